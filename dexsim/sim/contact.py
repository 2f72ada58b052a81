"""Forces out of MuJoCo-Warp's results: contact forces of named pairs, summed from its contact list, and what a dof
felt from outside."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import warp as wp
from mujoco_warp._src.types import vec5

from dexsim.sim.engine import ContactPair, geoms_of

# Sums are fixed-point integers: integer atomics commute, so results do not depend on the order of threads.


def pair_table(model: mujoco.MjModel, pairs: Sequence[ContactPair]) -> np.ndarray:
    """Return, for geoms (a, b), the pairs they belong to, int32 [ngeom, ngeom, most]; +p+1 if a is of the pair's first
    member, -(p+1) if b is, 0 = none."""
    table = np.zeros((model.ngeom, model.ngeom, 2), dtype=np.int32)
    for p, pair in enumerate(pairs):
        for a in geoms_of(model, *pair.first):
            for b in geoms_of(model, *pair.second):
                if a == b:
                    continue
                for i, j, s in ((a, b, p + 1), (b, a, -(p + 1))):
                    free = np.flatnonzero(table[i, j] == 0)
                    if abs(s) in np.abs(table[i, j]):
                        continue
                    if len(free) == 0:
                        free, table = np.array([table.shape[2]]), np.pad(table, ((0, 0), (0, 0), (0, 1)))
                    table[i, j, free[0]] = s
    return table


@wp.struct
class Contacts:
    """MuJoCo-Warp's contact list and the forces of its constraints."""

    nacon: wp.array(dtype=int)
    geom: wp.array(dtype=wp.vec2i)
    worldid: wp.array(dtype=int)
    frame: wp.array(dtype=wp.mat33)
    dim: wp.array(dtype=int)
    friction: wp.array(dtype=vec5)
    efc_address: wp.array2d(dtype=int)
    efc_force: wp.array2d(dtype=float)
    njmax: int
    pyramidal: int


@wp.kernel(enable_backward=False)
def add_contacts(
    x: Contacts,
    table: wp.array3d(dtype=int),
    # out
    normal_sum: wp.array2d(dtype=int),
    force_sum: wp.array3d(dtype=int),
):
    c = wp.tid()
    if c >= x.nacon[0]:
        return
    adr = x.efc_address[c, 0]
    g = x.geom[c]
    if adr < 0 or g[0] < 0 or g[1] < 0:
        return
    w = x.worldid[c]
    f = wp.vec3(0.0, 0.0, 0.0)
    if x.pyramidal == 1 and x.dim[c] > 1:
        # rows are the edges n +- mu_i t_i of the pyramid, two a direction
        for i in range(x.dim[c] - 1):
            if adr + 2 * i + 1 < x.njmax:
                plus, minus = x.efc_force[w, adr + 2 * i], x.efc_force[w, adr + 2 * i + 1]
                f[0] += plus + minus
                if i < 2:
                    f[i + 1] = (plus - minus) * x.friction[c][i]
    else:
        for i in range(wp.min(x.dim[c], 3)):
            a = x.efc_address[c, i]
            if a >= 0 and a < x.njmax:
                f[i] = x.efc_force[w, a]
    # the frame's first row is the normal, from geom[0] to geom[1]; f acts on geom[1]
    world = wp.transpose(x.frame[c]) * f
    for k in range(table.shape[2]):
        p = table[g[0], g[1], k]
        if p != 0:
            sign = -1.0  # first member is geom[0]: it gets the reaction
            if p < 0:
                sign = 1.0
            col = wp.abs(p) - 1
            wp.atomic_add(normal_sum, w, col, int(wp.round(f[0] * 65536.0)))
            for i in range(3):
                wp.atomic_add(force_sum, w, col, i, int(wp.round(sign * world[i] * 65536.0)))


@wp.kernel(enable_backward=False)
def read_sums(
    normal_sum: wp.array2d(dtype=int),
    force_sum: wp.array3d(dtype=int),
    # out
    normal: wp.array2d(dtype=float),
    force: wp.array2d(dtype=wp.vec3),
):
    w, p = wp.tid()
    s = 1.0 / 65536.0
    normal[w, p] = float(normal_sum[w, p]) * s
    force[w, p] = wp.vec3(float(force_sum[w, p, 0]) * s, float(force_sum[w, p, 1]) * s, float(force_sum[w, p, 2]) * s)
    # ready for the next control step
    normal_sum[w, p] = 0
    for i in range(3):
        force_sum[w, p, i] = 0


@wp.kernel(enable_backward=False)
def check_worlds(
    qpos: wp.array2d(dtype=float),
    qvel: wp.array2d(dtype=float),
    solver_overflow: wp.array(dtype=int),
    nacon: wp.array(dtype=int),
    nefc: wp.array(dtype=int),
    nan_bit: int,
    # out
    flags: wp.array(dtype=int),
    overflow: wp.array(dtype=int),
    peak: wp.array(dtype=int),
):
    w = wp.tid()
    bad = int(0)
    for i in range(qpos.shape[1]):
        if not wp.isfinite(qpos[w, i]):
            bad = 1
    for i in range(qvel.shape[1]):
        # 1e4 rad/s or m/s is far beyond anything a hand does: the solver has diverged
        if not wp.isfinite(qvel[w, i]) or wp.abs(qvel[w, i]) > 1.0e4:
            bad = 1
    f = solver_overflow[w]
    if bad == 1:
        f = nan_bit  # what a world that is not finite lost does not matter: it begins anew
    overflow[w] = overflow[w] | (f & ~nan_bit)
    flags[w] = f
    solver_overflow[w] = 0
    if w == 0:
        wp.atomic_max(peak, 0, nacon[0])
    wp.atomic_max(peak, 1, nefc[w])


@wp.kernel(enable_backward=False)
def outside_torque(
    smooth: wp.array2d(dtype=float),
    applied: wp.array2d(dtype=float),
    damper: wp.array2d(dtype=float),
    constraint: wp.array2d(dtype=float),
    row: wp.array2d(dtype=int),
    force: wp.array2d(dtype=float),
    # out
    outside: wp.array2d(dtype=float),
):
    """Compute what `Engine.keep_outside` says; row: the constraint that is a dof's dry friction, -1: none; force: of
    all constraints."""
    w, i = wp.tid()
    load = smooth[w, i] - applied[w, i] - damper[w, i] + constraint[w, i]
    if row[w, i] >= 0:
        load -= force[w, row[w, i]]
    outside[w, i] = load
