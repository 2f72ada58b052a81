"""The hand carried along a path without turning: what hand and object feel of it.

In a frame that is carried along without turning, a motion with acceleration a is the same as gravity g - a (d'Alembert;
exact for every body, whatever touches what). So the hand stays where it is in every engine, and gravity moves: a lift
and a shake cost nothing and need no extra joints. A turn of the base is gravity that turns (`grasp_eval`), slowly
enough that the turn itself adds nothing.
"""

from __future__ import annotations

import numpy as np

LIFT, LIFT_S = 0.3, 0.75  # m up along the palm's normal, s: minimum jerk
REST_S = 1.0  # s
SHAKE, SHAKE_HZ, SHAKES = 0.02, 3.0, 2  # m either way, 1/s, periods along the fingers, then across them


def lifted(t: float) -> np.ndarray:
    """Acceleration [3] m/s2, palm frame, t s after the lift begins: x(s) = LIFT (10 s^3 - 15 s^4 + 6 s^5), s = t /
    LIFT_S."""
    s = t / LIFT_S
    inside = 0.0 <= s <= 1.0
    return np.array([0.0, 0.0, LIFT / LIFT_S**2 * (60 * s - 180 * s**2 + 120 * s**3) if inside else 0.0])


def shaken(t: float) -> np.ndarray:
    """Acceleration [3] m/s2, palm frame, t s after the shaking begins: SHAKE (1 - cos w t) along x for SHAKES periods,
    then along y; at rest before and after."""
    w, span = 2 * np.pi * SHAKE_HZ, SHAKES / SHAKE_HZ
    out = np.zeros(3)
    if 0.0 <= t < 2 * span:
        out[0 if t < span else 1] = SHAKE * w**2 * np.cos(w * t)
    return out
