"""Solids by the hundred to train a grasp on: tapered prisms, barrels, sheared boxes, stepped prisms and angled bars.

Drawn by number, so that shape 17 is the same everywhere. None is of a family that is kept out of training or judged
by: tetrahedra, stones, arcs, crosses, superellipsoids, random polyhedra (`benchmarks/unseen_shapes.py`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dexsim.assets.objects.geometry import hull_vertices, mass_properties, principal_axes, union_boundary

EXTENT = 0.060  # m, largest extent at scale 1, as of the library's
SPACING = 2e-3  # m, of the distance grid: its mean error is 0.03 mm, and it is baked in a tenth of a second
MOST, GENERATED = 512, "generated_"  # how many there are; their names' first part
Hulls = list[np.ndarray]


def _ring(n: int, radius: float, z: float) -> np.ndarray:
    angle = 2 * np.pi * np.arange(n) / n
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(n, z)], 1)


def _bar(half: np.ndarray, chamfer: float = 0.06) -> np.ndarray:
    """Return a box of half lengths [3] about the origin, its twelve edges cut off."""
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    return np.concatenate([signs * (half - chamfer * (1 - np.eye(3)[k])) for k in range(3)])


def _prism(rng: np.random.Generator) -> Hulls:
    n, top, flat = int(rng.integers(3, 9)), rng.uniform(0.6, 1.0), np.array([1.0, rng.uniform(0.75, 1.0), 1.0])
    rings = [_ring(n, r, z) for r, z in ((0.85, -1.0), (1.0, -0.85), (top, 0.85), (0.85 * top, 1.0))]
    height = rng.uniform(0.55, 1.5)
    return [np.concatenate(rings) * flat * [1, 1, height]]


def _barrel(rng: np.random.Generator) -> Hulls:
    radius = np.sort(rng.uniform(0.55, 1.0, 4))[[0, 2, 3, 1]]
    rings = [_ring(7, r, z) for r, z in zip(radius, (-1.0, -0.4, 0.35, 1.0), strict=True)]
    return [np.concatenate(rings) * [1, rng.uniform(0.75, 1.0), rng.uniform(0.7, 1.5)]]


def _sheared(rng: np.random.Generator) -> Hulls:
    turn = np.eye(3)
    turn[0, 1:] = rng.uniform(-0.35, 0.35, 2)
    return [_bar(rng.uniform(0.6, 1.0, 3)) @ turn]


def _stepped(rng: np.random.Generator) -> Hulls:
    n, thin, rise = int(rng.integers(4, 9)), rng.uniform(0.5, 0.8), rng.uniform(0.3, 0.9)
    head = np.concatenate([_ring(n, r, z) for r, z in ((0.85, 0.0), (1.0, 0.12), (1.0, rise), (0.85, rise + 0.12))])
    shank = np.concatenate([_ring(8, r, z) for r, z in ((0.8 * thin, -1.2), (thin, -1.08), (thin, 0.1))])
    return [head, shank]


def _angled(rng: np.random.Generator) -> Hulls:
    a, b = rng.uniform(0.38, 0.55, (2, 3))
    a[0], b[2] = 1.0, rng.uniform(0.6, 0.9)
    shift = np.array([rng.uniform(-0.9, 0.9) * (1 - b[0]), 0.0, b[2]])
    return [_bar(a), _bar(b) + shift]


FAMILIES: tuple[Callable[[np.random.Generator], Hulls], ...] = (_prism, _barrel, _sheared, _stepped, _angled)


def generated(number: int) -> Hulls:
    """Return the hulls (m, list of [V, 3]) of solid `number` (0 and more): its family by turns, its measures drawn.

    Frame and size as of the library: centre of mass at the origin, principal axes along x, y, z, largest extent 60 mm.
    """
    hulls = [hull_vertices(points) for points in FAMILIES[number % len(FAMILIES)](np.random.default_rng([49, number]))]
    _, centre, inertia = mass_properties(union_boundary(hulls))
    axes = principal_axes(inertia)
    hulls = [(h - centre) @ axes for h in hulls]
    scale = EXTENT / np.ptp(np.concatenate(hulls), axis=0).max()
    return [h * scale for h in hulls]
