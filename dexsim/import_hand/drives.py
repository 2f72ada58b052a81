"""What an MJCF file says of a hand's drives: gains, torques, and what of it is not used."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

OF_JOINT = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)  # the same of a hinge and of a slide


@dataclass
class Pull:
    """An actuator that pulls a tendon of fixed coefficients. arms: [m, or 1] by joint, so that it stands at
    sum(arm * q); range: of that, or None."""

    name: str
    arms: dict[str, float]
    range: tuple[float, float] | None


@dataclass
class Drives:
    """By joint, or by name of a pull: effort [N m], kp [N m/rad], kd [N m s/rad], at the joint (N, N/m, N s/m of a
    slide), delay [s]; notes: what of the actuators was not used, a line each. pulls: actuators that pull a tendon;
    moved: joints that have a drive."""

    effort: dict[str, float] = field(default_factory=dict)
    kp: dict[str, float] = field(default_factory=dict)
    kd: dict[str, float] = field(default_factory=dict)
    delay: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    pulls: list[Pull] = field(default_factory=list)
    moved: set[str] = field(default_factory=set)


def read(spec: mujoco.MjSpec) -> Drives:
    """Return the drives of a model's joints, seen at the joint: of an actuator with gear g, torques times g, gains
    times g^2.

    Several actuators on one joint add up: `position` beside `velocity` is a PD drive.
    """
    out = Drives()
    skipped: dict[str, list[str]] = {}
    drums: dict[str, str] = {}  # by tendon, what pulls it

    def leave(what: str, name: str) -> None:
        skipped.setdefault(what, []).append(name)

    for k, a in enumerate(spec.actuators):
        name = a.name or a.target or f"actuator {k}"
        at, tendon = a.target, spec.tendon(a.target) if a.trntype == mujoco.mjtTrn.mjTRN_TENDON else None
        if tendon is not None and (arms := fixed_arms(tendon)):
            at = drums.setdefault(a.target, name if spec.joint(name) is None else f"{name}_drive")
            ends = np.array(tendon.range, float) if tendon.limited != 0 else np.zeros(2)
            if not np.ptp(ends) and a.biasprm[1] < 0 and a.ctrllimited != 0 and a.gear[0]:  # commands are lengths
                ends = np.sort(np.array(a.ctrlrange, float) * a.gainprm[0] / (-a.biasprm[1] * a.gear[0]))
            if all(p.name != at for p in out.pulls):
                out.pulls.append(Pull(at, arms, (float(ends[0]), float(ends[1])) if np.ptp(ends) else None))
        elif a.trntype not in OF_JOINT or spec.joint(a.target) is None:
            leave("actuators that do not turn a joint", name)
            continue
        else:
            out.moved.add(at)
        if a.delay > 0:
            out.delay[at] = float(a.delay)
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
        if tendon is not None and tendon.actfrclimited != 0 and np.abs(tendon.actfrcrange).max() > 0:
            most = float(np.abs(tendon.actfrcrange).max())
            reach = min(reach, most) if reach else most
        if reach > 0:
            out.effort[at] = out.effort.get(at, 0.0) + reach
        if affine:
            if bias[1] < 0:
                out.kp[at] = out.kp.get(at, 0.0) - bias[1] * gear**2
                if not np.isclose(gain[0], -bias[1]):
                    leave("a gain that is not kp", name)
            if bias[2] < 0:
                out.kd[at] = out.kd.get(at, 0.0) - bias[2] * gear**2
            elif bias[2] > 0:
                leave("dampratio", name)
            if bias[0]:
                leave("a constant force", name)
            joint = spec.joint(a.target)
            if joint is not None and bias[1] < 0 and a.ctrllimited != 0 and np.ptp(a.ctrlrange) > 0 and gear:
                ends = np.sort(np.array(a.ctrlrange, float) / gear)
                span = np.ptp(np.array(joint.range, float))
                turn = np.degrees(1.0) if _degrees(spec) and joint.type == mujoco.mjtJoint.mjJNT_HINGE else 1.0
                if span > 0 and np.abs(ends * turn - np.array(joint.range, float)).max() > 0.01 * span:
                    leave("ctrlrange (commands reach the joint's own range)", name)
        if a.armature or np.any(a.damping):
            leave("armature and damping of actuators", name)
        if a.dyntype != mujoco.mjtDyn.mjDYN_NONE:
            leave("the time constant of a filter", name)
    out.notes = [f"not used: {what}: {', '.join(names)}" for what, names in skipped.items()]
    return out


def within(pulls: Iterable[Pull], m: mujoco.MjModel, names: set[str]) -> list[Pull]:
    """Return the pulls of a hand's joints `names`: what a tendon passes before the palm stands still, as drawn."""
    out = []
    for p in pulls:
        arms = {j: c for j, c in p.arms.items() if j in names}
        still = sum(c * float(m.qpos0[m.joint(j).qposadr[0]]) for j, c in p.arms.items() if j not in names)
        if arms:
            out.append(Pull(p.name, arms, p.range and (p.range[0] - still, p.range[1] - still)))
    return out


def fixed_arms(tendon: Any) -> dict[str, float]:
    """Return coefficients by joint of a tendon; empty for one that is routed over sites and geoms."""
    out: dict[str, float] = {}
    for wrap in tendon.path:
        try:
            target = wrap.target
        except (AttributeError, TypeError, ValueError):  # a pulley has none
            return {}
        if not isinstance(target, mujoco.MjsJoint):
            return {}
        out[target.name] = out.get(target.name, 0.0) + float(wrap.coef)
    return out


def _degrees(spec: mujoco.MjSpec) -> bool:
    return bool(spec.compiler.degree)


def contacts(spec: mujoco.MjSpec) -> list[str]:
    """Return a line for what the file says of contact: dexsim's law of contact, and what tasks draw, take its place."""
    plain = mujoco.MjSpec().worldbody.add_geom()
    names = ("friction", "solref", "solimp", "condim", "margin", "gap")
    solid = [g for g in spec.geoms if g.contype or g.conaffinity]
    said = [name for name in names if any(not np.allclose(getattr(g, name), getattr(plain, name)) for g in solid)]
    return [f"not used: {', '.join(said)} of the file's shapes: dexsim has its own law of contact"] if said else []


def unused(spec: mujoco.MjSpec) -> list[str]:
    """Return lines for what the file says of joints, links and what ties them, and dexsim's hand does not have."""
    plain = mujoco.MjSpec()
    law = ("solref_limit", "solimp_limit", "solref_friction", "solimp_friction")
    groups = (
        ("joints", spec.joints, plain.worldbody.add_body().add_joint(), ("margin", *law, "actgravcomp")),
        ("tendons", spec.tendons, plain.add_tendon(), ("margin", *law)),
        ("equalities", spec.equalities, plain.add_equality(), ("solref", "solimp")),
    )
    out = []
    for kind, items, usual, attributes in groups:
        for what in attributes:
            names = [x.name or getattr(x, "name1", "") for x in items
                     if not np.allclose(getattr(x, what), getattr(usual, what))]  # fmt: skip
            if names:
                said = what.replace("solref_", "solref").replace("solimp_", "solimp")
                out.append(f"not used: {said} of {kind} {', '.join(names)}")
    for what in ("stiffness", "damping"):
        names = [j.name for j in [*spec.joints, *spec.tendons] if np.any(np.ravel(getattr(j, what))[1:])]
        if names:
            out.append(f"not used: the higher terms of {what} of {', '.join(names)}")
    floating = [b.name for b in spec.bodies if b.gravcomp]
    return out + ([f"not used: gravcomp of links {', '.join(floating)}"] if floating else [])
