"""The columns of the servo table `params[world, joint, column]`: every imperfection of a joint's drive, by name.

Each column has a neutral value at which its effect is absent: neutral values with kp and kd set are an ideal PD drive.
Units are those of a hinge; for a slide joint read m, m/s, N, N/m for rad, rad/s, N.m, N.m/rad.
To add an effect: one `Column` here, its lines in `kernel.py`, the same lines in `reference.py`.
"""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass

from dexsim.errors import UserError

INF = math.inf


@dataclass(frozen=True)
class Column:
    """One column: `neutral` is the value at which the effect is absent, `low`..`high` the values that are allowed."""

    name: str
    unit: str
    neutral: float
    low: float
    high: float
    text: str


COLUMNS: tuple[Column, ...] = (
    # The servo's loop (paper, "Actuator Model Randomization").
    Column("kp", "N.m/rad", 0.0, 0.0, 1e5, "proportional gain; duty per rad when drive is voltage"),
    Column("kd", "N.m.s/rad", 0.0, 0.0, 1e4, "gain on the measured velocity; duty per rad/s when drive is voltage"),
    Column("deadband", "rad", 0.0, 0.0, 1.0, "no torque while |target - position| is less (the paper's epsilon)"),
    Column("torque_limit", "N.m", INF, 0.0, INF, "stall torque tau0: the clamp at zero speed"),
    Column("no_load_speed", "rad/s", INF, 1e-3, INF, "speed at which the torque-speed line reaches zero"),
    Column("efficiency", "1", 1.0, 0.0, 2.0, "eta: torque at the joint over motor torque"),
    Column("delay", "s", 0.0, 0.0, 0.5, "time from a target being sent to the servo acting on it"),
    Column("lag", "s", 0.0, 0.0, 1.0, "time constant of a first-order lag on the motor torque"),
    Column("supply", "1", 1.0, 0.05, 2.0, "supply voltage over nominal: scales the no-load speed (and the duty)"),
    # Friction of motor and gear, at the joint.
    Column("coulomb_friction", "N.m", 0.0, 0.0, 1e3, "dry friction, sliding level, mean of both directions"),
    Column("friction_asymmetry", "1", 0.0, -2.0, 2.0, "(level moving positive - level moving negative) / mean"),
    Column("stribeck_peak", "N.m", 0.0, 0.0, 1e3, "breakaway friction in excess of the sliding level"),
    Column("stribeck_speed", "rad/s", 1.0, 1e-4, 1e3, "speed at which that excess is down to 1/e (if stribeck_peak)"),
    Column("viscous_friction", "N.m.s/rad", 0.0, 0.0, 1e4, "friction proportional to speed"),
    Column("load_friction", "1", 0.0, 0.0, 10.0, "dry friction per motor torque while the motor drives the load"),
    Column("load_friction_backdriven", "1", 0.0, 0.0, 10.0, "dry friction per motor torque while the load drives it"),
    # Motor and gear, periodic in position.
    Column("torque_ripple", "N.m", 0.0, 0.0, 1e3, "amplitude of a torque periodic in the position (cogging, gear)"),
    Column("ripple_per_turn", "1", 1.0, 0.0, 1e4, "periods in one turn of the joint (if torque_ripple)"),
    Column("ripple_phase", "rad", 0.0, -6.3, 6.3, "phase of the ripple at position zero"),
    # Encoder of the loop and of the reported position: measured = scale * position + offset.
    Column("position_offset", "rad", 0.0, -7.0, 7.0, "encoder zero error, added to the measured position"),
    Column("position_scale", "1", 1.0, 0.5, 2.0, "encoder scale: measured over true position"),
    # Torque of nothing that is known: a regression of what a diagnosis could not name, marked as such (gap/standin.py).
    Column("standin_constant", "N.m", 0.0, -1e3, 1e3, "stand-in: constant torque on the joint"),
    Column("standin_position", "N.m/rad", 0.0, -1e3, 1e3, "stand-in: torque per position"),
    Column("standin_speed", "N.m.s/rad", 0.0, -1e3, 1e3, "stand-in: torque per speed (negative brakes)"),
    Column("standin_drag", "N.m.s2/rad2", 0.0, -1e3, 1e3, "stand-in: torque per speed times |speed| (negative brakes)"),
)  # fmt: skip

NAMES: tuple[str, ...] = tuple(c.name for c in COLUMNS)
INDEX: dict[str, int] = {name: i for i, name in enumerate(NAMES)}


def did_you_mean(name: str, valid) -> str:
    """' Did you mean X?' for the valid name nearest to `name`, or nothing."""
    near = difflib.get_close_matches(str(name), [str(v) for v in valid], n=1)
    return f" Did you mean '{near[0]}'?" if near else ""


def column(name: str) -> Column:
    """The column called `name`; UserError with the valid names otherwise."""
    if name not in INDEX:
        hint = did_you_mean(name, NAMES)
        raise UserError(f"servo column '{name}' does not exist.{hint} Valid columns: {', '.join(NAMES)}")
    return COLUMNS[INDEX[name]]


def describe() -> str:
    """A text table of all columns: name, unit, neutral value, allowed range, meaning."""
    rows = [("column", "unit", "neutral", "range", "meaning")]
    rows += [(c.name, c.unit, f"{c.neutral:g}", f"{c.low:g} .. {c.high:g}", c.text) for c in COLUMNS]
    widths = [max(len(r[i]) for r in rows) for i in range(4)]
    return "\n".join("  ".join([r[i].ljust(widths[i]) for i in range(4)] + [r[4]]) for r in rows)
