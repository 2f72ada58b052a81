"""Kernels that a control step launches outside physics, and which lines launch them.

    python -m tests.launches [lines=25] [any setting of train.py]

On a GPU each of them costs 1.6 to 2 us, whatever it does, so that their number is what the step costs beside its
physics. They are counted on a CPU with MuJoCo-Warp, in the step as a GPU records it: torch operations that compute
(views and bare allocations do not) and Warp launches. An operation of torch counts as one, though some are two or three
kernels. The number belongs to the code and to no machine.
"""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
import warp as wp
from torch.utils._python_dispatch import TorchDispatchMode

from benchmarks import tools
from benchmarks.options import options
from dexsim import rotation
from dexsim.sim.launches import Launches
from dexsim.tasks import make_env

PACKAGE = Path(rotation.__file__).parent
FREE = {"detach", "empty", "empty_like", "empty_strided", "new_empty", "lift_fresh", "_local_scalar_dense"}
"""Operations of torch that launch nothing."""
PARTS = ("before", "touch", "after", "reset", "returned")


class Count(TorchDispatchMode):
    """Counts what is launched while it is on: `found[line of dexsim]`."""

    def __init__(self) -> None:
        super().__init__()
        self.found: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        if not func.is_view and func._overloadpacket.__name__ not in FREE and not _reshaped(func, args, out):
            self.found[_line()] += 1
        return out


def _reshaped(func: Any, args: Any, out: Any) -> bool:
    """Return whether an operation that could copy gave a view."""
    own = func._overloadpacket.__name__ in ("_reshape_alias", "reshape", "_unsafe_view", "_to_copy", "contiguous")
    return own and isinstance(out, torch.Tensor) and out.data_ptr() == args[0].data_ptr()


def _line() -> str:
    """Return the innermost line of dexsim that is being run."""
    for frame in reversed(traceback.extract_stack()[:-2]):
        path = Path(frame.filename)
        if PACKAGE in path.parents:
            return f"{path.relative_to(PACKAGE.parent)}:{frame.lineno} {frame.name}"
    return "elsewhere"


@contextmanager
def counting() -> Iterator[Counter[str]]:
    """Yield what is launched meanwhile, by line; Warp's kernels are counted and run."""
    count, launch, packed = Count(), wp.launch, Launches.__call__

    def counted(*args: Any, **kwargs: Any) -> Any:
        count.found[_line()] += 1
        return launch(*args, **kwargs)

    def counted_once(self: Launches, *args: Any) -> None:
        count.found[_line()] += 1
        wp.launch = launch  # what packs a launch is not another
        try:
            packed(self, *args)
        finally:
            wp.launch = counted

    wp.launch, Launches.__call__ = counted, counted_once  # type: ignore[method-assign]
    try:
        with count:
            yield count.found
    finally:
        wp.launch, Launches.__call__ = launch, packed  # type: ignore[method-assign]


@contextmanager
def as_on_a_gpu(env: Any) -> Iterator[None]:
    """Choose what a GPU would be given, where the code asks."""
    multiply, to_matrix = rotation.multiply, rotation.to_matrix
    rotation.multiply, rotation.to_matrix = rotation._multiply_in_few, rotation._to_matrix_in_few
    env.draws_ahead, before = True, env.draws_ahead
    try:
        yield
    finally:
        rotation.multiply, rotation.to_matrix = multiply, to_matrix
        env.draws_ahead = before


def count(env: Any, actions: torch.Tensor) -> dict[str, Counter[str]]:
    """Launches of one control step outside physics, by part and line. The environment must have done steps before."""
    found: dict[str, Counter[str]] = {}

    def part(name: str, call: Any) -> None:
        with counting() as lines:
            call()
        found[name] = lines

    with as_on_a_gpu(env):
        env.step(actions)
        env.step(actions)  # what is drawn together is known after the first
        env._action_in.copy_(actions)
        part("before", env._before)
        with counting() as servo:
            env.servo.before_each()
        env.engine.step(env.decimation, env.servo.before_each)
        part("touch", env.feel)
        found["touch"] += Counter({line: n * env.decimation for line, n in servo.items()})
        part("after", env._after)
        part("reset", lambda: env.reset(env.done))
        part("returned", env.results)
    return found


def main(argv: list[str]) -> dict:
    rest: list[str] = []
    displayed = options(argv, {"lines": 25}, rest)["lines"]
    cfg = tools.config(["device=cpu", "worlds=4", "sim.engine=warp", *rest])
    env = make_env(cfg, cfg["worlds"], "cpu", 0, "warp")
    found = count(env, torch.zeros(env.num_envs, env.num_actions))
    lines = sum(found.values(), Counter())
    for line, n in lines.most_common(displayed):
        print(f"  {n:4d}  {line}")
    out = {name: sum(part.values()) for name, part in found.items()}
    return tools.report({"benchmark": "launches", "task": cfg["task"]["name"], **out, "launches": sum(out.values())})


if __name__ == "__main__":
    tools.command(main, __doc__)
