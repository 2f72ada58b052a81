"""The hand carried along a path without turning: what hand and object feel of it.

In a frame that is carried along without turning, a motion with acceleration a is the same as gravity g - a (d'Alembert;
exact for every body, whatever touches what). So the hand stays where it is in every engine, and gravity moves: a lift
and a shake cost nothing and need no extra joints. A turn of the base is gravity that turns, slowly enough that the turn
itself adds nothing.

A path of one's own is a CSV file with columns t [s], x, y, z [m, of the palm] and optionally rx, ry, rz [rad, rotation
vector from the start], along the axes that the palm frame has at the start: x along the fingers, z up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dexsim import files
from dexsim.errors import UserError

STAGES = (1.75, 1.75)  # s: to turn, lift or shake, and to stay
GRAVITY = np.array([0.0, 0.0, -9.81])  # m/s2, the palm up
LEAST_ROWS, MOST_S = 4, 60.0
MOST_ACCELERATION, MOST_SPIN = 100.0, 2.5  # m/s2, rad/s: a faster turn throws things outwards, which gravity cannot say
LIFT, LIFT_S = 0.3, 0.75  # m up along the palm's normal, s: minimum jerk
SHAKE, SHAKE_HZ, SHAKES = 0.02, 3.0, 2  # m either way, 1/s, periods along the fingers, then across them


def lifted(t: float) -> np.ndarray:
    """Return acceleration [3] m/s2, palm frame, t s after the lift begins: x(s) = LIFT (10 s^3 - 15 s^4 + 6 s^5), s = t
    / LIFT_S."""
    s = t / LIFT_S
    inside = 0.0 <= s <= 1.0
    return np.array([0.0, 0.0, LIFT / LIFT_S**2 * (60 * s - 180 * s**2 + 120 * s**3) if inside else 0.0])


def shaken(t: float) -> np.ndarray:
    """Return acceleration [3] m/s2, palm frame, t s after the shaking begins: SHAKE (1 - cos w t) along x for SHAKES
    periods, then along y; at rest before and after."""
    w, span = 2 * np.pi * SHAKE_HZ, SHAKES / SHAKE_HZ
    out = np.zeros(3)
    if 0.0 <= t < 2 * span:
        out[0 if t < span else 1] = SHAKE * w**2 * np.cos(w * t)
    return out


@dataclass(frozen=True)
class Base:
    """What the hand's base goes through in two stages. held: what the shares held to the end of each are called;
    stages: s; gravity: [3] m/s2 in the palm frame, t s after the first begins, None where each episode is turned about
    an axis of its own."""

    held: tuple[str, str]
    stages: tuple[float, float] = STAGES
    gravity: Callable[[float], np.ndarray] | None = None


def of(setting: str) -> Base:
    """turn, lift, or a path's CSV file. Raises UserError."""
    if setting == "turn":
        return Base(("hold_rate_turned_90", "hold_rate_turned_180"))
    if setting == "lift":
        return Base(
            ("hold_rate_lifted", "hold_rate_shaken"), gravity=lambda t: GRAVITY - lifted(t) - shaken(t - STAGES[0])
        )
    if not str(setting).lower().endswith(".csv"):
        raise UserError(f"task.evaluation.base={setting}: must be turn, lift, or a path: a .csv file of t,x,y,z")
    gravity, seconds = along(files.place(setting))
    return Base(("hold_rate_path_half", "hold_rate_path"), (seconds / 2, seconds / 2), gravity)


def along(path: Path) -> tuple[Callable[[float], np.ndarray], float]:
    """Return (gravity [3] m/s2 in the frame of a palm that is carried along a file's path, by time [s]; how long the
    path is [s]). Cubic splines, at rest at both ends. Raises UserError."""
    t, x, turn = _read(path)
    where = f"task.evaluation.base={path}"
    from scipy.interpolate import CubicSpline  # 0.3 s of every start
    from scipy.spatial.transform import Rotation, RotationSpline

    place = CubicSpline(t, x, bc_type="clamped")
    turned = RotationSpline(t, Rotation.from_rotvec(turn))
    fine = np.linspace(0.0, t[-1], 2000)
    fastest, spin = np.linalg.norm(place(fine, 2), axis=1), np.linalg.norm(turned(fine, 1), axis=1)
    for values, most, unit in ((fastest, MOST_ACCELERATION, "m/s2"), (spin, MOST_SPIN, "rad/s")):
        k = int(values.argmax())
        if values[k] > most:
            raise UserError(
                f"{where}: {values[k]:.3g} {unit} at t = {fine[k]:.2f} s; allowed {most:g}: is t in s and the rest in"
                " m and rad? else take more time"
            )

    def gravity(at: float) -> np.ndarray:
        if not 0.0 <= at <= t[-1]:
            return turned(min(max(at, 0.0), t[-1])).inv().apply(GRAVITY)
        return turned(at).inv().apply(GRAVITY - place(at, 2))

    return gravity, float(t[-1])


def _read(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times [K], places [K, 3], rotation vectors [K, 3]."""
    where = f"task.evaluation.base={path}"
    known = ("t", "x", "y", "z", "rx", "ry", "rz")
    found = files.table(path, "path of the base", known[:4], known[4:], whole=True)
    t = found["t"]
    if len(t) < LEAST_ROWS:
        raise UserError(f"{where}: {len(t)} rows; at least {LEAST_ROWS}")
    if t[0] != 0 or (np.diff(t) <= 0).any() or t[-1] > MOST_S:
        raise UserError(f"{where}: column t must begin at 0, grow with every row, and end by {MOST_S:g} s")
    x, turn = (np.stack([found.get(c, np.zeros(len(t))) for c in part], 1) for part in (known[1:4], known[4:]))
    return t, x, turn
