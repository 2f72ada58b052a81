"""One joint through many windows under many parameter guesses: a Warp kernel, one thread per guess and window.

In free air each joint is its own small system once the other joints' measured motion is prescribed:

    I(t) dv/dt = eta * motor - gravity(q, t) - rest(t) - friction(v) - viscous v
 with I, gravity and rest taken from the MuJoCo model along the measured motion (`mechanics.py`); the drive's laws are
those of `dexsim.actuator.laws`, which the training's kernel calls too, so a fitted column means the same there. With
play or elasticity, rotor and link are two inertias joined by a spring with a gap, integrated implicitly (no stiffness
limit on the step). Dry friction is solved exactly in each step (a joint sticks when the level can hold it), not
approximated by a smooth law.
"""

# No `from __future__ import annotations`: Warp resolves these annotations from the closure.

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from dexsim.actuator.columns import FEATURES as SERVO_FEATURES
from dexsim.actuator.columns import MEMORY
from dexsim.actuator.laws import (
    COULOMB,
    LEAST_ROTOR,
    RIPPLE,
    SETPOINT,
    SETPOINT_NEW,
    SETPOINT_SPEED,
    STRIBECK_PEAK,
    arrived,
    command_delay,
    difference,
    dragged_target,
    dry_friction,
    encoder_error,
    encoder_line,
    feed_forward,
    friction_acts,
    gear_load_friction,
    heard_speed,
    hold,
    lag_share,
    lost_error,
    other_terms,
    parasitic_torque,
    pd,
    preslide,
    preslide_speed,
    sagged_torque,
    stage_before,
    supply_left,
    torque_limits,
    transmission,
    transmission_damping,
    viscous,
    voltage_torque,
    warm_motor,
    wind,
)
from dexsim.gap.plant.columns import INDEX, NEUTRAL, SERIES_INDEX

f64 = wp.float64
parasitic = parasitic_torque(frozenset(SERVO_FEATURES))
encoder = encoder_error(frozenset(SERVO_FEATURES))
late = command_delay(frozenset(SERVO_FEATURES))
hears = heard_speed(frozenset(SERVO_FEATURES), skips=True)
lost = lost_error(frozenset(SERVO_FEATURES))
drags = dragged_target(frozenset(SERVO_FEATURES))
motor = warm_motor(frozenset(SERVO_FEATURES))
leaves = supply_left(frozenset(SERVO_FEATURES))
acts = friction_acts(frozenset(SERVO_FEATURES))
dry = dry_friction(frozenset(SERVO_FEATURES), gone=25.0)  # of exp(-25) a search sees nothing, and exp() is dear
ONE_BODY_STEPS = 1  # sub-steps of the plant without a play or an elasticity in one step of the grid
TWO_BODY_STEPS = 6  # sub-steps of the two-inertia plant in one step of the grid

# constants of a joint: consts[...]
C_VOLTAGE, C_LOOP_MOTOR, C_POS_MOTOR, C_DAMPING, C_FRICTION, C_LOW, C_HIGH, C_STIFF, C_SLIDE = range(9)
P_KP, P_KD, P_LAG, P_SUPPLY, P_VISC = (INDEX[n] for n in ("kp", "kd", "lag", "supply", "viscous_friction"))
P_THINS, P_THINSPEED = INDEX["thinning_friction"], INDEX["thinning_speed"]
P_LOADOUT = INDEX["load_friction_external"]  # the first of `FEATURES["load"]`, which stand in a row
P_OFFSET, P_SCALE = INDEX["position_offset"], INDEX["position_scale"]
P_ISCALE, P_GSCALE, P_ARM, P_PAYLOAD, P_TX, P_TY, P_TZ, P_GAP, P_SOFT, P_ROTOR = (
    INDEX[n]
    for n in (
        "inertia_scale", "gravity_scale", "armature", "payload", "tilt_x", "tilt_y", "tilt_z", "backlash", "softness",
        "rotor",
    )
)  # fmt: skip
P_BIAS, P_AGE, P_LIMITSPEED = (INDEX[n] for n in ("bias", "feedback_delay", "limit_speed"))
X = SERIES_INDEX
XQ, XV, XI, XGC, XGS, XR, XLI, XLC, XLS = (
    X[n] for n in ("q", "v", "inertia", "gravity_cos", "gravity_sin", "rest", "load_inertia", "load_cos", "load_sin")
)
XTXC, XTXS, XTYC, XTYS, XTZC, XTZS = (X[f"tilt_{a}_{b}"] for a in "xyz" for b in ("cos", "sin"))
XSUP, XOTH, XWARM, XDRAG, XON = (X[n] for n in ("supply", "others_torque", "warmth", "drag0", "enabled"))
P_OWN = INDEX["own_payload"]
P_GEARLOAD, P_GEARBACK, P_GEARPOWER, P_GEARUNIT = (
    INDEX[f"gear_load_{n}"] for n in ("friction", "friction_backdriven", "power", "unit")
)
SETTLES = 4.0  # x the lag: what was asked for longer ago is out of the torque but for 2 %
PRESSED = 5e-3  # s in which the load comes to press a gear's flanks; that of the same step would be a loop
XOWI, XOWC, XOWS = (X[n] for n in ("own_inertia", "own_cos", "own_sin"))
XDV, XDA, XPULL = (X[n] for n in ("drag_v0", "drag_a0", "pull0"))
P_LINKAGE, P_REACTION = INDEX["linkage"], INDEX["reaction"]
P_FRESH = INDEX["effort_fresh"]
P_READSCALE, P_READOFFSET = INDEX["readout_scale"], INDEX["readout_offset"]
P_FROM, P_REBOUND = INDEX["coupling_from"], INDEX["rebound"]
P_BRAKING = INDEX["braking_slope"]
P_COUT, P_CACROSS, P_HARD = INDEX["com_out"], INDEX["com_across"], INDEX["hardening"]
P_FEEDV, P_FEEDA, P_KI = INDEX["speed_feedforward"], INDEX["acceleration_feedforward"], INDEX["integral_gain"]
P_SPRING, P_PRELOAD = INDEX["spring"], INDEX["spring_preload"]
P_LATE = INDEX["late_by"]
P_MOTORSHARE = INDEX["motor_share"]
P_STAGES = INDEX["lag_stages"]
P_WEAK, P_WEAKOWN = INDEX["sag_torque"], INDEX["sag_own"]
XOC, XOS, XOI, XAC, XAS, XAI = (X[f"com_{a}_{b}"] for a in ("out", "across") for b in ("cos", "sin", "inertia"))


Memory = wp.types.vector(length=len(MEMORY), dtype=f64)


@wp.struct
class Recorded:
    """What the kernel takes: G grid points, W windows, H guesses, n samples. Units as in `columns.py`."""

    params: wp.array2d(dtype=f64)  # [H, C]
    inits: wp.array3d(dtype=f64)  # [H, 1 or W, 2] added to the initial position and velocity
    setpoints: wp.array3d(dtype=f64)  # [H, 0 or W, 2] setpoint and its speed at the begin, NaN: where the joint is
    consts: wp.array(dtype=f64)
    series: wp.array2d(dtype=f64)  # [G, E]
    cmd_t: wp.array(dtype=f64)
    cmd: wp.array(dtype=f64)
    window: wp.array2d(dtype=int)  # [W, 8] grid start, steps, warm steps, first sample, samples, cmd range, first cmd
    window_t: wp.array(dtype=f64)  # [W] time at the grid start
    sample_step: wp.array(dtype=int)  # [n] step of the window in which the sample falls
    sample_part: wp.array(dtype=f64)  # [n] where in it, 0..1
    out_q: wp.array2d(dtype=f64)  # [H, n]
    out_torque: wp.array2d(dtype=f64)  # [H, n]


FIELDS = tuple(Recorded.vars)


@wp.struct
class Guess:  # the columns of one guess that every step asks for
    kp: f64
    kd: f64
    read_scale: f64  # of what is reported, where that is not the loop's own encoder
    read_offset: f64
    scale: f64
    offset: f64
    dt: f64  # of a sub-step
    rate: f64  # of them [1/s]
    age: f64
    ki: f64
    beyond: bool  # the controller has more terms than the PD
    steep: f64  # braking_slope
    limit_speed: f64
    lag: f64  # share of its way that the torque goes in a sub-step, in each of its stages
    staged: bool  # there are two
    gap2: f64
    soft: f64
    two: bool  # rotor and link are two bodies
    viscous: f64
    thins: f64  # of it, what is less the faster it turns, and
    thin_speed: f64  # the speed at which half of that is left
    carries: bool  # friction is by the load from outside too, or falls with speed, or is by its square
    gear_load: f64  # friction by what the gear hands to the joint, driving it, and
    gear_back: f64  # back-driven
    gear_power: f64
    gear_unit: f64
    bias: f64
    spring: f64
    preload: f64
    weak_own: f64  # of what the drive gives, lost per N.m of its own
    feed_v: f64
    feed_a: f64
    rotor: f64  # kg.m2, before it is kept within the inertia
    mass: f64  # payload
    own_mass: f64
    off_centre: bool
    tilted: bool
    # of the joint's constants
    voltage: bool
    loop_motor: bool
    slide: bool
    base_friction: f64
    base_damping: f64
    motor_share: f64  # of both, where rotor and link are two bodies
    low: f64
    high: f64
    stop: f64


@wp.struct
class State:  # of the joint
    q: f64
    v: f64
    qm: f64  # of the rotor, the joint's where they are one
    vm: f64
    last: f64  # motor torque
    stage: f64  # the same before the second stage of its lag
    memory: Memory  # what the drive's laws remember (`columns.MEMORY`)
    taken: f64  # share of the dry friction that is taken up
    integral: f64  # the controller's integral term
    since: f64  # s, since it was taken
    # 1 before its first step, 2 where its torque is known by then (a bool's padding is copied with it, at the price of
    # a division)
    fresh: f64
    older: f64  # what the age of its position makes of the torque that the loop asks for
    borne: f64  # torque that the gear hands to the joint, as its friction feels it


@wp.struct
class Now:  # what holds in one step of the grid
    target: f64
    feed: f64  # torque of the feed-forward
    carried: f64  # speed at which a linkage turns the motor, the joint at rest
    load: f64  # torque of what is neither gravity nor the joint's own
    tau0: f64
    no_load: f64
    supply: f64
    weak: f64  # of what the drive gives, lost to the other joints
    efficiency: f64
    friction: f64  # factor
    inertia: f64
    gravity_cos: f64
    gravity_sin: f64
    q: f64  # measured
    enabled: bool
    held: bool  # the recorded motion is held on the joint


@wp.struct
class Pair:  # rotor and link in one step of the grid, where they are two bodies
    rotor: f64  # kg.m2
    link: f64
    stiff: f64  # of the spring between them
    hardening: f64
    damping: f64  # of the spring
    rotor_rate: f64  # inertia over a sub-step
    link_rate: f64
    moves_rotor: f64  # speed that a torque gives the rotor in a sub-step,
    moves_both: f64  # and both


@wp.struct
class Torque:  # of the motor, as a line in the speeds at the end of the step
    now: f64
    end: f64  # at unchanged speed
    on_loop: f64  # less per speed of the loop's encoder
    on_drive: f64  # less per speed of the motor's own


@wp.func
def guess(c: Recorded, of: Any, dt: f64):
    p = Guess()
    p.kp = of[P_KP]
    p.kd = of[P_KD]
    p.scale = of[P_SCALE]
    p.read_scale = of[P_READSCALE]
    p.read_offset = of[P_READOFFSET]
    p.offset = of[P_OFFSET]
    p.age = of[P_AGE]
    p.ki = of[P_KI]
    p.steep = of[P_BRAKING]
    p.limit_speed = of[P_LIMITSPEED]
    p.gap2 = f64(0.5) * of[P_GAP]
    p.soft = of[P_SOFT]
    p.two = p.gap2 > f64(0.0) or p.soft > f64(0.0)
    p.dt = dt / f64(ONE_BODY_STEPS)
    if p.two:
        p.dt = dt / f64(TWO_BODY_STEPS)
    p.rate = f64(1.0) / p.dt
    p.staged = of[P_STAGES] > f64(1.5)
    p.lag = lag_share(of[P_LAG] / of[P_STAGES], p.dt)
    p.viscous = of[P_VISC]
    p.thins = of[P_THINS]
    p.thin_speed = of[P_THINSPEED]
    for k in range(wp.static(len(SERVO_FEATURES["load"]))):
        p.carries = p.carries or of[P_LOADOUT + k] != f64(0.0)
    p.gear_load = of[P_GEARLOAD]
    p.gear_back = of[P_GEARBACK]
    p.gear_power = of[P_GEARPOWER]
    p.gear_unit = of[P_GEARUNIT]
    p.bias = of[P_BIAS]
    p.spring = of[P_SPRING]
    p.preload = of[P_PRELOAD]
    p.weak_own = of[P_WEAKOWN]
    p.feed_v = of[P_FEEDV]
    p.feed_a = of[P_FEEDA]
    p.beyond = p.ki != f64(0.0) or p.feed_v != f64(0.0) or p.feed_a != f64(0.0)
    p.rotor = of[P_ROTOR] + of[P_ARM]
    p.mass = of[P_PAYLOAD]
    p.own_mass = of[P_OWN]
    p.off_centre = p.mass != f64(0.0) and (of[P_COUT] != f64(0.0) or of[P_CACROSS] != f64(0.0))
    p.tilted = of[P_TX] != f64(0.0) or of[P_TY] != f64(0.0) or of[P_TZ] != f64(0.0)
    p.voltage = c.consts[C_VOLTAGE] > f64(0.0)
    p.loop_motor = c.consts[C_LOOP_MOTOR] > f64(0.0)
    p.slide = c.consts[C_SLIDE] >= f64(0.5)
    p.base_friction = c.consts[C_FRICTION]
    p.base_damping = c.consts[C_DAMPING]
    p.motor_share = of[P_MOTORSHARE]
    # what an encoder that misreads has shown lies within the range: no stop is where the joint was recorded to be
    per = f64(1.0) / p.scale
    p.low = wp.min(c.consts[C_LOW], (c.consts[C_LOW] - p.offset) * per)
    p.high = wp.max(c.consts[C_HIGH], (c.consts[C_HIGH] - p.offset) * per)
    p.stop = c.consts[C_STIFF]
    return p


# -- encoder and commands ----------------------------------------------------------------------------------------------


@wp.func
def shown(of: Any, q: f64, x: State, p: Guess):
    """(what the encoder shows at position q, what it shows of a speed there over that speed)."""
    error = encoder(of, q, x.memory, x.fresh != f64(0.0))
    m = encoder_line(q, p.scale, p.offset)
    m += error[0] + error[1]
    return wp.vec2d(m, p.scale + error[2])


@wp.func
def position(of: Any, m: f64, x: State, p: Guess):
    """Where m is reported: its inverse, by two fixed-point steps."""
    at = unread(m, p) - p.offset
    q = at / p.scale
    error = encoder(of, q, x.memory, x.fresh != f64(0.0))
    q = (at - error[0] - error[1]) / p.scale
    error = encoder(of, q, x.memory, x.fresh != f64(0.0))
    q = (at - error[0] - error[1]) / p.scale
    return q


@wp.func
def unread(m: f64, p: Guess):
    """What the encoder shows where m is reported: without what the readout alone is off by."""
    return (m - p.read_offset) / p.read_scale


@wp.func
def command(c: Recorded, first: int, k: int, last: int, end: f64, dt: f64, rates: bool):
    """Target [rad], with `rates` its speed and acceleration for a feed-forward, means over the step of dt [s] that ends
    at `end`, the delay taken off; command k of the run's first .. last - 1 is in force at its begin."""
    target = c.cmd[k]
    kk = int(k)
    while kk + 1 < last:
        stamp = c.cmd_t[kk + 1]
        if stamp >= end:
            break
        target += arrived(end, stamp, dt) * (c.cmd[kk + 1] - c.cmd[kk])
        kk += 1
    speed = f64(0.0)
    acceleration = f64(0.0)
    if not rates:
        return wp.vec3d(target, speed, acceleration)
    for m in range(wp.max(k, first + 1), kk + 1):
        since = c.cmd_t[m]
        span = since - c.cmd_t[m - 1]
        rate = difference(c.cmd[m], c.cmd[m - 1], span, dt)
        earlier = f64(0.0)
        if m > first + 1:
            earlier = difference(c.cmd[m - 1], c.cmd[m - 2], c.cmd_t[m - 1] - c.cmd_t[m - 2], dt)
        until = end
        if m < kk:
            until = wp.min(until, c.cmd_t[m + 1])
        share = hold(since, span, until, end - dt, dt)
        speed += share * rate
        acceleration += share * difference(rate, earlier, span, dt)
    return wp.vec3d(target, speed, acceleration)


# -- what holds in a step ----------------------------------------------------------------------------------------------


@wp.func
def drive_now(c: Recorded, of: Any, g: int, dt: f64, x: State, p: Guess, n: Now):
    """(`n` with what the supply, the temperature and the other joints make of the drive at grid point g, what the
    drive remembers)."""
    dragger = int(of[P_FROM])
    fresh = x.fresh != f64(0.0)
    shift, kept = drags(of, c.series[g, XDRAG + dragger], x.memory, fresh, dt)
    n.target += shift
    n.carried = of[P_LINKAGE] * c.series[g, XDV + dragger]
    if p.loop_motor:
        n.target += of[P_LINKAGE] * c.series[g, XDRAG + dragger]
    n.load = of[P_REACTION] * c.series[g, XPULL + dragger]
    n.load -= of[P_LINKAGE] * c.series[g, XDA + dragger] * p.rotor
    n.load = c.series[g, XR] + n.load

    warm, kept = motor(of, c.series[g, XWARM], x.last, p.voltage, kept, fresh, dt)
    n.tau0 = warm[0]
    n.no_load = warm[1]
    n.efficiency = warm[2]
    n.friction = warm[3]
    supply = of[P_SUPPLY] * c.series[g, XSUP]
    supply, kept = leaves(of, supply, c.series[g, XOTH], kept, fresh, dt)
    n.supply = supply
    n.weak = of[P_WEAK] * c.series[g, XOTH]
    n.enabled = c.series[g, XON] >= f64(0.5)
    return n, kept


@wp.func
def body_now(c: Recorded, of: Any, g: int, p: Guess, n: Now):
    """`n` with the inertia about the joint and the gravity on it at grid point g."""
    mass = p.mass
    inertia = of[P_ISCALE] * c.series[g, XI] + of[P_ARM] + mass * c.series[g, XLI]
    gc = of[P_GSCALE] * c.series[g, XGC] + mass * c.series[g, XLC]
    gs = of[P_GSCALE] * c.series[g, XGS] + mass * c.series[g, XLS]
    own = p.own_mass
    if own != f64(0.0):
        inertia += own * c.series[g, XOWI]
        gc += own * c.series[g, XOWC]
        gs += own * c.series[g, XOWS]
    if p.off_centre:
        out = of[P_COUT]
        across = of[P_CACROSS]
        inertia += mass * (out * c.series[g, XOI] + across * c.series[g, XAI] + out * out + across * across)
        gc += mass * (out * c.series[g, XOC] + across * c.series[g, XAC])
        gs += mass * (out * c.series[g, XOS] + across * c.series[g, XAS])
    if p.tilted:
        tx = of[P_TX]
        ty = of[P_TY]
        tz = of[P_TZ]
        gc += tx * c.series[g, XTXC] + ty * c.series[g, XTYC] + tz * c.series[g, XTZC]
        gs += tx * c.series[g, XTXS] + ty * c.series[g, XTYS] + tz * c.series[g, XTZS]
    n.inertia = wp.max(inertia, f64(1.0e-9))
    n.gravity_cos = gc
    n.gravity_sin = gs
    n.q = c.series[g, XQ]
    return n


@wp.func
def pair_now(of: Any, p: Guess, n: Now):
    """What the sub-steps of rotor and link share: divisions and a root are most of what one costs."""
    b = Pair()
    if p.two:
        least = wp.static(f64(LEAST_ROTOR)) * n.inertia
        b.rotor = wp.clamp(p.rotor, least, wp.static(f64(1.0 - LEAST_ROTOR)) * n.inertia)
        b.link = n.inertia - b.rotor
        b.stiff = f64(1.0) / wp.max(p.soft, f64(1.0e-9))
        b.hardening = of[P_HARD]
        if p.soft <= f64(0.0):
            b.stiff = p.stop
            b.hardening = f64(0.0)
        b.damping = transmission_damping(of[P_REBOUND], b.stiff, b.rotor, b.link, n.inertia)
        b.rotor_rate = b.rotor * p.rate
        b.link_rate = b.link * p.rate
        b.moves_rotor = p.dt / b.rotor
        b.moves_both = p.dt / n.inertia
    return b


@wp.func
def turned(gc: f64, gs: f64, dq: f64):
    """gc cos(dq) + gs sin(dq) [N.m]: the model's gravity at dq [rad] from where it was evaluated, by Taylor's series,
    true to 4e-12; farther off from a sixteenth of the angle, doubled four times, true to 1e-6 over a turn."""
    far = wp.abs(dq) > f64(0.15)
    y = dq
    if far:
        y = wp.clamp(dq, f64(-6.3), f64(6.3)) * f64(1.0 / 16.0)
    x = y * y
    c = f64(1.0) - x * (f64(0.5) - x * (f64(1.0 / 24.0) - x * f64(1.0 / 720.0)))
    s = y * (f64(1.0) - x * (f64(1.0 / 6.0) - x * (f64(1.0 / 120.0) - x * f64(1.0 / 5040.0))))
    if far:
        c, s = doubled(c, s)
        c, s = doubled(c, s)
        c, s = doubled(c, s)
        c, s = doubled(c, s)
    return gc * c + gs * s


@wp.func
def doubled(c: f64, s: f64):
    """(cosine, sine) of twice an angle."""
    return f64(1.0) - f64(2.0) * s * s, f64(2.0) * s * c


# -- the drive ---------------------------------------------------------------------------------------------------------


@wp.func
def drive_torque(u: wp.vec3d, v_lim: f64, x: f64, lower: f64, upper: f64, steep: f64, line: f64, gain: f64, drift: f64):
    """What a torque drive gives of u = (now, end, slope). At its limit the torque keeps to the limit for the whole
    step, unless the step's end is within the limits; line: torque lost per speed; gain, drift: the change of speed in
    this step is gain * torque + drift."""
    t = Torque()
    t.now = wp.clamp(u[0], -lower, upper)
    t.end = wp.clamp(u[1], -lower, upper)
    t.on_loop = u[2]
    limit = upper
    if u[1] < f64(0.0):
        limit = lower
    if wp.abs(u[1]) > limit:
        end = u[1] - u[2] * (gain * t.end + drift)
        if end * wp.sign(u[1]) >= limit:
            t.on_loop = f64(0.0)
            if u[1] * v_lim > f64(0.0) and limit > f64(0.0):
                t.on_drive = line
            elif u[1] * v_lim < f64(0.0) and limit > f64(0.0):
                # it grows as the speed falls, exponentially: taken at the step's start it would come late
                t.on_drive = -wp.min(steep * line, f64(0.5) / wp.max(gain, f64(1.0e-12)))
        else:
            t.on_loop = u[2] * limit / wp.abs(u[1])
    return t


@wp.func
def drive_voltage(u: wp.vec3d, v: f64, gain: f64, drift: f64, n: Now):
    """What a voltage drive gives of a duty u = (now, end, slope); gain, drift as for `drive_torque`."""
    t = Torque()
    t.on_drive = n.tau0 / n.no_load
    t.now = voltage_torque(u[0], n.tau0, n.supply, t.on_drive, v)
    t.end = voltage_torque(u[1], n.tau0, n.supply, t.on_drive, v)
    slope = u[2]
    if wp.abs(u[1]) > f64(1.0):
        end = u[1] - u[2] * (gain * t.end + drift)
        if end * wp.sign(u[1]) >= f64(1.0):
            slope = f64(0.0)
        else:
            slope = slope / wp.abs(u[1])
    t.on_loop = n.tau0 * n.supply * slope
    return t


@wp.func
def driven(t: Torque, p: Guess, n: Now):
    """The torque, none where the drive is off; a light rotor's slope is bounded."""
    if p.two:  # its steps are short, and a light rotor's would not stand it
        t.on_drive = wp.max(t.on_drive, f64(0.0))
    if not n.enabled:
        t.now = f64(0.0)
        t.end = f64(0.0)
        t.on_loop = f64(0.0)
        t.on_drive = f64(0.0)
    return t


# -- the bodies --------------------------------------------------------------------------------------------------------


@wp.func
def one_body(x: State, t: Torque, applied: f64, load: f64, level: f64, give: f64, stop_d: f64, visc: f64, grease: f64,
             theta: f64, dt: f64, p: Guess, n: Now):  # fmt: skip
    """The step of a joint whose motor is fixed to it; applied, load: torques with and against it [N.m]; level, give: of
    dry friction (`friction_acts`); visc: all that is by its speed, grease: of it, what is by the motor's
    [N.m.s/rad]."""
    begun = x.v
    damping = n.efficiency * t.on_loop + n.efficiency * t.on_drive
    level += p.base_friction
    share = f64(1.0) / theta
    mass = n.inertia * p.rate * share
    a = mass + damping + visc + stop_d
    slower = f64(1.0) / a
    free = (mass * x.v + applied + damping * x.v - load + grease * n.carried) * slower
    free -= n.carried  # dry friction acts where the motor turns
    turn = f64(0.0)  # of the friction, taken up by a speed in the step
    if give > f64(0.0):
        turn = dt / give
    if n.held:
        if give > f64(0.0):
            x.taken = preslide(x.taken, (x.v - n.carried) * turn)
    else:
        went = n.carried  # speed in the middle of the step, or at its end
        if give > f64(0.0):
            free = preslide_speed(free, a, level, x.taken, give * p.rate)
            went = free + n.carried
            x.taken = preslide(x.taken, free * turn)
            x.q += dt * (free + n.carried)
            x.v = x.v + (free + n.carried - x.v) * share
            if (x.v - n.carried) * free < f64(0.0):
                x.v = n.carried
        elif wp.abs(free) * a <= level:
            x.q += dt * n.carried
            x.v = n.carried
        else:
            free -= wp.sign(free) * level * slower
            went = free + n.carried
            x.q += dt * went
            ahead = x.v + (free + n.carried - x.v) * share
            if (ahead - n.carried) * free < f64(0.0):  # friction stops the joint within the step
                ahead = n.carried
            x.v = ahead
        x.last = t.end - (t.on_loop + t.on_drive) * (went - begun)  # what it gave: the lag goes on from there
    x.qm = x.q
    x.vm = x.v
    return x


@wp.func
def two_bodies(x: State, t: Torque, applied: f64, load: f64, level: f64, give: f64, stop_d: f64, drag: f64,
               grease: f64, dt: f64, p: Guess, n: Now, b: Pair):  # fmt: skip
    """The step of rotor and link, joined by a spring with a gap: implicit in both speeds, so that no stiffness limits
    the step. grease: viscous friction, drag: what else is by the speed of the rotor [N.m.s/rad]."""
    zero = f64(0.0)
    begun = x.v
    begun_m = x.vm
    twist = x.qm + dt * x.vm - x.q - dt * x.v
    kh = zero  # slope of the spring at this stretch
    pull = zero
    if wp.abs(twist) >= p.gap2:
        spring = transmission(x.qm - x.q - wp.sign(twist) * p.gap2, b.stiff, b.hardening)
        kh = spring[1] * dt + b.damping
        pull = spring[0]
    d_l = n.efficiency * t.on_loop
    d_m = n.efficiency * t.on_drive
    if p.loop_motor:
        d_m = d_l + d_m
        d_l = zero
    # the model's own friction and damping: a share before the play, the rest behind it
    link_share = f64(1.0) - p.motor_share
    level += p.motor_share * p.base_friction
    # rotor:  a11 vm' + a12 v' = b1      link:  a21 vm' + a22 v' = b2
    a11 = b.rotor_rate + grease + p.motor_share * p.base_damping + kh + d_m + drag
    a12 = -kh + d_l
    a21 = -kh
    a22 = b.link_rate + link_share * p.base_damping + kh + stop_d
    b1 = b.rotor_rate * x.vm + applied + d_m * x.vm + d_l * x.v - pull
    b2 = b.link_rate * x.v - load + pull
    if n.held:  # link held
        a21 = zero
        a22 = f64(1.0)
        b2 = x.v
    det = a11 * a22 - a12 * a21
    x1 = (b1 * a22 - a12 * b2) / det
    x2 = zero
    gain = a22 / det
    if give > zero:
        x1 = preslide_speed(x1, f64(1.0) / gain, level, x.taken, give / dt)
        x.taken = preslide(x.taken, x1 * dt / give)
        x2 = (b2 - a21 * x1) / a22
    elif wp.abs(x1) <= gain * level:
        x1 = zero
        x2 = b2 / a22
    else:
        x1 -= wp.sign(x1) * gain * level
        x2 = (b2 - a21 * x1) / a22
    if link_share * p.base_friction > zero and not n.held:
        still = link_share * p.base_friction / a22
        if wp.abs(x2) <= still:
            x2 = zero
        else:
            x2 -= wp.sign(x2) * still
    x.vm = x1
    x.qm += dt * x.vm
    if n.held:  # a held link must not let the rotor run past the play
        wound = wp.abs(x.last) / b.stiff * f64(2.0)
        x.qm = wp.clamp(x.qm, x.q - p.gap2 - wound, x.q + p.gap2 + wound)
    else:
        x.v = x2
        x.q += dt * x.v
        turned = x.v - begun
        if p.loop_motor:
            turned = x.vm - begun_m
        x.last = t.end - t.on_loop * turned - t.on_drive * (x.vm - begun_m)
    return x


@wp.func
def substep(of: Any, x: State, p: Guess, n: Now, b: Pair):
    """The joint after a sub-step."""
    dt = p.dt
    zero = f64(0.0)
    half = f64(0.5)

    # what the loop sees
    q_l = x.q
    v_l = x.v
    v_drive = x.vm
    if p.two:
        if p.loop_motor:
            q_l = x.qm
            v_l = x.vm
    else:
        v_drive = x.v - n.carried
        if p.loop_motor:
            v_l = v_drive
    fresh = x.fresh != zero
    seen = shown(of, q_l, x, p)
    shows = seen[1]
    heard, kept = hears(of, v_l, x.memory, fresh, dt)
    e = n.target - seen[0] + p.age * shows * v_l  # a sampled loop acts on where the joint was
    rate = shows * heard[0]

    load = n.gravity_cos
    if not p.slide:
        dq = x.q - n.q  # the model was evaluated at the measured pose
        load = turned(n.gravity_cos, n.gravity_sin, dq)
    pulled = p.preload + p.spring * (x.q + half * dt * x.v)
    load += n.load + pulled
    by_gear = p.gear_load > zero or p.gear_back > zero
    if by_gear and (n.held or x.fresh != zero):
        x.borne = load

    beside, kept = parasitic(of, x.q, v_drive, kept, fresh, dt)
    drag = wp.max(zero, -beside[2])  # what of it brakes is taken at the end of the step
    grease = p.viscous * n.friction  # at the speed of the step's begin
    if p.thins > zero:
        grease = viscous(p.viscous, p.thins, p.thin_speed, v_drive) * n.friction
    visc = p.base_damping + grease
    visc += drag

    # theta-method: the middle of the step where it is smooth, its end where it is stiff
    theta = f64(1.0)
    moves = b.moves_both  # speed that a torque gives in the step
    if p.two:
        if wp.abs(x.qm - x.q) < p.gap2:
            moves = b.moves_rotor
    else:
        stiffness = n.efficiency * (p.kd + p.kp * dt)
        if p.voltage:
            stiffness = n.efficiency * n.tau0 * (n.supply * (p.kd + p.kp * dt) + f64(1.0) / n.no_load)
        moves = dt / n.inertia
        theta = wp.clamp(half + half * ((stiffness + visc) * moves - f64(0.6)), half, f64(1.0))
        moves = theta * moves
    gain = n.efficiency * moves
    step = theta * dt

    # what the loop asks for, and what the motor gives of it
    off, kept = lost(of, n.target, e, kept, fresh, dt)
    u = pd(e, off, rate, rate, rate, shows, p.kp, p.kd, step, p.age, f64(1.0))
    v_lim = v_drive + p.limit_speed * (rate - v_drive)
    speed = zero  # over the no-load speed
    limits = wp.vec2d(f64(1.0), f64(1.0))  # of the duty, or of the torque
    left = f64(1.0)  # of what the drive gives, where its supply sags
    if n.weak != zero or p.weak_own != zero:
        left = sagged_torque(n.weak, p.weak_own, x.last)
    per = f64(1.0) / (n.no_load * n.supply)
    if not p.voltage:
        speed = wp.abs(v_lim) * per
        if left != f64(1.0):
            speed = speed / left
        limits = torque_limits(n.tau0 * left, speed, v_lim, p.steep)
    asked = wp.vec3d(left * u[0], left * u[1], left * u[2])
    if p.beyond:
        if x.fresh != zero and p.ki != zero:  # a drive that has been on before: its integral holds the load
            x.integral = load / wp.max(n.efficiency, f64(0.01))
            if p.voltage:
                x.integral = x.integral / (n.tau0 * n.supply)
        x.integral = wind(x.integral, x.since * p.ki * u[3], u[0] + n.feed + x.integral, limits[0], limits[1])
        x.since = dt
        asked = other_terms(u, n.feed, x.integral, p.ki, rate, shows, step)
    drift = -load * moves
    t = Torque()
    if p.voltage:
        t = drive_voltage(asked, v_drive, gain, drift, n)
    else:
        t = drive_torque(asked, v_lim, speed, limits[0], limits[1], p.steep, n.tau0 * per, gain, drift)
    x.older = zero
    if t.on_loop != zero:
        x.older = p.kp * p.age * shows * v_l
        if p.voltage:
            x.older = n.tau0 * n.supply * x.older
    t = driven(t, p, n)
    if not n.enabled:
        x.integral = zero
    if x.fresh == f64(1.0):
        x.last = t.now
        x.stage = t.now
    x.fresh = zero
    if p.staged:
        t.now = x.stage + p.lag * (t.now - x.stage)
        t.end = x.stage + p.lag * (t.end - x.stage)
        t.on_loop = p.lag * t.on_loop
        t.on_drive = p.lag * t.on_drive
    before = x.last
    x.last = before + p.lag * (t.now - before)
    t.end = before + p.lag * (t.end - before)
    t.on_loop = p.lag * t.on_loop
    t.on_drive = p.lag * t.on_drive

    # what acts on the bodies
    applied = n.efficiency * t.end
    applied += beside[0]
    applied += p.bias
    parts, kept = dry(of, x.q, v_drive, before, p.bias - load, p.carries, f64(1.0), kept, fresh, dt)
    how, kept = acts(of, x.q, v_drive, kept, fresh, dt)
    x.memory = kept
    level = (parts[0] + parts[1] + (parts[2] + parts[3])) * n.friction
    if by_gear:
        by_load = gear_load_friction(x.borne, v_drive, p.gear_load, p.gear_back, p.gear_power, p.gear_unit)
        level += by_load * n.friction
    applied -= how[0] * level
    if drag > zero:
        applied += drag * v_drive
    stop_d = zero
    if x.q < p.low:
        load -= p.stop * (p.low - x.q - dt * x.v)
        stop_d = p.stop * f64(0.02)
    if x.q > p.high:
        load += p.stop * (x.q + dt * x.v - p.high)
        stop_d = p.stop * f64(0.02)
    was = x.v
    if p.two:
        on_motor = zero
        if p.gap2 > zero:  # a spring behind the play would keep it closed: one that leaves it open is before it
            on_motor = p.preload + p.spring * (x.qm + half * dt * x.vm)
            load -= pulled
        x = two_bodies(x, t, applied - on_motor, load, level, how[1], stop_d, drag, grease, dt, p, n, b)
    else:
        x = one_body(x, t, applied, load, level, how[1], stop_d, visc, grease, theta, dt, p, n)
    if p.staged:
        x.stage = stage_before(before, x.last, p.lag)
    if by_gear and not n.held:
        link = wp.max(n.inertia - p.rotor, zero)
        x.borne += lag_share(f64(PRESSED), dt) * (load + link * (x.v - was) / dt - x.borne)
    return x


@wp.func
def moved(c: Recorded, h: int, w: int, x: State):
    """The joint from where this guess begins in window w: all windows from the same, or each from its own."""
    of = wp.min(w, c.inits.shape[1] - 1)
    x.q += c.inits[h, of, 0]
    x.v += c.inits[h, of, 1]
    return x


@wp.func
def begun(c: Recorded, of: Any, h: int, w: int, g: int, warm: int, p: Guess):
    """The joint at the begin of window w: where it was measured."""
    x = State()
    x.fresh = f64(1.0)
    x.q = position(of, c.series[g, XQ], x, p)
    x.v = c.series[g, XV] / (p.read_scale * shown(of, x.q, x, p)[1])
    if warm == 0:
        x = moved(c, h, w, x)
    x.qm = x.q
    x.vm = x.v
    if w < c.setpoints.shape[1] and not wp.isnan(c.setpoints[h, w, 0]):
        x.memory[SETPOINT] = c.setpoints[h, w, 0]
        x.memory[SETPOINT_SPEED] = c.setpoints[h, w, 1]
        x.memory[SETPOINT_NEW] = f64(-1.0)
    return x


@wp.func
def held(c: Recorded, of: Any, h: int, w: int, g: int, last: bool, x: State, p: Guess):
    """The joint on its recorded motion in window w, while the drive's own state settles; last: it is let go now."""
    error = encoder(of, x.q, x.memory, x.fresh != f64(0.0))
    m = unread(c.series[g, XQ], p) - error[0] - error[1]
    x.q = (m - p.offset) / p.scale
    x.v = c.series[g, XV] / (p.read_scale * shown(of, x.q, x, p)[1])
    if last:
        x = moved(c, h, w, x)
    if not p.two:
        x.qm = x.q
        x.vm = x.v
    return x


@wp.func
def asked_before(c: Recorded, of: Any, k: int, last: int, t: f64, dt: f64, x: State, p: Guess):
    """Steps of dt [s] before t [s] in which a command changed that the drive's lag still holds some of; k, last: the
    command from which on to look, and the end of the run's."""
    waits, kept = late(of, t, x.memory, x.fresh != f64(0.0), dt)
    waits = waits + of[P_LATE]
    begin = t - waits - f64(SETTLES) * of[P_LAG]
    kk = int(k)
    while kk + 1 < last and c.cmd_t[kk + 1] <= begin:
        kk += 1
    if kk + 1 >= last:
        return 0
    since = t - waits - c.cmd_t[kk + 1]
    if since <= f64(0.0):
        return 0
    return int(wp.ceil(since / dt)) + 1


@wp.func
def finite(x: State):
    """The joint, where it has diverged far off and at rest."""
    if not (wp.abs(x.q) < f64(1.0e4)):
        x.q = f64(1.0e4)
        x.v = f64(0.0)
        x.qm = x.q
        x.vm = f64(0.0)
    return x


def compiled() -> str:
    """Return flags of the compiler on a CPU: scalars packed into vectors cost a twentieth more time than they save."""
    given = wp.config.cpu_compiler_flags
    return f"{'-march=native' if given is None else given} -fno-slp-vectorize"


@cache
def plant_kernel() -> wp.Kernel:
    """Return the kernel: one thread a guess and window. first_window, first: numbers of the launch's first window and
    guess; dt: step of the grid [s]."""

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": compiled()})
    def plant(first_window: int, first: int, dt: f64, c: Recorded):
        ww, hh = wp.tid()  # guesses of one window side by side: what was recorded in it stays in the cache
        w = first_window + ww
        h = first + hh
        g0 = c.window[w, 0]
        warm = c.window[w, 2]
        s = c.window[w, 3]
        s_end = s + c.window[w, 4]
        c_begin = c.window[w, 5]
        c_end = c.window[w, 6]
        k = c.window[w, 7]
        t = c.window_t[w]
        of = c.params[h]
        p = guess(c, of, dt)
        x = begun(c, of, h, w, g0, warm, p)
        lead = int(0)
        if warm == 0:
            lead = asked_before(c, of, k, c_end, t, dt, x, p)
            t -= f64(lead) * dt
        on_motor = c.consts[C_POS_MOTOR] > f64(0.0)
        after = shown(of, x.q, x, p)[0]  # at the end of the step
        for j in range(c.window[w, 1] + lead):
            i = j - lead
            g = g0 + wp.max(i, 0)
            if i <= 0 and lead > 0:  # where it is measured first, only the drive's torque goes on
                torque = x.last
                stage = x.stage
                x = begun(c, of, h, w, g0, warm, p)
                if j > 0:
                    x.last = torque
                    x.stage = stage
                    x.fresh = f64(2.0)
                after = shown(of, x.q, x, p)[0]
            if i >= 0 and i <= warm and warm > 0:
                x = held(c, of, h, w, g, i == warm, x, p)
                if i == 0:
                    x.qm = x.q
                    x.vm = x.v
                after = shown(of, x.q, x, p)[0]
                if on_motor:
                    after = shown(of, x.qm, x, p)[0]
            reported = after
            n = Now()
            n.held = i < warm or i < 0
            waits, kept = late(of, t, x.memory, x.fresh != f64(0.0), dt)
            waits = waits + of[P_LATE]
            x.memory = kept
            end = t + dt - waits
            while k + 1 < c_end and c.cmd_t[k + 1] <= end - dt:
                k += 1
            aim = command(c, c_begin, k, c_end, end, dt, p.beyond)
            n.target = aim[0]
            n.feed = feed_forward(p.feed_v, p.feed_a, aim[1], aim[2])
            n, kept = drive_now(c, of, g, dt, x, p, n)
            x.memory = kept
            n = body_now(c, of, g, p, n)
            b = pair_now(of, p, n)
            n_sub = int(ONE_BODY_STEPS)
            if p.two:
                n_sub = TWO_BODY_STEPS
            for _ in range(n_sub):
                x = substep(of, x, p, n, b)
            x = finite(x)
            after = shown(of, x.q, x, p)[0]
            if on_motor:
                after = shown(of, x.qm, x, p)[0]
            elif i < warm:
                after = reported
            while s < s_end and c.sample_step[s] == i:
                c.out_q[h, s] = p.read_scale * (reported + c.sample_part[s] * (after - reported)) + p.read_offset
                c.out_torque[h, s] = x.last - c.params[h, P_FRESH] * x.older
                s += 1
            t += dt

    return plant


# -- guesses side by side ----------------------------------------------------------------------------------------------
# On a CPU a step of one guess waits for its own divisions, one after the other. Of guesses that have none but the usual
# columns several are simulated at a time, which the compiler makes vectors of: all other columns are constants there,
# so that no call and no second body is left.

LANES = 8  # guesses side by side
USUAL = tuple(
    INDEX[n] for n in (
        "kp", "kd", "torque_limit", "no_load_speed", "efficiency", "coulomb_friction", "viscous_friction", "lag",
        "delay", "friction_asymmetry", "presliding", "deadband", "deadband_kind", "speed_lag", "braking_slope", "rotor",
        "supply", "position_offset", "position_scale", "inertia_scale", "gravity_scale", "armature", "payload",
        "tilt_x", "tilt_y", "tilt_z", "bias", "feedback_delay", "limit_speed", "motor_share", "effort_fresh",
        "effort_gain", "effort_offset", "readout_scale", "readout_offset", "spring", "spring_preload",
    )
)  # fmt: skip
MORE = USUAL + tuple(  # by another joint, by what hangs on it, or of a target that moves
    INDEX[n] for n in (
        "linkage", "reaction", "coupling_from", "own_payload", "com_out", "com_across", "speed_feedforward",
        "acceleration_feedforward",
    )
)  # fmt: skip
TWO = MORE + tuple(INDEX[n] for n in ("backlash", "softness", "rebound", "hardening"))  # of rotor and link
# what calls exp() or sin(), which would keep the others from being vectors: worked out before, as friction and bias
CALLED = tuple(k for k in MORE if k != P_BIAS) + tuple(
    INDEX[n] for n in (
        "stribeck_peak", "stribeck_speed", "torque_ripple", "ripple_per_turn", "ripple_phase", "lag_stages",
        "sag_torque", "sag_own", "sag", "coupling", "thinning_friction", "thinning_speed",
    )
)  # fmt: skip
Lanes = wp.types.vector(length=LANES, dtype=f64)
Row = wp.types.vector(length=len(NEUTRAL), dtype=f64)
ABSENT = np.where(np.isfinite(NEUTRAL), NEUTRAL, 1e9)  # as a plant has columns of what is not there
COLUMNS, FILTERED, P_DELAY = len(NEUTRAL), MEMORY["filtered"], INDEX["delay"]


@cache
def lanes_kernel(usual: tuple[int, ...]) -> wp.Kernel:
    """Return the kernel of guesses side by side, one thread `LANES` of them and a window: what `plant_kernel` does of a
    torque drive whose loop reads the joint, as far as these columns say (`USUAL`, `MORE`, `TWO` or `CALLED`). Rows of
    params: as many as threads have.

    No `wp.static` here is of a loop's variable: each process would write the kernel out anew, cached or not."""
    Columns = wp.types.vector(length=LANES * len(usual), dtype=f64)
    absent, places = wp.constant(Row(*ABSENT)), wp.constant(wp.types.vector(length=len(usual), dtype=int)(*usual))
    two, count, wait_at = usual == TWO, len(usual), LANES * usual.index(P_DELAY)
    fed = P_FEEDV in usual
    speed_at, acceleration_at = (LANES * usual.index(k) if fed else 0 for k in (P_FEEDV, P_FEEDA))
    substeps = TWO_BODY_STEPS if two else ONE_BODY_STEPS
    flags = f"{compiled()} -mprefer-vector-width=512"

    @wp.kernel(module="unique", enable_backward=False,
               module_options={"cpu_compiler_flags": flags, "max_unroll": COLUMNS})  # fmt: skip
    def plant_lanes(first_window: int, first: int, dt: f64, c: Recorded):
        ww, hh = wp.tid()
        w = first_window + ww
        h0 = LANES * (first + hh)
        g0 = c.window[w, 0]
        warm = c.window[w, 2]
        s = c.window[w, 3]
        s_end = s + c.window[w, 4]
        c_begin = c.window[w, 5]
        c_end = c.window[w, 6]
        t = c.window_t[w]
        columns = Columns()
        qs = Lanes()
        vs = Lanes()
        qms = Lanes()
        vms = Lanes()
        lasts = Lanes()
        stages = Lanes()
        levels = Lanes()
        pushes = Lanes()
        olders = Lanes()
        heards = Lanes()
        takens = Lanes()
        fresh = Lanes()
        ks = Lanes()
        targets = Lanes()
        before = Lanes()
        after = Lanes()
        leads = Lanes()
        feeds = Lanes()
        lead = int(0)
        rates = bool(False)
        aim = wp.vec3d()
        l = int(0)
        while l < LANES:
            of = c.params[h0 + l]
            for m in range(wp.static(count)):
                columns[LANES * m + l] = of[places[m]]
            p = guess(c, of, dt)
            x = begun(c, of, wp.min(h0 + l, c.inits.shape[0] - 1), w, g0, warm, p)
            qs[l] = x.q
            vs[l] = x.v
            qms[l] = x.q
            vms[l] = x.v
            fresh[l] = f64(1.0)
            ks[l] = f64(c.window[w, 7])
            after[l] = shown(of, x.q, x, p)[0]
            rates = rates or p.beyond
            if warm == 0:
                leads[l] = f64(asked_before(c, of, c.window[w, 7], c_end, t, dt, x, p))
                lead = wp.max(lead, int(leads[l]))
            l += 1
        t -= f64(lead) * dt
        for j in range(c.window[w, 1] + lead):
            i = j - lead
            g = g0 + wp.max(i, 0)
            if (i <= 0 and lead > 0) or (i <= warm and warm > 0):
                l = int(0)
                while l < LANES:
                    of = c.params[h0 + l]
                    h = wp.min(h0 + l, c.inits.shape[0] - 1)
                    p = guess(c, of, dt)
                    x = State()
                    if warm > 0:
                        x.q = qs[l]
                        x.v = vs[l]
                        x.qm = qms[l]
                        x.vm = vms[l]
                        x.fresh = fresh[l]
                        x = held(c, of, h, w, g, i == warm, x, p)
                        if i == 0:
                            x.qm = x.q
                            x.vm = x.v
                    else:
                        x = begun(c, of, h, w, g0, warm, p)
                        heards[l] = f64(0.0)
                        takens[l] = f64(0.0)
                        fresh[l] = f64(1.0)
                        if i > -int(leads[l]):
                            fresh[l] = f64(2.0)
                    qs[l] = x.q
                    vs[l] = x.v
                    qms[l] = x.qm
                    vms[l] = x.vm
                    after[l] = shown(of, x.q, x, p)[0]
                    l += 1
            l = int(0)
            while l < LANES:
                before[l] = after[l]
                wait = columns[wp.static(wait_at) + l]
                end = t + dt - wait
                if l > 0 and wait == columns[wp.static(wait_at) + l - 1]:
                    targets[l] = targets[l - 1]
                    ks[l] = ks[l - 1]
                else:
                    k = int(ks[l])
                    while k + 1 < c_end and c.cmd_t[k + 1] <= end - dt:
                        k += 1
                    ks[l] = f64(k)
                    aim = command(c, c_begin, k, c_end, end, dt, rates)
                    targets[l] = aim[0]
                if wp.static(fed):
                    by_speed = columns[wp.static(speed_at) + l]
                    feeds[l] = feed_forward(by_speed, columns[wp.static(acceleration_at) + l], aim[1], aim[2])
                l += 1
            part = int(0)
            while part < wp.static(substeps):
                l = int(0)
                while l < wp.static(LANES if usual == CALLED else 0):
                    of = c.params[h0 + l]
                    carried = of[P_LINKAGE] * c.series[g, XDV + int(of[P_FROM])]
                    v = vs[l] - carried
                    x = State()
                    fades, kept = dry(of, qs[l], v, f64(0.0), f64(0.0), False, f64(1.0), x.memory, False, dt)
                    wave, kept = parasitic(of, qs[l], v, x.memory, False, dt)
                    levels[l] = fades[0] + fades[1]
                    pushes[l] = wave[0]
                    l += 1
                l = int(0)
                # becomes vectors while no call, no loop and no struct of another loop is in it
                while l < LANES:
                    row = Row(absent)
                    for m in range(wp.static(count)):
                        row[places[m]] = columns[LANES * m + l]
                    if wp.static(usual == CALLED):
                        row[COULOMB] = levels[l]
                        row[STRIBECK_PEAK] = f64(0.0)
                        row[P_BIAS] = pushes[l]
                        row[RIPPLE] = f64(0.0)
                    fixed = guess(c, row, dt)
                    fixed.two = wp.static(two)
                    fixed.voltage = False
                    fixed.loop_motor = False
                    one = State()
                    one.q = qs[l]
                    one.v = vs[l]
                    one.qm = qms[l]
                    one.vm = vms[l]
                    one.last = lasts[l]
                    one.stage = stages[l]
                    one.memory[FILTERED] = heards[l]
                    one.taken = takens[l]
                    one.fresh = fresh[l]
                    n = Now()
                    n.held = i < warm or i < 0
                    n.target = targets[l]
                    if wp.static(fed):
                        n.feed = feeds[l]
                    n, kept = drive_now(c, row, g, dt, one, fixed, n)
                    one.memory = kept
                    n = body_now(c, row, g, fixed, n)
                    one = finite(substep(row, one, fixed, n, pair_now(row, fixed, n)))
                    qs[l] = one.q
                    vs[l] = one.v
                    qms[l] = one.qm
                    vms[l] = one.vm
                    lasts[l] = one.last
                    stages[l] = one.stage
                    olders[l] = one.older
                    heards[l] = one.memory[FILTERED]
                    takens[l] = one.taken
                    fresh[l] = one.fresh
                    after[l] = shown(row, one.q, one, fixed)[0]
                    l += 1
                part += 1
            while s < s_end and c.sample_step[s] == i:
                for l in range(LANES):
                    h = h0 + l
                    if h < c.out_q.shape[0]:
                        end_q = after[l]
                        if i < warm:
                            end_q = before[l]
                        of = c.params[h]
                        shows = before[l] + c.sample_part[s] * (end_q - before[l])
                        c.out_q[h, s] = of[P_READSCALE] * shows + of[P_READOFFSET]
                        c.out_torque[h, s] = lasts[l] - of[P_FRESH] * olders[l]
                s += 1
            t += dt

    return plant_lanes
