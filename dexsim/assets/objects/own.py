"""A user's own objects by name: a mesh file, or a folder that `dexsim import-object` wrote; worked out once, then
from a cache."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from dexsim import files
from dexsim.assets.objects.shape import Grid, Shape
from dexsim.errors import UserError

FORMAT = 1
FILE = "object.npz"
MESHES = (".stl", ".obj", ".ply", ".off")
PARTS = 16  # convex parts of a hollow mesh, where nothing is said


def is_own(name: str) -> bool:
    """Return whether the name of an object is a path: a mesh file, or a folder."""
    return name.lower().endswith(MESHES) or "/" in name or os.sep in name


def named(objects: Mapping[str, Any]) -> dict[str, Shape]:
    """Return the shapes that a task's `objects` name, by name, those trained on first: of the library, or a user's own
    (`own`: their scale and parts). Raises UserError for a name that is neither."""
    from dexsim.assets.objects import library

    known, out = library(), {}
    for key in ("train", "held_out"):
        if not isinstance(objects[key], (list, tuple)) or not all(isinstance(name, str) for name in objects[key]):
            raise UserError(f"task.objects.{key}={objects[key]}: must be a list of names, e.g. [box,sphere]")
    names = list(objects["train"])
    if not objects["train"]:
        raise UserError("task.objects.train=[]: must name a shape, e.g. [box,sphere]")
    if twice := [n for n in names if names.count(n) > 1]:
        raise UserError(f"task.objects.train: '{twice[0]}' stands twice; name each once")
    settings = objects.get("own") or {}
    for name in (*names, *objects["held_out"]):
        if name in known:
            out[name] = known[name]
        elif is_own(name):
            out[name] = own_shape(name, settings.get("scale", 1.0), settings.get("hulls", PARTS))
        else:
            raise UserError(
                f"task.objects: no shape '{name}'; shapes: {', '.join(known)}, or a mesh file ({', '.join(MESHES)})"
            )
    return out


def expand(names: list[str]) -> list[str]:
    """Names with each folder of meshes replaced by its meshes, paths made absolute. Raises UserError for a path without
    objects."""
    out: list[str] = []
    for name in names:
        path = files.place(name)
        folder = os.path.isdir(path)  # not Path's, which raises where a name is too long for a file
        if not is_own(str(name)) and not (folder and _listed(path)):
            out.append(str(name))
        elif folder and not (path / FILE).is_file():
            found = _listed(path)
            if not found:
                raise UserError(
                    f"objects: {name}: a folder with neither {FILE} (dexsim import-object) nor meshes"
                    f" ({', '.join(MESHES)})"
                )
            out += [str(p.resolve()) for p in found]
        else:
            out.append(str(path.resolve()))
    return out


def _listed(folder: Path) -> list[Path]:
    try:
        return sorted(p for p in folder.iterdir() if p.suffix.lower() in MESHES or os.path.isfile(p / FILE))
    except OSError as error:
        raise UserError(f"objects: {folder}: cannot be listed: {error.strerror}") from None


def own_shape(name: str, scale: float = 1.0, parts: int = PARTS) -> Shape:
    """Return the shape of a mesh file (scale: metres per unit; parts: convex ones at most) or of an imported folder (as
    it was imported), called `name`. Raises UserError as `load_mesh` does."""
    path = files.place(name)
    if os.path.isdir(path):
        files.check(path / FILE, "object")
        return replace(_read(path / FILE), name=name)
    files.check(path, "mesh")
    return replace(_cached(path.resolve(), path.stat().st_mtime_ns, float(scale), int(parts)), name=name)


@lru_cache(maxsize=256)
def _cached(path: Path, stamp: int, scale: float, parts: int) -> Shape:
    from dexsim.assets.objects.decompose import ITERATIONS, NODES, RESOLUTION, THRESHOLD
    from dexsim.assets.objects.mesh import load_mesh

    with open(path, "rb") as file:
        digest = hashlib.file_digest(file, "sha256")
    digest.update(f"{FORMAT} {scale!r} {parts} {THRESHOLD} {ITERATIONS} {NODES} {RESOLUTION}".encode())
    kept = cache_folder() / f"{digest.hexdigest()}.npz"
    if kept.is_file():
        try:
            return _read(kept)
        except UserError:
            pass  # broken off or of another version: made anew
    shape = replace(load_mesh(path, scale, parts), true_size=True)
    try:
        kept.parent.mkdir(parents=True, exist_ok=True)
        save(shape, kept)
    except OSError:
        pass  # no cache, no harm
    return shape


def cache_folder() -> Path:
    """Return where worked-out meshes are kept: $DEXSIM_CACHE, or dexsim/ in the user's cache."""
    own = os.environ.get("DEXSIM_CACHE")
    base = Path(own) if own else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dexsim"
    return base / "objects"


def save(shape: Shape, path: Path) -> None:
    """Write a shape, whole or not at all."""
    assert shape.grid is not None
    with files.beside(path) as part, open(part, "wb") as file:
        np.savez_compressed(
            file, format=FORMAT, name=shape.name, hulls=np.concatenate(shape.hulls).astype(np.float32),
            hull_sizes=np.array([len(h) for h in shape.hulls], np.int32), volume=shape.volume,
            inertia_unit=shape.inertia_unit, origin=shape.grid.origin, spacing=shape.grid.spacing,
            data=shape.grid.data.astype(np.float32), grid_error=np.array(shape.grid_error),
            notes=np.array(shape.notes, str),
            file_centre=shape.file_centre, file_axes=shape.file_axes, file_scale=shape.file_scale,
        )  # fmt: skip


def _read(path: Path) -> Shape:
    """Return what `save` wrote. Raises UserError for anything else."""
    try:
        d = files.arrays(path)
        if int(d["format"]) != FORMAT:
            raise ValueError(f"format {int(d['format'])}, must be {FORMAT}")
        hulls = np.split(d["hulls"].astype(float), np.cumsum(d["hull_sizes"])[:-1])
        mean, largest = (float(x) for x in d["grid_error"])
        shape = Shape(
            name=str(d["name"]), kind="grid", held_out=False, hulls=hulls,
            grid=Grid(d["origin"].astype(float), float(d["spacing"]), d["data"].astype(np.float32)),
            volume=float(d["volume"]), inertia_unit=d["inertia_unit"].astype(float),
            extents=np.ptp(np.concatenate(hulls), axis=0), grid_error=(mean, largest),
            true_size=True, notes=tuple(str(x) for x in np.atleast_1d(d["notes"])), file_centre=d["file_centre"],
            file_axes=d["file_axes"], file_scale=float(d["file_scale"]),
        )  # fmt: skip
        assert shape.grid is not None  # made above
        whole = shape.grid.data.ndim == 3 and len(hulls) >= 1
        good = all(h.ndim == 2 and h.shape[1] == 3 and np.isfinite(h).all() for h in hulls)
        if not (whole and good and np.isfinite(shape.grid.data).all() and shape.inertia_unit.shape == (3, 3)):
            raise ValueError("its arrays do not make a shape")
        return shape
    except (ValueError, KeyError, TypeError) as error:
        said = " ".join(str(error).split())[:160]
        raise UserError(f"object {path}: not a file of dexsim import-object ({said}); import the mesh again") from None
