"""Palm, fingers and tips, from the tree of bodies and joints alone."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import mujoco
import numpy as np

from dexsim.errors import UserError
from dexsim.import_hand import geometry

NAMED = (
    ("thumb", r"thumb|(^|[^a-z])th([^a-z]|$)|thj\d|th(distal|middle|proximal|base|hub|tip)"),
    ("index", r"index|fore|(^|[^a-z])(ff|if)([^a-z]|$)|ffj\d|ff(distal|middle|proximal|knuckle|tip)"),
    ("middle", r"middle_?f|mid(dle)?([^a-z]|$)|(^|[^a-z])mf([^a-z]|$)|mfj\d|mf(distal|middle|proximal|knuckle|tip)"),
    ("ring", r"ring|(^|[^a-z])rf([^a-z]|$)|rfj\d|rf(distal|middle|proximal|knuckle|tip)"),
    ("little", r"little|pinky|(^|[^a-z])lf([^a-z]|$)|lfj\d|lf(distal|middle|proximal|knuckle|metacarpal|tip)"),
)
"""What people call fingers."""


@dataclass
class Finger:
    """A finger found. joints: ids root to tip; tip: id of the distal body that carries the tip's surface; geoms: ids of
    that surface."""

    name: str
    joints: list[int]
    tip: int
    geoms: list[int] = field(default_factory=list)


@dataclass
class Tree:
    """palm: id of the body that all fingers hang on; fingers; before_palm: names of joints before the palm (a wrist, an
    arm), which are fixed; passive: ids of the fingers' joints that follow others."""

    palm: int
    fingers: list[Finger]
    before_palm: list[str]
    passive: set[int] = field(default_factory=set)

    @property
    def every(self) -> list[int]:
        """Return ids of the hand's joints: finger by finger, root to tip, a shared one with the first finger that has
        it."""
        return list(dict.fromkeys(j for f in self.fingers for j in f.joints))

    @property
    def joints(self) -> list[int]:
        """Return ids of the joints that have a drive of their own."""
        return [j for j in self.every if j not in self.passive]


def find(m: mujoco.MjModel, where: str, palm: str | None = None) -> Tree:
    """Find palm and fingers: fingers are the chains that end in a moving body with nothing that moves behind it; the
    palm is the last body that all of them share.

    palm: name of the body to take for it. Raises UserError where this is no hand: fewer than two fingers, a tip
    without a surface.
    """
    if palm is not None and mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_BODY, palm) < 0:
        raise UserError(f"{where}: palm={palm}: no such body; there are {', '.join(_names(m))}")
    root = 0 if palm is None else m.body(palm).id
    below = {b: geometry.path(m, b) for b in range(m.nbody)}
    moving = [b for b in range(1, m.nbody) if m.body_jntnum[b] and root in below[b] and b != root]
    ends = [b for b in moving if not any(b in below[c][:-1] for c in moving)]
    if len(ends) < 2:
        raise UserError(
            f"{where}: {len(ends)} finger(s) found: a hand has two or more chains of joints on one body; joints:"
            f" {', '.join(m.joint(j).name for j in range(m.njnt)) or 'none'}"
        )
    if palm is None:
        shared = [b for b in below[ends[0]] if all(b in below[e] for e in ends)]
        root = shared[-1]
        if root == 0:
            raise UserError(f"{where}: the fingers hang on the world; they need one body for a palm (a base link)")
    fingers = []
    for end in ends:
        path = below[end][below[end].index(root) + 1 :]
        joints = [j for b in path for j in range(m.body_jntadr[b], m.body_jntadr[b] + m.body_jntnum[b])]
        tip = _tip(m, end)
        if not geometry.solid(m, tip):
            raise UserError(
                f"{where}: the finger that ends in '{m.body(end).name}' has no shape at its end: give that link a"
                " collision or visual shape"
            )
        fingers.append(Finger("", joints, tip, _tip_geoms(m, tip)))
    _name(m, fingers)
    before = [m.joint(j).name for j in range(m.njnt) if m.jnt_bodyid[j] in below[root]]
    return Tree(root, fingers, before)


def _names(m: mujoco.MjModel) -> list[str]:
    return [m.body(b).name for b in range(1, m.nbody)]


def _tip(m: mujoco.MjModel, end: int) -> int:
    """Return the body that carries the fingertip's surface: the distal moving body, or one fixed to it that reaches
    farther (a rubber tip on a link of its own)."""
    data = geometry.posed(m)
    best, reach = end, -1.0
    for b in geometry.with_fixed(m, [end]):
        points = geometry.surface(m, b)[0]
        if not len(points):
            continue
        far = np.linalg.norm(points @ data.xmat[b].reshape(3, 3).T + data.xpos[b] - data.xpos[end], axis=1).max()
        if far > reach + 1e-4:
            best, reach = b, far
    return best


def _tip_geoms(m: mujoco.MjModel, tip: int) -> list[int]:
    """Return the tip's own surface: geoms called tip or pad, else all of the body's."""
    geoms = geometry.solid(m, tip)

    def named(g: int) -> str:
        mesh = m.mesh(m.geom_dataid[g]).name if m.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH else ""
        return f"{m.geom(g).name} {mesh}".lower()

    return [g for g in geoms if re.search(r"tip|pad|rubber", named(g))] or geoms


def _name(m: mujoco.MjModel, fingers: list[Finger]) -> None:
    """Names: what the author calls the finger, or finger0, finger1, ..."""
    names = []
    for finger in fingers:
        words = " ".join([m.joint(j).name for j in finger.joints] + [m.body(finger.tip).name]).lower()
        hits = {name: len(re.findall(pattern, words)) for name, pattern in NAMED}
        best = max(hits, key=lambda n: hits[n])
        names.append(best if hits[best] else "")
    for k, (finger, name) in enumerate(zip(fingers, names, strict=True)):
        finger.name = name if name and names.count(name) == 1 else f"finger{k}"
    fingers.sort(key=lambda f: f.name != "thumb")  # the thumb first, the others in the file's order
