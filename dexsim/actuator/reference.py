"""The servo's laws in NumPy float64 for arrays of any shape: what a search along measured motions takes, and what the
kernels are checked against. Written apart from `laws.py` and `kernel.py`.

p: columns by name; q [rad] of the joint, v [rad/s] of the motor; features: those of `columns.FEATURES` that count;
step: what laws remember, None from rest."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dexsim.actuator.columns import COLUMNS, FEATURES, MEMORY
from dexsim.actuator.law import of_kind

Numbers = float | np.ndarray


@dataclass
class Step:
    """Inputs of a law with memory beside what it acts on; it writes what it will remember.

    dt: of the step [s]; fresh [...]: nothing is remembered yet; memory: numbers [...] by their names in
    `columns.MEMORY`."""

    dt: float = 0.0
    fresh: Numbers | bool = True
    memory: dict[str, Numbers] = field(default_factory=lambda: {name: np.zeros(()) for name in MEMORY})


def over_time(
    law: Callable[..., Any], p: Mapping[str, float], t: np.ndarray, *signals: np.ndarray,
    features: Collection[str] = FEATURES,
) -> Any:  # fmt: skip
    """Return what a law of this file (`lost_error`, `parasitic_torque`, `shown_position`, ...) answers to signals
    [S] at the times t [S] s, from rest at the first: one after the other where a column p of it remembers, else at
    once."""
    step = Step()
    begun = dict(step.memory)
    out = law(p, *signals, features, step)
    there = {name for c in COLUMNS if c.feature in features and p[c.name] != c.neutral for name in c.remembers}
    if all(step.memory[name] is begun[name] for name in there):  # the law has not written it: it is another one's
        return out
    step, each = Step(), []
    for i, dt in enumerate(np.diff(t, prepend=t[0])):
        step.dt, step.fresh = float(dt), i == 0
        each.append(law(p, *(x[i] for x in signals), features, step))
    return tuple(np.array(x) for x in zip(*each, strict=True)) if isinstance(out, tuple) else np.array(each)


def measured_position(
    p: Mapping[str, Any], q: Any, features: Collection[str] = FEATURES, xp: Any = np, step: Step | None = None
) -> tuple[Any, Any]:
    """Return (position [...] rad that an encoder shows where what it turns with is at q [...] rad, its slope in q):
    scale, offset and all terms of `laws.encoder_error`.

    p: columns by name; features: those of `columns.FEATURES` that count; xp: whose arrays these are, `numpy` or
    `torch`: a servo says with this what its encoders report; step: what they remember, None from rest."""
    step = step or Step()
    reading, slope = p["position_scale"] * q + p["position_offset"], p["position_scale"]
    if "rare" in features:
        reading = reading + p["eccentric_sin"] * xp.sin(q) + p["eccentric_cos"] * (xp.cos(q) - 1.0)
        slope = slope + p["eccentric_sin"] * xp.cos(q) - p["eccentric_cos"] * xp.sin(q)
    return reading, slope


def shown_position(
    p: Mapping[str, Numbers], q: Numbers, features: Collection[str] = FEATURES, step: Step | None = None
) -> tuple[Numbers, Numbers]:
    """Return `measured_position` of an encoder that has come to q [...] rad in this step: as a law for `over_time`."""
    at: tuple[Numbers, Numbers] = measured_position(p, q, features, np, replace(step or Step(), fresh=False))
    return at


def command_delay(
    p: Mapping[str, Numbers], t: Numbers, features: Collection[str] = FEATURES, step: Step | None = None
) -> Numbers:
    """Return how long after its time a target acts [...] s, in a step that begins at t [...] s: of all terms of
    `laws.command_delay`."""
    step = step or Step()
    late = p["delay"]
    return late


def dragged_target(
    p: Mapping[str, Numbers], away: Numbers, features: Collection[str] = FEATURES, step: Step | None = None
) -> Numbers:
    """Shift [...] rad of a joint's target by another that is `away` [...] rad from its home: of all terms of
    `laws.dragged_target`."""
    step = step or Step()
    shift = p["coupling"] * away if "rare" in features else np.zeros(())
    return shift


def supply_left(
    p: Mapping[str, Numbers], supply: Numbers, others: Numbers, features: Collection[str] = FEATURES,
    step: Step | None = None,
) -> Numbers:  # fmt: skip
    """Supply [...] over nominal where it would be `supply` [...] without load and the other motors give |torque| of
    `others` [...] N.m together: of all steps of `laws.supply_left`."""
    step = step or Step()
    there = supply * np.maximum(1.0 - p["sag"] * others, 0.05) if "sag" in features else supply
    return there


def setpoint(p: Mapping[str, Numbers], target: Numbers, q: Numbers, step: Step) -> Numbers:
    """Return setpoint [...] rad that a firmware moves towards its target [...] rad at a limited speed and acceleration:
    from the joint's position q [...] rad, at its speed, of the first two steps, or from what is remembered where
    `setpoint_new` is -1; q, or the target, without either limit.

    p: columns by name. A limited setpoint stops in time: v <= a dt (sqrt(1/4 + 2 d / (a dt^2)) - 1/2) at the distance
    d, from d = a dt^2 k (k + 1) / 2 and v = a dt k."""
    most, steep = np.asarray(p["profile_speed"], float), np.asarray(p["profile_acceleration"], float)
    limited = (most < 1e8) | (steep < 1e8)
    if not np.any(limited):
        return target
    known = np.asarray(step.memory["setpoint_new"])
    fresh, new = np.asarray(step.fresh) & (known >= 0), known > 0.5
    dt = max(step.dt, 1e-12)
    at = np.where(new, q, step.memory["setpoint"])
    speed = np.where(new, (q - np.asarray(step.memory["setpoint"])) / dt, step.memory["setpoint_speed"])
    away = np.asarray(target - at)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        stops = steep * dt * (np.sqrt(0.25 + 2 * np.abs(away) / (steep * dt**2)) - 0.5)
        fast = np.minimum(np.minimum(most, np.abs(away) / dt), np.where(steep < 1e8, stops, np.inf))
        wanted = np.sign(away) * fast
        speed = np.where(steep < 1e8, speed + np.clip(wanted - speed, -steep * dt, steep * dt), wanted)
    at, speed = np.where(fresh, q, at + speed * dt), np.where(fresh, 0.0, speed)
    for name, value in (("setpoint", at), ("setpoint_speed", speed), ("setpoint_new", np.where(fresh, 1.0, 0.0))):
        step.memory[name] = np.where(limited, value, step.memory[name])
    mean = np.where(steep < 1e8, at, at - 0.5 * speed * np.abs(speed) * dt / most)  # over the step, as of a target
    return np.where(limited, mean, target)


def lost_error(
    p: Mapping[str, Numbers], target: Numbers, e: Numbers, features: Collection[str] = FEATURES,
    step: Step | None = None,
) -> tuple[Numbers, Numbers, Numbers]:  # fmt: skip
    """Return (what of the error e [...] rad to a target [...] rad a loop does not act on [rad], its slope in e, what
    acts: 0 no torque, 1 all but the error's, 2 all): of all terms of `laws.lost_error`."""
    step = step or Step()
    kind = p["deadband_kind"] if "rare" in features else 0.0
    behind = target - setpoint(p, target, target - e, step) if "profile" in features else np.zeros(np.shape(e))
    e = e - behind
    inside = np.abs(e) < p["deadband"]
    lost = behind + np.where(np.greater(kind, 1.5), np.clip(e, -p["deadband"], p["deadband"]), 0.0)
    slope = np.zeros_like(lost)
    return lost, slope, np.where(inside, np.where(np.greater(kind, 0.5), 1.0, 0.0), 2.0)


def heard_speed(
    p: Mapping[str, Numbers], v: Numbers, features: Collection[str] = FEATURES, step: Step | None = None
) -> tuple[Numbers, Numbers, Numbers]:
    """Return (speed [...] rad/s that kd acts on where the encoder's is v [...] rad/s, at the end of a step at
    unchanged v, share of a change of v that passes): of all filters of `laws.heard_speed`."""
    if "rare" not in features:
        return v, v, 1.0
    step = step or Step()
    share = step.dt / (p["speed_lag"] + step.dt) if step.dt else 1.0
    before = step.memory["filtered"]
    now = np.where(step.fresh, v, before + share * (v - before))
    step.memory["filtered"] = now
    return now, now + share * (v - now), share


def loop_torque(p: Mapping[str, Numbers], e: Numbers, v: Numbers, acts: Numbers) -> np.ndarray:
    """Return torque [...] N.m, or duty, that a loop asks for: kp e - kd v of the error e [...] rad that counts and the
    measured speed v [...] rad/s that kd acts on. acts [...]: 0 nothing, 1 all but the error's, 2 all of it
    (`lost_error`)."""
    damping = p["kd"] * v
    return np.where(np.greater(acts, 1.5), p["kp"] * e - damping, np.where(np.greater(acts, 0.5), -damping, 0.0))


def warm_motor(
    p: Mapping[str, Numbers], torque: Numbers, voltage: bool, features: Collection[str] = FEATURES,
    step: Step | None = None,
) -> tuple[Numbers, Numbers, Numbers, Numbers]:  # fmt: skip
    """Return (stall torque [...] N.m, no-load speed [...] rad/s, efficiency [...], factor [...] on the friction) of
    a motor as
    it is now: of all of `laws.warm_motor`. torque [...] N.m that it gave before."""
    step = step or Step()
    tau0, no_load, efficiency, rubs = p["torque_limit"], p["no_load_speed"], p["efficiency"], np.ones(())
    if "rare" in features:
        warmth = p["warmth"]
        torque_factor = 1.0 + p["thermal_torque"] * warmth
        rubs = np.maximum(1.0 + p["thermal_friction"] * warmth, 0.0)
        tau0 = tau0 * torque_factor
        if voltage:
            tau0 = tau0 / np.maximum(1.0 + p["thermal_resistance"] * warmth, 0.1)
            no_load = no_load / torque_factor
        else:
            efficiency = efficiency * torque_factor
    return tau0, no_load, efficiency, rubs


def torque_along(
    wanted: np.ndarray, v: np.ndarray, stall: Numbers, no_load: Numbers, voltage: bool, supply: Numbers = 1.0,
    limited: bool = True, braking_slope: Numbers = 1.0,
) -> np.ndarray:  # fmt: skip
    """Return the motor torque [S] N.m along a measured motion: `laws.torque_limits`, or `laws.voltage_torque`.

    wanted [S]: what the controller asks for, N.m, of a voltage drive its duty; v [S] rad/s; stall N.m and no_load rad/s
    (inf: no limit); supply: of its nominal voltage, of a voltage drive alone; limited: False leaves what is asked as it
    is; braking_slope: of the line while the drive brakes, of a torque drive (1: as it drives)."""
    if voltage:
        duty = np.clip(wanted, -1, 1) if limited else wanted
        return stall * duty * supply - (stall / no_load * v if np.all(np.isfinite(no_load)) else 0.0)
    if not limited or not np.all(np.isfinite(stall)):
        return wanted
    slope = np.where(wanted * v < 0, braking_slope, 1.0)
    limit = stall * np.maximum(1 - slope * (np.abs(v) / no_load), 0.0)
    return np.clip(wanted, -limit, limit)


def parasitic_torque(
    p: Mapping[str, Numbers], q: Numbers, v: Numbers, features: Collection[str] = FEATURES, step: Step | None = None
) -> tuple[Numbers, Numbers, Numbers]:
    """Return (torque [...] N.m, its slopes in position [N.m/rad] and speed [N.m.s/rad]) of a drive that neither its
    motor is
    asked for nor is dry friction: of all terms of `laws.parasitic_torque`."""
    step = step or Step()
    angle = p["ripple_per_turn"] * q + p["ripple_phase"]
    wave, tilt = np.sin(angle), np.cos(angle)
    if "shape" in features:
        form = p["ripple_shape"]
        centre = np.where(form < 0.0, np.pi, 0.0)
        tooth = np.sign(form) * (np.mod(angle - centre + np.pi, 2 * np.pi) / np.pi - 1.0)
        wave = (1.0 - np.abs(form)) * wave + np.abs(form) * tooth
        tilt = (1.0 - np.abs(form)) * tilt + form / np.pi
    torque, by_position = p["torque_ripple"] * wave, p["torque_ripple"] * p["ripple_per_turn"] * tilt
    by_speed = np.zeros_like(v)
    for law in of_kind("parasitic_torque", features):
        more = law.numpy(p, q, v)
        torque, by_position, by_speed = torque + more[0], by_position + more[1], by_speed + more[2]
    return torque, by_position, by_speed


def gear_load_friction(
    torque: np.ndarray, v: Numbers, driving: Numbers, backdriven: Numbers, power: Numbers, unit: Numbers
) -> np.ndarray:
    """Dry friction [...] N.m of a gear by the torque [...] N.m that it hands to the joint: `laws.gear_load_friction`. v
    [...]: the joint's speed, of which the sign counts."""
    share = np.where(torque * v < 0.0, backdriven, driving)
    return share * unit * (np.abs(torque) / unit) ** power


def dry_friction(
    p: Mapping[str, Numbers], q: Numbers, v: Numbers, motor: Numbers, outside: Numbers = 0.0,
    features: Collection[str] = FEATURES, step: Step | None = None,
) -> Numbers:  # fmt: skip
    """Return the level [...] N.m of a drive's dry friction at the temperature of its columns: of all terms of
    `laws.dry_friction`. motor, outside: torques on the gear's two sides, N.m."""
    step = step or Step()
    exponent = p["stribeck_exponent"] if "shape" in features else 2.0
    fades = np.exp(-(np.abs(v / p["stribeck_speed"]) ** exponent))
    share = np.where(motor * v < 0.0, p["load_friction_backdriven"], p["load_friction"])
    level = p["coulomb_friction"] + p["stribeck_peak"] * fades
    if "load" in features:
        lost = p["load_stribeck_external"] * outside - p["load_stribeck"] * motor
        small = np.minimum(np.abs(motor), np.abs(outside)) ** 2
        driven, drives = np.abs(outside) > np.abs(motor), np.abs(outside) < np.abs(motor)
        square = driven * p["load_quadratic"] + drives * p["load_quadratic_external"]
        level = level + np.abs(p["load_friction_external"] * outside - share * motor)
        level = level + fades * (np.abs(lost) + small * square * (motor * outside < 0.0))
    else:
        level = level + share * np.abs(motor)
    for law in of_kind("dry_friction", features):
        level = level + law.numpy(p, q, v)
    return level


def friction_acts(
    p: Mapping[str, Numbers], q: Numbers, v: Numbers, features: Collection[str] = FEATURES, step: Step | None = None
) -> tuple[Numbers, Numbers]:
    """(share [...] by which the level moving positive is above the mean of both directions, how far [...] rad the joint
    gives way before it slides): of all terms of `laws.friction_acts`."""
    step = step or Step()
    uneven, give = 0.5 * p["friction_asymmetry"], p["presliding"] if "presliding" in features else np.zeros(())
    return uneven, give


def viscous(p: Mapping[str, Numbers], v: Numbers, features: Collection[str] = FEATURES) -> Numbers:
    """Return the friction per speed [...] N.m.s/rad at the temperature of its columns: of `laws.viscous`."""
    if "shape" not in features:
        return p["viscous_friction"]
    half = p["thinning_speed"]
    return p["viscous_friction"] + p["thinning_friction"] * half / (half + np.abs(v))
