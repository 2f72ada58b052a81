"""`dexsim import-object mug.obj out=objects/mug`: a mesh as an object to grasp, checked, split, shown."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dexsim import files, outputs, typed
from dexsim.assets.objects import own
from dexsim.assets.objects.mesh import MOST_PARTS, surface
from dexsim.assets.objects.shape import Shape
from dexsim.errors import UserError
from dexsim.surface import across, obj
from dexsim.surface import hull as convex

USAGE = """usage: dexsim import-object MESH out=FOLDER [key=value ...]     MESH: .stl, .obj, .ply or .off

Check a mesh (closed, of a size that a hand can hold), split it into convex parts for contact, give it a distance grid
for touch and its inertia, and show it. What it writes can be grasped: dexsim train task=grasp objects='[FOLDER]'
(a mesh can also be named there directly: objects='[mug.obj]' object_scale=0.001).

  FOLDER/object.npz     convex parts, distance grid, inertia
  FOLDER/part_*.obj     the convex parts, in the file's own frame, in metres
  FOLDER/picture.png    the mesh, its parts, and a cut through the distance grid

settings (key=default):
  scale=1           metres per unit of the file: 0.001 for millimetres
  hulls=16          convex parts at most; 1 takes the convex hull
  picture=true      false: do not draw
"""


def main(argv: Sequence[str]) -> int:
    """Returns the exit status. Raises UserError."""
    given = {"scale": "1", "hulls": str(own.PARTS), "out": "", "picture": "true"}
    meshes, own_settings = typed.words(argv, given)
    given |= own_settings
    if len(meshes) != 1:
        raise UserError(f"one mesh is needed, {len(meshes)} given: dexsim import-object mug.obj out=objects/mug")
    if not given["out"]:
        raise UserError("say where to write: out=FOLDER, e.g. out=objects/mug")
    typed.truth("picture", given["picture"])
    scale, hulls = typed.number("scale", given["scale"]), typed.whole("hulls", given["hulls"], 1, MOST_PARTS)
    path, out = files.place(meshes[0]), files.place(given["out"])
    if path.is_dir():
        raise UserError(f"mesh {path} is a folder; import its meshes one by one, or give the folder to objects=")
    written = [own.FILE, "part_0.obj"] + ["picture.png"] * (given["picture"] == "true")
    there = out.exists()
    outputs.claim(out, "out=", written, [path])
    try:
        shape = own.own_shape(str(path), scale, hulls)
    except UserError:
        if not there:
            out.rmdir()
        raise
    shape = Shape(**{**shape.__dict__, "name": path.stem})
    size = " x ".join(f"{1e3 * x:.0f}" for x in shape.extents)
    print(f"{path.name}: {size} mm, {1e6 * shape.volume:.1f} cm3, {len(shape.hulls)} convex part(s)")
    for note in shape.notes:
        print(f"  {note}")
    assert shape.grid is not None
    cells = " x ".join(str(n) for n in shape.grid.data.shape)
    print(
        f"  distance grid {cells}, {1e3 * shape.grid.spacing:.2f} mm; off by {1e6 * shape.grid_error[0]:.0f} um"
    )
    with outputs.staged(out) as stage:
        own.save(shape, stage / own.FILE)
        for k, hull in enumerate(shape.hulls):
            points = hull @ shape.file_axes.T + shape.file_centre
            (stage / f"part_{k}.obj").write_text(obj(convex(points)), encoding="ascii")
        if given["picture"] == "true":
            draw(shape, path, stage / "picture.png")
    print(f"{out}: dexsim train objects='[{out}]'")
    return 0


def draw(shape: Shape, mesh: Path, picture: Path) -> None:
    """Draw the mesh, its convex parts in colours, and the distance grid cut through its middle."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    assert shape.grid is not None
    triangles = (surface(mesh, shape.file_scale)[0] - shape.file_centre) @ shape.file_axes
    light = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
    figure = Figure(figsize=(13, 4.6), dpi=90, layout="constrained")

    def solid(axes: Any, faces: np.ndarray, colour: np.ndarray) -> None:
        normal = across(faces)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-15)
        shade = 0.45 + 0.55 * np.clip(normal @ light, 0, 1)
        axes.add_collection3d(Poly3DCollection(1e3 * faces, facecolors=np.clip(shade[:, None] * colour, 0, 1)))

    half = 0.55e3 * shape.extents.max()
    for k, title in enumerate((f"{mesh.name}: {len(triangles)} triangles", f"{len(shape.hulls)} convex part(s)")):
        axes = figure.add_subplot(1, 3, k + 1, projection="3d")
        if k == 0:
            step = max(1, len(triangles) // 20000)
            solid(axes, triangles[::step], np.array([0.55, 0.65, 0.8]))
        else:
            for n, hull in enumerate(shape.hulls):
                vertices, faces = convex(hull)
                solid(axes, vertices[faces], np.array(colormaps["tab20"](n % 20)[:3]))
        axes.set(xlim=(-half, half), ylim=(-half, half), zlim=(-half, half), title=title)
        axes.set_box_aspect((1, 1, 1))
        axes.view_init(elev=38, azim=-60)
        axes.tick_params(labelsize=6)
    axes = figure.add_subplot(1, 3, 3)
    g = shape.grid
    spread = np.argsort(shape.extents)
    u, v = sorted(int(k) for k in spread[1:])
    w = int(spread[0])
    line = [g.origin[k] + g.spacing * np.arange(g.data.shape[k]) for k in range(3)]
    a, b = np.meshgrid(line[u], line[v], indexing="ij")
    points = np.zeros((a.size, 3))
    points[:, u], points[:, v] = a.ravel(), b.ravel()
    cut = 1e3 * g.sample(points).reshape(a.shape)
    most = np.abs(cut).max()
    drawn = axes.contourf(1e3 * a, 1e3 * b, cut, levels=np.linspace(-most, most, 25), cmap="RdBu_r")
    axes.contour(1e3 * a, 1e3 * b, cut, levels=[0.0], colors="black", linewidths=1.5)
    axes.set(
        aspect="equal", xlabel=f"{'xyz'[u]} [mm]", ylabel=f"{'xyz'[v]} [mm]", title=f"distance to it at {'xyz'[w]} = 0"
    )
    figure.colorbar(drawn, ax=axes, label="mm (inside < 0)", shrink=0.8)
    files.picture(figure, picture)
