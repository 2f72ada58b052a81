"""Triangle meshes of a MuJoCo model's visible geoms, for a viewer in the browser."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

FAR = 10.0  # m from its body: a parked geom slot
SIDES = 24  # of round shapes


@dataclass(frozen=True)
class BodyMesh:
    """Vertices [V, 3] (m, body frame) and faces [F, 3] of one body's geoms of one colour (r, g, b, alpha in 0-1)."""

    vertices: np.ndarray
    faces: np.ndarray
    rgba: tuple[float, float, float, float]


def body_meshes(model: mujoco.MjModel) -> dict[int, list[BodyMesh]]:
    """Return the meshes of each body, geoms of one colour merged; geoms of groups 0 to 2 as MuJoCo's own viewer shows
    them, parked ones and planes left out."""
    parts: dict[tuple[int, tuple], list[tuple[np.ndarray, np.ndarray]]] = {}
    for g in range(model.ngeom):
        rgba = model.mat_rgba[model.geom_matid[g]] if model.geom_matid[g] >= 0 else model.geom_rgba[g]
        if model.geom_group[g] > 2 or rgba[3] == 0 or np.abs(model.geom_pos[g]).max() > FAR:
            continue
        shape = _shape(model, g)
        if shape is not None:
            rotation = np.zeros(9)
            mujoco.mju_quat2Mat(rotation, model.geom_quat[g])
            vertices = shape[0] @ rotation.reshape(3, 3).T + model.geom_pos[g]
            parts.setdefault((int(model.geom_bodyid[g]), tuple(round(float(c), 3) for c in rgba)), []).append(
                (vertices, shape[1])
            )
    found: dict[int, list[BodyMesh]] = {}
    for (body, rgba), shapes in parts.items():
        offsets = np.cumsum([0, *(len(v) for v, _ in shapes)])
        faces = np.concatenate([f + o for (_, f), o in zip(shapes, offsets)])
        found.setdefault(body, []).append(BodyMesh(np.concatenate([v for v, _ in shapes]), faces, rgba))
    return found


def _shape(model: mujoco.MjModel, g: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the vertices and faces of one geom in its own frame; None for kinds that are not drawn."""
    kind, size = mujoco.mjtGeom(model.geom_type[g]), model.geom_size[g]
    t = mujoco.mjtGeom
    if kind == t.mjGEOM_MESH:
        m = model.geom_dataid[g]
        vertices = model.mesh_vert[model.mesh_vertadr[m] : model.mesh_vertadr[m] + model.mesh_vertnum[m]]
        return vertices.astype(float), model.mesh_face[
            model.mesh_faceadr[m] : model.mesh_faceadr[m] + model.mesh_facenum[m]
        ].astype(int)
    if kind == t.mjGEOM_BOX:
        return _box(size)
    if kind == t.mjGEOM_SPHERE:
        return _turned(*_arc(size[0], 0.0))
    if kind == t.mjGEOM_CAPSULE:
        return _turned(*_arc(size[0], size[1]))
    if kind == t.mjGEOM_CYLINDER:
        r, h = size[:2]
        return _turned(np.array([0.0, r, r, 0.0]), np.array([-h, -h, h, h]))
    if kind == t.mjGEOM_ELLIPSOID:
        vertices, faces = _turned(*_arc(1.0, 0.0))
        return vertices * size, faces
    return None


def _box(half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float) * half
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def _arc(radius: float, half: float) -> tuple[np.ndarray, np.ndarray]:
    """Profile (radius, height) of a capsule from its lower to its upper pole; half = 0: a sphere."""
    quarter = np.linspace(0, np.pi / 2, SIDES // 4 + 1)
    lower, upper = -quarter[::-1], quarter if half else quarter[1:]
    angle = np.concatenate([lower, upper])
    shift = np.concatenate([np.full(len(lower), -half), np.full(len(upper), half)])
    return radius * np.cos(angle), radius * np.sin(angle) + shift


def _turned(radius: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface of revolution about z of a profile [P]."""
    angle = np.linspace(0, 2 * np.pi, SIDES, endpoint=False)
    vertices = np.stack(
        [radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle), np.repeat(height[:, None], SIDES, 1)], -1
    ).reshape(-1, 3)
    faces = []
    for p in range(len(radius) - 1):
        for k in range(SIDES):
            a, b = p * SIDES + k, p * SIDES + (k + 1) % SIDES
            faces += [(a, b, b + SIDES), (a, b + SIDES, a + SIDES)]
    return vertices, np.array(faces)
