"""Distance of two convex cores that do not overlap: GJK on pairs of corners, warm-started.

Gilbert, Johnson and Keerthi 1988; the nearest point of a triangle by Ericson, Real-Time Collision Detection (2005),
section 5.1.5. The simplex is at most three pairs of corners, kept by name in registers. A search that begins at the
simplex of the step before is over after one look for a nearer corner, because bodies hardly move in one step. float32
throughout; what follows from that:

- directions are taken from the simplex's edges or face, not from the small difference of two large positions;
- a search ends when the corner found is no news, or promises less than `GAIN`, or does not bring the bodies
  nearer although it promised hardly more (`DOUBT`).
"""

from __future__ import annotations

from typing import Any

import warp as wp

from dexsim.sim.collision.shapes import Core, corner, support

OVERLAP = wp.constant(1.0e-6)
"""Cores nearer than this [m] count as overlapping: their distance says nothing about depth."""
GAIN = wp.constant(6.0e-9)
"""A corner that promises to bring two cores nearer by less than this [m] is no news: float32 resolves 4e-9 m at 0.05 m.
More would be felt: a facet that is left out for 2e-8 m at a corner 0.2 mm away is 1e-4 rad across, and the place on a
ball of 12 mm 1.2 um off."""
ROUNDED = wp.constant(2.0e-8)
"""What rounding makes of a distance [m], at most."""
DOUBT = wp.constant(1.0e-6)
"""A search that gets no nearer, although a corner promises more than this [m], goes on: the bodies may overlap."""
STEP = wp.constant(1.0e-5)
"""How far [m] bodies that touch are moved apart to tell where."""
LEAST = wp.constant(4.0e-9)
"""A direction by which two cores are further apart by less than this [m] tells nothing new."""
LOOKS = 24
"""Most looks for a nearer corner. Searches end by themselves; the worst of a million random poses took 17."""


@wp.struct
class Simplex:
    """n: pairs of corners (0: none yet). p: their differences A - B in B's frame [m]. i: A's corner | B's corner << 16.
    l: weights of the point v of the simplex that is nearest to the origin. inside: 1 if these and the corner i3 enclose
    it."""

    n: int
    p0: wp.vec3
    p1: wp.vec3
    p2: wp.vec3
    i0: int
    i1: int
    i2: int
    l0: float
    l1: float
    l2: float
    v: wp.vec3
    inside: int
    i3: int


@wp.func
def point(p: wp.vec3, i: int) -> Simplex:
    return Simplex(1, p, wp.vec3(), wp.vec3(), i, 0, 0, 1.0, 0.0, 0.0, p, 0, 0)


@wp.func
def segment(a: wp.vec3, b: wp.vec3, ia: int, ib: int) -> Simplex:
    """Return what of the segment a, b is nearest to the origin."""
    e = b - a
    ee = wp.dot(e, e)
    t = -wp.dot(a, e)
    if t <= 0.0 or ee <= 0.0:
        return point(a, ia)
    if t >= ee:
        return point(b, ib)
    t = t / ee
    v = a + t * e
    v = v - (wp.dot(v, e) / ee) * e  # exactly across the edge
    return Simplex(2, a, b, wp.vec3(), ia, ib, 0, 1.0 - t, t, 0.0, v, 0, 0)


@wp.func
def nearer(s: Simplex, t: Simplex) -> Simplex:
    if wp.dot(t.v, t.v) < wp.dot(s.v, s.v):
        return t
    return s


@wp.func
def triangle(a: wp.vec3, b: wp.vec3, c: wp.vec3, ia: int, ib: int, ic: int) -> Simplex:
    """Return what of the triangle a, b, c is nearest to the origin: a point within, or of an edge. Rounding may
    choose the wrong one, in a sliver, but never a point outside of the triangle."""
    ab = b - a
    ac = c - a
    n = wp.cross(ab, ac)
    nn = wp.dot(n, n)
    la = wp.dot(n, wp.cross(b, c))
    lb = wp.dot(n, wp.cross(c, a))
    lc = wp.dot(n, wp.cross(a, b))
    if la <= 0.0 or lb <= 0.0 or lc <= 0.0:
        return nearer(nearer(segment(a, b, ia, ib), segment(b, c, ib, ic)), segment(c, a, ic, ia))
    total = la + lb + lc
    s = Simplex(3, a, b, c, ia, ib, ic, la / total, lb / total, lc / total, wp.vec3(), 0, 0)
    v = s.l0 * a + s.l1 * b + s.l2 * c
    # the face tells the direction better than v, unless it is a sliver
    if nn > wp.dot(v, v) * wp.max(wp.dot(ab, ab), wp.dot(ac, ac)):
        v = (wp.dot(n, a) / nn) * n
    s.v = v
    return s


@wp.func
def beyond(a: wp.vec3, b: wp.vec3, c: wp.vec3, other: wp.vec3) -> bool:
    """Return whether the origin is on the other side of the plane a, b, c than `other`, or that cannot be told."""
    n = wp.cross(b - a, c - a)
    return wp.dot(n, a) * wp.dot(n, other - a) >= 0.0


@wp.func
def with_corner(s: Simplex, w: wp.vec3, i: int) -> Simplex:
    """Return what of the simplex and one more corner is nearest to the origin; `inside` if they enclose it."""
    if s.n == 0:
        return point(w, i)
    if s.n == 1:
        return segment(s.p0, w, s.i0, i)
    if s.n == 2:
        return triangle(s.p0, s.p1, w, s.i0, s.i1, i)
    best = Simplex()
    best.v = wp.vec3(1.0e10, 0.0, 0.0)
    if beyond(s.p0, s.p1, w, s.p2):
        best = triangle(s.p0, s.p1, w, s.i0, s.i1, i)
    if beyond(s.p1, s.p2, w, s.p0):
        best = nearer(best, triangle(s.p1, s.p2, w, s.i1, s.i2, i))
    if beyond(s.p2, s.p0, w, s.p1):
        best = nearer(best, triangle(s.p2, s.p0, w, s.i2, s.i0, i))
    if best.n == 0:
        best = s
        best.inside = 1
        best.i3 = i
    return best


@wp.func
def difference(a: Any, b: Core, vertex: wp.array(dtype=wp.vec3), R: wp.mat33, p: wp.vec3, i: int) -> wp.vec3:
    """Return the corner of A minus corner of B, in B's frame [m]."""
    return R * corner(a, vertex, i & 0xFFFF) + p - corner(b, vertex, i >> 16)


@wp.func
def begin(a: Any, b: Core, vertex: wp.array(dtype=wp.vec3), R: wp.mat33, p: wp.vec3, first: wp.vec3i) -> Simplex:
    """Return the simplex named by `first` (-1: none), where the bodies are now."""
    if first[0] < 0:
        i = support(a, vertex, -(wp.transpose(R) * p)) | (support(b, vertex, p) << 16)
        return point(difference(a, b, vertex, R, p, i), i)
    p0 = difference(a, b, vertex, R, p, first[0])
    if first[1] < 0:
        return point(p0, first[0])
    p1 = difference(a, b, vertex, R, p, first[1])
    if first[2] < 0:
        return segment(p0, p1, first[0], first[1])
    return triangle(p0, p1, difference(a, b, vertex, R, p, first[2]), first[0], first[1], first[2])


@wp.func
def away(p: wp.vec3) -> wp.vec3:
    """Return a way out (from A to B) where nothing better is known: along the line of centres."""
    if wp.dot(p, p) > 0.0:
        return -wp.normalize(p)
    return wp.vec3(0.0, 0.0, 1.0)


@wp.func
def outermost(
    a: Any, b: Core, vertex: wp.array(dtype=wp.vec3), R: wp.mat33, p: wp.vec3, u: wp.vec3, beside: wp.vec3
) -> int:
    """Return the corner of A - B furthest from the plane through `beside` across u, on the side where that is
    further."""
    up = support(a, vertex, wp.transpose(R) * u) | (support(b, vertex, -u) << 16)
    down = support(a, vertex, -(wp.transpose(R) * u)) | (support(b, vertex, u) << 16)
    height = wp.dot(u, difference(a, b, vertex, R, p, up) - beside)
    depth = wp.dot(u, beside - difference(a, b, vertex, R, p, down))
    return wp.where(height > depth, up, down)


@wp.func
def enclose(a: Any, b: Core, vertex: wp.array(dtype=wp.vec3), R: wp.mat33, p: wp.vec3, simplex: Simplex) -> Simplex:
    """Return a simplex that goes through the origin, with corners added until it has four."""
    s = simplex
    if s.n == 1:
        s.i1 = outermost(a, b, vertex, R, p, away(p), s.p0)
        s.p1 = difference(a, b, vertex, R, p, s.i1)
        s.n = 2
    if s.n == 2:
        e = s.p1 - s.p0
        across = wp.cross(e, wp.vec3(1.0, 0.0, 0.0))
        other = wp.cross(e, wp.vec3(0.0, 1.0, 0.0))
        if wp.dot(other, other) > wp.dot(across, across):
            across = other
        s.i2 = outermost(a, b, vertex, R, p, across, s.p0)
        s.p2 = difference(a, b, vertex, R, p, s.i2)
        s.n = 3
    if s.n == 3:
        s.i3 = outermost(a, b, vertex, R, p, wp.cross(s.p1 - s.p0, s.p2 - s.p0), s.p0)
        s.inside = 1
    return s


@wp.func
def distance(
    a: Any, b: Core, vertex: wp.array(dtype=wp.vec3), R: wp.mat33, p: wp.vec3, first: wp.vec3i, cutoff: float
) -> Simplex:
    """Return the simplex of the nearest points of A and B (`v` from B to A, in B's frame).

    R, p: A's frame in B's. first: names of the corners to begin with. cutoff [m]: bodies that are shown to be further
    apart need no exact answer; then |v| is at least the cutoff.
    """
    s = begin(a, b, vertex, R, p, first)
    best = s
    least = float(DOUBT)
    for _look in range(LOOKS):
        vv = wp.dot(s.v, s.v)
        if vv <= OVERLAP * OVERLAP:
            s = enclose(a, b, vertex, R, p, s)
            break
        i = support(a, vertex, -(wp.transpose(R) * s.v)) | (support(b, vertex, s.v) << 16)
        if i == s.i0 or (s.n > 1 and i == s.i1) or (s.n > 2 and i == s.i2):
            break
        w = difference(a, b, vertex, R, p, i)
        vw = wp.dot(s.v, w)
        norm = wp.sqrt(vv)
        promise = (vv - vw) / norm
        if promise <= GAIN or (vw > 0.0 and vw >= cutoff * norm):
            break
        t = with_corner(s, w, i)
        if t.inside != 0 and vw > 0.0 and promise <= DOUBT:
            break  # a fourth corner of one facet: these are flat, and enclose nothing
        # No nearer, as far as |v| tells: a place 1e-5 m further on a facet brings a centre 1e-2 m away nearer by 5e-9
        # m. What the next corner promises tells better. Unless that gets less, it is over.
        if t.inside == 0 and wp.dot(t.v, t.v) >= vv and promise < DOUBT:
            if promise >= least:
                s = best
                break
            if wp.length(t.v) > norm + ROUNDED:
                break  # rounding chose the wrong edge of a flat simplex
            best = s
            least = promise
        s = t
        if s.inside != 0:
            break
    return s


@wp.func
def nearest_of_b(b: Core, vertex: wp.array(dtype=wp.vec3), i: wp.vec3i, l: wp.vec3) -> wp.vec3:
    """Return the weighted mean of B's corners named by i (-1: none), in B's frame [m]."""
    q = l[0] * corner(b, vertex, i[0] >> 16)
    if i[1] >= 0:
        q += l[1] * corner(b, vertex, i[1] >> 16)
    if i[2] >= 0:
        q += l[2] * corner(b, vertex, i[2] >> 16)
    return q


@wp.struct
class Crossing:
    """found: 1 if an edge of A lies across an edge of B. q: the point on B's edge; v: from there to A's; both in B's
    frame [m]."""

    found: int
    q: wp.vec3
    v: wp.vec3


@wp.func
def crossing(a: Core, b: Core, vertex: wp.array(dtype=wp.vec3), R: wp.mat33, p: wp.vec3, s: Simplex) -> Crossing:
    """Return where the simplex is of two corners of each body: the nearest points of these two edges.

    Their directions come from each body's own corners. The simplex has differences of positions, in which a short edge
    is off by 1e-4 rad, and where two edges cross at a small angle the place goes with that.
    """
    out = Crossing()
    a0 = s.i0 & 0xFFFF
    b0 = s.i0 >> 16
    a1 = s.i1 & 0xFFFF
    b1 = s.i1 >> 16
    if s.n < 2:
        return out
    if s.n == 3:
        a2 = s.i2 & 0xFFFF
        b2 = s.i2 >> 16
        if a1 == a0:
            a1 = a2
        elif a2 != a0 and a2 != a1:
            return out
        if b1 == b0:
            b1 = b2
        elif b2 != b0 and b2 != b1:
            return out
    if a1 == a0 or b1 == b0:
        return out
    e = R * (corner(a, vertex, a1) - corner(a, vertex, a0))
    f = corner(b, vertex, b1) - corner(b, vertex, b0)
    n = wp.cross(e, f)
    nn = wp.dot(n, n)
    if nn <= 1.0e-6 * wp.dot(e, e) * wp.dot(f, f):
        return out
    w = R * corner(a, vertex, a0) + p - corner(b, vertex, b0)
    t = -wp.dot(wp.cross(w, f), n) / nn
    u = -wp.dot(wp.cross(w, e), n) / nn
    v = (wp.dot(n, w) / nn) * n
    if t < 0.0 or t > 1.0 or u < 0.0 or u > 1.0 or wp.abs(wp.length(v) - wp.length(s.v)) > ROUNDED:
        return out
    out.found = 1
    out.q = corner(b, vertex, b0) + u * f
    out.v = v
    return out


@wp.func
def separation(a: Core, b: Core, vertex: wp.array(dtype=wp.vec3), R: wp.mat33, p: wp.vec3, u: wp.vec3) -> float:
    """Return how far apart [m] the cores are along the unit direction u from A to B. No direction's exceeds their
    distance, or minus their depth if they overlap; that of the best one is it."""
    i = support(a, vertex, wp.transpose(R) * u) | (support(b, vertex, -u) << 16)
    return -wp.dot(u, difference(a, b, vertex, R, p, i))


@wp.struct
class Touch:
    """normal: from A to B; q: B's nearest point [m]; both in B's frame. dist [m]: negative if they overlap. i: names of
    the nearest corners, as `NarrowPhase.simplex`."""

    normal: wp.vec3
    dist: float
    q: wp.vec3
    i: wp.vec3i


@wp.func
def touching(a: Core, b: Core, vertex: wp.array(dtype=wp.vec3), R: wp.mat33, p: wp.vec3, about: wp.vec3) -> Touch:
    """Return the contact of cores that are hardly apart or hardly overlap, near the way out `about` (a unit vector).

    The difference of their positions has no direction, and a plane that they lie on both sides of need not go through
    where they touch. So A is moved out along the way by a little. What of convex bodies is nearest is the same then if
    the way is among the normals of the place where they touch, and else is off by at most the move times what the way
    is off: nearest points of a convex body lie no further apart than what they are nearest to. It tells a better way;
    the best is kept, by `separation`, and moved along the next time.
    """
    t = Touch()
    t.normal = about
    t.dist = separation(a, b, vertex, R, p, about)
    lowest = support(b, vertex, -about)
    t.q = corner(b, vertex, lowest)
    t.i = wp.vec3i(support(a, vertex, wp.transpose(R) * about) | (lowest << 16), -1, -1)
    step = float(STEP)
    tries = int(0)
    while tries < 3:  # not known in advance: the search is compiled once
        out = step * t.normal
        s = distance(a, b, vertex, R, p - out, wp.vec3i(-1, -1, -1), 1.0)
        d = wp.length(s.v)
        if s.inside == 0 and d > OVERLAP:
            t.i = wp.vec3i(s.i0, wp.where(s.n > 1, s.i1, -1), wp.where(s.n > 2, s.i2, -1))
            t.q = nearest_of_b(b, vertex, t.i, wp.vec3(s.l0, s.l1, s.l2))
            v = s.v
            c = crossing(a, b, vertex, R, p - out, s)
            if c.found != 0:
                t.q = c.q
                v = c.v
                d = wp.length(v)
            # as bodies are, unmoved; where that is not along what the search has, and not by rounding, it is better
            gap = -v - out
            ways = wp.where(wp.length(gap - (wp.dot(gap, v) / (d * d)) * v) > ROUNDED, 2, 1)
            done = int(1)
            for j in range(ways):
                u = wp.where(j == 0, -v / d, wp.normalize(gap))
                width = separation(a, b, vertex, R, p, u)
                if width > t.dist + LEAST:
                    done = int(0)
                if width > t.dist - LEAST:
                    t.dist = width
                    t.normal = u
            tries += 3 * done
        else:
            step = 10.0 * step
        tries += 1
    return t
