"""Friction: dry, viscous, at breakaway, under load, before it slides."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects import ByTorque, Effect, FittedEffect, Variant, entry, param
from dexsim.gap.finding import Finding
from dexsim.gap.plant.columns import INDEX as PLANT_INDEX
from dexsim.gap.plant.columns import Scales
from dexsim.gap.rules import BELIEF, JUDGE

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case
    from dexsim.gap.search.inverse_dynamics import Columns


class CoulombFriction(Effect):
    """Dry friction: tau_f sign(v), which may differ by direction."""

    id = "coulomb_friction"
    words = "has more (or less) dry friction than believed"
    shows = "at reversals and low speed"
    experiment = "slow triangles in both directions at constant load"
    classes = ("friction or play", "friction and load", "friction or pull", "friction or dead zone")
    motions = ("triangles", "steps")
    fitted_anyway = {"coulomb_friction": "torque"}
    parts_stand = True  # its directions may differ
    demo = {"coulomb_friction": 0.06}

    def variants(self, s: Scales) -> list[Variant]:
        nominal = s.nominal["coulomb_friction"]
        top = max(1.2 * s.demand, 3 * nominal, 1e-9)
        torque = param("torque", "coulomb_friction", "set", 0.0, top, nominal, "N.m")
        asymmetry = param("asymmetry", "friction_asymmetry", "set", -1.5, 1.5)
        starts = [(nominal + f * s.tau, 0.0) for f in (0.015, 0.03, 0.06, 0.12, 0.22, 0.4)]
        if nominal > 0.02 * s.tau:
            starts.append((0.5 * nominal, 0.0))
        starts += [(nominal + 0.1 * s.tau, 0.8), (nominal + 0.1 * s.tau, -0.8)]
        return [Variant((torque, asymmetry), tuple(starts))]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return (case.regimes["speed"] > JUDGE.slides * case.scales.speed).astype(float)

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        out = {"torque": fit.entry("torque", fit.force, add=fit.case.scales.base_friction)}
        return out | {"asymmetry": fit.entry("asymmetry", "1")}

    def said(self, finding: Finding, believed: dict[str, float]) -> str:
        more = finding.parameters["torque"]["value"] > believed["coulomb_friction"] if believed else None
        return self.words if more is None else self.words.replace("more (or less)", "more" if more else "less")


class ViscousFriction(Effect):
    """Friction that grows with speed: b v, or (b + a / (1 + |v| / v_h)) v of grease that thins as it is sheared."""

    id = "viscous_friction"
    by_torque = "viscous friction that differs by direction"
    words = "has friction that grows with speed"
    shows = "at high speed"
    experiment = "constant speeds from slow to fast"
    classes = ("with speed",)
    motions = ("ladder",)
    kinds = 2

    def variants(self, s: Scales) -> list[Variant]:
        nominal, unit = s.nominal["viscous_friction"], s.tau / s.speed
        starts = [(nominal + f * unit,) for f in (0.02, 0.05, 0.1, 0.2, 0.4, 0.8)]
        if nominal > 0.03 * unit:
            starts.append((0.5 * nominal,))
        top = max(3 * unit, 4 * nominal)
        line = param("coefficient", "viscous_friction", "set", 0.0, top, nominal, "N.m.s/rad")
        # half of it lost at less would be dry friction, at far more than the fastest that was seen the line
        half = param("half_speed", "thinning_speed", "set", 0.08 * s.speed, 3 * s.peak_speed, 0.3 * s.speed, "rad/s")
        more, most = s.nominal["thinning_friction"], top * (1 + s.speed / half.low)
        rest = param("at_rest", "thinning_friction", "set", 0.0, most, more, "N.m.s/rad")
        # as much at the joint's typical speed as the line has
        begun = tuple(
            (more + f * unit * (1 + 1 / h), h * s.speed) for h in (0.15, 0.5) for f in (0.05, 0.1, 0.2, 0.4, 0.8)
        )
        return [Variant((line,), tuple(starts)), Variant((rest, half), begun, "that thins")]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return case.regimes["speed"]

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        unit = f"{fit.force}.s/{fit.length}"
        s = fit.case.scales
        if "at_rest" not in fit.value:
            return {"coefficient": fit.entry("coefficient", unit, add=s.base_damping)}
        # the line that takes as much energy from the recorded motion, by its mean speeds between samples: smoothed ones
        # lack the peaks, which weigh most
        plant = fit.case.plant
        way, time = np.diff(plant.q), np.diff(plant.t)
        on = (plant.run_of[1:] == plant.run_of[:-1]) & (time > 0)
        v = np.abs(way[on] / time[on])
        share = float(np.sum(v * v / (1 + v / fit.value["half_speed"])) / max(np.sum(v * v), 1e-12))
        line = s.base_damping + s.nominal["viscous_friction"]
        return {
            "coefficient": fit.entry("at_rest", unit, add=line / share, times=share),
            "at_rest": fit.entry("at_rest", unit, add=line),
            "half_speed": fit.entry("half_speed", f"{fit.length}/s"),
        }

    def torque_columns(self, own: Columns) -> dict[str, Callable[[Columns], np.ndarray]]:
        return {self.by_torque: lambda d: np.abs(d.v)}

    @property
    def shows_by_torque(self) -> str:
        return f"{self.shows}; differs by direction"

    def parameters_by_torque(self, found: ByTorque) -> dict[str, Any]:  # the coefficient: of what differs by direction
        own = found.joint["viscous_friction"]
        unit = f"{found.force}.s/{found.length}"
        asymmetry = found.entry("1", 2, own)
        # neither direction's is below 0
        asymmetry |= {k: float(np.clip(asymmetry[k], -2.0, 2.0)) for k in ("value", "low", "high")}
        return {"coefficient": entry(own, own * 0.95, own * 1.05, unit), "asymmetry": asymmetry}

    def refused_by_torque(self, value: float, joint: dict[str, float], slowest: float) -> str | None:
        own = joint.get("viscous_friction", 0.0)
        return None if abs(value) <= own else (
            f"the least squares give {own:.3g} with {value:.3g} more forwards and less backwards, and neither "
            "direction's can be negative"
        )


SPEEDS = (0.02, 0.04, 0.08, 0.14, 0.2, 0.3)
"""Of the top speed of a recorded motion: where inverse dynamics try Stribeck's excess to be down to 1/e."""


class StribeckFriction(Effect):
    """Breakaway friction above the sliding level: peak exp(-|v / v_s|^n) sign(v), n 2 or 1."""

    id = "stribeck_friction"
    by_torque = "stribeck_friction"
    words = "needs a breakaway torque above its sliding friction"
    shows = "at speeds between zero and v_s"
    experiment = "very slow ramps from rest, and the same faster"
    classes = ("friction or play",)
    motions = ("triangles", "ladder")
    demo = {"stribeck_peak": 0.06, "stribeck_speed": 0.25}

    def variants(self, s: Scales) -> list[Variant]:
        peak = param("peak", "stribeck_peak", "set", 0.0, 1.2 * s.demand, 0.0, "N.m")
        # up to the fastest that was seen, by which the peak is gone to a third: beyond, it is sliding friction
        v_s = param("v_s", "stribeck_speed", "set", 0.003 * s.speed, s.peak_speed, 0.1 * s.speed, "rad/s")
        starts = tuple((a * s.tau, b * s.speed) for a in (0.03, 0.08, 0.2, 0.45) for b in (0.02, 0.08, 0.25))
        return [Variant((peak, v_s), starts, laws=(("exponential in speed", (("stribeck_exponent", 1.0),)),))]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        m, s = case.regimes, case.scales
        v = m["speed"]
        near = np.exp(-((v / max(values.get("v_s", 0.1 * s.speed), 1e-6)) ** 2))
        return near * ((v > 0.2 * (JUDGE.slides * s.speed)) | (np.abs(m["_torque"]) > 0))

    def torque_columns(self, own: Columns) -> dict[str, Callable[[Columns], np.ndarray]]:
        top = float(np.abs(own.v).max())
        return {f"{self.by_torque} (v_s {k * top:.3g})": partial(_falling, speed=k * top) for k in SPEEDS}

    def parameters_by_torque(self, found: ByTorque) -> dict[str, Any]:
        v_s = found.speed
        return {"peak": found.entry(found.force), "v_s": entry(v_s, 0.5 * v_s, 2 * v_s, f"{found.length}/s")}

    def refused_by_torque(self, value: float, joint: dict[str, float], slowest: float) -> str | None:
        return None if value > 0 else ""  # an excess is more


def _falling(d: Columns, speed: float) -> np.ndarray:
    """Return [m] dry friction of one that falls with speed [rad/s], exp(-(v / speed)^2)."""
    return d.column(lambda q, v, load: np.sign(v) * np.exp(-((v / speed) ** 2)))


class LoadFriction(Effect):
    """Friction that grows with the torque that a gear transmits, more or less where the load drives it."""

    id = "load_friction"
    by_torque = "load_friction"
    approximated = ("gear_load_friction", "gear_load_friction_backdriven")
    words = "has friction that grows with the load on its gear"
    shows = "at high load"
    experiment = "the same slow motion under two or more loads"
    classes = ("friction and load",)
    motions = ("triangles", "holds")
    demo = {"load_friction": 0.25, "load_friction_backdriven": 0.25}

    def variants(self, s: Scales) -> list[Variant]:
        drive = param("fraction", "load_friction", "set", 0.0, 0.95, s.nominal["load_friction"])
        back = param(
            "fraction_backdriven", "load_friction_backdriven", "set", 0.0, 3.0, s.nominal["load_friction_backdriven"]
        )
        by_motor = Variant((drive, back), ((0.04, 0.05), (0.1, 0.12), (0.2, 0.25), (0.35, 0.35), (0.3, 0.8)))
        # of what the gear hands to the joint: a share of the motor's torque cannot say that a gear holds against its
        # load by itself, nor what it loses to a load of the joint's own inertia
        gear = "gear_load_friction"
        by_gear = Variant(
            (
                param("fraction", gear, "set", 0.0, 5.0),
                param("fraction_backdriven", f"{gear}_backdriven", "set", 0.0, 5.0),
            ),
            ((0.3, 0.3), (1.0, 1.0)),
            "of the torque on the joint",
            (("gear_load_unit", max(s.gravity, 0.3 * s.tau)),),
            approximate=True,
            laws=(("Hertz contact", (("gear_load_power", 2 / 3),)),),
        )
        return [by_motor, by_gear]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return np.abs(case.regimes["_load"]) * (case.regimes["speed"] > JUDGE.slides * case.scales.speed).astype(float)

    def torque_columns(self, own: Columns) -> dict[str, Callable[[Columns], np.ndarray]]:
        return {self.by_torque: lambda d: d.column(lambda q, v, load: np.abs(load) * np.sign(v))} if own.loaded else {}

    def parameters_by_torque(self, found: ByTorque) -> dict[str, Any]:
        return {"fraction": found.entry("1")}

    def refused_by_torque(self, value: float, joint: dict[str, float], slowest: float) -> str | None:
        return None if 0 < value < 1 and joint.get("coulomb_friction", 0.0) >= 0 else ""

    def columns_beside(self, variant: Variant, joints: Sequence[str], row: np.ndarray, case: Case) -> dict[str, float]:
        """Return what stands in for dry friction that grows with the torque on the joint, per torque from outside: the
        servo table knows that torque without the joint's own inertia, and a line. As large as on average while the
        joint slid."""
        if not variant.approximate:
            return {}
        share, back, power, unit = (
            row[PLANT_INDEX[f"gear_load_{n}"]] for n in ("friction", "friction_backdriven", "power", "unit")
        )
        slides = case.regimes["speed"] > JUDGE.slides * case.scales.speed
        load, speed = case.regimes["_load"][slides], case.regimes["_speed"][slides]
        by_load = np.where(load * speed < 0.0, back, share) * unit * (np.abs(load) / unit) ** power
        return {"load_friction_external": float(by_load.sum() / max(np.abs(load).sum(), 1e-12))}


def give(s: Scales) -> float:
    """Return how far any dry friction may give way before it slides [rad or m]."""
    return BELIEF.gives_slide if s.slide else BELIEF.gives


DISTANCES = (3e-5, 1e-4, 3e-4, 1e-3, 3e-3)
"""Of a whole recorded motion: over which inverse dynamics try dry friction to give way."""


class Presliding(Effect):
    """Dry friction that gives way elastically before it slides.

    The share z of the friction that is taken up grows along the way: dz = (1 - z sign(dq)) dq / distance (P. Dahl
    1968).
    """

    id = "presliding"
    by_torque = "dry friction that gives way before it slides"
    named_by_torque = False
    words = "gives way elastically before its dry friction slides"
    shows = "after reversals and in small motions"
    experiment = "slow reversals about a pose, from far below a degree up, without and with a load"
    classes = ("about a reversal",)
    motions = ("triangles",)

    def variants(self, s: Scales) -> list[Variant]:
        low = give(s)
        distance = param("distance", "presliding", "set", low, 50 * low, low, "m" if s.slide else "rad")
        return [Variant((distance,), tuple((f * low,) for f in (2.5, 6.0, 15.0, 35.0)))]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        q, v, run = case.regimes["position"], case.regimes["_speed"], case.plant.run_of
        way = np.r_[0.0, np.abs(np.diff(q))]
        turned = np.r_[True, (np.sign(v[1:]) != np.sign(v[:-1])) | (run[1:] != run[:-1])]
        gone = np.cumsum(way)
        since = gone - np.maximum.accumulate(np.where(turned, gone, 0.0))
        return np.exp(-since / max(values.get("distance", give(case.scales)), 1e-12))

    def torque_columns(self, own: Columns) -> dict[str, Callable[[Columns], np.ndarray]]:
        ways = (k * own.span for k in DISTANCES)
        return {f"{self.by_torque} (over {way:.2g})": partial(_gives, way=way) for way in ways}

    def refused_by_torque(self, value: float, joint: dict[str, float], slowest: float) -> str | None:
        # what gives way is friction that is there
        return None if 0 < value < 2 * joint.get("coulomb_friction", 0.0) else ""


def _gives(d: Columns, way: float) -> np.ndarray:
    """Return [m] dry friction of one that is taken up over a way [rad], less what is there at once."""
    return d.column(lambda q, v, load: taken_up(q, way) - np.sign(v))


def taken_up(q: np.ndarray, distance: float) -> np.ndarray:
    """Return [n] share -1..1 of a dry friction that is taken up along q: dz = (1 - z sign(dq)) dq / distance, each step
    exactly (P. Dahl 1968)."""
    z, out = 0.0, np.empty(len(q))
    steps = np.diff(q, prepend=q[0])
    keep = np.exp(-np.abs(steps) / distance)
    for i, (step, k) in enumerate(zip(steps, keep, strict=True)):
        way = 1.0 if step > 0 else -1.0
        z = way + (z - way) * k
        out[i] = z
    return out
