"""Surfaces as triangles: of a model's geoms, of convex hulls; points spread over them; their text as OBJ."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import mujoco
import numpy as np
from scipy.spatial import ConvexHull

Surface = tuple[np.ndarray, np.ndarray]
"""Vertices [V, 3] m and triangles [T, 3], outward."""


def rotation(quat: np.ndarray) -> np.ndarray:
    """Return the matrix [3, 3] of a quaternion (w, x, y, z)."""
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.asarray(quat, float))
    return out.reshape(3, 3)


def geom_surface(m: mujoco.MjModel, g: int) -> Surface:
    """Return a geom's surface in its body's frame; empty for planes, height fields and the like."""
    kind, size, t = m.geom_type[g], m.geom_size[g], mujoco.mjtGeom
    if kind == t.mjGEOM_MESH:
        k = m.geom_dataid[g]
        v, f = m.mesh_vertadr[k], m.mesh_faceadr[k]
        vertices = m.mesh_vert[v : v + m.mesh_vertnum[k]].astype(float)
        faces = m.mesh_face[f : f + m.mesh_facenum[k]].astype(int)
    else:
        from trimesh import creation  # here, for it takes half a second to import

        if kind == t.mjGEOM_BOX:
            shape = creation.box(extents=2 * size)
        elif kind == t.mjGEOM_SPHERE:
            shape = creation.icosphere(subdivisions=3, radius=size[0])
        elif kind == t.mjGEOM_ELLIPSOID:
            shape = creation.icosphere(subdivisions=3, radius=1.0)
            shape.apply_scale(size)
        elif kind == t.mjGEOM_CYLINDER:
            shape = creation.cylinder(radius=size[0], height=2 * size[1], sections=40)
        elif kind == t.mjGEOM_CAPSULE:
            shape = creation.capsule(radius=size[0], height=2 * size[1], count=(32, 16))
            shape.apply_translation([0, 0, -shape.bounds.mean(0)[2]])
        else:
            return np.zeros((0, 3)), np.zeros((0, 3), int)
        vertices, faces = np.asarray(shape.vertices, float), np.asarray(shape.faces, int)
    return vertices @ rotation(m.geom_quat[g]).T + m.geom_pos[g], faces


def of_geoms(m: mujoco.MjModel, geoms: Iterable[int]) -> Surface:
    """Return the surface of several geoms of one body, in its frame."""
    return joined([geom_surface(m, g) for g in geoms])


def joined(surfaces: Sequence[Surface]) -> Surface:
    """Return several surfaces as one."""
    at, vertices, faces = 0, [np.zeros((0, 3))], [np.zeros((0, 3), int)]
    for v, f in surfaces:
        vertices.append(v)
        faces.append(f + at)
        at += len(v)
    return np.concatenate(vertices), np.concatenate(faces)


def hull(points: np.ndarray) -> Surface:
    """Return the convex hull of points [P, 3]."""
    found = ConvexHull(points)
    used, faces = np.unique(found.simplices, return_inverse=True)
    faces = faces.reshape(-1, 3)
    vertices = found.points[used]
    inward = np.einsum("ij,ij->i", across(vertices[faces]), found.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return vertices, faces


def across(triangles: np.ndarray) -> np.ndarray:
    """Return vectors [T, 3] along the normals of triangles [T, 3, 3], twice their areas [m2] long."""
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def spread(triangles: np.ndarray, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return points [count, 3] spread at random over triangles [T, 3, 3], by area, and the triangle [count] of each."""
    area = np.linalg.norm(across(triangles), axis=1)
    chosen = rng.choice(len(triangles), count, p=area / area.sum())
    return np.einsum("pk,pki->pi", rng.dirichlet(np.ones(3), count), triangles[chosen]), chosen


def obj(surface: Surface) -> str:
    """Return wavefront OBJ text, metres."""
    lines = [f"v {x:.7g} {y:.7g} {z:.7g}\n" for x, y, z in surface[0] + 0.0]
    return "".join([*lines, *(f"f {a} {b} {c}\n" for a, b, c in surface[1] + 1)])
