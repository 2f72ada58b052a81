"""Exact geometry of a union of convex polyhedra: boundary, mass properties, signed distance (NumPy, double precision).

A shape is a list of hulls, each an array of vertices [V, 3] in metres. Everything here works on that list alone, so
that contact (which gets the hulls) and touch (which gets a grid of these distances) see the same surface.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import ConvexHull

from dexsim.surface import across

# Corners this close to a plane (relative to the size of the hull) lie in it.
_FLAT = 2e-6


def hull_vertices(points: np.ndarray) -> np.ndarray:
    """Return the corners of the convex hull of `points` [P, 3], in the order given, [V, 3]."""
    points = np.asarray(points, float)
    return points[np.sort(ConvexHull(points).vertices)]


def hull_planes(vertices: np.ndarray) -> np.ndarray:
    """Planes [F, 4] (outward unit normal n, offset d; inside is n . x + d <= 0), coplanar triangles merged."""
    hull = ConvexHull(vertices)
    tol = _FLAT * np.ptp(vertices, axis=0).max()
    corners = vertices[hull.simplices]  # [T, 3, 3]
    area = np.linalg.norm(across(corners), axis=1)
    kept: list[np.ndarray] = []
    # Largest first: a sliver's own normal is uncertain, so it should join a face, not found one.
    for k in np.argsort(-area, kind="stable"):
        normal = hull.equations[k, :3]
        if not any(normal @ p[:3] > 0 and np.abs(corners[k] @ p[:3] + p[3]).max() < tol for p in kept):
            kept.append(hull.equations[k])
    return np.array(kept)


def hull_faces(vertices: np.ndarray) -> list[np.ndarray]:
    """Return faces of a convex hull as polygons [K, 3], counter-clockwise seen from outside, in the order of
    `hull_planes`."""
    tol = _FLAT * np.ptp(vertices, axis=0).max()
    faces = []
    for plane in hull_planes(vertices):
        on = vertices[np.abs(vertices @ plane[:3] + plane[3]) < tol]
        centre = on.mean(axis=0)
        u = on[0] - centre
        u /= np.linalg.norm(u)
        v = np.cross(plane[:3], u)
        faces.append(on[np.argsort(np.arctan2((on - centre) @ v, (on - centre) @ u))])
    return faces


def _cut(polygon: np.ndarray, plane: np.ndarray, tol: float) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Splits a convex polygon by a plane into its part inside (n . x + d <= 0) and its part outside."""
    side = polygon @ plane[:3] + plane[3]
    if (side <= tol).all():
        return polygon, None
    if (side >= -tol).all():
        return None, polygon
    inside, outside = [], []
    for a, b, sa, sb in zip(polygon, np.roll(polygon, -1, axis=0), side, np.roll(side, -1), strict=True):
        if sa <= tol:
            inside.append(a)
        if sa >= -tol:
            outside.append(a)
        if (sa < -tol and sb > tol) or (sa > tol and sb < -tol):
            crossing = a + (b - a) * (sa / (sa - sb))
            inside.append(crossing)
            outside.append(crossing)
    return np.array(inside), np.array(outside)


def _outside_of(
    polygon: np.ndarray, normal: np.ndarray, planes: np.ndarray, keep_shared: bool, tol: float
) -> list[np.ndarray]:
    """Return the parts of a face (outward `normal`) that are not inside the polyhedron `planes`, as convex polygons.

    A face lying in one of the planes is kept where the two look the same way and `keep_shared` (one of two hulls
    keeps a surface that both have), and dropped where they face each other (the seam of two touching hulls).
    """
    pieces: list[np.ndarray] = []
    rest = polygon
    for plane in planes:
        if np.abs(rest @ plane[:3] + plane[3]).max() <= tol:
            if plane[:3] @ normal > 0 and keep_shared:
                return [polygon]
            continue
        inside, out = _cut(rest, plane, tol)
        if out is not None and len(out) >= 3:
            pieces.append(out)
        if inside is None or len(inside) < 3:
            return pieces
        rest = inside
    return pieces


def union_boundary(hulls: Sequence[np.ndarray]) -> np.ndarray:
    """Return triangles [T, 3, 3] of the boundary of the union of convex hulls, counter-clockwise seen from outside.

    Faces are cut exactly by the planes of the other hulls; where cut faces meet there may be T-junctions, which
    matter neither to integrals over the boundary nor to distances.
    """
    tol = 1e-9 * max(np.ptp(h, axis=0).max() for h in hulls)
    planes = [hull_planes(h) for h in hulls]
    triangles = []
    for i, vertices in enumerate(hulls):
        for face, plane in zip(hull_faces(vertices), planes[i], strict=True):
            pieces = [face]
            for j, other in enumerate(planes):
                if j != i:
                    pieces = [q for p in pieces for q in _outside_of(p, plane[:3], other, i < j, 1e3 * tol)]
            for piece in pieces:
                for k in range(1, len(piece) - 1):
                    triangle = piece[[0, k, k + 1]]
                    area = np.linalg.norm(np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0]))
                    if area > tol**2:
                        triangles.append(triangle)
    return np.array(triangles)


def simplify_hull(points: np.ndarray, limit: int) -> tuple[np.ndarray, float, float]:
    """At most `limit` corners [V, 3] of a convex polyhedron near the hull of `points`, and how far (m) its surface
    lies at most inside and at most outside of that hull's.

    Greedy: starts from the extreme points along the axes and adds the corner farthest outside until `limit`; then
    grows about its centre to the volume of the full hull, so that the error is shared between inside and outside.
    Both are convex, so the largest distances are found at corners.
    """
    full = ConvexHull(points)
    corners = points[full.vertices]
    if len(corners) <= limit:
        return hull_vertices(points), 0.0, 0.0
    chosen = sorted({int(i) for axis in range(3) for i in (corners[:, axis].argmin(), corners[:, axis].argmax())})
    flat = 1e-3 * np.ptp(corners, axis=0).max()
    while np.linalg.matrix_rank(corners[chosen] - corners[chosen[0]], tol=flat) < 3:
        # Not a solid yet: add the point farthest from the span of those chosen.
        offset = corners - corners[chosen[0]]
        span = np.linalg.svd(offset[chosen])[2][: np.linalg.matrix_rank(offset[chosen], tol=flat)]
        farthest = int(np.linalg.norm(offset - offset @ span.T @ span, axis=1).argmax())
        if farthest in chosen:
            break
        chosen.append(farthest)
    while len(chosen) < limit:
        distance = _triangle_distance(corners, union_boundary([hull_vertices(corners[chosen])]))
        distance[chosen] = 0
        chosen.append(int(distance.argmax()))
    simple = hull_vertices(corners[chosen])
    volume, centre, _ = mass_properties(union_boundary([simple]))
    simple = centre + (simple - centre) * (full.volume / volume) ** (1 / 3)
    beyond = (corners @ (planes := hull_planes(simple))[:, :3].T + planes[:, 3]).max(axis=1) > 0
    inside = (_triangle_distance(corners, union_boundary([simple])) * beyond).max()
    beyond = (simple @ full.equations[:, :3].T + full.equations[:, 3]).max(axis=1) > 0
    outside = (_triangle_distance(simple, points[full.simplices]) * beyond).max()
    return simple, float(inside), float(outside)


def mass_properties(triangles: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return volume (m^3), centre (m, [3]) and inertia per kg about the centre (m^2, [3, 3]) of a solid of uniform
    density.

    Sums signed tetrahedra from the origin to each boundary triangle (divergence theorem): for vertices a, b, c the
    second moment is V/20 (aa' + bb' + cc' + ss'), s = a + b + c.
    """
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    v = np.einsum("ti,ti->t", a, np.cross(b, c)) / 6
    volume = v.sum()
    s = a + b + c
    centre = (v[:, None] * s).sum(axis=0) / (4 * volume)
    second = sum(np.einsum("t,ti,tj->ij", v, w, w) for w in (a, b, c, s)) / 20
    second = second / volume - np.outer(centre, centre)
    return float(volume), centre, np.trace(second) * np.eye(3) - second


def _triangle_distance(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return distance [P] from points [P, 3] to the nearest of triangles [T, 3, 3]."""
    best = np.full(len(points), np.inf)
    # Over a triangle's interior: distance to its plane. (Products of matrices keep the temporaries at [P, T].)
    edges = np.roll(triangles, -1, axis=1) - triangles
    normal = np.cross(edges[:, 0], edges[:, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    height = points @ normal.T - np.einsum("ti,ti->t", normal, triangles[:, 0])
    over = np.ones(height.shape, bool)
    for k in range(3):
        inward = np.cross(normal, edges[:, k])
        over &= points @ inward.T >= np.einsum("ti,ti->t", inward, triangles[:, k])
    best = np.minimum(best, np.where(over, np.abs(height), np.inf).min(axis=1))
    # Elsewhere: distance to an edge.
    start, along = triangles.reshape(-1, 3), edges.reshape(-1, 3)
    length2 = np.einsum("ei,ei->e", along, along)
    reach = points @ along.T - np.einsum("ei,ei->e", along, start)
    t = np.clip(reach / length2, 0, 1)
    square = (
        np.einsum("pi,pi->p", points, points)[:, None]
        - 2 * points @ start.T
        + np.einsum("ei,ei->e", start, start)
        + t * (t * length2 - 2 * reach)
    )
    return np.minimum(best, np.sqrt(np.maximum(square.min(axis=1), 0)))


def signed_distance(hulls: Sequence[np.ndarray], points: np.ndarray, chunk: int = 8192) -> np.ndarray:
    """Return exact signed distance [P] (m, negative inside) from points [P, 3] to the boundary of the union of the
    hulls."""
    points = np.asarray(points, float)
    triangles = union_boundary(hulls)
    planes = [hull_planes(h) for h in hulls]
    out = np.empty(len(points))
    for lo in range(0, len(points), chunk):
        p = points[lo : lo + chunk]
        inside = np.zeros(len(p), bool)
        for hull in planes:
            inside |= (p @ hull[:, :3].T + hull[:, 3]).max(axis=1) <= 0
        out[lo : lo + chunk] = np.where(inside, -1, 1) * _triangle_distance(p, triangles)
    return out


def principal_axes(inertia: np.ndarray) -> np.ndarray:
    """Return rotation R [3, 3], columns the principal axes, chosen nearest to the axes the inertia is given in.

    An inertia that is diagonal already (to 1e-6 of its size) gives the identity.
    """
    if np.abs(inertia - np.diag(np.diag(inertia))).max() < 1e-6 * np.trace(inertia):
        return np.eye(3)
    axes = np.linalg.eigh(inertia)[1]
    order = [-1, -1, -1]
    weight = np.abs(axes)
    for _ in range(3):
        row, column = np.unravel_index(np.argmax(weight), weight.shape)
        order[int(row)] = int(column)
        weight[row, :] = weight[:, column] = -1
    axes = axes[:, order] * np.sign(np.diag(axes[:, order]))
    if np.linalg.det(axes) < 0:
        axes[:, int(np.argmin(np.diag(axes)))] *= -1
    return axes
