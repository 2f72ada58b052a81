"""The surfaces of fingertips and links that press objects, as points whose convex hull each is."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from dexsim import files
from dexsim.errors import UserError
from dexsim.hand.derive import S
from dexsim.hand.hand import Finger, Hand
from dexsim.surface import geom_surface

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
    model, out = hand.compiled, []
    for name in geoms:
        out.append(geom_surface(model, model.geom(name).id)[0])
        if not len(out[-1]):
            raise UserError(f"hand {hand.folder}: geom '{name}' of a fingertip: must be a mesh or a solid primitive")
    return np.concatenate(out)
