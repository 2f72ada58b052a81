"""Parameters of one joint in the gap's own plant: its columns (the servo's, then what the servo table does not hold),
what is prescribed along a trajectory, and the numbers that are fitted, each to the columns that it acts on, between
bounds that follow from typical sizes of the motion.

Every column has a neutral value at which it is not there, as in `dexsim.actuator.columns`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dexsim.actuator.columns import COLUMNS as SERVO_COLUMNS
from dexsim.gap.rules import BELIEF

if TYPE_CHECKING:
    from dexsim.gap.plant.batch import JointPlant
    from dexsim.gap.plant.case import Case

EXTRA: tuple[tuple[str, float, str, str], ...] = (
    # name, neutral, unit, meaning
    ("inertia_scale", 1.0, "1", "factor on the model's inertia about the joint"),
    ("gravity_scale", 1.0, "1", "factor on the model's gravity torque"),
    ("armature", 0.0, "kg.m2", "reflected rotor inertia beyond the model's"),
    ("payload", 0.0, "kg", "mass added at the centre of mass of the last link"),
    ("own_payload", 0.0, "kg", "the same on the joint's own link, where others follow it"),
    ("tilt_x", 0.0, "rad", "gravity turned about the world's x"),
    ("tilt_y", 0.0, "rad", "gravity turned about the world's y"),
    ("tilt_z", 0.0, "rad", "gravity turned about the world's z"),
    (
        "linkage",
        0.0,
        "1",
        "the same where the link is tied to its motor and the other joint: the motor turns by as much, with its rotor "
        "and friction",
    ),
    ("reaction", 0.0, "1", "the other end of a linkage: share of another joint's load that pulls on this one"),
    (
        "feedback_delay",
        0.0,
        "s",
        "age of the position that the loop acts on: it is sampled, and its torque holds until the next sample",
    ),
    (
        "limit_speed",
        0.5,
        "1",
        "speed that the torque limit falls with: 0 the motor's, 1 what the loop takes for it (they part with play, "
        "elasticity, scale, filter)",
    ),
    (
        "sag_torque",
        0.0,
        "1/N.m",
        "share of all that a torque drive gives (gains, limit, speed) lost per N.m of the other joints' motors: where "
        "it sets a voltage it weakens with its supply",
    ),
    ("sag_own", 0.0, "1/N.m", "the same per N.m of its own motor"),
    (
        "motor_share",
        0.0,
        "1",
        "share of the model's friction and damping of the joint that acts on the motor where play or elasticity parts "
        "the two; the rest acts on the joint",
    ),
    ("bias", 0.0, "N.m", "constant torque on the joint"),
    ("spring", 0.0, "N.m/rad", "stiffness of a spring at the joint, beyond the model's"),
    ("spring_preload", 0.0, "N.m", "its torque at joint zero, towards smaller positions"),
    ("effort_gain", 1.0, "1", "shown effort over motor torque (used by the fit, not by the motion)"),
    ("effort_offset", 0.0, "N.m", "added to the shown effort"),
    (
        "effort_fresh",
        0.0,
        "1",
        "0: the shown effort is the one that acts, 1: the one that the loop would ask for at that moment",
    ),
    ("readout_scale", 1.0, "1", "reported over what the encoder shows, where the loop has another encoder"),
    ("readout_offset", 0.0, "rad", "added to what is reported, where the loop has another encoder"),
    (
        "lag_stages",
        1.0,
        "1",
        "equal first-order stages in a row that share the column `lag` between them: 1, or 2 for a lag of second order",
    ),
    ("com_out", 0.0, "m", "centre of the added mass, out from the hinge beyond the last link's centre of mass"),
    ("com_across", 0.0, "m", "the same, along the way it turns"),
    ("gear_load_friction", 0.0, "1", "dry friction per torque that the gear hands to the joint, where it drives it"),
    ("gear_load_friction_backdriven", 0.0, "1", "the same where the joint drives the gear"),
    ("gear_load_power", 1.0, "1", "both are shares of unit * (|torque| / unit)^power; 2/3: Hertz's contact"),
    ("gear_load_unit", 1.0, "N.m", "that unit"),
    ("late_by", 0.0, "s", "all commands act later by as much: what their clock is off, no delay of the drive"),
)

NAMES: tuple[str, ...] = tuple(c.name for c in SERVO_COLUMNS) + tuple(e[0] for e in EXTRA)
INDEX: dict[str, int] = {name: i for i, name in enumerate(NAMES)}
NEUTRAL: np.ndarray = np.array([c.neutral for c in SERVO_COLUMNS] + [e[1] for e in EXTRA])
NOT_NEGATIVE: tuple[int, ...] = tuple(
    INDEX[name] for name in ("coulomb_friction", "viscous_friction", "delay", "backlash", "softness", "deadband")
)
"""Columns that no sum of a belief and a correction may take below 0, where the plant's laws mean nothing."""

# What the mechanism and the recording prescribe along a joint's trajectory, on the integration grid.
SERIES: tuple[str, ...] = (
    "q", "v",  # smoothed measured motion of the joint itself
    "inertia",  # about the joint, the model's armature included
    "gravity_cos", "gravity_sin",  # gravity bias torque = cos * cos(q - q_meas) + sin * sin(q - q_meas)
    "rest",  # bias torque of the other joints' motion (Coriolis, coupling inertia) and springs
    "load_inertia", "load_cos", "load_sin",  # the same of a unit mass on the last link
    "own_inertia", "own_cos", "own_sin",  # and on the joint's own link; 0 where that is the last
    "tilt_x_cos", "tilt_x_sin", "tilt_y_cos", "tilt_y_sin", "tilt_z_cos", "tilt_z_sin",  # per rad of tilt
    "supply",  # measured supply over nominal
    "others_torque",  # sum of the other joints' |motor torque|, N.m
    "warmth",  # temperature above the reference, degC
    "enabled",
    # what the added mass's place adds: per kg.m, inertia linear in the place
    "com_out_cos", "com_out_sin", "com_out_inertia",
    "com_across_cos", "com_across_sin", "com_across_inertia",
    "drag0", "drag1", "drag2", "drag3",  # motion of the joints that may drag this one, from its first sample, rad
    "drag_v0", "drag_v1", "drag_v2", "drag_v3", "drag_a0", "drag_a1", "drag_a2", "drag_a3",  # its rate and acceleration
    "pull0", "pull1", "pull2", "pull3",  # torque on those joints' links that their own motors give, N.m
)  # fmt: skip
DRAGGERS = 4  # joints that may drag one, of which a plant knows the motion
SERIES_INDEX: dict[str, int] = {name: i for i, name in enumerate(SERIES)}

# parameters that say what an effect is like, not how large it is
SHAPES = ("v_s", "half_speed", "per_turn", "phase", "rebound", "rotor")


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
    unknown: tuple[str, ...] = ()  # servo columns of which nothing is believed
    base_friction: float = 0.0
    base_damping: float = 0.0
    armature: float = 0.0
    own_torque: float = 0.0  # of one kg on the joint's own link; 0 where that is the last
    own_inertia: float = 0.0
    leaf_mass: float = 0.0  # kg: of the last link, and of the joint's own
    own_mass: float = 0.0
    velocity_loop: bool = False  # its damping acts on the error of the speed
    apart: bool = False  # the loop reads the motor's encoder, and what is reported is the joint's

    @property
    def damping(self) -> tuple[str, ...]:
        """Return the columns that the loop's damping is in."""
        return ("kd", "speed_feedforward") if self.velocity_loop else ("kd",)

    @property
    def effort_zero(self) -> float:
        """What a reading of the effort may be off by at rest (N.m, N for a slide)."""
        return BELIEF.effort_zero * (self.nominal["torque_limit"] if self.nominal["torque_limit"] < 1e8 else self.tau)


@dataclass(frozen=True)
class Param:
    """One number that is fitted. `key` is unique in a fit; it acts on plant columns [.., R, C].

    mode: `factor` multiplies the believed value, `add` adds to it, `set` replaces it, `inverse` sets 1 / x.
    """

    key: str
    columns: tuple[str, ...]
    mode: str
    low: float
    high: float
    start: float
    unit: str = "1"
    nuisance: bool = False
    sd: float = (
        0.0  # what is believed of it beforehand: its start to this standard deviation; 0: nothing inside the bounds
    )
    late: bool = False  # let go where a fit of the others ends (`Fitter.fit`)

    @property
    def span(self) -> float:
        return self.high - self.low

    def unit_on(self, slide: bool) -> str:
        """Return its unit on a joint that turns, or slides."""
        return self.unit.replace("N.m", "N").replace("rad", "m").replace("kg.m2", "kg") if slide else self.unit

    def apply(self, params: np.ndarray, x: np.ndarray, base: np.ndarray) -> None:
        """Writes x [H] into params [H, R, C], base [R, C] being what is believed."""
        for name in self.columns:
            c = INDEX[name]
            if self.mode == "factor":
                params[:, :, c] = params[:, :, c] * x[:, None]
            elif self.mode == "add":
                params[:, :, c] = params[:, :, c] + x[:, None]
            elif self.mode == "inverse":
                params[:, :, c] = 1.0 / np.maximum(x[:, None], 1e-12)
            else:
                params[:, :, c] = x[:, None]


def expand(
    plant: JointPlant, params: list[Param], x: np.ndarray, fixed: Sequence[tuple[str, float]] = ()
) -> np.ndarray:
    """Return [H, R, C] plant parameters of the guesses x [H, P]: what replaces first, factors and additions after;
    fixed: constants (column, value) that stand in the place of what is believed."""
    base = plant.base()
    for name, value in fixed:
        base[:, INDEX[name]] = value
    out = np.repeat(base[None], len(x), 0)
    for modes in (("set", "inverse"), ("factor", "add")):
        for i, p in enumerate(params):
            if p.mode in modes:
                p.apply(out, x[:, i], base)
    for c in (INDEX["stribeck_speed"], INDEX["thinning_speed"]):
        out[:, :, c] = np.maximum(out[:, :, c], 1e-4)
    for c in NOT_NEGATIVE:
        out[:, :, c] = np.maximum(out[:, :, c], 0.0)
    return out


def neutral_of(param: Param, case: Case) -> float:
    """Return value of a parameter at which its effect is not there."""
    if param.mode == "add":
        return 0.0
    if param.mode == "factor":
        return 1.0
    name = param.columns[0]
    return float(case.scales.nominal.get(name, NEUTRAL[INDEX[name]]))


def at_bound(params: Sequence[Param], values: dict[str, float], case: Case) -> str:
    """Return key of a parameter that stopped at a bound of what is physical; empty where none did."""
    for p in params:
        if p.key in ("phase", "rebound", "rotor"):
            continue
        zero = neutral_of(p, case)
        for bound in (p.low, p.high):
            away = abs(bound - zero)
            # a fit comes to rest a little before a bound; where an effect begins near one, it may be as small
            room = (0.01 if away > 0.25 * p.span else 1e-3) * p.span
            if away > room and abs(values[p.key] - bound) <= room:
                return p.key
    return ""
