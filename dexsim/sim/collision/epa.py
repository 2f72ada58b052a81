"""Depth of two convex cores that overlap: EPA on pairs of corners, from the tetrahedron that GJK ended with.

Van den Bergen, Proximity queries and penetration depth computation on 3D game objects (2001). Cores have corners only,
so the depth found is the exact one: that of the facet of A - B which is nearest to the origin. Radii and margins add to
it, because a ball widens A - B by as much in every direction. When GJK was warm-started with the facet of the step
before, its tetrahedron stands on that facet, and one look confirms it.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from dexsim.sim.collision.gjk import OVERLAP, difference
from dexsim.sim.collision.shapes import Core, support

POINTS = 32
"""Most corners of the growing polytope."""
FACES = 2 * POINTS - 4
EDGES = 48
FAR = wp.constant(1.0e10)
GAIN = wp.constant(6.0e-9)
"""A corner that lies above a facet by less than this [m] is of it."""
ATTEMPTS = wp.constant(3)
"""Searches at most: one is enough in all but one of some ten thousand overlapping poses."""
PARALLEL = wp.constant(0.999)
"""Cosine above which two triangles may be of one facet: one that rounding has turned round can lie as deep as the
nearest."""
SURE = wp.constant(1.0e-7)
"""A facet beyond which A - B goes on by more than this [m] is not one of its facets."""
LEVEL = wp.constant(2.0e-8)
"""How far [m] a corner must lie above a face to see it, more in each attempt: faces of one plane are seen together or
not at all, whatever rounding says of each."""


@wp.struct
class Facet:
    """The facet of A - B nearest to the origin. found: 0 if there is none (the four corners were flat). sure: 0 if A -
    B does not end where the facet is: then `depth` is how far A - B reaches along `normal`, a way out of the overlap,
    if not the shortest. normal: outward, which is from A to B, in B's frame. depth [m]: its distance from the origin.
    i, l: names of its corners, and weights of the nearest point."""

    found: int
    sure: int
    normal: wp.vec3
    depth: float
    i0: int
    i1: int
    i2: int
    l0: float
    l1: float
    l2: float


@wp.func
def plane(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.vec4:
    """Return the unit normal of the triangle (counter-clockwise seen from outside) and the origin's depth below it; FAR
    if it has no area."""
    n = wp.cross(b - a, c - a)
    area = wp.length(n)
    if area <= 1.0e-14:
        return wp.vec4(0.0, 0.0, 0.0, FAR)
    n = n / area
    # of the corner that is nearest to the origin, whose position is the most exact
    p = a
    if wp.dot(b, b) < wp.dot(p, p):
        p = b
    if wp.dot(c, c) < wp.dot(p, p):
        p = c
    return wp.vec4(n[0], n[1], n[2], wp.dot(n, p))


@wp.func
def weights(n: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.vec3:
    """Return the barycentric coordinates of the origin's projection on the triangle of normal n."""
    la = wp.dot(n, wp.cross(b, c))
    lb = wp.dot(n, wp.cross(c, a))
    lc = wp.dot(n, wp.cross(a, b))
    return wp.vec3(la, lb, lc) / (la + lb + lc)


@wp.func
def three(f: int) -> wp.vec3i:
    """Return the points of a face."""
    return wp.vec3i(f & 0xFF, (f >> 8) & 0xFF, (f >> 16) & 0xFF)


@wp.func
def grown(
    a: Any, b: Core, vertex: wp.array(dtype=wp.vec3), R: wp.mat33, p: wp.vec3, names: wp.vec4i, above: float
) -> Facet:
    """Return the nearest facet of A - B, by one search. above [m]: from a corner at this height a face is not seen."""
    pos = wp.zeros(shape=(POINTS,), dtype=wp.vec3)
    name = wp.zeros(shape=(POINTS,), dtype=int)
    face = wp.zeros(shape=(FACES,), dtype=int)  # three points of 8 bits, or -1
    at = wp.zeros(shape=(FACES,), dtype=wp.vec4)
    edge = wp.zeros(shape=(EDGES,), dtype=int)
    none = Facet()
    out = Facet(1, 0, wp.vec3(), FAR, 0, 0, 0, 1.0, 0.0, 0.0)
    for j in range(4):
        name[j] = names[j]
        pos[j] = difference(a, b, vertex, R, p, names[j])
    points = int(4)
    faces = int(4)
    turned = wp.dot(wp.cross(pos[1] - pos[0], pos[2] - pos[0]), pos[3] - pos[0]) > 0.0
    # faces of a tetrahedron whose last point lies below the first three
    face[0] = wp.where(turned, 0 | (2 << 8) | (1 << 16), 0 | (1 << 8) | (2 << 16))
    face[1] = wp.where(turned, 0 | (1 << 8) | (3 << 16), 0 | (3 << 8) | (1 << 16))
    face[2] = wp.where(turned, 1 | (2 << 8) | (3 << 16), 1 | (3 << 8) | (2 << 16))
    face[3] = wp.where(turned, 2 | (0 << 8) | (3 << 16), 2 | (3 << 8) | (0 << 16))
    for j in range(4):
        t = three(face[j])
        at[j] = plane(pos[t[0]], pos[t[1]], pos[t[2]])
        if at[j][3] < -2.0 * OVERLAP:
            return none
    nearest = int(0)
    done = int(0)
    lost = int(0)
    for _look in range(2 * POINTS):
        nearest = int(0)
        for j in range(1, faces):
            if at[j][3] < at[nearest][3]:
                nearest = j
        n = wp.vec3(at[nearest][0], at[nearest][1], at[nearest][2])
        i = support(a, vertex, wp.transpose(R) * n) | (support(b, vertex, -n) << 16)
        w = difference(a, b, vertex, R, p, i)
        reach = wp.dot(n, w)
        level = at[nearest][3]
        if reach < out.depth:
            out.normal = n
            out.depth = reach
            out.i0 = i
            out.i1 = i
            out.i2 = i
        for j in range(points):
            if name[j] == i:
                done = int(1)
        if reach - level <= GAIN:
            done = int(1)
        if done == 1 and reach - level > SURE:
            lost = int(1)
        if lost == 1 or done == 1 or points == POINTS:
            break
        name[points] = i
        pos[points] = w
        # faces that see the new point go; the edges of the hole are those that only one of them had
        edges = int(0)
        count = int(0)
        for j in range(faces):
            f = face[j]
            g = at[j]
            if j == nearest or (g[3] < FAR and g[0] * w[0] + g[1] * w[1] + g[2] * w[2] - g[3] > above):
                t = three(f)
                for e in range(3):
                    u = t[e]
                    v = t[(e + 1) % 3]
                    twin = int(-1)
                    for h in range(edges):
                        if edge[h] == (v | (u << 8)):
                            twin = h
                    if twin >= 0:
                        edges -= 1
                        edge[twin] = edge[edges]
                    elif edges < EDGES:
                        edge[edges] = u | (v << 8)
                        edges += 1
                    else:
                        lost = int(1)
            else:
                face[count] = f
                at[count] = g
                count += 1
        if lost == 1 or edges < 3 or count + edges > FACES:
            break
        faces = count
        for h in range(edges):
            u = edge[h] & 0xFF
            v = edge[h] >> 8
            face[faces] = u | (v << 8) | (points << 16)
            at[faces] = plane(pos[u], pos[v], w)
            # Inside out: what grows comes nowhere nearer to the origin, unless that lies just outside, of cores that
            # touch.
            if at[faces][3] < wp.where(level > OVERLAP, level - SURE, -2.0 * OVERLAP):
                lost = int(1)
            faces += 1
        points += 1
    if done == 0 or lost == 1:
        return out
    # of several triangles of one facet, the one that the origin is below
    n = wp.vec3(at[nearest][0], at[nearest][1], at[nearest][2])
    best = int(nearest)
    most = float(-FAR)
    for j in range(faces):
        m = wp.vec3(at[j][0], at[j][1], at[j][2])
        if at[j][3] - at[nearest][3] <= 2.0 * GAIN and wp.dot(m, n) > PARALLEL:
            t = three(face[j])
            l = weights(m, pos[t[0]], pos[t[1]], pos[t[2]])
            least = wp.min(l[0], wp.min(l[1], l[2]))
            if least > most:
                most = least
                best = j
    t = three(face[best])
    n = wp.vec3(at[best][0], at[best][1], at[best][2])
    l = weights(n, pos[t[0]], pos[t[1]], pos[t[2]])
    return Facet(1, 1, n, at[best][3], name[t[0]], name[t[1]], name[t[2]], l[0], l[1], l[2])


@wp.func
def penetration(a: Any, b: Core, vertex: wp.array(dtype=wp.vec3), R: wp.mat33, p: wp.vec3, names: wp.vec4i) -> Facet:
    """Return the nearest facet of A - B, which contains the origin. R, p: A's frame in B's. names: four corners that
    enclose it, or have it on a face.

    Parallel faces and edges of the two cores make facets of many corners, and rounding may call some triangles of one
    facet seen and others not, until one is inside out. That shows: it is nearer than any was before, or A - B goes on
    beyond it. Then the search is repeated, and what it must be above a face to see it is raised.
    """
    best = Facet()
    attempt = int(0)
    while attempt < ATTEMPTS and best.sure == 0:
        f = grown(a, b, vertex, R, p, names, LEVEL * float(attempt))
        if best.found == 0 or f.sure != 0 or f.depth < best.depth:
            best = f
        if f.found == 0:
            attempt = ATTEMPTS
        attempt += 1
    return best
