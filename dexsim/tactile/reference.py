"""Distances and the rubber of touch in NumPy, float64: what a diagnosis reads touch with."""

from __future__ import annotations

import numpy as np

from dexsim.assets.objects.shape import Grid
from dexsim.tactile.kernel import MAX_STRAIN

# -- signed distances (points q [..., 3] in the shape's frame; sizes as MuJoCo's) ------------------------------------


def sd_box(q: np.ndarray, half: np.ndarray) -> np.ndarray:
    x = np.abs(q) - half
    return np.linalg.norm(np.maximum(x, 0.0), axis=-1) + np.minimum(x.max(-1), 0.0)


def sd_sphere(q: np.ndarray, radius: float) -> np.ndarray:
    return np.linalg.norm(q, axis=-1) - radius


def sd_capsule(q: np.ndarray, radius: float, half: float) -> np.ndarray:
    z = q[..., 2] - np.clip(q[..., 2], -half, half)
    return np.sqrt(q[..., 0] ** 2 + q[..., 1] ** 2 + z**2) - radius


def sd_cylinder(q: np.ndarray, radius: float, half: float) -> np.ndarray:
    r, z = np.hypot(q[..., 0], q[..., 1]) - radius, np.abs(q[..., 2]) - half
    return np.hypot(np.maximum(r, 0.0), np.maximum(z, 0.0)) + np.minimum(np.maximum(r, z), 0.0)


def sd_grid(q: np.ndarray, grid: Grid) -> np.ndarray:
    """Interpolate trilinearly; outside the grid sqrt(gap^2 + value at the nearest point of the box ^2)."""
    q = np.asarray(q, dtype=float)
    end = grid.origin + grid.spacing * (np.array(grid.data.shape) - 1)
    gap = np.linalg.norm(q - np.clip(q, grid.origin, end), axis=-1)
    v = grid.sample(q.reshape(-1, 3)).reshape(q.shape[:-1])
    return np.where(gap > 0.0, np.hypot(gap, np.maximum(v, 0.0)), v)


def distance(kind: str, size: np.ndarray, q: np.ndarray, grid: Grid | None = None) -> np.ndarray:
    """Return signed distance [m]; size as in `dexsim.tactile.sdf`."""
    if kind == "box":
        return sd_box(q, np.asarray(size))
    if kind == "sphere":
        return sd_sphere(q, size[0])
    if kind == "capsule":
        return sd_capsule(q, size[0], size[1])
    if kind == "cylinder":
        return sd_cylinder(q, size[0], size[1])
    assert grid is not None  # kind "grid" has one
    return size[0] * sd_grid(q / size[0], grid)


def mooney_rivlin_force(depth: np.ndarray, area: np.ndarray, thickness: float, c10: float, c01: float) -> np.ndarray:
    """Return uniaxial compression, stretch l = 1 - depth / thickness: pressure 2 (l^-2 - l) (c10 + c01 / l)."""
    stretch = 1.0 - np.minimum(np.maximum(depth, 0.0) / thickness, MAX_STRAIN)
    return area * 2.0 * (stretch**-2 - stretch) * (c10 + c01 / stretch)
