"""One joint through many windows under many parameter guesses: a Warp kernel, one thread per guess and window.

In free air each joint is its own small system once the other joints' measured motion is prescribed:

    I(t) dv/dt = eta * motor - gravity(q, t) - rest(t) - friction(v) - viscous v

with I, gravity and rest taken from the MuJoCo model along the measured motion (`mechanics.py`); the motor's law is that
of `dexsim.actuator.kernel`, line for line, so a fitted column means the same there. With play or elasticity, rotor
and link are two inertias joined by a spring with a gap, integrated implicitly (no stiffness limit on the step). Dry
friction is solved exactly in each step (a joint sticks when the level can hold it), not approximated by a smooth law.
"""

# No `from __future__ import annotations`: Warp resolves these annotations from the closure.

from functools import lru_cache

import warp as wp

from dexsim.actuator.laws import difference, hold, preslide, preslide_speed, ripple_wave, stribeck_power, torque_limit, wind
from dexsim.gap.plant.columns import INDEX, LATE_GROUPS, SERIES_INDEX

f64 = wp.float64
vec5 = wp.types.vector(length=5, dtype=f64)
ONE_BODY_STEPS = 1
TWO_BODY_STEPS = 6  # sub-steps of the two-inertia plant in one step of the grid

# constants of a joint: consts[...]
C_VOLTAGE, C_LOOP_MOTOR, C_POS_MOTOR, C_DAMPING, C_FRICTION, C_LOW, C_HIGH, C_STIFF, C_SLIDE, C_OPEN = range(10)
CONSTS = 10
P_KP, P_KD, P_DEADBAND, P_LIMIT, P_NLS, P_EFF, P_DELAY, P_LAG, P_SUPPLY = (
    INDEX[n] for n in ("kp", "kd", "deadband", "torque_limit", "no_load_speed", "efficiency", "delay", "lag", "supply")
)
P_COULOMB, P_ASYM, P_PEAK, P_VS, P_VISC, P_LOAD, P_BACK = (
    INDEX[n]
    for n in (
        "coulomb_friction", "friction_asymmetry", "stribeck_peak", "stribeck_speed", "viscous_friction",
        "load_friction", "load_friction_backdriven",
    )
)  # fmt: skip
P_RIPPLE, P_TURN, P_PHASE, P_OFFSET, P_SCALE = (
    INDEX[n] for n in ("torque_ripple", "ripple_per_turn", "ripple_phase", "position_offset", "position_scale")
)
P_ISCALE, P_GSCALE, P_ARM, P_PAYLOAD, P_TX, P_TY, P_TZ, P_GAP, P_SOFT, P_ROTOR, P_SAG = (
    INDEX[n]
    for n in (
        "inertia_scale", "gravity_scale", "armature", "payload", "tilt_x", "tilt_y", "tilt_z", "backlash", "softness",
        "rotor", "sag",
    )
)  # fmt: skip
P_TTORQUE, P_TFRICTION, P_TRES, P_COUPLING, P_ESIN, P_ECOS, P_SPEEDLAG, P_BIAS, P_AGE, P_LIMITSPEED = (
    INDEX[n]
    for n in (
        "thermal_torque", "thermal_friction", "thermal_resistance", "coupling", "eccentric_sin", "eccentric_cos",
        "speed_lag", "bias", "feedback_delay", "limit_speed",
    )
)  # fmt: skip
X = SERIES_INDEX
XQ, XV, XI, XGC, XGS, XR, XLI, XLC, XLS = (
    X[n] for n in ("q", "v", "inertia", "gravity_cos", "gravity_sin", "rest", "load_inertia", "load_cos", "load_sin")
)
XTXC, XTXS, XTYC, XTYS, XTZC, XTZS = (X[f"tilt_{a}_{b}"] for a in "xyz" for b in ("cos", "sin"))
XSUP, XOTH, XWARM, XDRAG, XON, XDRIVE = (X[n] for n in ("supply", "others_torque", "warmth", "drag0", "enabled", "drive"))
P_OWN = INDEX["own_payload"]
XOWI, XOWC, XOWS = (X[n] for n in ("own_inertia", "own_cos", "own_sin"))
XDV, XDA, XPULL = (X[n] for n in ("drag_v0", "drag_a0", "pull0"))
P_LINKAGE, P_REACTION = INDEX["linkage"], INDEX["reaction"]
P_FRESH = INDEX["effort_fresh"]
P_FROM, P_REBOUND = INDEX["coupling_from"], INDEX["rebound"]
P_PRESLIDE, P_BRAKING, P_DEADKIND = INDEX["presliding"], INDEX["braking_slope"], INDEX["deadband_kind"]
P_COUT, P_CACROSS, P_HARD = INDEX["com_out"], INDEX["com_across"], INDEX["hardening"]
P_EXPONENT, P_SHAPE = INDEX["stribeck_exponent"], INDEX["ripple_shape"]
P_FEEDV, P_FEEDA, P_KI = INDEX["speed_feedforward"], INDEX["acceleration_feedforward"], INDEX["integral_gain"]
P_LATE, P_LATEAT, P_LATEGROUP = INDEX["late_by"], INDEX["late_at"], INDEX["late_group"]
XOC, XOS, XOI, XAC, XAS, XAI = (X[f"com_{a}_{b}"] for a in ("out", "across") for b in ("cos", "sin", "inertia"))


@lru_cache(maxsize=None)
def plant_kernel():
    """The kernel; inputs documented at its launch in `plant.py`."""

    @wp.func
    def law(
        e: f64, v_m: f64, v: f64, kp: f64, kd: f64, scale: f64, deadband: f64, tau0: f64, nls: f64, supply: f64,
        dt: f64, voltage: f64, gain: f64, drift: f64, steep: f64, kind: f64, age: f64, v_lim: f64,
        feed: f64, ki: f64, since: f64, wound: f64,
    ):  # fmt: skip
        """(motor torque now, at the end of the step at unchanged speed, its slope in the loop's speed, its slope in the
        motor's speed, the integral term). gain, drift: the change of speed in this step is gain * torque + drift. feed: torque of
        the feed-forward; ki: integral_gain; wound: the integral term, `since` s before.

        At its limit the torque keeps to the limit for the whole step, unless the step's end is within the limits."""
        zero = f64(0.0)
        one = f64(1.0)
        half = f64(0.5)
        now = kp * e - kd * v_m
        pd = now - kp * dt * v_m
        slope = scale * (kp * (dt - age) + kd)
        if kind > f64(1.5):  # a dead zone: the error counts from its edge on
            cut = kp * wp.clamp(e, -deadband, deadband)
            now -= cut
            pd -= cut
        dead = wp.abs(e) < deadband
        if dead:
            if kind < half:  # no torque at all
                now = zero
                pd = zero
                slope = zero
            else:  # the error is taken for zero, the speed still counts
                now = -kd * v_m
                pd = now
                slope = scale * kd
        upper = one  # limits of the duty, or of the torque
        lower = one
        x = zero
        if voltage <= zero:
            x = wp.abs(v_lim) / (nls * supply)
            upper = torque_limit(tau0, x, one)
            lower = upper
            if v_lim > zero:
                lower = torque_limit(tau0, x, steep)
            elif v_lim < zero:
                upper = torque_limit(tau0, x, steep)
        kept = wound
        if not dead or kind > half:
            if not dead:
                e_i = e
                if kind > f64(1.5):
                    e_i = e - wp.clamp(e, -deadband, deadband)
                kept = wind(wound, since * ki * e_i, now + feed + wound, lower, upper)
                pd += ki * dt * (e_i - dt * v_m)
                slope += scale * ki * dt * dt
            now += feed + kept
            pd += feed + kept
        motor_now = zero
        motor = zero
        line = zero
        if voltage > zero:
            line = tau0 / nls
            motor_now = tau0 * supply * wp.clamp(now, -one, one) - line * v
            motor = tau0 * supply * wp.clamp(pd, -one, one) - line * v
            if wp.abs(pd) > one:
                end = pd - slope * (gain * motor + drift)
                if end * wp.sign(pd) >= one:
                    slope = zero
                else:
                    slope = slope / wp.abs(pd)
            slope = tau0 * supply * slope
        else:
            motor_now = wp.clamp(now, -lower, upper)
            motor = wp.clamp(pd, -lower, upper)
            limit = upper
            if pd < zero:
                limit = lower
            if wp.abs(pd) > limit:
                end = pd - slope * (gain * motor + drift)
                if end * wp.sign(pd) >= limit:
                    slope = zero
                    if pd * v_lim > zero and limit > zero:
                        line = tau0 / (nls * supply)
                    elif pd * v_lim < zero and limit > zero:
                        # it grows as the speed falls, exponentially: taken at the step's start it would come late
                        line = -wp.min(steep * tau0 / (nls * supply), half / wp.max(gain, f64(1.0e-12)))
                else:
                    slope = slope * limit / wp.abs(pd)
        return vec5(motor_now, motor, slope, line, kept)

    @wp.func
    def measured(q: f64, scale: f64, offset: f64, esin: f64, ecos: f64, round_: bool):
        """What the encoder shows at position q."""
        m = scale * q + offset
        if round_:
            m += esin * wp.sin(q) + ecos * (wp.cos(q) - f64(1.0))
        return m

    @wp.func
    def rate_of(q: f64, scale: f64, esin: f64, ecos: f64, round_: bool):
        """What the encoder shows of a speed at position q, over that speed."""
        k = scale
        if round_:
            k += esin * wp.cos(q) - ecos * wp.sin(q)
        return k

    @wp.func
    def acts_at(t: f64, i: int, late: f64, at: int, group: int):
        """When command i acts, but for the delay: its time t, later where it is one of those that are."""
        if late != f64(0.0) and (i // group) % LATE_GROUPS == at:
            return t + late
        return t

    @wp.func
    def target_rates(cmd_t: wp.array(dtype=f64), cmd: wp.array(dtype=f64), first: int, k: int, last: int, begin: f64, dt: f64,
                     late: f64, at: int, group: int):  # fmt: skip
        """Speed [rad/s] and acceleration [rad/s2] of the target, means over the step (see `actuator.laws.difference`): commands
        k .. last of the run, which begins with command `first`, are in force in it."""
        speed = f64(0.0)
        acceleration = f64(0.0)
        for m in range(wp.max(k, first + 1), last + 1):
            stamp = acts_at(cmd_t[m], m, late, at, group)
            before = acts_at(cmd_t[m - 1], m - 1, late, at, group)
            rate = difference(cmd[m], cmd[m - 1], stamp - before, dt)
            earlier = f64(0.0)
            if m > first + 1:
                earlier = difference(cmd[m - 1], cmd[m - 2], before - acts_at(cmd_t[m - 2], m - 2, late, at, group), dt)
            until = begin + dt
            if m < last:
                until = wp.min(until, acts_at(cmd_t[m + 1], m + 1, late, at, group))
            share = hold(stamp, stamp - before, until, begin, dt)
            speed += share * rate
            acceleration += share * difference(rate, earlier, stamp - before, dt)
        return wp.vec2d(speed, acceleration)

    @wp.kernel(module="unique", enable_backward=False)
    def plant(
        first: int,  # first guess of this launch
        dt: f64,
        params: wp.array2d(dtype=f64),  # [H, C]
        inits: wp.array2d(dtype=f64),  # [H, 2] added to the initial position and velocity
        consts: wp.array(dtype=f64),
        series: wp.array2d(dtype=f64),  # [G, E]
        cmd_t: wp.array(dtype=f64),
        cmd: wp.array(dtype=f64),
        window: wp.array2d(dtype=int),  # [W, 8] grid start, steps, warm steps, first sample, samples, cmd range, first cmd
        window_t: wp.array(dtype=f64),  # [W] time at the grid start
        sample_step: wp.array(dtype=int),  # [n] step of the window in which the sample falls
        sample_part: wp.array(dtype=f64),  # [n] where in it, 0..1
        out_q: wp.array2d(dtype=f64),  # [H, n]
        out_torque: wp.array2d(dtype=f64),  # [H, n]
    ):
        hh, w = wp.tid()
        h = first + hh
        zero = f64(0.0)
        one = f64(1.0)
        half = f64(0.5)
        g0 = window[w, 0]
        steps = window[w, 1]
        warm = window[w, 2]
        s = window[w, 3]
        s_end = s + window[w, 4]
        c_end = window[w, 6]
        k = window[w, 7]
        t = window_t[w]

        kp = params[h, P_KP]
        kd = params[h, P_KD]
        scale = params[h, P_SCALE]
        offset = params[h, P_OFFSET]
        esin = params[h, P_ESIN]
        ecos = params[h, P_ECOS]
        delay = params[h, P_DELAY]
        gap2 = half * params[h, P_GAP]
        soft = params[h, P_SOFT]
        two = gap2 > zero or soft > zero
        round_ = esin != zero or ecos != zero  # an eccentric encoder
        turn = params[h, P_TURN]
        ripple = params[h, P_RIPPLE]
        peak = params[h, P_PEAK]
        tilted = params[h, P_TX] != zero or params[h, P_TY] != zero or params[h, P_TZ] != zero
        speed_lag = params[h, P_SPEEDLAG]
        load_mass = params[h, P_PAYLOAD]
        out = params[h, P_COUT]
        across = params[h, P_CACROSS]
        off_centre = load_mass != zero and (out != zero or across != zero)
        hard = params[h, P_HARD]
        late = params[h, P_LATE]
        late_at = int(params[h, P_LATEAT])
        late_group = int(params[h, P_LATEGROUP])
        voltage = consts[C_VOLTAGE]
        base_damping = consts[C_DAMPING]
        base_friction = consts[C_FRICTION]
        low = consts[C_LOW]
        high = consts[C_HIGH]

        # measured = scale * q + offset + eccentricity(q): invert once, by two fixed-point steps
        m0 = series[g0, XQ]
        q = (m0 - offset) / scale
        q = (m0 - offset - esin * wp.sin(q) - ecos * (wp.cos(q) - one)) / scale
        q = (m0 - offset - esin * wp.sin(q) - ecos * (wp.cos(q) - one)) / scale
        v = series[g0, XV] / rate_of(q, scale, esin, ecos, round_)
        if warm == 0:
            q += inits[h, 0]
            v += inits[h, 1]
        qm = q
        vm = v
        last = zero
        v_f = v
        fresh = int(1)
        prev_tau = zero
        give = params[h, P_PRESLIDE]
        age = params[h, P_AGE]
        z = zero  # share of the friction that is taken up
        feed_v = params[h, P_FEEDV]
        feed_a = params[h, P_FEEDA]
        ki = params[h, P_KI]
        wound = zero  # the controller's integral term
        since = zero

        for i in range(steps):
            g = g0 + i
            # the recorded motion is held on the joint while the drive's own state settles
            if i <= warm and warm > 0:
                m1 = series[g, XQ]
                if round_:
                    m1 = m1 - esin * wp.sin(q) - ecos * (wp.cos(q) - one)
                q = (m1 - offset) / scale
                v = series[g, XV] / rate_of(q, scale, esin, ecos, round_)
                if i == warm:
                    q += inits[h, 0]
                    v += inits[h, 1]
                if not two:
                    qm = q
                    vm = v
            if i == 0 and two:
                qm = q
                vm = v

            # target in force at the end of this step, averaged over it
            end = t + dt - delay
            while k + 1 < c_end and acts_at(cmd_t[k + 1], k + 1, late, late_at, late_group) <= end - dt:
                k += 1
            target = cmd[k]
            kk = int(k)
            while kk + 1 < c_end and acts_at(cmd_t[kk + 1], kk + 1, late, late_at, late_group) < end:
                part = wp.clamp((end - acts_at(cmd_t[kk + 1], kk + 1, late, late_at, late_group)) / dt, zero, one)
                target += part * (cmd[kk + 1] - cmd[kk])
                kk += 1
            feed = zero
            if feed_v != zero or feed_a != zero:
                wish = target_rates(cmd_t, cmd, window[w, 5], k, kk, end - dt, dt, late, late_at, late_group)
                feed = feed_v * wish[0] + feed_a * wish[1]
            dragger = int(params[h, P_FROM])
            target += params[h, P_COUPLING] * series[g, XDRAG + dragger]
            carried = params[h, P_LINKAGE] * series[g, XDV + dragger]  # speed at which a linkage turns the motor, the joint at rest
            if consts[C_LOOP_MOTOR] > zero:
                target += params[h, P_LINKAGE] * series[g, XDRAG + dragger]
            elsewhere = params[h, P_REACTION] * series[g, XPULL + dragger]
            elsewhere -= params[h, P_LINKAGE] * series[g, XDA + dragger] * (params[h, P_ROTOR] + params[h, P_ARM])

            warmth = series[g, XWARM]
            torque_factor = one + params[h, P_TTORQUE] * warmth
            friction_factor = wp.max(one + params[h, P_TFRICTION] * warmth, zero)
            resistance = wp.max(one + params[h, P_TRES] * warmth, f64(0.1))
            tau0 = params[h, P_LIMIT] * torque_factor
            nls = params[h, P_NLS]
            if voltage > zero:
                tau0 = tau0 / resistance
                nls = nls / torque_factor
            supply = params[h, P_SUPPLY] * series[g, XSUP] * wp.max(one - params[h, P_SAG] * series[g, XOTH], f64(0.05))
            eff = params[h, P_EFF]
            if voltage <= zero:
                eff = eff * torque_factor

            inertia = params[h, P_ISCALE] * series[g, XI] + params[h, P_ARM] + load_mass * series[g, XLI]
            gc = params[h, P_GSCALE] * series[g, XGC] + load_mass * series[g, XLC]
            gs = params[h, P_GSCALE] * series[g, XGS] + load_mass * series[g, XLS]
            own = params[h, P_OWN]
            if own != zero:
                inertia += own * series[g, XOWI]
                gc += own * series[g, XOWC]
                gs += own * series[g, XOWS]
            if off_centre:
                inertia += load_mass * (out * series[g, XOI] + across * series[g, XAI] + out * out + across * across)
                gc += load_mass * (out * series[g, XOC] + across * series[g, XAC])
                gs += load_mass * (out * series[g, XOS] + across * series[g, XAS])
            if tilted:
                gc += params[h, P_TX] * series[g, XTXC] + params[h, P_TY] * series[g, XTYC] + params[h, P_TZ] * series[g, XTZC]
                gs += params[h, P_TX] * series[g, XTXS] + params[h, P_TY] * series[g, XTYS] + params[h, P_TZ] * series[g, XTZS]
            inertia = wp.max(inertia, f64(1.0e-9))

            reported = measured(q, scale, offset, esin, ecos, round_)
            shown = reported
            if consts[C_POS_MOTOR] > zero:
                shown = measured(qm, scale, offset, esin, ecos, round_)

            visc = base_damping + params[h, P_VISC] * friction_factor
            n_sub = int(ONE_BODY_STEPS)
            if two:
                n_sub = TWO_BODY_STEPS
            dts = dt / f64(n_sub)
            for sub in range(n_sub):
                q_l = reported
                v_l = v
                if not two and consts[C_LOOP_MOTOR] > zero:
                    v_l = v - carried
                if two and consts[C_LOOP_MOTOR] > zero:
                    q_l = measured(qm, scale, offset, esin, ecos, round_)
                    v_l = vm
                elif sub > 0:
                    q_l = measured(q, scale, offset, esin, ecos, round_)
                q_e = q
                if two and consts[C_LOOP_MOTOR] > zero:
                    q_e = qm
                shows = rate_of(q_e, scale, esin, ecos, round_)
                if fresh == 1 or speed_lag <= zero:
                    v_f = v_l
                else:
                    v_f += dts / (speed_lag + dts) * (v_l - v_f)
                e = target - q_l + age * shows * v_l  # a sampled loop acts on where the joint was
                v_drive = vm
                if not two:
                    v_drive = v - carried
                # the lag acts on the velocity that kd sees; without it v_f is v_l
                load = gc
                if consts[C_SLIDE] < half:
                    dq = q - series[g, XQ]  # the model was evaluated at the measured pose
                    load = gc * wp.cos(dq) + gs * wp.sin(dq)
                load += series[g, XR] + elsewhere
                # theta-method: the middle of the step where it is smooth, its end where it is stiff
                theta = one
                if not two:
                    stiffness = eff * (kd + kp * dts)
                    if voltage > zero:
                        stiffness = eff * tau0 * (supply * (kd + kp * dts) + one / nls)
                    theta = wp.clamp(half + half * ((stiffness + visc) * dts / inertia - f64(0.6)), half, one)
                body = inertia
                if two and wp.abs(qm - q) < gap2:
                    body = wp.clamp(params[h, P_ROTOR] + params[h, P_ARM], f64(0.03) * inertia, f64(0.97) * inertia)
                step = theta * dts
                if fresh == 1 and ki != zero:  # a drive that has been on before: its integral holds the load
                    wound = load / wp.max(eff, f64(0.01))
                    if voltage > zero:
                        wound = wound / (tau0 * supply)
                torque = law(
                    e, shows * v_f, v_drive, kp, kd, shows, params[h, P_DEADBAND], tau0, nls, supply, step, voltage,
                    eff * step / body, -load * step / body, params[h, P_BRAKING], params[h, P_DEADKIND], age,
                    v_drive + params[h, P_LIMITSPEED] * (shows * v_f - v_drive), feed, ki, since, wound,
                )
                now = torque[0]
                motor = torque[1]
                damping = torque[2]
                wound = torque[4]
                since = dts
                older = zero  # what the age of its position makes of the torque that the loop asks for
                if damping != zero:
                    older = kp * age * shows * v_l
                    if voltage > zero:
                        older = tau0 * supply * older
                slope_m = torque[3]
                if two:  # its steps are short, and a light rotor's would not stand it
                    slope_m = wp.max(slope_m, zero)
                if consts[C_OPEN] > zero:  # the stage after the drive, with its recorded input
                    now = series[g, XDRIVE]
                    motor = now
                    damping = zero
                    slope_m = zero
                    if consts[C_OPEN] > f64(1.5):  # that input is the duty
                        line = tau0 / nls
                        now = tau0 * supply * series[g, XDRIVE] - line * v_drive
                        motor = now
                        slope_m = line
                if series[g, XON] < half:
                    wound = zero
                    now = zero
                    motor = zero
                    damping = zero
                    slope_m = zero
                blend = dts / (params[h, P_LAG] + dts)
                if fresh == 1:
                    last = now
                    fresh = 0
                now = last + blend * (now - last)
                motor = last + blend * (motor - last)
                line_l = blend * damping
                line_m = blend * slope_m
                damping = eff * line_l
                slope_m = eff * line_m
                before = last
                last = now
                begun = v
                begun_m = vm
                applied = eff * motor
                if ripple != zero:
                    wave = ripple_wave(turn * q + params[h, P_PHASE], params[h, P_SHAPE])
                    applied += ripple * wave[0]
                applied += params[h, P_BIAS]

                v_fric = v - carried
                if two:
                    v_fric = vm
                fraction = params[h, P_LOAD]
                if before * v_fric < zero:
                    fraction = params[h, P_BACK]
                level = params[h, P_COULOMB]
                if peak > zero:
                    ratio_v = v_fric / params[h, P_VS]
                    power = stribeck_power(ratio_v, params[h, P_EXPONENT])
                    if power < f64(25.0):
                        level += peak * wp.exp(-power)
                level = (level + fraction * wp.abs(before)) * friction_factor
                applied -= half * params[h, P_ASYM] * level

                stop_d = zero
                if q < low:
                    load -= consts[C_STIFF] * (low - q - dts * v)
                    stop_d = consts[C_STIFF] * f64(0.02)
                if q > high:
                    load += consts[C_STIFF] * (q + dts * v - high)
                    stop_d = consts[C_STIFF] * f64(0.02)

                if not two:
                    level += base_friction
                    damping += slope_m
                    a = inertia / (theta * dts) + damping + visc + stop_d
                    free = (inertia / (theta * dts) * v + applied + damping * v - load + params[h, P_VISC] * friction_factor * carried) / a
                    free -= carried  # dry friction acts where the motor turns
                    if i < warm:
                        if give > zero:
                            z = preslide(z, v_fric * dts / give)
                    else:
                        went = carried  # speed in the middle of the step, or at its end
                        if give > zero:
                            free = preslide_speed(free, a, level, z, give / dts)
                            went = free + carried
                            z = preslide(z, free * dts / give)
                            q += dts * (free + carried)
                            v = v + (free + carried - v) / theta
                            if (v - carried) * free < zero:
                                v = carried
                        elif wp.abs(free) * a <= level:
                            q += dts * carried
                            v = carried
                        else:
                            free -= wp.sign(free) * level / a
                            went = free + carried
                            q += dts * went
                            ahead = v + (free + carried - v) / theta
                            if (ahead - carried) * free < zero:  # friction stops the joint within the step
                                ahead = carried
                            v = ahead
                        last = motor - (line_l + line_m) * (went - begun)  # what it gave: the lag goes on from there
                    qm = q
                    vm = v
                else:
                    rotor = wp.clamp(params[h, P_ROTOR] + params[h, P_ARM], f64(0.03) * inertia, f64(0.97) * inertia)
                    link = inertia - rotor
                    stiff = one / wp.max(soft, f64(1.0e-9))
                    if soft <= zero:
                        stiff = consts[C_STIFF]
                    damp = f64(2.0) * params[h, P_REBOUND] * wp.sqrt(stiff * rotor * link / inertia)  # how gear teeth rebound, an elasticity rings
                    twist = qm + dts * vm - q - dts * v
                    engaged = zero
                    side = zero
                    if wp.abs(twist) >= gap2:
                        engaged = one
                        side = wp.sign(twist) * gap2
                    stretch = stiff * (qm - q - side)
                    harder = one
                    if soft > zero:
                        harder = one + hard * stretch * stretch
                    kh = engaged * ((f64(3.0) * harder - f64(2.0)) * stiff * dts + damp)  # its slope at this stretch
                    pull = engaged * stretch * harder
                    d_m = damping + slope_m
                    d_l = zero
                    if consts[C_LOOP_MOTOR] < half:
                        d_m = slope_m
                        d_l = damping
                    # rotor:  a11 vm' + a12 v' = b1      link:  a21 vm' + a22 v' = b2
                    a11 = rotor / dts + params[h, P_VISC] * friction_factor + kh + d_m
                    a12 = -kh + d_l
                    a21 = -kh
                    a22 = link / dts + base_damping + kh + stop_d
                    b1 = rotor / dts * vm + applied + d_m * vm + d_l * v - pull
                    b2 = link / dts * v - load + pull
                    if i < warm:  # link held
                        a21 = zero
                        a22 = one
                        b2 = v
                    det = a11 * a22 - a12 * a21
                    x1 = (b1 * a22 - a12 * b2) / det
                    gain = a22 / det
                    if give > zero:
                        x1 = preslide_speed(x1, one / gain, level, z, give / dts)
                        z = preslide(z, x1 * dts / give)
                        x2 = (b2 - a21 * x1) / a22
                    elif wp.abs(x1) <= gain * level:
                        x1 = zero
                        x2 = b2 / a22
                    else:
                        x1 -= wp.sign(x1) * gain * level
                        x2 = (b2 - a21 * x1) / a22
                    if base_friction > zero and i >= warm:
                        still = base_friction / a22
                        if wp.abs(x2) <= still:
                            x2 = zero
                        else:
                            x2 -= wp.sign(x2) * still
                    vm = x1
                    qm += dts * vm
                    if i >= warm:
                        v = x2
                        q += dts * v
                        turned = v - begun
                        if consts[C_LOOP_MOTOR] > half:
                            turned = vm - begun_m
                        last = motor - line_l * turned - line_m * (vm - begun_m)
                    if i < warm:  # a held link must not let the rotor run past the play
                        qm = wp.clamp(qm, q - gap2 - wp.abs(last) / stiff * f64(2.0), q + gap2 + wp.abs(last) / stiff * f64(2.0))

            if not (wp.abs(q) < f64(1.0e4)):  # diverged: keep it finite, far off
                q = f64(1.0e4)
                v = zero
                qm = q
                vm = zero
            nxt = measured(q, scale, offset, esin, ecos, round_)
            if consts[C_POS_MOTOR] > zero:
                nxt = measured(qm, scale, offset, esin, ecos, round_)
            if i < warm and consts[C_POS_MOTOR] <= zero:
                nxt = shown
            if i == 0:
                prev_tau = last
            while s < s_end and sample_step[s] == i:
                p = sample_part[s]
                out_q[h, s] = shown + p * (nxt - shown)
                out_torque[h, s] = last - params[h, P_FRESH] * older
                s += 1
            prev_tau = last
            t += dt

    return plant
