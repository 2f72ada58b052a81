"""A physics step whose stages run side by side on a GPU: its streams, followed on a CPU, leave no order to chance."""

from __future__ import annotations

import contextlib
import math

import mujoco_warp as mjw
import pytest
import warp as wp
from worlds import task_cfg

from dexsim.sim.beside import Beside
from dexsim.tasks import make_env


class Stream:
    """A stream that only notes what it waits for: of each launch, which earlier ones are over when it begins."""

    def __init__(self, name: str):
        self.name, self.over = name, set()

    def wait_stream(self, other: Stream) -> None:
        self.over |= other.over


def arrays(values):
    """Return (pointer, bytes) of all arrays, those of structs too."""
    for value in values:
        if isinstance(value, wp.array) and value.ptr and value.size:
            yield value.ptr, value.ptr + value.capacity
        elif hasattr(value, "_cls"):
            yield from arrays(getattr(value, name) for name in value._cls.vars)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["grasp", "rotate", "rotate_fingertips"])
def test_no_stage_writes_what_another_beside_it_uses(task, monkeypatch):
    env = make_env(task_cfg(task=task, worlds=2), 2, "cpu", 0, "warp")
    assert not env.engine.mjm.neq and not env.engine.mjm.ntendon  # with them, one after the other
    engine, launches = env.engine, []
    here = now = Stream("here")
    launch, launch_tiled, zero = wp.launch, wp.launch_tiled, wp.array.zero_

    def follow(reads, writes, what):
        launches.append((set(now.over), set(arrays(reads)), set(arrays(writes)), what, now.name))
        now.over.add(len(launches) - 1)

    def launched(kernel, dim, inputs=(), outputs=(), *args, **kwargs):
        if math.prod(dim if isinstance(dim, (tuple, list)) else (dim,)):
            follow(inputs, outputs, kernel.key)
        launch(kernel, dim, inputs, outputs, *args, **kwargs)

    def tiled(kernel, dim, inputs=(), outputs=(), **kwargs):
        follow(inputs, outputs, kernel.key)
        launch_tiled(kernel, dim=dim, inputs=inputs, outputs=outputs, **kwargs)

    def zeroed(array):
        follow((), [array], "zero")
        zero(array)

    @contextlib.contextmanager
    def scoped(stream, sync_enter=True):
        nonlocal now
        assert not sync_enter
        before, now = now, stream
        yield
        now = before

    monkeypatch.setattr(wp, "get_stream", lambda: now)
    monkeypatch.setattr(wp, "ScopedStream", scoped)
    monkeypatch.setattr(wp, "launch", launched)
    monkeypatch.setattr(wp.array, "zero_", zeroed)
    monkeypatch.setattr(wp, "launch_tiled", tiled)
    with engine.narrow.in_place(), Beside(Stream("contacts"), Stream("primitives")).in_place():
        mjw.step(engine.m, engine.d)
    assert here.over == set(range(len(launches)))  # all is joined
    names = {name for *_, name in launches}
    assert names == {"here", "contacts", "primitives"}
    for k, (over, reads, writes, what, _) in enumerate(launches):
        for i in set(range(k)) - over:
            _, read, wrote, other, _ = launches[i]
            if all("primitive" in kernel or kernel in ("separate", "overlapping") for kernel in (what, other)):
                continue  # both append to one list of contacts
            clash = [(a, b) for a, b in writes for c, d in read | wrote if a < d and c < b]
            clash += [(a, b) for a, b in wrote for c, d in reads if a < d and c < b]
            assert not clash, (what, other)
