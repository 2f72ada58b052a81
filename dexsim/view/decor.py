"""Adds to a rendered scene what a model does not draw: a table, a forearm, pushes, lit taxels, a cube's colours."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

TABLE, ARM = np.array([0.62, 0.66, 0.71, 1.0]), np.array([0.35, 0.38, 0.42, 1.0])
PUSH = np.array([0.88, 0.15, 0.13, 1.0])
FACES = np.array(  # +x, -x, +y, -y, +z, -z of a cube
    [[0.90, 0.20, 0.17, 1], [0.95, 0.55, 0.10, 1], [0.15, 0.65, 0.30, 1], [0.12, 0.35, 0.80, 1],
     [0.97, 0.97, 0.95, 1], [0.98, 0.85, 0.15, 1]]
)  # fmt: skip
METRES_A_NEWTON = 0.03  # length of a push's arrow, of 0.12 m at most
FULL_TAXEL = 0.25  # N, of the brightest taxel


def turn_down(gravity: np.ndarray) -> np.ndarray:
    """Return the rotation [3, 3] that takes a direction of gravity [3] to straight down."""
    return Rotation.align_vectors([[0.0, 0.0, -1.0]], [gravity if np.any(gravity) else [0.0, 0.0, -1.0]])[0].as_matrix()


class Decor:
    """Decoration of one world's scene.

    Args:
        model: compiled model; its first body below the world is the hand.
        arrays: of a clip, rows by frame: push [T, 3] N on the object, taxels [T, F, K] N with taxel_point and
            taxel_normal [F, K, 3] (m, frames of `bodies`), gravity [T, 3] m/s^2. Each may be absent.
        bodies: names of the bodies that carry the taxels [F].
        colours: whether a box's faces get six colours.
    """

    def __init__(self, model: Any, arrays: Any, bodies: list[str], colours: bool) -> None:
        self._model, self._colours = model, colours
        names = ("push", "taxels", "taxel_point", "taxel_normal", "gravity")
        self._arrays = {k: arrays[k] for k in names if k in arrays}
        self._bodies = [model.body(name).id for name in bodies]
        named = {model.body(b).name: b for b in range(model.nbody)}
        self._object, self._table = named.get("object", -1), "table" in named
        self._roots = [b for b in range(1, model.nbody) if model.body_parentid[b] == 0 and not model.body_dofnum[b]]
        self._pos, self._quat = model.body_pos.copy(), model.body_quat.copy()

    def turn(self, k: int, qpos: np.ndarray) -> np.ndarray:
        """Turn the hand as frame k's gravity says, and return the pose [nq] in which the object has turned with it."""
        if "gravity" not in self._arrays:
            return qpos
        rotation = turn_down(self._arrays["gravity"][k])
        quat, turned = np.zeros(4), np.zeros(4)
        mujoco.mju_mat2Quat(quat, rotation.ravel())
        qpos = qpos.copy()
        for b in self._roots:
            self._model.body_pos[b] = rotation @ self._pos[b]
            mujoco.mju_mulQuat(turned, quat, self._quat[b])
            self._model.body_quat[b] = turned
        for j in np.flatnonzero(self._model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
            at = self._model.jnt_qposadr[j]
            qpos[at : at + 3] = rotation @ qpos[at : at + 3]
            mujoco.mju_mulQuat(turned, quat, qpos[at + 3 : at + 7])
            qpos[at + 3 : at + 7] = turned
        return qpos

    def draw(self, scene: Any, data: Any, k: int) -> None:
        """Add the geoms of frame k to a scene; data: after the forward kinematics of that frame."""
        if not self._table:
            floor = np.array([0.03, 0.0, -0.13])
            self._add(scene, mujoco.mjtGeom.mjGEOM_CYLINDER, [0.45, 0.004, 0.0], floor, np.eye(3), TABLE)
        if self._object >= 0:  # a hand that stands in the world's middle, fingers along its x axis
            frame = turn_down(self._arrays["gravity"][k]) if "gravity" in self._arrays else np.eye(3)
            if self._model.body_dofnum[1]:  # on a base that moves
                frame = data.xmat[1].reshape(3, 3)
            along = frame @ np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]).T
            middle = data.xpos[1] * bool(self._model.body_dofnum[1]) + frame @ np.array([-0.16, 0.0, -0.02])
            self._add(scene, mujoco.mjtGeom.mjGEOM_CAPSULE, [0.03, 0.12, 0.0], middle, along, ARM)
        if self._colours and self._object >= 0:
            self._faces(scene, data)
        if "taxels" in self._arrays:
            self._taxels(scene, data, k)
        if "push" in self._arrays and self._object >= 0:
            force = self._arrays["push"][k]
            if "gravity" in self._arrays:
                force = turn_down(self._arrays["gravity"][k]) @ force
            size = float(np.linalg.norm(force))
            if size > 1e-3:
                self._arrow(scene, data.xipos[self._object], force / size, min(METRES_A_NEWTON * size, 0.12) + 0.06)

    def _arrow(self, scene: Any, at: np.ndarray, way: np.ndarray, length: float) -> None:
        """Draw an arrow that ends at a point of the object's surface, seen from its middle `at`."""
        if scene.ngeom >= scene.maxgeom:
            return
        tip = at - 0.03 * way
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_ARROW, np.zeros(3), np.zeros(3), np.eye(3).ravel(),
                            PUSH.astype(np.float32))  # fmt: skip
        mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_ARROW, 0.007, tip - length * way, tip)
        scene.ngeom += 1

    def _taxels(self, scene: Any, data: Any, k: int) -> None:
        """Light the taxels that feel a force: yellow to dark red."""
        from dexsim.view.live_panels import colours

        forces = self._arrays["taxels"][k]
        for f, body in enumerate(self._bodies):
            lit = np.flatnonzero(forces[f] > 0.01)
            if not len(lit):
                continue
            rgb = colours(forces[f][lit], FULL_TAXEL) / 255.0
            frame = data.xmat[body].reshape(3, 3)
            points = self._arrays["taxel_point"][f][lit] + 5e-4 * self._arrays["taxel_normal"][f][lit]
            for point, colour in zip(data.xpos[body] + points @ frame.T, rgb, strict=True):
                rgba = np.r_[colour, 1.0]
                self._add(scene, mujoco.mjtGeom.mjGEOM_SPHERE, [1.1e-3, 0, 0], point, np.eye(3), rgba, 0.6)

    def _faces(self, scene: Any, data: Any) -> None:
        """Lay a coloured plate on each face of the object's boxes."""
        for g in np.flatnonzero(self._model.geom_bodyid == self._object):
            if self._model.geom_type[g] != mujoco.mjtGeom.mjGEOM_BOX or np.abs(self._model.geom_pos[g]).max() > 1.0:
                continue
            half, frame = self._model.geom_size[g], data.geom_xmat[g].reshape(3, 3)
            for face, colour in enumerate(FACES):
                axis, side = face // 2, 1 - 2 * (face % 2)
                size = 0.86 * half
                size[axis] = 4e-4
                centre = data.geom_xpos[g] + side * half[axis] * frame[:, axis]
                self._add(scene, mujoco.mjtGeom.mjGEOM_BOX, size, centre, frame, colour)

    @staticmethod
    def _add(scene: Any, kind: Any, size: Any, pos: Any, mat: Any, rgba: Any, glow: float = 0.0) -> None:
        if scene.ngeom >= scene.maxgeom:
            return
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(geom, kind, np.asarray(size, float), np.asarray(pos, float), np.asarray(mat, float).ravel(),
                            np.asarray(rgba, np.float32))  # fmt: skip
        geom.emission = glow
        scene.ngeom += 1
