"""Random presses of objects on pads, in NumPy: the poses over which touch is calibrated and judged."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dexsim.assets.objects.shape import Shape
from dexsim.tactile import reference as ref
from dexsim.tactile.layout import TaxelLayout, gap_to_hull


@dataclass(frozen=True)
class Press:
    """An object against a pad, in the pad's body frame.

    depth: of the skin's deepest point in the object [m]. at [3]: that point at first touch. rotation, position: the
    object's frame. d [T]: signed distances of the pad's taxels [m].
    """

    shape: str
    depth: float
    at: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    d: np.ndarray


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


def surface_points(rng: np.random.Generator, shape: Shape, size: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield random points of an object's surface, by area, and the outward normals there (object frame), without
    end."""
    kind = shape.kind
    if kind == "grid":
        from dexsim.assets.objects.geometry import union_boundary

        tri = union_boundary(shape.hulls)
        n = np.cross(tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0])
        area = np.linalg.norm(n, axis=1)
        while True:
            i = rng.choice(len(tri), p=area / area.sum())
            yield rng.dirichlet(np.ones(3)) @ tri[i] * size[0], n[i] / area[i]
    r, half = size[0], size[1]
    while True:
        if kind == "box":
            a, b, c = size
            axis = rng.choice(3, p=np.array([b * c, a * c, a * b]) / (a * b + b * c + a * c))
            n = rng.choice([-1.0, 1.0]) * np.eye(3)[axis]
            yield np.where(np.abs(n) > 0, n * size, rng.uniform(-1, 1, 3) * size), n
            continue
        n = rng.normal(size=3)
        n /= np.linalg.norm(n)
        if kind == "sphere":
            yield n * r, n
            continue
        end = rng.random() < r / (r + 2 * half) if kind == "cylinder" else rng.random() < r / (r + half)
        if kind == "capsule" and end:
            yield n * r + [0.0, 0.0, half * np.sign(n[2])], n
        elif end:
            e, s = n[:2] / np.hypot(*n[:2]) * r * np.sqrt(rng.random()), np.sign(n[2])
            yield np.array([*e, s * half]), np.array([0.0, 0.0, s])
        else:
            e = np.array([*n[:2] / np.hypot(*n[:2]), 0.0])
            yield e * r + [0.0, 0.0, rng.uniform(-half, half)], e


def presses(
    rng: np.random.Generator,
    layout: TaxelLayout,
    pad: int,
    skin: Skin,
    shape: Shape,
    size: np.ndarray,
    depths: tuple[float, ...],
    count: int,
    tilt: float = np.radians(10.0),
) -> Iterator[Press]:
    """Return `count` random presses of a shape (of `dexsim.assets.objects`) at each of the depths.

    A point of the object's surface, by area, meets a point of the skin, by area, with normals opposed up to `tilt`
    [rad] and any spin; the object then moves along the skin's normal until the skin's deepest point is at each depth.
    Poses that touch elsewhere first (more than 15 mm away) are drawn again.
    """
    taxels = layout.point[pad, : layout.count[pad]]
    points = surface_points(rng, shape, size)
    done = 0
    for _ in range(50 * count):
        if done == count:
            return
        i = rng.choice(len(skin.points), p=skin.area)
        s, n = skin.points[i], skin.normals[i]
        p, m = next(points)
        rotation = _turn(rng, tilt * np.sqrt(rng.random())) @ _onto(m, -n, rng)
        position = s - rotation @ p
        ok = True
        out = []
        for depth in (0.0, *depths):
            for _ in range(12):
                d = ref.distance(shape.kind, size, (skin.points - position) @ rotation, shape.grid)
                error = depth + d.min()
                if abs(error) < 1e-7:
                    break
                position = position - n * error
            ok &= abs(error) < 1e-5
            if depth == 0.0:
                at = skin.points[np.argmin(d)]
                ok &= np.linalg.norm(at - s) < 15e-3
            else:
                taxel_d = ref.distance(shape.kind, size, (taxels - position) @ rotation, shape.grid)
                out.append(Press(shape.name, depth, at, rotation, position, taxel_d))
            if not ok:
                break
        if ok:
            done += 1
            yield from out


def _chord(p: np.ndarray, axis: int) -> np.ndarray:
    step = np.linalg.norm(np.diff(p, axis=axis), axis=-1).mean(axis=1 - axis)
    return np.concatenate([[0.0], np.cumsum(step)])


def _onto(a: np.ndarray, b: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a rotation that takes unit vector a to b, with random spin about b."""

    def frame(z: np.ndarray, x: np.ndarray) -> np.ndarray:
        x = x - (x @ z) * z
        x /= np.linalg.norm(x)
        return np.stack([x, np.cross(z, x), z], axis=1)

    return frame(b, rng.normal(size=3)) @ frame(a, rng.normal(size=3)).T


def _turn(rng: np.random.Generator, angle: float) -> np.ndarray:
    axis = rng.normal(size=3)
    x, y, z = axis / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
