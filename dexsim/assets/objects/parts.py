"""Distances to a solid that a decomposition cut into convex parts, which touch without overlapping: the cuts are no
surface. (`geometry.signed_distance` is exact, for a few hulls that overlap where they should be solid.)"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from dexsim.assets.objects.baking import MARGIN, sampled
from dexsim.assets.objects.shape import Grid
from dexsim.surface import across, spread

SEAM = 3e-4
"""m: a face's point that is nearer than this to another part, or in it, belongs to a cut."""
STEP = 5e-4  # m between the points that stand for the surface


def distance(hulls: Sequence[np.ndarray], points: np.ndarray) -> np.ndarray:
    """Return signed distance [P] m (negative inside) of points [P, 3] to the union of hulls [V, 3].

    Outside it is the largest distance to the planes of the nearest part: exact over faces, a lower bound near edges.
    Inside it is that to the nearest point of the surface, cuts left out, within 0.2 mm.
    """
    planes = [ConvexHull(h).equations for h in hulls]
    over = np.min([_height(points, p) for p in planes], axis=0)
    inside = over < 0
    if inside.any():
        surface = boundary(hulls, STEP)
        far = cKDTree(surface).query(points[inside])[0]
        # a ball as deep as a part's nearest plane fits into that part: where that explains the distance, it is exact
        own = -over[inside]
        over[inside] = -np.where(far - own < SEAM, own, far)
    return over


def _height(points: np.ndarray, planes: np.ndarray) -> np.ndarray:
    out = np.empty(len(points))
    for at in range(0, len(points), 65536):
        part = slice(at, at + 65536)
        out[part] = (points[part] @ planes[:, :3].T + planes[:, 3]).max(axis=1)
    return out


def boundary(hulls: Sequence[np.ndarray], step: float, seed: int = 0) -> np.ndarray:
    """Points [P, 3] of the union's surface, about `step` m apart."""
    rng = np.random.default_rng(seed)
    full = [ConvexHull(h) for h in hulls]
    out = []
    for k, (hull, corners) in enumerate(zip(full, hulls)):
        triangles = corners[hull.simplices]
        count = int(np.ceil(np.linalg.norm(across(triangles), axis=1).sum() / step**2))
        points = np.concatenate([corners, spread(triangles, count, rng)[0]])
        hidden = np.zeros(len(points), bool)
        for n, other in enumerate(full):
            if n != k:
                hidden |= _height(points, other.equations) < SEAM
        out.append(points[~hidden])
    return np.concatenate(out)


def grid(hulls: Sequence[np.ndarray], spacing: float, margin: float = MARGIN) -> Grid:
    """Return the grid of `distance`."""
    return sampled(partial(distance, hulls), hulls, spacing, margin)


def grid_error(hulls: Sequence[np.ndarray], baked: Grid, band: float = 2e-3, n: int = 4000) -> tuple[float, float]:
    """Mean and largest |grid - distance| (m) at random points within `band` of the surface."""
    rng = np.random.default_rng(0)
    surface = boundary(hulls, 2e-3)
    points = surface[rng.integers(len(surface), size=n)]
    way = rng.normal(size=(n, 3))
    points = points + way / np.linalg.norm(way, axis=1, keepdims=True) * rng.uniform(0, band, (n, 1))
    error = np.abs(baked.sample(points) - distance(hulls, points))
    return float(error.mean()), float(error.max())
