"""Sampling of what varies by episode: named ranges from `dexsim/configs/randomize/`, drawn for all worlds at once."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

import torch
import warp as wp

from dexsim.errors import UserError

Request = tuple[str, tuple[int, ...]]
"""What is drawn (a range's name, or UNIFORM or NORMAL) and its shape by world."""
UNIFORM, NORMAL = "[0, 1)", "N(0, 1)"
_PLAIN, _LINEAR, _LOG = 0, 1, 2


@wp.kernel(enable_backward=False)
def spread(
    kind: wp.array(dtype=int), table: wp.array2d(dtype=float), width: wp.array(dtype=float), u: wp.array2d(dtype=float)
):
    """Numbers in [0, 1) [R, N] to their ranges: (low, high - low) or, of a logarithmic one, (low, high / low)."""
    r, w = wp.tid()
    if kind[r] == wp.static(_PLAIN):
        return
    share = 0.5 + width[0] * (u[r, w] - 0.5)
    if kind[r] == wp.static(_LINEAR):
        u[r, w] = table[r, 0] + share * table[r, 1]
    else:
        u[r, w] = table[r, 0] * wp.pow(table[r, 1], share)


class Plan:
    """Draws a list of requests at once: one call of the generator for all uniform numbers, one for all normal ones."""

    def __init__(self, sampler: Sampler, requests: list[Request]):
        wp.init()
        self.requests, self._sampler = requests, sampler
        size = {i: max(1, math.prod(shape)) for i, (_, shape) in enumerate(requests)}
        log = {i: sampler.ranges[name][2] for i, (name, _) in enumerate(requests) if name in sampler.ranges}
        groups = [  # rows of one matrix each, in this order
            [i for i, (name, _) in enumerate(requests) if name == UNIFORM],
            [i for i in log if not log[i]],
            [i for i in log if log[i]],
            [i for i, (name, _) in enumerate(requests) if name == NORMAL],
        ]
        self._rows = [[(i, size[i]) for i in group] for group in groups]
        plain, linear, log_uniform, self._normal = (sum(n for _, n in rows) for rows in self._rows)
        self._uniform = plain + linear + log_uniform
        ends = [sampler.ranges[requests[i][0]] for rows in self._rows[1:3] for i, n in rows for _ in range(n)]
        table = [(0.0, 1.0)] * plain + [(low, high / low if is_log else high - low) for low, high, is_log in ends]
        kinds = [_PLAIN] * plain + [_LINEAR] * linear + [_LOG] * log_uniform
        dev = sampler.device
        self._table = torch.tensor(table, dtype=torch.float32).reshape(-1, 2).to(dev)
        self._kinds = torch.tensor(kinds, dtype=torch.int32).to(dev)

    def draw(self) -> list[torch.Tensor]:
        """Return [N, *shape] of each request, in order."""
        s = self._sampler
        u = torch.rand(self._uniform, s.n, generator=s.rng, device=s.device)
        args = [wp.from_torch(x) for x in (self._kinds, self._table, s.width.reshape(1), u)]
        wp.launch(spread, dim=u.shape, inputs=args, device=str(u.device))
        drawn = [*u.split([sum(n for _, n in rows) for rows in self._rows[:3]])]
        drawn.append(torch.randn(self._normal, s.n, generator=s.rng, device=s.device))
        out: dict[int, torch.Tensor] = {}
        for rows, values in zip(self._rows, drawn, strict=True):
            at = 0
            for i, n in rows:
                out[i] = values[at : at + n].view(*self.requests[i][1], s.n).movedim(-1, 0)
                at += n
        return [out[i] for i in range(len(self.requests))]


class Sampler:
    """Draws the ranges of a randomization config.

    cfg: nested dict whose leaves are `[low, high]` (uniform), `{log: [low, high]}` (log-uniform) or a number (fixed).
    Draws are independent by world (and by column); nothing depends on earlier draws.
    """

    def __init__(self, cfg: dict, rng: torch.Generator, n: int, device: str):
        self.cfg, self.rng, self.n, self.device = cfg, rng, n, device
        self.ranges: dict[str, tuple[float, float, bool]] = {}
        self.read: set[str] = set()  # names of ranges that somebody asked for
        # share of each range, about its middle, that `draw` uses: a curriculum widens it
        self.width = torch.ones((), device=device)
        self._read("randomize", cfg)
        self._plans: dict[str, Plan] = {}
        self._noted: list[Request] | None = None
        self._ahead: deque[tuple[Request, torch.Tensor]] = deque()

    @contextmanager
    def drawn_ahead(self, name: str) -> Iterator[None]:
        """Draw, within this, what is drawn by a dozen kernels, and not by six for each range.

        The first time under a `name` notes what is asked for, in which order. From then on all of that is drawn at the
        beginning and handed out, as long as it is asked for in the same order; after something else, one by one again.
        The numbers are others than without, of the same ranges.
        """
        plan = self._plans.get(name)
        noted: list[Request] = []
        if plan is None:
            self._noted = noted
        else:
            self._ahead.extend(zip(plan.requests, plan.draw(), strict=True))
        try:
            yield
        finally:
            self._noted = None
            self._ahead.clear()
        if plan is None:
            self._plans[name] = Plan(self, noted)

    def _given(self, name: str, shape: tuple[int, ...]) -> torch.Tensor | None:
        """Return what was drawn ahead for this request, if it is the next."""
        if self._noted is not None:
            self._noted.append((name, shape))
        if self._ahead:
            request, value = self._ahead.popleft()
            if request == (name, shape):
                return value
            self._ahead.clear()
        return None

    def _read(self, path: str, node: dict) -> None:
        for key, value in node.items():
            here = f"{path}.{key}"
            name = here.removeprefix("randomize.")
            if isinstance(value, dict) and set(value) != {"log"}:
                self._read(here, value)
                continue
            log = isinstance(value, dict)
            pair = value["log"] if log else value
            pair = [pair, pair] if isinstance(pair, (int, float)) else pair
            if not (
                isinstance(pair, (list, tuple)) and len(pair) == 2 and all(isinstance(v, (int, float)) for v in pair)
            ):
                raise UserError(f"{here}={value}: must be a number, [low, high], or {{log: [low, high]}}")
            low, high = float(pair[0]), float(pair[1])
            if not (math.isfinite(low) and math.isfinite(high)):
                raise UserError(f"{here}=[{low}, {high}]: both ends must be finite")
            if not low <= high:
                raise UserError(f"{here}=[{low}, {high}]: low must not exceed high")
            if log and low <= 0:
                raise UserError(f"{here}: a log range needs low > 0, not {low}")
            self.ranges[name] = (low, high, log)

    def check(self, name: str, low: float, high: float) -> None:
        """Raise UserError unless the range `name` lies in [low, high]."""
        a, b, _ = self.range(name)
        if a < low or b > high:
            raise UserError(f"randomize.{name}=[{a:g}, {b:g}]: must lie in [{low:g}, {high:g}]")

    def rows(self) -> list[tuple[str, str, str]]:
        """(name, range, "") of all ranges, for the first screen."""
        return [
            (name, f"[{lo:g}, {hi:g}]" + (" log" if log else ""), "") for name, (lo, hi, log) in self.ranges.items()
        ]

    def range(self, name: str) -> tuple[float, float, bool]:
        self.read.add(name)
        if name not in self.ranges:
            raise UserError(f"randomize.{name} is missing; the file has: {', '.join(self.ranges)}")
        return self.ranges[name]

    def draw(self, name: str, *shape: int) -> torch.Tensor:
        """Return [N, *shape] samples of the range `name`, float32."""
        low, high, log = self.range(name)
        if (given := self._given(name, shape)) is not None:
            return given
        u = 0.5 + self.width * (torch.rand(self.n, *shape, generator=self.rng, device=self.device) - 0.5)
        if log:
            return low * (high / low) ** u
        return low + (high - low) * u

    def uniform(self, *shape: int) -> torch.Tensor:
        """Return [N, *shape] uniform in [0, 1)."""
        if (given := self._given(UNIFORM, shape)) is not None:
            return given
        return torch.rand(self.n, *shape, generator=self.rng, device=self.device)

    def normal(self, *shape: int) -> torch.Tensor:
        """Return [N, *shape] standard normal."""
        if (given := self._given(NORMAL, shape)) is not None:
            return given
        return torch.randn(self.n, *shape, generator=self.rng, device=self.device)

    def direction(self) -> torch.Tensor:
        """Return [N, 3] unit vectors, uniform on the sphere."""
        v = self.normal(3)
        return v / v.norm(dim=1, keepdim=True).clamp(min=1e-9)

    def quaternion(self) -> torch.Tensor:
        """Return [N, 4] rotations (w x y z), uniform."""
        q = self.normal(4)
        return q / q.norm(dim=1, keepdim=True).clamp(min=1e-9)
