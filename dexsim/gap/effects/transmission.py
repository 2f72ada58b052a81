"""Between motor and joint: play, elasticity, ripple, a coupling to another joint."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects import Effect, FittedEffect, Variant, entry, param, word
from dexsim.gap.plant.columns import DRAGGERS, Param, Scales

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case


RINGS = (0.1, 0.3)  # damping ratios of a transmission that are tried: whether a loop rattles with it hangs on them


class Backlash(Effect):
    """Free play between motor and joint."""

    id = "backlash"
    words = "has free play between motor and joint"
    shows = "when the load changes sign"
    experiment = "small steps about a pose without load, both encoders logged if there are two"
    classes = ("friction or play", "about a reversal")
    motions = ("triangles", "chirp")
    parts_motor = True
    rings = True
    demo = {"backlash": 0.06}

    def variants(self, s: Scales) -> list[Variant]:
        top = min(0.5 * s.span, 60 * s.error + 30 * s.sigma)
        low = min(3.0 * s.sigma, 0.1 * top)  # less cannot be told from the plant's own inaccuracy
        gap = param("gap", "backlash", "set", low, top, low, "m" if s.slide else "rad")
        starts = sorted({min(f * s.sigma, 0.8 * top) for f in (4.0, 7.0, 12.0, 20.0, 40.0, 70.0, 120.0)})
        rebound = param("rebound", "rebound", "set", 0.02, 0.7, 0.1)
        params: tuple[Param, ...] = (gap, rebound)
        extra: tuple[float, ...] = ()
        if s.armature <= 0:  # how much of the inertia is the rotor's is not known
            params, extra = (
                (*params, param("rotor", "rotor", "set", 0.05 * s.inertia, 0.95 * s.inertia, 0.3 * s.inertia)),
                (0.3 * s.inertia,),
            )
        return [Variant(params, tuple((x, ring, *extra) for x in starts for ring in RINGS))]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return near_sign_change(case, case.regimes["_load"] + case.regimes["_friction"], 0.04)

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {"gap": fit.entry("gap", fit.length)}


def near_sign_change(case: Case, x: np.ndarray, seconds: float) -> np.ndarray:
    """Return [n] 1 about where x [n] changes sign within a run: a quarter of `seconds` before, the rest after."""
    t, run = case.plant.t, case.plant.run_of
    out = np.zeros(len(t))
    change = np.flatnonzero((np.sign(x[1:]) != np.sign(x[:-1])) & (run[1:] == run[:-1]))
    for i in change:
        j = (
            np.searchsorted(t[case.plant.rows(int(run[i]))], [t[i] - 0.25 * seconds, t[i] + 0.75 * seconds])
            + case.plant.rows(int(run[i])).start
        )
        out[j[0] : j[1] + 1] = 1.0
    return out


class Compliance(Effect):
    """An elastic transmission, which may harden: torque = k x (1 + h x^2)."""

    id = "compliance"
    words = "has an elastic transmission"
    shows = "at high load and at 5-30 Hz"
    experiment = "a chirp of 1-30 Hz"
    parts_motor = True
    rings = True
    demo = {"softness": 0.5}

    def variants(self, s: Scales) -> list[Variant]:
        # not stiffer than a tenth of the loop's own spring is softness that leaves no trace
        top = 3.0 / s.stiffness
        soft = param("softness", "softness", "set", 0.04 / s.stiffness, top, 0.04 / s.stiffness, "rad/N.m")
        hard = param("hardening", "hardening", "set", 0.0, 8.0 / s.tau**2, 0.0, "1/(N.m)2")
        ring = param("rebound", "rebound", "set", 0.02, 0.7, 0.1)
        starts = tuple((0.4 / s.stiffness, 0.1, h / s.tau**2) for h in (0.1, 0.5, 2.5))
        sizes = tuple((f / s.stiffness, r) for f in (0.06, 0.1, 0.15, 0.25, 0.4, 0.65, 1.0, 1.7) for r in RINGS)
        return [Variant((soft, ring), sizes), Variant((soft, ring, hard), starts, "hardening", refines=True)]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return case.regimes["load"]

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        value, (low, high) = fit.value["softness"], fit.interval["softness"]
        invert = lambda x: 1.0 / max(x, 1e-9)  # noqa: E731
        out = {"stiffness": entry(invert(value), invert(high), invert(low), f"{fit.force}/{fit.length}")}
        if "hardening" in fit.value:  # torque k x (1 + hardening x^2)
            out["hardening"] = fit.entry("hardening", f"1/{fit.length}2", times=invert(value) ** 2)
        return out


SAWTOOTH = (("rising sawtooth", (("ripple_shape", 1.0),)), ("falling sawtooth", (("ripple_shape", -1.0),)))


class TorqueRipple(Effect):
    """Cogging and gear eccentricity: a torque that repeats with the position."""

    id = "torque_ripple"
    words = "has a torque ripple that repeats with position"
    shows = "periodically in position"
    experiment = "slow constant speed over the whole range"
    kinds = 2
    whole = True

    def variants(self, s: Scales) -> list[Variant]:
        out = []
        for turns in (1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 14, 16, 18, 20, 24, 28, 32, 36, 42, 48, 56, 64, 80, 100):
            period = 2 * np.pi / turns
            if not s.slide and 1.2 * s.span > period > 6 * s.sigma:
                params = (
                    # as a dry friction, any that the drive can work against: a light joint's own load is far less
                    param("amplitude", "torque_ripple", "set", 0.0, 1.2 * s.demand, 0.0, "N.m"),
                    # a gear's own periods are whole numbers a turn of the joint; those of a motor before it are many,
                    # and ranges overlap
                    param(
                        "per_turn",
                        "ripple_per_turn",
                        "set",
                        turns * (0.98 if turns < 8 else 0.85),
                        turns * (1.02 if turns < 8 else 1.17),
                        turns,
                    ),
                    param("phase", "ripple_phase", "set", -6.3, 6.3, 0.0, "rad"),
                )
                a = 0.1 * s.tau
                starts = tuple((a, float(turns), ph) for ph in (0.0, np.pi / 2, np.pi, -np.pi / 2))
                out.append(Variant(params, starts, f"{turns} a turn", laws=SAWTOOTH))
        return out

    def unseen(self, s: Scales) -> str:
        if self.variants(s):
            return ""
        return (
            "it slides and has no turn"
            if s.slide
            else f"it moves over {s.span:.2g} rad, less than a period of any gear"
        )

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return np.abs(np.sin(values.get("per_turn", 1) * case.regimes["position"] + values.get("phase", 0.0)))

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {"amplitude": fit.entry("amplitude", fit.force), "per_turn": fit.entry("per_turn", "1")}


class JointCoupling(Effect):
    """A joint that is dragged along by another: a tendon or a linkage."""

    id = "joint_coupling"
    words = "is dragged along by another joint"
    shows = "while that joint moves"
    experiment = "one joint at a time, the others held"
    kinds = 2
    from_poses = True
    couples = True
    whole = True

    def variants(self, s: Scales) -> list[Variant]:
        out = []
        for k, other in enumerate(s.others[:DRAGGERS]):
            fixed, note = (("coupling_from", float(k)),), {"from_joint": other}
            # its target is dragged along; a linkage between motor, joint and the other; the pull at its other end
            for column, label, starts in (
                ("coupling", other, (0.02, 0.15)),
                ("linkage", f"linkage with {other}", (0.05, 0.4)),
                ("reaction", f"pull of {other}", (0.1,)),
            ):
                p = param("ratio", column, "set", -1.0, 1.0)
                out.append(Variant((p,), tuple((sign * x,) for x in starts for sign in (-1, 1)), label, fixed, note))
        return out

    def unseen(self, s: Scales) -> str:
        return super().unseen(s) if s.others else "no other joint moves"

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        others = list(case.scales.others)
        k = others.index(note["from_joint"]) if note.get("from_joint") in others else 0
        return np.abs(case.regimes.get(f"_drag{k}", case.regimes["speed"]))

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {"ratio": fit.entry("ratio", "1"), "from_joint": word(fit.variant.note["from_joint"])}
