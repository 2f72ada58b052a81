"""The same laws in NumPy, float64, one plain line each: what the kernels are tested against."""

from __future__ import annotations

from collections.abc import Mapping

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
    top = np.array(grid.data.shape) - 1
    g = (q - grid.origin) / grid.spacing
    c = np.clip(g, 0, top)
    i = np.minimum(c.astype(int), top - 1)
    f = c - i
    v = np.zeros(q.shape[:-1])
    for corner in np.ndindex(2, 2, 2):
        w = np.where(corner, f, 1.0 - f).prod(-1)
        v += w * grid.data[tuple(np.moveaxis(i + corner, -1, 0))]
    gap = np.linalg.norm((g - c) * grid.spacing, axis=-1)
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


def normal(kind: str, size: np.ndarray, q: np.ndarray, grid: Grid | None = None, eps: float = 1e-6) -> np.ndarray:
    """Return outward unit normal [..., 3] at the nearest surface point: the gradient of the distance."""
    g = np.stack(
        [distance(kind, size, q + e, grid) - distance(kind, size, q - e, grid) for e in eps * np.eye(3)], axis=-1
    )
    return g / np.linalg.norm(g, axis=-1, keepdims=True)


# -- laws ----------------------------------------------------------------------------------------------------------


def linear_force(depth: np.ndarray, area: np.ndarray, stiffness: float) -> np.ndarray:
    return stiffness * area * np.maximum(depth, 0.0)


def hertz_force(depth: np.ndarray, area: np.ndarray, stiffness: float) -> np.ndarray:
    return stiffness * area * np.sqrt(np.maximum(depth, 0.0))


def mooney_rivlin_force(depth: np.ndarray, area: np.ndarray, thickness: float, c10: float, c01: float) -> np.ndarray:
    """Return uniaxial compression, stretch l = 1 - depth / thickness: pressure 2 (l^-2 - l) (c10 + c01 / l)."""
    stretch = 1.0 - np.minimum(np.maximum(depth, 0.0) / thickness, MAX_STRAIN)
    return area * 2.0 * (stretch**-2 - stretch) * (c10 + c01 / stretch)


def taxel_force(
    law: str, depth: np.ndarray, area: np.ndarray, stiffness: float, rubber: Mapping, threshold: float = 0.0
) -> np.ndarray:
    if law == "linear":
        f = linear_force(depth, area, stiffness)
    elif law == "hertz":
        f = hertz_force(depth, area, stiffness)
    else:
        f = stiffness * mooney_rivlin_force(depth, area, rubber["thickness"], rubber["c10"], rubber["c01"])
    return np.where(f <= threshold, 0.0, f)


def spread(force: float, d: np.ndarray, area: np.ndarray, reach: float) -> np.ndarray:
    """Share the solver's force among taxels at distances d: by area times squared depth under the level max(min d +
    reach, 0)."""
    w = area * np.maximum(np.maximum(d.min() + reach, 0.0) - d, 0.0) ** 2
    return force * w / w.sum()
