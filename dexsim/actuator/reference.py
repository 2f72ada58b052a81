"""The servo's laws, and how a step integrates them, in NumPy float64 for arrays of any shape: what the kernels are
checked against. Written apart from `laws.py` and `kernel.py`; all that it takes from them are the limits of the
numerics, as how stiff the end of a play is."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dexsim.actuator.columns import COLUMNS, FEATURES, INDEX, MEMORY
from dexsim.actuator.kernel import BORROWED, EDGE, SEED, SNAP, STOP_GAIN, STOP_RATE
from dexsim.actuator.law import of_kind
from dexsim.actuator.laws import LEAST_ROTOR

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
    law: Callable[..., Any],
    p: Mapping[str, float],
    t: np.ndarray,
    *signals: np.ndarray,
    features: Collection[str] = FEATURES,
) -> Any:
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
    `laws.command_delay`.

    p: columns by name; features: those of `columns.FEATURES` that count; step: None from rest."""
    step = step or Step()
    late = p["delay"]
    return late


def dragged_target(
    p: Mapping[str, Numbers], away: Numbers, features: Collection[str] = FEATURES, step: Step | None = None
) -> Numbers:
    """Shift [...] rad of a joint's target by another that is `away` [...] rad from its home: of all terms of
    `laws.dragged_target`.

    p: columns by name; features: those of `columns.FEATURES` that count; step: None from rest."""
    step = step or Step()
    shift = p["coupling"] * away if "rare" in features else np.zeros(())
    return shift


def supply_left(
    p: Mapping[str, Numbers],
    supply: Numbers,
    others: Numbers,
    features: Collection[str] = FEATURES,
    step: Step | None = None,
) -> Numbers:
    """Supply [...] over nominal where it would be `supply` [...] without load and the other motors give |torque| of
    `others` [...] N.m together: of all steps of `laws.supply_left`.

    p: columns by name; features: those of `columns.FEATURES` that count; step: None from rest."""
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
    p: Mapping[str, Numbers],
    target: Numbers,
    e: Numbers,
    features: Collection[str] = FEATURES,
    step: Step | None = None,
) -> tuple[Numbers, Numbers, Numbers]:
    """Return (what of the error e [...] rad to a target [...] rad a loop does not act on [rad], its slope in e, what
    acts: 0 no torque, 1 all but the error's, 2 all): of all terms of `laws.lost_error`.

    p: columns by name; features: those of `columns.FEATURES` that count; step: None from rest."""
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
    unchanged v, share of a change of v that passes): of all filters of `laws.heard_speed`.

    p: columns by name; features: those of `columns.FEATURES` that count; step: None from rest."""
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


def target_in_force(time: Numbers, stamps: np.ndarray, targets: np.ndarray, delay: Numbers, dt: float) -> np.ndarray:
    """Return the target [rad] after `delay`, averaged over the step [time, time + dt].

    stamps [..., queue] (s), targets [..., queue] (rad), oldest first; time, delay [...] (s).
    """
    end = time - delay + dt
    target = np.array(targets[..., 0], dtype=float)
    for k in range(1, stamps.shape[-1]):
        part = np.clip((end - stamps[..., k]) / dt, 0.0, 1.0)
        blended = target + part * (targets[..., k] - targets[..., k - 1])
        target = np.where(part > 1.0 - SNAP, targets[..., k], np.where(part > SNAP, blended, target))
    return target


def target_rates(
    time: Numbers, stamps: np.ndarray, targets: np.ndarray, delay: Numbers, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the speed [rad/s] and acceleration [rad/s2] of the target, means over the step: arguments as for
    `target_in_force`.

    Target k has speed (x_k - x_k-1) / span and acceleration (speed_k - speed_k-1) / span, span = t_k - t_k-1, from t_k
    to the next target, for at most 2 span.
    """
    begin = np.asarray(time - delay, dtype=float)
    spans = np.diff(stamps, axis=-1)
    real = spans > SNAP * dt
    per = 1.0 / np.where(real, spans, np.inf)
    rates = np.diff(targets, axis=-1) * per
    bends = np.diff(np.concatenate([np.zeros_like(rates[..., :1]), rates], -1), axis=-1) * per
    ends = np.concatenate([stamps[..., 2:], np.full_like(stamps[..., :1], np.inf)], -1)
    ends = np.minimum(np.minimum(ends, stamps[..., 1:] + 2.0 * spans), (begin + dt)[..., None])
    share = np.maximum(ends - np.maximum(stamps[..., 1:], begin[..., None]), 0.0) / dt
    return (share * rates).sum(-1), (share * bends).sum(-1)


def warm_motor(
    p: Mapping[str, Numbers],
    torque: Numbers,
    voltage: bool,
    features: Collection[str] = FEATURES,
    step: Step | None = None,
) -> tuple[Numbers, Numbers, Numbers, Numbers]:
    """Return (stall torque [...] N.m, no-load speed [...] rad/s, efficiency [...], factor [...] on the friction) of
    a motor as
    it is now: of all of `laws.warm_motor`.

    p: columns by name; torque [...] N.m that it gave before; features: those of `columns.FEATURES` that count; step:
    None from rest."""
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
    wanted: np.ndarray,
    v: np.ndarray,
    stall: Numbers,
    no_load: Numbers,
    voltage: bool,
    supply: Numbers = 1.0,
    limited: bool = True,
    braking_slope: Numbers = 1.0,
) -> np.ndarray:
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


def lagged(t: np.ndarray, torque: np.ndarray, time: float, stages: int = 1) -> np.ndarray:
    """Return the torque [S] N.m after a lag of `time` s, of that in force before each of the times t [S] s: exact for
    one that changes at these times only; from rest at the first.

    stages: 1 first order, 2 second order: two in a row with half the time each (`laws.lag_share`)."""
    out = np.asarray(torque, float)
    for _ in range(stages):
        gone = 1.0 - np.exp(-np.diff(t, prepend=t[0]) * stages / time)
        y, x, out = out[0], out, np.empty_like(out)
        for i in range(len(x)):
            y += gone[i] * (x[i] - y)
            out[i] = y
    return out


def parasitic_torque(
    p: Mapping[str, Numbers], q: Numbers, v: Numbers, features: Collection[str] = FEATURES, step: Step | None = None
) -> tuple[Numbers, Numbers, Numbers]:
    """Return (torque [...] N.m, its slopes in position [N.m/rad] and speed [N.m.s/rad]) of a drive that neither its
    motor is
    asked for nor is dry friction: of all terms of `laws.parasitic_torque`.

    p: columns by name; q [rad] of the joint, v [rad/s] of the motor; features: those of `columns.FEATURES` that
    count; step: None from rest."""
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
    p: Mapping[str, Numbers],
    q: Numbers,
    v: Numbers,
    motor: Numbers,
    outside: Numbers = 0.0,
    features: Collection[str] = FEATURES,
    step: Step | None = None,
) -> Numbers:
    """Return the level [...] N.m of a drive's dry friction at the temperature of its columns: of all terms of
    `laws.dry_friction`.

    p: columns by name; q [rad] of the joint, v [rad/s] of the motor; motor, outside: torques on the gear's two sides,
    N.m; features: those of `columns.FEATURES` that count; step: None from rest."""
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
    gives way before it slides): of all terms of `laws.friction_acts`.

    p: columns by name; q [rad] of the joint, v [rad/s] of the motor; features: those of `columns.FEATURES` that
    count; step: None from rest."""
    step = step or Step()
    uneven, give = 0.5 * p["friction_asymmetry"], p["presliding"] if "presliding" in features else np.zeros(())
    return uneven, give


def viscous(p: Mapping[str, Numbers], v: Numbers, features: Collection[str] = FEATURES) -> Numbers:
    """Return the friction per speed [...] N.m.s/rad at the temperature of its columns: of `laws.viscous`.

    p: columns by name; v [rad/s] of the motor; features: those of `columns.FEATURES` that count."""
    if "shape" not in features:
        return p["viscous_friction"]
    half = p["thinning_speed"]
    return p["viscous_friction"] + p["thinning_friction"] * half / (half + np.abs(v))


def servo(
    params: np.ndarray,
    target: Numbers,
    q: Numbers,
    v: Numbers,
    *,
    dt: float,
    voltage: bool = False,
    q_loop: Numbers | None = None,
    v_loop: Numbers | None = None,
    last: Numbers = 0.0,
    enabled: Numbers = 1.0,
    inertia: Numbers = np.inf,
    base_damping: Numbers = 0.0,
    base_frictionloss: Numbers = 0.0,
    base_armature: Numbers = 0.0,
    features: Collection[str] = (),
    dragging: Numbers = 0.0,
    others: Numbers = 0.0,
    memory: Mapping[str, Numbers] | None = None,
    rotor: Numbers = 0.0,
    line_a: Numbers = 0.0,
    line_b: Numbers = 0.0,
    fresh: Numbers = 1.0,
    loop_motor: Numbers = False,
    rates: tuple[Numbers, Numbers] = (0.0, 0.0),
    integral: Numbers = 0.0,
    taken: Numbers = 0.0,
    outside: Numbers = 0.0,
) -> dict[str, np.ndarray]:
    """Return one evaluation of the servo, all arrays [...], params [..., C] in the units of `columns.py`.

    target [rad]; q [rad], v [rad/s] of the driven joint; q_loop, v_loop of the joint that carries the loop's encoder
    (default q, v); last: motor torque of the step before [N.m]; enabled 1 or 0; inertia about the joint [kg.m2];
    base_*: the model's own friction and armature. features: those of `columns.FEATURES` that count. dragging [rad]: how
    far the joint that drags this one is from its home; others [N.m]: sum of the other motors' |torque|; memory: what
    laws remember by name (`columns.MEMORY`); rotor, line_a, line_b, fresh, integral, taken: the state's other slots;
    loop_motor: the loop's encoder is on the rotor; rates: the target's speed and acceleration (`target_rates`);
    outside: what the joint felt from outside in the step before [N.m]. Returns `torque` (motor torque the current
    shows), `qfrc_applied`, `dof_damping`, `dof_frictionloss`, `dof_armature` as `kernel.py` defines them, and the next
    of what is remembered, of `rotor`, `line_a`, `line_b`, `integral` and `taken`.
    """
    play = "play" in features
    p = {name: np.asarray(params, dtype=float)[..., i] for name, i in INDEX.items()}
    q, v = np.asarray(q, dtype=float), np.asarray(v, dtype=float)
    first = np.asarray(fresh) != 0.0
    turned = q if q_loop is None else np.asarray(q_loop, dtype=float)
    turning = v if v_loop is None else np.asarray(v_loop, dtype=float)
    two = play & ((p["backlash"] > 0.0) | (p["softness"] > 0.0))
    v_drive = np.where(two & ~first, line_a + np.asarray(line_b) * v, v)
    rotor_q = np.where(two & ~first, rotor + dt * v_drive, q)
    rotor_inertia = np.where(
        two, np.maximum(np.where(p["rotor"] == 0.0, base_armature, p["rotor"]), LEAST_ROTOR * inertia), 0.0
    )
    on_rotor = two & np.asarray(loop_motor)
    turned, turning = np.where(on_rotor, rotor_q, turned), np.where(on_rotor, v_drive, turning)
    step = Step(dt, first)
    step.memory |= memory or {}
    tau0, no_load, efficiency, friction_factor = warm_motor(p, last, voltage, features, step)
    q_m, scale = shown_position(p, turned, features, step)
    v_m = scale * turning
    heard, then, kd_blend = heard_speed(p, turning, features, step)
    v_d, v_next = scale * heard, scale * then
    target = target + dragged_target(p, dragging, features, step)

    lost, bend, acts = lost_error(p, target, target - q_m, features, step)
    e, heeded = target - q_m - lost, 1.0 - bend
    now, pd = loop_torque(p, e, v_d, acts), loop_torque(p, e - heeded * dt * v_m, v_next, acts)
    slope = scale * (p["kp"] * heeded * dt + kd_blend * p["kd"])
    dead, damped = np.less(acts, 1.5), np.equal(acts, 1.0)
    slope = np.where(damped, scale * kd_blend * p["kd"], np.where(dead, 0.0, slope))

    supply = supply_left(p, p["supply"], others, features, step)
    upper, lower = np.ones_like(v), np.ones_like(v)  # limits of the duty, or of the torque
    if not voltage:
        with np.errstate(invalid="ignore"):
            x = np.abs(v_drive) / (no_load * supply)
            steep = p["braking_slope"] if "braking" in features else np.ones_like(v)
            drives, brakes = (np.where(k * x < 1.0, tau0 * (1.0 - k * x), 0.0) for k in (1.0, steep))
            upper, lower = np.where(v_drive < 0.0, brakes, drives), np.where(v_drive > 0.0, brakes, drives)
    if "controller" in features:
        feed = p["speed_feedforward"] * rates[0] + p["acceleration_feedforward"] * rates[1]
        counted = np.where(dead, 0.0, e)
        added = dt * p["integral_gain"] * counted
        wanted = now + feed + integral
        waits = ((wanted > upper) & (added > 0.0)) | ((wanted < -lower) & (added < 0.0))
        integral = np.where(np.asarray(enabled) == 0.0, 0.0, integral + np.where(waits, 0.0, added))
        fed, off = ~dead | damped, ~dead
        now = now + np.where(fed, feed + integral, 0.0)
        pd = pd + np.where(fed, feed + integral, 0.0) + np.where(off, added - dt * dt * p["integral_gain"] * v_m, 0.0)
        slope = slope + np.where(off, scale * dt * dt * p["integral_gain"], 0.0)

    inertia_drive = np.where(two, rotor_inertia, inertia)
    with np.errstate(divide="ignore", invalid="ignore"):  # np.where evaluates the branch not taken
        if voltage:
            line = tau0 / no_load
            motor_now = tau0 * supply * np.clip(now, -1.0, 1.0) - line * v_drive
            motor = tau0 * supply * np.clip(pd, -1.0, 1.0) - line * v_drive
            damping = tau0 * supply * slope + line
            unlimited = tau0 * supply * pd - line * v_drive
            ratio = np.where(unlimited != 0.0, np.clip(motor / unlimited, 0.0, 1.0), 0.0)
            on_drive = np.where(np.abs(pd) > 1.0, np.maximum(ratio * damping, line), line)
            damping = np.where(np.abs(pd) > 1.0, on_drive, damping)
        else:
            motor_now = np.clip(now, -lower, upper)
            motor = np.clip(pd, -lower, upper)
            limit = np.where(pd < 0.0, lower, upper)
            line = tau0 / (no_load * supply)
            braking = pd * v_drive < 0.0
            growth = np.minimum(steep * efficiency * line * dt / inertia_drive, 60.0)
            grown = np.maximum(limit, SEED * tau0) * (np.exp(growth) - 1.0) / growth
            grown = np.minimum(grown, np.minimum(tau0, np.abs(pd)))
            grows = (np.abs(pd) > limit) & braking & (growth > SNAP) & (steep * x < EDGE)
            size = np.where(grows, grown, limit)
            motor = np.where(grows, np.sign(pd) * size, motor)
            line = np.where(limit == 0.0, 0.0, line)
            line = np.where(braking, size / (no_load * supply * (1.0 + x)), line)
            on_drive = np.where(np.abs(pd) > limit, np.maximum(slope * size / np.abs(pd), line), 0.0)
            damping = np.where(np.abs(pd) > limit, on_drive, slope)

    on = np.asarray(enabled) != 0.0
    motor_now, motor, damping, on_drive = (np.where(on, x, 0.0) for x in (motor_now, motor, damping, on_drive))

    blend = dt / (p["lag"] + dt)
    motor_now = last + blend * (motor_now - last)
    motor = last + blend * (motor - last)
    damping = blend * damping

    applied = efficiency * motor
    damping = efficiency * damping
    on_drive = efficiency * blend * on_drive

    beside, by_position, by_speed = parasitic_torque(p, q, v_drive, features, step)
    stiffness, drag = np.maximum(0.0, -by_position), np.maximum(0.0, -by_speed)
    applied = applied + beside - stiffness * dt * v
    damping = damping + stiffness * dt + drag
    on_drive = on_drive + drag

    of_motor, slope_motor, drawn = applied, damping, applied
    pull = p["standin_position"]
    brake = p["standin_speed"] + p["standin_drag"] * np.abs(v)
    spring = np.maximum(0.0, -pull)
    applied = applied + p["standin_constant"] + pull * q + brake * v - spring * dt * v
    damping = damping + spring * dt + np.maximum(0.0, -brake)

    own = friction_factor * dry_friction(p, q, v_drive, last, outside, features, step)
    level = base_frictionloss + own
    grease = friction_factor * viscous(p, v_drive, features)

    uneven, give = friction_acts(p, q, v_drive, features, step)
    gives = ("presliding" in features) & np.greater(give, 0.0)
    y = v_drive * dt / np.where(gives, give, 1.0)
    taken = np.where(gives & ~first, (taken + y) / (1.0 + np.abs(y)), np.where(gives, 0.0, taken))
    sliding = np.where(gives, np.where(two, own, level), 0.0)
    grease = grease + sliding * dt / np.where(gives, give, 1.0) * (1.0 - taken * np.sign(v_drive)) / (1.0 + np.abs(y))
    of_motor = of_motor - sliding * taken

    one = {
        "qfrc_applied": applied - uneven * level - sliding * taken + damping * v,
        "dof_damping": base_damping + grease + damping,
        "dof_frictionloss": np.where(gives, 0.0, level),
        "line_a": np.zeros_like(v), "line_b": np.ones_like(v),
    }  # fmt: skip
    other = one
    if play:
        with np.errstate(divide="ignore", invalid="ignore"):
            other = _rotor(
                p,
                of_motor - uneven * own,
                slope_motor,
                on_drive,
                on_rotor,
                np.where(gives, 0.0, own),
                grease,
                rotor_q,
                v_drive,
                rotor_inertia,
                inertia,
                q,
                v,
                dt,
                p["kp"] * tau0 if voltage else p["kp"],
            )
        rest, rest_slope = applied - drawn, damping - slope_motor  # of the stand-in: on the link itself
        other["qfrc_applied"] = other["qfrc_applied"] + rest + rest_slope * v
        other["dof_damping"] = base_damping + rest_slope
        other["dof_frictionloss"] = np.broadcast_to(base_frictionloss, v.shape)
    out = {name: np.where(two, other[name], one[name]) for name in one}
    armature = (
        np.maximum(base_armature - rotor_inertia, -BORROWED * inertia) + np.where(two, other.get("armature", 0.0), 0.0)
        if play
        else base_armature
    )
    return (
        out
        | {name: np.asarray(value) for name, value in step.memory.items()}
        | {"torque": motor_now, "dof_armature": armature, "rotor": rotor_q, "integral": integral, "taken": taken}
    )


def _rotor(
    p: dict[str, np.ndarray],
    of_motor: np.ndarray,
    slope: Numbers,
    on_drive: Numbers,
    on_rotor: np.ndarray,
    own: np.ndarray,
    grease: np.ndarray,
    rotor_q: np.ndarray,
    w: np.ndarray,
    rotor_inertia: np.ndarray,
    inertia: Numbers,
    q: np.ndarray,
    v: np.ndarray,
    dt: float,
    gain: Numbers,
) -> dict[str, np.ndarray]:
    """Return the rotor's step as a line in the link's velocity ("Play and elasticity" in `kernel.py`): qfrc_applied and
    armature of what passes to the link, line_a and line_b of the rotor's velocity. gain: stiffness of the loop
    [N.m/rad]."""
    on_drive = np.where(on_rotor, slope, on_drive)
    on_loop = np.where(on_rotor, 0.0, slope - on_drive)
    soft, gap2 = p["softness"], 0.5 * p["backlash"]
    link = np.maximum(inertia - rotor_inertia, LEAST_ROTOR * inertia)
    stop = STOP_GAIN * gain + STOP_RATE**2 * inertia
    stiff = np.where(soft > 0.0, 1.0 / soft, stop)
    damp = 2.0 * p["rebound"] * np.sqrt(stiff * rotor_inertia * link / (rotor_inertia + link))
    free_a = rotor_inertia / dt + grease + on_drive
    push = rotor_inertia / dt * w + of_motor + on_drive * w
    slides = np.abs(push) > own
    free = (
        np.where(slides, (push - np.sign(push) * own + on_loop * v) / free_a, 0.0),
        np.where(slides, -on_loop / free_a, 0.0),
    )
    twist = rotor_q + dt * (free[0] + free[1] * v) - q - dt * v
    side = np.sign(twist) * gap2
    stretch = stiff * (rotor_q - q - side)
    harder = np.where(soft > 0.0, 1.0 + p["hardening"] * stretch**2, 1.0)
    k, pull = (3.0 * harder - 2.0) * stiff * dt + damp, stretch * harder
    push = push - pull
    slides = np.abs(push + k * v) > own
    a = np.where(slides, (push - np.sign(push + k * v) * own + on_loop * v) / (free_a + k), 0.0)
    b = np.where(slides, (k - on_loop) / (free_a + k), 0.0)
    t, slope_t = pull + k * a, k * (1.0 - b)
    on = (np.abs(twist) >= gap2) & ((gap2 == 0.0) | ((t - slope_t * v) * side >= 0.0))
    return {"qfrc_applied": np.where(on, t - slope_t * v, 0.0), "armature": np.where(on, slope_t * dt, 0.0),
            "line_a": np.where(on, a, free[0]), "line_b": np.where(on, b, free[1])}  # fmt: skip
