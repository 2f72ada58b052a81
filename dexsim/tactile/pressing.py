"""The surface of a pad, finer than its taxels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dexsim.tactile.layout import TaxelLayout, gap_to_hull


@dataclass(frozen=True)
class Skin:
    """Dense samples of a pad's surface, body frame: points [n, 3], unit normals [n, 3], area of each [n]."""

    points: np.ndarray
    normals: np.ndarray
    area: np.ndarray


def skin_of(
    layout: TaxelLayout, pad: int, columns: int, rows: int, tip: np.ndarray | None = None, fine: int = 6
) -> Skin:
    """Return the pad's skin, interpolated bicubically between its lattice of columns x rows taxels, `fine` times finer;
    moved along its normals onto the convex hull of `tip` [V, 3] (body frame) where given: what the physics presses."""
    from scipy.interpolate import RectBivariateSpline

    p = layout.point[pad, : layout.count[pad]].reshape(columns, rows, 3)
    u, v = (_chord(p, axis) for axis in (0, 1))
    uu, vv = np.linspace(0, u[-1], fine * (columns - 1) + 1), np.linspace(0, v[-1], fine * (rows - 1) + 1)
    s = [RectBivariateSpline(u, v, p[..., i], s=0) for i in range(3)]
    point, du, dv = (np.stack([f(uu, vv, dx=a, dy=b) for f in s], -1) for a, b in ((0, 0), (1, 0), (0, 1)))
    n = np.cross(du, dv)
    size = np.linalg.norm(n, axis=-1)
    # the thumb's outermost corners have no well-defined normal: leave such points out
    good = size > 0.2 * np.linalg.norm(du, axis=-1) * np.linalg.norm(dv, axis=-1)
    point, n, area = point[good], (n / size[..., None])[good], size[good] / size[good].sum()
    if n.mean(0) @ layout.normal[pad, : layout.count[pad]].mean(0) < 0:  # of a mirrored pad the lattice is left-handed
        n = -n
    if tip is not None:
        point = point + n * gap_to_hull(point, n, tip)[:, None]
    return Skin(point, n, area)


def _chord(p: np.ndarray, axis: int) -> np.ndarray:
    step = np.linalg.norm(np.diff(p, axis=axis), axis=-1).mean(axis=1 - axis)
    return np.concatenate([[0.0], np.cumsum(step)])
