"""Distance of a cylinder from a point, segment, box or hull that does not overlap it.

A cylinder has no corners, so the search is over the other body's alone: as GJK keeps the corners nearest to the origin,
this keeps those nearest to the cylinder, whose distance from a point is a closed form. On an edge the derivative of the
distance grows steadily, so its root is bracketed; on a face the nearest point is where the cylinder reaches furthest
along the face's normal. A face, edge or corner of the other body is exact, then, and nothing is said by a chord of the
rim. All in the cylinder's frame: axis z, radius half[0], half length half[1].
"""

from __future__ import annotations

import warp as wp

from dexsim.sim.collision.gjk import DOUBT, GAIN, LOOKS, OVERLAP, ROUNDED
from dexsim.sim.collision.shapes import Core, corner, corners, support

STEPS = 50
"""Most steps to the root on an edge; every other one halves the bracket, so that the last is less than float32
resolves."""
FAR = wp.constant(1.0e10)
NEAR = wp.constant(0.2)
"""How far [rad] a way out past an edge may be from where the prism had it."""
LOWER = wp.constant(1.0e-8)
"""What rounding makes of the heights [m] of the ends of one edge."""
FLAT = wp.constant(1.0e-7)
"""And of the corners of one face: of a sliver's normal more is not known."""
LEVEL = wp.constant(1.0e-5)
"""A direction [rad] as near to square with the axis leads out through the side."""


@wp.struct
class Nearest:
    """n: corners of the feature that is nearest (0: none). p: their places [m]. i: their numbers. x [m]: its nearest
    point. g [m]: from the cylinder's nearest point to x; zero if they overlap."""

    n: int
    p0: wp.vec3
    p1: wp.vec3
    p2: wp.vec3
    i0: int
    i1: int
    i2: int
    x: wp.vec3
    g: wp.vec3


@wp.func
def off(half: wp.vec3, x: wp.vec3) -> wp.vec3:
    """Return the way from the point of the cylinder that is nearest to x, to x [m]; zero within."""
    rho = wp.sqrt(x[0] * x[0] + x[1] * x[1])
    k = float(0.0)
    if rho > half[0]:
        k = (rho - half[0]) / rho
    return wp.vec3(k * x[0], k * x[1], x[2] - wp.clamp(x[2], -half[1], half[1]))


@wp.func
def furthest(half: wp.vec3, u: wp.vec3) -> wp.vec3:
    """Return the point of the cylinder that is furthest along u [m]; of a whole cap its centre."""
    flat = wp.sqrt(u[0] * u[0] + u[1] * u[1])
    k = float(0.0)
    if flat > 0.0:
        k = half[0] / flat
    return wp.vec3(k * u[0], k * u[1], wp.where(u[2] > 0.0, half[1], -half[1]))


@wp.func
def stands_off(half: wp.vec3, b: Core, vertex: wp.array(dtype=wp.vec3), R: wp.mat33, p: wp.vec3, u: wp.vec3) -> float:
    """Return how far [m] the body is beyond the cylinder along the unit direction u: see gjk.separation."""
    return wp.dot(u, R * corner(b, vertex, support(b, vertex, -(wp.transpose(R) * u))) + p - furthest(half, u))


@wp.func
def none() -> Nearest:
    z = wp.vec3()
    return Nearest(0, z, z, z, 0, 0, 0, z, wp.vec3(FAR, 0.0, 0.0))


@wp.func
def nearer(s: Nearest, t: Nearest) -> Nearest:
    if wp.dot(t.g, t.g) < wp.dot(s.g, s.g):
        return t
    return s


@wp.func
def on_corner(half: wp.vec3, a: wp.vec3, i: int) -> Nearest:
    return Nearest(1, a, wp.vec3(), wp.vec3(), i, 0, 0, a, off(half, a))


@wp.func
def on_edge(half: wp.vec3, a: wp.vec3, b: wp.vec3, ia: int, ib: int) -> Nearest:
    """Return what of the segment a, b is nearest to the cylinder."""
    e = b - a
    low = float(0.0)
    high = float(1.0)
    f_low = wp.dot(e, off(half, a))
    f_high = wp.dot(e, off(half, b))
    if f_low >= 0.0:
        return on_corner(half, a, ia)
    if f_high <= 0.0:
        return on_corner(half, b, ib)
    t = float(0.5)
    side = int(0)
    for step in range(STEPS):
        # Regula falsi with the Illinois rule; where the edge goes from the side to the rim it is slow, hence the
        # halving
        t = (low * f_high - high * f_low) / (f_high - f_low)
        if step % 2 == 1 or not (t > low and t < high):
            t = 0.5 * (low + high)
        f = wp.dot(e, off(half, a + t * e))
        if f == 0.0 or t == low or t == high:
            break
        if f < 0.0:
            low = t
            f_low = f
            if side < 0:
                f_high = 0.5 * f_high
            side = -1
        else:
            high = t
            f_high = f
            if side > 0:
                f_low = 0.5 * f_low
            side = 1
        if high - low < 2.0e-7:
            break
    x = a + t * e
    g = off(half, x)
    across = g - (wp.dot(g, e) / wp.dot(e, e)) * e  # exactly across the edge
    if g[0] != 0.0 or g[1] != 0.0:
        # and across the line of the side, or the rim's tangent: these tell the direction better than a small difference
        beside = wp.vec3(0.0, 0.0, 1.0)
        if g[2] != 0.0:
            beside = wp.normalize(wp.vec3(-x[1], x[0], 0.0))
        c = wp.cross(e, beside)
        if wp.dot(c, c) > 1.0e-3 * wp.dot(e, e):
            across = (wp.dot(g, c) / wp.dot(c, c)) * c
    return Nearest(2, a, b, wp.vec3(), ia, ib, 0, x, across)


@wp.func
def beside(y: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.vec3:
    """Return the corner nearest to y: from there a height above the face suffers least from what its normal is off."""
    p = a
    if wp.length_sq(b - y) < wp.length_sq(p - y):
        p = b
    if wp.length_sq(c - y) < wp.length_sq(p - y):
        p = c
    return p


@wp.func
def on_face(half: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3, ia: int, ib: int, ic: int) -> Nearest:
    """Return the triangle's nearest point if that is within, else `none`: then an edge has it, or one as near."""
    n = wp.cross(b - a, c - a)
    area = wp.length(n)
    if area <= 1.0e-14:
        return none()
    n = n / area
    if wp.dot(n, a) < 0.0:
        n = -n
    y = furthest(half, n)
    p = beside(y, a, b, c)
    gap = wp.dot(n, p - y)
    x = y + gap * n
    if gap <= 0.0:
        # the cylinder goes through the plane, here at least
        gap = 0.0
        x = (wp.dot(n, p) / wp.dot(n, y)) * y
    m = wp.cross(b - a, c - a)
    if (
        wp.dot(m, wp.cross(b - x, c - x)) <= 0.0
        or wp.dot(m, wp.cross(c - x, a - x)) <= 0.0
        or wp.dot(m, wp.cross(a - x, b - x)) <= 0.0
    ):
        return none()
    return Nearest(3, a, b, c, ia, ib, ic, x, gap * n)


@wp.func
def place(s: Nearest, k: int) -> wp.vec3:
    return wp.where(k == 0, s.p0, wp.where(k == 1, s.p1, s.p2))


@wp.func
def number(s: Nearest, k: int) -> int:
    return wp.where(k == 0, s.i0, wp.where(k == 1, s.i1, s.i2))


@wp.func
def with_corner(half: wp.vec3, s: Nearest, w: wp.vec3, i: int) -> Nearest:
    """Return what of the feature and one more corner is nearest to the cylinder; the corner has a part in it."""
    best = none()
    face = none()
    for k in range(s.n):  # not known in advance: a loop that is not unrolled compiles in a third of the time
        a = place(s, k)
        ia = number(s, k)
        best = nearer(best, on_edge(half, a, w, ia, i))
        if s.n == 3 or s.n - k == 2:
            next = (k + 1) % s.n
            face = nearer(face, on_face(half, a, place(s, next), w, ia, number(s, next), i))
    # a point within a face is nearer than its edges, but near a corner by less than float32 tells
    if face.n != 0 and wp.length(face.g) <= wp.length(best.g) + GAIN:
        return face
    return best


@wp.func
def begin(half: wp.vec3, b: Core, vertex: wp.array(dtype=wp.vec3), R: wp.mat33, p: wp.vec3, first: wp.vec3i) -> Nearest:
    """Return the nearest of the corners numbered in `first` (-1: none), where the body is now."""
    i = first[0]
    if i < 0 or i >= corners(b):
        i = support(b, vertex, -(wp.transpose(R) * p))
    s = on_corner(half, R * corner(b, vertex, i) + p, i)
    k = int(1)
    while k < 3:
        i = first[k]
        if i >= 0 and i < corners(b) and i != s.i0 and (s.n < 2 or i != s.i1):
            w = R * corner(b, vertex, i) + p
            s = nearer(s, with_corner(half, s, w, i))
        k += 1
    return s


@wp.func
def from_cylinder(
    half: wp.vec3, b: Core, vertex: wp.array(dtype=wp.vec3), R: wp.mat33, p: wp.vec3, first: wp.vec3i, cutoff: float
) -> Nearest:
    """Return what of the body b is nearest to the cylinder; g is zero if they overlap, or that cannot be told.

    R, p: the body's frame in the cylinder's. first: numbers of corners to begin with. cutoff [m]: bodies that are shown
    to be further apart need no exact answer; then |g| is at least the cutoff.
    """
    s = begin(half, b, vertex, R, p, first)
    best = s
    least = float(FAR)
    for _look in range(LOOKS):
        gg = wp.dot(s.g, s.g)
        if gg <= OVERLAP * OVERLAP:
            least = FAR
            break
        norm = wp.sqrt(gg)
        i = support(b, vertex, -(wp.transpose(R) * s.g))
        w = R * corner(b, vertex, i) + p
        promise = wp.dot(s.x - w, s.g) / norm
        if promise <= GAIN or norm - promise >= cutoff:
            return s
        t = with_corner(half, s, w, i)
        # no nearer, as far as |g| tells: what the next corner promises tells better (see gjk.distance)
        if wp.dot(t.g, t.g) >= gg:
            if promise >= least:
                break
            best = s
            least = promise
        s = t
    if least > DOUBT:
        best.g = wp.vec3(0.0)
    return best


@wp.func
def beside_side(half: wp.vec3, b: Core, vertex: wp.array(dtype=wp.vec3), R: wp.mat33, s: Nearest) -> Nearest:
    """Return where the nearest is an edge beside the round side: its point by the edge's own direction.

    Of two positions' difference a short edge is off by 1e-4 rad seen along the axis, and where edge and axis are at a
    small angle the place goes with that (see gjk.crossing).
    """
    if s.n != 2 or s.g[2] != 0.0 or (s.g[0] == 0.0 and s.g[1] == 0.0):
        return s
    e = R * (corner(b, vertex, s.i1) - corner(b, vertex, s.i0))
    flat = e[0] * e[0] + e[1] * e[1]
    if flat <= 1.0e-6 * wp.dot(e, e):
        return s
    t = -(s.p0[0] * e[0] + s.p0[1] * e[1]) / flat
    x = s.p0 + t * e
    rho = (s.p0[0] * e[1] - s.p0[1] * e[0]) / flat  # of the edge's line from the axis, in lengths of e seen along it
    c = rho * wp.vec3(e[1], -e[0], 0.0)
    g = c - half[0] * wp.normalize(c)
    if t < 0.0 or t > 1.0 or wp.abs(x[2]) > half[1] or wp.length(g - s.g) > ROUNDED:
        return s
    n = s
    n.x = x
    n.g = g
    return n


@wp.struct
class Way:
    """A way out of an overlap past a feature of the body. found: 0 if there is none. u: unit direction from the
    cylinder to the body. depth [m]: how far the feature must go along it."""

    found: int
    u: wp.vec3
    depth: float


@wp.func
def way(half: wp.vec3, u: wp.vec3, a: wp.vec3) -> Way:
    """Return the along u for a feature with the point a, where the rim is furthest along it."""
    return Way(1, u, wp.dot(u, furthest(half, u) - a))


@wp.func
def past_corner(half: wp.vec3, a: wp.vec3, about: wp.vec3) -> Way:
    """Return the way out for a corner through the side or through a cap, whichever is nearer to `about`, if it is below
    that."""
    u = wp.vec3(0.0, 0.0, wp.where(about[2] > 0.0, 1.0, -1.0))
    rho = wp.sqrt(a[0] * a[0] + a[1] * a[1])
    below = rho <= half[0]
    if rho > 0.0 and wp.abs(about[2]) < 0.5:
        u = wp.vec3(a[0] / rho, a[1] / rho, 0.0)
        below = wp.abs(a[2]) <= half[1]
    w = way(half, u, a)
    w.found = wp.where(below, 1, 0)
    return w


@wp.func
def past_edge(half: wp.vec3, a: wp.vec3, b: wp.vec3, about: wp.vec3) -> Way:
    """Return the shortest way out for the edge a, b among directions across it that are near `about`: over a rim, or
    past the side."""
    length = wp.length(b - a)
    e = (b - a) / length
    c = wp.normalize(about - wp.dot(about, e) * e)
    s = wp.cross(e, c)
    low = float(-NEAR)
    high = float(NEAR)
    # the depth's derivative grows through zero where the depth is least
    for _step in range(STEPS):
        angle = 0.5 * (low + high)
        u = wp.cos(angle) * c + wp.sin(angle) * s
        slope = wp.dot(wp.cos(angle) * s - wp.sin(angle) * c, furthest(half, u) - a)
        if slope < 0.0:
            low = angle
        else:
            high = angle
    w = Way()
    if low == -NEAR or high == NEAR:
        return w  # it is further off
    angle = 0.5 * (low + high)
    w = way(half, wp.cos(angle) * c + wp.sin(angle) * s, a)
    beside = wp.cross(w.u, wp.vec3(0.0, 0.0, 1.0))
    single = wp.abs(w.u[2]) > LEVEL and wp.abs(w.u[0]) + wp.abs(w.u[1]) > LEVEL
    across = e
    if wp.abs(w.u[2]) <= LEVEL and wp.abs(wp.dot(e, beside)) > LEVEL:
        across = beside  # a whole line of the side is furthest: where that and the edge cross
        single = True
    at = wp.dot(furthest(half, w.u) - a, across) / wp.dot(e, across)
    if single and (at < -LEVEL or at > length + LEVEL):
        w.found = 0  # past its ends
    return w


@wp.func
def past_face(half: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3, about: wp.vec3) -> Way:
    """Return the way out along the normal of a triangle."""
    w = Way()
    n = wp.cross(b - a, c - a)
    if wp.dot(n, n) > 0.0:
        u = wp.normalize(wp.where(wp.dot(n, about) > 0.0, n, -n))
        w = way(half, u, beside(furthest(half, u), a, b, c))
    return w


@wp.func
def past(half: wp.vec3, c0: wp.vec3, c1: wp.vec3, c2: wp.vec3, about: wp.vec3, i: wp.vec3i) -> Way:
    """Return the way out past the feature of corners c, near the direction `about`. Where their numbers i are the
    same it has fewer."""
    if i[0] == i[1] and i[0] == i[2]:
        return past_corner(half, c0, about)
    if i[0] == i[1]:
        return past_edge(half, c0, c2, about)
    if i[0] == i[2] or i[1] == i[2]:
        return past_edge(half, c0, c1, about)
    return past_face(half, c0, c1, c2, about)


@wp.func
def lowest(b: Core, vertex: wp.array(dtype=wp.vec3), d: wp.vec3) -> wp.vec3i:
    """Return the numbers of the three corners that are least along d (in the body's frame); the last again where
    there are but two."""
    i = wp.vec3i(0, 0, 0)
    h = wp.vec3(FAR, FAR, FAR)
    for k in range(corners(b)):
        s = wp.dot(corner(b, vertex, k), d)
        if s < h[0]:
            h = wp.vec3(s, h[0], h[1])
            i = wp.vec3i(k, i[0], i[1])
        elif s < h[1]:
            h = wp.vec3(h[0], s, h[1])
            i = wp.vec3i(i[0], k, i[1])
        elif s < h[2]:
            h[2] = s
            i[2] = k
    if h[2] == FAR:
        i[2] = i[1]
    return i


@wp.func
def widest(b: Core, vertex: wp.array(dtype=wp.vec3), d: wp.vec3, first: wp.vec3i) -> wp.vec3i:
    """Return three corners far apart of the face that is lowest along d (in the body's frame), which tell its normal
    best; `first`, the three lowest, if no more are as low."""
    c0 = corner(b, vertex, first[0])
    level = wp.dot(d, c0) + FLAT
    out = first
    most = float(0.0)
    for k in range(corners(b)):
        e = corner(b, vertex, k) - c0
        if wp.dot(d, e + c0) <= level and wp.length_sq(e) > most:
            most = wp.length_sq(e)
            out = wp.vec3i(first[0], k, first[2])
    if most == 0.0:
        return first
    c1 = corner(b, vertex, out[1])
    most = float(0.0)
    for k in range(corners(b)):
        e = corner(b, vertex, k) - c0
        area = wp.length_sq(wp.cross(e, c1 - c0))
        if wp.dot(d, e + c0) <= level and area > most:
            most = area
            out = wp.vec3i(out[0], out[1], k)
    if most == 0.0:
        return first
    return out


@wp.func
def side(b: Core, vertex: wp.array(dtype=wp.vec3), d: wp.vec3, y: wp.vec3, near: wp.vec3i) -> wp.vec2i:
    """Return the ends of the edge beyond which y lies, of the face that is lowest along the unit direction d; (-1,
    -1) if y is within. All in the body's frame; near: three of the face's corners."""
    level = wp.dot(d, corner(b, vertex, near[0])) + FLAT
    out = wp.vec2i(-1, -1)
    furthest_off = float(0.0)
    for i in range(corners(b)):
        p = corner(b, vertex, i)
        if wp.dot(d, p) <= level:
            for j in range(corners(b)):
                e = corner(b, vertex, j) - p
                if i != j and wp.dot(d, e + p) <= level:
                    inward = wp.normalize(wp.cross(d, e))
                    off_by = -wp.dot(inward, y - p)
                    if off_by > furthest_off:
                        least = float(0.0)
                        for k in range(corners(b)):
                            q = corner(b, vertex, k)
                            if wp.dot(d, q) <= level:
                                least = wp.min(least, wp.dot(inward, q - p))
                        if least > -LOWER:
                            furthest_off = off_by
                            out = wp.vec2i(i, j)
    return out


@wp.func
def rounder(
    half: wp.vec3, b: Core, vertex: wp.array(dtype=wp.vec3), R: wp.mat33, p: wp.vec3, about: wp.vec3, on: wp.vec3i
) -> Way:
    """Return the way out of the round cylinder near that of the prism, whose facets are chords.

    about: the prism's. on: the body's corners that it led past. Tried are the features that these and the body's three
    lowest corners make, fewest corners first: the shortest along which no other corner is lower.
    """
    three = lowest(b, vertex, wp.transpose(R) * about)
    most = wp.dot(about, furthest(half, about) - (R * corner(b, vertex, three[0]) + p)) + 2.0 * LOWER
    best = Way()
    face = wp.vec3i(-1, -1, -1)
    k = int(0)
    while k < 8:
        i = on
        if k < 3:
            i = wp.vec3i(three[k], three[k], three[k])
        elif k < 6:
            i = wp.vec3i(three[(k + 1) % 3], three[(k + 1) % 3], three[(k + 2) % 3])
        elif k == 6:
            i = widest(b, vertex, wp.transpose(R) * about, three)
        c0 = R * corner(b, vertex, i[0]) + p
        w = past(half, c0, R * corner(b, vertex, i[1]) + p, R * corner(b, vertex, i[2]) + p, about, i)
        if w.found != 0 and w.depth < most:
            other = R * corner(b, vertex, support(b, vertex, -(wp.transpose(R) * w.u))) + p
            if wp.dot(w.u, c0 - other) <= wp.where(k < 6, LOWER, FLAT):
                best = w
                most = w.depth - LOWER
                face = wp.where(k < 6, wp.vec3i(-1, -1, -1), i)
        k += 1
    if face[0] >= 0:
        # The rim may be furthest beyond one of the face's edges, where the way out is hardly shorter: by the tilt
        # squared. That edge need not be of the three corners'.
        to_b = wp.transpose(R)
        ends = side(b, vertex, to_b * best.u, to_b * (furthest(half, best.u) - p), face)
        if ends[0] >= 0:
            w = past_edge(half, R * corner(b, vertex, ends[0]) + p, R * corner(b, vertex, ends[1]) + p, best.u)
            if w.found != 0 and w.depth < best.depth + LOWER:
                best = w
    return best
