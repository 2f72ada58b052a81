"""Visual meshes of the hand, all drawn by this code: convex rounded shells and lofted fingertip skins.

The link bounds in `bodies.csv` are measured; everything about the shapes inside them is our own drawing.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from dexsim.surface import hull as hull_mesh

Mesh = tuple[np.ndarray, np.ndarray]  # vertices [n, 3] m, triangles [m, 3]


def _ball(radius: float, around: int = 20, levels: int = 7) -> np.ndarray:
    t = np.linspace(0, 2 * np.pi, around, endpoint=False)
    out = []
    for p in np.linspace(-np.pi / 2, np.pi / 2, levels):
        ring = np.stack([np.cos(t) * np.cos(p), np.sin(t) * np.cos(p), np.full_like(t, np.sin(p))], axis=1)
        out.append(ring if abs(p) < 1.57 else ring[:1])
    return radius * np.concatenate(out)


def rounded(corners: Iterable[Iterable[float]], radius: float) -> Mesh:
    """Return the hull of balls at the corners, whose surface therefore lies `radius` outside the corners."""
    corners = np.asarray(list(corners), dtype=float)
    return hull_mesh((corners[:, None, :] + _ball(radius)[None]).reshape(-1, 3))


def rounded_box(low: Iterable[float], high: Iterable[float], radius: float) -> Mesh:
    """Return a box between two corners with its edges rounded."""
    low, high = np.asarray(list(low)) + radius, np.asarray(list(high)) - radius
    grid = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    return rounded(grid, radius)


def slab(outline: Iterable[Iterable[float]], low: float, high: float, radius: float) -> Mesh:
    """Return a convex outline [(y, z), ...] (outer dimensions) extruded along x from low to high, edges rounded."""
    outline = np.asarray(list(outline), dtype=float)
    middle = outline.mean(axis=0)
    away = outline - middle
    inset = middle + away * (1 - radius / np.linalg.norm(away, axis=1, keepdims=True))
    return rounded([[x, *p] for x in (low + radius, high - radius) for p in inset], radius)


def ear(circle: tuple[float, float], radius: float, root: Iterable[Iterable[float]], low: float, high: float,
        axis: int) -> Mesh:
    """Return a hinge plate: a disc around `circle` joined to root points, both across `axis`, low..high thick."""
    t = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    flat = np.concatenate([np.array(circle) + radius * np.stack([np.cos(t), np.sin(t)], axis=1), np.array(list(root))])
    return hull_mesh(np.concatenate([np.insert(flat, axis, value, axis=1) for value in (low, high)]))


def loft(outer: np.ndarray, normal: np.ndarray, thickness: float) -> Mesh:
    """Return a closed sheet between a grid of surface points [nu, nv, 3] and the same moved in along the normals."""
    nu, nv = outer.shape[:2]
    vertices = np.concatenate([outer.reshape(-1, 3), (outer - thickness * normal).reshape(-1, 3)])
    index = np.arange(nu * nv).reshape(nu, nv)
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    top = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    rim = np.concatenate([index[:, 0], index[-1, 1:], index[-2::-1, -1], index[0, -2:0:-1]])
    after = np.roll(rim, -1)
    n = nu * nv
    side = np.concatenate([np.stack([rim, rim + n, after], 1), np.stack([after, rim + n, after + n], 1)])
    return vertices, np.concatenate([top, top[:, ::-1] + n, side])


def write_obj(path: Path, mesh: Mesh, note: str) -> None:
    """Write Wavefront OBJ, metres, 1 micrometre grid."""
    vertices, faces = mesh
    with open(path, "w", encoding="ascii") as f:
        f.write(f"# {note}\n")
        f.writelines(f"v {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in vertices + 0.0)
        f.writelines(f"f {a} {b} {c}\n" for a, b, c in faces + 1)
