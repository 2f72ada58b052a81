"""Objects of one's own: contact and touch against the mesh itself.

    python -m benchmarks.objects [out=out/objects.json] [parts=1,8,16,24] [places=3000]

Hollow solids, drawn here: a cup, a bowl, a pipe, a ring. Each is read with `load_mesh` as its convex hull (parts=1) and
split into at most so many parts.
  contact   a ball of 6 mm at random places about the surface: its distance to the mesh, less what C MuJoCo measures to
            the object's geoms; and the share of places clear of the mesh by 1 mm or more where MuJoCo sees a contact
  touch     the distance grid that taxels read, against the mesh, at the same places
  drop      a ball let fall into the cup: its height when it lies still, over that of the cup's bottom
"""

from __future__ import annotations

import json
import tempfile
import time
from pathlib import Path

import mujoco
import numpy as np
import trimesh

from benchmarks import tools
from dexsim.assets.objects import Shape, load_mesh
from dexsim.assets.objects.geometry import _triangle_distance
from dexsim.errors import UserError

BALL = 0.006  # m, radius
BAND = 0.008  # m from the mesh to the ball's surface, at most


def solids() -> dict[str, trimesh.Trimesh]:
    """Closed hollow meshes, metres."""

    def turned(profile: list[tuple[float, float]]) -> trimesh.Trimesh:
        return trimesh.creation.revolve(1e-3 * np.array(profile, float), sections=40)

    return {
        "cup": turned([(0, 0), (36, 0), (36, 80), (31, 80), (31, 6), (0, 6)]),
        "bowl": turned([(0, 0), (20, 0), (45, 25), (45, 30), (40, 30), (18, 6), (0, 6)]),
        "pipe": trimesh.creation.annulus(r_min=0.018, r_max=0.026, height=0.07, sections=40),
        "ring": trimesh.creation.torus(major_radius=0.030, minor_radius=0.009, major_sections=40, minor_sections=20),
    }


def winding(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Winding number [P] of a closed surface about points [P, 3]: 1 inside, 0 outside (Van Oosterom and Strackee 1983,
    The solid angle of a plane triangle)."""
    out = np.empty(len(points))
    for k, p in enumerate(points):
        a, b, c = (triangles[:, i] - p for i in range(3))
        la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
        over = np.einsum("ti,ti->t", a, np.cross(b, c))
        under = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
        out[k] = 2 * np.arctan2(over, under).sum() / (4 * np.pi)
    return out


def mesh_distance(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Exact signed distance [P] m, negative inside."""
    far = np.concatenate([_triangle_distance(points[k : k + 1000], triangles) for k in range(0, len(points), 1000)])
    return np.where(winding(points, triangles) > 0.5, -far, far)


def places(triangles: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
    """Centres [count, 3] of balls about a surface."""
    rng = np.random.default_rng(seed)
    size = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    chosen = triangles[rng.choice(len(triangles), count, p=size / size.sum())]
    points = np.einsum("pk,pki->pi", rng.dirichlet(np.ones(3), count), chosen)
    way = rng.normal(size=(count, 3))
    return points + way / np.linalg.norm(way, axis=1, keepdims=True) * rng.uniform(0, BALL + BAND, (count, 1))


def model_of(shape: Shape, ball_free: bool = False) -> mujoco.MjModel:
    """The object, fixed, and a ball."""
    spec = mujoco.MjSpec()
    for k, hull in enumerate(shape.hulls):
        spec.add_mesh(name=f"part{k}", uservert=np.asarray(hull).ravel())
        spec.worldbody.add_geom(name=f"part{k}", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"part{k}")
    ball = spec.worldbody.add_body(name="ball", pos=[0, 0, 0.2])
    if ball_free:
        ball.add_freejoint()
    ball.add_geom(name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[BALL, 0, 0], density=1000)
    return spec.compile()


def contact_distance(shape: Shape, centres: np.ndarray) -> np.ndarray:
    """What MuJoCo measures [P] m from the ball's surface to the nearest of the object's geoms."""
    spec_model = model_of(shape)
    data = mujoco.MjData(spec_model)
    body, ball = spec_model.body("ball").id, spec_model.geom("ball").id
    out = np.full(len(centres), np.inf)
    for k, centre in enumerate(centres):
        spec_model.body_pos[body] = centre
        mujoco.mj_kinematics(spec_model, data)
        for g in range(len(shape.hulls)):
            out[k] = min(out[k], mujoco.mj_geomDistance(spec_model, data, g, ball, 1.0, None))
    return out


def drop(shape: Shape, seconds: float = 1.5) -> float:
    """Height [m] of the ball's lowest point, in the file's frame, when it has fallen into the middle of the object."""
    model = model_of(shape, ball_free=True)
    model.opt.timestep, model.geom_solref[:, 0] = 5e-4, 4e-3  # as firm as the tasks' links
    data = mujoco.MjData(model)
    down = shape.file_axes.T @ np.array([0, 0, -9.81])
    model.opt.gravity[:] = down
    start = (np.array([0.004, 0.003, 0.095]) - shape.file_centre) @ shape.file_axes
    data.qpos[:3] = start
    while data.time < seconds:
        mujoco.mj_step(model, data)
    return float((shape.file_axes @ data.qpos[:3] + shape.file_centre)[2] - BALL)


def main(argv: list[str]) -> dict:
    """Measure, print and write. Raises UserError."""
    own, rest = tools.split(argv, {"out": "out/objects.json", "parts": "1,8,16,24", "places": "3000"})
    if rest:
        raise UserError(f"'{rest[0]}': no such setting; there are out=, parts=, places=")
    out: dict = {"solids": {}}
    print(f"{'solid':<7}{'parts':>6}{'s':>6}   contact off by [mm]: mean   95 %    max  phantom     touch: mean   95 %")
    with tempfile.TemporaryDirectory() as folder:
        for name, mesh in solids().items():
            path = Path(folder) / f"{name}.stl"
            mesh.export(path)
            out["solids"][name] = {}
            for most in tools.numbers(own["parts"], "parts"):
                began = time.perf_counter()
                shape = load_mesh(path, 1.0, most)
                took = time.perf_counter() - began
                triangles = (np.asarray(mesh.triangles, float) - shape.file_centre) @ shape.file_axes
                centres = places(triangles, tools.numbers(own["places"], "places")[0])
                true = mesh_distance(centres, triangles)
                centres, true = centres[true > BALL - 0.002], true[true > BALL - 0.002]
                seen = contact_distance(shape, centres)
                error = np.abs(seen - (true - BALL))
                clear = true - BALL > 0.001
                felt = np.abs(shape.grid.sample(centres) - true)
                row = {
                    "parts": len(shape.hulls), "seconds": took, "contact_mean": error.mean(),
                    "contact_95": np.quantile(error, 0.95), "contact_max": error.max(),
                    "phantom": float((seen[clear] < 0).mean()), "touch_mean": felt.mean(),
                    "touch_95": np.quantile(felt, 0.95),
                }  # fmt: skip
                if name == "cup":
                    row["drop"] = drop(shape) - 0.006
                out["solids"][name][str(most)] = {k: float(v) for k, v in row.items()}
                mm = {k: 1e3 * v for k, v in row.items()}
                print(
                    f"{name:<7}{row['parts']:>6}{took:>6.0f}{mm['contact_mean']:>29.2f}{mm['contact_95']:>7.2f}"
                    f"{mm['contact_max']:>7.2f}{100 * row['phantom']:>7.1f} %"
                    f"{mm['touch_mean']:>16.2f}{mm['touch_95']:>7.2f}"
                    + (f"   dropped ball: {mm['drop']:+.1f} mm from the bottom" if "drop" in row else ""),
                    flush=True,
                )
    target = Path(own["out"])
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(json.dumps(out, indent=1))
    return out


if __name__ == "__main__":
    tools.command(main, __doc__)
