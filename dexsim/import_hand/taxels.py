"""Touch pads: a grid of taxels painted on a fingertip's palmar side by rays, or read from a person's CSV."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

from dexsim import files
from dexsim.errors import UserError
from dexsim.import_hand import geometry
from dexsim.import_hand.frame import unit
from dexsim.surface import Surface, hull

STEEPEST = 0.35
"""Least cosine between a taxel's normal and the pad's: flanks steeper than 70 degrees carry none."""
OFF = 1e-3
"""m along its normal that a taxel may lie off the hull that presses objects (dexsim.tactile lifts it by no more)."""


@dataclass
class Pad:
    """Taxels of a fingertip in the tip body's frame. point, normal, tangent [T, 3] m, unit, unit; area [T] m2; rows: of
    the lattice, k = column * rows + row, 0: none; note: what a person should know."""

    point: np.ndarray
    normal: np.ndarray
    tangent: np.ndarray
    area: np.ndarray
    rows: int
    note: str = ""

    def csv(self) -> str:
        """Return the table's text: k,x,y,z,nx,ny,nz,tx,ty,tz,area."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow("k x y z nx ny nz tx ty tz area".split())
        for k in range(len(self.point)):
            row = [*self.point[k], *self.normal[k], *self.tangent[k]]
            writer.writerow([k, *(f"{x + 0.0:.6f}" for x in row), f"{self.area[k]:.6e}"])
        return out.getvalue()


def paint(
    finger: str, surface: Surface, position: np.ndarray, normal: np.ndarray, along: np.ndarray, size: tuple[int, int],
    holes: str = "hull",
) -> Pad:  # fmt: skip
    """Lay a grid of size (rows, columns) on the side of `surface` that `normal` looks out of.

    surface: the tip's, tip body's frame; position [3] m: the middle of the pad, about; along [3]: from the joint to
    the tip: rows run that way. The grid covers three quarters of the tip's width and of its length beyond the middle,
    and shrinks until every ray meets a face that is not too steep. Taxels lie on the convex hull that presses objects;
    where the surface itself is hollow there, or has a hole, `note` says so. Raises UserError: a hole where holes is
    "refuse", a side without a face.
    """
    rows, columns = size
    edges = geometry.open_edges(surface)
    if edges and holes == "refuse":
        raise UserError(
            f"finger {finger}: the mesh of its tip is not closed, {edges} edges border a hole; close it (Blender: Mesh"
            " > Clean Up > Fill Holes), or holes=hull takes its convex hull"
        )
    outer = hull(surface[0])
    normal = unit(normal)
    along = unit(along - normal * (normal @ along))
    across = np.cross(along, normal)
    axes = np.stack([across, along, normal], 1)
    local = surface[0] @ axes
    low, high = local.min(0), local.max(0)
    middle = np.array([0.5 * (low[0] + high[0]), position @ along])
    half = np.array([0.38 * (high[0] - low[0]), min(0.8 * (high[1] - middle[1]), 0.75 * (high[0] - low[0]))])
    if half.min() <= 0:
        raise UserError(f"finger {finger}: its tip position lies beyond the tip's surface; correct tip.position")
    for shrink in np.linspace(1.0, 0.3, 15):
        u = middle[0] + shrink * half[0] * np.linspace(-1, 1, columns) * (columns > 1)
        v = middle[1] + shrink * half[1] * np.linspace(-1, 1, rows) * (rows > 1)
        grid = np.stack([np.repeat(u, rows), np.tile(v, columns), np.full(rows * columns, high[2] + 0.01)], 1)
        distance, facing = geometry.first_hits(outer, grid @ axes.T, -normal)
        if np.isfinite(distance).all() and (facing @ normal).min() > STEEPEST:
            break
    else:
        raise UserError(
            f"finger {finger}: a grid of {rows} x {columns} taxels does not fit on its tip's side that tip.normal looks"
            " out of; correct tip.position or tip.normal, or paint by pads=FILE.csv"
        )
    point = grid @ axes.T - distance[:, None] * normal
    true, _ = geometry.first_hits(surface, grid @ axes.T, -normal)
    hollow = float(np.where(np.isfinite(true), true - distance, np.ptp(local[:, 2])).max())
    facing = _smooth(facing, rows, columns)
    tangent = unit(across - facing * (facing @ across)[:, None])
    cell = (2 * shrink * half[0] / max(columns - 1, 1)) * (2 * shrink * half[1] / max(rows - 1, 1))
    if rows * columns == 1 or 1 in size:
        cell = (2 * shrink * half[0] / columns) * (2 * shrink * half[1] / rows)
    area = cell / np.maximum(facing @ normal, STEEPEST)
    note = "its mesh is not closed: taxels lie on its convex hull, which touches" if edges else ""
    if not edges and hollow > OFF:
        note = f"the tip is hollow there by up to {1e3 * hollow:.1f} mm: taxels lie on its convex hull, which touches"
    return Pad(point, facing, tangent, area, rows, note)


def _smooth(normals: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Return normals averaged with their neighbours' in the grid: facets of a hull turn in steps."""
    grid = np.pad(normals.reshape(columns, rows, 3), ((1, 1), (1, 1), (0, 0)), mode="edge")
    mean = grid[1:-1, 1:-1] * 2 + grid[:-2, 1:-1] + grid[2:, 1:-1] + grid[1:-1, :-2] + grid[1:-1, 2:]
    return unit(mean).reshape(-1, 3)


def read(path: Path) -> dict[str, Pad]:
    """Return a person's taxels: columns finger, x, y, z [m], nx, ny, nz in the tip body's frame, and area [m2] where it
    is known. Raises UserError, with the line."""
    need = ("finger", "x", "y", "z", "nx", "ny", "nz")
    found = files.table(path, "taxels", need, ("area",), ("finger",))
    found.setdefault("area", np.zeros(len(found["x"])))
    every = np.stack([found[c] for c in (*need[1:], "area")], 1)
    if not len(every) or (np.linalg.norm(every[:, 3:6], axis=1) < 1e-6).any():
        raise UserError(f"taxels {path}: has no lines, or one whose nx, ny, nz are all 0: a normal must have a length")
    out = {}
    for finger in dict.fromkeys(found["finger"].tolist()):
        table = every[found["finger"] == finger]
        normal = unit(table[:, 3:6])
        helper = np.eye(3)[np.abs(normal.mean(0)).argmin()]
        tangent = unit(np.cross(np.cross(normal, helper), normal))
        area = table[:, 6]
        if (area <= 0).any():
            area = np.full(len(table), _spacing(table[:, :3]) ** 2)
        out[finger] = Pad(table[:, :3], normal, tangent, area, 0)
    return out


def _spacing(points: np.ndarray) -> float:
    """Return median distance to the nearest neighbour [m]."""
    if len(points) < 2:
        return 2e-3
    away = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(away, np.inf)
    return float(np.median(away.min(1)))


def check(finger: str, pad: Pad, skin: np.ndarray, where: str) -> None:
    """Refuse taxels that the tip's hull (corners `skin` [V, 3] m) cannot carry."""
    planes = ConvexHull(skin).equations
    slope = pad.normal @ planes[:, :3].T
    depth = -(pad.point @ planes[:, :3].T + planes[:, 3])
    # along its normal a taxel leaves the hull where it meets the first of the planes that the normal climbs to
    with np.errstate(divide="ignore", invalid="ignore"):
        out = np.where(slope > 1e-9, depth / slope, np.inf).min(axis=1)
    k = int(np.abs(out).argmax())
    if abs(out[k]) > OFF:
        side = "inside the finger" if out[k] > 0 else "outside the fingertip"
        raise UserError(
            f"{where}: taxel {k} of finger {finger} lies {1e3 * abs(out[k]):.1f} mm {side} (along its normal), allowed"
            f" {1e3 * OFF:g} mm: put it on the surface of the tip's convex hull, in the tip body's frame, in metres"
        )
