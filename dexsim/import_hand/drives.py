"""What an MJCF file says of a hand's drives: gains, torques, and what of it is not used."""

from __future__ import annotations

from dataclasses import dataclass, field

import mujoco
import numpy as np


@dataclass
class Drives:
    """By joint: effort [N m], kp [N m/rad], kd [N m s/rad], at the joint (N, N/m, N s/m of a slide); notes: what of the
    actuators was not used, a line each."""

    effort: dict[str, float] = field(default_factory=dict)
    kp: dict[str, float] = field(default_factory=dict)
    kd: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def read(spec: mujoco.MjSpec) -> Drives:
    """The drives of a model's joints, seen at the joint: of an actuator with gear g, torques times g, gains times g^2.

    Several actuators on one joint add up: `position` beside `velocity` is a PD drive.
    """
    out = Drives()
    unused: dict[str, list[str]] = {}

    def leave(what: str, name: str) -> None:
        unused.setdefault(what, []).append(name)

    for k, a in enumerate(spec.actuators):
        name = a.name or a.target or f"actuator {k}"
        if a.trntype != mujoco.mjtTrn.mjTRN_JOINT or spec.joint(a.target) is None:
            leave("actuators that do not turn a joint", name)
            continue
        gear = float(a.gear[0])
        gain, bias = np.array(a.gainprm, float), np.array(a.biasprm, float)
        affine = a.biastype == mujoco.mjtBias.mjBIAS_AFFINE
        if a.gaintype != mujoco.mjtGain.mjGAIN_FIXED or not (affine or a.biastype == mujoco.mjtBias.mjBIAS_NONE):
            leave("the law of actuators that are neither motor, position nor velocity", name)
            continue
        reach = 0.0
        if a.forcelimited != 0 and np.abs(a.forcerange).max() > 0:
            reach = float(np.abs(a.forcerange).max()) * abs(gear)
        if not affine and a.ctrllimited != 0 and np.abs(a.ctrlrange).max() > 0:
            most = float(np.abs(a.ctrlrange).max() * abs(gain[0] * gear))
            reach = min(reach, most) if reach else most
        if reach > 0:
            out.effort[a.target] = out.effort.get(a.target, 0.0) + reach
        if affine:
            if bias[1] < 0:
                out.kp[a.target] = out.kp.get(a.target, 0.0) - bias[1] * gear**2
                if not np.isclose(gain[0], -bias[1]):
                    leave("a gain that is not kp", name)
            if bias[2] < 0:
                out.kd[a.target] = out.kd.get(a.target, 0.0) - bias[2] * gear**2
            elif bias[2] > 0:
                leave("dampratio", name)
            if bias[0]:
                leave("a constant force", name)
            joint = spec.joint(a.target)
            if bias[1] < 0 and a.ctrllimited != 0 and np.ptp(a.ctrlrange) > 0 and gear:
                ends = np.sort(np.array(a.ctrlrange, float) / gear)
                span = np.ptp(np.array(joint.range, float))
                turn = np.degrees(1.0) if _degrees(spec) and joint.type == mujoco.mjtJoint.mjJNT_HINGE else 1.0
                if span > 0 and np.abs(ends * turn - np.array(joint.range, float)).max() > 0.01 * span:
                    leave("ctrlrange (commands reach the joint's own range)", name)
        if a.dyntype != mujoco.mjtDyn.mjDYN_NONE:
            leave("the time constant of a filter", name)
    out.notes = [f"not used: {what}: {', '.join(names)}" for what, names in unused.items()]
    return out


def _degrees(spec: mujoco.MjSpec) -> bool:
    return bool(spec.compiler.degree)


def contacts(spec: mujoco.MjSpec) -> list[str]:
    """A line for what the file says of contact: dexsim's law of contact, and what tasks draw, take its place."""
    plain = mujoco.MjSpec().worldbody.add_geom()
    names = ("friction", "solref", "solimp", "condim", "margin", "gap")
    solid = [g for g in spec.geoms if g.contype or g.conaffinity]
    said = [name for name in names if any(not np.allclose(getattr(g, name), getattr(plain, name)) for g in solid)]
    return [f"not used: {', '.join(said)} of the file's shapes: dexsim has its own law of contact"] if said else []


def joints(spec: mujoco.MjSpec) -> list[str]:
    """Lines for what the file says of joints and links and dexsim's hand does not have."""
    plain = mujoco.MjSpec().worldbody.add_body().add_joint()
    out = []
    for what in ("margin", "solref_limit", "solimp_limit", "solref_friction", "solimp_friction", "actgravcomp"):
        names = [j.name for j in spec.joints if not np.allclose(getattr(j, what), getattr(plain, what))]
        if names:
            out.append(f"not used: {what.replace('solref_', 'solref').replace('solimp_', 'solimp')} of joints"
                       f" {', '.join(names)}")  # fmt: skip
    for what in ("stiffness", "damping"):
        names = [j.name for j in spec.joints if np.any(np.ravel(getattr(j, what))[1:])]
        if names:
            out.append(f"not used: the higher terms of {what} of joints {', '.join(names)}")
    floating = [b.name for b in spec.bodies if b.gravcomp]
    return out + ([f"not used: gravcomp of links {', '.join(floating)}"] if floating else [])
