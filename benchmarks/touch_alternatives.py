"""Other ways to the taxels' depths, on the scene of benchmarks.touch: mesh queries, wp.Volume, MuJoCo's tactile sensor.

The first two are one thread a taxel, as one would write them: pose into the object's frame, distance, the same force
law, raw forces written, nothing reduced. The sensor is MuJoCo-Warp's own; it gives depth and two slip speeds a taxel,
no force.
"""

# No `from __future__ import annotations`: Warp resolves these annotations from the closure.

from collections.abc import Callable
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import trimesh
import warp as wp

from dexsim.assets import xhand
from dexsim.assets.objects import library
from dexsim.tactile.kernel import HERTZ, Law, Pads, pose_in, taxel_force, turn_in, xyz

FAR = 0.03
"""m: how far a mesh query looks; deeper than any taxel of the scene lies."""


@wp.kernel(enable_backward=False, module="unique")
def by_mesh(
    xpos: wp.array2d(dtype=wp.vec3),
    xmat: wp.array2d(dtype=wp.mat33),
    pads: Pads,
    law: Law,
    mesh: wp.uint64,
    frame: int,
    felt: wp.array3d(dtype=float),
):
    w, f, t = wp.tid()
    p = pads.taxel[f, t]
    q = turn_in(xmat, w, pads.body[f], frame) * xyz(p) + pose_in(xpos, xmat, w, pads.body[f], frame)
    c = float(0.0)
    hit = wp.mesh_query_point_sign_normal(mesh, q, wp.static(FAR))
    if hit.result and hit.sign < 0.0:
        depth = wp.length(q - wp.mesh_eval_position(mesh, hit.face, hit.u, hit.v))
        c = taxel_force(wp.static(HERTZ), law, law.stiffness[f], depth, p[3], 0.0)
    felt[w, f, t] = c


@wp.kernel(enable_backward=False, module="unique")
def by_volume(
    xpos: wp.array2d(dtype=wp.vec3),
    xmat: wp.array2d(dtype=wp.mat33),
    pads: Pads,
    law: Law,
    volume: wp.uint64,
    frame: int,
    felt: wp.array3d(dtype=float),
):
    w, f, t = wp.tid()
    p = pads.taxel[f, t]
    q = turn_in(xmat, w, pads.body[f], frame) * xyz(p) + pose_in(xpos, xmat, w, pads.body[f], frame)
    c = float(0.0)
    d = wp.volume_sample_f(volume, wp.volume_world_to_index(volume, q), wp.Volume.LINEAR)
    if d < 0.0:
        c = taxel_force(wp.static(HERTZ), law, law.stiffness[f], -d, p[3], 0.0)
    felt[w, f, t] = c


def mesh_of(name: str, size: np.ndarray) -> trimesh.Trimesh:
    """The surface of a benchmark shape, in its own frame."""
    if name == "box":
        return trimesh.creation.box(extents=2 * np.asarray(size))
    if name == "sphere":
        return trimesh.creation.icosphere(subdivisions=3, radius=float(size[0]))
    return trimesh.convex.convex_hull(library()[name].hulls[0])


def grid_of(name: str, size: np.ndarray, spacing: float = 1.25e-3) -> tuple[np.ndarray, np.ndarray, float]:
    """(distances [x, y, z], origin [3], spacing) of a benchmark shape."""
    if name not in ("box", "sphere"):
        g = library()[name].grid
        return np.asarray(g.data, np.float32), np.asarray(g.origin), g.spacing
    half = np.asarray(size) if name == "box" else np.full(3, size[0])
    n = np.ceil(2 * (half + 3 * spacing) / spacing).astype(int) + 1
    origin = -spacing * (n - 1) / 2
    x = np.stack(np.meshgrid(*(origin[i] + spacing * np.arange(n[i]) for i in range(3)), indexing="ij"), -1)
    if name == "sphere":
        return (np.linalg.norm(x, axis=-1) - size[0]).astype(np.float32), origin, spacing
    d = np.abs(x) - half
    return (np.linalg.norm(np.maximum(d, 0), axis=-1) + np.minimum(d.max(-1), 0)).astype(np.float32), origin, spacing


class Queries:
    """Distance by mesh queries or by a wp.Volume for one scene; `launch` writes `felt` [N, F, W]."""

    def __init__(self, scene: Any, touch: Any, name: str, size: np.ndarray, how: str):
        self.device = scene.engine.device
        with wp.ScopedDevice(self.device):
            self.felt = wp.zeros((scene.engine.n, *touch._pads.taxel.shape), dtype=float)
            if how == "mesh":
                surface = mesh_of(name, size)
                faces = wp.array(np.asarray(surface.faces, np.int32).ravel(), dtype=int)
                self._held = wp.Mesh(wp.array(np.asarray(surface.vertices, np.float32), dtype=wp.vec3), faces)
                self.note = f"{len(surface.faces)} faces"
            else:
                data, origin, spacing = grid_of(name, size)
                self._held = wp.Volume.load_from_numpy(data, tuple(float(x) for x in origin), spacing, bg_value=FAR)
                self.note = f"{data.shape[0]} x {data.shape[1]} x {data.shape[2]} samples"
        self._kernel = by_mesh if how == "mesh" else by_volume
        e = scene.engine
        self._args = [e.wp.xpos, e.wp.xmat, touch._pads, touch._law, self._held.id, e.body("object"), self.felt]
        self.count = touch.layout.taxels

    def launch(self) -> None:
        wp.launch(self._kernel, dim=self.felt.shape, inputs=self._args, device=self.device)

    def forces(self) -> torch.Tensor:
        """Raw forces [N, F, T]."""
        return wp.to_torch(self.felt)[:, :, : self.count]


class Sensor:
    """MuJoCo-Warp's tactile sensor on the same hand, poses and taxels; `launch` is its velocity-sensor stage alone.

    Contacts are found once beforehand (the sensor asks which geoms touch the finger's body; the solver needs them
    anyhow).
    """

    def __init__(self, scene: Any, touch: Any, name: str, size: np.ndarray, qpos: np.ndarray):
        self.device, n = scene.engine.device, scene.engine.n
        self._points = touch._pads.taxel.numpy()[:, : touch.layout.taxels, :3]
        self._law, self._area, self.count = (
            touch._law,
            touch._pads.taxel.numpy()[:, : touch.layout.taxels, 3],
            touch.layout.taxels,
        )
        model, meshes = self._spec(name, size).compile(), [f"taxels_{f}" for f in xhand.FINGERS]
        verts = [int(model.mesh_vertnum[model.mesh(m).id]) for m in meshes]
        if verts != [self.count] * len(meshes):
            raise RuntimeError(f"MuJoCo kept {verts} of {self.count} taxels a pad")
        with wp.ScopedDevice(self.device):
            self._m = mjw.put_model(model)
            self._m.opt.warn_overflow = False
            self._d = mjw.put_data(model, mujoco.MjData(model), nworld=n, nconmax=48, njmax=256)
            wp.to_torch(self._d.qpos)[:] = torch.as_tensor(qpos, dtype=torch.float32)[torch.arange(n) % len(qpos)].to(
                self.device
            )
            mjw.fwd_position(self._m, self._d)
            mjw.fwd_velocity(self._m, self._d)
        self.note = "depth and two slip speeds"
        self._stiffness = touch._law.stiffness.numpy()

    def _spec(self, name: str, size: np.ndarray) -> mujoco.MjSpec:
        """The hand with a mesh of taxels on each fingertip, and the object; the hand does not touch itself, because the
        sensor would feel that too."""
        spec = xhand.hand_spec()
        for geom in list(spec.geoms):
            if not geom.contype and not geom.conaffinity:
                spec.delete(geom)
            else:
                geom.contype, geom.conaffinity = 0, 1
        g = mujoco.mjtGeom
        body = spec.worldbody.add_body(name="object")
        body.add_freejoint()
        common = dict(contype=1, conaffinity=0, mass=0.1, name="object")
        if name == "box":
            body.add_geom(type=g.mjGEOM_BOX, size=list(size), **common)
        elif name == "sphere":
            body.add_geom(type=g.mjGEOM_SPHERE, size=[size[0], 0, 0], **common)
        else:
            mesh = spec.add_mesh(name=name, uservert=np.asarray(library()[name].hulls[0], float).ravel())
            mesh.needsdf = True
            body.add_geom(type=g.mjGEOM_MESH, meshname=name, **common)
        for i, f in enumerate(xhand.FINGERS):
            spec.add_mesh(name=f"taxels_{f}", uservert=self._points[i].astype(float).ravel())
            spec.body(xhand.TIP_BODIES[i]).add_geom(
                name=f"pad_{f}", type=g.mjGEOM_MESH, meshname=f"taxels_{f}", mass=0, contype=0, conaffinity=0
            )
            spec.add_sensor(
                name=f"touch_{f}",
                type=mujoco.mjtSensor.mjSENS_TACTILE,
                objtype=mujoco.mjtObj.mjOBJ_MESH,
                objname=f"taxels_{f}",
                reftype=mujoco.mjtObj.mjOBJ_GEOM,
                refname=f"pad_{f}",
            )
        return spec

    def launch(self) -> None:
        with wp.ScopedDevice(self.device):
            mjw.sensor_vel(self._m, self._d)

    def forces(self) -> torch.Tensor:
        """What its depths give by the same law, [N, F, T]."""
        data = wp.to_torch(self._d.sensordata).cpu().reshape(self._d.nworld, len(xhand.FINGERS), -1)
        depth = data[:, :, : self.count]
        k = torch.as_tensor(self._stiffness)[:, None] * torch.as_tensor(self._area)
        return k * depth.sqrt()


def alternatives(scene: Any, touch: Any, name: str, size: np.ndarray, qpos: np.ndarray) -> dict[str, Callable[[], Any]]:
    """Name -> maker of something with `launch`, `forces` and `note`."""
    return {
        "mesh query": lambda: Queries(scene, touch, name, size, "mesh"),
        "wp.Volume": lambda: Queries(scene, touch, name, size, "volume"),
        "MuJoCo tactile": lambda: Sensor(scene, touch, name, size, qpos),
    }
