"""Sums of one iteration kept on the device: no host synchronisation until the iteration is over."""

from __future__ import annotations

from collections.abc import Callable

import torch


class Meter:
    """Rewards, episode lengths and the environment's log terms over one iteration.

    ``add`` only launches small device operations; ``read`` synchronises once. A log term may be a number or a tensor
    (its mean counts); NaN says "nothing to report at this step" and is left out of the mean.
    """

    def __init__(self, n: int, device: str) -> None:
        self._return = torch.zeros(n, device=device)
        self._length = torch.zeros(n, device=device)
        # returns, lengths and number of ended episodes; reward of all steps
        self._sums = torch.zeros(4, dtype=torch.float64, device=device)
        self._device = device
        self._steps = 0
        self._logs: dict[tuple[str, ...], list[torch.Tensor]] = {}

    def add(self, rewards: torch.Tensor, dones: torch.Tensor, log: dict | None) -> None:
        """Count one step: rewards [N], dones [N], the environment's ``extras["log"]``."""
        done = (dones > 0).float()
        self._return += rewards
        self._length += 1
        step = torch.stack([(self._return * done).sum(), (self._length * done).sum(), done.sum(), rewards.mean()])
        self._sums += step.double()
        self._return *= 1 - done
        self._length *= 1 - done
        self._steps += 1
        if log:
            values = [self._mean(v) for v in log.values()]
            self._logs.setdefault(tuple(log), []).append(torch.stack(values))

    def _mean(self, value: float | torch.Tensor) -> torch.Tensor:
        if isinstance(value, torch.Tensor):
            value = value.detach().to(self._device, torch.float32)
            return value if value.ndim == 0 else value.mean()
        return torch.full((), float(value), device=self._device)

    def read(self, over_ranks: Callable[[torch.Tensor], torch.Tensor] = lambda sums: sums) -> dict[str, float]:
        """Means of the iteration, then start the next one. ``reward`` and ``length`` are over the episodes that ended
        (absent when none did), ``step_reward`` over all steps.

        over_ranks: adds up float64 sums [K] over the processes of a run (all log the same terms).
        """
        parts, names = [self._sums, self._sums.new_full((1,), self._steps)], []
        for keys, steps in self._logs.items():
            rows = torch.stack(steps).double()
            there = ~rows.isnan()
            parts += [torch.where(there, rows, 0.0).sum(0), there.sum(0).double()]
            names.append(keys)
        returns, lengths, ended, rewards, steps, *rest = over_ranks(torch.cat(parts)).tolist()
        found: dict[str, float] = {"step_reward": rewards / max(steps, 1)}
        if ended:
            found |= {"reward": returns / ended, "length": lengths / ended, "episodes": ended}
        for keys in names:
            sums, counts, rest = rest[: len(keys)], rest[len(keys): 2 * len(keys)], rest[2 * len(keys):]
            found |= {(k if "/" in k else f"Episode/{k}"): s / n for k, s, n in zip(keys, sums, counts) if n}
        self.drop()
        return found

    def state(self) -> dict[str, torch.Tensor]:
        """Returns and lengths so far of the episodes that go on, copied."""
        return {"meter.return": self._return.clone(), "meter.length": self._length.clone()}

    def load(self, state: dict[str, torch.Tensor]) -> None:
        """Go on from `state()`."""
        self._return.copy_(state["meter.return"])
        self._length.copy_(state["meter.length"])

    def drop(self) -> None:
        """Forget the sums, of a rollout that is over or was broken off."""
        self._sums.zero_()
        self._logs.clear()
        self._steps = 0
