"""The touch kernel: transform, distance, force and reduction of all taxels in one launch.

Pads that share one force form a group, and each taxel's distance is measured once. Two variants share every line of
the law (`taxel_force`, `spread_weight`, grids' distances): `serial`, one thread per (world, group), for the CPU; for
CUDA 16 lanes measure a group in a world, two side by side in a warp: a lane keeps the distances of every 16th taxel in
registers, sums are shuffles, and there is no barrier and no shared memory. Other warps of the same launch feel what the
hand touches of itself, as few groups do at a time. Both compose the two poses once a group and reduce in the frame of
its body.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from math import gcd
from typing import Any

import warp as wp

from dexsim.tactile.lanes import LANES, lane_ballot, lane_xor, lanes_min, lanes_sum, lanes_sum4, lowest_bit
from dexsim.tactile.sdf import (
    BOX,
    CYLINDER,
    GRID,
    SPHERE,
    Shapes,
    bound_radius,
    boxes_gap,
    distance,
    in_box,
    load4,
    sd_cells,
    sd_grid,
)

WIDTH = 16
"""Lanes that measure a group of pads in a world: a warp does 32 / WIDTH of them side by side."""
HAND_WIDTH = 8
"""Lanes that ask whether a group of pads in a world touches the hand itself, which a warp then measures."""
MAX_UNROLL = 16
"""Rounds of taxels, one a lane, whose distances are kept in registers; more go through a thread's memory."""
REGISTERS = 64
"""Most registers of a thread on CUDA: 1 to 2 % faster on an H200 than 80, so than as many as the compiler likes."""
CHUNK = 4
"""Rounds of taxels that are measured at a time: all their loads are under way before the first is used."""
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


@wp.struct
class Unit:
    """What `WIDTH` lanes measure of a world: a group, or half of its pads."""

    group: int
    round: int  # its first round, and how many
    rounds: int
    pad: int  # the first of its pads in `Groups.pads`, and how many
    pads: int
    half: int  # 1: the other half of the group is with the other lanes of the warp
    ends: int  # bit k, of its first 31 rounds: a pad ends with round k


@wp.struct
class Groups:
    """Pads of one body that the same forces press, as one: G groups of up to R rounds of 32 taxels, a round of one
    pad."""

    body: wp.array(dtype=int)  # [G]
    pads: wp.array(dtype=int)  # [F] pads, group by group
    first: wp.array(dtype=int)  # [G + 1] where each group begins in `pads`
    rounds: wp.array(dtype=int)  # [G]
    unit: wp.array(dtype=Unit)  # [U]
    round: wp.array2d(dtype=wp.vec3i)  # [G, R] its pad, the number of its first taxel there, 1: the pad's last round
    # [G + 1, 32 R] as in `Pads`; copies of the first without area where no taxel is
    taxel: wp.array2d(dtype=wp.vec4)
    bound: wp.array(dtype=wp.vec4)  # [G] bounding sphere: centre, radius
    middle: wp.array(dtype=wp.vec3)  # [G] bounding box, body frame
    half: wp.array(dtype=wp.vec3)  # [G]


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
    """What G groups of pads may touch in N worlds of O objects and B bodies, and how the physics has them press it: C
    pairs."""

    xpos: wp.array2d(dtype=wp.vec3)  # [N, B] m
    xmat: wp.array2d(dtype=wp.mat33)  # [N, B]
    pair_normal: wp.array2d(dtype=float)  # [N, C] N, the solver's; [1, 1] where nothing asks for it
    object_body: wp.array(dtype=int)  # [O]
    shape_id: wp.array2d(dtype=int)  # [N, O] -1: no object
    shape_size: wp.array2d(dtype=wp.vec3)  # [N, O] m, of grids the scale first
    pair_column: wp.array2d(dtype=int)  # [G, O] the pair of a group and an object
    link_body: wp.array(dtype=int)  # [L] bodies of the hand whose surfaces pads may touch
    self_column: wp.array(dtype=int)  # [G] the pair of a group's body and the rest of the hand


@wp.struct
class Felt:
    """What pads feel (out)."""

    force: wp.array2d(dtype=float)  # [N, F] N
    centre: wp.array2d(dtype=wp.vec3)  # [N, F] m, world frame
    force_other: wp.array2d(dtype=float)  # [N, F] N, of the rest of the hand
    readings: wp.array3d(dtype=float)  # [N, F, T] N, where every taxel's force is asked for
    distance: wp.array3d(dtype=float)  # [N, F, T] m: scratch, where the solver's force is spread


@wp.struct
class FlatFelt:
    """The same without axes: a warp finds a pad by one number, and keeps its distances."""

    force: wp.array(dtype=float)
    centre: wp.array(dtype=wp.vec3)
    force_other: wp.array(dtype=float)
    readings: wp.array(dtype=float)


@wp.func
def taxel_force(kind: int, law: Law, stiffness: float, depth: float, area: float, threshold: float):
    """Return the normal force [N] of a taxel pressed in by `depth` > 0 [m].

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
    """Return the distance [m] under which taxels share the solver's force, given the nearest taxel's distance [m]."""
    return wp.max(nearest + reach, 0.0)


@wp.func
def spread_weight(d: float, area: float, level: float):
    """Return a taxel's share of the solver's force, up to a factor: area times the square of the depth under the level.

    Deeper than `reach` the level is 0, the object's surface. A shallower contact, or one that falls between the taxels,
    is shared by those within `reach` of the nearest one, as a skin with thickness does. Continuous in the distances,
    and the nearest taxel always has a positive share: no force is lost. The square, which fades out smoothly at the
    edge of the patch, lowers the lattice's error in the centre of a flat contact against the depth itself (measured).
    """
    depth = wp.max(level - d, 0.0)
    return area * depth * depth


@wp.func_native("return x.data[i];")
def mat_at(x: wp.array2d(dtype=wp.mat33), i: int) -> wp.mat33:
    """Return element i of a contiguous array: half the instructions of an index a dimension."""
    ...


@wp.func_native("return x.data[i];")
def vec_at(x: wp.array2d(dtype=wp.vec3), i: int) -> wp.vec3: ...


@wp.func_native("return x.data[i];")
def float_at(x: wp.array2d(dtype=float), i: int) -> float: ...


@wp.func_native("return x.data[i];")
def int_at(x: wp.array2d(dtype=int), i: int) -> int: ...


@wp.func
def pose_in(xpos: wp.array2d(dtype=wp.vec3), xmat: wp.array2d(dtype=wp.mat33), w: int, body: int, frame: int):
    """Return the position [m] of a body's origin in another body's frame."""
    at = w * xpos.shape[1]
    return wp.transpose(mat_at(xmat, at + frame)) * (vec_at(xpos, at + body) - vec_at(xpos, at + frame))


@wp.func
def turn_in(xmat: wp.array2d(dtype=wp.mat33), w: int, body: int, frame: int):
    at = w * xmat.shape[1]
    return wp.transpose(mat_at(xmat, at + frame)) * mat_at(xmat, at + body)


@wp.func
def may_touch(shapes: Shapes, shape: int, size: wp.vec3, middle: wp.vec3, radius: float):
    """Return whether a pad in a sphere can reach the shape: first by bounding spheres, then by the distance itself."""
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
    """Return the centre of pressure of pad f [m, body frame], of its sums (moment of force, force); the pad's centre
    where nothing presses."""
    at = pads.centre[f]
    if total[3] > 0.0:
        at = xyz(total) / total[3]
    return at


@wp.func
def link_gap(here: Surroundings, groups: Groups, tips: Shapes, w: int, g: int, j: int):
    """Return a distance [m] below which no taxel of group g is to link j; far where that is the group's own body. A
    millimetre is for coarse grids."""
    out = float(FAR)
    if here.link_body[j] != groups.body[g]:
        a = turn_in(here.xmat, w, groups.body[g], here.link_body[j])
        b = pose_in(here.xpos, here.xmat, w, groups.body[g], here.link_body[j])
        out = boxes_gap(a, b, groups.middle[g], groups.half[g], tips.middle[j], tips.half[j]) - 1.0e-3
    return out


@cache
def touch_kernel(
    lanes: bool, solver: bool, raw: bool, others: bool, *, law: str = "hertz", pads: int = 5, groups: int = 5,
    taxels: int = 120, rounds: int = 4, objects: int = 1, feel_others: bool = False, links: int = 5,
    selves: bool = False, most: int = 1, units: int = 5, unit_rounds: int = 4,
) -> wp.Kernel:  # fmt: skip
    """Return the kernel for one choice of options. Dimensions: serial [N, G]; lanes: see `spans`.

    solver: spread the solver's normal forces; else the plain spring sum. raw: write every taxel's force. others: feel
    the hand's own links as well; feel_others: and write them into the taxels' forces; selves: their force too is the
    solver's, spread. pads, groups, taxels, rounds, most: the layout's sizes F, G, T and R (a multiple of `CHUNK`, or
    less than it), and the most pads of a group. units, unit_rounds: U, and the most rounds of one. objects: in each
    world. links: L.
    """
    kind = LAWS[law]
    if not lanes:
        kernel = _serial(solver, raw, others, kind, feel_others, selves)
    else:
        of_object = _of_object(solver, raw, kind, pads, taxels, rounds, most, units, unit_rounds, objects)
        of_hand = _of_hand(raw, kind, pads, groups, taxels, rounds, most, feel_others, links, selves)

        def kernel(
            here: Surroundings, pads: Pads, groups: Groups, law: Law, shapes: Shapes, tips: Shapes, out: FlatFelt,
            begin: int, hand: int,
        ):  # fmt: skip
            i = wp.tid() + begin
            if i >= hand:
                of_object(here, pads, groups, law, shapes, out, i - hand)
            elif wp.static(others):
                of_hand(here, groups, law, tips, out, i, hand // LANES)

    # Approximate roots and reciprocals are wrong in the last bits only: 1e-7 of a distance
    options = {"fast_math": lanes, "max_unroll": MAX_UNROLL if rounds <= MAX_UNROLL else CHUNK}
    return wp.kernel(
        kernel, enable_backward=False, module="unique", grid_stride=False, cuda_max_registers=REGISTERS,
        module_options=options,
    )  # fmt: skip


def spans(worlds: int, groups: int, units: int, others: bool, raw: bool) -> tuple[int, list[tuple[int, int]]]:
    """Return the threads that feel the hand itself, and the spans of threads (first, count) to be launched in turn with
    lanes: at once, the hand's first, as they wait longest; in two launches where both write the same readings."""
    hand = LANES * -(-worlds * groups * HAND_WIDTH // LANES) if others else 0
    of_object = LANES * -(-worlds * units * WIDTH // LANES)
    return hand, [(hand, of_object), (0, hand)] if raw and others else [(0, hand + of_object)]


@wp.func
def weight_of(pads: Pads, groups: Groups, distance: wp.array3d(dtype=float), w: int, g: int, level: float):
    """Return the sum of a group's weights."""
    whole = float(0.0)
    for i in range(groups.first[g], groups.first[g + 1]):
        f = groups.pads[i]
        for t in range(pads.count[f]):
            whole += spread_weight(distance[w, f, t], pads.taxel[f, t][3], level)
    return whole


def _serial(solver: bool, raw: bool, others: bool, kind: int, feel_others: bool, selves: bool) -> Callable:
    def serial(here: Surroundings, pads: Pads, groups: Groups, law: Law, shapes: Shapes, tips: Shapes, out: Felt):
        w, g = wp.tid()
        body = groups.body[g]
        bound = groups.bound[g]
        first = groups.first[g]
        end = groups.first[g + 1]
        for i in range(first, end):
            f = groups.pads[i]
            out.force[w, f] = 0.0
            out.centre[w, f] = wp.vec3(0.0, 0.0, 0.0)  # moment of force, body frame
            if wp.static(others):
                out.force_other[w, f] = 0.0
            if wp.static(raw):
                for t in range(out.readings.shape[2]):
                    out.readings[w, f, t] = 0.0
        for o in range(here.object_body.shape[0]):
            shape = here.shape_id[w, o]
            size = here.shape_size[w, o]
            pressed = float(1.0)
            if wp.static(solver):
                pressed = here.pair_normal[w, here.pair_column[g, o]]
            if shape >= 0 and pressed > 0.0:
                a = turn_in(here.xmat, w, body, here.object_body[o])
                b = pose_in(here.xpos, here.xmat, w, body, here.object_body[o])
                level = float(0.0)
                scale = float(1.0)
                share = float(1.0)
                near = bool(True)
                if wp.static(solver):
                    nearest = float(FAR)
                    for i in range(first, end):
                        f = groups.pads[i]
                        for t in range(pads.count[f]):
                            d = distance(shapes, shape, size, a * xyz(pads.taxel[f, t]) + b)
                            out.distance[w, f, t] = d
                            nearest = wp.min(nearest, d)
                    level = spread_level(nearest, law.reach)
                    share = weight_of(pads, groups, out.distance, w, g, level)
                    scale = pressed / share
                else:
                    near = may_touch(shapes, shape, size, a * xyz(bound) + b, bound[3])
                if near:
                    for i in range(first, end):
                        f = groups.pads[i]
                        stiff = law.scale[w] * law.stiffness[f]
                        s = wp.vec4(0.0, 0.0, 0.0, 0.0)
                        for t in range(pads.count[f]):
                            p = pads.taxel[f, t]
                            c = float(0.0)
                            if wp.static(solver):
                                c = spread_weight(out.distance[w, f, t], p[3], level)
                            else:
                                d = distance(shapes, shape, size, a * xyz(p) + b)
                                if d < 0.0:
                                    c = taxel_force(wp.static(kind), law, stiff, -d, p[3], law.threshold[w])
                            s += wp.vec4(c * p[0], c * p[1], c * p[2], c)
                            if wp.static(raw):
                                out.readings[w, f, t] = out.readings[w, f, t] + scale * c
                        out.force[w, f] = out.force[w, f] + pressed * (s[3] / share)  # of a pad alone, all of it
                        out.centre[w, f] = out.centre[w, f] + scale * xyz(s)
        for i in range(first, end):
            f = groups.pads[i]
            moment = out.centre[w, f]
            at = centre_of(pads, f, wp.vec4(moment[0], moment[1], moment[2], out.force[w, f]))
            out.centre[w, f] = here.xmat[w, body] * at + here.xpos[w, body]
        if wp.static(others and selves):
            other = here.pair_normal[w, here.self_column[g]]
            if other > 0.0:
                for i in range(first, end):
                    f = groups.pads[i]
                    for t in range(pads.count[f]):
                        out.distance[w, f, t] = FAR
                best = int(0)
                least = float(FAR)
                for j in range(here.link_body.shape[0]):
                    gap = link_gap(here, groups, tips, w, g, j)
                    if gap < least:
                        least = gap
                        best = j
                # the nearest link first: where it is says how near others must be to matter
                nearest = float(FAR)
                for k in range(here.link_body.shape[0] + 1):
                    j = wp.where(k == 0, best, k - 1)
                    gap = link_gap(here, groups, tips, w, g, j)
                    if (k == 0 or j != best) and gap < spread_level(nearest, law.reach):
                        a = turn_in(here.xmat, w, body, here.link_body[j])
                        b = pose_in(here.xpos, here.xmat, w, body, here.link_body[j])
                        for i in range(first, end):
                            f = groups.pads[i]
                            for t in range(pads.count[f]):
                                d = wp.min(out.distance[w, f, t], sd_grid(tips, j, 1.0, a * xyz(pads.taxel[f, t]) + b))
                                out.distance[w, f, t] = d
                                nearest = wp.min(nearest, d)
                level = spread_level(nearest, law.reach)
                scale = other / weight_of(pads, groups, out.distance, w, g, level)
                for i in range(first, end):
                    f = groups.pads[i]
                    for t in range(pads.count[f]):
                        c = scale * spread_weight(out.distance[w, f, t], pads.taxel[f, t][3], level)
                        out.force_other[w, f] = out.force_other[w, f] + c
                        if wp.static(raw and feel_others):
                            out.readings[w, f, t] = out.readings[w, f, t] + c
        elif wp.static(others):
            for j in range(here.link_body.shape[0]):
                if link_gap(here, groups, tips, w, g, j) < 0.0:
                    a = turn_in(here.xmat, w, body, here.link_body[j])
                    b = pose_in(here.xpos, here.xmat, w, body, here.link_body[j])
                    for i in range(first, end):
                        f = groups.pads[i]
                        stiff = law.scale[w] * law.stiffness[f]
                        for t in range(pads.count[f]):
                            p = pads.taxel[f, t]
                            q = a * xyz(p) + b
                            if in_box(q, tips.middle[j], tips.half[j]):
                                d = sd_grid(tips, j, 1.0, q)
                                if d < 0.0:
                                    c = taxel_force(wp.static(kind), law, stiff, -d, p[3], law.threshold[w])
                                    out.force_other[w, f] = out.force_other[w, f] + c
                                    if wp.static(raw and feel_others):
                                        out.readings[w, f, t] = out.readings[w, f, t] + c

    return serial


def _of_object(
    solver: bool, raw: bool, kind: int, pad_count: int, taxels: int, rounds: int, most: int, units: int,
    unit_rounds: int, objects: int,
) -> Callable:  # fmt: skip
    """Return a function of `WIDTH` lanes that measures a unit in a world."""
    split = LANES // WIDTH
    all_rounds = unit_rounds * split
    slots, chunk = -(-most // WIDTH), all_rounds if all_rounds < CHUNK else gcd(CHUNK, all_rounds)
    Reals = wp.types.vector(length=all_rounds, dtype=float)
    Totals = wp.types.matrix(shape=(slots, 4), dtype=float)

    @wp.func
    def distances(s: Shapes, i: int, size: wp.vec3, a: wp.mat33, b: wp.vec3, groups: Groups, n: int, at: int):
        """Return distances of this lane's taxels to a shape, in n rounds from flat index `at` on; FAR behind them. All
        primitives are one formula: a box, or a body of revolution, minus a radius; no branch, a third of the code."""
        d = Reals(FAR)
        if s.kind[i] == wp.static(GRID):
            offset = s.offset[i]
            dims = s.dims[i]
            origin = s.origin[i]
            h = s.spacing[i]
            for c in range(wp.static(all_rounds // chunk)):
                if wp.static(chunk) * c < n:
                    for k in range(wp.static(chunk)):
                        r = wp.static(chunk) * c + k
                        q = a * xyz(load4(groups.taxel, at + wp.static(WIDTH) * r)) + b
                        d[r] = sd_cells(s.data, offset, dims, origin, h, size[0], q)
        else:
            kind = s.kind[i]
            box = kind == wp.static(BOX)
            wide = wp.where(kind == wp.static(CYLINDER), size[0], 0.0)
            round = wp.where(box or kind == wp.static(CYLINDER), 0.0, size[0])
            tall = wp.where(box, size[2], wp.where(kind == wp.static(SPHERE), 0.0, size[1]))
            for c in range(wp.static(all_rounds // chunk)):
                if wp.static(chunk) * c < n:
                    for k in range(wp.static(chunk)):
                        r = wp.static(chunk) * c + k
                        q = a * xyz(load4(groups.taxel, at + wp.static(WIDTH) * r)) + b
                        x = wp.where(box, wp.abs(q[0]) - size[0], wp.sqrt(q[0] * q[0] + q[1] * q[1]) - wide)
                        y = wp.where(box, wp.abs(q[1]) - size[1], -FAR)
                        z = wp.abs(q[2]) - tall
                        most = wp.max(x, wp.max(y, z))
                        out = wp.vec3(wp.max(x, 0.0), wp.max(y, 0.0), wp.max(z, 0.0))
                        d[r] = wp.length(out) + wp.min(most, 0.0) - round
        return d

    @wp.func
    def of_object(here: Surroundings, pads: Pads, groups: Groups, law: Law, shapes: Shapes, out: FlatFelt, i: int):
        # Every branch around an exchange of lanes is the same for the whole warp.
        lane = i & wp.static(WIDTH - 1)
        item = i // wp.static(WIDTH)
        w = item // wp.static(units)
        unit = groups.unit[item - w * wp.static(units)]
        g = unit.group
        inside = w < here.shape_id.shape[0]
        w = wp.where(inside, w, 0)
        body = groups.body[g]
        bodies = here.xpos.shape[1]
        rot = mat_at(here.xmat, w * bodies + body)
        pos = vec_at(here.xpos, w * bodies + body)
        at = (g * wp.static(rounds) + unit.round) * wp.static(LANES) + lane
        mine = Reals()  # N, on this lane's taxels
        totals = Totals()  # moment of force, force: of the pads that this lane reports
        for o in range(wp.static(objects)):
            # all that is loaded here is under way while the lanes ask
            shape = int_at(here.shape_id, w * wp.static(objects) + o)
            size = vec_at(here.shape_size, w * wp.static(objects) + o)
            place = w * bodies + here.object_body[o]
            turn = wp.transpose(mat_at(here.xmat, place))
            a = turn * rot
            b = turn * (pos - vec_at(here.xpos, place))
            near = inside and shape >= 0
            force = float(1.0)
            if wp.static(solver):
                column = int_at(here.pair_column, g * wp.static(objects) + o)
                force = float_at(here.pair_normal, w * here.pair_normal.shape[1] + column)
                near = near and force > 0.0
            elif near:
                near = may_touch(shapes, shape, size, a * xyz(groups.bound[g]) + b, groups.bound[g][3])
            if lane_ballot(near) != 0:
                shape = wp.max(shape, 0)
                n = wp.where(near, unit.rounds * wp.static(split), 0)
                d = distances(shapes, shape, size, a, b, groups, n, at)
                level = float(0.0)
                if wp.static(solver):
                    least = lanes_min(wp.min(d), wp.static(WIDTH))
                    other = lane_xor(least, wp.static(WIDTH % LANES))
                    if unit.half != 0:
                        least = wp.min(least, other)
                    level = spread_level(least, law.reach)
                whole = float(0.0)
                found = Totals()
                s = wp.vec4(0.0, 0.0, 0.0, 0.0)
                k = int(0)
                for r in range(wp.static(all_rounds)):
                    c = float(0.0)
                    p = load4(groups.taxel, at + wp.static(WIDTH) * r)
                    if wp.static(solver):
                        c = spread_weight(d[r], p[3], level)
                        if wp.static(most > 1):
                            c = wp.where(r < n, c, 0.0)  # behind them stands the other half
                    else:
                        if d[r] < level and (wp.static(most == 1) or r < n):
                            stiff = law.scale[w] * law.stiffness[groups.round[g, unit.round + r // wp.static(split)][0]]
                            c = taxel_force(wp.static(kind), law, stiff, -d[r], p[3], law.threshold[w])
                    s += wp.vec4(c * p[0], c * p[1], c * p[2], c)
                    whole += c
                    d[r] = c
                    if (r + 1) % wp.static(split) == 0:
                        last = r + 1 == wp.static(all_rounds)
                        if not wp.static(most == 1):
                            bits = unit.ends >> (r // wp.static(split))
                            if wp.static(unit_rounds > 31):
                                bits = groups.round[g, unit.round + r // wp.static(split)][2]
                            last = r < n and (bits & 1) != 0
                        if lane_ballot(last and s[3] > 0.0) != 0:
                            total = lanes_sum4(s, i & 31, wp.static(WIDTH))
                            for q in range(wp.static(slots)):
                                if last and k == wp.static(WIDTH) * q + lane:
                                    found[q] = total
                        if last:
                            k += 1
                            s = wp.vec4(0.0, 0.0, 0.0, 0.0)
                scale = float(1.0)
                if wp.static(solver):
                    scale = 0.0
                    whole = lanes_sum(whole, wp.static(WIDTH))
                    other = lane_xor(whole, wp.static(WIDTH % LANES))
                    if unit.half != 0:
                        whole += other
                    if near:
                        scale = force / whole
                totals += scale * found
                if wp.static(raw):
                    mine += scale * d
        if inside:
            for q in range(wp.static(slots)):
                k = wp.static(WIDTH) * q + lane
                if k < unit.pads:
                    f = groups.pads[unit.pad + k]
                    pad = w * wp.static(pad_count) + f
                    out.force[pad] = totals[q, 3]
                    out.centre[pad] = rot * centre_of(pads, f, totals[q]) + pos
            if wp.static(raw):
                for r in range(wp.static(all_rounds)):
                    if r < unit.rounds * wp.static(split):
                        this = groups.round[g, unit.round + r // wp.static(split)]
                        at = (w * wp.static(pad_count) + this[0]) * wp.static(taxels)
                        t = this[1] + wp.static(WIDTH) * (r % wp.static(split)) + lane
                        if t < wp.static(taxels):
                            out.readings[at + t] = mine[r]
                        if this[2] != 0 and (r + 1) % wp.static(split) == 0:
                            for u in range(t + wp.static(WIDTH), wp.static(taxels), wp.static(WIDTH)):
                                out.readings[at + u] = 0.0

    return of_object


def _of_hand(
    raw: bool, kind: int, pad_count: int, group_count: int, taxels: int, rounds: int, most: int, feel_others: bool,
    links: int, selves: bool,
) -> Callable:  # fmt: skip
    """Return a function of a warp for what pads touch of the hand itself, which few do at a time."""
    blocks, slots, tested = -(-links // LANES), -(-most // HAND_WIDTH), 1 if selves else links
    Reals, Gaps, Sums = (wp.types.vector(length=n, dtype=float) for n in (rounds, max(blocks, 1), slots))

    @wp.func
    def nearer(d: Any, s: Shapes, i: int, a: wp.mat33, b: wp.vec3, groups: Groups, n: int, at: int, level: float):
        """Return the lesser of the distances d and those to a grid, of taxels less than `level` [m] from its box."""
        offset = s.offset[i]
        dims = s.dims[i]
        low = s.origin[i]
        h = s.spacing[i]
        high = low + h * wp.vec3(float(dims[0] - 1), float(dims[1] - 1), float(dims[2] - 1))
        for r in range(wp.static(rounds)):
            if r < n:
                q = a * xyz(load4(groups.taxel, at + LANES * r)) + b
                off = q - wp.max(low, wp.min(q, high))
                near = wp.dot(off, off) <= level * level
                if lane_ballot(near) != 0:
                    # those that are far read one cell, all the same, without a branch that others would wait at
                    e = sd_cells(s.data, offset, dims, low, h, 1.0, wp.where(near, q, low))
                    d[r] = wp.min(d[r], wp.where(near, e, FAR))
        return d

    @wp.func
    def shares(d: Any, groups: Groups, at: int, reach: float, force: float):
        """Return what each taxel has of a force that is spread over its group, by its distance."""
        level = spread_level(lanes_min(wp.min(d), LANES), reach)
        whole = float(0.0)
        for r in range(wp.static(rounds)):
            c = spread_weight(d[r], load4(groups.taxel, at + LANES * r)[3], level)
            whole += c
            d[r] = c
        return d * (force / lanes_sum(whole, LANES))

    @wp.func
    def to_links(here: Surroundings, groups: Groups, tips: Shapes, w: int, g: int, at: int, lane: int, reach: float):
        """Return distances to the nearest of the hand's other links, exact where they are under the level. A lane asks
        how near its link may be; then the warp measures them, nearest first, until the rest cannot matter."""
        gap = Gaps(FAR)
        for k in range(wp.static(blocks)):
            if 32 * k + lane < wp.static(links):
                gap[k] = link_gap(here, groups, tips, w, g, 32 * k + lane)
        d = Reals(FAR)
        level = float(FAR)
        more = bool(True)
        while more:
            least = gap[0]
            for k in range(1, wp.static(blocks)):
                least = wp.min(least, gap[k])
            least = lanes_min(least, LANES)
            more = least < level
            if more:
                j = int(0)
                for k in range(wp.static(blocks)):
                    bits = lane_ballot(gap[k] == least)
                    if bits != 0:
                        j = 32 * k + lowest_bit(bits)
                for k in range(wp.static(blocks)):
                    if j == 32 * k + lane:
                        gap[k] = FAR
                a = turn_in(here.xmat, w, groups.body[g], here.link_body[j])
                b = pose_in(here.xpos, here.xmat, w, groups.body[g], here.link_body[j])
                d = nearer(d, tips, j, a, b, groups, groups.rounds[g], at, level)
                level = spread_level(lanes_min(wp.min(d), LANES), reach)
        return d

    @wp.func
    def of_hand(here: Surroundings, groups: Groups, law: Law, tips: Shapes, out: FlatFelt, i: int, warps: int):
        lane = i & 31
        # Pairs of a world and a group that are far from each other: those of one world are busy at the same time.
        item = (i >> 5) + lane // wp.static(HAND_WIDTH) * warps
        w = item // wp.static(group_count)
        g = item - w * wp.static(group_count)
        k = lane % wp.static(HAND_WIDTH)
        inside = w < here.shape_id.shape[0]
        sums = Sums()  # N, on the pads that this lane reports
        # A lane asks for a group, or a group and a link; then the warp feels those that are pressed, or near.
        for first in range(0, wp.static(tested), wp.static(HAND_WIDTH)):
            busy = inside and first + k < wp.static(tested)
            if busy:
                if wp.static(selves):
                    busy = here.pair_normal[w, here.self_column[g]] > 0.0
                else:
                    busy = link_gap(here, groups, tips, w, g, first + k) < 0.0
            these = lane_ballot(busy)
            while these != 0:
                bit = lowest_bit(these)
                these = these & (these - 1)
                item = (i >> 5) + bit // wp.static(HAND_WIDTH) * warps
                w1 = item // wp.static(group_count)
                g1 = item - w1 * wp.static(group_count)
                n = groups.rounds[g1]
                at = g1 * wp.static(rounds * LANES) + lane
                d = Reals(FAR)  # m, then N, of this lane's taxels
                if wp.static(selves):
                    d = to_links(here, groups, tips, w1, g1, at, lane, law.reach)
                    d = shares(d, groups, at, law.reach, here.pair_normal[w1, here.self_column[g1]])
                else:
                    j = first + bit % wp.static(HAND_WIDTH)
                    a = turn_in(here.xmat, w1, groups.body[g1], here.link_body[j])
                    b = pose_in(here.xpos, here.xmat, w1, groups.body[g1], here.link_body[j])
                    d = nearer(d, tips, j, a, b, groups, n, at, 0.0)
                    if lane_ballot(wp.min(d) < 0.0) == 0:
                        n = 0
                other = float(0.0)
                its = lane // wp.static(HAND_WIDTH) == bit // wp.static(HAND_WIDTH)
                c = int(0)  # pads so far
                for r in range(wp.static(rounds)):
                    if r < n:
                        this = groups.round[g1, r]
                        force = d[r]
                        if wp.static(not selves):
                            force = 0.0
                            if d[r] < 0.0:
                                stiff = law.scale[w1] * law.stiffness[this[0]]
                                area = load4(groups.taxel, at + 32 * r)[3]
                                force = taxel_force(wp.static(kind), law, stiff, -d[r], area, law.threshold[w1])
                        other += force
                        if wp.static(raw and feel_others):
                            if force > 0.0:
                                t = (w1 * wp.static(pad_count) + this[0]) * wp.static(taxels) + this[1] + lane
                                out.readings[t] = out.readings[t] + force
                        if this[2] != 0:
                            if lane_ballot(other > 0.0) != 0:
                                other = lanes_sum(other, LANES)
                                for q in range(wp.static(slots)):
                                    if its and c == wp.static(HAND_WIDTH) * q + k:
                                        sums[q] += other
                            other = 0.0
                            c += 1
        if inside:
            for q in range(wp.static(slots)):
                j = groups.first[g] + wp.static(HAND_WIDTH) * q + k
                if j < groups.first[g + 1]:
                    out.force_other[w * wp.static(pad_count) + groups.pads[j]] = sums[q]

    return of_hand
