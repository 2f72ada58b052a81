"""Bodies of a model: where they are, what hangs on what, which geoms carry their surface, and rays that meet it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import mujoco
import numpy as np

from dexsim.surface import Surface, of_geoms


def posed(m: mujoco.MjModel, q: np.ndarray | None = None) -> mujoco.MjData:
    """Return a model's data where its joints are at q [nq], as drawn without: frames, anchors and axes."""
    d = mujoco.MjData(m)
    if q is not None:
        d.qpos[:] = q
    mujoco.mj_kinematics(m, d)
    mujoco.mj_comPos(m, d)
    return d


def path(m: mujoco.MjModel, body: int) -> list[int]:
    """Return the bodies from the world to this one."""
    out = [int(body)]
    while out[-1]:
        out.append(int(m.body_parentid[out[-1]]))
    return out[::-1]


def with_fixed(m: mujoco.MjModel, bodies: Iterable[int]) -> list[int]:
    """Return bodies, and behind them those that are fixed to them."""
    out = list(bodies)
    for b in range(1, m.nbody):
        if m.body_parentid[b] in out and not m.body_jntnum[b] and b not in out:
            out.append(b)
    return out


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


def surface(m: mujoco.MjModel, body: int) -> Surface:
    """Return where a body's surface is (`solid`), in its frame."""
    return of_geoms(m, solid(m, body))


def solid_geoms(body: Any) -> list[Any]:
    """Return the same as `solid`, of a body of a model that is still being edited."""
    return [g for g in body.geoms if g.contype or g.conaffinity] or list(body.geoms)


def _geoms(m: mujoco.MjModel, body: int) -> list[int]:
    at = int(m.body_geomadr[body])
    return list(range(at, at + int(m.body_geomnum[body]))) if at >= 0 else []


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
