"""Where a hand catches and holds things, palm frame: as `hand.yaml` says, else from its cupped pose."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from dexsim.hand.couplings import Couplings
from dexsim.hand.hand import Hand


@dataclass(frozen=True)
class Places:
    """Points [3] m, palm frame. catch: on the palm, over it an object is let fall; middle: of what the hand can reach;
    beside: where an object lies between the outer fingers, of which y counts."""

    catch: np.ndarray
    middle: np.ndarray
    beside: np.ndarray


def places(hand: Hand) -> Places:
    """Return those of the file, mirrored and scaled with the hand; what it leaves out from the cupped pose: on the
    palm, 70 % of the way along the fingers to the tips of those that the opposing ones press against (the xHand's is
    there). `dexsim import-hand` searches for `catch` from there (`dexsim.tasks.held_drops`)."""
    given = hand.file.places
    said = np.array([1.0, -1.0 if hand.mirror else 1.0, 1.0]) * hand.scale
    tips = fingertips(hand, hand.pose("cupped"))
    along, across, _ = tips[list(hand.others)].mean(0)
    floor = np.array([0.7 * along, across, 0.0])
    if given is None or None in (given.catch, given.middle, given.beside):
        floor[2] = surface(hand, floor)
    out = {}
    for name in ("catch", "middle", "beside"):
        own = getattr(given, name) if given is not None else None
        out[name] = floor if own is None else np.array(own) * said
    return Places(**out)


def surface(hand: Hand, over: np.ndarray) -> float:
    """Return height [m] of the palm: the highest that its collision geoms are between its centre and below a point."""
    spec = hand.spec()
    for geom in list(spec.geoms):
        if geom.parent.name != hand.palm_body or not geom.contype:
            spec.delete(geom)
    model = spec.compile()
    data = mujoco.MjData(model)
    Couplings(model, hand.joints).put(data, hand.pose("open"))
    mujoco.mj_forward(model, data)
    hit, down, top = np.full(1, -1, np.int32), np.array([0.0, 0.0, -1.0]), 10.0
    heights = [0.0]
    for share in np.linspace(0.0, 1.0, 11):
        start = np.array([share * over[0], share * over[1], top])
        far = mujoco.mj_ray(model, data, start, down, None, 1, -1, hit)
        heights += [top - far] if far >= 0 else []
    return float(max(heights[1:] or heights))


def fingertips(hand: Hand, angles: np.ndarray) -> np.ndarray:
    """Return fingertips [F, 3] m at joint angles [J] rad, palm frame."""
    model = hand.compiled
    data = mujoco.MjData(model)
    hand.couplings.put(data, angles)
    mujoco.mj_kinematics(model, data)
    return np.array(
        [data.body(f.body).xpos + data.body(f.body).xmat.reshape(3, 3) @ np.array(f.position) for f in hand.fingers]
    )


def approach(hand: Hand) -> np.ndarray:
    """Return which way each joint turns to bring its finger's tip nearer to the fingers it presses against, at the open
    pose: +1, -1, or 0 where it hardly matters [J]. Flexion joints as `hand.closing` says."""
    start, step = hand.pose("open"), 1e-3
    out = hand.closing.copy()
    for k, finger in enumerate(hand.fingers):
        goal = hand.others if k in hand.opposing else hand.opposing
        for j in finger.joints:
            if out[j]:
                continue
            gap = []
            for sign in (-1, 1):
                q = start.copy()
                q[j] += sign * step
                tips = fingertips(hand, q)
                gap.append(np.linalg.norm(tips[k] - tips[list(goal)].mean(0)))
            slope = (gap[1] - gap[0]) / (2 * step)
            out[j] = -np.sign(slope) if abs(slope) > 0.2 * np.linalg.norm(fingertips(hand, start)[k]) else 0.0
    return out
