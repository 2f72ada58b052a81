"""The touch kernel: transform, distance, force and reduction of all taxels in one launch.

Two variants share every line of the law (`taxel_force`, `spread_weight`, the distances): `serial`, one thread per
(world, pad), for the CPU and for pads of more than 512 taxels; `lanes`, one warp per (world, pad), for CUDA: each lane
keeps every 32nd taxel in registers, sums are shuffles, and there is no barrier and no shared memory. Both compose the
two poses once a pad and reduce in the frame of the pad's body.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import warp as wp

from dexsim.tactile.lanes import LANES, lane_ballot, lanes_min, lanes_sum, lanes_sum4, lowest_bit
from dexsim.tactile.sdf import (
    BOX,
    CAPSULE,
    CYLINDER,
    SPHERE,
    Shapes,
    bound_radius,
    boxes_apart,
    distance,
    in_box,
    load4,
    sd_box,
    sd_capsule,
    sd_cells,
    sd_cylinder,
    sd_grid,
    sd_sphere,
)

MAX_ROUNDS = 16
"""Taxels a lane may keep, in steps of 32 lanes."""
LINEAR = 0
HERTZ = 1
MOONEY_RIVLIN = 2
LAWS = {"linear": LINEAR, "hertz": HERTZ, "mooney_rivlin": MOONEY_RIVLIN}
MAX_STRAIN = 0.8
"""Compression at which the rubber model saturates (stress grows without bound as it goes to 1)."""
FAR = wp.constant(1.0e9)  # m


@wp.struct
class Pads:
    """A layout on the device: F pads of up to T taxels, in rows of W (T made a multiple of 32)."""

    body: wp.array(dtype=int)  # [F]
    count: wp.array(dtype=int)  # [F]
    # [F, W] point [m] in the body frame, and area [m^2]: one 16-byte load. Behind a pad's last taxel stand copies of
    # its first one with no area: they feel nothing and are never the only nearest.
    taxel: wp.array2d(dtype=wp.vec4)
    centre: wp.array(dtype=wp.vec3)  # [F] pad centre, body frame
    bound: wp.array(dtype=wp.vec4)  # [F] bounding sphere: centre, radius
    middle: wp.array(dtype=wp.vec3)  # [F] bounding box, body frame
    half: wp.array(dtype=wp.vec3)  # [F]


@wp.struct
class Law:
    """Constants of the force law."""

    stiffness: wp.array(dtype=float)  # [F] linear: N/m^3; hertz: N/m^2.5; mooney_rivlin: factor
    scale: wp.array(dtype=float)  # [N] of the stiffness
    threshold: wp.array(dtype=float)  # [N] N, at or under which a taxel is silent
    thickness: float  # m, of the rubber
    c10: float  # Pa
    c01: float  # Pa
    reach: float  # m, see spread_weight


@wp.struct
class Surroundings:
    """What F pads may touch in N worlds of O objects and B bodies, and how the physics has them press it: C pairs."""

    xpos: wp.array2d(dtype=wp.vec3)  # [N, B] m
    xmat: wp.array2d(dtype=wp.mat33)  # [N, B]
    pair_normal: wp.array2d(dtype=float)  # [N, C] N, the solver's; [1, 1] where nothing asks for it
    object_body: wp.array(dtype=int)  # [O]
    shape_id: wp.array2d(dtype=int)  # [N, O] -1: no object
    shape_size: wp.array2d(dtype=wp.vec3)  # [N, O] m, of grids the scale first
    pair_column: wp.array2d(dtype=int)  # [F, O] the pair of a pad and an object
    link_body: wp.array(dtype=int)  # [L] bodies of the hand whose surfaces pads may touch
    tip_column: wp.array2d(dtype=int)  # [F, L] the pair of a pad and such a body; -1: not declared
    self_column: wp.array(dtype=int)  # [F] the pair of a pad's body and the rest of the hand


@wp.struct
class Felt:
    """What pads feel (out)."""

    force: wp.array2d(dtype=float)  # [N, F] N
    centre: wp.array2d(dtype=wp.vec3)  # [N, F] m, world frame
    force_other: wp.array2d(dtype=float)  # [N, F] N, of the rest of the hand
    felt: wp.array3d(dtype=float)  # [N, F, T] N, where every taxel's force is asked for
    distance: wp.array3d(dtype=float)  # [N, F, T] m: scratch, where the solver's force is spread


@wp.struct
class FlatFelt:
    """The same without axes: a warp a pad finds its place by one number, and keeps its distances."""

    force: wp.array(dtype=float)
    centre: wp.array(dtype=wp.vec3)
    force_other: wp.array(dtype=float)
    felt: wp.array(dtype=float)


@wp.func
def taxel_force(kind: int, law: Law, stiffness: float, depth: float, area: float, threshold: float):
    """Normal force [N] of a taxel pressed in by `depth` > 0 [m].

    Linear: stiffness * area * depth, an elastic foundation (paper, "Tactile Sensor Simulation": f = k d, weighted by
    the area a taxel stands for); its sum grows with about the square of the depth. Hertz: stiffness * area *
    sqrt(depth): the pressure under a smooth body on an elastic solid is proportional to the root of the rigid overlap
    (Hertz), and the sum grows with its power 1.5. Mooney-Rivlin: uniaxial compression of the rubber, stretch
    l = 1 - depth / thickness, pressure 2 (l^-2 - l) (c10 + c01 / l), times `stiffness`. At or under `threshold` [N] the
    taxel is silent.
    """
    f = float(0.0)
    if kind == wp.static(LINEAR):
        f = stiffness * area * depth
    elif kind == wp.static(HERTZ):
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


@wp.func
def centre_of(pads: Pads, f: int, total: wp.vec4):
    """Centre of pressure of pad f, body frame, of the sums (moment of force, force); the pad's centre where nothing
    presses."""
    at = pads.centre[f]
    if total[3] > 0.0:
        at = xyz(total) / total[3]
    return at


@wp.func
def may_meet(f: int, g: int, here: Surroundings, pads: Pads, w: int):
    """Whether pad f may touch link g: another body, and pressed where the physics says so."""
    near = here.link_body[g] != pads.body[f]
    if near and here.tip_column[f, g] >= 0:
        near = here.pair_normal[w, here.tip_column[f, g]] > 0.0
    return near


@wp.func
def tips_apart(pads: Pads, tips: Shapes, f: int, g: int, a: wp.mat33, b: wp.vec3):
    """Whether pad f, whose body has rotation a and origin b in that of link g, surely does not touch it."""
    return boxes_apart(a, b, pads.middle[f], pads.half[f], tips.middle[g], tips.half[g])


@wp.func
def from_link(here: Surroundings, tips: Shapes, w: int, body: int, point: wp.vec3, g: int):
    """Return the signed distance [m] of a point of a body, in the world, to link g; far where that is the body."""
    out = float(FAR)
    if g < here.link_body.shape[0]:
        other = here.link_body[g]
        if other != body:
            out = sd_grid(tips, g, 1.0, wp.transpose(here.xmat[w, other]) * (point - here.xpos[w, other]))
    return out


@wp.func
def links_near(here: Surroundings, tips: Shapes, w: int, body: int, ball: wp.vec4, lane: int):
    """Return bits of the links (of the first 64) that may be the nearest to a point of a ball, in the world, and a
    distance [m] that no point of it is below: along a way, distances change by no more than its length."""
    low = int(0)
    high = int(0)
    least = float(FAR)
    for g in range(here.link_body.shape[0]):
        least = wp.min(least, from_link(here, tips, w, body, xyz(ball), g))
    for g in range(wp.min(here.link_body.shape[0], 64)):
        if from_link(here, tips, w, body, xyz(ball), g) <= least + 2.0 * ball[3]:
            low = low | wp.where(g < 32, 1 << (g & 31), 0)
            high = high | wp.where(g < 32, 0, 1 << (g & 31))
    return wp.vec2i(low, high), least - ball[3]


@wp.func
def links_near_lanes(here: Surroundings, tips: Shapes, w: int, body: int, ball: wp.vec4, lane: int):
    """Return the same, a link a lane."""
    a = from_link(here, tips, w, body, xyz(ball), lane)
    b = from_link(here, tips, w, body, xyz(ball), lane + 32)
    least = lanes_min(wp.min(a, b))
    far = least + 2.0 * ball[3]
    return wp.vec2i(lane_ballot(a <= far), lane_ballot(b <= far)), least - ball[3]


@wp.func
def nearest_link(here: Surroundings, tips: Shapes, w: int, body: int, near: wp.vec2i, point: wp.vec3):
    """Return the signed distance [m] of a point of a body, in the world, to the nearest of the hand's other links
    `near`."""
    out = float(FAR)
    for g in range(here.link_body.shape[0]):
        bits = wp.where(g < 32, near[0], near[1])
        if g >= 64 or ((bits >> (g & 31)) & 1) != 0:
            out = wp.min(out, from_link(here, tips, w, body, point, g))
    return out


@wp.func
def ball_of(here: Surroundings, pads: Pads, w: int, f: int):
    """Return the ball of pad f's taxels in the world: centre, and radius with a millimetre for coarse grids [m]."""
    body = pads.body[f]
    c = here.xmat[w, body] * xyz(pads.bound[f]) + here.xpos[w, body]
    return wp.vec4(c[0], c[1], c[2], pads.bound[f][3] + 1.0e-3)


@wp.func
def beside_object(
    here: Surroundings, pads: Pads, shapes: Shapes, shape: int, size: wp.vec3, a: wp.mat33, b: wp.vec3, f: int, o: int,
    first: int, step: int, level: float,
):  # fmt: skip
    """Return the least distance [m] and the sum of weights under `level` of every step-th taxel, from `first`, of the
    other pads that share pad f's pair with object o."""
    nearest = float(1.0e9)
    weight = float(0.0)
    for g in range(pads.body.shape[0]):
        if g != f and here.pair_column[g, o] == here.pair_column[f, o]:
            t = int(first)
            while t < pads.count[g]:
                d = distance(shapes, shape, size, a * xyz(pads.taxel[g, t]) + b)
                nearest = wp.min(nearest, d)
                weight += spread_weight(d, pads.taxel[g, t][3], level)
                t += step
    return wp.vec2(nearest, weight)


@cache
def _beside_links(lanes: bool) -> Callable:
    look = links_near_lanes if lanes else links_near

    @wp.func
    def beside_links(here: Surroundings, pads: Pads, tips: Shapes, w: int, f: int, lane: int, level: float):
        """Return the same for the rest of the hand, of the other pads on pad f's body. Pads that are no nearer than
        `level` are passed over."""
        nearest = float(FAR)
        weight = float(0.0)
        body = pads.body[f]
        for g in range(pads.body.shape[0]):
            if g != f and pads.body[g] == body:
                near, least = look(here, tips, w, body, ball_of(here, pads, w, g), lane)
                t = int(lane)
                while least < level and t < pads.count[g]:
                    point = here.xmat[w, body] * xyz(pads.taxel[g, t]) + here.xpos[w, body]
                    d = nearest_link(here, tips, w, body, near, point)
                    nearest = wp.min(nearest, d)
                    weight += spread_weight(d, pads.taxel[g, t][3], level)
                    t += wp.static(LANES if lanes else 1)
        return wp.vec2(nearest, weight)

    return beside_links


@cache
def touch_kernel(
    lanes: bool,
    solver: bool,
    raw: bool,
    others: bool,
    *,
    law: str = "hertz",
    pads: int = 5,
    taxels: int = 120,
    objects: int = 1,
    feel_others: bool = False,
    links: int = 5,
    selves: bool = False,
    shared: bool = False,
    registers: int = 0,
) -> wp.Kernel:
    """Return the kernel for one choice of options; dimensions: [N, F] threads (serial) or N * F * 32 (lanes).

    solver: spread the solver's normal forces; else the plain spring sum. raw: write every taxel's force. others: feel
    the hand's own links as well; feel_others: and write them into the taxels' forces; selves: their force too is the
    solver's, spread. pads, taxels, objects, links: the layout's sizes F and T, the objects in each world, and links L.
    shared: pads on one body share its force. registers: CUDA, at most so many a thread (0: as the compiler likes).
    """
    rounds = -(-taxels // LANES)
    make = _lanes if lanes else _serial
    kernel = make(
        solver, raw, others, LAWS[law], pads, taxels, objects, feel_others, links, selves, shared, rounds
    )
    # Approximate roots and reciprocals are wrong in the last bits only: 1e-7 of a distance
    return wp.kernel(
        kernel,
        enable_backward=False,
        module="unique",
        grid_stride=False,
        cuda_max_registers=registers or None,
        module_options={"fast_math": lanes},
    )


def _serial(
    solver: bool, raw: bool, others: bool, kind: int, pad_count: int, taxels: int, objects: int, feel_others: bool,
    links: int, selves: bool, shared: bool, rounds: int,
) -> Callable:  # fmt: skip
    beside_links = _beside_links(False)

    def serial(here: Surroundings, pads: Pads, law: Law, shapes: Shapes, tips: Shapes, out: Felt):
        w, f = wp.tid()
        body = pads.body[f]
        n = pads.count[f]
        bound = pads.bound[f]
        k = law.scale[w] * law.stiffness[f]
        total = wp.vec4(0.0, 0.0, 0.0, 0.0)  # moment of force, force
        if wp.static(raw):
            for t in range(out.felt.shape[2]):
                out.felt[w, f, t] = 0.0
        for o in range(here.object_body.shape[0]):
            shape = here.shape_id[w, o]
            size = here.shape_size[w, o]
            pressed = float(0.0)
            if wp.static(solver):
                pressed = here.pair_normal[w, here.pair_column[f, o]]
            if shape >= 0 and (pressed > 0.0 or not wp.static(solver)):
                a = turn_in(here.xmat, w, body, here.object_body[o])
                b = pose_in(here.xpos, here.xmat, w, body, here.object_body[o])
                if wp.static(solver):
                    nearest = float(1.0e9)
                    for t in range(n):
                        d = distance(shapes, shape, size, a * xyz(pads.taxel[f, t]) + b)
                        out.distance[w, f, t] = d
                        nearest = wp.min(nearest, d)
                    if wp.static(shared):
                        beside = beside_object(here, pads, shapes, shape, size, a, b, f, o, 0, 1, 0.0)
                        nearest = wp.min(nearest, beside[0])
                    level = spread_level(nearest, law.reach)
                    s = wp.vec4(0.0, 0.0, 0.0, 0.0)
                    for t in range(n):
                        p = pads.taxel[f, t]
                        c = spread_weight(out.distance[w, f, t], p[3], level)
                        s += wp.vec4(c * p[0], c * p[1], c * p[2], c)
                    whole = s[3]
                    if wp.static(shared):
                        whole += beside_object(here, pads, shapes, shape, size, a, b, f, o, 0, 1, level)[1]
                        pressed = pressed * s[3] / whole
                    c = here.pair_normal[w, here.pair_column[f, o]] / whole
                    total += wp.vec4(c * s[0], c * s[1], c * s[2], pressed)
                    if wp.static(raw):
                        for t in range(n):
                            share = spread_weight(out.distance[w, f, t], pads.taxel[f, t][3], level)
                            out.felt[w, f, t] = out.felt[w, f, t] + c * share
                else:
                    if may_touch(shapes, shape, size, a * xyz(bound) + b, bound[3]):
                        for t in range(n):
                            p = pads.taxel[f, t]
                            d = distance(shapes, shape, size, a * xyz(p) + b)
                            if d < 0.0:
                                c = taxel_force(wp.static(kind), law, k, -d, p[3], law.threshold[w])
                                total += wp.vec4(c * p[0], c * p[1], c * p[2], c)
                                if wp.static(raw):
                                    out.felt[w, f, t] = out.felt[w, f, t] + c
        out.force[w, f] = total[3]
        out.centre[w, f] = here.xmat[w, body] * centre_of(pads, f, total) + here.xpos[w, body]
        if wp.static(others and selves):
            other = here.pair_normal[w, here.self_column[f]]
            if other > 0.0:
                nearest = float(1.0e9)
                near, _ = links_near(here, tips, w, body, ball_of(here, pads, w, f), 0)
                for t in range(n):
                    point = here.xmat[w, body] * xyz(pads.taxel[f, t]) + here.xpos[w, body]
                    d = nearest_link(here, tips, w, body, near, point)
                    out.distance[w, f, t] = d
                    nearest = wp.min(nearest, d)
                if wp.static(shared):
                    nearest = wp.min(nearest, beside_links(here, pads, tips, w, f, 0, nearest)[0])
                level = spread_level(nearest, law.reach)
                own = float(0.0)
                for t in range(n):
                    own += spread_weight(out.distance[w, f, t], pads.taxel[f, t][3], level)
                whole = own
                if wp.static(shared):
                    whole += beside_links(here, pads, tips, w, f, 0, level)[1]
                c = other / whole
                if wp.static(raw and feel_others):
                    for t in range(n):
                        share = spread_weight(out.distance[w, f, t], pads.taxel[f, t][3], level)
                        out.felt[w, f, t] = out.felt[w, f, t] + c * share
                if wp.static(shared):
                    other = c * own
            out.force_other[w, f] = other
        elif wp.static(others):
            other = float(0.0)
            for g in range(here.link_body.shape[0]):
                if may_meet(f, g, here, pads, w):
                    a = turn_in(here.xmat, w, body, here.link_body[g])
                    b = pose_in(here.xpos, here.xmat, w, body, here.link_body[g])
                    if not tips_apart(pads, tips, f, g, a, b):
                        for t in range(n):
                            p = pads.taxel[f, t]
                            q = a * xyz(p) + b
                            if in_box(q, tips.middle[g], tips.half[g]):
                                d = sd_grid(tips, g, 1.0, q)
                                if d < 0.0:
                                    c = taxel_force(wp.static(kind), law, k, -d, p[3], law.threshold[w])
                                    other += c
                                    if wp.static(raw and feel_others):
                                        out.felt[w, f, t] = out.felt[w, f, t] + c
            out.force_other[w, f] = other

    return serial


def _lanes(
    solver: bool, raw: bool, others: bool, kind: int, pad_count: int, taxels: int, objects: int, feel_others: bool,
    links: int, selves: bool, shared: bool, rounds: int,
) -> Callable:  # fmt: skip
    Reals = wp.types.vector(length=rounds, dtype=float)
    width = rounds * LANES
    beside_links = _beside_links(True)

    @wp.func
    def distances(s: Shapes, i: int, size: wp.vec3, a: wp.mat33, b: wp.vec3, px: Reals, py: Reals, pz: Reals):
        # The kind is asked once for all, so that a lane's loads are all under way before the first is used.
        kind = s.kind[i]
        d = Reals()
        if kind == wp.static(BOX):
            for r in range(wp.static(rounds)):
                d[r] = sd_box(a * wp.vec3(px[r], py[r], pz[r]) + b, size)
        elif kind == wp.static(SPHERE):
            for r in range(wp.static(rounds)):
                d[r] = sd_sphere(a * wp.vec3(px[r], py[r], pz[r]) + b, size[0])
        elif kind == wp.static(CAPSULE):
            for r in range(wp.static(rounds)):
                d[r] = sd_capsule(a * wp.vec3(px[r], py[r], pz[r]) + b, size[0], size[1])
        elif kind == wp.static(CYLINDER):
            for r in range(wp.static(rounds)):
                d[r] = sd_cylinder(a * wp.vec3(px[r], py[r], pz[r]) + b, size[0], size[1])
        else:
            offset = s.offset[i]
            n = s.dims[i]
            origin = s.origin[i]
            h = s.spacing[i]
            for r in range(wp.static(rounds)):
                d[r] = sd_cells(s.data, offset, n, origin, h, size[0], a * wp.vec3(px[r], py[r], pz[r]) + b)
        return d

    def lanes(here: Surroundings, pads: Pads, law: Law, shapes: Shapes, tips: Shapes, out: FlatFelt):
        # Every branch around an exchange of lanes is the same for the whole warp.
        i = wp.tid()
        lane = i & 31
        pad = i >> 5
        w = pad // wp.static(pad_count)
        f = pad - w * wp.static(pad_count)
        body = pads.body[f]
        rot = here.xmat[w, body]
        pos = here.xpos[w, body]
        px = Reals()
        py = Reals()
        pz = Reals()
        area = Reals()
        wanted = bool(wp.static(not solver or (others and not selves)))
        if wp.static(solver):  # a pad that nothing presses asks for none of its taxels
            for o in range(wp.static(objects)):
                wanted = wanted or here.pair_normal[w, here.pair_column[f, o]] > 0.0
            if wp.static(others and selves):
                wanted = wanted or here.pair_normal[w, here.self_column[f]] > 0.0
        if wanted:
            for r in range(wp.static(rounds)):
                v = load4(pads.taxel, f * wp.static(width) + 32 * r + lane)
                px[r] = v[0]
                py[r] = v[1]
                pz[r] = v[2]
                area[r] = v[3]
        total = wp.vec4(0.0, 0.0, 0.0, 0.0)  # moment of force, force; the same in all lanes
        mine = Reals()  # forces of this lane's taxels
        for o in range(wp.static(objects)):
            shape = here.shape_id[w, o]
            size = here.shape_size[w, o]
            turn = wp.transpose(here.xmat[w, here.object_body[o]])
            a = turn * rot
            b = turn * (pos - here.xpos[w, here.object_body[o]])
            if wp.static(solver):
                pressed = here.pair_normal[w, here.pair_column[f, o]]
                if shape >= 0 and pressed > 0.0:
                    d = distances(shapes, shape, size, a, b, px, py, pz)
                    nearest = d[0]
                    for r in range(1, wp.static(rounds)):
                        nearest = wp.min(nearest, d[r])
                    if wp.static(shared):
                        beside = beside_object(here, pads, shapes, shape, size, a, b, f, o, lane, 32, 0.0)
                        nearest = wp.min(nearest, beside[0])
                    level = spread_level(lanes_min(nearest), law.reach)
                    s = wp.vec4(0.0, 0.0, 0.0, 0.0)
                    for r in range(wp.static(rounds)):
                        c = spread_weight(d[r], area[r], level)
                        s += wp.vec4(c * px[r], c * py[r], c * pz[r], c)
                        d[r] = c
                    s = lanes_sum4(s, lane)
                    whole = s[3]
                    scale = pressed / whole
                    if wp.static(shared):
                        beside = beside_object(here, pads, shapes, shape, size, a, b, f, o, lane, 32, level)
                        whole += lanes_sum(beside[1])
                        scale = pressed / whole
                        pressed = scale * s[3]
                    total += wp.vec4(scale * s[0], scale * s[1], scale * s[2], pressed)
                    mine += scale * d
            else:
                if shape >= 0:
                    bound = pads.bound[f]
                    if may_touch(shapes, shape, size, a * xyz(bound) + b, bound[3]):
                        k = law.scale[w] * law.stiffness[f]
                        quiet = law.threshold[w]
                        d = distances(shapes, shape, size, a, b, px, py, pz)
                        s = wp.vec4(0.0, 0.0, 0.0, 0.0)
                        for r in range(wp.static(rounds)):
                            c = float(0.0)
                            if d[r] < 0.0:
                                c = taxel_force(wp.static(kind), law, k, -d[r], area[r], quiet)
                            s += wp.vec4(c * px[r], c * py[r], c * pz[r], c)
                            d[r] = c
                        total += lanes_sum4(s, lane)
                        mine += d
        if lane == 0:
            out.force[pad] = total[3]
            out.centre[pad] = rot * centre_of(pads, f, total) + pos
        if wp.static(others and selves):
            other = here.pair_normal[w, here.self_column[f]]
            if other > 0.0:
                d = Reals()
                near, _ = links_near_lanes(here, tips, w, body, ball_of(here, pads, w, f), lane)
                for r in range(wp.static(rounds)):
                    d[r] = FAR
                    if wp.static(32) * r < pads.count[f]:
                        d[r] = nearest_link(here, tips, w, body, near, rot * wp.vec3(px[r], py[r], pz[r]) + pos)
                nearest = d[0]
                for r in range(1, wp.static(rounds)):
                    nearest = wp.min(nearest, d[r])
                if wp.static(shared):
                    nearest = wp.min(nearest, beside_links(here, pads, tips, w, f, lane, nearest)[0])
                level = spread_level(lanes_min(nearest), law.reach)
                own = float(0.0)
                for r in range(wp.static(rounds)):
                    d[r] = spread_weight(d[r], area[r], level)
                    own += d[r]
                own = lanes_sum(own)
                whole = own
                if wp.static(shared):
                    whole += lanes_sum(beside_links(here, pads, tips, w, f, lane, level)[1])
                if wp.static(raw and feel_others):
                    mine += other / whole * d
                if wp.static(shared):
                    other = other / whole * own
            if lane == 0:
                out.force_other[pad] = other
        elif wp.static(others):
            # Lane j asks whether link j is near, all at once; then the warp feels the links that are.
            other = float(0.0)
            for block in range(wp.static(-(-links // LANES))):
                j = wp.static(32) * block + lane
                near = j < wp.static(links)
                if near:
                    near = may_meet(f, j, here, pads, w)
                if near:
                    turn = wp.transpose(here.xmat[w, here.link_body[j]])
                    near = not tips_apart(pads, tips, f, j, turn * rot, turn * (pos - here.xpos[w, here.link_body[j]]))
                left = lane_ballot(near)
                while left != 0:
                    g = 32 * block + lowest_bit(left)
                    left = left & (left - 1)
                    turn = wp.transpose(here.xmat[w, here.link_body[g]])
                    a = turn * rot
                    b = turn * (pos - here.xpos[w, here.link_body[g]])
                    middle = tips.middle[g]
                    half = tips.half[g]
                    offset = tips.offset[g]
                    n = tips.dims[g]
                    origin = tips.origin[g]
                    h = tips.spacing[g]
                    k = law.scale[w] * law.stiffness[f]
                    quiet = law.threshold[w]
                    for r in range(wp.static(rounds)):
                        q = a * wp.vec3(px[r], py[r], pz[r]) + b
                        if in_box(q, middle, half):
                            gap = sd_cells(tips.data, offset, n, origin, h, 1.0, q)
                            if gap < 0.0:
                                c = taxel_force(wp.static(kind), law, k, -gap, area[r], quiet)
                                other += c
                                if wp.static(raw and feel_others):
                                    mine[r] += c
            other = lanes_sum(other)
            if lane == 0:
                out.force_other[pad] = other
        if wp.static(raw):
            for r in range(wp.static(rounds)):
                t = 32 * r + lane
                if t < wp.static(taxels):
                    out.felt[pad * wp.static(taxels) + t] = mine[r]

    return lanes
