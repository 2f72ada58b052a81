"""What touch needs to know of objects: kinds, and baked distance grids, flat on the device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from dexsim.assets.objects.shape import Grid, Shape
from dexsim.errors import UserError
from dexsim.tactile.sdf import KINDS, Shapes


@dataclass(frozen=True)
class TouchShape:
    """name; kind: "box", "sphere", "capsule", "cylinder" or "grid"; grid: for kind "grid" only."""

    name: str
    kind: str
    grid: Grid | None = None


Felt = TouchShape | Shape


class ShapeSet:
    """Shapes by index, in the order given.

    shapes: `TouchShape`s or objects of `dexsim.assets.objects` (anything with name, kind, grid). Fails with UserError
    on an unknown kind or a grid that does not hold its shape.
    """

    def __init__(self, shapes: Sequence[Felt], device: str = "cpu"):
        self.names = tuple(s.name for s in shapes)
        self.kinds = np.array([_kind(s) for s in shapes], dtype=np.int32)
        self.grids: list[Grid | None] = []
        dims, origin, spacing, offset, radius, middle, half = [], [], [], [], [], [], []
        seen, self.cells, data = _laid_out([s for s in shapes if s.kind == "grid"], device)
        for s in shapes:
            grid = None
            d, o, h = (2, 2, 2), np.zeros(3), 1.0
            bound = (0.0, np.zeros(3), np.zeros(3))
            if s.kind == "grid":
                start, grid, bound = seen[id(s.grid)]
                d, o, h = grid.data.shape, grid.origin, grid.spacing
            self.grids.append(grid)
            dims.append(d)
            origin.append(o)
            spacing.append(h)
            radius.append(bound[0])
            middle.append(bound[1])
            half.append(bound[2])
            offset.append(start if grid is not None else 0)
        self.device = device
        out = Shapes()
        with wp.ScopedDevice(device):
            out.kind = wp.array(self.kinds, dtype=int)
            out.dims = wp.array(np.array(dims, dtype=np.int32).reshape(-1, 3), dtype=wp.vec3i)
            out.origin = wp.array(np.array(origin, dtype=np.float32).reshape(-1, 3), dtype=wp.vec3)
            out.spacing = wp.array(np.array(spacing, dtype=np.float32), dtype=float)
            out.offset = wp.array(np.array(offset, dtype=np.int32), dtype=int)
            out.radius = wp.array(np.array(radius, dtype=np.float32), dtype=float)
            out.middle = wp.array(np.array(middle, dtype=np.float32).reshape(-1, 3), dtype=wp.vec3)
            out.half = wp.array(np.array(half, dtype=np.float32).reshape(-1, 3), dtype=wp.vec3)
            out.data = data
        self.wp = out

    def index(self, name: str) -> int:
        """Index of the shape of this name."""
        if name not in self.names:
            raise UserError(f"no touch shape '{name}'; there are: {', '.join(self.names)}")
        return self.names.index(name)


_LaidOut = tuple[dict[int, tuple[int, Grid, tuple]], int, wp.array]
_cached_grids: dict[tuple, tuple[list[Grid | None], _LaidOut]] = {}
"""What was last laid out, with its grids, and for whom: tens of megabytes, which every environment of a process asks
for again of the same objects and fingertips."""
CACHED = 2


def _laid_out(shapes: list[Felt], device: str) -> _LaidOut:
    """Lay out, by the identity of each grid (variants of one shape share it) where its cells begin, the grid and what
    bounds its surface; the number of cells; all of them on the device, not to be written to."""
    key = (device, *(id(s.grid) for s in shapes))
    if key in _cached_grids:
        return _cached_grids[key][1]
    seen: dict[int, tuple[int, Grid, tuple]] = {}
    data: list[np.ndarray] = []
    at = 0
    for s in shapes:
        if id(s.grid) not in seen:
            grid = _checked(s)
            seen[id(s.grid)] = (at, grid, _surface_bound(grid))
            data.append(_cells(grid.data))
            at += len(data[-1]) // 2
    if at >= 2**30:
        raise UserError(f"distance grids hold {at} cells, at most {2**30 - 1} fit: use fewer or coarser ones")
    flat = np.concatenate(data) if data else np.zeros((2, 4), np.float32)
    found: _LaidOut = (seen, at, wp.array(flat, dtype=wp.vec4, device=device))
    if data and not any(s.grid.data.flags.writeable for s in shapes if s.grid is not None):  # others may change
        while len(_cached_grids) >= CACHED:
            del _cached_grids[next(iter(_cached_grids))]
        _cached_grids[key] = [s.grid for s in shapes], found
    return found


def bake_convex(points: np.ndarray, spacing: float = 0.5e-3, margin: float = 2e-3) -> Grid:
    """Return distance grid [m] of the convex hull of points [n, 3]: exact inside (largest of the face planes'
    distances) and on faces; near an edge outside it is a lower bound, which no contact reads."""
    from scipy.spatial import ConvexHull

    planes = ConvexHull(points).equations
    low, high = points.min(0) - margin, points.max(0) + margin
    n = np.ceil((high - low) / spacing).astype(int) + 1
    out = np.empty(tuple(n), dtype=np.float32)

    # By blocks within blocks: of the planes, few can be highest in one.
    def block(first: np.ndarray, last: np.ndarray, near: np.ndarray) -> np.ndarray:
        """Return those of the planes `near` that may rise over the one that is highest in the middle of a block."""
        value = near[:, :3] @ (low + spacing * (first + last - 1) / 2) + near[:, 3]
        top = value.argmax()
        rise = np.abs(near[:, :3] - near[top, :3]) @ (0.5 * spacing * (last - first))
        return near[value + rise >= value[top]]

    outer, inner = 12, 6
    for corner in np.ndindex(*(-(-n // outer))):
        start = np.array(corner) * outer
        end = np.minimum(start + outer, n)
        around = block(start, end, planes)
        for part in np.ndindex(*(-(-(end - start) // inner))):
            first = start + np.array(part) * inner
            last = np.minimum(first + inner, end)
            near = block(first, last, around)
            cells = np.stack(
                np.meshgrid(*(np.arange(a, b) for a, b in zip(first, last, strict=True)), indexing="ij"), -1
            )
            d = (low + spacing * cells) @ near[:, :3].T + near[:, 3]
            out[tuple(slice(a, b) for a, b in zip(first, last, strict=True))] = d.max(-1)
    return Grid(low, float(spacing), out)


def _kind(shape: Felt) -> int:
    if shape.kind not in KINDS:
        raise UserError(f"touch shape '{shape.name}': kind '{shape.kind}' is unknown; choose one of {', '.join(KINDS)}")
    return KINDS[shape.kind]


def _checked(shape: Felt) -> Grid:
    g = shape.grid
    what = f"touch shape '{shape.name}'"
    if g is None:
        raise UserError(f"{what}: kind 'grid' needs a distance grid")
    data = np.asarray(g.data, dtype=np.float32)
    if data.ndim != 3 or min(data.shape) < 2:
        raise UserError(f"{what}: grid has shape {data.shape}; at least 2 samples along each of 3 axes are needed")
    if not np.all(np.isfinite(data)) or not g.spacing > 0.0:
        raise UserError(f"{what}: grid must be finite with positive spacing; spacing is {g.spacing}")
    edge = min(data[[0, -1]].min(), data[:, [0, -1]].min(), data[:, :, [0, -1]].min())
    if edge <= 0.0:
        raise UserError(
            f"{what}: grid does not hold the shape (distance {edge:.3g} m on its border, must be > 0): bake it with a"
            " wider margin"
        )
    if data.min() >= 0.0:
        raise UserError(f"{what}: grid is nowhere negative: no sample lies inside the shape; use a finer grid")
    return Grid(np.asarray(g.origin, dtype=float), float(g.spacing), data)


def _cells(d: np.ndarray) -> np.ndarray:
    """Return the corners of each cell [2 C, 4], as `dexsim.tactile.sdf.Shapes.data` has them."""
    n = tuple(k - 1 for k in d.shape)
    out = np.empty((*n, 2, 2, 2), dtype=np.float32)
    for x, y, z in np.ndindex(2, 2, 2):
        out[..., x, y, z] = d[x : x + n[0], y : y + n[1], z : z + n[2]]
    return out.reshape(-1, 4)


def _surface_bound(g: Grid) -> tuple[float, np.ndarray, np.ndarray]:
    """Return radius about the frame's origin, and middle and half sizes of a box, that hold every cell with a corner
    inside."""
    points = [np.argwhere(g.data <= limit) * g.spacing + g.origin for limit in (g.spacing, 0.0)]
    radius = np.sqrt((points[0] ** 2).sum(1).max()) + np.sqrt(3.0) * g.spacing
    low, high = points[1].min(0) - g.spacing, points[1].max(0) + g.spacing
    return float(radius), 0.5 * (low + high), 0.5 * (high - low)
