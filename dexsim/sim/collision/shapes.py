"""Convex cores: what is left of a geom when its radius is taken away, and their corners and supports.

A sphere is a point, a capsule a segment, a box and a hull are themselves; the radius is added again to the distance of
the cores, exactly. Every core is the hull of a few numbered corners, so a search of the nearest points is over pairs of
numbers. A cylinder is the prism of very many sides.
"""

from __future__ import annotations

import mujoco
import numpy as np
import warp as wp

SPHERE, CAPSULE, CYLINDER, BOX, HULL = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}")) for name in ("SPHERE", "CAPSULE", "CYLINDER", "BOX", "MESH")
)
SIDES = wp.constant(1 << 14)
"""Of the prism that stands for a cylinder: one of 30 mm radius lacks 0.6 nm of its roundness."""


@wp.struct
class Core:
    """kind: SPHERE (a point), CAPSULE (a segment along z), BOX or HULL. half [m]: size of the geom. first, count: its
    corners in the table of hull corners."""

    kind: int
    half: wp.vec3
    first: int
    count: int


@wp.struct
class Prism:
    """A cylinder along z. half [m]: radius, half length. Its own type, so that kernels without cylinders are compiled
    without them."""

    half: wp.vec3


@wp.func
def radius_of(kind: int, size: wp.vec3) -> float:
    """Return the distance of the geom's surface from its core [m]."""
    if kind == SPHERE or kind == CAPSULE:
        return size[0]
    return 0.0


@wp.func
def corners(core: Core) -> int:
    if core.kind == HULL:
        return core.count
    if core.kind == BOX:
        return 8
    if core.kind == CAPSULE:
        return 2
    return 1


@wp.func
def corner(core: Core, vertex: wp.array(dtype=wp.vec3), i: int) -> wp.vec3:
    """Return the corner i in the geom's frame [m]."""
    if core.kind == HULL:
        return vertex[core.first + i]
    if core.kind == BOX:
        h = core.half
        return wp.vec3(
            wp.where((i & 1) != 0, h[0], -h[0]),
            wp.where((i & 2) != 0, h[1], -h[1]),
            wp.where((i & 4) != 0, h[2], -h[2]),
        )
    if core.kind == CAPSULE:
        return wp.vec3(0.0, 0.0, wp.where(i != 0, core.half[1], -core.half[1]))
    return wp.vec3(0.0, 0.0, 0.0)


@wp.func
def support(core: Core, vertex: wp.array(dtype=wp.vec3), d: wp.vec3) -> int:
    """Return the corner that is furthest along d (in the geom's frame)."""
    if core.kind == HULL:
        # All of them, in order: the corners of one hull are few and neighbouring threads read the same ones, while a
        # climb along edges is a chain of loads that wait for each other.
        best = int(0)
        most = wp.dot(vertex[core.first], d)
        for i in range(1, core.count):
            s = wp.dot(vertex[core.first + i], d)
            if s > most:
                most = s
                best = i
        return best
    if core.kind == BOX:
        return wp.where(d[0] > 0.0, 1, 0) + wp.where(d[1] > 0.0, 2, 0) + wp.where(d[2] > 0.0, 4, 0)
    if core.kind == CAPSULE:
        return wp.where(d[2] > 0.0, 1, 0)
    return 0


@wp.func  # type: ignore[no-redef]
def corner(core: Prism, vertex: wp.array(dtype=wp.vec3), i: int) -> wp.vec3:  # noqa: F811  (an overload)
    """Return the corner i in the geom's frame [m]: at the upper end if odd."""
    angle = (2.0 * wp.pi / float(SIDES)) * float(i >> 1)
    h = core.half
    return wp.vec3(h[0] * wp.cos(angle), h[0] * wp.sin(angle), wp.where((i & 1) != 0, h[1], -h[1]))


@wp.func  # type: ignore[no-redef]
def support(core: Prism, vertex: wp.array(dtype=wp.vec3), d: wp.vec3) -> int:  # noqa: F811  (an overload)
    """Return the corner that is furthest along d (in the geom's frame)."""
    turn = int(wp.round(wp.atan2(d[1], d[0]) * (float(SIDES) / (2.0 * wp.pi))))
    return ((turn & (SIDES - 1)) << 1) + wp.where(d[2] > 0.0, 1, 0)


def hull_corners(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return corners of each mesh's convex hull: (first [nmesh], count [nmesh], corners [n, 3] in m). A mesh without
    a hull, which no geom that collides has, gets none."""
    first, count, found = (
        np.zeros(model.nmesh, np.int32),
        np.zeros(model.nmesh, np.int32),
        [np.zeros((0, 3), np.float32)],
    )
    for k in range(model.nmesh):
        vertex = model.mesh_vert[model.mesh_vertadr[k] :][: model.mesh_vertnum[k]]
        adr = model.mesh_graphadr[k]
        if adr < 0:
            continue
        number = int(model.mesh_graph[adr])
        first[k], count[k] = sum(map(len, found)), number
        found.append(vertex[model.mesh_graph[adr + 2 + number :][:number]])
    return first, count, np.concatenate(found).astype(np.float32)
