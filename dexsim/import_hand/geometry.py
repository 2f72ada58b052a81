"""Surfaces of a model's bodies, as triangles in the body's frame, and rays that meet them."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

Surface = tuple[np.ndarray, np.ndarray]
"""Vertices [V, 3] m and triangles [T, 3], outward."""


def rotation(quat: np.ndarray) -> np.ndarray:
    """Return matrix [3, 3] of a quaternion (w, x, y, z)."""
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.asarray(quat, float))
    return out.reshape(3, 3)


def quaternion(matrix: np.ndarray) -> np.ndarray:
    """Return quaternion (w, x, y, z) of a matrix [3, 3]."""
    out = np.zeros(4)
    mujoco.mju_mat2Quat(out, np.asarray(matrix, float).ravel())
    return out


def geom_surface(m: mujoco.MjModel, g: int) -> Surface:
    """Return a geom's surface in its body's frame; empty for planes, height fields and the like."""
    import trimesh

    kind, size, t = m.geom_type[g], m.geom_size[g], mujoco.mjtGeom
    if kind == t.mjGEOM_MESH:
        k = m.geom_dataid[g]
        v, f = m.mesh_vertadr[k], m.mesh_faceadr[k]
        vertices = m.mesh_vert[v : v + m.mesh_vertnum[k]].astype(float)
        faces = m.mesh_face[f : f + m.mesh_facenum[k]].astype(int)
    else:
        if kind == t.mjGEOM_BOX:
            shape = trimesh.creation.box(extents=2 * size)
        elif kind == t.mjGEOM_SPHERE:
            shape = trimesh.creation.icosphere(subdivisions=3, radius=size[0])
        elif kind == t.mjGEOM_ELLIPSOID:
            shape = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
            shape.apply_scale(size)
        elif kind == t.mjGEOM_CYLINDER:
            shape = trimesh.creation.cylinder(radius=size[0], height=2 * size[1], sections=40)
        elif kind == t.mjGEOM_CAPSULE:
            shape = trimesh.creation.capsule(radius=size[0], height=2 * size[1], count=(32, 16))
            shape.apply_translation([0, 0, -shape.bounds.mean(0)[2]])
        else:
            return np.zeros((0, 3)), np.zeros((0, 3), int)
        vertices, faces = np.asarray(shape.vertices, float), np.asarray(shape.faces, int)
    return vertices @ rotation(m.geom_quat[g]).T + m.geom_pos[g], faces


def joined(surfaces: list[Surface]) -> Surface:
    """Return several surfaces as one."""
    at, vertices, faces = 0, [np.zeros((0, 3))], [np.zeros((0, 3), int)]
    for v, f in surfaces:
        vertices.append(v)
        faces.append(f + at)
        at += len(v)
    return np.concatenate(vertices), np.concatenate(faces)


def colliding(m: mujoco.MjModel, body: int) -> list[int]:
    """Return geoms of a body that its author lets collide."""
    return [g for g in _geoms(m, body) if m.geom_contype[g] or m.geom_conaffinity[g]]


def seen(m: mujoco.MjModel, body: int) -> list[int]:
    """Return geoms of a body that are drawn: those that do not collide, or all where all collide."""
    geoms = _geoms(m, body)
    return [g for g in geoms if not (m.geom_contype[g] or m.geom_conaffinity[g])] or geoms


def solid(m: mujoco.MjModel, body: int) -> list[int]:
    """Return geoms that say where a body's surface is: those that collide, or else those that are drawn."""
    return colliding(m, body) or _geoms(m, body)


def solid_geoms(body: Any) -> list[Any]:
    """Return the same as `solid`, of a body of a model that is still being edited."""
    return [g for g in body.geoms if g.contype or g.conaffinity] or list(body.geoms)


def _geoms(m: mujoco.MjModel, body: int) -> list[int]:
    at = int(m.body_geomadr[body])
    return list(range(at, at + int(m.body_geomnum[body]))) if at >= 0 else []


def points_on(surface: Surface, count: int, seed: int = 0) -> np.ndarray:
    """Return points [count, 3] spread over a surface, by area."""
    vertices, faces = surface
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    rng = np.random.default_rng(seed)
    chosen = corners[rng.choice(len(faces), count, p=area / area.sum())]
    return np.einsum("pk,pki->pi", rng.dirichlet(np.ones(3), count), chosen)


def first_hits(surface: Surface, origins: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where parallel rays first meet a surface: distances [R] (inf: never) and the unit normals there [R, 3],
    turned against the rays.

    Moeller and Trumbore (1997), Fast, minimum storage ray/triangle intersection; both sides of a triangle count.
    """
    vertices, faces = surface
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    size = np.linalg.norm(normal, axis=1)
    keep = (size > 0) & (np.abs(normal @ direction) > 1e-9 * size)
    a, b, c, normal = a[keep], b[keep], c[keep], normal[keep] / size[keep, None]
    distance = np.full(len(origins), np.inf)
    hit = np.zeros((len(origins), 3))
    if not len(a):
        return distance, hit
    e1, e2 = b - a, c - a
    p = np.cross(direction, e2)
    det = np.einsum("ij,ij->i", e1, p)
    for r, origin in enumerate(origins):
        s = origin - a
        u = np.einsum("ij,ij->i", s, p) / det
        q = np.cross(s, e1)
        v = q @ direction / det
        t = np.einsum("ij,ij->i", e2, q) / det
        inside = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (t > 0)
        if inside.any():
            t = np.where(inside, t, np.inf)
            k = int(t.argmin())
            distance[r] = t[k]
            hit[r] = -normal[k] * np.sign(normal[k] @ direction)
    return distance, hit


def open_edges(surface: Surface) -> int:
    """Return how many edges of a surface border a hole (0: it is closed). Corners at one place count as one."""
    vertices, faces = surface
    _, same = np.unique(np.round(vertices / 1e-7).astype(np.int64), axis=0, return_inverse=True)
    merged = same.ravel()[faces]
    merged = merged[(merged[:, 0] != merged[:, 1]) & (merged[:, 1] != merged[:, 2]) & (merged[:, 2] != merged[:, 0])]
    edges = np.sort(merged[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    return int((counts % 2).sum())
