"""Random presses of objects on pads, in NumPy, over which touch is calibrated and judged; and its laws, one plain line
each, that the kernels are tested against."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from dexsim.assets.objects.shape import Grid, Shape
from dexsim.tactile.layout import TaxelLayout
from dexsim.tactile.pressing import Skin
from dexsim.tactile.reference import distance, mooney_rivlin_force


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
                d = distance(shape.kind, size, (skin.points - position) @ rotation, shape.grid)
                error = depth + d.min()
                if abs(error) < 1e-7:
                    break
                position = position - n * error
            ok &= abs(error) < 1e-5
            if depth == 0.0:
                at = skin.points[np.argmin(d)]
                ok &= np.linalg.norm(at - s) < 15e-3
            else:
                taxel_d = distance(shape.kind, size, (taxels - position) @ rotation, shape.grid)
                out.append(Press(shape.name, depth, at, rotation, position, taxel_d))
            if not ok:
                break
        if ok:
            done += 1
            yield from out


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


def normal(kind: str, size: np.ndarray, q: np.ndarray, grid: Grid | None = None, eps: float = 1e-6) -> np.ndarray:
    """Return outward unit normal [..., 3] at the nearest surface point: the gradient of the distance."""
    g = np.stack(
        [distance(kind, size, q + e, grid) - distance(kind, size, q - e, grid) for e in eps * np.eye(3)], axis=-1
    )
    return g / np.linalg.norm(g, axis=-1, keepdims=True)


def linear_force(depth: np.ndarray, area: np.ndarray, stiffness: float) -> np.ndarray:
    return stiffness * area * np.maximum(depth, 0.0)


def hertz_force(depth: np.ndarray, area: np.ndarray, stiffness: float) -> np.ndarray:
    return stiffness * area * np.sqrt(np.maximum(depth, 0.0))


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
