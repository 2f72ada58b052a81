"""What the rest of dexsim knows of an object: `Shape` and its distance `Grid`."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

MAX_VERTICES, MAX_HULLS = 32, 3
"""Of a hull, and of a shape: what the kernels of collision and touch hold."""


@dataclass(frozen=True)
class Grid:
    """Signed distance (m, negative inside) sampled on a regular grid in the shape frame at scale 1.

    Sample [i, j, k] lies at `origin` + `spacing` * (i, j, k). At uniform scale s, the distance at x is s * d(x / s).
    """

    origin: np.ndarray  # [3] m, float64
    spacing: float  # m, the same along x, y, z
    data: np.ndarray  # [nx, ny, nz] m, float32

    def sample(self, points: np.ndarray) -> np.ndarray:
        """Return distance [P] at points [P, 3] by trilinear interpolation; points beyond the grid read its border."""
        top = np.array(self.data.shape) - 1
        u = np.clip((np.asarray(points, float) - self.origin) / self.spacing, 0, top)
        cell = np.minimum(u.astype(int), top - 1)
        f = u - cell
        value = np.zeros(len(u))
        for corner in np.ndindex(2, 2, 2):
            weight = np.where(corner, f, 1 - f).prod(axis=1)
            value += weight * self.data[tuple((cell + corner).T)]
        return value

    def gradient(self, points: np.ndarray) -> np.ndarray:
        """Return gradient [P, 3] of `sample` by central differences over half a cell either way (1 / unit length)."""
        step = 0.5 * self.spacing
        points = np.asarray(points, float)
        return np.stack([(self.sample(points + d) - self.sample(points - d)) / (2 * step) for d in step * np.eye(3)], 1)


@dataclass(frozen=True)
class Shape:
    """One object shape. The shape frame has its origin at the centre of mass (uniform density); x, y, z are the
    principal axes of inertia. All figures are for scale 1; at uniform scale s lengths take s, `volume` s^3 and
    `inertia_unit` s^2.

    kind "box", "sphere", "capsule": `size` holds MuJoCo's sizes (box: half lengths; sphere: radius; capsule: radius
    and half length of the straight part, along z), no hulls, no grid. kind "grid": the union of `hulls` for contact,
    and `grid`, baked from those same hulls, for touch.
    """

    name: str
    kind: str
    held_out: bool  # kept for evaluation, never trained on
    hulls: list[np.ndarray]  # of [V, 3] m, V <= 32, each the corners of a convex polyhedron
    grid: Grid | None
    volume: float  # m^3
    inertia_unit: np.ndarray  # [3, 3] m^2: inertia about the centre of mass per kg
    extents: np.ndarray  # [3] m, size of the bounding box
    size: np.ndarray = field(default_factory=lambda: np.zeros(3))  # [3] m, primitives only
    grid_error: tuple[float, float] = (0.0, 0.0)  # m, mean and largest |grid - exact| within 2 mm of the surface
    true_size: bool = False  # of a user's own: scenes take it at scale 1, not at the task's sizes
    notes: tuple[str, ...] = ()  # what was approximated, for a person to read
    # A point x of the file that the shape came from is (x * file_scale - file_centre) @ file_axes in the shape frame.
    file_centre: np.ndarray = field(default_factory=lambda: np.zeros(3))  # [3] m
    file_axes: np.ndarray = field(default_factory=lambda: np.eye(3))  # [3, 3], columns are the shape's axes
    file_scale: float = 1.0


def primitive_mass_properties(kind: str, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return volume [...] (m^3) and diagonal inertia per kg [..., 3] (m^2) of solid primitives of `size` [..., 3] (m).

    Sizes as in MuJoCo. Box: (b^2 + c^2) / 3 for half lengths b, c. Sphere: 2 r^2 / 5. Capsule of radius r and half
    length h: a cylinder and two half spheres, whose centres lie 3 r / 8 beyond its ends.
    """
    size = np.asarray(size, float)
    a, b, c = size[..., 0], size[..., 1], size[..., 2]
    if kind == "box":
        return 8 * a * b * c, np.stack([b**2 + c**2, a**2 + c**2, a**2 + b**2], axis=-1) / 3
    if kind == "sphere":
        return 4 / 3 * np.pi * a**3, np.stack([0.4 * a**2] * 3, axis=-1)
    if kind == "capsule":
        tube, ball = 2 * np.pi * a**2 * b, 4 / 3 * np.pi * a**3
        along = tube * a**2 / 2 + ball * 0.4 * a**2
        across = tube * (a**2 / 4 + b**2 / 3) + ball * (0.4 * a**2 + b**2 + 0.75 * a * b)
        return tube + ball, np.stack([across, across, along], axis=-1) / (tube + ball)[..., None]
    raise ValueError(f"kind {kind!r} is no primitive; primitives: box, sphere, capsule")
