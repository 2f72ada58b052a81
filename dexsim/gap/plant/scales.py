"""Typical sizes of one joint's motion, which set where fits of effects begin and end."""

from __future__ import annotations

from dataclasses import dataclass


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
    apart: bool = False  # the loop reads the motor's encoder, and what is reported is the joint's
