"""Bakes the irregular shapes into `library.npz`: `python -m tools.assets.objects [--picture PATH.png]`."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from dexsim import files
from dexsim.assets.objects.baking import pack, shape_from_hulls
from dexsim.assets.objects.geometry import union_boundary
from dexsim.assets.objects.shape import Shape
from tools.assets.shapes import SHAPES, hulls_of

LIBRARY = Path(__file__).resolve().parents[2] / "dexsim" / "assets" / "objects" / "library.npz"


def bake_all() -> dict[str, Shape]:
    """Return every shape of `SHAPES`, baked."""
    return {name: shape_from_hulls(name, hulls_of(name), held_out) for name, (_, held_out) in SHAPES.items()}


def contact_sheet(path: str | Path, shapes: dict[str, Shape] | None = None) -> None:
    """Draws all irregular shapes (default: those of the library), flat shaded, to a picture file."""
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    from dexsim.assets.objects import library

    shapes = {n: s for n, s in (shapes or library()).items() if s.hulls}
    columns = 5
    rows = -(-len(shapes) // columns)
    figure = Figure(figsize=(3 * columns, 3.1 * rows), dpi=90)
    light = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
    for k, shape in enumerate(shapes.values()):
        axes = figure.add_subplot(rows, columns, k + 1, projection="3d")
        triangles = union_boundary(shape.hulls) * 1e3
        normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        shade = 0.35 + 0.65 * np.clip(normal @ light, 0, 1)
        base = np.array([0.95, 0.55, 0.25] if shape.held_out else [0.45, 0.65, 0.90])
        axes.add_collection3d(Poly3DCollection(triangles, facecolors=np.clip(shade[:, None] * base, 0, 1)))
        axes.set(xlim=(-32, 32), ylim=(-32, 32), zlim=(-32, 32))
        axes.set_box_aspect((1, 1, 1))
        axes.view_init(elev=28, azim=-60)
        axes.tick_params(labelsize=6)
        judged = ", for evaluation" if shape.held_out else ""
        axes.set_title(f"{shape.name}: {len(shape.hulls)} hull(s), {1e6 * shape.volume:.0f} cm³{judged}", fontsize=8)
    figure.tight_layout()
    files.picture(figure, Path(path))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--picture", help="also draw all shapes to this file")
    arguments = parser.parse_args()
    shapes = bake_all()
    stored = {f"{name}/{key}": array for name, shape in shapes.items() for key, array in pack(shape).items()}
    np.savez_compressed(LIBRARY, **stored)  # type: ignore[arg-type]  # its stub takes ** for allow_pickle
    print("name       hulls vertices   extents mm           cm3    kept out  grid          error mean/max mm")
    for shape in shapes.values():
        sizes = ",".join(str(len(h)) for h in shape.hulls)
        extents = " x ".join(f"{1e3 * e:.1f}" for e in shape.extents)
        assert shape.grid is not None  # baked
        dims = "x".join(str(n) for n in shape.grid.data.shape)
        mean, largest = (1e3 * e for e in shape.grid_error)
        print(
            f"{shape.name:10} {len(shape.hulls)}     {sizes:10} {extents:20} {1e6 * shape.volume:6.1f} "
            f"{'yes' if shape.held_out else 'no':8}  {dims:12}  {mean:.3f} / {largest:.3f}"
        )
    print(f"{LIBRARY.name}: {LIBRARY.stat().st_size / 1e6:.2f} MB")
    if arguments.picture:
        contact_sheet(arguments.picture, shapes)
        print(f"picture: {arguments.picture}")


if __name__ == "__main__":
    main()
