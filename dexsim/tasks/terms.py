"""Declares what a task is made of: observations, rewards, terminations, commands, events, metrics.

A term is a method of a `Task` under one of the decorators here. It returns one value for each of N worlds, as a torch
tensor, and is recorded in the step's graph: no Python branches on its values. Its options and its keyword arguments
with defaults become settings of the task, which the command line changes:

    @observe("N", noise=0.05)          task.observations.touch.noise=0.1  task.observations.touch.actor=false
    @reward(2.0)                       task.rewards.height=1
    def height(self, top=0.1): ...     task.reward.height.top=0.2
    @done                              task.terminations.dropped=false
    def dropped(self, below=-0.05)     task.termination.dropped.below=-0.1
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar, overload

import torch

from dexsim import typed
from dexsim.errors import UserError

Method = TypeVar("Method", bound=Callable[..., Any])
Span = float | tuple[float, float]
"""A number, or the ends of a range from which each episode draws."""
VECTOR, SIX = (1, -1, 1), (1, -1, 1, -1, 1, -1)
"""Signs of a mirror image: of a vector in the palm frame, of the first two columns of a rotation matrix."""
KINDS = ("observe", "reward", "done", "command", "event", "metric")
_MARK = "_dexsim_term"


@dataclass(frozen=True)
class Term:
    """A declared term. name: the method's, or the one that it was given; text: what it is (the first line of its
    docstring); options: what its decorator was given; params: its keyword arguments with their defaults."""

    kind: str
    name: str
    method: Callable[..., Any]
    unit: str = ""
    text: str = ""
    options: dict[str, Any] = field(default_factory=dict)
    params: dict[str, Any] = field(default_factory=dict)


def _declare(kind: str, method: Callable[..., Any], unit: str, options: dict[str, Any], name: str | None = None) -> Any:
    text = ((method.__doc__ or "").strip().splitlines() or [""])[0]
    params, skip = {}, {"event": 2}.get(kind, 1)
    takes = inspect.signature(method).parameters
    if len(takes) < skip:
        raise UserError(f"term {method.__name__}: must take {'self and mask [N]' if kind == 'event' else 'self'}")
    for k, (argument, p) in enumerate(takes.items()):
        if k < skip:
            continue
        if p.default is inspect.Parameter.empty:
            raise UserError(
                f"term {method.__name__}: its argument {argument} needs a default: the setting's usual value"
            )
        params[argument] = p.default
    term = Term(kind, name or method.__name__, method, unit, text.rstrip("."), options, params)
    setattr(method, _MARK, term)
    return method


def observe(
    unit: str = "", *, noise: float | str = 0.0, delay: Span | str = 0.0, dropout: float = 0.0, frames: int = 1,
    only: Literal["actor", "critic"] | None = None, real: str | None = None, name: str | None = None,
    mirror: tuple[int, ...] | None = None,
) -> Callable[[Method], Method]:  # fmt: skip
    """Declare a row of the observation: [N] or [N, ...], flattened; or several, by name, of one method.

    What the actor sees passes through value -> noise -> delay -> dropout -> frames; the critic sees the value. A method
    that reads `self.clean`, or touch, is computed for each: touch is clean for the critic.

    Args:
        unit: of the value, for the tables.
        noise: standard deviation of what is added to each number and control step, in `unit`; text: the setting of the
            task that has it, "sensors.joint_noise".
        delay: s that a reading is old; a pair: drawn anew for each episode; text as above.
        dropout: share of the readings that do not arrive; the one before stays.
        frames: how many of the last readings are seen, the newest first.
        only: who sees it; None: both.
        real: what provides it on a real hand, in words, for the manifest of a bundle; None: what the method's docstring
            says.
        mirror: signs by which its numbers change where hand and world are mirrored (palm y to -y), repeated:
            `VECTOR` of places and speeds in the palm frame, `SIX` of a 6D orientation; None: they stay.
        name: of the row, where the method's would hide something of the environment.
    """
    given = {"noise": noise, "delay": delay, "dropout": dropout, "frames": frames, "only": only, "real": real,
             "mirror": mirror}  # fmt: skip
    if callable(unit):
        raise UserError(f'term {getattr(unit, "__name__", "?")}: write @observe("unit"), with the unit of its value')
    return lambda method: _declare("observe", method, unit, given, name)


@overload
def reward(weight: Method) -> Method: ...
@overload
def reward(weight: float = 1.0, *, name: str | None = None) -> Callable[[Method], Method]: ...
def reward(weight: Any = 1.0, *, name: str | None = None) -> Any:
    """Declare a term of the reward, [N]; weight: what a control step's value is multiplied by. 0 leaves it out."""
    if callable(weight):
        return _declare("reward", weight, "", {"weight": 1.0})
    return lambda method: _declare("reward", method, "", {"weight": weight}, name)


@overload
def done(method: Method) -> Method: ...
@overload
def done(*, name: str) -> Callable[[Method], Method]: ...
def done(method: Any = None, *, name: str | None = None) -> Any:
    """Declare an end of the episode, bool [N]."""
    if method is not None:
        return _declare("done", method, "", {})
    return lambda method: _declare("done", method, "", {}, name)


def command(
    unit: str = "", *, hold_s: Span = float("inf"), only: Literal["actor", "critic", "rows"] | None = None
) -> Any:
    """Declare what the policy is told: the method returns new values for all worlds, [N] or [N, D], which hold for
    `hold_s` s (a pair: drawn anew), from the start of an episode. `self.commands[name]` is the present value, which is
    observed too, unless `only` says that other rows alone use it ("rows"); `self.renew(name, mask)` asks for a new
    one."""
    return lambda method: _declare("command", method, unit, {"hold_s": hold_s, "only": only})


def event(when: Method | Literal["reset"] = "reset", *, every_s: Span | None = None) -> Any:
    """Declare what happens to the masked worlds, `method(self, mask)`: as an episode begins, or `every_s` s (a pair:
    drawn anew each time)."""
    if callable(when):
        return _declare("event", when, "", {"every_s": None})
    return lambda method: _declare("event", method, "", {"every_s": every_s})


def metric(unit: str = "", *, now: bool = False, name: str | None = None) -> Callable[[Method], Method]:
    """Declare a figure of an episode, [N], a running value: the log shows that of the worlds' last ended episodes, and
    an evaluation its mean over episodes with an interval. now: the log shows the mean over worlds as they are."""
    return lambda method: _declare("metric", method, unit, {"now": now}, name)


def terms_of(made: type) -> dict[str, list[Term]]:
    """Return the terms of a class by kind, in the order in which they are declared; those of its bases first. A method
    of the same name takes the place of a base's; without a decorator it removes it."""
    found: dict[str, Term | None] = {}
    for owner in reversed(made.__mro__):
        for name, value in vars(owner).items():
            term = getattr(value, _MARK, None)
            if isinstance(term, Term):
                found[name] = term
            elif name in found:
                found[name] = None
    return {kind: [t for t in found.values() if t is not None and t.kind == kind] for kind in KINDS}


def span(value: Any, where: str, unit: str = "s") -> tuple[float, float]:
    """Return the ends of a number or a pair, not negative. Raises UserError."""
    pair = value if isinstance(value, (list, tuple)) else [value, value]
    good = len(pair) == 2 and all(isinstance(x, (int, float)) and not isinstance(x, bool) for x in pair)
    if not good or not 0 <= pair[0] <= pair[1]:
        raise UserError(f"{where}={value}: must be a number of {unit} of at least 0, or [low, high]")
    return float(pair[0]), float(pair[1])


class Sensing:
    """One row of the actor's observation: value -> noise -> delay -> dropout -> frames."""

    def __init__(self, term: Term, given: dict[str, Any], where: str):
        self.term, self.unit = term, term.unit
        self.noise = typed.number(f"{where}.noise", given["noise"], 0.0)
        self.dropout = typed.number(f"{where}.dropout", given["dropout"], 0.0, 1.0)
        self.frames = int(typed.number(f"{where}.frames", given["frames"], 1, 64, exact=True))
        self.delay = span(given["delay"], f"{where}.delay")
        self.params = {k: given[k] for k in term.params}
        self.width = 0  # of the value, known once it was computed
        self.clean_width = 0  # of what the critic sees
        self.parts: dict[str, int] = {}  # of a method of several rows: their widths by name
        self.twice = False  # whether actor and critic get values of their own
        self.lag: torch.Tensor | None = None  # [N] control steps
        self.past: torch.Tensor | None = None  # [N, L, D] readings, newest first, before delay
        self.got: torch.Tensor | None = None  # [N, D] the last that arrived
        self.seen: torch.Tensor | None = None  # [N, frames, D]

    def begin(self, mask: torch.Tensor, uniform: Callable[[], torch.Tensor], dt: float) -> None:
        """Draw the delay of new episodes."""
        low, high = self.delay
        if high == 0:
            return
        drawn = ((low + (high - low) * uniform()) / dt).round().long()
        if self.lag is None:
            self.lag = torch.zeros_like(drawn)
        self.lag.copy_(torch.where(mask, drawn, self.lag))

    def __call__(self, value: torch.Tensor, env: Any, fresh: torch.Tensor, advance: bool) -> torch.Tensor:
        """Return what is seen of a value [N, D]. fresh [N]: an episode begins; advance: a control step has passed."""
        sampler = env.sampler
        if self.noise:
            value = value + self.noise * sampler.normal(value.shape[1])
        if self.delay[1] > 0:
            length = int(-(-self.delay[1] // env.dt)) + 1
            if self.past is None:
                self.past = _lasting(value, length)
            moved = torch.cat([value[:, None], self.past[:, :-1]], 1)
            moved = torch.where(fresh[:, None, None], value[:, None].expand_as(moved), moved)
            if advance:
                self.past.copy_(moved)
            assert self.lag is not None
            pick = self.lag.clamp(max=length - 1)[:, None, None].expand(-1, 1, value.shape[1])
            value = moved.gather(1, pick)[:, 0]
        if self.dropout:
            if self.got is None:
                self.got = _lasting(value, 1)[:, 0]
            lost = (sampler.uniform() < self.dropout) & ~fresh
            value = torch.where(lost[:, None], self.got, value)
            if advance:
                self.got.copy_(value)
        if self.frames > 1:
            if self.seen is None:
                self.seen = _lasting(value, self.frames)
            moved = torch.cat([value[:, None], self.seen[:, :-1]], 1)
            moved = torch.where(fresh[:, None, None], value[:, None].expand_as(moved), moved)
            if advance:
                self.seen.copy_(moved)
            value = moved.flatten(1)
        return value

    def memory(self) -> dict[str, Any]:
        """Return what one step leaves to the next."""
        own: dict[str, Any] = {k: getattr(self, k) for k in ("past", "got", "seen") if getattr(self, k) is not None}
        if self.lag is not None:
            own["lag"] = self.lag, 0, 2**31
        return {f"{self.term.name}.{k}": v for k, v in own.items()}


def _lasting(value: torch.Tensor, count: int) -> torch.Tensor:
    """Return memory [N, count, D] that outlives the rollout that happens to come first."""
    with torch.inference_mode(False):
        return torch.zeros(len(value), count, value.shape[1], dtype=value.dtype, device=value.device)


Size = int | Callable[[Any], int]


def joints(env: Any) -> int:
    """Count the joints of the hand of an environment: a size of `memory`."""
    return int(env.num_actions)


def fingers(env: Any) -> int:
    """Count its fingers, likewise."""
    return int(env.fingers)


class Memory:
    """A tensor [N, ...] of a task that one control step leaves to the next; see `memory`. Assigning copies into it."""

    def __init__(self, shape: tuple[Size, ...], dtype: torch.dtype, reset: bool):
        self.shape, self.dtype, self.reset = shape, dtype, reset

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = f"_memory_{name}"

    def __get__(self, env: Any, owner: type | None = None) -> Any:
        return self if env is None else env.__dict__[self.name]

    def __set__(self, env: Any, value: torch.Tensor) -> None:
        held = env.__dict__[self.name]
        if value is held:
            return
        try:
            held.copy_(value)
        except (RuntimeError, TypeError) as error:
            shape = list(value.shape) if isinstance(value, torch.Tensor) else type(value).__name__
            name = self.name.removeprefix("_memory_")
            raise UserError(f"memory {name}: cannot take {shape}, it is declared as {list(held.shape)}") from error

    def allocate(self, env: Any) -> None:
        """Allocate zeros for all worlds of an environment."""
        shape = [size if isinstance(size, int) else size(env) for size in self.shape]
        env.__dict__[self.name] = torch.zeros(env.num_envs, *shape, dtype=self.dtype, device=env.device)


def memory(*shape: Size, dtype: torch.dtype = torch.float32, reset: bool = True) -> Any:
    """Declare a tensor [N, *shape] that lives from step to step, `turned = memory()`; zero where an episode begins,
    unless `reset` is False. Kept in checkpoints; `self.turned = ...` copies into it. A size may be a function of the
    environment, as `joints` and `fingers` are."""
    return Memory(shape, dtype, reset)


def memories_of(made: type) -> dict[str, Memory]:
    """Return the declared memory of a class and its bases by name."""
    return {name: v for owner in reversed(made.__mro__) for name, v in vars(owner).items() if isinstance(v, Memory)}
