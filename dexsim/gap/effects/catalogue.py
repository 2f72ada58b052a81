"""The catalogue of effects: what each is in plain words, what leaves its trace, what it is confused with, how it is fitted.

An effect offers variants for a joint: parameters of the plant with physical bounds, and where to start. Ids and
parameter keys are those of `diagnosis.json`. To add an effect: an entry here, its lines in `plant_kernel.py` (and the
servo table, where training is to have it too).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from dexsim.gap.search.fit import Param


@dataclass(frozen=True)
class Scales:
    """Typical sizes of one joint's motion, from which bounds and starts follow (SI; N, m for a slide).

    tau: large motor torque; demand: largest torque asked for; speed: large speed; peak_speed; error: large position
    error of the loop; stiffness: torque per position error; inertia, gravity: of the joint; span: range of motion;
    sigma: noise of the position; nominal: believed plant parameters by name; others: other joints that moved;
    load_torque, load_inertia: of one kg on the last link; warm: spread of the temperature [degC], 0 where unknown.
    """

    tau: float
    demand: float
    speed: float
    peak_speed: float
    error: float
    stiffness: float
    inertia: float
    gravity: float
    span: float
    sigma: float
    nominal: dict[str, float]
    others: tuple[str, ...]
    others_torque: float
    load_torque: float
    load_inertia: float
    tilt: dict[str, float]
    warm: float
    slide: bool
    voltage: bool
    effort: bool
    saturates: float  # share of samples at the believed limit
    base_friction: float = 0.0
    base_damping: float = 0.0
    armature: float = 0.0
    own_torque: float = 0.0  # of one kg on the joint's own link; 0 where that is the last
    own_inertia: float = 0.0
    leaf_mass: float = 0.0  # kg: of the last link, and of the joint's own
    own_mass: float = 0.0


@dataclass(frozen=True)
class Variant:
    """One way an effect may be there: its parameters, starts [n][P], and constants set on the plant."""

    params: tuple[Param, ...]
    starts: tuple[tuple[float, ...], ...]
    label: str = ""
    fixed: tuple[tuple[str, float], ...] = ()
    note: dict = field(default_factory=dict)
    refines: bool = False  # adds parameters to the first variant: tried only where that one was found
    dear: float = 0.0  # of the loss: by as much it must do better than simpler effects that it can imitate


@dataclass(frozen=True)
class Effect:
    """An entry: id, what it is (a phrase after "joint X ..."), where it shows, how its variants are made.

    report: fitted values by Param key -> {key: (value, unit)} in the ids of `diagnosis.json`.
    """

    id: str
    words: str
    shows: str
    variants: Callable[[Scales], list[Variant]]
    experiment: str
    columns: tuple[str, ...] = ()  # servo columns it writes


CONFUSED: tuple[frozenset[str], ...] = tuple(
    frozenset(x)
    for x in (
        ("backlash", "stribeck_friction", "coulomb_friction"),
        ("command_delay", "lag"),
        ("viscous_friction", "torque_speed_limit", "gain_mismatch"),
        ("current_sensor", "payload", "gain_mismatch"),
        ("coulomb_friction", "load_friction"),
        ("supply_sag", "torque_speed_limit", "thermal"),
        ("position_offset", "payload"),
        ("tactile_gain", "contact_stiffness"),
    )
)
"""Classes of effects that some recordings cannot tell apart (the only sets that may be reported)."""


RINGS = (0.1, 0.3)  # damping ratios of a transmission that are tried: whether a loop rattles with it hangs on them
LIGHTEST = 0.95  # of a link's believed mass: what may be taken away at most
MIN_WARMTH = 2.0  # degC: a smaller change of temperature tells nothing


def _p(key, column, mode, low, high, start=0.0, unit="1"):
    return Param(key, (column,) if isinstance(column, str) else tuple(column), mode, float(low), float(high), float(start), unit)


def _coulomb(s: Scales) -> list[Variant]:
    nominal = s.nominal["coulomb_friction"]
    top = max(1.2 * s.demand, 3 * nominal, 1e-9)
    torque = _p("torque", "coulomb_friction", "set", 0.0, top, nominal, "N.m")
    asymmetry = _p("asymmetry", "friction_asymmetry", "set", -1.5, 1.5)
    starts = [(nominal + f * s.tau, 0.0) for f in (0.015, 0.03, 0.06, 0.12, 0.22, 0.4)]
    if nominal > 0.02 * s.tau:
        starts.append((0.5 * nominal, 0.0))
    starts += [(nominal + 0.1 * s.tau, 0.8), (nominal + 0.1 * s.tau, -0.8)]
    return [Variant((torque, asymmetry), tuple(starts))]


def _stribeck(s: Scales) -> list[Variant]:
    peak = _p("peak", "stribeck_peak", "set", 0.0, 1.2 * s.demand, 0.0, "N.m")
    v_s = _p("v_s", "stribeck_speed", "set", 0.003 * s.speed, 0.35 * s.speed, 0.1 * s.speed, "rad/s")
    return [Variant((peak, v_s), tuple((a * s.tau, b * s.speed) for a in (0.03, 0.08, 0.2, 0.45) for b in (0.02, 0.08, 0.25)))]


def _viscous(s: Scales) -> list[Variant]:
    nominal, unit = s.nominal["viscous_friction"], s.tau / s.speed
    starts = [(nominal + f * unit,) for f in (0.02, 0.05, 0.1, 0.2, 0.4, 0.8)]
    if nominal > 0.03 * unit:
        starts.append((0.5 * nominal,))
    top = max(3 * unit, 4 * nominal)
    return [Variant((_p("coefficient", "viscous_friction", "set", 0.0, top, nominal, "N.m.s/rad"),), tuple(starts))]


def _load_friction(s: Scales) -> list[Variant]:
    drive = _p("fraction", "load_friction", "set", 0.0, 0.95, s.nominal["load_friction"])
    back = _p("fraction_backdriven", "load_friction_backdriven", "set", 0.0, 3.0, s.nominal["load_friction_backdriven"])
    return [Variant((drive, back), ((0.04, 0.05), (0.1, 0.12), (0.2, 0.25), (0.35, 0.35), (0.3, 0.8)))]


def _backlash(s: Scales) -> list[Variant]:
    top = min(0.5 * s.span, 60 * s.error + 30 * s.sigma)
    low = min(3.0 * s.sigma, 0.1 * top)  # less cannot be told from the plant's own inaccuracy
    gap = _p("gap", "backlash", "set", low, top, low, "m" if s.slide else "rad")
    starts = sorted({min(f * s.sigma, 0.8 * top) for f in (4.0, 7.0, 12.0, 20.0, 40.0, 70.0, 120.0)})
    rebound = _p("rebound", "rebound", "set", 0.02, 0.7, 0.1)
    params, extra = (gap, rebound), ()
    if s.armature <= 0:  # how much of the inertia is the rotor's is not known
        params, extra = (*params, _p("rotor", "rotor", "set", 0.05 * s.inertia, 0.95 * s.inertia, 0.3 * s.inertia)), (0.3 * s.inertia,)
    return [Variant(params, tuple((x, ring, *extra) for x in starts for ring in RINGS))]


def _compliance(s: Scales) -> list[Variant]:
    # not stiffer than a tenth of the loop's own spring is softness that leaves no trace
    top = 3.0 / s.stiffness
    soft = _p("softness", "softness", "set", 0.04 / s.stiffness, top, 0.04 / s.stiffness, "rad/N.m")
    hard = _p("hardening", "hardening", "set", 0.0, 8.0 / s.tau**2, 0.0, "1/(N.m)2")
    ring = _p("rebound", "rebound", "set", 0.02, 0.7, 0.1)
    starts = tuple((0.4 / s.stiffness, 0.1, h / s.tau**2) for h in (0.1, 0.5, 2.5))
    sizes = tuple((f / s.stiffness, r) for f in (0.06, 0.1, 0.15, 0.25, 0.4, 0.65, 1.0, 1.7) for r in RINGS)
    return [Variant((soft, ring), sizes), Variant((soft, ring, hard), starts, "hardening", refines=True)]


def _delay(s: Scales) -> list[Variant]:
    delay = _p("delay", "delay", "add", -s.nominal["delay"], 0.2, 0.0, "s")
    return [Variant((delay,), ((0.003,), (0.006,), (0.012,), (0.02,), (0.035,), (0.08,)))]


def _lag(s: Scales) -> list[Variant]:
    out = [Variant((_p("time_constant", "lag", "set", 0.0, 0.3, s.nominal["lag"], "s"),), ((0.003,), (0.006,), (0.012,), (0.025,), (0.06,)), "drive")]
    if s.nominal["kd"] > 0:
        out.append(Variant((_p("time_constant", "speed_lag", "set", 0.0, 0.3, 0.0, "s"),), ((0.006,), (0.012,), (0.03,), (0.08,)), "velocity filter", note={"of": "speed"}))
    return out


def _torque_limit(s: Scales) -> list[Variant]:
    believed = s.nominal["torque_limit"]
    top = min(believed, 8 * s.demand)  # one in a thousand moments asks for far more than the rest, and it is there that a limit shows
    low = 0.05 * s.demand
    if top <= low or s.voltage:
        top = believed * 1.0
    limit = _p("torque", "torque_limit", "set", min(low, 0.5 * top), top, top, "N.m")
    sizes = [f * min(s.demand, believed) for f in (0.95, 0.88, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2)] + [f * top for f in (0.9, 0.78, 0.65, 0.5, 0.35)]
    starts = sorted({round(max(x, 1.05 * low), 12) for x in sizes if x < top}, reverse=True)
    return [Variant((limit,), tuple((x,) for x in starts))] if starts else []


def _speed_limit(s: Scales) -> list[Variant]:
    believed = s.nominal["no_load_speed"]
    top = min(believed, 30 * s.peak_speed)
    low = min(0.3 * s.peak_speed, 0.8 * top)
    speed = _p("no_load_speed", "no_load_speed", "set", low, top, top, "rad/s")
    starts = [x for x in (0.7 * s.peak_speed, 0.9 * s.peak_speed, 1.1 * s.peak_speed, 1.6 * s.peak_speed, 2.3 * s.peak_speed, 3.5 * s.peak_speed,
                                0.9 * believed, 0.8 * believed, 0.65 * believed) if low < x < top]
    return [Variant((speed,), tuple((x,) for x in starts))] if starts else []


def _sag(s: Scales) -> list[Variant]:
    if not s.others or s.others_torque <= 0:
        return []
    top = 0.9 / s.others_torque
    sag = _p("sag", "sag", "set", 0.0, 1.5 * top, 0.0, "1/N.m")  # at the others' peaks nothing of the supply may be left
    return [Variant((sag,), tuple((f * top,) for f in (0.02, 0.05, 0.1, 0.2, 0.4, 0.7)))]


def _ripple(s: Scales) -> list[Variant]:
    out = []
    for turns in (1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 14, 16, 18, 20, 24, 28, 32, 36, 42, 48, 56, 64, 80, 100):
        period = 2 * np.pi / turns
        if not s.slide and 1.2 * s.span > period > 6 * s.sigma:
            params = (
                _p("amplitude", "torque_ripple", "set", 0.0, 1.2 * s.tau, 0.0, "N.m"),
                # a gear's own periods are whole numbers a turn of the joint; those of a motor before it are many, and ranges overlap
                _p("per_turn", "ripple_per_turn", "set", turns * (0.98 if turns < 8 else 0.85), turns * (1.02 if turns < 8 else 1.17), turns),
                _p("phase", "ripple_phase", "set", -6.3, 6.3, 0.0, "rad"),
            )
            a = 0.1 * s.tau
            starts = tuple((a, float(turns), ph) for ph in (0.0, np.pi / 2, np.pi, -np.pi / 2))
            out.append(Variant(params, starts, f"{turns} a turn"))
    return out


def _thermal(s: Scales) -> list[Variant]:
    if s.warm < MIN_WARMTH:
        return []
    out = []
    for of, column in (("torque_constant", "thermal_torque"), ("friction", "thermal_friction"), ("resistance", "thermal_resistance")):
        if of == "resistance" and not s.voltage:
            continue
        if of == "friction" and not (s.nominal["coulomb_friction"] > 0 or s.nominal["viscous_friction"] > 0):
            continue
        top = min(0.03 if of != "friction" else 0.1, 0.7 / s.warm)
        # copper gains 0.39 % of resistance per degree: ten times that is a proxy of something else
        # friction may grow several times over; what falls cannot fall below nothing
        low, high = (0.0, 0.008) if of == "resistance" else (-top, top) if of != "friction" else (-min(0.1, 0.95 / s.warm), min(0.1, 2.5 / s.warm))
        p = _p("per_degree", column, "set", low, high, 0.0, "1/degC")
        starts = tuple((f,) for f in ((0.25 * high, 0.7 * high) if low == 0 else (-0.5 * top, -0.15 * top, 0.15 * top, 0.5 * high)))
        out.append(Variant((p,), starts, of, note={"of": of}))
    return out


def _coupling(s: Scales) -> list[Variant]:
    out = []
    for k, other in enumerate(s.others[:4]):
        fixed, note = (("coupling_from", float(k)),), {"from_joint": other}
        # its target is dragged along; a linkage between motor, joint and the other; and that linkage's pull at its other end
        for column, label, starts in (("coupling", other, (0.02, 0.15)), ("linkage", f"linkage with {other}", (0.05, 0.4)), ("reaction", f"pull of {other}", (0.1,))):
            p = _p("ratio", column, "set", -1.0, 1.0)
            out.append(Variant((p,), tuple((sign * x,) for x in starts for sign in (-1, 1)), label, fixed, note))
    return out


def _offset(s: Scales) -> list[Variant]:
    if s.gravity < 0.02 * s.tau:
        return []
    p = _p("offset", "position_offset", "add", -0.6, 0.6, 0.0, "m" if s.slide else "rad")
    return [Variant((p,), ((-0.2,), (-0.07,), (-0.02,), (0.02,), (0.07,), (0.2,)))]


def _scale(s: Scales) -> list[Variant]:
    out = [Variant((_p("scale", "position_scale", "set", 0.7, 1.4, 1.0),), ((0.85,), (0.94,), (0.98,), (1.02,), (1.06,), (1.15,)), "scale")]
    if not s.slide and s.span > 0.5:
        e = min(0.2, 0.3 * s.span)
        params = (_p("ecc_sin", "eccentric_sin", "set", -e, e, 0.0, "rad"), _p("ecc_cos", "eccentric_cos", "set", -e, e, 0.0, "rad"))
        out.append(Variant(params, ((0.2 * e, 0.0), (-0.2 * e, 0.0), (0.0, 0.2 * e), (0.0, -0.2 * e)), "eccentricity"))
        # its zero may have been set anywhere along the turn, and not where the model has it
        params = (params[0], _p("ecc_cos", ("eccentric_cos", "position_offset"), "add", -e, e, 0.0, "rad"))
        out.append(Variant(params, ((0.05 * e, 0.2 * e), (-0.05 * e, -0.2 * e), (0.2 * e, 0.2 * e), (-0.2 * e, 0.2 * e)), "eccentricity, its zero elsewhere", dear=0.08))
    return out


def _payload(s: Scales) -> list[Variant]:
    out = []
    unit = s.tau / max(s.load_torque, 1e-9) if s.load_torque * s.inertia > 0.05 * s.tau * s.load_inertia else np.inf
    unit = min(unit, 3 * s.inertia / max(s.load_inertia, 1e-12))
    if np.isfinite(unit) and s.load_torque > 0.02 * s.gravity:
        # a link may be believed heavier by all but a little of what it is said to weigh
        least = -max(0.3 * unit, LIGHTEST * s.leaf_mass)
        mass = _p("mass", "payload", "set", least, 2.0 * unit, 0.0, "kg")
        out.append(Variant((mass,), (*((f * unit,) for f in (0.03, 0.08, 0.2, 0.5, 1.0, -0.06, -0.15)), (0.4 * least,)), "mass"))
        reach = np.sqrt(s.load_inertia)  # of the last link's centre from the hinge
        if not s.slide and reach > 1e-3:
            params = (_p("mass", "payload", "set", 0.0, 2.0 * unit, 0.0, "kg"), _p("com_out", "com_out", "set", -1.2 * reach, 1.2 * reach, 0.0, "m"),
                      _p("com_across", "com_across", "set", -1.2 * reach, 1.2 * reach, 0.0, "m"))  # fmt: skip
            starts = tuple((f * unit, a * reach, b * reach) for f in (0.1, 0.4) for a, b in ((0.0, 0.5), (0.0, -0.5), (-0.4, 0.0), (0.4, 0.0)))
            out.append(Variant(params, starts, "mass and its centre"))
    if s.own_torque > 0.02 * s.gravity and s.own_inertia > 0:
        unit = min(s.tau / s.own_torque, 3 * s.inertia / s.own_inertia)
        mass = _p("mass", "own_payload", "set", -max(0.3 * unit, LIGHTEST * s.own_mass), 2.0 * unit, 0.0, "kg")
        out.append(Variant((mass,), tuple((f * unit,) for f in (0.05, 0.3, -0.1)), "mass on its own link", note={"own": True}))
    for letter, size in s.tilt.items():
        if size > 0.05 * s.tau * 0.1 and size > 0.2 * max(s.tilt.values()):
            p = _p(f"tilt_{letter}", f"tilt_{letter}", "set", -0.8, 0.8, 0.0, "rad")
            out.append(Variant((p,), ((-0.2,), (-0.07,), (-0.02,), (0.02,), (0.07,), (0.2,)), f"tilt {letter}"))
    return out


def _inertia(s: Scales) -> list[Variant]:
    p = _p("armature", "armature", "add", -0.7 * s.inertia, 6.0 * s.inertia, 0.0, "kg" if s.slide else "kg.m2")
    return [Variant((p,), tuple((f * s.inertia,) for f in (0.08, 0.2, 0.5, 1.2, 3.0, -0.1, -0.3)))]


def _gain(s: Scales) -> list[Variant]:
    params = [_p("kp_factor", "kp", "factor", 0.25, 4.0, 1.0)]
    starts = [(0.6,), (0.8,), (0.91,), (1.1,), (1.3,), (1.7,)]
    if s.nominal["kd"] > 0:
        params.append(_p("kd_factor", "kd", "factor", 0.1, 6.0, 1.0))
        starts = [(x[0], 1.0) for x in starts] + [(1.0, 0.5), (1.0, 0.8), (1.0, 1.25), (1.0, 1.8), (1.0, 3.0)]
    return [Variant(tuple(params), tuple(starts))]


def _deadband(s: Scales) -> list[Variant]:
    top = max(2.5 * s.error, 6 * s.sigma)
    p = _p("width", "deadband", "set", 0.0, top, 0.0, "m" if s.slide else "rad")
    starts = tuple((f * top,) for f in (0.01, 0.02, 0.04, 0.07, 0.12, 0.2, 0.3, 0.45, 0.65))
    kinds = (("no torque inside", 0.0), ("damped inside", 1.0), ("counted from its edge", 2.0))
    return [Variant((p,), starts, label, (("deadband_kind", k),)) for label, k in kinds if k != 1.0 or s.nominal["kd"] > 0]


def _current(s: Scales) -> list[Variant]:
    if not s.effort:
        return []
    gain = _p("gain", "effort_gain", "set", -1.5, 3.0, 1.0)
    offset = _p("offset", "effort_offset", "set", -s.tau, s.tau, 0.0, "N.m")
    return [Variant((gain, offset), ((0.7, 0.0), (1.3, 0.0), (1.0, 0.1 * s.tau), (1.0, -0.1 * s.tau), (-1.0, 0.0)))]


CATALOGUE: tuple[Effect, ...] = (
    Effect("coulomb_friction", "has more (or less) dry friction than believed", "at reversals and low speed", _coulomb,
           "slow triangles in both directions at constant load", ("coulomb_friction", "friction_asymmetry")),
    Effect("stribeck_friction", "needs a breakaway torque above its sliding friction", "at speeds between zero and v_s", _stribeck,
           "very slow ramps from rest, and the same faster", ("stribeck_peak", "stribeck_speed")),
    Effect("viscous_friction", "has friction that grows with speed", "at high speed", _viscous, "constant speeds from slow to fast",
           ("viscous_friction",)),
    Effect("load_friction", "has friction that grows with the load on its gear", "at high load", _load_friction,
           "the same slow motion under two or more loads", ("load_friction", "load_friction_backdriven")),
    Effect("backlash", "has free play between motor and joint", "when the load changes sign", _backlash,
           "small steps about a pose without load, both encoders logged if there are two", ("backlash",)),
    Effect("compliance", "has an elastic transmission", "at high load and at 5-30 Hz", _compliance, "a chirp of 1-30 Hz", ()),
    Effect("command_delay", "acts on its commands later than believed", "in proportion to speed", _delay, "steps and a fast chirp", ("delay",)),
    Effect("lag", "builds its torque up with a lag", "at high acceleration", _lag, "steps and a fast chirp", ("lag",)),
    Effect("torque_limit", "gives less torque than believed when it saturates", "at saturation", _torque_limit,
           "large steps against a load", ("torque_limit",)),
    Effect("torque_speed_limit", "runs out of torque at a lower speed than believed", "at high speed and torque", _speed_limit,
           "large steps at full speed", ("no_load_speed",)),
    Effect("supply_sag", "loses supply while other joints load it", "while other joints work", _sag,
           "this joint moving alone, then with the others loaded", ("supply",)),
    Effect("torque_ripple", "has a torque ripple that repeats with position", "periodically in position", _ripple,
           "slow constant speed over the whole range", ("torque_ripple", "ripple_per_turn", "ripple_phase")),
    Effect("thermal", "changes as it warms up", "with temperature", _thermal, "the same motion cold and warm, in random order"),
    Effect("joint_coupling", "is dragged along by another joint", "while that joint moves", _coupling,
           "one joint at a time, the others held"),
    Effect("position_offset", "has an encoder zero error", "with the pose", _offset, "static poses over the whole range", ("position_offset",)),
    Effect("position_scale", "has an encoder that is not linear in the position", "with the pose", _scale,
           "the full range against a protractor or the stops", ("position_scale",)),
    Effect("payload", "carries another mass (or another direction of gravity) than the model", "with the pose, also at rest", _payload,
           "static poses over the whole range, and the same turned over"),
    Effect("inertia", "has more (or less) inertia than the model", "at high acceleration", _inertia, "steps and a fast chirp"),
    Effect("gain_mismatch", "runs on other gains than believed", "with the size of the error", _gain,
           "steps of several sizes against a known load", ("kp", "kd")),
    Effect("deadband", "ignores small position errors", "at small errors", _deadband, "small steps of increasing size", ("deadband",)),
    Effect("current_sensor", "shows its effort with a wrong gain or offset", "in the effort alone", _current, "a hold under a known load"),
)  # fmt: skip
EFFECTS: dict[str, Effect] = {e.id: e for e in CATALOGUE}


SEPARATED = (
    "small reversals about a pose while a load holds the joint to one side, then without it, and very slow ramps (both encoders logged if there are two)",
    "steps of two sizes and a fast chirp: a delay shifts the motion, a lag rounds it",
    "constant speeds from slow to fast, and steps against a known load",
    "static poses while a known weight is held",
    "the same slow motion under two or more loads",
    "this joint alone, then with the others loaded, cold and warm in random order",
    "static poses over the whole range, and the same with the mechanism turned over: what gravity does changes sign, an encoder's zero stays",
)
"""What tells the members of a class of `CONFUSED` apart, in its order (touch has its own, see `touch_effects`)."""


def separating(effects: Sequence[str]) -> str:
    """The experiment that tells effects of one class apart; the first one's own where they are of none."""
    for members, experiment in zip(CONFUSED, SEPARATED, strict=False):
        if set(effects) <= members:
            return experiment
    return EFFECTS[effects[0]].experiment


def confusable(a: str, b: str) -> bool:
    """Whether two effects are of one class that some recordings cannot separate."""
    return any(a in c and b in c for c in CONFUSED)
