"""The columns of the servo table `params[world, joint, column]`: every imperfection of a joint's drive, by name.

Each column has a neutral value at which its effect is absent: neutral values with kp and kd set are an ideal PD drive.
Units are those of a hinge; for a slide joint read m, m/s, N, N/m for rad, rad/s, N.m, N.m/rad.
To add an effect: one `Column` here, its law in `laws.py`, which the training's kernel and the search's plant call, and
the same law in `reference.py`, written apart; docs/howto/extending.md has the rest. Effects that most drives do without
are compiled in only where they are used (`Column.feature`): the usual servo does not pay for them.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable

from dexsim.actuator.law import Column, brought
from dexsim.errors import UserError

INF = math.inf


# fmt: off
COLUMNS: tuple[Column, ...] = (
    # The servo's loop (paper, "Actuator Model Randomization").
    Column("kp", "N.m/rad", 0.0, 0.0, 1e5, 4.0, "proportional gain; duty per rad when drive is voltage"),
    Column("kd", "N.m.s/rad", 0.0, 0.0, 1e4, 0.1,
           "gain on the measured velocity; duty per rad/s when drive is voltage"),
    Column("speed_feedforward", "N.m.s/rad", 0.0, 0.0, 1e4, 0.01,
           "added to the PD: gain * r', r' the backward difference of the targets; duty per rad/s when drive is "
           "voltage", feature="controller"),
    Column("acceleration_feedforward", "N.m.s2/rad", 0.0, 0.0, 1e4, 1e-5,
           "added to the PD: gain * r'', the difference of r'; duty per rad/s2 when drive is voltage",
           feature="controller"),
    Column("integral_gain", "N.m/(rad.s)", 0.0, 0.0, 1e6, 20.0,
           "added to the PD: gain * integral of the error, which waits at the torque limit; duty per rad.s when drive "
           "is voltage", feature="controller"),
    Column("deadband", "rad", 0.0, 0.0, 1.0, 0.05, "no torque while |target - position| is less (the paper's epsilon)"),
    Column("torque_limit", "N.m", INF, 0.0, INF, 1.0, "stall torque tau0: the clamp at zero speed"),
    Column("no_load_speed", "rad/s", INF, 1e-3, INF, 10.0, "speed at which the torque-speed line reaches zero"),
    Column("braking_slope", "1", 1.0, -1.0, 1.0, 2.0,
           "fall of the torque limit with speed while braking, over its fall while driving: limit = torque_limit * "
           "max(0, 1 - braking_slope * |speed| / no_load_speed); 1 the paper's, 0 all of it, -1 the driving line goes "
           "on", feature="braking"),
    Column("efficiency", "1", 1.0, 0.0, 2.0, 0.3, "eta: torque at the joint over motor torque"),
    Column("delay", "s", 0.0, 0.0, 0.5, 0.02, "time from a target being sent to the servo acting on it", delays=True),
    Column("lag", "s", 0.0, 0.0, 1.0, 0.02, "time constant of a first-order lag on the motor torque"),
    Column("supply", "1", 1.0, 0.05, 2.0, 0.3, "supply voltage over nominal: scales the no-load speed (and the duty)"),
    # Friction of motor and gear, at the joint.
    Column("coulomb_friction", "N.m", 0.0, 0.0, 1e3, 0.02, "dry friction, sliding level, mean of both directions"),
    Column("friction_asymmetry", "1", 0.0, -2.0, 2.0, 0.4, "(level moving positive - level moving negative) / mean"),
    Column("stribeck_peak", "N.m", 0.0, 0.0, 1e3, 0.02, "breakaway friction in excess of the sliding level"),
    Column("stribeck_speed", "rad/s", 1.0, 1e-4, 1e3, 0.95,
           "speed at which that excess is down to 1/e (if stribeck_peak)"),
    Column("stribeck_exponent", "1", 2.0, 0.2, 6.0, 1.5,
           "how it falls with speed: exp(-(|speed| / stribeck_speed)^exponent)", feature="shape"),
    Column("presliding", "rad", 0.0, 0.0, 1.0, 0.02,
           "how far the joint gives way elastically before its dry friction slides: friction * z, dz/dq = (1 - z "
           "sign(speed)) / presliding", feature="presliding"),
    Column("viscous_friction", "N.m.s/rad", 0.0, 0.0, 1e4, 0.01, "friction proportional to speed"),
    Column("load_friction", "1", 0.0, 0.0, 10.0, 0.2, "dry friction per motor torque while the motor drives the load"),
    Column("load_friction_backdriven", "1", 0.0, 0.0, 10.0, 0.4,
           "dry friction per motor torque while the load drives it"),
    # Motor and gear, periodic in position.
    Column("torque_ripple", "N.m", 0.0, 0.0, 1e3, 0.02,
           "amplitude of a torque periodic in the position (cogging, gear)"),
    Column("ripple_per_turn", "1", 1.0, 0.0, 1e4, 20.0, "periods in one turn of the joint (if torque_ripple)"),
    Column("ripple_phase", "rad", 0.0, -6.3, 6.3, 3.0, "phase of the ripple at position zero"),
    Column("ripple_shape", "1", 0.0, -1.0, 1.0, 1.0,
           "0 sinusoid, 1 sawtooth that rises and drops, -1 one that falls and jumps up; between: a mixture",
           feature="shape"),
    # Encoder of the loop and of the reported position: measured = scale * position + offset.
    Column("position_offset", "rad", 0.0, -7.0, 7.0, 0.05, "encoder zero error, added to the measured position"),
    Column("position_scale", "1", 1.0, 0.5, 2.0, 0.1, "encoder scale: measured over true position"),
    # The same encoder, eccentric: measured = scale * q + offset + eccentric_sin * sin q + eccentric_cos * (cos q - 1).
    Column("eccentric_sin", "rad", 0.0, -1.0, 1.0, 0.05,
           "encoder error, sine of the position", feature="rare", encoder=True),
    Column("eccentric_cos", "rad", 0.0, -1.0, 1.0, 0.05,
           "encoder error, cosine of the position - 1", feature="rare", encoder=True),
    # Firmware.
    Column("speed_lag", "s", 0.0, 0.0, 1.0, 0.02,
           "time constant of the filter on the velocity that kd acts on", feature="rare", remembers=("filtered",)),
    Column("deadband_kind", "1", 0.0, 0.0, 2.0, 2.0,
           "inside the deadband 0: no torque, 1: the error counts as zero, 2: it counts from the edge on",
           feature="rare"),
    # A firmware's setpoint: it goes to the target at a limited speed, which it changes at a limited acceleration.
    Column("profile_speed", "rad/s", INF, 1e-3, INF, 3.0,
           "largest speed at which the firmware moves its setpoint towards the target",
           feature="profile", remembers=("setpoint", "setpoint_speed")),
    Column("profile_acceleration", "rad/s2", INF, 1e-2, INF, 40.0,
           "largest acceleration of that setpoint: with a speed, a trapezoid; the setpoint slows down in time",
           feature="profile", remembers=("setpoint_new",)),
    # Between motor and joint: a rotor of its own, joined to the link by a spring with a gap.
    Column("backlash", "rad", 0.0, 0.0, 2.0, 0.05, "total free play between motor and joint", feature="play"),
    Column("rebound", "1", 0.1, 0.0, 1.0, 0.5,
           "damping ratio of the transmission: of its elasticity, or of the impact at the ends of its play",
           feature="play", asks=False),
    Column("softness", "rad/N.m", 0.0, 0.0, 1e4, 0.2, "1 / stiffness of the transmission", feature="play"),
    Column("hardening", "1/(N.m)2", 0.0, 0.0, 1e6, 0.5,
           "its stiffness is 1 + hardening * torque^2 times as large under load", feature="play", asks=False),
    Column("rotor", "kg.m2", 0.0, 0.0, 1e3, 0.003,
           "reflected inertia of the rotor (if play or elasticity); 0: the model's armature",
           feature="play", asks=False),
    # Temperature: relative changes per degree of `warmth`.
    Column("thermal_torque", "1/degC", 0.0, -0.2, 0.2, 0.01, "change of the torque constant", feature="rare"),
    Column("thermal_friction", "1/degC", 0.0, -0.5, 0.5, 0.02,
           "change of all friction: dry, of the load, viscous", feature="rare"),
    Column("thermal_resistance", "1/degC", 0.0, -0.2, 0.2, 0.004,
           "change of the winding's resistance (drive: voltage)", feature="rare"),
    Column("warmth", "degC", 0.0, -100.0, 200.0, 40.0,
           "temperature above that at which the other figures hold", feature="rare", asks=False),
    # Other joints.
    Column("sag", "1/N.m", 0.0, 0.0, 1e3, 0.3,
           "supply lost per N.m that the motors of the other joints give", feature="sag"),
    Column("coupling", "1", 0.0, -10.0, 10.0, 0.3,
           "how far the target is dragged along per rad that another joint moves", feature="rare"),
    Column("coupling_from", "1", 0.0, 0.0, 1e3, 2.0,
           "which joint: its number in the mechanism's order, from 0 (if coupling)", feature="rare", asks=False),
    # Torque of nothing that is known: a regression of what a diagnosis could not name, marked as such (`gap`).
    Column("standin_constant", "N.m", 0.0, -1e3, 1e3, 0.05, "stand-in: constant torque on the joint"),
    Column("standin_position", "N.m/rad", 0.0, -1e3, 1e3, 0.2, "stand-in: torque per position"),
    Column("standin_speed", "N.m.s/rad", 0.0, -1e3, 1e3, 0.01, "stand-in: torque per speed (negative brakes)"),
    Column("standin_drag", "N.m.s2/rad2", 0.0, -1e3, 1e3, 0.002,
           "stand-in: torque per speed times |speed| (negative brakes)"),
    # Friction of a gear by its load from both sides (BAM's m3 to m6). Last, so that the others keep their numbers.
    Column("load_friction_external", "1", 0.0, 0.0, 10.0, 0.4,
           "dry friction per torque from outside (gravity, contacts): with load_friction |load_friction_external * "
           "outside - load_friction * motor|", feature="load"),
    Column("load_stribeck", "1", 0.0, 0.0, 10.0, 0.3,
           "dry friction per motor torque that falls with speed as stribeck_peak does", feature="load"),
    Column("load_stribeck_external", "1", 0.0, 0.0, 10.0, 0.3,
           "the same per torque from outside, subtracted likewise", feature="load"),
    Column("load_quadratic", "1/(N.m)", 0.0, 0.0, 1e3, 0.5,
           "dry friction per motor torque squared while a larger torque from outside drives the motor; falls with "
           "speed likewise", feature="load"),
    Column("load_quadratic_external", "1/(N.m)", 0.0, 0.0, 1e3, 0.5,
           "the same per torque from outside squared while the motor drives a smaller one", feature="load"),
    # Grease that thins as it is sheared.
    Column("thinning_friction", "N.m.s/rad", 0.0, 0.0, 1e4, 0.01,
           "what friction per speed is more at rest than viscous_friction, and less the faster it turns",
           feature="shape"),
    Column("thinning_speed", "rad/s", 1.0, 1e-4, 1e3, 0.95,
           "speed at which half of thinning_friction is left: thinning_friction / (1 + |speed| / thinning_speed)",
           feature="shape", asks=False),
    *(c for law in brought().values() for c in law.columns),
)
# fmt: on

NAMES: tuple[str, ...] = tuple(c.name for c in COLUMNS)

DRY_FRICTION = (
    "coulomb_friction", "stribeck_peak", "load_friction", "load_friction_backdriven", "load_friction_external",
    "load_stribeck", "load_stribeck_external", "load_quadratic", "load_quadratic_external",
)  # fmt: skip
"""Columns of which each is the size of a dry friction, or of a part of it."""

INDEX: dict[str, int] = {name: i for i, name in enumerate(NAMES)}

FEATURES: dict[str, tuple[str, ...]] = {
    feature: tuple(c.name for c in COLUMNS if c.feature == feature and c.asks)
    for feature in dict.fromkeys(c.feature for c in COLUMNS if c.feature)
}
"""What is compiled into a servo only where one of these columns differs from its neutral value."""
FEATURE_OF: dict[str, str] = {name: feature for feature, names in FEATURES.items() for name in names}

ENCODER: frozenset[str] = frozenset(c.name for c in COLUMNS if c.encoder)
"""Columns of what an encoder shows beyond its scale and offset (`laws.encoder_error`)."""

DELAYS: tuple[str, ...] = tuple(c.name for c in COLUMNS if c.delays)
"""Columns [s] that a command's delay is at most the sum of (`laws.command_delay`)."""

MEMORY: dict[str, int] = {name: i for i, name in enumerate(n for c in COLUMNS for n in c.remembers)}
"""What the laws of drives keep from step to step, each number with its place: slots of the same names in a servo's
state, a vector for the laws."""


def simulated(features: frozenset[str]) -> list[int]:
    """Return the indices of the columns that a servo built with these features looks at."""
    return [i for i, c in enumerate(COLUMNS) if not c.feature or c.feature in features]


def did_you_mean(name: str, valid: Iterable[object]) -> str:
    """Return ' Did you mean X?' for the valid name nearest to `name`, or nothing."""
    near = difflib.get_close_matches(str(name), [str(v) for v in valid], n=1)
    return f" Did you mean '{near[0]}'?" if near else ""


def column(name: str) -> Column:
    """Return the column called `name`; UserError with the valid names otherwise."""
    if name not in INDEX:
        hint = did_you_mean(name, NAMES)
        raise UserError(f"servo column '{name}' does not exist.{hint} Valid columns: {', '.join(NAMES)}")
    return COLUMNS[INDEX[name]]


def describe() -> str:
    """Return a text table of all columns: name, unit, neutral value, allowed range, meaning."""
    rows = [("column", "unit", "neutral", "range", "meaning")]
    rows += [(c.name, c.unit, f"{c.neutral:g}", f"{c.low:g} .. {c.high:g}", c.text) for c in COLUMNS]
    widths = [max(len(r[i]) for r in rows) for i in range(4)]
    return "\n".join("  ".join([r[i].ljust(widths[i]) for i in range(4)] + [r[4]]) for r in rows)
