"""Objects to grasp: primitives, irregular shapes made by `shapes.py`, and a user's own meshes.

The irregular shapes are loaded from `library.npz`, which `python -m tools.assets.objects` writes; trimesh is
imported only to read a user's mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np

from dexsim.assets.objects.baking import unpack
from dexsim.assets.objects.shape import Grid, Shape, primitive_mass_properties

__all__ = ["Grid", "Shape", "library", "load_mesh", "names", "primitive_mass_properties"]

# Sizes (m) at scale 1, largest extent 60 mm; see Shape.size.
_PRIMITIVES = {
    "box": (0.030, 0.024, 0.020),
    "sphere": (0.030, 0.0, 0.0),
    "capsule": (0.019, 0.011, 0.0),
}


def _primitive(kind: str) -> Shape:
    size = np.array(_PRIMITIVES[kind])
    volume, inertia = primitive_mass_properties(kind, size)
    a, b, c = size
    extents = {"box": (2 * a, 2 * b, 2 * c), "sphere": (2 * a,) * 3, "capsule": (2 * a, 2 * a, 2 * (a + b))}[kind]
    return Shape(kind, kind, False, [], None, float(volume), np.diag(inertia), np.array(extents), size)


@cache
def _library() -> dict[str, Shape]:
    shapes = {kind: _primitive(kind) for kind in _PRIMITIVES}
    with as_file(files(__name__) / "library.npz") as path, np.load(path, allow_pickle=False) as stored:
        parts: dict[str, dict[str, np.ndarray]] = {}
        for key in stored.files:
            name, part = key.split("/")
            parts.setdefault(name, {})[part] = stored[key]
    for name, arrays in parts.items():
        shapes[name] = unpack(name, arrays)
    for shape in shapes.values():
        # One copy serves every caller; nobody may change it.
        for array in (*shape.hulls, shape.inertia_unit, shape.extents, shape.size):
            array.flags.writeable = False
        if shape.grid is not None:
            shape.grid.data.flags.writeable = False
            shape.grid.origin.flags.writeable = False
    return shapes


def library() -> dict[str, Shape]:
    """Return all shapes that ship with dexsim by name: box, sphere, capsule, then those of `shapes.SHAPES` in that
    order."""
    return dict(_library())


def names(held_out: bool | None = None) -> list[str]:
    """Names of the shapes: those trained on (False), those kept for evaluation (True), or all (None)."""
    return [name for name, shape in _library().items() if held_out is None or shape.held_out == held_out]


def load_mesh(path: str | Path | Sequence[str | Path], scale: float = 1.0, parts: int = 1) -> Shape:
    """Return a `Shape` of kind "grid" from a user's mesh file (a hollow one split into at most `parts` convex ones), or
    from a list of at most three files of its convex parts.

    See `dexsim.assets.objects.mesh.load_mesh`, which this calls.
    """
    from dexsim.assets.objects.mesh import load_mesh as load

    return load(path, scale, parts)
