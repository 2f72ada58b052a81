"""What the drive moves: inertia, mass and gravity, a spring at the joint, a push from outside."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects import Effect, FittedEffect, Variant, entry, param
from dexsim.gap.effects.signals import PositionOffset
from dexsim.gap.finding import Finding
from dexsim.gap.plant.columns import Scales

if TYPE_CHECKING:
    import mujoco

    from dexsim.gap.plant.case import Case


MOST_INERTIA = 30.0  # x the model's about the joint: the most that is looked for beyond it


class Inertia(Effect):
    """Another inertia of the rotor or the link than the model's."""

    id = "inertia"
    words = "has more (or less) inertia than the model"
    shows = "at high acceleration"
    experiment = "steps and a fast chirp"
    motions = ("chirp",)
    from_poses = True
    model_columns = ("armature",)

    def variants(self, s: Scales) -> list[Variant]:
        # a rotor's inertia counts with the square of its gear's ratio: beside a model that has none of it, it may be
        # many times a light link's
        top = MOST_INERTIA * s.inertia
        p = param("armature", "armature", "add", -0.7 * s.inertia, top, 0.0, "kg" if s.slide else "kg.m2")
        return [Variant((p,), tuple((f * s.inertia,) for f in (0.08, 0.2, 0.5, 1.2, 3.0, 8.0, 20.0, -0.1, -0.3)))]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return case.regimes["acceleration"]

    def said(self, finding: Finding, believed: dict[str, float]) -> str:
        return self.words.replace("more (or less)", "more" if finding.parameters["armature"]["value"] > 0 else "less")

    def to_model(self, spec: mujoco.MjSpec, case: Case, values: dict[str, float], note: dict) -> list[str]:
        return [add_armature(spec, case.joint, values["armature"])]


def add_armature(spec: mujoco.MjSpec, joint: str, inertia: float) -> str:
    """Adds an inertia [kg.m2, kg for a slide] to a joint's armature, which becomes none at the least; returns what was
    done, in words."""
    armature = float(np.ravel(spec.joint(joint).armature)[0]) + inertia
    spec.joint(joint).armature = max(armature, 0.0)
    if armature >= 0:
        return f"model.xml: armature of {joint} is {armature:.3g}"
    return (
        f"{joint} has {-inertia:.3g} kg.m2 less inertia than the model's links and armature together; change its "
        "links' inertia"
    )


HEAVIEST = 3.0  # x the mass of all that a joint moves: a payload beyond it is something else
LIGHTEST = 0.95  # of a link's believed mass: what may be taken away at most


class Payload(Effect):
    """Another mass on the links than the model's, or another direction of gravity."""

    id = "payload"
    words = "carries another mass (or another direction of gravity) than the model"
    shows = "with the pose, also at rest"
    experiment = "static poses over the whole range, and the same turned over"
    classes = ("static load", "zero or gravity", "weight or push")
    motions = ("holds",)
    kinds = 2
    from_poses = True
    model_columns = ("payload", "own_payload", "com_out", "com_across")

    def variants(self, s: Scales) -> list[Variant]:
        out = []
        unit = s.tau / max(s.load_torque, 1e-9) if s.load_torque * s.inertia > 0.05 * s.tau * s.load_inertia else np.inf
        unit = min(unit, 3 * s.inertia / max(s.load_inertia, 1e-12))
        if np.isfinite(unit) and s.load_torque > 0.02 * s.gravity:
            # a link may be believed heavier by all but a little of what it is said to weigh
            least = -max(0.3 * unit, LIGHTEST * s.leaf_mass)
            mass = param("mass", "payload", "set", least, 2.0 * unit, 0.0, "kg")
            out.append(
                Variant(
                    (mass,), (*((f * unit,) for f in (0.03, 0.08, 0.2, 0.5, 1.0, -0.06, -0.15)), (0.4 * least,)), "mass"
                )
            )
            reach = np.sqrt(s.load_inertia)  # of the last link's centre from the hinge
            if not s.slide and reach > 1e-3:
                params = (
                    param("mass", "payload", "set", 0.0, 2.0 * unit, 0.0, "kg"),
                    param("com_out", "com_out", "set", -1.2 * reach, 1.2 * reach, 0.0, "m"),
                    param("com_across", "com_across", "set", -1.2 * reach, 1.2 * reach, 0.0, "m"),
                )
                starts = tuple(
                    (f * unit, a * reach, b * reach)
                    for f in (0.1, 0.4)
                    for a, b in ((0.0, 0.5), (0.0, -0.5), (-0.4, 0.0), (0.4, 0.0))
                )
                out.append(Variant(params, starts, "mass and its centre"))
        if s.own_torque > 0.02 * s.gravity and s.own_inertia > 0:
            unit = min(s.tau / s.own_torque, 3 * s.inertia / s.own_inertia)
            mass = param("mass", "own_payload", "set", -max(0.3 * unit, LIGHTEST * s.own_mass), 2.0 * unit, 0.0, "kg")
            out.append(
                Variant(
                    (mass,), tuple((f * unit,) for f in (0.05, 0.3, -0.1)), "mass on its own link", note={"own": True}
                )
            )
        for letter, size in s.tilt.items():
            if size > 0.05 * s.tau * 0.1 and size > 0.2 * max(s.tilt.values()):
                p = param(f"tilt_{letter}", f"tilt_{letter}", "set", -0.8, 0.8, 0.0, "rad")
                out.append(Variant((p,), ((-0.2,), (-0.07,), (-0.02,), (0.02,), (0.07,), (0.2,)), f"tilt {letter}"))
        return out

    def unseen(self, s: Scales) -> str:
        return "" if self.variants(s) else "neither gravity nor the inertia of the last link shows at the joint"

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        m = case.regimes
        return np.abs(m["_added_own" if note.get("own") else "_added"] if "mass" in values else m["_gravity"])

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        if "mass" in fit.value:
            out = {"mass": fit.entry("mass", "kg")}
            return out | ({"com": centre_of_mass(fit.case, fit.value, fit.interval)} if "com_out" in fit.value else {})
        keys = [f"tilt_{k}" for k in "xyz"]
        return {
            "tilt": {
                "value": [float(fit.value.get(k, 0.0)) for k in keys],
                "low": [float(fit.interval.get(k, (0.0, 0.0))[0]) for k in keys],
                "high": [float(fit.interval.get(k, (0.0, 0.0))[1]) for k in keys],
                "unit": "rad",
            }
        }

    def said(self, finding: Finding, believed: dict[str, float]) -> str:
        p = finding.parameters
        if "mass" in p:
            return f"carries {'more' if p['mass']['value'] > 0 else 'less'} mass than the model"
        return "hangs in another direction of gravity than the model"

    def impossible(self, values: dict[str, float], case: Case) -> str:
        mass, carried = values.get("mass", 0.0), case.constants.carried
        return (
            f"{mass:.3g} kg more are no payload of a joint whose links weigh {carried:.3g} kg"
            if mass > HEAVIEST * carried > 0
            else ""
        )

    def excludes(self, mine: Variant, other: Effect, theirs: Variant) -> bool:
        # the same turn, once of the encoder and once of gravity
        return mine.label.startswith("tilt") and isinstance(other, PositionOffset)

    def to_model(self, spec: mujoco.MjSpec, case: Case, values: dict[str, float], note: dict) -> list[str]:
        if not values.get("mass"):
            return []
        place = None
        if "com_out" in values:
            c = case.constants
            assert c.places is not None  # such a variant is only of a joint that has them
            place = c.centre + values["com_out"] * c.places[0] + values["com_across"] * c.places[1]
        return [add_mass(spec, case.joint, values["mass"], place, bool(note.get("own")))]


def centre_of_mass(case: Case, raw: dict[str, float], spread: dict[str, tuple[float, float]]) -> dict[str, Any]:
    """Return [3] m: where the added mass sits in the last link's frame, with its interval. Along the hinge the joint
    feels nothing: there it is taken to sit as the link's own centre does."""
    c = case.constants
    assert c.places is not None  # such a variant is only of a joint that has them
    value = c.centre + raw["com_out"] * c.places[0] + raw["com_across"] * c.places[1]
    half = np.sqrt(
        sum((0.5 * np.ptp(spread[k]) * way) ** 2 for k, way in zip(("com_out", "com_across"), c.places, strict=True))
    )
    lists = {
        k: [round(float(v), 6) for v in x] for k, x in (("value", value), ("low", value - half), ("high", value + half))
    }
    return lists | {"unit": "m"}


def add_mass(spec: mujoco.MjSpec, joint: str, mass: float, place: np.ndarray | None, own: bool = False) -> str:
    """Adds a point mass [kg] (or takes it away) at `place` [3] m in the frame of the last link after a joint (own: of
    the joint's own), by default at that link's centre of mass; returns what was done, in words."""
    import mujoco

    from dexsim.gap.plant.mechanics import leaf_of

    model = spec.compile()
    body = int(model.jnt_bodyid[model.joint(joint).id])
    leaf = body if own else leaf_of(model, body)
    name, m0, c0 = (
        model.body(leaf).name or f"the link of {joint}",
        float(model.body_mass[leaf]),
        model.body_ipos[leaf].copy(),
    )
    place = c0 if place is None else np.asarray(place, float)
    if m0 + mass < 0.05 * m0:
        return f"{joint} carries {-mass:.3g} kg less than the model's links after it; change their masses"
    flat = np.zeros(9)
    mujoco.mju_quat2Mat(flat, model.body_iquat[leaf])
    rotation = flat.reshape(3, 3)
    centre = (m0 * c0 + mass * place) / (m0 + mass)
    inertia = rotation @ np.diag(model.body_inertia[leaf]) @ rotation.T
    for m, r in ((m0, c0 - centre), (mass, place - centre)):
        inertia += m * (r @ r * np.eye(3) - np.outer(r, r))
    values, axes = np.linalg.eigh(inertia)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, axes.ravel())
    body = next(b for b in spec.bodies if b.id == leaf)  # names may be missing
    body.fullinertia = [np.nan] * 6  # not given: principal axes instead
    body.explicitinertial, body.mass, body.ipos, body.iquat, body.inertia = (
        True,
        m0 + mass,
        centre,
        quat,
        np.maximum(values, 1e-12),
    )
    where = "" if np.allclose(place, c0) else f" at {' '.join(f'{x:.4f}' for x in place)} m in its frame"
    return f"model.xml: {mass:.3g} kg {'added to' if mass > 0 else 'on'} {name}{where}"


STIFFEST = 12.0  # x the joint's large torque over its range of motion: stiffer, it would hardly have moved


class JointSpring(Effect):
    """A spring at the joint that the model lacks: torque -(stiffness * q + preload), as MuJoCo's joint stiffness with
    springref = -preload / stiffness."""

    id = "joint_spring"
    words = "is pulled towards a position by a spring that the model lacks"
    shows = "with the position, also at rest"
    experiment = "static poses over the whole range, and the drive off at each"
    classes = ("static load", "friction or pull")
    motions = ("holds",)
    also_sizes = ("preload",)
    from_poses = True
    model_columns = ("spring", "spring_preload")

    def variants(self, s: Scales) -> list[Variant]:
        unit = s.tau / s.span
        if s.stiffness > unit:
            return []
        stiffness = param("stiffness", "spring", "set", 0.0, STIFFEST * unit, 0.0, "N/m" if s.slide else "N.m/rad")
        preload = param("preload", "spring_preload", "set", -2.0 * s.tau, 2.0 * s.tau, 0.0, "N" if s.slide else "N.m")
        starts = ((0.1, 0.0), (0.3, 0.0), (0.3, 0.2), (0.3, -0.2), (0.8, 0.0), (0.8, 0.4), (0.8, -0.4), (1.6, 0.0))
        return [Variant((stiffness, preload), tuple((k * unit, p * s.tau) for k, p in starts))]

    def unseen(self, s: Scales) -> str:
        return "" if self.variants(s) else (
            "its loop holds the joint stiffer than a spring that it can work against, and gains and gravity within "
            "their tolerance do what a spring would"
        )

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return np.abs(values["stiffness"] * case.regimes["position"] + values["preload"])

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        out = super().parameters(fit)
        k, at = fit.value["stiffness"], fit.value["preload"]
        if fit.interval["stiffness"][0] > 0:
            ends = [-p / c for c in fit.interval["stiffness"] for p in fit.interval["preload"]]
            out["rest"] = entry(-at / k, min(ends), max(ends), fit.length)
        return out

    def to_model(self, spec: mujoco.MjSpec, case: Case, values: dict[str, float], note: dict) -> list[str]:
        joint, k = spec.joint(case.joint), values["stiffness"]
        if k <= 0:
            return []
        had = float(np.ravel(joint.stiffness)[0])
        # angles of the file may be in degrees
        unit = 180 / np.pi if spec.compiler.degree and not case.scales.slide else 1.0
        rest = (had * float(joint.springref) / unit - values["preload"]) / (had + k)
        joint.springref = rest * unit
        # the first of a polynomial's coefficients where MuJoCo has several
        joint.stiffness = [had + k, *np.ravel(joint.stiffness)[1:]] if np.size(joint.stiffness) > 1 else had + k
        return [f"model.xml: stiffness of {case.joint} is {had + k:.3g}, its springref {rest:.3g}"]


class ExternalForce(Effect):
    """Something outside that pushes: a contact, a person, a cable.

    It is no state of the joint, so no law of the plant has it: it is named where the recorded motor torque does not fit
    the body at all, in stretches of time.
    """

    id = "external_force"
    words = "is pushed by something outside: a contact, a person, a cable"
    shows = "in stretches of time, whatever the joint does"
    experiment = "the same commands again with nothing in reach and no cable pulled"
    classes = ("weight or push",)
    motions = ("holds",)
    simulated = False

    def variants(self, s: Scales) -> list[Variant]:
        return []

    def unseen(self, s: Scales) -> str:
        return "" if s.effort else "no motor torque is recorded, without which a push is not told from a missing law"
