"""A world's state set anew, by one kernel for all that belongs to it."""

# No `from __future__ import annotations`: Warp resolves these annotations from the closure.

from functools import cache
from types import SimpleNamespace
from typing import Any

import torch
import warp as wp


@cache
def _kernel(real: type) -> tuple[wp.Kernel, Any]:
    """Return the kernel, and the struct that it takes: what belongs to the state of N worlds."""

    @wp.struct
    class States:
        qpos: wp.array2d(dtype=real)
        qvel: wp.array2d(dtype=real)
        warmstart: wp.array2d(dtype=real)
        qfrc_applied: wp.array2d(dtype=real)
        xfrc_applied: wp.array3d(dtype=real)
        time: wp.array(dtype=real)
        pair_normal: wp.array2d(dtype=float)
        pair_force: wp.array2d(dtype=wp.vec3)
        flags: wp.array(dtype=int)

    @wp.kernel(module="unique", enable_backward=False)
    def set_state(
        mask: wp.array(dtype=wp.bool),
        new_qpos: wp.array2d(dtype=real),
        new_qvel: wp.array2d(dtype=real),
        out: States,
    ):
        w, k = wp.tid()
        if not mask[w]:
            return
        if k < out.qpos.shape[1]:
            out.qpos[w, k] = new_qpos[w, k]
        if k < out.qvel.shape[1]:
            out.qvel[w, k] = new_qvel[w, k]
            out.warmstart[w, k] = real(0.0)
            out.qfrc_applied[w, k] = real(0.0)
        if k < out.xfrc_applied.shape[1]:
            for c in range(6):
                out.xfrc_applied[w, k, c] = real(0.0)
        if k < out.pair_normal.shape[1]:
            out.pair_normal[w, k] = float(0.0)
            out.pair_force[w, k] = wp.vec3(0.0, 0.0, 0.0)
        if k == 0:
            out.time[w] = real(0.0)
            out.flags[w] = 0

    return set_state, States


class Begin:
    """Sets states of an engine's worlds (`Engine.set_state`).

    real: Warp scalar of the engine's state. own: the engine's `wp`. t: its `t`; warmstart [N, nv]."""

    def __init__(self, real: type, own: SimpleNamespace, t: SimpleNamespace, warmstart: torch.Tensor):
        (self._kernel, states), self._dtype, self._device = _kernel(real), t.qpos.dtype, own.qpos.device
        self._out = states()
        for name in ("qpos", "qvel", "qfrc_applied", "time", "pair_normal", "pair_force", "flags"):
            setattr(self._out, name, getattr(own, name))
        self._out.warmstart, self._out.xfrc_applied = wp.from_torch(warmstart), wp.from_torch(t.xfrc_applied)
        n, most = t.qpos.shape[0], max(x.shape[1] for x in (t.qpos, t.qvel, t.xfrc_applied, t.pair_normal))
        self._dim = n, most

    def __call__(self, mask: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor) -> None:
        new = [wp.from_torch(x.to(self._dtype)) for x in (qpos, qvel)]
        wp.launch(self._kernel, dim=self._dim, inputs=[wp.from_torch(mask), *new, self._out], device=self._device)
