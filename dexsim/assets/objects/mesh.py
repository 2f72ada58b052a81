"""A user's own mesh as a `Shape`: reads it with trimesh, names what is wrong with it, and makes hulls and a grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from dexsim import files, guard
from dexsim.assets.objects.baking import MARGIN, shape_from_hulls
from dexsim.assets.objects.decompose import CONVEX
from dexsim.assets.objects.geometry import mass_properties, principal_axes, simplify_hull, union_boundary
from dexsim.assets.objects.shape import MAX_HULLS, MAX_VERTICES, Shape
from dexsim.errors import UserError
from dexsim.surface import spread

SMALLEST, LARGEST = 0.005, 0.300  # m, largest extent of an object that a hand can be asked to hold
_CELLS = 62  # along the longest side of the grid, margin included
_FINE_CELLS = 90  # the same of what is split into many parts
PATIENCE = 60.0
"""Times the usual limits for a sound surface: CoACD splits a hollow one by a search, and a distance grid is baked."""
MOST_PARTS = 32  # convex parts of one object


def _scale_hint(extent: float, scale: float) -> str:
    """Return the factor that would bring an extent (as scaled, m) into range, in words."""
    for unit, factor in (("millimetres", 1e-3), ("centimetres", 1e-2), ("inches", 0.0254)):
        # Units guess the file as it is, so undo the scale that was passed.
        if SMALLEST <= extent / scale * factor <= LARGEST:
            return f"the file is probably in {unit}: pass {_named(factor)}"
    if SMALLEST <= extent / scale <= LARGEST:
        return f"the file is probably in metres already: pass {_named(1.0)}"
    return f"pass a scale that brings it there, e.g. {_named(scale * 0.06 / extent)} for 60 mm"


def _named(scale: float) -> str:
    """Return a scale as the commands take it."""
    return f"object_scale={scale:.3g} (to import-object: scale={scale:.3g})"


def _read(path: Path, scale: float) -> tuple[np.ndarray, list[str]]:
    import trimesh

    try:
        mesh: Any = trimesh.load(path, force="mesh")  # a Trimesh, or what has neither vertices nor faces
    except Exception as error:  # trimesh raises whatever its reader for the format does
        reason = " ".join(str(error).split()) or type(error).__name__
        raise UserError(
            f"mesh {path}: cannot be read ({reason[:120]}); formats that work: .stl, .obj, .ply, .off"
        ) from error
    vertices = np.asarray(getattr(mesh, "vertices", ()), float)
    if len(getattr(mesh, "faces", ())) == 0 or len(vertices) == 0:
        raise UserError(f"mesh {path}: holds no triangles; export the surface as a triangle mesh")
    if not np.isfinite(vertices).all():
        raise UserError(f"mesh {path}: {(~np.isfinite(vertices).all(axis=1)).sum()} vertices are not finite numbers")
    mesh.merge_vertices(merge_tex=True, merge_norm=True)

    extent = scale * np.ptp(vertices, axis=0).max()
    if not SMALLEST <= extent <= LARGEST:
        raise UserError(
            f"mesh {path}: largest extent is {1e3 * extent:.4g} mm at scale={scale:g}, allowed "
            f"{1e3 * SMALLEST:g} to {1e3 * LARGEST:g} mm; {_scale_hint(extent, scale)}"
        )
    faces = np.asarray(mesh.faces)
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    _, counts = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
    # A closed surface may pass an edge more than twice (two bodies touching), but never an odd number of times.
    if (counts % 2).any():
        raise UserError(
            f"mesh {path}: not watertight, {(counts % 2).sum()} of {len(counts)} edges border a hole; "
            "close the surface (for example Blender: Mesh > Clean Up > Fill Holes)"
        )
    # Wound alike, neighbours run along their common edge in opposite directions.
    order = np.where(edges[:, 0] < edges[:, 1], 1, -1)
    _, which = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    balance = np.bincount(which.ravel(), weights=order)
    if (balance != 0).any():
        raise UserError(
            f"mesh {path}: inconsistent winding at {(balance != 0).sum()} of {len(counts)} edges (neighbouring faces "
            "look to opposite sides); recalculate the normals outside (Blender: Mesh > Normals > Recalculate Outside)"
        )
    triangles = scale * np.asarray(mesh.vertices, float)[faces]
    box = np.prod(np.ptp(triangles.reshape(-1, 3), axis=0))
    volume = mass_properties(triangles - triangles.mean(axis=(0, 1)))[0] if box > 0 else 0.0
    if abs(volume) <= 1e-4 * extent**3:
        raise UserError(
            f"mesh {path}: encloses no volume ({1e6 * volume:.3g} cm3 at {1e3 * extent:.3g} mm extent); "
            "an object must be solid: give a flat surface a thickness"
        )
    if volume < 0:
        return triangles[:, ::-1], [f"{path.name}: its faces looked inward; turned to look outward"]
    return triangles, []


def _split(file: Path, triangles: np.ndarray, parts: int) -> tuple[list[np.ndarray], list[str]]:
    """Return the hulls of a hollow mesh's convex parts, and notes on how well they follow it."""
    from dexsim.assets.objects.decompose import decompose

    vertices, faces = np.unique(triangles.reshape(-1, 3).round(9), axis=0, return_inverse=True)
    hulls = [simplify_hull(p, MAX_VERTICES)[0] for p in decompose(vertices, faces.reshape(-1, 3), parts, file)]
    inside = _depth_of_surface(triangles, hulls)
    return hulls, [
        f"{file.name}: hollow, split into {len(hulls)} convex parts; its surface lies {1e3 * np.abs(inside).mean():.1f}"
        f" mm off theirs on average, 95 % within {1e3 * np.quantile(np.abs(inside), 0.95):.1f} mm"
        + ("" if len(hulls) < parts else "; object_hulls= allows more parts")
    ]


def _depth_of_surface(triangles: np.ndarray, hulls: list[np.ndarray], count: int = 3000) -> np.ndarray:
    """Return how deep [count] m points of a surface lie in the union of hulls (negative: outside), evenly spread by
    area."""
    points = spread(triangles, count, np.random.default_rng(0))[0]
    planes = [ConvexHull(h).equations for h in hulls]
    return np.max([-(points @ p[:, :3].T + p[:, 3]).max(axis=1) for p in planes], axis=0)


def load_mesh(path: str | Path | Sequence[str | Path], scale: float = 1.0, parts: int = 1) -> Shape:
    """Return a `Shape` of kind "grid" from a mesh file, or from a list of at most three files with its convex parts.

    path: .stl, .obj, .ply or .off file, or a list of them whose parts share one frame; each part stands for its hull.
    scale: metres per unit of the file (0.001 for millimetres). parts: how many convex parts a hollow mesh may be split
    into (`dexsim.assets.objects.decompose`; 1: its convex hull is taken).

    Contact and touch both use the convex hull of the mesh (of each part), simplified to 32 corners; `Shape.notes`
    states what that changed. Volume, centre and inertia of a single file are those of the mesh itself, of parts
    those of the union of the hulls. A few seconds of work: the distance grid is baked here.

    Raises UserError, naming the file, for: a missing or unreadable file, no triangles, a largest extent outside
    5 to 300 mm, holes, inconsistent winding, no volume, more than three files, a scale that is not positive, a hollow
    mesh to be split without CoACD.
    """
    if not 1 <= parts <= MOST_PARTS:
        raise UserError(f"object_hulls={parts}: must be a whole number from 1 to {MOST_PARTS}")
    paths = [Path(path)] if isinstance(path, (str, Path)) else [Path(p) for p in path]
    single = isinstance(path, (str, Path))
    if not 1 <= len(paths) <= MAX_HULLS:
        raise UserError(
            f"mesh parts: {len(paths)} files given, allowed 1 to {MAX_HULLS}; merge convex parts that lie close by"
        )
    if not (np.isfinite(scale) and scale > 0):
        raise UserError(f"mesh {paths[0]}: scale={scale}, must be a positive number; 0.001 for a file in millimetres")
    surfaces = [surface(p, scale) for p in paths]
    size = sum(t.nbytes for t, _ in surfaces)
    given = paths, surfaces, scale, parts, single
    return guard.call(_made, *given, what=f"mesh {paths[0]}", size=size, patience=PATIENCE)


def surface(path: Path, scale: float) -> tuple[np.ndarray, list[str]]:
    """Return triangles [T, 3, 3] (m) of the closed surface in a mesh file, outward, and notes. Raises UserError for
    what is wrong with it."""
    return guard.call(_read, path, scale, what=f"mesh {path}", size=files.check(path, "mesh"))


def _made(paths: Sequence[Path], surfaces: Sequence[Any], scale: float, parts: int, single: bool) -> Shape:
    notes: list[str] = []
    hulls: list[np.ndarray] = []
    split = False
    for file, (triangles, said) in zip(paths, surfaces, strict=True):
        notes += said
        points = triangles.reshape(-1, 3)
        try:
            hull_volume = ConvexHull(points).volume
            corners, inside, outside = simplify_hull(points, MAX_VERTICES)
        except QhullError as error:
            raise UserError(f"mesh {file}: too flat for a convex hull; give it a thickness") from error
        share = mass_properties(triangles)[0] / hull_volume
        if share < CONVEX and single and parts > 1:
            hulls, said = _split(file, triangles, parts)
            notes, split = notes + said, True
            break
        if share < CONVEX:
            advice = "; pass a list of up to three files of convex parts to keep its hollows" if single else ""
            notes.append(f"{file.name}: not convex ({100 * share:.0f} % of its hull); its convex hull is used{advice}")
        if inside > 0 or outside > 0:
            notes.append(
                f"{file.name}: convex hull simplified to {len(corners)} corners of the same volume, at most "
                f"{1e3 * inside:.2f} mm inside and {1e3 * outside:.2f} mm outside of it"
            )
        hulls.append(corners)
    solid = triangles if single else union_boundary(hulls)
    volume, centre, inertia = mass_properties(solid)
    axes = principal_axes(inertia)
    hulls = [(h - centre) @ axes for h in hulls]
    if split:
        shape = _shape_of_parts(paths[0].stem, hulls)
    else:
        # One to one with the library: about 1.25 mm for an object of 60 mm.
        spacing = (np.ptp(np.concatenate(hulls), axis=0).max() + 2 * MARGIN) / _CELLS
        shape = shape_from_hulls(paths[0].stem, hulls, spacing=spacing)
    return replace(
        shape, volume=volume, inertia_unit=axes.T @ inertia @ axes, notes=tuple(notes), file_centre=centre,
        file_axes=axes, file_scale=scale,
    )  # fmt: skip


def _shape_of_parts(name: str, hulls: list[np.ndarray]) -> Shape:
    """Return what `shape_from_hulls` makes, of parts that touch."""
    from dexsim.assets.objects import parts

    hulls = [np.asarray(h, np.float32).astype(float) for h in hulls]
    spacing = (np.ptp(np.concatenate(hulls), axis=0).max() + 2 * MARGIN) / _FINE_CELLS
    grid = parts.grid(hulls, spacing)
    return Shape(
        name=name, kind="grid", held_out=False, hulls=hulls, grid=grid, volume=0.0, inertia_unit=np.eye(3),
        extents=np.ptp(np.concatenate(hulls), axis=0), grid_error=parts.grid_error(hulls, grid),
    )  # fmt: skip
