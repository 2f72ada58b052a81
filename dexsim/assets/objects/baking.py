"""From hulls to a `Shape`: mass properties and the distance grid, and the compact form of both on disk."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from dexsim.assets.objects.geometry import mass_properties, signed_distance, union_boundary
from dexsim.assets.objects.shape import Grid, Shape
from dexsim.surface import spread

SPACING = 1.25e-3  # m between samples
MARGIN = 9e-3  # m of grid beyond the shape on every side
UNIT = 2e-6  # m, step of the stored distances (16 bits reach 65 mm)


def bake_grid(hulls: Sequence[np.ndarray], spacing: float = SPACING, margin: float = MARGIN) -> Grid:
    """Return the grid of exact distances to the union of `hulls`, rounded to `UNIT`."""
    return sampled(lambda points: np.round(signed_distance(hulls, points) / UNIT) * UNIT, hulls, spacing, margin)


def sampled(
    distance: Callable[[np.ndarray], np.ndarray], hulls: Sequence[np.ndarray], spacing: float, margin: float
) -> Grid:
    """Return a grid of distance(points [P, 3]) [P] m around hulls [V, 3]."""
    points = np.concatenate(hulls)
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    shape = np.ceil((high - low) / spacing).astype(int) + 1
    origin = (low + high) / 2 - spacing * (shape - 1) / 2
    axes = [origin[k] + spacing * np.arange(shape[k]) for k in range(3)]
    samples = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return Grid(origin, spacing, distance(samples).reshape(shape).astype(np.float32))


def grid_error(hulls: Sequence[np.ndarray], grid: Grid, band: float = 2e-3, n: int = 4000) -> tuple[float, float]:
    """Mean and largest |grid - exact| (m) at random points within `band` of the surface.

    The largest lies at sharp edges, where the distance has a kink inside one cell (about 0.3 cells at a right angle).
    """
    rng = np.random.default_rng(0)
    on = spread(union_boundary(hulls), n, rng)[0]
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = on + direction * rng.uniform(0, band, (n, 1))
    error = np.abs(grid.sample(points) - signed_distance(hulls, points))
    return float(error.mean()), float(error.max())


def shape_from_hulls(name: str, hulls: list[np.ndarray], held_out: bool = False, spacing: float = SPACING) -> Shape:
    """Return a `Shape` of kind "grid" from hulls [V, 3] (m) that are in the shape frame already."""
    # What is stored and what is baked must be the same numbers, so round to float32 first.
    hulls = [np.asarray(h, np.float32).astype(float) for h in hulls]
    volume, _, inertia = mass_properties(union_boundary(hulls))
    grid = bake_grid(hulls, spacing)
    return Shape(
        name=name, kind="grid", held_out=held_out, hulls=hulls, grid=grid, volume=volume, inertia_unit=inertia,
        extents=np.ptp(np.concatenate(hulls), axis=0), grid_error=grid_error(hulls, grid),
    )  # fmt: skip


def pack(shape: Shape) -> dict[str, np.ndarray]:
    """Return arrays to store for a shape of kind "grid".

    The distances are whole `UNIT`s in 16 bits; second differences (along x, then y) leave small numbers wherever
    the distance is linear, which is what makes the file compress.
    """
    assert shape.grid is not None  # a shape of kind "grid" has one
    units = np.round(shape.grid.data.astype(float) / UNIT)
    if np.abs(units).max() > 32767:
        raise ValueError(f"shape {shape.name}: distances beyond 65 mm do not fit the stored 16 bits")
    code = units.astype(np.int16)
    for axis in (0, 1):
        code = np.diff(code, axis=axis, prepend=np.int16(0))
    # The high and the low bytes apart compress better than in turns.
    split = np.ascontiguousarray(code).view(np.uint8).reshape(*code.shape, 2)
    return {
        "held_out": np.array(shape.held_out), "hulls": np.concatenate(shape.hulls).astype(np.float32),
        "hull_sizes": np.array([len(h) for h in shape.hulls], np.int32), "volume": np.array(shape.volume),
        "inertia_unit": shape.inertia_unit, "origin": shape.grid.origin, "spacing": np.array(shape.grid.spacing),
        "grid_error": np.array(shape.grid_error), "data_low": np.ascontiguousarray(split[..., 0]),
        "data_high": np.ascontiguousarray(split[..., 1]),
    }  # fmt: skip


def unpack(name: str, stored: dict[str, np.ndarray]) -> Shape:
    """Return the shape that `pack` stored."""
    hulls = np.split(stored["hulls"].astype(float), np.cumsum(stored["hull_sizes"])[:-1])
    code = (stored["data_high"].astype(np.uint16) << 8 | stored["data_low"]).view(np.int16)
    for axis in (1, 0):
        code = np.cumsum(code, axis=axis, dtype=np.int16)
    data = (code.astype(float) * UNIT).astype(np.float32)
    mean, largest = (float(e) for e in stored["grid_error"])
    return Shape(
        name=name, kind="grid", held_out=bool(stored["held_out"]), hulls=hulls,
        grid=Grid(stored["origin"], float(stored["spacing"]), data), volume=float(stored["volume"]),
        inertia_unit=stored["inertia_unit"], extents=np.ptp(np.concatenate(hulls), axis=0), grid_error=(mean, largest),
    )  # fmt: skip
