"""The irregular shapes: unions of at most three convex hulls of at most 32 corners, drawn by the formulas below.

Each function returns hulls in millimetres in any frame; `hulls_of` moves the centre of mass (uniform density) to the
origin, turns the principal axes onto x, y, z and scales the largest extent to 60 mm. Deterministic: random numbers
come from fixed seeds.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dexsim.assets.objects.geometry import hull_vertices, mass_properties, principal_axes, union_boundary

EXTENT = 0.060  # m, largest extent at scale 1

Hulls = list[np.ndarray]


def _box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], chamfer: float = 0.0) -> np.ndarray:
    """Return a box between the given bounds; with `chamfer` its twelve edges are cut (24 corners)."""
    low, high = np.array([x[0], y[0], z[0]]), np.array([x[1], y[1], z[1]])
    centre, half = (low + high) / 2, (high - low) / 2
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    if not chamfer:
        return centre + signs * half
    return centre + np.concatenate([signs * (half - chamfer * (1 - np.eye(3)[k])) for k in range(3)])


def _ring(n: int, radius: float, z: float, phase: float = 0.0) -> np.ndarray:
    angle = 2 * np.pi * (np.arange(n) + phase) / n
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(n, z)], axis=1)


def _sphere_points(n: int) -> np.ndarray:
    """Return `n` directions spread evenly over the sphere (Fibonacci lattice)."""
    k = np.arange(n) + 0.5
    z = 1 - 2 * k / n
    angle = np.pi * (1 + 5**0.5) * k
    return np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=1)


def rock() -> Hulls:
    """Return a stone: 30 directions, radius uneven by +-15 %, axes 30 : 25 : 21."""
    radius = 1 + 0.15 * (2 * np.random.default_rng(11).random(30) - 1)
    return [_sphere_points(30) * radius[:, None] * [30, 25, 21]]


def pebble() -> Hulls:
    """Return a flat stone, thicker on one side: 28 directions, axes 30 : 23 : 13."""
    radius = 1 + 0.10 * (2 * np.random.default_rng(5).random(28) - 1)
    points = _sphere_points(28)[:, [2, 0, 1]] * radius[:, None] * [30, 23, 13]
    points[:, 2] *= 1 + points[:, 0] / 80
    return [points]


def wedge() -> Hulls:
    """Return a ramp: a five-sided profile, narrower at the top."""
    profile = np.array([(-30, -16), (30, -16), (30, -6), (-14, 18), (-30, 18)], float)
    width = np.where(profile[:, 1] > 0, 15.0, 19.0)
    return [np.array([(x, s * w, z) for (x, z), w in zip(profile, width, strict=True) for s in (-1, 1)])]


def egg() -> Hulls:
    """Return an egg, blunt below: five rings of six, two poles on r(u) = 21.5 sqrt(1 - u^2) (1 - 0.18 u), z = 30 u."""
    rings = []
    for k, u in enumerate((-0.86, -0.48, 0.0, 0.46, 0.85)):
        rings.append(_ring(6, 21.5 * np.sqrt(1 - u**2) * (1 - 0.18 * u), 30 * u, phase=0.5 * (k % 2)))
    return [np.concatenate([*rings, [[0, 0, -30.0], [0, 0, 30.0]]])]


def hexprism() -> Hulls:
    """Return a hexagonal prism with chamfered ends."""
    return [np.concatenate([_ring(6, r, z) for r, z in ((17, -30), (21, -26), (21, 26), (17, 30))])]


def tetra() -> Hulls:
    """Return an uneven tetrahedron with its corners cut off, one of them less than the others."""
    corners = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]) * [30.0, 24.0, 27.0]
    points = []
    for i, a in enumerate(corners):
        cut = 0.16 if i == 0 else 0.24
        points += [a + cut * (b - a) for j, b in enumerate(corners) if j != i]
    return [np.array(points)]


def bracket() -> Hulls:
    """Return an L of two chamfered bars, 23 and 21 mm thick, 30 mm deep."""
    return [
        _box((-12, 46), (-12, 11), (-15, 15), chamfer=2.5),
        _box((-12, 9), (-12, 40), (-15, 15), chamfer=2.5),
    ]


def peanut() -> Hulls:
    """Return two unequal knobs on a waist."""
    big = _sphere_points(26)[:, [2, 0, 1]] * 19 + [-17, 0, 0]
    small = _sphere_points(24)[:, [2, 0, 1]] * 15.5 + [19, 0, 0]
    waist = np.concatenate([_ring(8, r, z) for r, z in ((13.5, -17), (11, 1), (11.5, 19))])[:, [2, 0, 1]]
    return [big, small, waist]


def tee() -> Hulls:
    """Return a T: a bar 60 mm wide on a stem."""
    return [
        _box((-30, 30), (0, 21), (-14, 14), chamfer=2.5),
        _box((-10.5, 10.5), (-32, 16), (-12, 12), chamfer=2.5),
    ]


def bolt() -> Hulls:
    """Return a thick hexagonal head on an eight-sided shank."""
    head = np.concatenate([_ring(6, r, z) for r, z in ((19, 10), (23, 13), (23, 27), (19, 30))])
    shank = np.concatenate([_ring(8, r, z) for r, z in ((10, -30), (12.5, -27), (12.5, 20))])
    return [head, shank]


def crescent() -> Hulls:
    """Return a banana: three bars along an arc of 150 degrees, tapering to the ends."""
    hulls = []
    nodes = np.radians([15, 65, 115, 165])
    section = np.array([(-1, -0.5), (-0.5, -1), (0.5, -1), (1, -0.5), (1, 0.5), (0.5, 1), (-0.5, 1), (-1, 0.5)])
    half = {0: 9.0, 1: 13.0, 2: 13.0, 3: 8.0}
    for k in range(3):
        points = []
        for node in (k, k + 1):
            radial = np.array([np.cos(nodes[node]), np.sin(nodes[node]), 0])
            across = half[node] * section
            points.append(30 * radial + across[:, :1] * radial + across[:, 1:] * [0, 0, 1.1])
        hulls.append(np.concatenate(points))
    return hulls


def cross() -> Hulls:
    """Return three unequal bars crossing at right angles, off each other's middle."""
    return [
        _box((-32, 28), (-11, 11), (-11.5, 11.5), chamfer=2.5),
        _box((-10, 12), (-24, 30), (-10.5, 10.5), chamfer=2.5),
        _box((-11, 11), (-10, 10.5), (-26, 22), chamfer=2.5),
    ]


def cylinder() -> Hulls:
    """Return a prism of 16 sides, 44 mm across and 60 mm high, of the volume of the round cylinder it stands for."""
    sides = 16
    radius = 22 * np.sqrt(2 * np.pi / sides / np.sin(2 * np.pi / sides))
    return [np.concatenate([_ring(sides, radius, z, phase=0.5) for z in (-30, 30)])]


# name -> (drawing, kept for evaluation only)
SHAPES: dict[str, tuple[Callable[[], Hulls], bool]] = {
    "cylinder": (cylinder, False),
    "rock": (rock, False),
    "wedge": (wedge, False),
    "egg": (egg, False),
    "hexprism": (hexprism, False),
    "bracket": (bracket, False),
    "peanut": (peanut, False),
    "tee": (tee, False),
    "bolt": (bolt, False),
    "tetra": (tetra, True),
    "pebble": (pebble, True),
    "crescent": (crescent, True),
    "cross": (cross, True),
}


def hulls_of(name: str) -> Hulls:
    """Return hulls (m, list of [V, 3], float64) of a shape: centre of mass at the origin, principal axes along x, y, z,
    largest extent 60 mm."""
    hulls = [hull_vertices(points) * 1e-3 for points in SHAPES[name][0]()]
    _, centre, inertia = mass_properties(union_boundary(hulls))
    axes = principal_axes(inertia)
    hulls = [(h - centre) @ axes for h in hulls]
    scale = EXTENT / np.ptp(np.concatenate(hulls), axis=0).max()
    return [h * scale for h in hulls]
