"""The kernels of the narrow phase: for cores that are apart, for cores that overlap, and for cylinders.

Both take the pairs that MuJoCo-Warp's broad phase found and write with its own functions, so that margins, mixed
materials, friction, explicit pairs and what a contact is are decided where they always were.
"""

from __future__ import annotations

from typing import Any

import warp as wp
from mujoco_warp._src.collision_core import contact_margin_gap, contact_material_params, write_contact
from mujoco_warp._src.math import make_frame

from dexsim.sim.collision.cylinder import FAR, beside_side, from_cylinder, furthest, rounder, stands_off
from dexsim.sim.collision.epa import Facet, penetration
from dexsim.sim.collision.gjk import (
    LEAST,
    OVERLAP,
    ROUNDED,
    STEP,
    away,
    crossing,
    distance,
    nearest_of_b,
    touching,
)
from dexsim.sim.collision.shapes import (
    BOX,
    CAPSULE,
    CYLINDER,
    HULL,
    SPHERE,
    Core,
    Prism,
    corners,
    radius_of,
)

SHALLOW = wp.constant(3.0e-6)
"""Of an overlap less deep than this [m], what is nearest is looked for with the bodies moved apart."""

# Each product and sum rounded by itself, as on a CPU. Fused, a cross product of parallel edges is no longer zero but
# what one of its two products lost by rounding: a direction out of nothing, by which flat simplices were taken to
# enclose the origin.
_ROUNDED = {"fuse_fp": False}


def _arrays(name: str, about: str, fields: dict[str, Any]) -> Any:
    """Return a struct of the arrays among MuJoCo-Warp's parameters, by its names for them."""
    arrays = {k: kind for k, kind in fields.items() if isinstance(kind, type(wp.array[int]))}
    return wp.struct(type(name, (), {"__annotations__": arrays, "__doc__": about, "__module__": __name__}))


_MARGIN, _MATERIAL, _WRITE = (
    f.func.__annotations__ for f in (contact_margin_gap, contact_material_params, write_contact)
)
Materials = _arrays("Materials", "MuJoCo-Warp's model fields that decide a contact's parameters.", _MARGIN | _MATERIAL)
Contacts = _arrays(
    "Contacts", "MuJoCo-Warp's contact list, and how many contacts are in it.",
    {k.removeprefix("contact_").removesuffix("_out"): kind for k, kind in _WRITE.items()},
)  # fmt: skip


@wp.func
def write(
    mat: Materials, out: Contacts, room: int, geoms: wp.vec2i, pairid: wp.vec2i, world: int, margin: float, gap: float,
    dist: float, pos: wp.vec3, normal: wp.vec3,
):  # fmt: skip
    """Write one contact. dist [m]: of the surfaces, without margin; normal: from geoms[0] to geoms[1], world frame."""
    condim, friction, solref, solreffriction, solimp, adhesion = contact_material_params(
        mat.geom_condim, mat.geom_priority, mat.geom_solmix, mat.geom_solref, mat.geom_solimp, mat.geom_friction,
        mat.geom_adhesion, mat.pair_dim, mat.pair_solref, mat.pair_solreffriction, mat.pair_solimp, mat.pair_adhesion,
        mat.pair_friction, geoms, pairid[0], world,
    )  # fmt: skip
    write_contact(
        room, 0, dist, pos, make_frame(normal), margin, gap, condim, friction, solref, solreffriction, solimp, adhesion,
        geoms, pairid, world, out.dist, out.pos, out.frame, out.includemargin, out.friction, out.solref,
        out.solreffriction, out.solimp, out.dim, out.geom, out.efc_address, out.worldid, out.type, out.geomcollisionid,
        out.adhesion, out.nacon,
    )  # fmt: skip


@wp.func
def core_of(
    kind: int, size: wp.vec3, dataid: int, hull_first: wp.array(dtype=int), hull_count: wp.array(dtype=int)
) -> Core:
    if kind == HULL and dataid >= 0:
        return Core(kind, size, hull_first[dataid], hull_count[dataid])
    return Core(kind, size, 0, 0)


@wp.func
def known(name: int, a: Core, b: Core) -> bool:
    """Return whether both corners exist: another mesh may be there than in the step before."""
    return name < 0 or ((name & 0xFFFF) < corners(a) and (name >> 16) < corners(b))


@wp.struct
class Pairs:
    """Results of the broad phase, MuJoCo-Warp's shapes, and what is kept of each pair between steps.

    geom_size, geom_dataid, geom_xpos, geom_xmat: as in MuJoCo-Warp. room: most pairs. number: pairs found. geom, id,
    world: of each. hull_first, hull_count [nmesh], hull [n]: corners of each mesh's convex hull. slot [ngeom, ngeom]:
    column of `simplex`. simplex [N, P]: names of the corners that were nearest, or -1.
    """

    geom_type: wp.array(dtype=int)
    geom_dataid: wp.array2d(dtype=int)
    geom_size: wp.array2d(dtype=wp.vec3)
    geom_xpos: wp.array2d(dtype=wp.vec3)
    geom_xmat: wp.array2d(dtype=wp.mat33)
    room: int
    number: wp.array(dtype=int)
    geom: wp.array(dtype=wp.vec2i)
    id: wp.array(dtype=wp.vec2i)
    world: wp.array(dtype=int)
    hull_first: wp.array(dtype=int)
    hull_count: wp.array(dtype=int)
    hull: wp.array(dtype=wp.vec3)
    slot: wp.array2d(dtype=int)
    simplex: wp.array2d(dtype=wp.vec3i)


@wp.struct
class Two:
    """A pair's cores and A's pose in B's frame (R, p); margin, gap and A's radius [m]."""

    a: Core
    b: Core
    R: wp.mat33
    p: wp.vec3
    margin: float
    gap: float
    radius: float


@wp.func
def two(pairs: Pairs, mat: Materials, k: int) -> Two:
    geoms = pairs.geom[k]
    world = pairs.world[k]
    margin, gap = contact_margin_gap(
        mat.geom_margin, mat.geom_gap, mat.pair_margin, mat.pair_gap, geoms, pairs.id[k][0], world
    )
    size = pairs.geom_size[world % pairs.geom_size.shape[0], geoms[0]]
    kind = pairs.geom_type[geoms[0]]
    meshes = world % pairs.geom_dataid.shape[0]
    a = core_of(kind, size, pairs.geom_dataid[meshes, geoms[0]], pairs.hull_first, pairs.hull_count)
    b = core_of(HULL, size, pairs.geom_dataid[meshes, geoms[1]], pairs.hull_first, pairs.hull_count)
    to_b = wp.transpose(pairs.geom_xmat[world, geoms[1]])
    p = to_b * (pairs.geom_xpos[world, geoms[0]] - pairs.geom_xpos[world, geoms[1]])
    return Two(a, b, to_b * pairs.geom_xmat[world, geoms[0]], p, margin, gap, radius_of(kind, size))


@wp.func
def add(
    pairs: Pairs, mat: Materials, out: Contacts, k: int, t: Two, q: wp.vec3, v: wp.vec3, normal: wp.vec3, dist: float
):
    """Add the contact of pair k. q: B's nearest point; v: from there to A's core; normal: from A to B; all in B's
    frame. dist [m]: of the cores, negative if they overlap. A contact lies halfway between the surfaces, and margins
    move both alike."""
    geoms = pairs.geom[k]
    world = pairs.world[k]
    b_mat = pairs.geom_xmat[world, geoms[1]]
    middle = q + 0.5 * v + (0.5 * t.radius) * normal
    pos = b_mat * middle + pairs.geom_xpos[world, geoms[1]]
    write(mat, out, pairs.room, geoms, pairs.id[k], world, t.margin, t.gap, dist - t.radius, pos, b_mat * normal)


@wp.kernel(enable_backward=False, module="unique", module_options=_ROUNDED)
def separate(
    pairs: Pairs,
    mat: Materials,
    # out
    out: Contacts,
    deep: wp.array(dtype=int),
    enclosing: wp.array(dtype=wp.vec4i),
    deep_number: wp.array(dtype=int),
):
    """Find contacts of each pair of a point, segment, box or hull with a hull: its contact, if cores are apart.
    Pairs that overlap are listed in `deep`, with four corners that enclose the origin of A - B, or -1 where they
    only touch."""
    k = wp.tid()
    if k >= wp.min(pairs.number[0], pairs.room):
        return
    geoms = pairs.geom[k]
    kind = pairs.geom_type[geoms[0]]
    if pairs.geom_type[geoms[1]] != HULL or (kind != SPHERE and kind != CAPSULE and kind != BOX and kind != HULL):
        return
    t = two(pairs, mat, k)
    if t.b.count == 0 or (kind == HULL and t.a.count == 0):
        return
    cutoff = t.margin + t.gap + t.radius
    world = pairs.world[k]
    home = pairs.slot[geoms[0], geoms[1]]
    first = pairs.simplex[world, home]
    if not (known(first[0], t.a, t.b) and known(first[1], t.a, t.b) and known(first[2], t.a, t.b)):
        first = wp.vec3i(-1, -1, -1)
    s = distance(t.a, t.b, pairs.hull, t.R, t.p, first, cutoff)
    names = wp.vec3i(s.i0, wp.where(s.n > 1, s.i1, -1), wp.where(s.n > 2, s.i2, -1))
    pairs.simplex[world, home] = names
    d = wp.length(s.v)
    if s.inside != 0 or d <= OVERLAP:
        j = wp.atomic_add(deep_number, 0, 1)
        deep[j] = k
        enclosing[j] = wp.where(s.inside != 0, wp.vec4i(s.i0, s.i1, s.i2, s.i3), wp.vec4i(-1, -1, -1, -1))
    elif d < cutoff:
        q = nearest_of_b(t.b, pairs.hull, names, wp.vec3(s.l0, s.l1, s.l2))
        v = s.v
        c = crossing(t.a, t.b, pairs.hull, t.R, t.p, s)
        if c.found != 0:
            q = c.q
            v = c.v
            d = wp.length(v)
        add(pairs, mat, out, k, t, q, v, -v / d, d)


@wp.kernel(enable_backward=False, module="unique", module_options=_ROUNDED)
def overlapping(
    pairs: Pairs,
    mat: Materials,
    deep: wp.array(dtype=int),
    enclosing: wp.array(dtype=wp.vec4i),
    deep_number: wp.array(dtype=int),
    stride: int,
    # out
    out: Contacts,
):
    """Find the contacts of the pairs in `deep`."""
    for j in range(wp.tid(), wp.min(deep_number[0], pairs.room), stride):
        k = deep[j]
        t = two(pairs, mat, k)
        geoms = pairs.geom[k]
        home = pairs.slot[geoms[0], geoms[1]]
        corners4 = enclosing[j]
        f = Facet()
        if corners4[0] >= 0:
            f = penetration(t.a, t.b, pairs.hull, t.R, t.p, corners4)
        if f.found != 0 and f.depth > SHALLOW:
            names = wp.vec3i(f.i0, f.i1, f.i2)
            pairs.simplex[pairs.world[k], home] = names
            q = nearest_of_b(t.b, pairs.hull, names, wp.vec3(f.l0, f.l1, f.l2))
            add(pairs, mat, out, k, t, q, f.depth * f.normal, f.normal, -f.depth)
        else:
            about = away(t.p)
            if f.found != 0:
                about = f.normal
            h = touching(t.a, t.b, pairs.hull, t.R, t.p, about)
            pairs.simplex[pairs.world[k], home] = h.i
            add(pairs, mat, out, k, t, h.q, -h.dist * h.normal, h.normal, h.dist)


@wp.kernel(enable_backward=False, module="unique", module_options=_ROUNDED)
def beside_cylinder(
    pairs: Pairs,
    mat: Materials,
    # out
    out: Contacts,
):
    """Find contacts of each pair of a cylinder with a segment, box or hull: its contact. In the cylinder's frame;
    normals from it to the other."""
    k = wp.tid()
    if k >= wp.min(pairs.number[0], pairs.room):
        return
    geoms = pairs.geom[k]
    first_kind = pairs.geom_type[geoms[0]]
    second_kind = pairs.geom_type[geoms[1]]
    first_is = first_kind == CYLINDER and (second_kind == BOX or second_kind == HULL)
    if not first_is and (first_kind != CAPSULE or second_kind != CYLINDER):
        return
    world = pairs.world[k]
    geom = wp.where(first_is, geoms[0], geoms[1])
    other = wp.where(first_is, geoms[1], geoms[0])
    margin, gap = contact_margin_gap(
        mat.geom_margin, mat.geom_gap, mat.pair_margin, mat.pair_gap, geoms, pairs.id[k][0], world
    )
    half = pairs.geom_size[world % pairs.geom_size.shape[0], geom]
    size = pairs.geom_size[world % pairs.geom_size.shape[0], other]
    kind = pairs.geom_type[other]
    b = core_of(
        kind, size, pairs.geom_dataid[world % pairs.geom_dataid.shape[0], other], pairs.hull_first, pairs.hull_count
    )
    if kind == HULL and b.count == 0:
        return
    radius = radius_of(kind, size)
    mat_c = pairs.geom_xmat[world, geom]
    R = wp.transpose(mat_c) * pairs.geom_xmat[world, other]
    p = wp.transpose(mat_c) * (pairs.geom_xpos[world, other] - pairs.geom_xpos[world, geom])
    cutoff = margin + gap + radius
    home = pairs.slot[geoms[0], geoms[1]]
    first = pairs.simplex[world, home]
    normal = wp.vec3(0.0)
    middle = wp.vec3(0.0)
    dist = float(0.0)
    out_by = wp.vec3(0.0)
    step = float(STEP)
    tries = int(0)
    while tries < 4:  # not known in advance: the search is compiled once
        s = from_cylinder(half, b, pairs.hull, R, p + out_by, first, wp.where(tries == 0, cutoff, 1.0))
        s = beside_side(half, b, pairs.hull, R, s)
        d = wp.length(s.g)
        done = int(0)
        first = wp.vec3i(s.i0, wp.where(s.n > 1, s.i1, -1), wp.where(s.n > 2, s.i2, -1))
        if tries == 0:
            pairs.simplex[world, home] = first
            if d > 0.0:
                dist = d
                normal = s.g / d
                middle = s.x - 0.5 * s.g
                done = int(1)
            else:
                # they overlap, or nearly: the prism and the body, in the body's frame
                a = Prism(half)
                to_b = wp.transpose(R)
                f = Facet()
                t = distance(a, b, pairs.hull, to_b, -(to_b * p), wp.vec3i(-1, -1, -1), cutoff)
                if t.inside != 0:
                    f = penetration(a, b, pairs.hull, to_b, -(to_b * p), wp.vec4i(t.i0, t.i1, t.i2, t.i3))
                normal = -away(p)
                if f.found != 0:
                    normal = R * f.normal
                    w = rounder(half, b, pairs.hull, R, p, normal, wp.vec3i(f.i0 >> 16, f.i1 >> 16, f.i2 >> 16))
                    if w.found != 0:
                        normal = w.u
                elif wp.length(t.v) > OVERLAP:
                    normal = -wp.normalize(R * t.v)
                # A cap is a facet of so many corners that the polytope is lost at it at times, on another way out that
                # is hardly longer; but the caps' ways are known.
                dist = float(-FAR)
                about = normal
                tried = int(0)
                while tried < 3:
                    u = wp.where(tried == 0, about, wp.vec3(0.0, 0.0, wp.where(tried == 1, 1.0, -1.0)))
                    along_u = stands_off(half, b, pairs.hull, R, p, u)
                    if along_u > dist + LEAST:
                        dist = along_u
                        normal = u
                    tried += 1
                middle = furthest(half, normal) + 0.5 * dist * normal
        elif d > 0.0:
            # moved out along a normal of the place where they overlap or touch, they have it there (see gjk.touching)
            done = int(1)
            g = s.g - out_by
            straight = wp.dot(g, s.g) / (d * d)
            shallow = dist > -SHALLOW
            ways = wp.where(shallow and wp.length(g - straight * s.g) > ROUNDED, 2, 1)
            for j in range(ways):
                u = wp.where(j == 0, s.g / d, wp.normalize(g))
                along_u = stands_off(half, b, pairs.hull, R, p, u)
                if along_u > dist + LEAST:
                    done = int(0)
                if along_u > dist + wp.where(shallow, -LEAST, LEAST):
                    dist = along_u
                    normal = u
            middle = s.x - out_by - 0.5 * dist * normal
        else:
            step = 10.0 * step
        out_by = (step - wp.min(dist, 0.0)) * normal
        tries = wp.where(done == 1, 4, tries + 1)
    if dist >= cutoff:
        return
    pos = mat_c * (middle - (0.5 * radius) * normal) + pairs.geom_xpos[world, geom]
    along = mat_c * wp.where(first_is, normal, -normal)
    write(mat, out, pairs.room, geoms, pairs.id[k], world, margin, gap, dist - radius, pos, along)
