"""The narrow phase's host side: its tables, its launches, and its place in MuJoCo-Warp's step."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from mujoco_warp._src import collision_driver
from mujoco_warp._src.types import GeomType
from mujoco_warp._src.warp_util import event_scope

from dexsim.sim.collision import kernels
from dexsim.sim.collision.shapes import BOX, CAPSULE, CYLINDER, HULL, SPHERE, hull_corners
from dexsim.sim.launches import taken

VERSION = "4.0.0"
"""The MuJoCo-Warp whose stages this replaces and calls; with another one the setting is refused (see `unsupported`)."""
ROUND = {(GeomType.CAPSULE, GeomType.CYLINDER), (GeomType.CYLINDER, GeomType.BOX), (GeomType.CYLINDER, GeomType.MESH)}
"""Types of geom pairs with a cylinder that are ours."""
KINDS = ROUND | {(GeomType(kind), GeomType.MESH) for kind in (SPHERE, CAPSULE, BOX, HULL)}
"""Types of geom pairs that are ours."""
_DISTANCE_SENSORS = [int(getattr(mujoco.mjtSensor, f"mjSENS_GEOM{name}")) for name in ("DIST", "NORMAL", "FROMTO")]
_MOST_CORNERS = 1 << 15  # corners are named by 16 bits


def unsupported(model: mujoco.MjModel) -> str | None:
    """Return the why `sim.collision=hand` cannot serve this model, or None if it can."""
    if mjw.__version__ != VERSION:
        return f"it is written for MuJoCo-Warp {VERSION}, and {mjw.__version__} is installed"
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_MULTICCD:
        return "it makes one contact a pair, and the model asks for several (multiccd)"
    if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
        return "it does not let bodies sleep, and the model asks for that"
    if np.isin(model.sensor_type, _DISTANCE_SENSORS).any():
        return "it answers no sensor of distances between geoms, and the model has one"
    most = max((len(c) for c in _hulls(model)), default=0)
    if most > _MOST_CORNERS:
        return f"a convex hull of the model has {most} corners, and {_MOST_CORNERS} is the most it takes"
    return None


def _hulls(model: mujoco.MjModel) -> list[np.ndarray]:
    first, count, corners = hull_corners(model)
    return [corners[f : f + n] for f, n in zip(first, count, strict=True)]


class NarrowPhase:
    """Contacts of the model's hulls and cylinders, for N worlds of `m`.

    Attributes:
      simplex: wp.array [N, P] vec3i, corners that were nearest in the last step, of each of the model's P pairs with a
        hull; -1 = forget. Results depend on it by rounding only.
      deep_number: wp.array [1] int, pairs of the last step whose cores overlapped.
    """

    def __init__(self, model: mujoco.MjModel, m: mjw.Model, d: mjw.Data):
        self.m, self.d = m, d
        self.block_dim = 128  # threads a block of the kernel for bodies that are apart
        slot = np.full((model.ngeom, model.ngeom), -1, np.int32)
        pairs = np.sort(m.nxn_geom_pair_filtered.numpy().reshape(-1, 2), axis=1)
        by_type = np.take_along_axis(pairs, np.argsort(model.geom_type[pairs], axis=1, kind="stable"), axis=1)
        ours = by_type[[(GeomType(int(a)), GeomType(int(b))) in KINDS for a, b in model.geom_type[by_type]]]
        for k, (a, b) in enumerate(ours):
            slot[a, b] = slot[b, a] = k
        first, count, corners = hull_corners(model)
        self.number = len(ours)
        self.cylinders = bool((model.geom_type[ours] == CYLINDER).any())
        if not self.number:
            return
        self.simplex = wp.full((d.nworld, self.number), wp.vec3i(-1, -1, -1), dtype=wp.vec3i)
        self.deep_number = wp.zeros(1, dtype=int)
        self._deep, self._enclosing = wp.zeros(d.naconmax, dtype=int), wp.zeros(d.naconmax, dtype=wp.vec4i)
        self._pairs = taken(kernels.Pairs, m)
        p = self._pairs
        p.geom_xpos, p.geom_xmat, p.room, p.number = d.geom_xpos, d.geom_xmat, d.naconmax, d.ncollision
        p.hull_first, p.hull_count, p.hull = (
            wp.array(first, dtype=int),
            wp.array(count, dtype=int),
            wp.array(corners, dtype=wp.vec3),
        )
        p.slot, p.simplex = wp.array(slot, dtype=int), self.simplex
        self._mat = taken(kernels.Materials, m)
        self._out = taken(kernels.Contacts, d.contact)
        self._out.nacon = d.nacon

    @contextmanager
    def in_place(self) -> Iterator[None]:
        """Let `mujoco_warp.step`, within this, find the contacts of hulls here."""
        theirs = collision_driver.convex_narrowphase

        def convex(m: mjw.Model, d: mjw.Data, ctx: Any, table: list[tuple[GeomType, GeomType]]) -> None:
            theirs(m, d, ctx, [pair for pair in table if pair not in KINDS])
            self.launch(ctx)

        collision_driver.convex_narrowphase = convex
        try:
            yield
        finally:
            collision_driver.convex_narrowphase = theirs

    def launch(self, ctx: collision_driver.CollisionContext) -> None:
        """Append the contacts of the broad phase's pairs in `ctx` to the contact list."""
        hull_narrowphase(self, ctx)


@event_scope
def hull_narrowphase(n: NarrowPhase, ctx: collision_driver.CollisionContext) -> None:
    d, pairs = n.d, n._pairs
    pairs.geom, pairs.id, pairs.world = ctx.collision_pair, ctx.collision_pairid, ctx.collision_worldid
    n.deep_number.zero_()
    wp.launch(
        kernels.separate, dim=d.naconmax, inputs=[pairs, n._mat],
        outputs=[n._out, n._deep, n._enclosing, n.deep_number], block_dim=n.block_dim,
    )  # fmt: skip
    threads = min(d.naconmax, 1 << 15)
    wp.launch(
        kernels.overlapping, dim=threads, inputs=[pairs, n._mat, n._deep, n._enclosing, n.deep_number, threads],
        outputs=[n._out], block_dim=32,
    )  # fmt: skip
    if n.cylinders:
        wp.launch(kernels.beside_cylinder, dim=d.naconmax, inputs=[pairs, n._mat], outputs=[n._out], block_dim=32)
