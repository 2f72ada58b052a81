"""Joint angles with which a hand's fingertips lie against the sides of a cube on its palm, from tables of forward
kinematics: how the fingers of `dexsim stable-grasps` close.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from dexsim.hand import Hand
from dexsim.tactile.layout import hand_layout, tip_layout

ROWS = 4000  # joint angles tried for each finger
SIDEWAYS = 0.15  # rad, either side of the cupped pose: joints that turn a pressing finger aside
GAP = (-0.010, 0.0)  # m off the cube's face, of the middle of a pad: within it, since the finger stops as it touches
INSIDE = 0.1  # of the edge: how far from a face's upright edges
HEIGHT = (-0.2, 0.35)  # of the edge, over the cube's middle
FACING = 0.6  # cosine between pad and face, at least
CLEAR = 0.006  # m that the finger's joints stay off the cube


class Reach:
    """Tables of every finger's own angles q [ROWS, j], its pad's middle point [ROWS, 3] m and outward normal [ROWS, 3],
    and where its joints are, anchor [ROWS, j, 3] m; palm frame."""

    def __init__(self, hand: Hand, rng: np.random.Generator):
        self.hand, model = hand, hand.compiled
        data = mujoco.MjData(model)
        middle = (hand_layout(hand) or tip_layout(hand)).centre()
        ids = [model.joint(j).id for j in hand.joints]
        cupped = hand.pose("cupped")
        low, high = hand.limits[:, 0].copy(), hand.limits[:, 1].copy()
        for k in hand.others:
            for j in set(hand.fingers[k].joints) - set(hand.fingers[k].flexion):
                low[j], high[j] = max(low[j], cupped[j] - SIDEWAYS), min(high[j], cupped[j] + SIDEWAYS)
        every = rng.uniform(low, high, (ROWS, len(ids)))
        F = len(hand.fingers)
        point, normal, anchor = np.zeros((ROWS, F, 3)), np.zeros((ROWS, F, 3)), np.zeros((ROWS, len(ids), 3))
        bodies = [model.body(f.body).id for f in hand.fingers]
        for row, q in enumerate(every):
            hand.couplings.put(data, q)
            mujoco.mj_kinematics(model, data)
            anchor[row] = data.xanchor[ids]
            for k, (body, finger) in enumerate(zip(bodies, hand.fingers, strict=True)):
                turn = data.xmat[body].reshape(3, 3)
                point[row, k] = data.xpos[body] + turn @ middle[k]
                normal[row, k] = turn @ np.array(finger.normal)
        self.point, self.normal = point.swapaxes(0, 1), normal.swapaxes(0, 1)
        self.q = [every[:, list(f.joints)] for f in hand.fingers]
        self.anchor = [anchor[:, list(f.joints)] for f in hand.fingers]

    def fitting(self, finger: int, centre: np.ndarray, yaw: float, edge: float) -> np.ndarray:
        """Return rows of a finger's table that lay its pad against an upright face of a cube, its joints clear of it.
        centre [3] m; yaw rad about the palm's normal; edge m."""
        c, s = math.cos(yaw), math.sin(yaw)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        at, out = (self.point[finger] - centre) @ turn, self.normal[finger] @ turn
        axis = np.abs(at[:, :2]).argmax(1)
        rows = np.arange(len(at))
        side = np.sign(at[rows, axis])
        off, along = side * at[rows, axis] - edge / 2, np.abs(at[rows, 1 - axis])
        joints = np.abs((self.anchor[finger] - centre) @ turn).max(2).min(1) - edge / 2
        return np.flatnonzero(
            (off > GAP[0]) & (off < GAP[1]) & (along < (0.5 - INSIDE) * edge) & (-side * out[rows, axis] > FACING)
            & (at[:, 2] > HEIGHT[0] * edge) & (at[:, 2] < HEIGHT[1] * edge) & (joints > CLEAR)
        )  # fmt: skip
