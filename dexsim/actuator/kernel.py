"""The servo as Warp kernels: one thread per world and joint. `reference.py` holds the same lines in NumPy.

The law (paper, "Actuator Model Randomization"; its reference velocity qd_ref is taken as zero: targets are held):

    e      = target - q_m,    q_m = scale * q + offset                     measured position of the loop's encoder
    tau_c  = kp * e - kd * qd_m                                            (+ the controller's other terms, `laws.controller_terms`)
    tau_b  = 0 if |e| < deadband else tau_c
    limit  = torque_limit * max(0, 1 - b |qd| / no_load_speed)             b = 1 where motor * qd >= 0, braking_slope where it brakes
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
    the speed falls, exponentially with rate r = braking_slope * efficiency * tau0 / no_load_speed / inertia; a tiny link does so within one
    step, so T takes the mean over the step, limit * (exp(r dt) - 1) / (r dt), `inertia` being 1 / dof_invweight0.
  All differences from the law are O(dt).

Play and elasticity. The motor turns a rotor of inertia J_r, which leaves the joint's armature; a spring K with a gap joins
rotor and link. Backward Euler over the step, with the link's velocity v' at its end still open:
    J_r (w' - w) / dt = motor(w', v') - viscous w' - level sign(w') - tau',   tau' = K (stretch + dt (w' - v')) + C (w' - v').
Friction and the side of the gap are taken from the step's start with v' = v; what remains is a line w' = A + B v', so that the link
feels tau' = T - D v'. D dt goes to dof_armature and T - D v to qfrc_applied, so that MuJoCo solves link, contact and spring together (its
contacts know the inertia, not the damping). The rotor's step is completed with the v' it
found when the next begins: what the rotor loses the link receives. With K -> inf, D dt -> J_r: the armature again.
Rotors carry the motor's friction and turn the torque-speed line; the model's own friction stays on the link.
Dry friction goes to dof_frictionloss (as a torque it would chatter), so MuJoCo resolves sticking; one that is elastic before it
slides (`presliding`) is a spring there and goes to qfrc_applied and dof_damping. How hard it sticks is
the joint's solimpfriction: the default (0.9) lets a stuck joint creep, 0.999 does not.
"""

# No `from __future__ import annotations`: Warp resolves these annotations from the closure.

from functools import lru_cache
from typing import Any

import warp as wp

from dexsim.actuator.columns import INDEX
from dexsim.actuator.laws import difference, hold, preslide, preslide_slope, ripple_wave, stribeck_power, torque_limit, wind

# Slots of state[world, joint, slot] before the queue: `queue` stamps [s], then `queue` targets [rad], oldest first.
MOTOR, ENABLED, QUEUE = 0, 1, 2
SLOTS = ("motor", "enabled")
# After the queue, where a feature of `columns.FEATURES` needs it. line_a, line_b: see "Play and elasticity".
EXTRA_SLOTS = ("filtered", "rotor", "line_a", "line_b", "fresh", "integral", "taken")
FILTERED, ROTOR, LINE_A, LINE_B, FRESH, INTEGRAL, TAKEN = range(len(EXTRA_SLOTS))
EXTENDED = frozenset({"play", "rare", "controller", "presliding"})  # the features that need them

NEVER = -1.0e9  # the stamp of a target that has always been there
SEED = 1.0e-6  # of the stall torque: braking from the no-load speed starts from no less
EDGE = 1.0 + SEED
STOP_RATE = 2.0 * 3.141592653589793 * 40.0  # rad/s: how stiff the ends of a play are, over the inertia, and
STOP_GAIN = 30.0  # over the loop's own stiffness
LEAST_ROTOR = 0.03  # of the joint's inertia
BORROWED = 0.5  # of the joint's inertia: what a rotor beyond the model's armature may take from the link
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
ECC_SIN, ECC_COS = INDEX["eccentric_sin"], INDEX["eccentric_cos"]
SPEED_LAG, DEADBAND_KIND = INDEX["speed_lag"], INDEX["deadband_kind"]
BACKLASH, REBOUND, SOFTNESS, HARDENING, ROTOR_INERTIA = (INDEX[n] for n in ("backlash", "rebound", "softness", "hardening", "rotor"))
THERMAL_TORQUE, THERMAL_FRICTION, THERMAL_RESISTANCE, WARMTH = (
    INDEX[n] for n in ("thermal_torque", "thermal_friction", "thermal_resistance", "warmth")
)
BRAKING = INDEX["braking_slope"]
STRIBECK_EXPONENT, PRESLIDING, RIPPLE_SHAPE = (INDEX[n] for n in ("stribeck_exponent", "presliding", "ripple_shape"))
FEED_SPEED, FEED_ACCELERATION, INTEGRAL_GAIN = (INDEX[n] for n in ("speed_feedforward", "acceleration_feedforward", "integral_gain"))
SAG, COUPLING, COUPLING_FROM = INDEX["sag"], INDEX["coupling"], INDEX["coupling_from"]
REST, REST_POSITION = INDEX["standin_constant"], INDEX["standin_position"]
REST_SPEED, REST_DRAG = INDEX["standin_speed"], INDEX["standin_drag"]


@wp.func
def target_rates(state: wp.array3d(dtype=Any), w: int, j: int, queue: int, begin: Any, dt: Any):
    """(speed [rad/s], acceleration [rad/s2]) of the target, each the mean over the step [begin, begin + dt] of what is in force
    (`laws.difference`, `laws.hold`): begin is the step's, less the delay."""
    speed = begin * type(begin)(0.0)
    acceleration = begin * type(begin)(0.0)
    rate = begin * type(begin)(0.0)
    for k in range(1, queue):
        stamp = state[w, j, QUEUE + k]
        span = stamp - state[w, j, QUEUE + k - 1]
        before = rate
        rate = difference(state[w, j, QUEUE + queue + k], state[w, j, QUEUE + queue + k - 1], span, dt)
        until = begin + dt
        if k + 1 < queue:
            until = wp.min(until, state[w, j, QUEUE + k + 1])
        share = hold(stamp, span, until, begin, dt)
        speed += share * rate
        acceleration += share * difference(rate, before, span, dt)
    return wp.vector(speed, acceleration)


@lru_cache(maxsize=None)
def servo_kernel(real, voltage: bool, features: frozenset[str] = frozenset()):
    """The kernel that runs before each physics step, for real in {wp.float32, wp.float64}, the kind of drive and `FEATURES`."""
    play, sag, rare, braking, controller, presliding, shape = (
        name in features for name in ("play", "sag", "rare", "braking", "controller", "presliding", "shape")
    )
    extended = bool(features & EXTENDED)

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
        base_armature: wp.array2d(dtype=real),
        home: wp.array2d(dtype=real),
        loop_motor: wp.array(dtype=int),
        time: wp.array(dtype=real),
        qpos: wp.array2d(dtype=real),
        qvel: wp.array2d(dtype=real),
        given: wp.array(dtype=real),
        # in and out
        state: wp.array3d(dtype=real),
        # out
        qfrc_applied: wp.array2d(dtype=real),
        dof_damping: wp.array2d(dtype=real),
        dof_frictionloss: wp.array2d(dtype=real),
        dof_armature: wp.array2d(dtype=real),
        torque: wp.array2d(dtype=real),
    ):
        w, j = wp.tid()
        zero = real(0.0)
        one = real(1.0)
        d = dof[j]
        v = qvel[w, d]
        scale = params[w, j, SCALE]
        turned = qpos[w, loop_q[j]]  # what the loop's encoder turns with
        turning = qvel[w, loop_dof[j]]
        v_drive = v  # the motor's speed
        inertia_drive = inertia[w, j]

        x0 = int(0)
        fresh = bool(False)
        if wp.static(extended):
            x0 = QUEUE + 2 * queue
            fresh = state[w, j, x0 + FRESH] != zero
            state[w, j, x0 + FRESH] = zero

        # The rotor where the last step's v' has left it.
        two = bool(False)
        loop_on_rotor = bool(False)
        rotor_q = zero
        rotor_inertia = zero
        gap2 = zero
        armature = zero
        if wp.static(play):
            rotor_q = qpos[w, dof_q[j]]
            gap2 = real(0.5) * params[w, j, BACKLASH]
            two = gap2 > zero or params[w, j, SOFTNESS] > zero
            if two and not fresh:
                v_drive = state[w, j, x0 + LINE_A] + state[w, j, x0 + LINE_B] * v
                rotor_q = state[w, j, x0 + ROTOR] + dt * v_drive
            if two:
                rotor_inertia = params[w, j, ROTOR_INERTIA]
                if rotor_inertia == zero:
                    rotor_inertia = base_armature[w, j]
                rotor_inertia = wp.max(rotor_inertia, wp.static(real(LEAST_ROTOR)) * inertia[w, j])
                inertia_drive = rotor_inertia
                loop_on_rotor = loop_motor[j] != 0
                if loop_on_rotor:
                    turned = rotor_q
                    turning = v_drive
            state[w, j, x0 + ROTOR] = rotor_q
            armature = wp.max(base_armature[w, j] - rotor_inertia, -real(BORROWED) * inertia[w, j])
            dof_armature[w, d] = armature

        q_m = scale * turned + params[w, j, OFFSET]
        v_m = scale * turning
        v_d = v_m  # the speed that kd acts on: now, and
        v_next = v_m  # at the end of the step at unchanged speed
        kd_blend = one
        if wp.static(rare):
            q_m += params[w, j, ECC_SIN] * wp.sin(turned) + params[w, j, ECC_COS] * (wp.cos(turned) - one)
            scale += params[w, j, ECC_SIN] * wp.cos(turned) - params[w, j, ECC_COS] * wp.sin(turned)  # what it shows of a speed here
            v_m = scale * turning
            kd_blend = dt / (params[w, j, SPEED_LAG] + dt)
            filtered = turning
            if not fresh:
                filtered = state[w, j, x0 + FILTERED]
                filtered += kd_blend * (turning - filtered)
            state[w, j, x0 + FILTERED] = filtered
            v_d = scale * filtered
            v_next = scale * (filtered + kd_blend * (turning - filtered))

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
        if wp.static(rare):
            dragged = params[w, j, COUPLING]
            if dragged != zero:
                other = wp.clamp(int(params[w, j, COUPLING_FROM]), 0, dof_q.shape[0] - 1)
                target += dragged * (qpos[w, dof_q[other]] - home[w, other])

        # What the supply and the temperature leave of the motor, and its limits at this speed.
        tau0 = params[w, j, TORQUE_LIMIT]
        supply = params[w, j, SUPPLY]
        no_load = params[w, j, NO_LOAD_SPEED]
        efficiency = params[w, j, EFFICIENCY]
        friction_factor = one
        if wp.static(rare):
            warmth = params[w, j, WARMTH]
            torque_factor = one + params[w, j, THERMAL_TORQUE] * warmth
            friction_factor = wp.max(one + params[w, j, THERMAL_FRICTION] * warmth, zero)
            tau0 = tau0 * torque_factor
            if wp.static(voltage):
                tau0 = tau0 / wp.max(one + params[w, j, THERMAL_RESISTANCE] * warmth, wp.static(real(0.1)))
                no_load = no_load / torque_factor
            else:
                efficiency = efficiency * torque_factor
        if wp.static(sag):
            others = given[w] - wp.abs(torque[w, j])
            supply = supply * wp.max(one - params[w, j, SAG] * others, wp.static(real(0.05)))
        x = zero  # speed over no-load speed
        upper = one  # limits of torque, or of duty
        lower = one
        steep = one  # how the limit falls with the speed while braking
        if wp.static(not voltage):
            x = wp.abs(v_drive) / (no_load * supply)
            upper = torque_limit(tau0, x, one)
            lower = upper
            if wp.static(braking):
                steep = params[w, j, BRAKING]
                if v_drive > zero:
                    lower = torque_limit(tau0, x, steep)
                elif v_drive < zero:
                    upper = torque_limit(tau0, x, steep)

        # PD: now (what the current shows) and as a line in the velocity at the end of the step.
        e = target - q_m
        kp = params[w, j, KP]
        now = kp * e - params[w, j, KD] * v_d
        pd = now - kp * dt * v_m
        slope = scale * (kp * dt + params[w, j, KD])
        kind = zero
        if wp.static(rare):
            pd = kp * e - params[w, j, KD] * v_next - kp * dt * v_m
            slope = scale * (kp * dt + kd_blend * params[w, j, KD])
            kind = params[w, j, DEADBAND_KIND]
            if kind > real(1.5):
                cut = kp * wp.clamp(e, -params[w, j, DEADBAND], params[w, j, DEADBAND])
                now -= cut
                pd -= cut
        dead = wp.abs(e) < params[w, j, DEADBAND]
        if dead:
            if wp.static(rare):
                if kind > real(0.5):
                    now = -params[w, j, KD] * v_d
                    pd = -params[w, j, KD] * v_next
                    slope = scale * kd_blend * params[w, j, KD]
                else:
                    now = zero
                    pd = zero
                    slope = zero
            else:
                now = zero
                pd = zero
                slope = zero

        if wp.static(controller):
            wish = target_rates(state, w, j, queue, end - dt, dt)
            feed = params[w, j, FEED_SPEED] * wish[0] + params[w, j, FEED_ACCELERATION] * wish[1]
            ki = params[w, j, INTEGRAL_GAIN]
            e_i = e  # the error that is integrated: what the deadband leaves of it
            if kind > real(1.5):
                e_i = e - wp.clamp(e, -params[w, j, DEADBAND], params[w, j, DEADBAND])
            if dead:
                e_i = zero
            wound = zero
            if state[w, j, ENABLED] != zero:
                wound = state[w, j, x0 + INTEGRAL]
                wound = wind(wound, dt * ki * e_i, now + feed + wound, lower, upper)
            state[w, j, x0 + INTEGRAL] = wound
            if not dead or kind > real(0.5):
                now += feed + wound
                pd += feed + wound
                if not dead:  # backward Euler of the integral, too
                    pd += dt * ki * (e_i - dt * v_m)
                    slope += scale * dt * dt * ki
        motor_now = zero
        motor = zero
        damping = zero
        on_drive = zero  # what of the slope below is in the motor's own speed, not in that of the loop's encoder
        if wp.static(voltage):
            line = tau0 / no_load
            motor_now = tau0 * supply * wp.clamp(now, -one, one) - line * v_drive
            motor = tau0 * supply * wp.clamp(pd, -one, one) - line * v_drive
            damping = tau0 * supply * slope + line
            on_drive = line
            if wp.abs(pd) > one:
                unlimited = tau0 * supply * pd - line * v_drive
                ratio = zero
                if unlimited != zero:
                    ratio = wp.clamp(motor / unlimited, zero, one)
                damping = wp.max(ratio * damping, line)
                on_drive = damping
        else:
            motor_now = wp.clamp(now, -lower, upper)
            motor = wp.clamp(pd, -lower, upper)
            limit = upper
            if pd < zero:
                limit = lower
            damping = slope
            if wp.abs(pd) > limit:
                line = tau0 / (no_load * supply)
                size = limit
                if pd * v_drive < zero:  # braking: the limit grows as the speed falls, by this factor within the step
                    growth = wp.min(steep * efficiency * line * dt / inertia_drive, real(60.0))
                    if growth > real(SNAP) and steep * x < real(EDGE):
                        size = wp.max(limit, real(SEED) * tau0) * (wp.exp(growth) - one) / growth
                        size = wp.min(size, wp.min(tau0, wp.abs(pd)))
                        motor = wp.sign(pd) * size
                    line = size / (no_load * supply * (one + x))
                elif limit == zero:
                    line = zero
                # to the PD's zero, or to the no-load speed in the direction of the torque
                damping = wp.max(slope * size / wp.abs(pd), line)
                on_drive = damping

        if state[w, j, ENABLED] == zero:
            motor_now = zero
            motor = zero
            damping = zero
            on_drive = zero

        # First-order lag, backward Euler: y' = (1 - blend) y + blend * motor.
        blend = dt / (params[w, j, LAG_TIME] + dt)
        last = state[w, j, MOTOR]
        motor_now = last + blend * (motor_now - last)
        motor = last + blend * (motor - last)
        damping = blend * damping
        state[w, j, MOTOR] = motor_now
        torque[w, j] = motor_now

        applied = efficiency * motor
        damping = efficiency * damping
        on_drive = efficiency * blend * on_drive

        # Ripple; where its slope is that of a spring, it too is taken at the end of the step.
        turn = params[w, j, RIPPLE_PER_TURN]
        angle = turn * qpos[w, dof_q[j]] + params[w, j, RIPPLE_PHASE]
        form = zero
        if wp.static(shape):
            form = params[w, j, RIPPLE_SHAPE]
        wave = ripple_wave(angle, form)
        applied += params[w, j, RIPPLE] * wave[0]
        stiffness = wp.max(zero, -params[w, j, RIPPLE] * turn * wave[1])
        applied -= stiffness * dt * v
        damping += stiffness * dt

        of_motor = applied  # on the rotor, where there is one
        slope_motor = damping

        # The stand-in for what is not known; what of it brakes, or pulls like a spring, is taken at the end of the step.
        pull = params[w, j, REST_POSITION]
        brake = params[w, j, REST_SPEED] + params[w, j, REST_DRAG] * wp.abs(v)
        applied += params[w, j, REST] + pull * qpos[w, dof_q[j]] + brake * v
        spring = wp.max(zero, -pull)
        applied -= spring * dt * v
        brake = wp.max(zero, -brake)
        damping += spring * dt

        # Dry friction: an interval of torques [-level (1 + a/2), +level (1 - a/2)], as a symmetric one and a constant.
        ratio_v = v_drive / params[w, j, STRIBECK_SPEED]
        fraction = params[w, j, LOAD]
        if last * v_drive < zero:
            fraction = params[w, j, LOAD_BACK]
        viscous = params[w, j, VISCOUS]
        level = base_frictionloss[w, j] + params[w, j, COULOMB]
        if wp.static(rare):
            viscous = viscous * friction_factor
            level = base_frictionloss[w, j] + friction_factor * params[w, j, COULOMB]
            fraction = fraction * friction_factor
        peak = params[w, j, STRIBECK_PEAK]
        if wp.static(rare):
            peak = peak * friction_factor
        exponent = real(2.0)
        if wp.static(shape):
            exponent = params[w, j, STRIBECK_EXPONENT]
        level += peak * wp.exp(-stribeck_power(ratio_v, exponent)) + fraction * wp.abs(last)

        # Elastic before it slides: a torque, taken up at the step's begin, and its line in the speed at the step's end.
        bristle = zero
        if wp.static(presliding):
            give = params[w, j, PRESLIDING]
            if give > zero:
                taken = zero
                if not fresh:
                    taken = preslide(state[w, j, x0 + TAKEN], v_drive * dt / give)
                state[w, j, x0 + TAKEN] = taken
                sliding = level
                if two:
                    sliding = level - base_frictionloss[w, j]
                bristle = sliding * taken
                viscous += sliding * dt / give * preslide_slope(taken, v_drive * dt / give)

        if wp.static(play):
            if two:
                drawn = of_motor
                own = level - base_frictionloss[w, j]  # the rotor's; the model's own stays on the link
                of_motor -= real(0.5) * params[w, j, ASYMMETRY] * own
                if wp.static(presliding):
                    if params[w, j, PRESLIDING] > zero:
                        of_motor -= bristle
                        own = zero
                on_loop = zero  # the slope in the link's speed
                if loop_on_rotor:
                    on_drive = slope_motor
                else:
                    on_loop = slope_motor - on_drive
                applied = applied - drawn  # what acts on the link itself: the stand-in
                damping = damping - slope_motor
                soft = params[w, j, SOFTNESS]
                link = wp.max(inertia[w, j] - rotor_inertia, wp.static(real(LEAST_ROTOR)) * inertia[w, j])
                stiff = kp
                if wp.static(voltage):
                    stiff = kp * tau0
                stiff = real(STOP_GAIN) * stiff + wp.static(real(STOP_RATE * STOP_RATE)) * inertia[w, j]
                if soft > zero:
                    stiff = one / soft
                damp = real(2.0) * params[w, j, REBOUND] * wp.sqrt(stiff * rotor_inertia * link / (rotor_inertia + link))
                # without the spring: rotor_inertia (w' - w) / dt = of_motor - on_drive (w' - w) - on_loop (v' - v) - viscous w' -+ own
                free_a = rotor_inertia / dt + viscous + on_drive
                push = rotor_inertia / dt * v_drive + of_motor + on_drive * v_drive
                line_a = zero
                line_b = zero
                if wp.abs(push) > own:
                    line_a = (push - wp.sign(push) * own + on_loop * v) / free_a
                    line_b = -on_loop / free_a
                twist = rotor_q + dt * (line_a + line_b * v) - qpos[w, dof_q[j]] - dt * v
                pulls = zero
                spring_t = zero
                if wp.abs(twist) >= gap2:
                    side = wp.sign(twist) * gap2
                    stretch = stiff * (rotor_q - qpos[w, dof_q[j]] - side)
                    harder = one
                    if soft > zero:
                        harder = one + params[w, j, HARDENING] * stretch * stretch
                    grip = (real(3.0) * harder - real(2.0)) * stiff * dt + damp
                    pull = stretch * harder
                    all_a = free_a + grip
                    on_a = zero
                    on_b = zero
                    if wp.abs(push - pull + grip * v) > own:
                        on_a = (push - pull - wp.sign(push - pull + grip * v) * own + on_loop * v) / all_a
                        on_b = (grip - on_loop) / all_a
                    pushed = pull + grip * on_a
                    slope_pushed = grip * (one - on_b)
                    # the ends of a play push and do not pull
                    if gap2 == zero or (pushed - slope_pushed * v) * side >= zero:
                        line_a = on_a
                        line_b = on_b
                        pulls = pushed
                        spring_t = slope_pushed
                state[w, j, x0 + LINE_A] = line_a
                state[w, j, x0 + LINE_B] = line_b
                damping += brake
                # D goes to the armature, D (v' - v) = D dt a: contacts are solved with the inertia, which a damping is no part of
                qfrc_applied[w, d] = applied + damping * v + pulls - spring_t * v
                dof_armature[w, d] = armature + spring_t * dt
                dof_damping[w, d] = base_damping[w, j] + damping
                dof_frictionloss[w, d] = base_frictionloss[w, j]
                return
            state[w, j, x0 + LINE_A] = zero
            state[w, j, x0 + LINE_B] = one

        applied -= real(0.5) * params[w, j, ASYMMETRY] * level
        if wp.static(presliding):
            if params[w, j, PRESLIDING] > zero:
                applied -= bristle
                level = zero
        damping += brake
        qfrc_applied[w, d] = applied + damping * v
        dof_damping[w, d] = base_damping[w, j] + viscous + damping
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
def reset_kernel(real, extended: bool = False):
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
        if wp.static(extended):
            state[w, j, QUEUE + 2 * queue + FRESH] = real(1.0)
            state[w, j, QUEUE + 2 * queue + INTEGRAL] = real(0.0)
        state[w, j, MOTOR] = real(0.0)
        state[w, j, ENABLED] = real(1.0)
        for k in range(queue):
            state[w, j, QUEUE + k] = real(NEVER)
            state[w, j, QUEUE + queue + k] = target[w, j]
        torque[w, j] = real(0.0)

    return reset


@lru_cache(maxsize=None)
def given_kernel(real):
    """What all motors of a world give, from the last step: sum of |torque| [N.m], for a supply that sags."""

    @wp.kernel(module="unique", enable_backward=False)
    def given(joints: int, torque: wp.array2d(dtype=real), out: wp.array(dtype=real)):
        w = wp.tid()
        total = real(0.0)
        for j in range(joints):
            total += wp.abs(torque[w, j])
        out[w] = total

    return given
