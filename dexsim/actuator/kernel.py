"""The servo as Warp kernels: one thread per world and joint. `reference.py` holds the same lines in NumPy.

The law (paper, "Actuator Model Randomization"; its reference velocity qd_ref is taken as zero: targets are held):

    e      = target - q_m,    q_m = scale * q + offset                     measured position of the loop's encoder
    tau_c  = kp * e - kd * qd_m
    tau_b  = 0 if |e| < deadband else tau_c
    limit  = torque_limit * max(0, 1 - |qd| / no_load_speed)
    motor  = clip(tau_b, -limit, +limit)                                   what the motor's current shows
    joint  = efficiency * lag(motor) + ripple(q) - friction

Voltage drive: duty = clip(kp * e - kd * qd_m, -1, 1), motor = torque_limit * (duty * supply - qd / no_load_speed).

Integration. A finger link may weigh 1e-5 kg.m2, where this law taken explicitly explodes at millisecond steps. So
MuJoCo is given a line in the velocity v' at the end of the step, motor(v') = T - D (v' - v), by
    qfrc_applied = T + D v,    dof_damping = D + (viscous and the model's own),
which implicitfast and discrete integrate implicitly: M (v' - v) = dt (qfrc_applied - dof_damping v' + ...).
  - Within the limits T = kp (e - dt qd_m) - kd qd_m and D = kp dt + kd: backward Euler in position and velocity; at
    rest T = kp e exactly.
  - At the limits the line goes through (v, T = +-limit) and the velocity at which the law itself is zero: the unlimited
    PD's zero or the no-load speed, whichever comes first. Driving along the torque-speed line D is that line's slope; a
    drive at its limit never overshoots in one step, whatever the inertia. While it brakes, the paper's limit grows as
    the speed falls, exponentially with rate r = efficiency * tau0 / no_load_speed / inertia; a tiny link does so within one
    step, so T takes the mean over the step, limit * (exp(r dt) - 1) / (r dt), `inertia` being 1 / dof_invweight0.
  All differences from the law are O(dt).
Dry friction goes to dof_frictionloss (as a torque it would chatter), so MuJoCo resolves sticking. How hard it sticks is
the joint's solimpfriction: the default (0.9) lets a stuck joint creep, 0.999 does not.
"""

# No `from __future__ import annotations`: Warp resolves these annotations from the closure.

from functools import lru_cache

import warp as wp

from dexsim.actuator.columns import INDEX

# Slots of state[world, joint, slot] before the queue: `queue` stamps [s], then `queue` targets [rad], oldest first.
MOTOR, ENABLED, QUEUE = 0, 1, 2
SLOTS = ("motor", "enabled")

NEVER = -1.0e9  # the stamp of a target that has always been there
SEED = 1.0e-6  # of the stall torque: braking from the no-load speed starts from no less
EDGE = 1.0 + SEED
SNAP = 1.0e-3  # parts of a step shorter than this are rounding of the clock
WHOLE = 1.0 - SNAP

KP, KD = INDEX["kp"], INDEX["kd"]
DEADBAND = INDEX["deadband"]
TORQUE_LIMIT, NO_LOAD_SPEED = INDEX["torque_limit"], INDEX["no_load_speed"]
EFFICIENCY, DELAY, LAG_TIME, SUPPLY = INDEX["efficiency"], INDEX["delay"], INDEX["lag"], INDEX["supply"]
COULOMB, ASYMMETRY = INDEX["coulomb_friction"], INDEX["friction_asymmetry"]
STRIBECK_PEAK, STRIBECK_SPEED = INDEX["stribeck_peak"], INDEX["stribeck_speed"]
VISCOUS = INDEX["viscous_friction"]
LOAD, LOAD_BACK = INDEX["load_friction"], INDEX["load_friction_backdriven"]
RIPPLE, RIPPLE_PER_TURN, RIPPLE_PHASE = INDEX["torque_ripple"], INDEX["ripple_per_turn"], INDEX["ripple_phase"]
OFFSET, SCALE = INDEX["position_offset"], INDEX["position_scale"]
REST, REST_POSITION = INDEX["standin_constant"], INDEX["standin_position"]
REST_SPEED, REST_DRAG = INDEX["standin_speed"], INDEX["standin_drag"]


@lru_cache(maxsize=None)
def servo_kernel(real, voltage: bool):
    """The kernel that runs before each physics step, for real in {wp.float32, wp.float64} and the kind of drive."""

    @wp.kernel(module="unique", enable_backward=False)
    def servo(
        # in
        dt: real,
        queue: int,
        dof: wp.array(dtype=int),
        dof_q: wp.array(dtype=int),
        loop_q: wp.array(dtype=int),
        loop_dof: wp.array(dtype=int),
        params: wp.array3d(dtype=real),
        inertia: wp.array2d(dtype=real),
        base_damping: wp.array2d(dtype=real),
        base_frictionloss: wp.array2d(dtype=real),
        time: wp.array(dtype=real),
        qpos: wp.array2d(dtype=real),
        qvel: wp.array2d(dtype=real),
        # in and out
        state: wp.array3d(dtype=real),
        # out
        qfrc_applied: wp.array2d(dtype=real),
        dof_damping: wp.array2d(dtype=real),
        dof_frictionloss: wp.array2d(dtype=real),
        torque: wp.array2d(dtype=real),
    ):
        w, j = wp.tid()
        zero = real(0.0)
        one = real(1.0)
        d = dof[j]
        v = qvel[w, d]
        scale = params[w, j, SCALE]
        q_m = scale * qpos[w, loop_q[j]] + params[w, j, OFFSET]
        v_m = scale * qvel[w, loop_dof[j]]

        # The target in force, averaged over this step: a delay that ends inside a step acts for the rest of it.
        end = time[w] - params[w, j, DELAY] + dt
        target = state[w, j, QUEUE + queue]
        for k in range(1, queue):
            part = wp.clamp((end - state[w, j, QUEUE + k]) / dt, zero, one)
            new = state[w, j, QUEUE + queue + k]
            if part > real(WHOLE):
                target = new
            elif part > real(SNAP):
                target += part * (new - state[w, j, QUEUE + queue + k - 1])

        # PD: now (what the current shows) and as a line in the velocity at the end of the step.
        e = target - q_m
        kp = params[w, j, KP]
        now = kp * e - params[w, j, KD] * v_m
        pd = now - kp * dt * v_m
        slope = scale * (kp * dt + params[w, j, KD])
        if wp.abs(e) < params[w, j, DEADBAND]:
            now = zero
            pd = zero
            slope = zero

        tau0 = params[w, j, TORQUE_LIMIT]
        supply = params[w, j, SUPPLY]
        motor_now = zero
        motor = zero
        damping = zero
        if wp.static(voltage):
            line = tau0 / params[w, j, NO_LOAD_SPEED]
            motor_now = tau0 * supply * wp.clamp(now, -one, one) - line * v
            motor = tau0 * supply * wp.clamp(pd, -one, one) - line * v
            damping = tau0 * supply * slope + line
            if wp.abs(pd) > one:
                unlimited = tau0 * supply * pd - line * v
                ratio = zero
                if unlimited != zero:
                    ratio = wp.clamp(motor / unlimited, zero, one)
                damping = wp.max(ratio * damping, line)
        else:
            x = wp.abs(v) / (params[w, j, NO_LOAD_SPEED] * supply)  # speed over no-load speed
            limit = zero
            if x < one:
                limit = tau0 * (one - x)
            motor_now = wp.clamp(now, -limit, limit)
            motor = wp.clamp(pd, -limit, limit)
            damping = slope
            if wp.abs(pd) > limit:
                line = tau0 / (params[w, j, NO_LOAD_SPEED] * supply)
                size = limit
                if pd * v < zero:  # braking: the limit grows as the speed falls, by this factor within the step
                    growth = wp.min(params[w, j, EFFICIENCY] * line * dt / inertia[w, j], real(60.0))
                    if growth > real(SNAP) and x < real(EDGE):
                        size = wp.max(limit, real(SEED) * tau0) * (wp.exp(growth) - one) / growth
                        size = wp.min(size, wp.min(tau0, wp.abs(pd)))
                        motor = wp.sign(pd) * size
                    line = size / (params[w, j, NO_LOAD_SPEED] * supply * (one + x))
                elif limit == zero:
                    line = zero
                # to the PD's zero, or to the no-load speed in the direction of the torque
                damping = wp.max(slope * size / wp.abs(pd), line)

        if state[w, j, ENABLED] == zero:
            motor_now = zero
            motor = zero
            damping = zero

        # First-order lag, backward Euler: y' = (1 - blend) y + blend * motor.
        blend = dt / (params[w, j, LAG_TIME] + dt)
        last = state[w, j, MOTOR]
        motor_now = last + blend * (motor_now - last)
        motor = last + blend * (motor - last)
        damping = blend * damping
        state[w, j, MOTOR] = motor_now
        torque[w, j] = motor_now

        applied = params[w, j, EFFICIENCY] * motor
        damping = params[w, j, EFFICIENCY] * damping

        # Ripple; where its slope is that of a spring, it too is taken at the end of the step.
        turn = params[w, j, RIPPLE_PER_TURN]
        angle = turn * qpos[w, dof_q[j]] + params[w, j, RIPPLE_PHASE]
        applied += params[w, j, RIPPLE] * wp.sin(angle)
        stiffness = wp.max(zero, -params[w, j, RIPPLE] * turn * wp.cos(angle))
        applied -= stiffness * dt * v
        damping += stiffness * dt

        # The stand-in for what is not known; what of it brakes, or pulls like a spring, is taken at the end of the step.
        pull = params[w, j, REST_POSITION]
        brake = params[w, j, REST_SPEED] + params[w, j, REST_DRAG] * wp.abs(v)
        applied += params[w, j, REST] + pull * qpos[w, dof_q[j]] + brake * v
        spring = wp.max(zero, -pull)
        applied -= spring * dt * v
        brake = wp.max(zero, -brake)
        damping += spring * dt

        # Dry friction: an interval of torques [-level (1 + a/2), +level (1 - a/2)], as a symmetric one and a constant.
        ratio_v = v / params[w, j, STRIBECK_SPEED]
        fraction = params[w, j, LOAD]
        if last * v < zero:
            fraction = params[w, j, LOAD_BACK]
        level = base_frictionloss[w, j] + params[w, j, COULOMB]
        level += params[w, j, STRIBECK_PEAK] * wp.exp(-ratio_v * ratio_v) + fraction * wp.abs(last)
        applied -= real(0.5) * params[w, j, ASYMMETRY] * level

        damping += brake
        qfrc_applied[w, d] = applied + damping * v
        dof_damping[w, d] = base_damping[w, j] + params[w, j, VISCOUS] + damping
        dof_frictionloss[w, d] = level

    return servo


@lru_cache(maxsize=None)
def send_kernel(real):
    """Appends a target to the queues of the masked worlds; the oldest entry falls out."""

    @wp.kernel(module="unique", enable_backward=False)
    def send(
        queue: int,
        period: real,  # of the bus that carries targets; 0: they act when stamped
        mask: wp.array(dtype=wp.bool),
        stamp: wp.array(dtype=real),
        target: wp.array2d(dtype=real),
        state: wp.array3d(dtype=real),
    ):
        w, j = wp.tid()
        if not mask[w]:
            return
        t = stamp[w]
        if period > real(0.0):
            t = wp.ceil(t / period - real(SNAP)) * period
        for k in range(queue - 1):
            state[w, j, QUEUE + k] = state[w, j, QUEUE + k + 1]
            state[w, j, QUEUE + queue + k] = state[w, j, QUEUE + queue + k + 1]
        state[w, j, QUEUE + queue - 1] = t
        state[w, j, QUEUE + 2 * queue - 1] = target[w, j]

    return send


@lru_cache(maxsize=None)
def reset_kernel(real):
    """Puts the masked worlds' drives at rest: no torque stored, enabled, the given target since ever."""

    @wp.kernel(module="unique", enable_backward=False)
    def reset(
        queue: int,
        mask: wp.array(dtype=wp.bool),
        target: wp.array2d(dtype=real),
        state: wp.array3d(dtype=real),
        torque: wp.array2d(dtype=real),
    ):
        w, j = wp.tid()
        if not mask[w]:
            return
        state[w, j, MOTOR] = real(0.0)
        state[w, j, ENABLED] = real(1.0)
        for k in range(queue):
            state[w, j, QUEUE + k] = real(NEVER)
            state[w, j, QUEUE + queue + k] = target[w, j]
        torque[w, j] = real(0.0)

    return reset
