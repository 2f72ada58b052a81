"""The surfaces of fingertips and links that press objects, as points whose convex hull each is."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np

from dexsim import files
from dexsim.errors import UserError
from dexsim.hand.derive import S
from dexsim.hand.hand import Finger, Hand

MAX_SKIN = 32 << 20


def tip_skin(hand: Hand, finger: Finger) -> np.ndarray:
    """Return corners [V, 3] m in the tip body's frame: the pad's `skin` where it names one, else of the tip's geoms.

    Raises UserError for a file without vertices, and for geoms that have no surface points (planes, height fields).
    """
    if finger.pad is not None and finger.pad.skin is not None:
        flip = S if hand.mirror else np.ones(3)
        return obj_vertices(hand.folder / finger.pad.skin) * flip * hand.scale
    return geom_points(hand, finger.geoms)


def link_skins(hand: Hand) -> list[tuple[str, np.ndarray]]:
    """Return (body, corners [V, 3] m in its frame) of every link that presses objects: what touches the hand's
    other links."""
    tips = {f.body: tip_skin(hand, f) for f in hand.fingers}
    own = {body: geom_points(hand, geoms) for body, geoms in hand.links.items()}
    return [
        (body, np.concatenate([x[body] for x in (tips, own) if body in x])) for body in dict.fromkeys((*tips, *own))
    ]


def tip_skins(hand: Hand) -> list[np.ndarray]:
    """Return `tip_skin` of every finger."""
    return [tip_skin(hand, f) for f in hand.fingers]


@lru_cache(maxsize=64)
def _vertices(path: Path, stamp: int) -> np.ndarray:
    text = files.text(path, "fingertip skin", MAX_SKIN)
    try:
        rows = [[float(x) for x in line.split()[1:4]] for line in text.splitlines() if line.startswith("v ")]
        out = np.array(rows, dtype=float).reshape(-1, 3)
    except ValueError as error:
        raise UserError(f"fingertip skin {path}: {error}; a line 'v x y z' a vertex, m") from None
    if len(out) < 4 or not np.isfinite(out).all():
        raise UserError(f"fingertip skin {path}: {len(out)} vertices, must be 4 or more finite ones ('v x y z', m)")
    return out


def obj_vertices(path: Path) -> np.ndarray:
    """Return vertices [V, 3] of an OBJ file. Raises UserError."""
    files.check(path, "fingertip skin", MAX_SKIN)
    return _vertices(path, path.stat().st_mtime_ns).copy()


def geom_points(hand: Hand, geoms: tuple[str, ...]) -> np.ndarray:
    """Return points [V, 3] m of the surfaces of collision geoms, in the frame of their body."""
    model = hand.compiled
    ball = _sphere()
    out = []
    for name in geoms:
        g = model.geom(name)
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, g.quat)
        kind, size = int(g.type[0]), g.size
        t = mujoco.mjtGeom
        if kind == t.mjGEOM_MESH:
            at, n = model.mesh_vertadr[g.dataid[0]], model.mesh_vertnum[g.dataid[0]]
            points = model.mesh_vert[at : at + n].astype(float)
        elif kind == t.mjGEOM_SPHERE:
            points = ball * size[0]
        elif kind == t.mjGEOM_ELLIPSOID:
            points = ball * size
        elif kind == t.mjGEOM_CAPSULE:
            points = np.concatenate([ball * size[0] + [0, 0, s * size[1]] for s in (-1, 1)])
        elif kind == t.mjGEOM_BOX:
            points = size * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        elif kind == t.mjGEOM_CYLINDER:
            a = np.linspace(0, 2 * np.pi, 48, endpoint=False)
            ring = np.stack([size[0] * np.cos(a), size[0] * np.sin(a), 0 * a], 1)
            points = np.concatenate([ring + [0, 0, s * size[1]] for s in (-1, 1)])
        else:
            raise UserError(f"hand {hand.folder}: geom '{name}' of a fingertip: must be a mesh or a solid primitive")
        out.append(points @ turn.reshape(3, 3).T + g.pos)
    return np.concatenate(out)


def _sphere(around: int = 32, levels: int = 17) -> np.ndarray:
    """Return points [P, 3] on the unit sphere, both poles among them."""
    a = np.linspace(0, 2 * np.pi, around, endpoint=False)
    rings = [
        np.stack([np.cos(p) * np.cos(a), np.cos(p) * np.sin(a), np.full_like(a, np.sin(p))], 1)
        for p in np.linspace(-np.pi / 2, np.pi / 2, levels)
    ]
    return np.unique(np.round(np.concatenate(rings), 12), axis=0)
