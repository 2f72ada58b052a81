"""Stages of MuJoCo-Warp's step that need nothing of each other, side by side on a GPU.

    positions - broad phase - hulls | primitives, rows of friction and limits - rows of contacts - solver - integration
              - inertia, velocities, bias, unconstrained acceleration                            /

One after the other, most of these kernels leave a part of the GPU idle: they have a thread a world, or end when their
slowest pair does. What a step computes stays as it is; the order of contacts, which the GPU decides, may change.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import warp as wp
from mujoco_warp._src import collision_driver, constraint, smooth, solver


class Beside:
    """Two more streams of a device, for a step that is recorded: contacts; those of primitives, and constraint rows."""

    def __init__(self, contacts: wp.Stream, primitives: wp.Stream):
        self._contacts, self._primitives = contacts, primitives

    @contextmanager
    def in_place(self) -> Iterator[None]:
        """Let `mujoco_warp.step`, recorded within this, fork; it is joined again before the solver."""
        here, contacts, primitives = wp.get_stream(), self._contacts, self._primitives
        # of each stage: which stream waits for which before it, and where it is launched
        stages: tuple[tuple[Any, str, list[tuple[wp.Stream, wp.Stream]], wp.Stream], ...] = (
            (smooth, "com_pos", [(contacts, here), (primitives, here)], here),
            (collision_driver, "collision", [], contacts),
            (collision_driver, "convex_narrowphase", [(primitives, contacts)], contacts),
            (collision_driver, "primitive_narrowphase", [], primitives),
            (constraint, "make_constraint", [(primitives, here)], primitives),
            (constraint, "_efc_contact_init", [(primitives, contacts)], primitives),
            (solver, "solve", [(here, contacts), (here, primitives)], here),
        )
        original = [(owner, name, getattr(owner, name)) for owner, name, *_ in stages]
        for (owner, name, theirs), (*_, waits, stream) in zip(original, stages, strict=True):
            setattr(owner, name, _launched(theirs, waits, stream))
        try:
            yield
        finally:
            for owner, name, theirs in original:
                setattr(owner, name, theirs)


def _launched(
    stage: Callable[..., Any], waits: list[tuple[wp.Stream, wp.Stream]], stream: wp.Stream
) -> Callable[..., Any]:
    """Return a stage that is launched on a stream, when each stream of `waits` waits for the other."""

    def launch(*args: Any) -> Any:
        for one, other in waits:
            one.wait_stream(other)
        with wp.ScopedStream(stream, sync_enter=False):
            return stage(*args)

    return launch
