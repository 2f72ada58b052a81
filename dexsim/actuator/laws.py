"""The physics of a drive, one small Warp function a law, in SI units: what the training's servo (`kernel.py`) and the
search's plant (`dexsim.gap.plant.kernel`) have in common. Each works in float32 and in float64; `reference.py` has the
same laws in NumPy, written apart, as their check.

Where several laws make up one quantity they are put together here, for both kernels, in the order of the signal:
`encoder_error`, `command_delay`, `dragged_target`, `heard_speed`, `lost_error`, `warm_motor`, `supply_left`,
`dry_friction`, `friction_acts`, `parasitic_torque`. Each gives a Warp function, for a kernel with these of
`columns.FEATURES`; `of` is there a drive's row of the table, in the order of `columns.py`. A further law of such a
quantity is a function of this file, a term there, and a term of the same function of `reference.py`: training, search
and what a diagnosis hands on take the quantity from these two.

Laws with memory: all of them are given what their drive remembers and hand it on. memory: a vector, `columns.MEMORY`
has the place of each number; fresh: nothing is remembered yet (the first step after a reset), a law begins from rest
and sets what it will remember; dt: of the step [s]. Each number is written by one law, once a step."""

# No `from __future__ import annotations`: Warp resolves these annotations from the module.

import math
from functools import cache
from typing import Any

import warp as wp

from dexsim.actuator.columns import INDEX, MEMORY
from dexsim.actuator.law import of_kind

TORQUE_LIMIT, NO_LOAD_SPEED, EFFICIENCY = (INDEX[n] for n in ("torque_limit", "no_load_speed", "efficiency"))
THERMAL_TORQUE, THERMAL_FRICTION, THERMAL_RESISTANCE = (
    INDEX[n] for n in ("thermal_torque", "thermal_friction", "thermal_resistance")
)
COULOMB, STRIBECK_PEAK, STRIBECK_SPEED, STRIBECK_EXPONENT = (
    INDEX[n] for n in ("coulomb_friction", "stribeck_peak", "stribeck_speed", "stribeck_exponent")
)
LOAD, LOAD_BACK, LOAD_OUTSIDE = (
    INDEX[n] for n in ("load_friction", "load_friction_backdriven", "load_friction_external")
)
LOAD_PEAK, LOAD_PEAK_OUTSIDE, LOAD_SQUARE, LOAD_SQUARE_OUTSIDE = (
    INDEX[n] for n in ("load_stribeck", "load_stribeck_external", "load_quadratic", "load_quadratic_external")
)
RIPPLE, RIPPLE_PER_TURN, RIPPLE_PHASE, RIPPLE_SHAPE = (
    INDEX[n] for n in ("torque_ripple", "ripple_per_turn", "ripple_phase", "ripple_shape")
)
ECC_SIN, ECC_COS = INDEX["eccentric_sin"], INDEX["eccentric_cos"]
DEADBAND, DEADBAND_KIND = INDEX["deadband"], INDEX["deadband_kind"]
PROFILE_SPEED, PROFILE_ACCELERATION = INDEX["profile_speed"], INDEX["profile_acceleration"]
SETPOINT, SETPOINT_SPEED, SETPOINT_NEW = (MEMORY[n] for n in ("setpoint", "setpoint_speed", "setpoint_new"))
DELAY, SPEED_LAG, FILTERED = INDEX["delay"], INDEX["speed_lag"], MEMORY["filtered"]
COUPLING, SAG = INDEX["coupling"], INDEX["sag"]
ASYMMETRY, PRESLIDING = INDEX["friction_asymmetry"], INDEX["presliding"]

# -- of installed packages ---------------------------------------------------------------------------------------------


def added(kind: str, features: frozenset[str]) -> Any:
    """Return the Warp function of (of, q, v) that sums the laws of installed packages of one kind (`law.Law`), for a
    kernel with these features; None where there is none."""
    total = None
    for law in of_kind(kind, features):
        total = _plus(total, law.warp, INDEX[law.columns[0].name])
    return total


def _plus(before: Any, law: Any, at: int) -> Any:
    @wp.func
    def first(of: Any, q: Any, v: Any):
        return law(of, wp.static(at), q, v)

    @wp.func
    def both(of: Any, q: Any, v: Any):
        return before(of, q, v) + law(of, wp.static(at), q, v)

    return first if before is None else both


# -- encoder -----------------------------------------------------------------------------------------------------------


@wp.func
def eccentricity(q: Any, sine: Any, cosine: Any):
    """(part by sin q, part by cos q, slope) of the error [rad] at position q [rad] of an encoder whose disk is off its
    axis: sine * sin q + cosine * (cos q - 1), zero at q = 0. Geometry, to first order in the offset over the disk's
    radius."""
    s = wp.sin(q)
    c = wp.cos(q)
    return wp.vector(sine * s, cosine * (c - type(q)(1.0)), sine * c - cosine * s)


@wp.func
def encoder_line(q: Any, scale: Any, offset: Any):
    """Return the position [rad] that an encoder of this scale and offset [rad] shows at q [rad], but for
    `encoder_error`: scale * q + offset. A scale of 1 and no offset by definition of a right one; ours, as far as it
    is off."""
    return scale * q + offset


@cache
def encoder_error(features: frozenset[str] = frozenset()) -> Any:
    """Return what an encoder shows beyond scale * q + offset, as a sum of laws of the position (terms of `error` and
    `slope`, and of `reference.measured_position`; columns are marked `encoder`). Recordings, and whoever asks what a
    position is from what is shown, take the encoder from these two, at any time: none of our encoders remembers."""

    @wp.func
    def error(of: Any, q: Any, memory: Any, fresh: bool):
        """Return (first, error, slope): first + error [rad] at position q [rad] of what the encoder turns with, and
        the slope of that in q. Two parts, since each kernel keeps the order of its sum, as of `dry_friction`."""
        first = type(q)(0.0)
        error = type(q)(0.0)
        slope = type(q)(0.0)
        if wp.static("rare" in features):
            if of[ECC_SIN] != type(q)(0.0) or of[ECC_COS] != type(q)(0.0):
                off_axis = eccentricity(q, of[ECC_SIN], of[ECC_COS])
                first = off_axis[0]
                error += off_axis[1]
                slope += off_axis[2]
        return wp.vector(first, error, slope)

    return error


# -- delay and lag -----------------------------------------------------------------------------------------------------


@cache
def command_delay(features: frozenset[str] = frozenset()) -> Any:
    """Return how long after its time a target acts, as a sum of laws of the time and of what is remembered (a delay
    that varies, or grows: terms of `late`; columns are marked `delays`, so that a servo keeps its targets for as
    long)."""

    @wp.func
    def delay(of: Any, t: Any, memory: Any, fresh: bool, dt: Any):
        """(delay [s], memory) of the targets that a step uses which begins at time t [s] of the run."""
        late = type(t)(0.0)
        late += of[DELAY]
        return late, memory

    return delay


@wp.func
def arrived(end: Any, stamp: Any, dt: Any):
    """Share of the step of dt [s] that ends at `end` [s], less the delay, in which a target stamped `stamp` is in
    force, (end - stamp) / dt within 0 .. 1: a delay that ends inside a step acts for the rest of it. Ours."""
    return wp.clamp((end - stamp) / dt, type(dt)(0.0), type(dt)(1.0))


@cache
def dragged_target(features: frozenset[str] = frozenset()) -> Any:
    """Return how far another joint (column `coupling_from`) drags a joint's target, as a sum of laws of where that is
    (a tendon that is slack at first, one that gives: terms of `shift`); needs the feature `rare`."""

    @wp.func
    def dragged(of: Any, away: Any, memory: Any, fresh: bool, dt: Any):
        """(shift of the target [rad], memory) where the other joint is `away` [rad] from its home."""
        shift = type(away)(0.0)
        if wp.static("rare" in features):
            shift += of[COUPLING] * away
        return shift, memory

    return dragged


@wp.func
def lag_share(time: Any, dt: Any):
    """Share of the way that a first-order lag, time * y' = u - y, goes from y to u in a step of dt [s]: backward
    Euler.

    A lag of second order is two of these in a row, (1 + s time / 2)^-2 in Laplace's s: half the time [s] each, so that
    the mean delay is that of one with all of it, critically damped (G. Franklin, J. Powell, A. Emami-Naeini, Feedback
    Control of Dynamic Systems, section 3.3)."""
    return dt / (time + dt)


@wp.func
def stage_before(before: Any, after: Any, share: Any):
    """Return what went into a first-order lag [N.m, or what it lags] whose output went from `before` to `after` in a
    step of this `lag_share`: u = before + (after - before) / share, of a lag of second order the first stage, where
    the output of the second is known (source: `lag_share`, solved for u)."""
    return before + (after - before) / share


@cache
def heard_speed(features: frozenset[str] = frozenset(), skips: bool = False) -> Any:
    """Return the speed that a loop's gain kd acts on; a further filter is one more step from v to `now`. skips:
    whether a filter without a lag passes the speed as it is, where it else comes out but for rounding: each kernel
    keeps its own, as of `dry_friction`."""

    @wp.func
    def heard(of: Any, v: Any, memory: Any, fresh: bool, dt: Any):
        """Return ((now, end, share), memory): speed [rad/s] of what the encoder turns with as kd has it now, and at
        the end of a step of dt [s] in which v does not change; share of a change of v that passes in the step.

        A first-order lag (column `speed_lag`)."""
        now = v
        end = v
        share = type(v)(1.0)
        if wp.static("rare" in features):
            if wp.static(not skips) or of[SPEED_LAG] > type(v)(0.0):
                share = lag_share(of[SPEED_LAG], dt)
                if not fresh:
                    now = memory[FILTERED] + share * (v - memory[FILTERED])
                end = now + share * (v - now)
            memory[FILTERED] = now
        return wp.vector(now, end, share), memory

    return heard


# -- the motor ---------------------------------------------------------------------------------------------------------


@wp.func
def warmed(per_degree: Any, warmth: Any):
    """Return the factor on a torque constant, a friction or a resistance, linear in the temperature: 1 + per_degree
    [1/degC] * warmth [degC].

    Copper's resistance has +0.0039 (IEC 60028), the magnets' flux about -0.001 (NdFeB) per degree; grease gets
    thinner."""
    return type(warmth)(1.0) + per_degree * warmth


@cache
def warm_motor(features: frozenset[str] = frozenset()) -> Any:
    """Return what a motor can do as it is now; a further law (a motor that heats up as it works, one that weakens) is
    a term of `warm`, or a factor of what is returned."""

    @wp.func
    def motor(of: Any, warmth: Any, torque: Any, voltage: bool, memory: Any, fresh: bool, dt: Any):
        """Return ((stall torque [N.m], no-load speed [rad/s], efficiency, factor on the friction), memory) of a
        drive `warmth` [degC] above the temperature that its figures hold at (`warmed`); torque: what it gave in the
        step before [N.m].

        The torque constant k is Nm/A and V.s/rad in one. A voltage drive's stall torque k u / R and no-load speed u / k
        follow from it and from the resistance R; a torque drive asks for a current, and k is lost on the way to the
        joint."""
        tau0 = of[TORQUE_LIMIT]
        no_load = of[NO_LOAD_SPEED]
        efficiency = of[EFFICIENCY]
        rubs = type(warmth)(1.0)
        if wp.static("rare" in features):
            warm = warmth
            constant = warmed(of[THERMAL_TORQUE], warm)
            tau0 = tau0 * constant
            if voltage:
                tau0 = tau0 / wp.max(warmed(of[THERMAL_RESISTANCE], warm), type(warmth)(0.1))
                no_load = no_load / constant
            else:
                efficiency = efficiency * constant
            rubs = wp.max(warmed(of[THERMAL_FRICTION], warm), type(warmth)(0.0))
        return wp.vector(tau0, no_load, efficiency, rubs), memory

    return motor


@wp.func
def sagging(supply: Any, per_torque: Any, others: Any):
    """Supply over nominal where the other motors load it: supply * max(0.05, 1 - sag [1/N.m] * sum of their |torque|
    [N.m]). Ohm's law of a source with an internal resistance, currents in proportion to torques; the bound is ours."""
    return supply * wp.max(type(supply)(1.0) - per_torque * others, type(supply)(0.05))


@cache
def supply_left(features: frozenset[str] = frozenset()) -> Any:
    """Return what is left of a supply that other motors load; a further law (a battery that empties, a converter that
    limits) is one more step from the supply to what is left. Needs the feature `sag`."""

    @wp.func
    def remaining(of: Any, supply: Any, others: Any, memory: Any, fresh: bool, dt: Any):
        """(supply over nominal, memory), where it would be `supply` without load and the other motors give |torque| of
        `others` [N.m] together."""
        there = supply
        if wp.static("sag" in features):
            there = sagging(there, of[SAG], others)
        return there, memory

    return remaining


LEAST_ROTOR = 0.03  # of a joint's inertia: what each of rotor and link has at least of it
LEAST_LEFT = wp.constant(0.2)  # of what a drive gives: a supply that sags below that resets the drive


@wp.func
def sagged_torque(others: Any, per_own: Any, torque: Any):
    """Share that is left of a drive's torque where it and the other motors load one supply: 1 - others - per_own
    [1/N.m] * |torque| [N.m], at least LEAST_LEFT; others: the part that the other motors take, torque: the drive's own
    in the step before. Ours: the loss of `sagging`, seen at the torque instead of the supply, which is what a search
    can tell of a drive whose supply is not in its model."""
    return wp.max(type(torque)(1.0) - others - per_own * wp.abs(torque), type(torque)(LEAST_LEFT))


@wp.func
def duty_torque(duty: Any, tau0: Any, supply: Any, line: Any, v: Any):
    """Return the torque [N.m] of a DC motor at a duty of its supply: tau0 * supply * duty - line * v, line = stall
    torque over no-load speed [N.m.s/rad]. Kirchhoff's law of the armature, R i = u - k v with torque = k i, without an
    inductance."""
    return tau0 * supply * duty - line * v


@wp.func
def voltage_torque(duty: Any, tau0: Any, supply: Any, line: Any, v: Any):
    """Return torque [N.m] of a drive that cannot give more than its supply: tau0 * supply * clip(duty, -1, 1) - line
    * v, as of `duty_torque` (source: there)."""
    return duty_torque(wp.clamp(duty, -type(duty)(1.0), type(duty)(1.0)), tau0, supply, line, v)


@wp.func
def torque_limit(tau0: Any, x: Any, slope: Any):
    """Return largest torque [N.m] of a motor: tau0 * max(0, 1 - slope * x), x = |speed| / no-load speed at the supply's
    voltage.

    tau0: stall torque [N.m]. slope: 1 while the motor drives (the torque-speed line of a DC motor at its full voltage),
    the column `braking_slope` while it brakes: 1 the driving line mirrored (the paper's limit), 0 a current limit (tau0
    at any speed), -1 the driving line gone on beyond zero speed (back-EMF and full voltage add up: a voltage limit).
    """
    limit = type(tau0)(0.0)
    if slope * x < type(x)(1.0):
        limit = tau0 * (type(x)(1.0) - slope * x)
    return limit


@wp.func
def torque_limits(tau0: Any, x: Any, v: Any, slope: Any):
    """(lower, upper) >= 0: the torque lies in -lower .. upper [N.m] at speed v [rad/s], x = |v| / no-load speed;
    `torque_limit` with slope 1 in the direction of v, with `slope` against it (source: there)."""
    upper = torque_limit(tau0, x, type(x)(1.0))
    lower = upper
    if v > type(v)(0.0):
        lower = torque_limit(tau0, x, slope)
    elif v < type(v)(0.0):
        upper = torque_limit(tau0, x, slope)
    return wp.vector(lower, upper)


# -- transmission ------------------------------------------------------------------------------------------------------


@wp.func
def transmission(turn: Any, stiff: Any, hardening: Any):
    """Return (torque [N.m], stiffness [N.m/rad]) of a transmission wound up by `turn` [rad]: tau = t (1 + hardening
    t^2), t = stiff * turn; its stiffness is 1 + 3 hardening t^2 times as large. A cubic hardening spring, as
    harmonic drives show (T. Tuttle, W. Seering, A nonlinear model of a harmonic drive gear transmission, IEEE Trans.
    Robotics and Automation 12, 1996)."""
    stretch = stiff * turn
    harder = type(turn)(1.0) + hardening * stretch * stretch
    return wp.vector(stretch * harder, (type(turn)(3.0) * harder - type(turn)(2.0)) * stiff)


@wp.func
def transmission_damping(rebound: Any, stiff: Any, rotor: Any, link: Any, both: Any):
    """Return the damping [N.m.s/rad] of a spring [N.m/rad] between two inertias [kg.m2] at the damping ratio `rebound`:
    2 rebound sqrt(stiff * rotor * link / both), both = rotor + link. By definition of the damping ratio of one mass on
    a spring, at the reduced mass of the two."""
    return type(stiff)(2.0) * rebound * wp.sqrt(stiff * rotor * link / both)


# -- friction ----------------------------------------------------------------------------------------------------------


@wp.func
def stribeck_power(ratio: Any, exponent: Any):
    """Return p [1] of exp(-p), the share of `stribeck_peak` that is left at a speed: |ratio|^exponent, ratio = speed /
    stribeck_speed [1].

    2: Gaussian (Armstrong-Helouvry 1994, Tustin's exponential is 1); see B. Armstrong-Helouvry, P. Dupont, C. Canudas
    de Wit, A survey of models ... for the control of machines with friction, Automatica 30 (1994).
    """
    power = ratio * ratio
    if exponent != type(ratio)(2.0):
        power = wp.pow(wp.abs(ratio), exponent)
    return power


@wp.func
def viscous(high: Any, more: Any, half: Any, v: Any):
    """Return friction per speed [N.m.s/rad] of grease that thins as it is sheared, at speed v [rad/s]: high + more /
    (1 + |v| / half), high: what is left of it at any speed, more: what is beyond that at rest, half: speed [rad/s]
    at which half of that is left.

    Cross's law of a shear-thinning fluid, with its exponent 1 (M. Cross, Rheology of non-Newtonian fluids: a new flow
    equation for pseudoplastic systems, J. Colloid Science 20, 1965). It is nowhere negative: with the speed of a step's
    begin here, and that of its end as the factor, it is stable whatever the step."""
    return high + more / (type(v)(1.0) + wp.abs(v) / half)


@wp.func
def load_share(torque: Any, v: Any, driving: Any, backdriven: Any):
    """Dry friction per motor torque [1] of a gear: `driving` where the motor drives the load (torque [N.m] and speed v
    [rad/s] agree), `backdriven` where the load drives the motor (they do not). The friction is this share of |torque|
    (P. Hamon, M. Gautier, P. Garrec, Dynamic identification of robots with a dry friction model depending on load and
    velocity, IROS 2010)."""
    share = driving
    if torque * v < type(v)(0.0):
        share = backdriven
    return share


@wp.func
def gear_friction(motor: Any, outside: Any, share: Any, share_outside: Any):
    """Dry friction [N.m] of a gear that carries `motor` [N.m] on one side and `outside` [N.m] on the other, each
    positive along the joint: |share_outside * outside - share * motor|.

    The two oppose each other where one drives the other: their shares then add up, and where both push the same way
    they relieve the gear. Equal shares are friction by |outside - motor| (M. Duclusaud, G. Passault, V. Padois, O. Ly,
    Extended friction models for the physics simulation of servo actuators, arXiv 2410.08650, 2024, section III; the
    shares weighted before they are subtracted, as in the authors' code)."""
    return wp.abs(share_outside * outside - share * motor)


@wp.func
def gear_load_friction(torque: Any, v: Any, driving: Any, backdriven: Any, power: Any, unit: Any):
    """Dry friction [N.m] of a gear by the torque [N.m] that it hands to the joint at speed v [rad/s] of the motor:
    `load_share` of it where that is linear (power 1), else share * unit * (|torque| / unit)^power, unit: a torque [N.m]
    at which the power does not matter. Ours, for a friction that grows faster or slower than its load."""
    share = load_share(torque, v, driving, backdriven)
    return share * unit * wp.pow(wp.abs(torque) / unit, power)


@wp.func
def opposed_square(motor: Any, outside: Any, per_motor: Any, per_outside: Any):
    """Dry friction [N.m] by the square of the smaller of two torques [N.m] that oppose each other: per_outside
    [1/(N.m)] * outside^2 while the motor drives (|outside| < |motor|), per_motor [1/(N.m)] * motor^2 while it is driven
    (|outside| > |motor|), else 0 (source: `gear_friction`, model M6)."""
    out = type(motor)(0.0)
    if motor * outside < type(motor)(0.0):
        if wp.abs(outside) < wp.abs(motor):
            out = per_outside * outside * outside
        elif wp.abs(outside) > wp.abs(motor):
            out = per_motor * motor * motor
    return out


@cache
def dry_friction(features: frozenset[str] = frozenset(), gone: float = math.inf) -> Any:
    """Return a drive's dry friction, as a sum of laws (terms of `steady`). gone: `stribeck_power` from which on nothing
    of the column `stribeck_peak` is left. How a level acts on the joint is told by `friction_acts`; that it sticks is
    the kernels' own."""
    own = added("dry_friction", features)

    @wp.func
    def friction(
        of: Any, q: Any, v: Any, motor: Any, outside: Any, carries: bool, warm: Any, memory: Any,
        fresh: bool, dt: Any,
    ):  # fmt: skip
        """Return (level [N.m], memory), the level as four parts of a sum: what neither speed nor load changes; what
        falls with speed; by the load; by the load and falling with speed. Four, since in finite precision a sum
        depends on its order, and each kernel keeps its own, so that results made before can be made again bit for bit.

        q, v: position [rad] of the joint and speed [rad/s] of the motor; motor: torque [N.m] of the step before;
        outside: what the joint felt from outside then; carries: whether that, or a column of the feature `load`,
        counts; warm: factor on all of it."""
        steady = warm * of[COULOMB]
        if wp.static(own is not None):
            steady += warm * own(of, q, v)
        fading = type(q)(0.0)
        share = warm * load_share(motor, v, of[LOAD], of[LOAD_BACK])
        loaded = share * wp.abs(motor)
        loaded_fading = type(q)(0.0)
        exponent = type(q)(2.0)
        if wp.static("shape" in features):
            exponent = of[STRIBECK_EXPONENT]
        if of[STRIBECK_PEAK] > type(q)(0.0) or carries:
            power = stribeck_power(v / of[STRIBECK_SPEED], exponent)
            fades = type(q)(0.0)
            if power < type(q)(gone) or carries:
                fades = wp.exp(-power)
            if power < type(q)(gone):
                fading = warm * of[STRIBECK_PEAK] * fades
            if carries:
                loaded = gear_friction(motor, outside, share, warm * of[LOAD_OUTSIDE])
                by_both = gear_friction(motor, outside, of[LOAD_PEAK], of[LOAD_PEAK_OUTSIDE])
                by_both += opposed_square(motor, outside, of[LOAD_SQUARE], of[LOAD_SQUARE_OUTSIDE])
                loaded_fading = warm * fades * by_both
        return wp.vector(steady, fading, loaded, loaded_fading), memory

    return friction


@cache
def friction_acts(features: frozenset[str] = frozenset()) -> Any:
    """Return how a level of dry friction (`dry_friction`) acts on the joint, as sums of laws of position, speed and
    what is remembered (friction that differs by direction at one side of the turn, a seal that gives way farther after
    a rest). What gives way needs the feature `presliding`."""

    @wp.func
    def acts(of: Any, q: Any, v: Any, memory: Any, fresh: bool, dt: Any):
        """Return ((uneven, give), memory) at position q [rad] of the joint and speed v [rad/s] of the motor. uneven:
        the level moving positive is 1 + uneven of the mean of both directions, moving negative 1 - uneven; give: how
        far the joint gives way before it slides [rad], 0 not at all (`preslide`)."""
        uneven = type(v)(0.5) * of[ASYMMETRY]
        give = type(v)(0.0)
        if wp.static("presliding" in features):
            give += of[PRESLIDING]
        return wp.vector(uneven, give), memory

    return acts


@wp.func
def preslide(taken: Any, turned: Any):
    """Share [1] of the dry friction that is taken up, -1 .. 1, after a turn: z' = (z + y) / (1 + |y|), y = turn /
    presliding [1].

    Dahl's law dz/dy = 1 - z sign(y) (P. Dahl, A solid friction model, 1968), taken implicitly over the turn."""
    return (taken + turned) / (type(taken)(1.0) + wp.abs(turned))


@wp.func
def preslide_slope(taken: Any, turned: Any):
    """Return slope [1] of `preslide` from no turn to this one, (z' - z) / y = (1 - z sign(y)) / (1 + |y|) >= 0: of a
    line in the turn that is right at both ends (source: there)."""
    ahead = taken  # what of it lies in the direction of the turn; from rest either way
    if turned < type(turned)(0.0):
        ahead = -taken
    elif turned == type(turned)(0.0):
        ahead = type(taken)(0.0)
    return (type(taken)(1.0) - ahead) / (type(taken)(1.0) + wp.abs(turned))


@wp.func
def preslide_speed(free: Any, a: Any, level: Any, taken: Any, w: Any):
    """Return speed v [rad/s] at the end of a step under friction level * z' (`preslide`): the root of a (v - free) +
    level z' = 0. Ours, for Dahl's law.

    a: inertia over the step, and all that is proportional to the speed [N.m.s/rad]; free: the speed without friction;
    level [N.m]; w = presliding / step: the speed that takes up all of the friction in one step."""
    turn = wp.sign(a * free - level * taken)
    f = turn * free
    y = turn * taken
    A = a * w
    B = A - a * f + level
    C = level * y - a * f
    root = wp.sqrt(wp.max(B * B - type(a)(4.0) * A * C, type(a)(0.0)))
    u = (root - B) / (type(a)(2.0) * A)
    if B > type(a)(0.0):
        u = -type(a)(2.0) * C / (B + root)
    return turn * w * wp.max(u, type(a)(0.0))


# -- ripple ------------------------------------------------------------------------------------------------------------


@wp.func
def ripple_wave(angle: Any, shape: Any):
    """Return (value, slope per rad) at an angle [rad] of a wave of amplitude 1 whose fundamental is +sin: shape 0
    sin(angle), 1 a sawtooth that rises through 0 at angle 0 and drops at pi, -1 one that falls through 0 at pi and
    jumps up at 0; mixtures between. Ours, for a wave that is no sine: a sawtooth's Fourier series has all harmonics."""
    value = wp.sin(angle)
    slope = wp.cos(angle)
    if shape != type(angle)(0.0):
        share = wp.abs(shape)
        half = type(angle)(3.141592653589793)
        turned = angle  # within -pi .. pi of where the sawtooth passes zero
        if shape < type(angle)(0.0):
            turned = angle - half
        turned = turned - type(angle)(2.0) * half * wp.floor((turned + half) / (type(angle)(2.0) * half))
        tooth = turned / half * wp.sign(shape)
        value = value + share * (tooth - value)
        slope = slope + share * (wp.sign(shape) / half - slope)
    return wp.vector(value, slope)


# -- what a drive adds by itself ---------------------------------------------------------------------------------------


@cache
def parasitic_torque(features: frozenset[str] = frozenset()) -> Any:
    """Return all torque of a drive that neither its motor is asked for nor is dry friction, as a sum of laws of
    position, speed and what is remembered."""
    own = added("parasitic_torque", features)

    @wp.func
    def parasitic(of: Any, q: Any, v: Any, memory: Any, fresh: bool, dt: Any):
        """Return ((torque [N.m], its slopes in position [N.m/rad] and in speed [N.m.s/rad]), memory) at position q
        [rad] of the joint and speed v [rad/s] of the motor, on whose side of a play or an elasticity it acts."""
        torque = type(q)(0.0)
        by_position = type(q)(0.0)
        by_speed = type(v)(0.0)
        if of[RIPPLE] != type(q)(0.0):
            form = type(q)(0.0)
            if wp.static("shape" in features):
                form = of[RIPPLE_SHAPE]
            wave = ripple_wave(of[RIPPLE_PER_TURN] * q + of[RIPPLE_PHASE], form)
            torque += of[RIPPLE] * wave[0]
            by_position += of[RIPPLE] * of[RIPPLE_PER_TURN] * wave[1]
        if wp.static(own is not None):
            more = own(of, q, v)
            torque += more[0]
            by_position += more[1]
            by_speed += more[2]
        return wp.vector(torque, by_position, by_speed), memory

    return parasitic


@wp.func
def stand_in(constant: Any, by_position: Any, by_speed: Any, by_square: Any, q: Any, v: Any):
    """Return (torque [N.m], its slope [N.m.s/rad] in the speed) that stands in for what is not known of a drive, at
    position q [rad] and speed v [rad/s] of the joint: constant + by_position q + (by_speed + by_square |v|) v. Ours,
    for the columns `standin_*`."""
    brake = by_speed + by_square * wp.abs(v)
    return wp.vector(constant + by_position * q + brake * v, brake)


# -- the controller ----------------------------------------------------------------------------------------------------
#
# tau_c = kp e - kd qd_m + speed_feedforward * r' + acceleration_feedforward * r'' + integral_gain * integral of e dt,
# e = r - q_m, r the target in force. r' and r'' are taken from the targets as a drive takes them, by `difference`.
#
# A cascade of a proportional position loop and a PI speed loop,
#     u = K_pp e + F r',    tau_c = K_vp (u - qd) + K_vi * integral of (u - qd) dt,
# is the same law with
#     kp = K_vp K_pp + K_vi F,  kd = K_vp,  speed_feedforward = K_vp F,  integral_gain = K_vi K_pp
# where F = 1 or K_vi = 0 (from rest at e = 0: the integral of r' - qd is e). Without feed-forward (F = 0) its integral
# holds -K_vi q, a term in q alone: kp = K_vp K_pp + K_vi then acts on -q, and only K_vp K_pp of it on r; that one is
# not expressed by these columns. A current loop below is the column `lag`. (G. Ellis, Control System Design Guide,
# 4th ed. 2012, chapter 17.)


@wp.func
def profiled(at: Any, speed: Any, target: Any, most: Any, acceleration: Any, dt: Any):
    """Return (setpoint [rad], its speed [rad/s]) after a step of dt [s] from `at` towards the target [rad]: at most at
    the speed `most` [rad/s], which changes by at most acceleration [rad/s2] * dt and comes to rest at the target.

    A trapezoid in discrete time: in k steps of a deceleration a the setpoint goes a dt^2 k (k + 1) / 2, so that the
    fastest from which it stops within |d| is a dt (sqrt(1/4 + 2 |d| / (a dt^2)) - 1/2). Ours."""
    away = target - at
    size = wp.abs(away)
    fast = wp.min(most, size / dt)
    step = acceleration * dt
    if acceleration < type(dt)(1.0e8):
        fast = wp.min(fast, step * (wp.sqrt(type(dt)(0.25) + type(dt)(2.0) * size / (step * dt)) - type(dt)(0.5)))
    wanted = wp.sign(away) * fast
    now = wanted
    if acceleration < type(dt)(1.0e8):
        now = speed + wp.clamp(wanted - speed, -step, step)
    return wp.vector(at + now * dt, now)


@cache
def lost_error(features: frozenset[str] = frozenset()) -> Any:
    """Return what of its error a loop does not act on, as a sum of laws of the target, the error and what is
    remembered (another dead zone, an error that is limited, a target that is rounded or smoothed, a position that the
    loop has filtered: terms of `lost` and `slope`)."""

    @wp.func
    def lost_of(of: Any, target: Any, e: Any, memory: Any, fresh: bool, dt: Any):
        """Return ((lost, slope, acts), memory): lost [rad] of the error e [rad] to a target [rad]; its slope in e at
        that target; acts: 0 no torque at all, 1 all but the error's, 2 all of it, that of the rest of the error.

        The setpoint (columns `profile_speed`, `profile_acceleration`): the loop acts on its error, not on the target's.
        It begins where the joint is, at its speed; where memory says -1 for `setpoint_new`, where that says.

        The deadband (columns `deadband`, `deadband_kind`): inside it 0 no torque at all, 1 the error counts as zero, 2
        it counts from the edge on."""
        lost = type(e)(0.0)
        slope = type(e)(0.0)
        acts = type(e)(2.0)
        kind = type(e)(0.0)
        error = e
        if wp.static("profile" in features):
            if of[PROFILE_SPEED] < type(e)(1.0e8) or of[PROFILE_ACCELERATION] < type(e)(1.0e8):
                now = wp.vector(target - e, type(e)(0.0))
                first = fresh and memory[SETPOINT_NEW] >= type(e)(0.0)
                if not first:
                    now = wp.vector(memory[SETPOINT], memory[SETPOINT_SPEED])
                    if memory[SETPOINT_NEW] > type(e)(0.5):
                        now = wp.vector(target - e, (target - e - memory[SETPOINT]) / dt)
                    most, gains = of[PROFILE_SPEED], of[PROFILE_ACCELERATION]
                    now = profiled(now[0], now[1], target, most, gains, dt)  # type: ignore[index]
                memory[SETPOINT] = now[0]  # type: ignore[index]
                memory[SETPOINT_SPEED] = now[1]  # type: ignore[index]
                memory[SETPOINT_NEW] = wp.where(first, type(e)(1.0), type(e)(0.0))
                mean = now[0]  # type: ignore[index]
                if of[PROFILE_ACCELERATION] >= type(e)(1.0e8):  # over the step, as of a target
                    mean -= type(e)(0.5) * now[1] * wp.abs(now[1]) * dt / of[PROFILE_SPEED]  # type: ignore[index]
                lost += target - mean
                error = e - lost
        if wp.static("rare" in features):
            kind = of[DEADBAND_KIND]
        width = of[DEADBAND]
        if kind > type(e)(1.5):
            lost += wp.clamp(error, -width, width)
        if wp.abs(error) < width:
            acts = type(e)(0.0)
            if kind > type(e)(0.5):
                acts = type(e)(1.0)
        return wp.vector(lost, slope, acts), memory

    return lost_of


@wp.func
def pd(e: Any, lost: Any, v: Any, v_end: Any, rate: Any, scale: Any, kp: Any, kd: Any, dt: Any, age: Any, share: Any):
    """Return (now, end, slope, error that counts [rad], acts) of kp e - kd qd_m: torque [N.m] now; at the end of a
    step of dt [s] at unchanged speed, kp (e - rate dt) - kd v_end; by how much less per speed of the motor gained
    until then [N.m.s/rad].

    e: error of the measured position [rad]; lost: what of it does not count (`lost_error`). v, v_end: measured speed
    that kd acts on, now and then [rad/s]; rate: measured speed of the position; scale: what the encoder shows over what
    turns; share: of a change of speed, what kd's filter passes in the step; age: of the position [s]. acts: as of
    `lost_error`. The paper's law (`kernel.py`), backward Euler ours."""
    now = kp * e - kd * v
    end = kp * e - kd * v_end - kp * dt * rate
    slope = scale * (kp * (dt - age) + share * kd)
    now -= kp * lost[0]
    end -= kp * lost[0]
    end += kp * dt * rate * lost[1]
    slope -= scale * kp * (dt - age) * lost[1]
    counts = e - lost[0]
    acts = lost[2]
    if acts < type(e)(1.5):
        counts = type(e)(0.0)
        now = type(e)(0.0)
        end = type(e)(0.0)
        slope = type(e)(0.0)
        if acts > type(e)(0.5):
            now = -kd * v
            end = -kd * v_end
            slope = scale * share * kd
    return wp.vector(now, end, slope, counts, acts)


@wp.func
def other_terms(answer: Any, feed: Any, integral: Any, gain: Any, rate: Any, scale: Any, dt: Any):
    """Return (now, end, slope) of `pd`'s answer with the torque of the feed-forward and the integral term
    [N.m]; the
    integral goes on over the step: + gain * dt * (e - rate dt), gain = `integral_gain` (source: above)."""
    now = answer[0]
    end = answer[1]
    slope = answer[2]
    if answer[4] > type(dt)(0.5):
        now += feed + integral
        end += feed + integral
    if answer[4] > type(dt)(1.5):
        end += gain * dt * (answer[3] - dt * rate)
        slope += scale * gain * dt * dt
    return wp.vector(now, end, slope)


@wp.func
def feed_forward(by_speed: Any, by_acceleration: Any, speed: Any, acceleration: Any):
    """Return the torque [N.m] of the feed-forward: speed_feedforward * r' + acceleration_feedforward * r'', of a
    target's speed [rad/s] and acceleration [rad/s2] (source: above)."""
    return by_speed * speed + by_acceleration * acceleration


# intervals between targets for which their speed counts, if no other target comes: one may be late
HOLDS = wp.constant(2.0)
SHORTEST = wp.constant(1.0e-3)  # of a step: targets nearer in time than this are one


@wp.func
def difference(new: Any, old: Any, span: Any, dt: Any):
    """Return backward difference (new - old) / span [rad/s, rad/s2] of two targets [rad], or of two of their speeds,
    span [s] apart; 0 for a jump in no time. By definition of what a drive can take from its targets; the bound is
    ours."""
    rate = type(new)(0.0)
    if span > type(dt)(SHORTEST) * dt:
        rate = (new - old) / span
    return rate


@wp.func
def hold(stamp: Any, span: Any, until: Any, begin: Any, dt: Any):
    """Share of the step [begin, begin + dt] in which a target's speed is in force, (min(until, stamp + HOLDS span) -
    max(stamp, begin)) / dt >= 0: from the target's time `stamp` to `until` (the step's end, or the next target), for at
    most HOLDS times the interval `span` that it was taken over [s]. Ours."""
    end = wp.min(until, stamp + type(span)(HOLDS) * span)
    return wp.max(end - wp.max(stamp, begin), type(dt)(0.0)) / dt


@wp.func
def wind(integral: Any, step: Any, answer: Any, lower: Any, upper: Any):
    """Return the integral term [N.m] after a step of integral_gain * e * dt: it waits while the torque asked for,
    with it, is beyond the limits -lower .. upper and the step would take it further (conditional integration: K.
    Astrom, T. Hagglund, PID Controllers, 2nd ed. 1995, section 3.5)."""
    if (answer > upper and step > type(step)(0.0)) or (answer < -lower and step < type(step)(0.0)):
        return integral
    return integral + step
