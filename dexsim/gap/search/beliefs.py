"""What is refitted with every hypothesis: believed figures within their tolerance, stated ranges, what nobody knows."""

from __future__ import annotations

from dexsim.gap.effects.catalogue import CATALOGUE
from dexsim.gap.effects.presliding import give
from dexsim.gap.plant.case import BELIEF, PHYSICAL, Case
from dexsim.gap.plant.columns import Param, Scales

USUAL = (
    "kp",
    "kd",
    "torque_limit",
    "no_load_speed",
    "efficiency",
    "coulomb_friction",
    "viscous_friction",
    "load_friction",
    "load_friction_backdriven",
    "lag",
    "delay",
    "stribeck_peak",
    "stribeck_speed",
    "friction_asymmetry",
    "deadband",
    "position_offset",
    "position_scale",
    "speed_lag",
    "backlash",
    "softness",
)
WITH_OTHERS = (
    "torque_ripple",
    "ripple_per_turn",
    "ripple_phase",
    "deadband_kind",
    "coupling",
    "coupling_from",
    "warmth",
)
LATE = 0.75  # periods of its loop by which any drive may act on its commands late
ZERO = 2.0  # counts of an encoder by which its zero may be off
EFFORT_ZERO = 0.01  # of the torque limit: what a reading of the effort may be off by at rest
FILTER = 3e-3  # s: a filter of the measured speed that any drive may have


def unknown(name: str, s: Scales) -> tuple[Param, list[float]] | None:
    """How a servo column that is said to be unknown is fitted with every hypothesis, as the effect that writes it would
    be, and from where. None where no effect does, or where the column says nothing without others (`WITH_OTHERS`): it
    is taken as absent, and the effect looked for."""
    if name in WITH_OTHERS:
        return None
    for effect in CATALOGUE:
        for v in effect.variants(s):
            for i, p in enumerate(v.params):
                if p.columns == (name,):
                    starts = list(dict.fromkeys(x[i] for x in v.starts))
                    return Param(
                        name, p.columns, p.mode, p.low, p.high, starts[min(1, len(starts) - 1)], p.unit, nuisance=True
                    ), starts
    return None


def refitted(case: Case) -> list[Param]:
    """What is refitted with every hypothesis: believed figures inside +- 5 %, stated ranges, unknowns."""
    c, s = case, case.scales
    out = []
    for name in (*USUAL, *(n for n in c.unknown if n not in USUAL)):
        value = s.nominal[name]
        if name in c.unknown:
            guess = unknown(name, s)
            if guess is not None:
                out.append(guess[0])
        elif name in c.ranges:
            low, high = c.ranges[name]
            if name in ("kp", "kd") or (value > 0 and name in ("torque_limit", "no_load_speed")):
                out.append(Param(name, (name,), "factor", low / value, high / value, 1.0, nuisance=True))
            else:
                out.append(Param(name, (name,), "set", low, high, value, nuisance=True))
        elif (
            name
            in (
                "kp",
                "kd",
                "torque_limit",
                "no_load_speed",
                "coulomb_friction",
                "viscous_friction",
                "load_friction",
                "load_friction_backdriven",
                "stribeck_peak",
            )
            and 0 < value < 1e8
        ):
            out.append(Param(name, (name,), "factor", 1 - BELIEF, 1 + BELIEF, 1.0, nuisance=True, sd=0.5 * BELIEF))
    rate = c.loop_rate or 1000.0
    taken = {p.columns[0] for p in out}
    # a command waits for the loop's next period, half of one on average, and a clock is read when it is read; more is
    # an effect, which
    # training is given
    if "delay" not in taken:
        d, most = (
            s.nominal["delay"],
            (LATE if c.loop_rate else 2 * LATE) / rate,
        )  # of a loop that nothing is known of, twice as much
        out.append(
            Param(
                "delay",
                ("delay",),
                "add",
                -min(d, most),
                most,
                0.0,
                "s",
                nuisance=True,
                sd=most / (3 if c.loop_rate else 2),
            )
        )
    if "lag" not in taken:
        out.append(
            Param(
                "lag",
                ("lag",),
                "add",
                0.0,
                1.0 / rate,
                0.25 / rate,
                "s",
                nuisance=True,
                sd=(0.25 if c.loop_rate else 0.5) / rate,
            )
        )
    # a drive tells its speed from its encoder through some filter
    if s.nominal["kd"] > 0 and "speed_lag" not in taken:
        f, most = s.nominal["speed_lag"], max(FILTER, 2.0 / rate)
        out.append(
            Param(
                "speed_lag",
                ("speed_lag",),
                "set",
                max(f - most, 0.0),
                f + most,
                f + 1.0 / rate,
                "s",
                nuisance=True,
                sd=0.3 * FILTER,
            )
        )
    # what it acts on was sampled up to a period ago, and acts until the next sample: half a period on average
    out.append(
        Param(
            "feedback_delay", ("feedback_delay",), "set", 0.0, 1.5 / rate, 0.5 / rate, "s", nuisance=True, sd=0.5 / rate
        )
    )
    # what holds a joint gives a little before it slides
    small = give(s)
    out.append(Param("presliding", ("presliding",), "set", 0.0, small, 0.1 * small, nuisance=True))
    if not s.voltage and s.nominal["no_load_speed"] < 1e8:
        if "braking_slope" not in taken and "braking_slope" not in c.stated:
            out.append(Param("braking_slope", ("braking_slope",), "set", -1.0, 1.0, PHYSICAL, nuisance=True))
        if s.nominal["kd"] > 0:  # a limit of the motor, or of a firmware that goes by its own reading
            out.append(Param("limit_speed", ("limit_speed",), "set", 0.0, 1.0, 0.5, nuisance=True))
    low, high = c.factors.get("inertia", (1 - BELIEF, 1 + BELIEF))
    out.append(
        Param(
            "inertia",
            ("inertia_scale",),
            "factor",
            low,
            high,
            0.5 * (low + high),
            nuisance=True,
            sd=0.25 * (high - low),
        )
    )
    if s.gravity > 0.01 * s.tau:
        out.append(
            Param("gravity", ("gravity_scale",), "factor", 1 - BELIEF, 1 + BELIEF, 1.0, nuisance=True, sd=0.5 * BELIEF)
        )
    if c.constants.damping > 0:
        d = BELIEF * c.constants.damping
        out.append(Param("damping", ("viscous_friction",), "add", -d, d, 0.0, nuisance=True))
    if c.constants.friction > 0 or c.constants.damping > 0:
        # on which side of a play a model's friction acts it does not say; without a play it makes no difference
        out.append(Param("motor_share", ("motor_share",), "set", 0.0, 1.0, 0.5, nuisance=True))
    if s.apart:  # two encoders have two zeros, set to a count or two
        z = ZERO * max(c.quantum, c.sigma)
        out.append(Param("zero", ("readout_offset",), "add", -z, z, 0.0, nuisance=True, sd=0.5 * z))
    if c.sigma_torque > 0:
        o = EFFORT_ZERO * (s.nominal["torque_limit"] if s.nominal["torque_limit"] < 1e8 else s.tau)
        out.append(Param("effort_zero", ("effort_offset",), "add", -o, o, 0.0, nuisance=True, sd=0.5 * o))
        out.append(
            Param(
                "effort_gain", ("effort_gain",), "factor", 1 - BELIEF, 1 + BELIEF, 1.0, nuisance=True, sd=0.5 * BELIEF
            )
        )
        # a drive may show what it last asked for, or what acts meanwhile
        out.append(Param("effort_fresh", ("effort_fresh",), "set", 0.0, 1.0, 0.5, nuisance=True))
    return out
