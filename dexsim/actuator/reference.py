"""The servo law in NumPy float64, line for line what `kernel.py` does, for arrays of any shape: its oracle."""

from __future__ import annotations

import numpy as np

from dexsim.actuator.columns import INDEX
from dexsim.actuator.kernel import EDGE, SEED, SNAP


def target_in_force(time, stamps, targets, delay, dt) -> np.ndarray:
    """Target [rad] after `delay`, averaged over the step [time, time + dt].

    stamps [..., queue] (s), targets [..., queue] (rad), oldest first; time, delay [...] (s).
    """
    end = time - delay + dt
    target = np.array(targets[..., 0], dtype=float)
    for k in range(1, stamps.shape[-1]):
        part = np.clip((end - stamps[..., k]) / dt, 0.0, 1.0)
        blended = target + part * (targets[..., k] - targets[..., k - 1])
        target = np.where(part > 1.0 - SNAP, targets[..., k], np.where(part > SNAP, blended, target))
    return target


def servo(
    params,
    target,
    q,
    v,
    *,
    dt,
    voltage=False,
    q_loop=None,
    v_loop=None,
    last=0.0,
    enabled=1.0,
    inertia=np.inf,
    base_damping=0.0,
    base_frictionloss=0.0,
) -> dict[str, np.ndarray]:
    """One evaluation of the servo, all arrays [...], params [..., C] in the units of `columns.py`.

    target [rad]; q [rad], v [rad/s] of the driven joint; q_loop, v_loop of the joint that carries the loop's encoder
    (default q, v); last: motor torque of the step before [N.m]; enabled 1 or 0; inertia about the joint
    [kg.m2]; base_*: the model's own friction.
    Returns `torque` (motor torque the current shows), `qfrc_applied`, `dof_damping`, `dof_frictionloss` as `kernel.py`
    defines them.
    """
    p = {name: np.asarray(params, dtype=float)[..., i] for name, i in INDEX.items()}
    q, v = np.asarray(q, dtype=float), np.asarray(v, dtype=float)
    v_m = p["position_scale"] * (v if v_loop is None else np.asarray(v_loop, dtype=float))
    q_m = p["position_scale"] * (q if q_loop is None else np.asarray(q_loop, dtype=float)) + p["position_offset"]

    e = target - q_m
    active = np.abs(e) >= p["deadband"]
    now = np.where(active, p["kp"] * e - p["kd"] * v_m, 0.0)
    pd = np.where(active, p["kp"] * e - p["kd"] * v_m - p["kp"] * dt * v_m, 0.0)
    slope = np.where(active, p["position_scale"] * (p["kp"] * dt + p["kd"]), 0.0)

    tau0, supply = p["torque_limit"], p["supply"]
    with np.errstate(divide="ignore", invalid="ignore"):  # np.where evaluates the branch not taken
        if voltage:
            line = tau0 / p["no_load_speed"]
            motor_now = tau0 * supply * np.clip(now, -1.0, 1.0) - line * v
            motor = tau0 * supply * np.clip(pd, -1.0, 1.0) - line * v
            damping = tau0 * supply * slope + line
            unlimited = tau0 * supply * pd - line * v
            ratio = np.where(unlimited != 0.0, np.clip(motor / unlimited, 0.0, 1.0), 0.0)
            damping = np.where(np.abs(pd) > 1.0, np.maximum(ratio * damping, line), damping)
        else:
            x = np.abs(v) / (p["no_load_speed"] * supply)
            limit = np.where(x < 1.0, tau0 * (1.0 - x), 0.0)
            motor_now = np.clip(now, -limit, limit)
            motor = np.clip(pd, -limit, limit)
            line = tau0 / (p["no_load_speed"] * supply)
            braking = pd * v < 0.0
            growth = np.minimum(p["efficiency"] * line * dt / inertia, 60.0)
            grown = np.maximum(limit, SEED * tau0) * (np.exp(growth) - 1.0) / growth
            grown = np.minimum(grown, np.minimum(tau0, np.abs(pd)))
            grows = (np.abs(pd) > limit) & braking & (growth > SNAP) & (x < EDGE)
            size = np.where(grows, grown, limit)
            motor = np.where(grows, np.sign(pd) * size, motor)
            line = np.where(limit == 0.0, 0.0, line)
            line = np.where(braking, size / (p["no_load_speed"] * supply * (1.0 + x)), line)
            damping = np.where(np.abs(pd) > limit, np.maximum(slope * size / np.abs(pd), line), slope)

    on = np.asarray(enabled) != 0.0
    motor_now, motor, damping = np.where(on, motor_now, 0.0), np.where(on, motor, 0.0), np.where(on, damping, 0.0)

    blend = dt / (p["lag"] + dt)
    motor_now = last + blend * (motor_now - last)
    motor = last + blend * (motor - last)
    damping = blend * damping

    applied = p["efficiency"] * motor
    damping = p["efficiency"] * damping

    angle = p["ripple_per_turn"] * q + p["ripple_phase"]
    applied = applied + p["torque_ripple"] * np.sin(angle)
    stiffness = np.maximum(0.0, -p["torque_ripple"] * p["ripple_per_turn"] * np.cos(angle))
    applied = applied - stiffness * dt * v
    damping = damping + stiffness * dt

    pull = p["standin_position"]
    brake = p["standin_speed"] + p["standin_drag"] * np.abs(v)
    spring = np.maximum(0.0, -pull)
    applied = applied + p["standin_constant"] + pull * q + brake * v - spring * dt * v
    damping = damping + spring * dt + np.maximum(0.0, -brake)

    fraction = np.where(last * v < 0.0, p["load_friction_backdriven"], p["load_friction"])
    level = base_frictionloss + p["coulomb_friction"]
    level = level + p["stribeck_peak"] * np.exp(-((v / p["stribeck_speed"]) ** 2)) + fraction * np.abs(last)
    applied = applied - 0.5 * p["friction_asymmetry"] * level

    return {
        "torque": motor_now,
        "qfrc_applied": applied + damping * v,
        "dof_damping": base_damping + p["viscous_friction"] + damping,
        "dof_frictionloss": level,
    }
