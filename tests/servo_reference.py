"""A step of the servo in NumPy float64 for arrays of any shape: how it integrates the laws of
`dexsim.actuator.reference`. The kernel is checked against it. All that it takes from the kernel are the limits of the
numerics, as how stiff the end of a play is."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from dexsim.actuator.columns import INDEX
from dexsim.actuator.kernel import BORROWED, EDGE, SEED, SNAP, STOP_GAIN, STOP_RATE
from dexsim.actuator.laws import LEAST_ROTOR
from dexsim.actuator.reference import (
    Numbers,
    Step,
    dragged_target,
    dry_friction,
    friction_acts,
    heard_speed,
    loop_torque,
    lost_error,
    parasitic_torque,
    shown_position,
    supply_left,
    viscous,
    warm_motor,
)


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
