"""The touch kernel: transform, distance, force and reduction of all taxels in one launch.

Two variants share every line of the law (`taxel_force`, `spread_weight`, `distance`): `serial`, one thread per (world,
pad), for the CPU and for pads of more than 1024 taxels; `block`, one thread per taxel and one block per (world, pad),
for CUDA. Both reduce in the frame of the pad's body and transform once.
"""

from __future__ import annotations

from functools import cache

import warp as wp

from dexsim.tactile.sdf import Shapes, bound_radius, distance, in_grid, near_grid

LINEAR = 0
HERTZ = 1
MOONEY_RIVLIN = 2
LAWS = {"linear": LINEAR, "hertz": HERTZ, "mooney_rivlin": MOONEY_RIVLIN}
MAX_STRAIN = 0.8
"""Compression at which the rubber model saturates (stress grows without bound as it goes to 1)."""


@wp.struct
class Pads:
    """A layout on the device: F pads of up to T taxels."""

    body: wp.array(dtype=int)  # [F]
    count: wp.array(dtype=int)  # [F]
    taxel: wp.array2d(dtype=wp.vec4)  # [F, T] point [m] in the body frame, and area [m^2]: one 16-byte load
    centre: wp.array(dtype=wp.vec3)  # [F] pad centre, body frame
    bound: wp.array(dtype=wp.vec4)  # [F] bounding sphere: centre, radius


@wp.struct
class Law:
    """Constants of the force law, the same in all worlds."""

    kind: int
    stiffness: wp.array(dtype=float)  # [F] linear: N/m^3; hertz: N/m^2.5; mooney_rivlin: factor
    thickness: float  # m, of the rubber
    c10: float  # Pa
    c01: float  # Pa
    reach: float  # m, see spread_weight


@wp.func
def taxel_force(law: Law, stiffness: float, depth: float, area: float, threshold: float):
    """Normal force [N] of a taxel pressed in by `depth` > 0 [m].

    Linear: stiffness * area * depth, an elastic foundation (paper, "Tactile Sensor Simulation": f = k d, weighted by
    the area a taxel stands for); its sum grows with about the square of the depth. Hertz: stiffness * area *
    sqrt(depth): the pressure under a smooth body on an elastic solid is proportional to the root of the rigid overlap
    (Hertz), and the sum grows with its power 1.5. Mooney-Rivlin: uniaxial compression of the rubber, stretch
    l = 1 - depth / thickness, pressure 2 (l^-2 - l) (c10 + c01 / l), times `stiffness`. At or under `threshold` [N] the
    taxel is silent.
    """
    f = float(0.0)
    if law.kind == wp.static(LINEAR):
        f = stiffness * area * depth
    elif law.kind == wp.static(HERTZ):
        f = stiffness * area * wp.sqrt(depth)
    else:
        l = 1.0 - wp.min(depth / law.thickness, wp.static(MAX_STRAIN))
        f = stiffness * area * 2.0 * (1.0 / (l * l) - l) * (law.c10 + law.c01 / l)
    if f <= threshold:
        f = 0.0
    return f


@wp.func
def spread_level(nearest: float, reach: float):
    """Distance under which taxels share the solver's force, given the nearest taxel's distance [m]."""
    return wp.max(nearest + reach, 0.0)


@wp.func
def spread_weight(d: float, area: float, level: float):
    """A taxel's share of the solver's force, up to a factor: area times the square of the depth under the level.

    Deeper than `reach` the level is 0, the object's surface. A shallower contact, or one that falls between the taxels,
    is shared by those within `reach` of the nearest one, as a skin with thickness does. Continuous in the distances,
    and the nearest taxel always has a positive share: no force is lost. The square, which fades out smoothly at the
    edge of the patch, lowers the lattice's error in the centre of a flat contact against the depth itself (measured).
    """
    depth = wp.max(level - d, 0.0)
    return area * depth * depth


@wp.func
def pose_in(xpos: wp.array2d(dtype=wp.vec3), xmat: wp.array2d(dtype=wp.mat33), w: int, body: int, frame: int):
    """Position of a body's origin in another body's frame."""
    return wp.transpose(xmat[w, frame]) * (xpos[w, body] - xpos[w, frame])


@wp.func
def turn_in(xmat: wp.array2d(dtype=wp.mat33), w: int, body: int, frame: int):
    return wp.transpose(xmat[w, frame]) * xmat[w, body]


@wp.func
def into(xpos: wp.array2d(dtype=wp.vec3), xmat: wp.array2d(dtype=wp.mat33), w: int, body: int, frame: int, p: wp.vec3):
    """A point of a body in another body's frame: for one point cheaper than composing the two poses."""
    return wp.transpose(xmat[w, frame]) * (xmat[w, body] * p + (xpos[w, body] - xpos[w, frame]))


@wp.func
def may_touch(shapes: Shapes, shape: int, size: wp.vec3, middle: wp.vec3, radius: float):
    """Whether a pad inside a sphere can reach the shape: first by bounding spheres, then by the distance itself."""
    near = wp.length(middle) < radius + bound_radius(shapes, shape, size)
    if near:
        # 1 mm covers the interpolation error of coarse grids
        near = distance(shapes, shape, size, middle) < radius + 1.0e-3
    return near


@wp.func
def xyz(v: wp.vec4):
    return wp.vec3(v[0], v[1], v[2])


@cache
def touch_kernel(block: bool, solver: bool, raw: bool, others: bool) -> wp.Kernel:
    """The kernel for one choice of options; dimensions: [N, F] threads (serial) or tiles (block).

    solver: spread the solver's normal forces; else the plain spring sum. raw: write every taxel's force. others: feel
    other pads' tips as well.
    """
    def serial(
        xpos: wp.array2d(dtype=wp.vec3),
        xmat: wp.array2d(dtype=wp.mat33),
        pair_normal: wp.array2d(dtype=float),
        pads: Pads,
        law: Law,
        shapes: Shapes,
        object_body: wp.array(dtype=int),
        shape_id: wp.array2d(dtype=int),
        shape_size: wp.array2d(dtype=wp.vec3),
        pair_column: wp.array2d(dtype=int),
        tips: Shapes,
        tip_column: wp.array2d(dtype=int),
        feel_others: int,
        stiffness: wp.array(dtype=float),
        threshold: wp.array(dtype=float),
        scratch: wp.array3d(dtype=float),
        # out
        force: wp.array2d(dtype=float),
        centre: wp.array2d(dtype=wp.vec3),
        force_other: wp.array2d(dtype=float),
        felt: wp.array3d(dtype=float),
    ):
        w, f = wp.tid()
        body = pads.body[f]
        n = pads.count[f]
        bound = pads.bound[f]
        k = stiffness[w] * law.stiffness[f]
        total = wp.vec4(0.0, 0.0, 0.0, 0.0)  # moment of force, force
        if wp.static(raw):
            for t in range(felt.shape[2]):
                felt[w, f, t] = 0.0
        for o in range(object_body.shape[0]):
            shape = shape_id[w, o]
            size = shape_size[w, o]
            pressed = float(0.0)
            if wp.static(solver):
                pressed = pair_normal[w, pair_column[f, o]]
            if shape >= 0 and (pressed > 0.0 or not wp.static(solver)):
                a = turn_in(xmat, w, body, object_body[o])
                b = pose_in(xpos, xmat, w, body, object_body[o])
                if wp.static(solver):
                    nearest = float(1.0e9)
                    for t in range(n):
                        d = distance(shapes, shape, size, a * xyz(pads.taxel[f, t]) + b)
                        scratch[w, f, t] = d
                        nearest = wp.min(nearest, d)
                    level = spread_level(nearest, law.reach)
                    s = wp.vec4(0.0, 0.0, 0.0, 0.0)
                    for t in range(n):
                        p = pads.taxel[f, t]
                        c = spread_weight(scratch[w, f, t], p[3], level)
                        s += wp.vec4(c * p[0], c * p[1], c * p[2], c)
                    c = pressed / s[3]
                    total += wp.vec4(c * s[0], c * s[1], c * s[2], pressed)
                    if wp.static(raw):
                        for t in range(n):
                            share = spread_weight(scratch[w, f, t], pads.taxel[f, t][3], level)
                            felt[w, f, t] = felt[w, f, t] + c * share
                else:
                    if may_touch(shapes, shape, size, a * xyz(bound) + b, bound[3]):
                        for t in range(n):
                            p = pads.taxel[f, t]
                            d = distance(shapes, shape, size, a * xyz(p) + b)
                            if d < 0.0:
                                c = taxel_force(law, k, -d, p[3], threshold[w])
                                total += wp.vec4(c * p[0], c * p[1], c * p[2], c)
                                if wp.static(raw):
                                    felt[w, f, t] = felt[w, f, t] + c
        at = pads.centre[f]
        if total[3] > 0.0:
            at = xyz(total) / total[3]
        force[w, f] = total[3]
        centre[w, f] = xmat[w, body] * at + xpos[w, body]
        if wp.static(others):
            other = float(0.0)
            for g in range(pads.body.shape[0]):
                near = g != f
                if near and tip_column[f, g] >= 0:
                    near = pair_normal[w, tip_column[f, g]] > 0.0
                if near:
                    near = near_grid(tips, g, into(xpos, xmat, w, body, pads.body[g], xyz(bound)), bound[3])
                if near:
                    a = turn_in(xmat, w, body, pads.body[g])
                    b = pose_in(xpos, xmat, w, body, pads.body[g])
                    for t in range(n):
                        p = pads.taxel[f, t]
                        q = a * xyz(p) + b
                        if in_grid(tips, g, q):
                            d = distance(tips, g, wp.vec3(1.0, 1.0, 1.0), q)
                            if d < 0.0:
                                c = taxel_force(law, k, -d, p[3], threshold[w])
                                other += c
                                if wp.static(raw):
                                    if feel_others != 0:
                                        felt[w, f, t] = felt[w, f, t] + c
            force_other[w, f] = other

    def tiled(
        xpos: wp.array2d(dtype=wp.vec3),
        xmat: wp.array2d(dtype=wp.mat33),
        pair_normal: wp.array2d(dtype=float),
        pads: Pads,
        law: Law,
        shapes: Shapes,
        object_body: wp.array(dtype=int),
        shape_id: wp.array2d(dtype=int),
        shape_size: wp.array2d(dtype=wp.vec3),
        pair_column: wp.array2d(dtype=int),
        tips: Shapes,
        tip_column: wp.array2d(dtype=int),
        feel_others: int,
        stiffness: wp.array(dtype=float),
        threshold: wp.array(dtype=float),
        scratch: wp.array3d(dtype=float),
        # out
        force: wp.array2d(dtype=float),
        centre: wp.array2d(dtype=wp.vec3),
        force_other: wp.array2d(dtype=float),
        felt: wp.array3d(dtype=float),
    ):
        # Every branch around a tile operation is the same for the whole block.
        w, f, t = wp.tid()
        body = pads.body[f]
        live = t < pads.count[f]
        p = wp.vec4(0.0, 0.0, 0.0, 0.0)
        if live:
            p = pads.taxel[f, t]
        bound = pads.bound[f]
        k = stiffness[w] * law.stiffness[f]
        total = wp.vec4(0.0, 0.0, 0.0, 0.0)  # moment of force, force; the same in all lanes
        mine = float(0.0)  # this taxel's force
        for o in range(object_body.shape[0]):
            shape = shape_id[w, o]
            size = shape_size[w, o]
            pressed = float(0.0)
            if wp.static(solver):
                pressed = pair_normal[w, pair_column[f, o]]
            if shape >= 0 and (pressed > 0.0 or not wp.static(solver)):
                q = into(xpos, xmat, w, body, object_body[o], xyz(p))
                if wp.static(solver):
                    d = float(1.0e9)
                    if live:
                        d = distance(shapes, shape, size, q)
                    nearest = wp.tile_min(wp.tile(d))
                    c = spread_weight(d, p[3], spread_level(nearest[0], law.reach))
                    sums = wp.tile_sum(wp.tile(wp.vec4(c * p[0], c * p[1], c * p[2], c), preserve_type=True))
                    s = sums[0]
                    scale = pressed / s[3]
                    total += wp.vec4(scale * s[0], scale * s[1], scale * s[2], pressed)
                    mine += scale * c
                else:
                    if may_touch(shapes, shape, size, into(xpos, xmat, w, body, object_body[o], xyz(bound)), bound[3]):
                        c = float(0.0)
                        if live:
                            d = distance(shapes, shape, size, q)
                            if d < 0.0:
                                c = taxel_force(law, k, -d, p[3], threshold[w])
                        sums = wp.tile_sum(wp.tile(wp.vec4(c * p[0], c * p[1], c * p[2], c), preserve_type=True))
                        total += sums[0]
                        mine += c
        if t == 0:
            at = pads.centre[f]
            if total[3] > 0.0:
                at = xyz(total) / total[3]
            force[w, f] = total[3]
            centre[w, f] = xmat[w, body] * at + xpos[w, body]
        if wp.static(others):
            other = float(0.0)
            touched = int(0)
            for g in range(pads.body.shape[0]):
                near = g != f
                if near and tip_column[f, g] >= 0:
                    near = pair_normal[w, tip_column[f, g]] > 0.0
                if near:
                    near = near_grid(tips, g, into(xpos, xmat, w, body, pads.body[g], xyz(bound)), bound[3])
                if near:
                    touched = 1
                    q = into(xpos, xmat, w, body, pads.body[g], xyz(p))
                    if live and in_grid(tips, g, q):
                        d = distance(tips, g, wp.vec3(1.0, 1.0, 1.0), q)
                        if d < 0.0:
                            other += taxel_force(law, k, -d, p[3], threshold[w])
            if feel_others != 0:
                mine += other
            if touched != 0:
                both = wp.tile_sum(wp.tile(other))
                other = both[0]
            if t == 0:
                force_other[w, f] = other
        if wp.static(raw):
            if t < felt.shape[2]:
                felt[w, f, t] = mine

    return wp.kernel(tiled if block else serial, enable_backward=False, module="unique")
