"""The servo as Warp kernels: one thread per world and joint. Each law stands in `laws.py`; what
is here takes them to the end of a step. `reference.py` has both in NumPy.

The law (paper, "Actuator Model Randomization"; its reference velocity qd_ref is taken as zero: targets are held):

    e      = target - q_m,    q_m = scale * q + offset              measured position of the loop's encoder
    tau_c  = kp * e - kd * qd_m                                     (+ `laws.other_terms`: feed-forward, integral)
    tau_b  = 0 if |e| < deadband else tau_c
    limit  = torque_limit * max(0, 1 - b |qd| / no_load_speed)      b: 1 driving, braking_slope while it brakes
    motor  = clip(tau_b, -limit, +limit)                            what the motor's current shows
    joint  = efficiency * lag(motor) + parasitic(q, qd) - friction

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
    the speed falls, exponentially with rate r = braking_slope * efficiency * tau0 / no_load_speed / inertia; a tiny
    link does so within one step, so T takes the mean over the step, limit * (exp(r dt) - 1) / (r dt), `inertia` being
    1 / dof_invweight0.
  All differences from the law are O(dt).

Play and elasticity. The motor turns a rotor of inertia J_r, which leaves the joint's armature; a spring K with a gap
joins rotor and link. Backward Euler over the step, with the link's velocity v' at its end still open:
    J_r (w' - w) / dt = motor(w', v') - viscous w' - level sign(w') - tau',
    tau' = K (stretch + dt (w' - v')) + C (w' - v').
Friction and the side of the gap are taken from the step's start with v' = v; what remains is a line w' = A + B v', so
that the link feels tau' = T - D v'. D dt goes to dof_armature and T - D v to qfrc_applied, so that MuJoCo solves link,
contact and spring together (its contacts know the inertia, not the damping). The rotor's step is completed with the v'
it found when the next begins: what the rotor loses the link receives. With K -> inf, D dt -> J_r: the armature again.
Rotors carry the motor's friction and turn the torque-speed line; the model's own friction stays on the link.

Dry friction goes to dof_frictionloss (as a torque it would chatter), so MuJoCo resolves sticking. How hard it sticks is
the joint's solimpfriction: the default (0.9) lets a stuck joint creep, 0.999 does not. Friction that is elastic before
it slides (`presliding`) is a spring there: level * z goes to qfrc_applied, its line in v' to dof_damping.
"""

# No `from __future__ import annotations`: Warp resolves these annotations from the closure.

from functools import cache
from typing import Any

import warp as wp

from dexsim.actuator.columns import COLUMNS, INDEX, MEMORY
from dexsim.actuator.laws import (
    LEAST_ROTOR,
    arrived,
    command_delay,
    difference,
    dragged_target,
    dry_friction,
    encoder_error,
    encoder_line,
    feed_forward,
    friction_acts,
    heard_speed,
    hold,
    lag_share,
    lost_error,
    other_terms,
    parasitic_torque,
    pd,
    preslide,
    preslide_slope,
    stand_in,
    supply_left,
    torque_limits,
    transmission,
    transmission_damping,
    viscous,
    voltage_torque,
    warm_motor,
    wind,
)

# Slots of state[world, joint, slot] before the queue: `queue` stamps [s], then `queue` targets [rad], oldest first.
MOTOR, ENABLED, QUEUE = 0, 1, 2
SLOTS = ("motor", "enabled")
# After the queue, where a feature of `columns.FEATURES` needs it: what laws remember, in the order of its places, then
# what a step itself does. line_a, line_b: see "Play and elasticity".
EXTRA_SLOTS = (*MEMORY, "rotor", "line_a", "line_b", "fresh", "integral", "taken")
ROTOR, LINE_A, LINE_B, FRESH, INTEGRAL, TAKEN = range(len(MEMORY), len(EXTRA_SLOTS))
EXTENDED = frozenset({"play", "controller", "presliding"}) | {c.feature for c in COLUMNS if c.remembers}

NEVER = -1.0e9  # the stamp of a target that has always been there
SEED = 1.0e-6  # of the stall torque: braking from the no-load speed starts from no less
EDGE = 1.0 + SEED
STOP_RATE = 2.0 * 3.141592653589793 * 40.0  # rad/s: how stiff the ends of a play are, over the inertia, and
STOP_GAIN = 30.0  # over the loop's own stiffness
BORROWED = 0.5  # of the joint's inertia: what a rotor beyond the model's armature may take from the link
SNAP = 1.0e-3  # parts of a step shorter than this are rounding of the clock
WHOLE = 1.0 - SNAP

KP, KD = INDEX["kp"], INDEX["kd"]
LAG_TIME, SUPPLY, VISCOUS = INDEX["lag"], INDEX["supply"], INDEX["viscous_friction"]
THINNING, THINNING_SPEED = INDEX["thinning_friction"], INDEX["thinning_speed"]
OFFSET, SCALE = INDEX["position_offset"], INDEX["position_scale"]
BACKLASH, REBOUND, SOFTNESS, HARDENING, ROTOR_INERTIA = (
    INDEX[n] for n in ("backlash", "rebound", "softness", "hardening", "rotor")
)
WARMTH, BRAKING = INDEX["warmth"], INDEX["braking_slope"]
FEED_SPEED, FEED_ACCELERATION, INTEGRAL_GAIN = (
    INDEX[n] for n in ("speed_feedforward", "acceleration_feedforward", "integral_gain")
)
COUPLING_FROM = INDEX["coupling_from"]
REST, REST_POSITION = INDEX["standin_constant"], INDEX["standin_position"]
REST_SPEED, REST_DRAG = INDEX["standin_speed"], INDEX["standin_drag"]


@cache
def drives(real: type) -> Any:
    """Return the struct that the servo's kernel takes, in float32 or float64: N worlds, J joints; shapes and units
    as in `servo.Servo`."""

    @wp.struct
    class Drives:
        # addresses, [J]
        dof: wp.array(dtype=int)
        dof_q: wp.array(dtype=int)
        loop_motor: wp.array(dtype=int)  # the loop's encoder is on the rotor
        # what is believed, [N, J, C] and [N, J]
        params: wp.array3d(dtype=real)
        inertia: wp.array2d(dtype=real)
        base_damping: wp.array2d(dtype=real)
        base_frictionloss: wp.array2d(dtype=real)
        base_armature: wp.array2d(dtype=real)
        home: wp.array2d(dtype=real)
        # what the engine says, [N], [N, nq], [N, nv]
        time: wp.array(dtype=real)
        qpos: wp.array2d(dtype=real)
        qvel: wp.array2d(dtype=real)
        given: wp.array(dtype=real)  # sum of the motors' |torque| in the last step, [N]
        outside: wp.array2d(dtype=real)  # what the dofs felt from outside in it, [N, nv], where friction grows with it
        # in and out
        state: wp.array3d(dtype=real)
        torque: wp.array2d(dtype=real)
        # out, [N, nv]
        qfrc_applied: wp.array2d(dtype=real)
        dof_damping: wp.array2d(dtype=real)
        dof_frictionloss: wp.array2d(dtype=real)
        dof_armature: wp.array2d(dtype=real)

    return Drives


@wp.func
def target_in_force(state: wp.array3d(dtype=Any), w: int, j: int, queue: int, end: Any, dt: Any):
    """Return the target [rad], mean over the step of dt [s] that ends at `end`, less the delay (`laws.arrived`)."""
    target = state[w, j, QUEUE + queue]
    for k in range(1, queue):
        part = arrived(end, state[w, j, QUEUE + k], dt)
        new = state[w, j, QUEUE + queue + k]
        if part > type(dt)(WHOLE):
            target = new
        elif part > type(dt)(SNAP):
            target += part * (new - state[w, j, QUEUE + queue + k - 1])
    return target


@wp.func
def target_rates(state: wp.array3d(dtype=Any), w: int, j: int, queue: int, begin: Any, dt: Any):
    """Return (speed [rad/s], acceleration [rad/s2]) of the target, each the mean over the step [begin, begin + dt]
    of what is in force (`laws.difference`, `laws.hold`): begin is the step's, less the delay."""
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


@cache
def servo_kernel(real: type, voltage: bool, features: frozenset[str] = frozenset()) -> wp.Kernel:
    """Return the kernel that runs before each physics step, for real in {wp.float32, wp.float64}, the kind of drive and
    `FEATURES`.

    Its steps, in the order of the signal: `locate` the rotor; `sense` what the encoder shows; `control` what the loop
    asks for; `limit` what the motor gives of it; `resist` the friction; `couple` rotor and link where they are two.
    Each has the law as `laws.py` states it and takes it to the end of the step ("Integration"); what laws remember goes
    from one to the next and is written when all have had it."""
    play, sag, rare, braking, controller, presliding, load, shape = (
        name in features for name in ("play", "sag", "rare", "braking", "controller", "presliding", "load", "shape")
    )
    extended = bool(features & EXTENDED)
    # of the state, those that some law of this kernel keeps; a `wp.static` of a loop's variable would have each process
    # write the kernel out anew, cached or not
    remembered = [MEMORY[name] for c in COLUMNS if c.feature in features for name in c.remembers]
    places = wp.constant(wp.types.vector(length=len(remembered) + 1, dtype=int)(*remembered, 0))
    Drives, vec3, Memory = drives(real), wp.types.vector(length=3, dtype=real), wp.types.vector(len(MEMORY), real)
    encoder, late = encoder_error(features), command_delay(features)
    hears, lost, motor = heard_speed(features), lost_error(features), warm_motor(features)
    drags, leaves = dragged_target(features), supply_left(features)
    parasitic, dry, acts = parasitic_torque(features), dry_friction(features), friction_acts(features)

    @wp.struct
    # the motor's side, where the last step has left it: the joint itself where there is no play or elasticity
    class Rotor:
        q: real
        v: real
        inertia: real  # its own; 0 where the joint's armature stands for it
        two: bool  # it is a body of its own
        on_loop: bool  # the loop's encoder is on it

    @wp.struct
    class Sensed:  # what the loop's encoder shows
        q: real
        rate: real  # of it, now
        v: real  # the speed that kd acts on: now, and
        v_end: real  # at the end of the step at unchanged speed
        scale: real  # shown over true speed
        share: real  # of a change of speed, what the filter passes in a step

    @wp.struct
    class Motor:  # what the supply and the temperature leave of it
        tau0: real
        no_load: real
        supply: real
        efficiency: real
        friction: real  # factor

    @wp.struct
    class Torque:  # as a line in the velocity at the end of the step
        now: real  # what the current shows
        end: real  # at the end of the step at unchanged speed
        slope: real  # less per speed gained
        on_drive: real  # of it, in the motor's own speed, not in that of the loop's encoder

    @wp.struct
    class Friction:
        level: real  # dry
        own: real  # the drive's part of it
        uneven: real  # share of it that differs by direction, half
        give: real  # how far the joint gives way before it slides
        viscous: real
        taken: real  # torque of what gives way elastically; the level is 0 then

    @wp.func
    def locate(dt: real, x0: int, fresh: bool, d: Drives, w: int, j: int):
        """Return the rotor where the last step's v' has left it; writes its slot and the armature of what stays with
        the joint."""
        r = Rotor()
        r.v = d.qvel[w, d.dof[j]]
        if wp.static(play):
            r.q = d.qpos[w, d.dof_q[j]]
            r.two = d.params[w, j, BACKLASH] > real(0.0) or d.params[w, j, SOFTNESS] > real(0.0)
            if r.two and not fresh:
                r.v = d.state[w, j, x0 + LINE_A] + d.state[w, j, x0 + LINE_B] * r.v
                r.q = d.state[w, j, x0 + ROTOR] + dt * r.v
            if r.two:
                r.inertia = d.params[w, j, ROTOR_INERTIA]
                if r.inertia == real(0.0):
                    r.inertia = d.base_armature[w, j]
                r.inertia = wp.max(r.inertia, wp.static(real(LEAST_ROTOR)) * d.inertia[w, j])
                r.on_loop = d.loop_motor[j] != 0
            d.state[w, j, x0 + ROTOR] = r.q
            armature = wp.max(d.base_armature[w, j] - r.inertia, -real(BORROWED) * d.inertia[w, j])
            d.dof_armature[w, d.dof[j]] = armature
        return r

    @wp.func
    def sense(dt: real, fresh: bool, r: Rotor, memory: Memory, d: Drives, w: int, j: int):
        """Return (what the loop's encoder shows, memory)."""
        turned = d.qpos[w, d.dof_q[j]]
        turning = d.qvel[w, d.dof[j]]
        if wp.static(play):
            if r.on_loop:
                turned = r.q
                turning = r.v
        s = Sensed()
        s.scale = d.params[w, j, SCALE]
        error = encoder(d.params[w, j], turned, memory, False)
        s.q = encoder_line(turned, s.scale, d.params[w, j, OFFSET])
        s.q += error[0] + error[1]
        s.scale += error[2]
        s.rate = s.scale * turning
        heard, carry = hears(d.params[w, j], turning, memory, fresh, dt)
        s.v = s.scale * heard[0]
        s.v_end = s.scale * heard[1]
        s.share = heard[2]
        return s, carry

    @wp.func
    def remaining(dt: real, fresh: bool, last: real, memory: Memory, d: Drives, w: int, j: int):
        """Return (what the supply and the temperature leave of the motor, memory); last: its torque of the step
        before."""
        m = Motor()
        limits, carry = motor(d.params[w, j], d.params[w, j, WARMTH], last, wp.static(voltage), memory, fresh, dt)
        m.tau0 = limits[0]
        m.no_load = limits[1]
        m.efficiency = limits[2]
        m.friction = limits[3]
        others = real(0.0)
        if wp.static(sag):
            others = d.given[w] - wp.abs(d.torque[w, j])
        supply, carry = leaves(d.params[w, j], d.params[w, j, SUPPLY], others, carry, fresh, dt)
        m.supply = supply
        return m, carry

    @wp.func
    def control(
        dt: real, queue: int, x0: int, fresh: bool, s: Sensed, memory: Memory, lower: real, upper: real, d: Drives,
        w: int, j: int,
    ):  # fmt: skip
        """Return ((now, end, slope), memory), what the loop asks for, torque [N.m] or duty; -lower .. upper: the
        limits, at which its integral waits."""
        waits, carry = late(d.params[w, j], d.time[w], memory, fresh, dt)
        end = d.time[w] - waits + dt
        target = target_in_force(d.state, w, j, queue, end, dt)
        if wp.static(rare):
            other = wp.clamp(int(d.params[w, j, COUPLING_FROM]), 0, d.dof_q.shape[0] - 1)
            away = d.qpos[w, d.dof_q[other]] - d.home[w, other]
            shift, carry = drags(d.params[w, j], away, carry, fresh, dt)
            target += shift
        off, carry = lost(d.params[w, j], target, target - s.q, carry, fresh, dt)
        u = pd(
            target - s.q,
            off,
            s.v,
            s.v_end,
            s.rate,
            s.scale,
            d.params[w, j, KP],
            d.params[w, j, KD],
            dt,
            real(0.0),
            s.share,
        )
        if wp.static(not controller):
            return wp.vector(u[0], u[1], u[2]), carry
        wish = target_rates(d.state, w, j, queue, end - dt, dt)
        feed = feed_forward(d.params[w, j, FEED_SPEED], d.params[w, j, FEED_ACCELERATION], wish[0], wish[1])
        gain = d.params[w, j, INTEGRAL_GAIN]
        integral = real(0.0)
        if d.state[w, j, ENABLED] != real(0.0):
            integral = d.state[w, j, x0 + INTEGRAL]
            integral = wind(integral, dt * gain * u[3], u[0] + feed + integral, lower, upper)
        d.state[w, j, x0 + INTEGRAL] = integral
        return other_terms(u, feed, integral, gain, s.rate, s.scale, dt), carry

    @wp.func
    def drive_voltage(u: vec3, v: real, m: Motor):
        """Return what a voltage drive gives of a duty."""
        line = m.tau0 / m.no_load
        t = Torque()
        t.now = voltage_torque(u[0], m.tau0, m.supply, line, v)
        t.end = voltage_torque(u[1], m.tau0, m.supply, line, v)
        t.slope = m.tau0 * m.supply * u[2] + line
        t.on_drive = line
        if wp.abs(u[1]) > real(1.0):
            unlimited = m.tau0 * m.supply * u[1] - line * v
            ratio = real(0.0)
            if unlimited != real(0.0):
                ratio = wp.clamp(t.end / unlimited, real(0.0), real(1.0))
            t.slope = wp.max(ratio * t.slope, line)
            t.on_drive = t.slope
        return t

    @wp.func
    def drive_torque(
        dt: real, u: vec3, v: real, x: real, lower: real, upper: real, steep: real, inertia: real, m: Motor
    ):
        """Return what a torque drive gives of a torque; x: |v| over the no-load speed; steep: `braking_slope`."""
        t = Torque()
        t.now = wp.clamp(u[0], -lower, upper)
        t.end = wp.clamp(u[1], -lower, upper)
        t.slope = u[2]
        limit = upper
        if u[1] < real(0.0):
            limit = lower
        if wp.abs(u[1]) > limit:
            line = m.tau0 / (m.no_load * m.supply)
            size = limit
            if u[1] * v < real(0.0):  # braking: the limit grows as the speed falls, by this factor within the step
                growth = wp.min(steep * m.efficiency * line * dt / inertia, real(60.0))
                if growth > real(SNAP) and steep * x < real(EDGE):
                    size = wp.max(limit, real(SEED) * m.tau0) * (wp.exp(growth) - real(1.0)) / growth
                    size = wp.min(size, wp.min(m.tau0, wp.abs(u[1])))
                    t.end = wp.sign(u[1]) * size
                line = size / (m.no_load * m.supply * (real(1.0) + x))
            elif limit == real(0.0):
                line = real(0.0)
            # to the PD's zero, or to the no-load speed in the direction of the torque
            t.slope = wp.max(u[2] * size / wp.abs(u[1]), line)
            t.on_drive = t.slope
        return t

    @wp.func
    def ask(
        dt: real, queue: int, x0: int, fresh: bool, s: Sensed, memory: Memory, r: Rotor, m: Motor, d: Drives, w: int,
        j: int,
    ):  # fmt: skip
        """Return (the motor's torque after its lag, memory); writes what the current shows."""
        t = Torque()
        carry = memory
        if wp.static(voltage):
            duty, then = control(dt, queue, x0, fresh, s, memory, real(1.0), real(1.0), d, w, j)
            t = drive_voltage(duty, r.v, m)
            carry = then
        else:
            x = wp.abs(r.v) / (m.no_load * m.supply)
            steep = real(1.0)
            if wp.static(braking):
                steep = d.params[w, j, BRAKING]
            limits = torque_limits(m.tau0, x, r.v, steep)
            inertia = d.inertia[w, j]
            if r.two:
                inertia = r.inertia
            u, then = control(dt, queue, x0, fresh, s, memory, limits[0], limits[1], d, w, j)
            carry = then
            t = drive_torque(dt, u, r.v, x, limits[0], limits[1], steep, inertia, m)
        if d.state[w, j, ENABLED] == real(0.0):
            t.now = real(0.0)
            t.end = real(0.0)
            t.slope = real(0.0)
            t.on_drive = real(0.0)
        share = lag_share(d.params[w, j, LAG_TIME], dt)
        last = d.state[w, j, MOTOR]
        t.now = last + share * (t.now - last)
        t.end = last + share * (t.end - last)
        d.state[w, j, MOTOR] = t.now
        d.torque[w, j] = t.now
        t.end = m.efficiency * t.end
        t.slope = m.efficiency * (share * t.slope)
        t.on_drive = m.efficiency * share * t.on_drive
        return t, carry

    @wp.func
    def resist(
        dt: real, x0: int, fresh: bool, last: real, r: Rotor, factor: real, memory: Memory, d: Drives, w: int, j: int
    ):
        """Return (friction at the motor's speed, memory); last: its torque of the step before."""
        f = Friction()
        f.viscous = d.params[w, j, VISCOUS] * factor
        if wp.static(shape):
            more = d.params[w, j, THINNING]
            f.viscous = viscous(d.params[w, j, VISCOUS], more, d.params[w, j, THINNING_SPEED], r.v) * factor
        outside = real(0.0)
        if wp.static(load):
            outside = d.outside[w, d.dof[j]]
        level, carry = dry(
            d.params[w, j], d.qpos[w, d.dof_q[j]], r.v, last, outside, wp.static(load), factor, memory, fresh, dt
        )
        f.level = d.base_frictionloss[w, j] + level[0]
        f.level += level[1] + level[2] + level[3]
        f.own = f.level - d.base_frictionloss[w, j]
        how, carry = acts(d.params[w, j], d.qpos[w, d.dof_q[j]], r.v, carry, fresh, dt)
        f.uneven = how[0]
        if wp.static(presliding):  # a torque, taken up at the step's begin, and its line in the speed at the step's end
            f.give = how[1]
            if f.give > real(0.0):
                turned = r.v * dt / f.give
                taken = real(0.0)
                if not fresh:
                    taken = preslide(d.state[w, j, x0 + TAKEN], turned)
                d.state[w, j, x0 + TAKEN] = taken
                sliding = f.level
                if r.two:
                    sliding = f.own
                f.taken = sliding * taken
                f.viscous += sliding * dt / f.give * preslide_slope(taken, turned)
        return f, carry

    @wp.func
    def couple(dt: real, t: Torque, f: Friction, r: Rotor, stiffness: real, d: Drives, w: int, j: int):
        """Return (torque on the link T, its slope D in the link's speed, A, B): the rotor's step as a line w' = A +
        B v', "Play and elasticity". stiffness: of the loop [N.m/rad]."""
        q = d.qpos[w, d.dof_q[j]]
        v = d.qvel[w, d.dof[j]]
        gap2 = real(0.5) * d.params[w, j, BACKLASH]
        on_drive = t.on_drive
        on_loop = real(0.0)  # the slope in the link's speed
        if r.on_loop:
            on_drive = t.slope
        else:
            on_loop = t.slope - on_drive
        own = f.own
        if wp.static(presliding):
            if f.give > real(0.0):
                own = real(0.0)
        soft = d.params[w, j, SOFTNESS]
        link = wp.max(d.inertia[w, j] - r.inertia, wp.static(real(LEAST_ROTOR)) * d.inertia[w, j])
        stiff = real(STOP_GAIN) * stiffness + wp.static(real(STOP_RATE * STOP_RATE)) * d.inertia[w, j]
        hardening = real(0.0)
        if soft > real(0.0):
            stiff = real(1.0) / soft
            hardening = d.params[w, j, HARDENING]
        damp = transmission_damping(d.params[w, j, REBOUND], stiff, r.inertia, link, r.inertia + link)
        # without the spring: inertia (w' - w) / dt = t.end - on_drive (w' - w) - on_loop (v' - v) - viscous w' -+ own
        free_a = r.inertia / dt + f.viscous + on_drive
        push = r.inertia / dt * r.v + t.end + on_drive * r.v
        line_a = real(0.0)
        line_b = real(0.0)
        if wp.abs(push) > own:
            line_a = (push - wp.sign(push) * own + on_loop * v) / free_a
            line_b = -on_loop / free_a
        twist = r.q + dt * (line_a + line_b * v) - q - dt * v
        pulls = real(0.0)
        slope = real(0.0)
        if wp.abs(twist) >= gap2:
            side = wp.sign(twist) * gap2
            spring = transmission(r.q - q - side, stiff, hardening)
            grip = spring[1] * dt + damp
            all_a = free_a + grip
            on_a = real(0.0)
            on_b = real(0.0)
            if wp.abs(push - spring[0] + grip * v) > own:
                on_a = (push - spring[0] - wp.sign(push - spring[0] + grip * v) * own + on_loop * v) / all_a
                on_b = (grip - on_loop) / all_a
            pushed = spring[0] + grip * on_a
            slope_pushed = grip * (real(1.0) - on_b)
            # the ends of a play push and do not pull
            if gap2 == real(0.0) or (pushed - slope_pushed * v) * side >= real(0.0):
                line_a = on_a
                line_b = on_b
                pulls = pushed
                slope = slope_pushed
        return wp.vector(pulls, slope, line_a, line_b)

    @wp.kernel(module="unique", enable_backward=False)
    def servo(dt: real, queue: int, d: Drives):
        w, j = wp.tid()
        i = d.dof[j]
        q = d.qpos[w, d.dof_q[j]]
        v = d.qvel[w, i]
        x0 = int(0)
        fresh = bool(False)
        if wp.static(extended):
            x0 = QUEUE + 2 * queue
            fresh = d.state[w, j, x0 + FRESH] != real(0.0)
            d.state[w, j, x0 + FRESH] = real(0.0)
        last = d.state[w, j, MOTOR]
        memory = Memory()
        for k in range(wp.static(len(remembered))):
            memory[places[k]] = d.state[w, j, x0 + places[k]]
        r = locate(dt, x0, fresh, d, w, j)
        m, after_motor = remaining(dt, fresh, last, memory, d, w, j)
        s, heard = sense(dt, fresh, r, after_motor, d, w, j)
        t, after_asking = ask(dt, queue, x0, fresh, s, heard, r, m, d, w, j)

        # Ripple and its like; what of it brakes, or pulls like a spring, is taken at the end of the step.
        beside, added = parasitic(d.params[w, j], q, r.v, after_asking, fresh, dt)
        t.end += beside[0]
        stiffness = wp.max(real(0.0), -beside[1])
        t.end -= stiffness * dt * v
        t.slope += stiffness * dt
        drag = wp.max(real(0.0), -beside[2])
        t.slope += drag
        t.on_drive += drag

        # The stand-in for what is not known; what of it brakes, or pulls like a spring, is taken at the end of the
        # step.
        applied = t.end
        damping = t.slope
        pull = d.params[w, j, REST_POSITION]
        unknown = stand_in(d.params[w, j, REST], pull, d.params[w, j, REST_SPEED], d.params[w, j, REST_DRAG], q, v)
        brake = unknown[1]
        applied += unknown[0]
        spring = wp.max(real(0.0), -pull)
        applied -= spring * dt * v
        damping += spring * dt

        # Dry friction: an interval of torques [-level (1 + a/2), +level (1 - a/2)], as a symmetric one and a constant.
        f, carry = resist(dt, x0, fresh, last, r, m.friction, added, d, w, j)
        for k in range(wp.static(len(remembered))):
            d.state[w, j, x0 + places[k]] = carry[places[k]]
        if wp.static(play):
            d.state[w, j, x0 + LINE_A] = real(0.0)
            d.state[w, j, x0 + LINE_B] = real(1.0)
            if r.two:
                applied = applied - t.end  # what acts on the link itself: the stand-in
                damping = damping - t.slope + wp.max(real(0.0), -brake)
                t.end -= f.uneven * f.own
                if wp.static(presliding):
                    t.end -= f.taken
                loop = d.params[w, j, KP]
                if wp.static(voltage):
                    loop = loop * m.tau0
                c = couple(dt, t, f, r, loop, d, w, j)
                d.state[w, j, x0 + LINE_A] = c[2]
                d.state[w, j, x0 + LINE_B] = c[3]
                # D goes to the armature, D (v' - v) = D dt a: contacts are solved with the inertia, which a damping is
                # no part of
                d.qfrc_applied[w, i] = applied + damping * v + c[0] - c[1] * v
                d.dof_armature[w, i] = d.dof_armature[w, i] + c[1] * dt
                d.dof_damping[w, i] = d.base_damping[w, j] + damping
                d.dof_frictionloss[w, i] = d.base_frictionloss[w, j]
                return
        applied -= f.uneven * f.level
        if wp.static(presliding):
            if f.give > real(0.0):
                applied -= f.taken
                f.level = real(0.0)
        damping += wp.max(real(0.0), -brake)
        d.qfrc_applied[w, i] = applied + damping * v
        d.dof_damping[w, i] = d.base_damping[w, j] + f.viscous + damping
        d.dof_frictionloss[w, i] = f.level

    return servo


@cache
def send_kernel(real: type) -> wp.Kernel:
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


@cache
def reset_kernel(real: type, extended: bool = False) -> wp.Kernel:
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


@cache
def given_kernel(real: type) -> wp.Kernel:
    """Return what all motors of a world give, from the last step: sum of |torque| [N.m], for a supply that sags."""

    @wp.kernel(module="unique", enable_backward=False)
    def given(joints: int, torque: wp.array2d(dtype=real), out: wp.array(dtype=real)):
        w = wp.tid()
        total = real(0.0)
        for j in range(joints):
            total += wp.abs(torque[w, j])
        out[w] = total

    return given
