"""Distance or depth of a cylinder and a convex polytope, in float64, by looking at every feature: the reference of
`benchmarks.narrow_phase` for cylinders, which have no corners.

Apart, the nearest points lie on a corner, an edge or a face of the polytope, and each is solved by itself (a closed
form; the root of a growing function; where the cylinder reaches furthest along the normal). Overlapping, the least
depth is that along the normal of a face, along the axis, from the axis through a corner, across an edge and the axis,
or where an edge slides over a rim (again a root). Each of these is a distance of two points of the bodies, or a way
out, so that none can be too small, and the least is the answer.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls
from scipy.spatial import ConvexHull

HALVINGS = 52
LEVEL = 1e-9
"""Points of one feature are as high as each other, to this [m]."""
SAMPLES = 96
"""Directions across an edge between which a root is looked for."""


def features(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (edges [m, 2], triangles [k, 3]) of the hull of corners [n, 3]; of one or two corners no hull is
    needed."""
    if len(corners) < 3:
        return np.array([[0, 1]] if len(corners) == 2 else np.zeros((0, 2), int)), np.zeros((0, 3), int)
    triangles = ConvexHull(corners).simplices
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return np.unique(edges, axis=0), triangles


def answer(radius: float, half: float, corners: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return (distance in m, negative if they overlap; unit direction from the cylinder to the polytope; the place
    halfway between their nearest points in m), in the cylinder's frame: axis z, radius and half length in m, corners
    [n, 3] of the polytope."""
    edges, triangles = features(corners)
    dist, u, x = _separate(radius, half, corners, edges, triangles)
    if dist > 1e-12 and not _crosses(radius, half, u, corners):
        return dist, u, x - 0.5 * dist * u
    dist, u = _overlapping(radius, half, corners, edges, triangles)
    return dist, u, _between(radius, half, corners, dist, u)


def _between(radius: float, half: float, corners: np.ndarray, dist: float, u: np.ndarray) -> np.ndarray:
    """Return the place halfway between the furthest points along u of the cylinder and against it of the polytope:
    one point of the rim, or the polytope's one corner, or where its lowest edge crosses a line of the side."""
    flat = float(np.hypot(u[0], u[1]))
    if min(2 * half * abs(u[2]), 2 * radius * flat) > LEVEL:
        return _furthest(radius, half, u) + 0.5 * dist * u
    low = corners[(h := corners @ u) < h.min() + LEVEL]
    if len(low) == 1 or 2 * radius * flat <= LEVEL:  # on a cap: of an edge or face its middle
        return low.mean(0) - 0.5 * dist * u
    line = _furthest(radius, half, u) * [1, 1, 0] + np.outer([-half, half], [0, 0, 1.0])
    pairs = (low[:, None] - line[None]).reshape(-1, 3) - dist * u
    weight, _ = nnls(np.vstack([pairs.T / np.abs(pairs).max(), np.ones(len(pairs))]), np.array([0.0, 0.0, 0.0, 1.0]))
    return (weight.reshape(-1, 2).sum(1) / weight.sum()) @ low - 0.5 * dist * u


def _off(radius: float, half: float, x: np.ndarray) -> np.ndarray:
    """Return vectors from the cylinder's nearest point to each x [..., 3]."""
    rho = np.hypot(x[..., 0], x[..., 1])
    k = np.maximum(rho - radius, 0) / np.maximum(rho, 1e-300)
    return np.stack([k * x[..., 0], k * x[..., 1], x[..., 2] - np.clip(x[..., 2], -half, half)], -1)


def _furthest(radius: float, half: float, u: np.ndarray) -> np.ndarray:
    """Return the cylinder's furthest point along each u [..., 3]."""
    k = radius / np.maximum(np.hypot(u[..., 0], u[..., 1]), 1e-300)
    return np.stack([k * u[..., 0], k * u[..., 1], np.where(u[..., 2] > 0, half, -half)], -1)


def _crosses(radius: float, half: float, u: np.ndarray, corners: np.ndarray) -> bool:
    """Return whether the polytope reaches into the cylinder's side of the gap that was found along u."""
    return bool((corners @ u).min() < (_furthest(radius, half, u) @ u) - 1e-9)


def _separate(radius, half, corners, edges, triangles) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the distance, direction, and the polytope's nearest point."""
    found = [corners]
    if len(edges):
        a, e = corners[edges[:, 0]], corners[edges[:, 1]] - corners[edges[:, 0]]
        low, high = np.zeros(len(e)), np.ones(len(e))
        for _ in range(HALVINGS):
            t = 0.5 * (low + high)
            grows = (e * _off(radius, half, a + t[:, None] * e)).sum(1) > 0
            low, high = np.where(grows, low, t), np.where(grows, t, high)
        found.append(a + (0.5 * (low + high))[:, None] * e)
    points = np.concatenate(found)
    off = _off(radius, half, points)
    dist = np.linalg.norm(off, axis=1)
    k = dist.argmin()
    best = (float(dist[k]), off[k] / max(float(dist[k]), 1e-300), points[k])
    if len(triangles):
        p = corners[triangles]
        n = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
        n *= np.sign((n * p[:, 0]).sum(1, keepdims=True)) / np.linalg.norm(n, axis=1, keepdims=True)
        y = _furthest(radius, half, n)
        gap = (n * (p[:, 0] - y)).sum(1)
        x = y + gap[:, None] * n
        side = [(n * np.cross(p[:, (j + 1) % 3] - p[:, j], x - p[:, j])).sum(1) for j in range(3)]
        within = (np.min(side, 0) >= 0) | (np.max(side, 0) <= 0)
        gap = np.where(within & (gap >= 0), gap, np.inf)
        k = gap.argmin()
        if gap[k] < best[0]:
            best = (float(gap[k]), n[k], x[k])
    return best


def _overlapping(radius, half, corners, edges, triangles) -> tuple[float, np.ndarray]:
    def depth(u: np.ndarray) -> np.ndarray:
        return (u * _furthest(radius, half, u)).sum(1) - (u @ corners.T).min(1)

    ways = [np.array([[0, 0, 1.0], [0, 0, -1.0]]), corners * [1, 1, 0]]
    if len(triangles):
        p = corners[triangles]
        ways.append(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]))
    if len(edges):
        a, e = corners[edges[:, 0]], corners[edges[:, 1]] - corners[edges[:, 0]]
        ways.append(np.cross(e, [0, 0, 1.0]))
        e = e / np.linalg.norm(e, axis=1, keepdims=True)
        first = np.cross(e, np.eye(3)[np.abs(e).argmin(1)])
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        second = np.cross(e, first)

        def turned(phi: np.ndarray, k) -> tuple[np.ndarray, np.ndarray]:
            c, s = np.cos(phi)[..., None], np.sin(phi)[..., None]
            return c * first[k] + s * second[k], c * second[k] - s * first[k]

        def slope(phi: np.ndarray, k) -> np.ndarray:
            """Return the slope of the depth of edge k's line, by the angle of the direction across it."""
            u, du = turned(phi, k)
            return (du * (_furthest(radius, half, u) - a[k])).sum(-1)

        grid = np.linspace(0, 2 * np.pi, SAMPLES + 1)
        s = np.stack([slope(np.full(len(e), g), np.arange(len(e))) for g in grid], 1)
        k, j = np.nonzero((s[:, :-1] < 0) & (s[:, 1:] >= 0))
        low, high = grid[j], grid[j + 1]
        for _ in range(HALVINGS):
            mid = 0.5 * (low + high)
            up = slope(mid, k) >= 0
            low, high = np.where(up, low, mid), np.where(up, mid, high)
        ways.append(turned(0.5 * (low + high), k)[0])
    u = np.concatenate([np.concatenate([w, -w]) for w in ways])
    size = np.linalg.norm(u, axis=1)
    u = u[size > 1e-12] / size[size > 1e-12, None]
    d = depth(u)
    k = d.argmin()
    return -float(d[k]), u[k]
