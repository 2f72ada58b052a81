"""`Objects.write` as one Warp kernel: an object's row of the table, scaled, into the fields of its world."""

# No `from __future__ import annotations`: Warp resolves these annotations from the closure.

from functools import cache
from typing import Any

import warp as wp

BOX, SPHERE, CAPSULE, HULL = 0, 1, 2, 3
"""Kinds of the table's rows. The first three scale freely, each with a geom of its own in the scene, in this order."""


@wp.struct
class Table:
    """The nominal objects, V rows, S geoms each (`sim.scene.Scene`); lengths at the row's baked scale [m]."""

    kind: wp.array(dtype=int)  # [V]
    base_size: wp.array(dtype=wp.vec3)  # [V] MuJoCo's sizes of a primitive
    scale: wp.array(dtype=float)  # [V] of a hull
    extent: wp.array(dtype=float)  # [V] largest, of a hull
    bound: wp.array(dtype=float)  # [V] radius of a hull about the body's origin
    unit_inertia: wp.array(dtype=wp.vec3)  # [V] of a hull, per kg [m^2]
    dataid: wp.array2d(dtype=int)  # [V, S]
    pos: wp.array3d(dtype=float)  # [V, S, 3]
    quat: wp.array3d(dtype=float)  # [V, S, 4]
    size: wp.array3d(dtype=float)  # [V, S, 3]
    rbound: wp.array3d(dtype=float)  # [V, S, 1]
    aabb: wp.array3d(dtype=float)  # [V, S, 6]
    slots: wp.array(dtype=int)  # [S] geoms of the object
    tips: wp.array(dtype=int)  # [T] geoms of the fingertips
    tip_bodies: wp.array(dtype=int)  # [T]
    hand_geoms: wp.array(dtype=int)  # [G] all geoms of the hand
    friction_factor: wp.array(dtype=float)  # [G] of each over the world's friction


@wp.struct
class Drawn:
    """What is written, by world; see `Objects.write`."""

    mask: wp.array(dtype=wp.bool)
    variant: wp.array(dtype=wp.int64)
    scale: wp.array2d(dtype=float)  # [N, 3]
    mass: wp.array(dtype=float)
    com: wp.array2d(dtype=float)  # [N, 3]
    friction: wp.array(dtype=float)
    stiffness: wp.array(dtype=float)
    damping_ratio: wp.array(dtype=float)


@wp.struct
class Known:
    """What is remembered of it, by world: the attributes of `Objects`."""

    variant: wp.array(dtype=wp.int64)
    size: wp.array2d(dtype=float)
    mass: wp.array(dtype=float)
    com: wp.array2d(dtype=float)
    friction: wp.array(dtype=float)
    stiffness: wp.array(dtype=float)
    damping_ratio: wp.array(dtype=float)
    radius: wp.array(dtype=float)


@wp.func
def primitive_inertia(kind: int, size: wp.vec3):
    """Return the principal inertia per kg [m^2] of a box, sphere or capsule with MuJoCo's sizes; see
    `assets.objects.shape.primitive_mass_properties` for the formulas."""
    a = size[0]
    b = size[1]
    c = size[2]
    if kind == wp.static(BOX):
        return wp.vec3((b * b + c * c) / 3.0, (a * a + c * c) / 3.0, (a * a + b * b) / 3.0)
    if kind == wp.static(SPHERE):
        s = 0.4 * a * a
        return wp.vec3(s, s, s)
    tube = wp.static(2.0 * wp.PI) * a * a * b
    ball = wp.static(4.0 / 3.0 * wp.PI) * a * a * a
    volume = wp.max(tube + ball, 1.0e-12)
    across = (tube * (a * a / 4.0 + b * b / 3.0) + ball * (0.4 * a * a + b * b + 0.75 * a * b)) / volume
    along = (tube * a * a / 2.0 + ball * 0.4 * a * a) / volume
    return wp.vec3(across, across, along)


@wp.func
def half_extents(kind: int, size: wp.vec3):
    """Return half the edges of a primitive's bounding box [m]."""
    r = size[0]
    if kind == wp.static(SPHERE):
        return wp.vec3(r, r, r)
    if kind == wp.static(CAPSULE):
        return wp.vec3(r, r, r + size[1])
    return size


@cache
def fields(real: type) -> Any:
    @wp.struct
    class Fields:
        """The engine's model fields by world: [N, geoms or bodies, numbers]."""

        geom_dataid: wp.array2d(dtype=int)
        geom_pos: wp.array3d(dtype=real)
        geom_quat: wp.array3d(dtype=real)
        geom_size: wp.array3d(dtype=real)
        geom_rbound: wp.array3d(dtype=real)
        geom_aabb: wp.array3d(dtype=real)
        geom_friction: wp.array3d(dtype=real)
        geom_solref: wp.array3d(dtype=real)
        body_mass: wp.array3d(dtype=real)
        body_subtreemass: wp.array3d(dtype=real)
        body_inertia: wp.array3d(dtype=real)
        body_ipos: wp.array3d(dtype=real)
        body_iquat: wp.array3d(dtype=real)
        body_invweight0: wp.array3d(dtype=real)

    return Fields


@cache
def write_kernel(real: type) -> wp.Kernel:
    Fields = fields(real)

    @wp.func
    def write_geom(v: int, s: int, kind: int, size: wp.vec3, half: wp.vec3, bound: float, w: int, t: Table, f: Fields):
        """Write one of the object's geoms: as the table has it, or the primitive in use."""
        g = t.slots[s]
        f.geom_dataid[w, g] = t.dataid[v, s]
        for c in range(4):
            f.geom_quat[w, g, c] = real(t.quat[v, s, c])
        own = s == kind and kind != wp.static(HULL)
        for c in range(3):
            f.geom_pos[w, g, c] = real(t.pos[v, s, c])
            if own:
                f.geom_size[w, g, c] = real(size[c])
                f.geom_aabb[w, g, c] = real(0.0)
                f.geom_aabb[w, g, c + 3] = real(half[c])
            else:
                f.geom_size[w, g, c] = real(t.size[v, s, c])
                f.geom_aabb[w, g, c] = real(t.aabb[v, s, c])
                f.geom_aabb[w, g, c + 3] = real(t.aabb[v, s, c + 3])
        f.geom_rbound[w, g, 0] = real(t.rbound[v, s, 0])
        if own:
            f.geom_rbound[w, g, 0] = real(bound)

    @wp.func
    def write_body(body: int, mass: float, inertia: wp.vec3, com: wp.vec3, w: int, f: Fields):
        """Write mass and inertia, and what MuJoCo derives from them: of a free body in closed form (mj_setConst gives
        the same; tested), translational inverse weight 1 / m, rotational the mean inverse inertia."""
        f.body_mass[w, body, 0] = real(mass)
        f.body_subtreemass[w, body, 0] = real(mass)
        # the world's trees: the hand (body 1) and the object
        f.body_subtreemass[w, 0, 0] = f.body_subtreemass[w, 1, 0] + real(mass)
        for c in range(3):
            f.body_inertia[w, body, c] = real(inertia[c])
            f.body_ipos[w, body, c] = real(com[c])
        for c in range(4):
            f.body_iquat[w, body, c] = real(0.0)
        f.body_iquat[w, body, 0] = real(1.0)
        f.body_invweight0[w, body, 0] = real(1.0 / mass)
        f.body_invweight0[w, body, 1] = real((1.0 / inertia[0] + 1.0 / inertia[1] + 1.0 / inertia[2]) / 3.0)

    @wp.kernel(module="unique", enable_backward=False)
    def write(body: int, impedance: float, drawn: Drawn, t: Table, known: Known, f: Fields):
        w, k = wp.tid()
        if not drawn.mask[w]:
            return
        v = int(drawn.variant[w])
        kind = t.kind[v]
        mass = drawn.mass[w]
        size = wp.cw_mul(t.base_size[v], wp.vec3(drawn.scale[w, 0], drawn.scale[w, 1], drawn.scale[w, 2]))
        half = half_extents(kind, size)
        bound = t.bound[v]
        if kind == wp.static(BOX):
            bound = wp.length(size)
        elif kind == wp.static(SPHERE):
            bound = size[0]
        elif kind == wp.static(CAPSULE):
            bound = size[0] + size[1]

        if k < t.slots.shape[0]:
            write_geom(v, k, kind, size, half, bound, w, t, f)
        if k < t.hand_geoms.shape[0]:
            f.geom_friction[w, t.hand_geoms[k], 0] = real(drawn.friction[w] * t.friction_factor[k])
        # Stiffness on the tips. MuJoCo's contact reference acts on acceleration. With constant impedance d a contact at
        # rest at depth r carries f = -solref[0] r / ((1 - d) A), A = body_invweight0 of the two bodies, so solref =
        # (-K (1 - d) A, -b) makes it K r, whatever the mass; b = 2 zeta sqrt(K (1 - d) A) damps the contact at the
        # ratio zeta (semi-implicitly, at the effective mass that A describes). Restitution has no coefficient in
        # MuJoCo: this damping stands for it.
        if k < t.tips.shape[0]:
            a = float(f.body_invweight0[w, t.tip_bodies[k], 0]) + 1.0 / mass
            stiff = drawn.stiffness[w] * (1.0 - impedance) * a
            f.geom_solref[w, t.tips[k], 0] = real(-stiff)
            f.geom_solref[w, t.tips[k], 1] = real(-2.0 * drawn.damping_ratio[w] * wp.sqrt(stiff))
        if k > 0:
            return

        extent = t.extent[v]
        inertia = t.unit_inertia[v]
        if kind != wp.static(HULL):
            extent = 2.0 * wp.max(half)
            inertia = primitive_inertia(kind, size)
        com = wp.vec3(drawn.com[w, 0], drawn.com[w, 1], drawn.com[w, 2]) * extent
        write_body(body, mass, inertia * mass, com, w, f)
        if kind == wp.static(HULL):
            size = wp.vec3(t.scale[v], 0.0, 0.0)
        known.variant[w] = drawn.variant[w]
        known.mass[w] = mass
        known.friction[w] = drawn.friction[w]
        known.stiffness[w] = drawn.stiffness[w]
        known.damping_ratio[w] = drawn.damping_ratio[w]
        known.radius[w] = bound
        for c in range(3):
            known.size[w, c] = size[c]
            known.com[w, c] = com[c]

    return write
