"""Which way a finger closes, where its tip is, and the palm's frame: guesses from joints' axes, limits and surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from dexsim.import_hand import geometry
from dexsim.import_hand.tree import Finger, Tree
from dexsim.surface import joined, of_geoms, spread

PARALLEL = 0.8
"""Cosine from which on a joint's axis counts as that of the distal joint: they bend the finger in one plane."""

HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
SNAP = np.cos(np.radians(12.0))


@dataclass
class Motion:
    """How a finger moves. flexion: ids of the joints that close it, root to tip; closes: +1 or -1 each; position [3] m,
    normal [3]: of its tip, in the tip body's frame; reach: m from its root to its tip, stretched; straight: angle of
    each flexion joint [rad] there."""

    finger: Finger
    flexion: list[int]
    closes: list[int]
    position: np.ndarray
    normal: np.ndarray
    reach: float
    straight: np.ndarray


@dataclass(frozen=True)
class Palm:
    """In the frame of the palm's body: position [3] m, forward [3], normal [3] unit and at right angles."""

    position: np.ndarray
    forward: np.ndarray
    normal: np.ndarray

    @cached_property
    def matrix(self) -> np.ndarray:
        """Columns: the palm frame's x, y, z."""
        return np.stack([self.forward, np.cross(self.normal, self.forward), self.normal], 1)


def unit(v: np.ndarray) -> np.ndarray:
    """Scale v [..., 3] to length 1; zero stays."""
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)


def neutral(m: mujoco.MjModel) -> np.ndarray:
    """Return every joint at 0, or at the nearest of its limits [nq]."""
    return np.clip(np.zeros(m.nq), m.jnt_range[:, 0], m.jnt_range[:, 1])


def motions(
    m: mujoco.MjModel, fingers: list[Finger], flexion: list[list[int] | None], closes: list[list[int] | None]
) -> tuple[list[Motion], list[str]]:
    """Return how every finger moves, and a line for each whose closing side is not sure; flexion, closes: where a
    person has said them, else None.

    The joints that bend a finger have the axis of the distal one (within 37 degrees) where all joints are at 0. They
    close it together, as their axes say, towards the end that brings its tip nearer to the other fingertips; where
    that does not tell, towards the side on which they have more room. The tip lies on the axis of the distal link,
    three quarters out.
    """
    d = geometry.posed(m, neutral(m))
    bends, tips = [], []
    for finger, said in zip(fingers, flexion, strict=True):
        distal = finger.joints[-1]
        own = [j for j in finger.joints if abs(d.xaxis[j] @ d.xaxis[distal]) > PARALLEL and m.jnt_type[j] == HINGE]
        bends.append(said or own or [distal])
        tips.append(_tip(m, d, finger, bends[-1][-1]))
    guess, doubts = _closing(m, d, fingers, bends, tips)
    out, lines = [], []
    for k, finger in enumerate(fingers):
        given = closes[k]
        signs = guess[k] if given is None or len(given) != len(bends[k]) else given
        if signs is guess[k] and doubts[k]:
            lines.append(f"finger {finger.name}: {doubts[k]}: say fingers.{finger.name}.closes={[-x for x in signs]}"
                         " where that is wrong")  # fmt: skip
        out.append(_moved(m, d, finger, bends[k], list(signs), tips[k]))
    return out, lines


STEP = 0.1  # of the way from where a finger is drawn to its ends: how its tip begins to move
FACING = 0.1  # of a tip's way, taken towards the other tips: less does not tell a side
LEAN = 0.2  # of a joint's range, more on one side of 0 than on the other: less does not tell one either


def _closing(
    m: mujoco.MjModel, d: mujoco.MjData, fingers: list[Finger], bends: list[list[int]], tips: list[np.ndarray]
) -> tuple[list[list[int]], list[str]]:
    """Return which way the joints of each finger close it, and a doubt, or "", for each. d: at `neutral`; tips [F][3]
    m: in the tips' frames."""
    together, ends, room = [], [], []
    for finger, joints, tip in zip(fingers, bends, tips, strict=True):
        sign = [int(np.sign(d.xaxis[j] @ d.xaxis[joints[-1]])) if m.jnt_type[j] == HINGE else 1 for j in joints]
        lean = [s * m.jnt_range[j].sum() / max(np.ptp(m.jnt_range[j]), 1e-9) if m.jnt_type[j] == HINGE else 0.0
                for s, j in zip(sign, joints, strict=True)]  # fmt: skip  # a slide's 0 is either end
        moved = []
        for way in (1, -1):
            q = neutral(m)
            for s, j in zip(sign, joints, strict=True):
                q[j] += STEP * (m.jnt_range[j, 1 if way * s > 0 else 0] - q[j])
            other = mujoco.MjData(m)
            other.qpos[:] = q
            mujoco.mj_kinematics(m, other)
            moved.append(tip_at(other, finger.tip, tip))
        together.append(sign)
        ends.append(moved)
        room.append(float(np.mean(lean)))
    ways = [0 if x >= 0 else 1 for x in room]  # index into ends
    nearer = [0.0] * len(fingers)
    for _ in range(len(fingers) + 2):  # each against where the others go, until none turns round
        before = list(ways)
        for k, (one, other) in enumerate(ends):
            goals = np.array([ends[n][ways[n]] for n in range(len(fingers)) if n != k])
            far = [float(np.linalg.norm(goals - tip, axis=1).mean()) for tip in (one, other)]
            nearer[k] = (far[1] - far[0]) / max(float(np.linalg.norm(one - other)), 1e-4)
            if abs(nearer[k]) > FACING:
                ways[k] = 0 if nearer[k] > 0 else 1
        if ways == before:
            break
    out, doubts = [], []
    for k, sign in enumerate(together):
        side, doubt = ways[k], ""
        if abs(nearer[k]) <= FACING and abs(room[k]) <= LEAN:
            doubt = "neither its limits nor the other fingertips tell which way it closes, guessed"
        elif nearer[k] * room[k] < 0 and abs(nearer[k]) > FACING and abs(room[k]) > LEAN:
            doubt = "closes towards the other fingertips, though its joints have more room to the other side"
            if abs(nearer[k]) < min(0.5, abs(room[k])):
                side = 0 if room[k] > 0 else 1
                doubt = "closes to the side where its joints have more room, though that leads off the other fingertips"
        out.append([s if side == 0 else -s for s in sign])
        doubts.append(doubt)
    return out, doubts


def _tip(m: mujoco.MjModel, d: mujoco.MjData, finger: Finger, last: int) -> np.ndarray:
    """Return the end of a finger [3] m, in its tip's frame; last: id of its last flexion joint."""
    distal = finger.joints[-1]
    points = of_geoms(m, finger.geoms)[0]
    world = d.xmat[finger.tip].reshape(3, 3)
    points = points @ world.T + d.xpos[finger.tip]
    axis = d.xaxis[last]
    along = points.mean(0) - d.xanchor[distal]
    along = unit(along - axis * (axis @ along))
    reach = (points - d.xanchor[distal]) @ along
    low, high = reach.min(), reach.max()
    outer = points[reach >= high - 0.5 * (high - max(low, 0.0))]
    middle = 0.5 * (outer.min(0) + outer.max(0))
    tip = middle + along * (max(low, 0.0) + 0.75 * (high - max(low, 0.0)) - (middle - d.xanchor[distal]) @ along)
    return world.T @ (tip - d.xpos[finger.tip])


def _moved(
    m: mujoco.MjModel, d: mujoco.MjData, finger: Finger, flexion: list[int], closes: list[int], position: np.ndarray
) -> Motion:
    """Return a finger's motion; d: at `neutral`."""
    distal, last = finger.joints[-1], flexion[-1]
    world = d.xmat[finger.tip].reshape(3, 3)
    tip = tip_at(d, finger.tip, position)
    hinge = m.jnt_type[last] == HINGE
    axis = d.xaxis[last]
    points = of_geoms(m, finger.geoms)[0] @ world.T + d.xpos[finger.tip]
    along = points.mean(0) - d.xanchor[distal]
    along = unit(along - axis * (axis @ along))
    closing = closes[-1] * (np.cross(axis, tip - d.xanchor[last]) if hinge else d.xaxis[last])
    normal = unit(closing - along * (along @ closing))
    straight, longest = _stretched(m, finger, flexion, position)
    for k, (j, close) in enumerate(zip(flexion, closes, strict=True)):
        if m.jnt_type[j] != HINGE:  # a slide is no longer stretched than bent: it is open
            straight[k] = m.jnt_range[j, 0 if close > 0 else 1]
    return Motion(finger, list(flexion), closes, position, world.T @ normal, longest, straight)


def _stretched(m: mujoco.MjModel, finger: Finger, flexion: list[int], position: np.ndarray) -> tuple[np.ndarray, float]:
    """Return flexion angles at which the tip is farthest from the finger's first flexion joint, and how far."""
    d = mujoco.MjData(m)
    q = neutral(m)
    root = flexion[0]

    def far() -> float:
        d.qpos[:] = q
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)
        return float(np.linalg.norm(tip_at(d, finger.tip, position) - d.xanchor[root]))

    best = far()
    for _ in range(2):
        for j in flexion[1:]:
            best_angle = q[j]
            for angle in np.linspace(m.jnt_range[j, 0], m.jnt_range[j, 1], 41):
                q[j] = angle
                if (reach := far()) > best + 1e-6:
                    best, best_angle = reach, angle
            q[j] = best_angle
    return q[flexion].copy(), best


def tip_at(d: mujoco.MjData, body: int, position: np.ndarray) -> np.ndarray:
    """Return a point of a body in the world."""
    return d.xmat[body].reshape(3, 3) @ position + d.xpos[body]


def stretched(m: mujoco.MjModel, motions: list[Motion]) -> np.ndarray:
    """Return every finger stretched [nq]."""
    q = neutral(m)
    for x in motions:
        q[x.flexion] = x.straight
    return q


def opposing(m: mujoco.MjModel, motions: list[Motion]) -> list[int]:
    """Return which finger presses against the others: the one called thumb, or the one that points and closes least
    like them. One that closes against the others' direction joins it."""
    for k, x in enumerate(motions):
        if x.finger.name == "thumb":
            return [k]
    d = geometry.posed(m, stretched(m, motions))
    roots = np.array([d.xanchor[x.flexion[0]] for x in motions])
    tips = np.array([tip_at(d, x.finger.tip, x.position) for x in motions])
    normals = np.array([d.xmat[x.finger.tip].reshape(3, 3) @ x.normal for x in motions])
    spread = max(np.ptp(roots, axis=0).max(), 1e-6)
    score = []
    for k in range(len(motions)):
        others = [n for n in range(len(motions)) if n != k]
        pointing = 1 - unit(tips - roots)[k] @ unit(unit(tips - roots)[others].mean(0))
        closing = 1 - normals[k] @ unit(normals[others].mean(0))
        separation = np.linalg.norm(roots[k] - roots[others].mean(0)) / spread
        score.append(pointing + closing + 0.5 * separation)
    return [int(np.argmax(score))]


def palm(m: mujoco.MjModel, tree: Tree, motions: list[Motion], thumbs: list[int]) -> Palm:
    """Return the palm's frame: forward along the stretched fingers that do not oppose, the normal along their tips' way
    as they close, the origin in the middle of the palm's surface points."""
    d = geometry.posed(m, stretched(m, motions))
    fingers = [x for k, x in enumerate(motions) if k not in thumbs]
    tips = np.array([tip_at(d, x.finger.tip, x.position) for x in fingers])
    roots = np.array([d.xanchor[x.flexion[0]] for x in fingers])
    axes = np.array([d.xaxis[x.flexion[0]] for x in fingers])
    along = tips - roots  # an anchor may lie anywhere on its axis
    along -= axes * np.einsum("fi,fi->f", along, axes)[:, None]
    forward = unit(unit(along).mean(0))
    normals = np.array([d.xmat[x.finger.tip].reshape(3, 3) @ x.normal for x in fingers])
    normal = normals.mean(0)
    facing = [d.xmat[x.finger.tip].reshape(3, 3) @ x.normal for x in motions]
    if np.linalg.norm(normal) < 0.3 or (len(motions) < 4 and np.linalg.norm(np.mean(facing, axis=0)) < 0.3):
        # fingers around a centre (a gripper): they close towards it, its palm looks along them
        every = np.array([tip_at(d, x.finger.tip, x.position) for x in motions])
        forward = body_forward(d, motions)
        normal = forward
        forward = every[thumbs[0]] - every.mean(0)
    body = d.xmat[tree.palm].reshape(3, 3)
    # authors draw a palm along its own axes: take those where they are near
    normal = body @ _snapped(body.T @ unit(normal))
    forward = body @ _snapped(body.T @ unit(forward - normal * (normal @ forward)))
    forward = unit(forward - normal * (normal @ forward))
    points = palm_points(m, tree.palm)
    if len(points):
        middle = 0.5 * (points.min(0) + points.max(0)) if len(points) < 8 else points.mean(0)
    else:
        middle = body.T @ (roots.mean(0) - d.xpos[tree.palm])
    return Palm(middle, body.T @ forward, body.T @ normal)


def body_forward(d: mujoco.MjData, motions: list[Motion]) -> np.ndarray:
    """Return mean direction [3] of the tips' links, from the distal joint out, in the world."""
    out = []
    for x in motions:
        turn = d.xmat[x.finger.tip].reshape(3, 3)
        along = tip_at(d, x.finger.tip, x.position) - d.xanchor[x.finger.joints[-1]]
        normal = turn @ x.normal
        out.append(unit(along - normal * (normal @ along)))
    return unit(np.mean(out, axis=0))


def _snapped(v: np.ndarray) -> np.ndarray:
    """Return the nearest axis of the frame, where it is within SNAP."""
    k = int(np.abs(v).argmax())
    return np.sign(v[k]) * np.eye(3)[k] if abs(v[k]) > SNAP else v


def palm_points(m: mujoco.MjModel, body: int, count: int = 4000) -> np.ndarray:
    """Return points on the palm and on what is fixed to it, in its frame."""
    d = geometry.posed(m)
    surfaces = []
    turn = d.xmat[body].reshape(3, 3)
    for b in geometry.with_fixed(m, [body]):
        v, f = geometry.surface(m, b)
        surfaces.append(((v @ d.xmat[b].reshape(3, 3).T + d.xpos[b] - d.xpos[body]) @ turn, f))
    vertices, faces = joined(surfaces)
    return spread(vertices[faces], count, np.random.default_rng(0))[0] if len(faces) else np.zeros((0, 3))


def handedness(m: mujoco.MjModel, tree: Tree, motions: list[Motion], thumbs: list[int], frame: Palm) -> str:
    """Return right, left or none. right: seen with the fingers up and the palm towards you, the thumb is on your right;
    left; or none, where it stands in the middle or there are two fingers."""
    if len(motions) < 3:
        return "none"
    d = geometry.posed(m, stretched(m, motions))
    y = d.xmat[tree.palm].reshape(3, 3) @ frame.matrix[:, 1]
    # where its first moving link begins and where it ends, against the row of the others
    side = np.array([y @ (d.xanchor[x.finger.joints[0]] + tip_at(d, x.finger.tip, x.position)) / 2 for x in motions])
    others = np.delete(side, thumbs)
    away = side[thumbs].mean() - others.mean()
    if abs(away) < 0.15 * max(np.ptp(others), 1e-3):
        return "none"
    return "right" if away < 0 else "left"
