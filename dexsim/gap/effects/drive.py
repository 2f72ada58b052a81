"""The motor and its controller: limits of torque and speed, supply, heat, gains and terms of the loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from dexsim.actuator.columns import DRY_FRICTION
from dexsim.actuator.reference import torque_along
from dexsim.gap.effects import Effect, FittedEffect, Variant, param, word
from dexsim.gap.finding import Finding
from dexsim.gap.plant.case import REFERENCE, Case
from dexsim.gap.plant.columns import INDEX, Scales
from dexsim.gap.rules import JUDGE, SEARCH

ABOVE = (1.15, 1.5, 2.0, 2.5)  # x the believed limit that is tried where it is reached; the last is the bound
REACHED = 0.02  # share of the samples in which the believed limit is reached


class TorqueLimit(Effect):
    """A stall torque, or a clamp of the current, other than the believed one; above it only where that is reached."""

    id = "torque_limit"
    words = "gives less (or more) torque than believed when it saturates"
    shows = "at saturation"
    experiment = "large steps against a load"

    def variants(self, s: Scales) -> list[Variant]:
        believed = s.nominal["torque_limit"]
        # one in a thousand moments asks for far more than the rest, and it is there that a limit shows
        top = min(believed, 8 * s.demand)
        low = 0.05 * s.demand
        if top <= low or s.voltage:
            top = believed * 1.0
        above = ABOVE if s.saturates > REACHED and top == believed else ()
        top *= max((1.0, *above))
        limit = param("torque", "torque_limit", "set", min(low, 0.5 * top), top, min(top, believed), "N.m")
        sizes = [f * min(s.demand, believed) for f in (0.95, 0.88, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2)] + [
            f * min(top, believed) for f in (0.9, 0.78, 0.65, 0.5, 0.35)
        ]
        sizes += [f * believed for f in above[:-1]]
        starts = sorted({round(max(x, 1.05 * low), 12) for x in sizes if x < top}, reverse=True)
        return [Variant((limit,), tuple((x,) for x in starts))] if starts else []

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        s = case.scales
        return lost(s, case.regimes, values.get("torque", s.demand), s.nominal["no_load_speed"])

    def said(self, finding: Finding, believed: dict[str, float]) -> str:
        limit = finding.parameters.get("torque", {"value": 0.0})["value"]
        more = limit > believed.get("torque_limit", np.inf)
        return self.words.replace("less (or more)", "more" if more else "less")


def lost(s: Scales, m: dict[str, np.ndarray], limit: float, no_load_speed: float) -> np.ndarray:
    """Return [n] torque that the drive would give by its believed limits and does not give by these."""
    asked, v = m["_asked"], m["_speed"]

    def give(most: float, fastest: float) -> np.ndarray:
        return torque_along(asked, v, min(most, 1e9), fastest, s.voltage)

    return np.abs(give(s.nominal["torque_limit"], s.nominal["no_load_speed"]) - give(limit, no_load_speed))


class TorqueSpeedLimit(Effect):
    """A no-load speed below the believed one."""

    id = "torque_speed_limit"
    words = "runs out of torque at a lower speed than believed"
    shows = "at high speed and torque"
    experiment = "large steps at full speed"
    classes = ("with speed", "drive weakens", "limits at speed")
    motions = ("ladder", "steps")

    def variants(self, s: Scales) -> list[Variant]:
        believed = s.nominal["no_load_speed"]
        top = min(believed, 30 * s.peak_speed)
        low = min(0.3 * s.peak_speed, 0.8 * top)
        speed = param("no_load_speed", "no_load_speed", "set", low, top, top, "rad/s")
        starts = [
            x
            for x in (
                0.7 * s.peak_speed,
                0.9 * s.peak_speed,
                1.1 * s.peak_speed,
                1.6 * s.peak_speed,
                2.3 * s.peak_speed,
                3.5 * s.peak_speed,
                0.9 * believed,
                0.8 * believed,
                0.65 * believed,
            )
            if low < x < top
        ]
        return [Variant((speed,), tuple((x,) for x in starts))] if starts else []

    def unseen(self, s: Scales) -> str:
        return "" if self.variants(s) else "it moves far too slowly for its no-load speed"

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        s = case.scales
        return lost(s, case.regimes, s.nominal["torque_limit"], values.get("no_load_speed", s.peak_speed))


class BrakingLimit(Effect):
    """A torque limit that falls otherwise with speed while the drive brakes than while it drives.

    Where torque and speed differ in sign it is tau0 max(0, 1 - slope |v| / no-load speed). Nameable where the servo's
    file states a slope; where it states none, nothing is believed of braking and the slope is refitted with every
    hypothesis.
    """

    id = "braking_limit"
    words = "brakes with another torque at speed than believed"
    shows = "at saturation while it slows down"
    experiment = "large steps to full speed that end in a stop, and the same with a smaller torque limit"
    classes = ("limits at speed",)
    motions = ("steps",)

    def variants(self, s: Scales) -> list[Variant]:
        believed = s.nominal["braking_slope"]
        if s.voltage or s.nominal["no_load_speed"] >= 1e8:
            return []
        slope = param("slope", "braking_slope", "set", -1.0, 1.0, believed)
        starts = tuple((x,) for x in (0.0, -0.9, 0.5, 0.9) if abs(x - believed) > 0.2)
        return [Variant((slope,), starts)]

    def unseen(self, s: Scales) -> str:
        if s.voltage:
            return "a drive by voltage brakes along the line that it drives along"
        return super().unseen(s) if s.nominal["no_load_speed"] < 1e8 else "no no-load speed is believed"

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        m, s = case.regimes, case.scales
        limits = m["_asked"], m["_speed"], s.nominal["torque_limit"], s.nominal["no_load_speed"], False
        a, b = (torque_along(*limits, braking_slope=x) for x in (s.nominal["braking_slope"], values["slope"]))
        return np.abs(a - b)


class SupplySag(Effect):
    """A shared supply that drops while other joints load it."""

    id = "supply_sag"
    words = "loses supply while other joints load it"
    shows = "while other joints work"
    experiment = "this joint moving alone, then with the others loaded"
    classes = ("drive weakens",)
    kinds = 2
    every_kind = True  # where limits are reached it takes slopes far beyond what they hold for

    def variants(self, s: Scales) -> list[Variant]:
        if not s.others or s.others_torque <= 0:
            return []
        top = 0.9 / s.others_torque
        sag = param(
            "sag", "sag", "set", 0.0, 1.5 * top, 0.0, "1/N.m"
        )  # at the others' peaks nothing of the supply may be left
        out = [Variant((sag,), tuple((f * top,) for f in (0.02, 0.05, 0.1, 0.2, 0.4, 0.7)))]
        if not s.voltage:
            # a drive that is described by torques but sets a voltage loses all of them with its supply, to itself too
            weak = param("sag", "sag_torque", "set", 0.0, 1.5 * top, 0.0, "1/N.m")
            most = 0.7 / max(s.tau, 1e-9)
            own = param("own", "sag_own", "set", 0.0, most, 0.0, "1/N.m")
            starts = tuple((f * top, min(f * top, 0.9 * most)) for f in (0.01, 0.03, 0.08, 0.2, 0.4))
            out.append(Variant((weak, own), starts, "gains and limits alike"))
        return out

    def unseen(self, s: Scales) -> str:
        if not s.others:
            return "no other joint moves, so none can load the supply"
        if s.others_torque <= 0:
            return "the other joints give no torque"
        return super().unseen(s)

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return case.regimes.get("_others", case.regimes["speed"])

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        keys = ["sag", *(["own"] if "own" in fit.value else [])]
        return {k: fit.entry(k, f"1/({fit.force})") for k in keys}


WARMED = (*DRY_FRICTION, "viscous_friction", "thinning_friction")  # columns that `thermal_friction` scales


class Thermal(Effect):
    """Torque constant, friction or resistance that drift with the temperature."""

    id = "thermal"
    words = "changes as it warms up"
    by_warmth = ("thermal_torque", "thermal_friction", "thermal_resistance")
    shows = "with temperature"
    experiment = "the same motion cold and warm, in random order"
    classes = ("drive weakens",)
    kinds = 2

    def variants(self, s: Scales) -> list[Variant]:
        if s.warm < SEARCH.warmth:
            return []
        out = []
        for of, column in (
            ("torque_constant", "thermal_torque"),
            ("friction", "thermal_friction"),
            ("resistance", "thermal_resistance"),
        ):
            if of == "resistance" and not s.voltage:
                continue
            if of == "friction" and self.without(s):
                continue
            top = min(0.03 if of != "friction" else 0.1, 0.7 / s.warm)
            # copper gains 0.39 % of resistance per degree: ten times that is a proxy of something else
            # friction may grow several times over; what falls cannot fall below nothing
            low, high = -top, top
            if of == "resistance":
                low, high = 0.0, 0.008
            elif of == "friction":
                low, high = -min(0.1, 0.95 / s.warm), min(0.1, 2.5 / s.warm)
            p = param("per_degree", column, "set", low, high, 0.0, "1/degC")
            starts = tuple(
                (f,)
                for f in ((0.25 * high, 0.7 * high) if low == 0 else (-0.5 * top, -0.15 * top, 0.15 * top, 0.5 * high))
            )
            out.append(Variant((p,), starts, of, note={"of": of}))
        return out

    def without(self, s: Scales) -> dict[str, str]:
        if s.warm < SEARCH.warmth or any(s.nominal.get(n, 0.0) > 0 or n in s.unknown for n in WARMED):
            return {}
        if s.base_friction > 0:
            return {
                "of friction": "the drive is believed to have none, and the model's frictionloss has no temperature: "
                "state it as coulomb_friction of the servo"
            }
        return {"of friction": "no friction is believed of the drive; where its size is not known it is unknown, not 0"}

    def unseen(self, s: Scales) -> str:
        if s.warm <= 0:
            return "no temperature is recorded"
        if s.warm < SEARCH.warmth:
            return f"the temperature changes by {s.warm:.1f} degC, less than {SEARCH.warmth:g}"
        return super().unseen(s)

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        m = case.regimes
        warm = np.abs(m["temperature"] - REFERENCE) if "temperature" in m else m["time"]
        moving = (m["speed"] > JUDGE.slides * case.scales.speed).astype(float)
        return warm * (moving if note.get("of") == "friction" else np.abs(m["_torque"]))

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {"per_degree": fit.entry("per_degree", "1/degC"), "of": word(fit.variant.note["of"])}

    def doubts(self, case: Case, runs: Sequence[int]) -> list[str]:
        follows = temperature_follows(case, runs)
        return [f"temperature follows {follows}, so it may stand for anything that changes with it"] if follows else []


def temperature_follows(case: Case, runs: Sequence[int]) -> str:
    """Return what the temperature follows, in words: the clock since the first recording (then whatever drifts looks
    like heat), or the gain that the drive was set to; empty where it follows neither."""
    if "temperature" not in case.regimes or not len(runs):
        return ""
    warm, clock = [], []
    for k, r in enumerate(runs):
        rows = case.plant.rows(r)
        t = case.plant.t[rows]
        warm.append(case.regimes["temperature"][rows])
        clock.append(k + (t - t[0]) / max(float(t[-1] - t[0]), 1e-9))
    if abs(_rank_correlation(np.concatenate(clock), np.concatenate(warm))) > JUDGE.ordered:
        return "the clock"
    if len(warm) < 3:
        return ""
    means = np.array([x.mean() for x in warm])
    if abs(_rank_correlation(np.arange(float(len(means))), means)) > JUDGE.ordered:
        return "the order of the recordings"
    gain = np.array([case.plant.nominal[r][INDEX["kp"]] for r in runs])
    return "the gain" if abs(_rank_correlation(gain, means)) > JUDGE.ordered else ""


def _rank_correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Return Spearman's, with ties at their middle rank; 0 where one does not change."""
    return float(spearmanr(a, b).statistic) if np.ptp(a) > 0 and np.ptp(b) > 0 else 0.0


class GainMismatch(Effect):
    """A firmware that runs on other gains than believed."""

    id = "gain_mismatch"
    words = "runs on other gains than believed"
    parts_stand = True  # there are two
    shows = "with the size of the error"
    experiment = "steps of several sizes against a known load"
    classes = ("with speed", "static load", "loop")
    motions = ("steps", "holds")

    def variants(self, s: Scales) -> list[Variant]:
        there = [n for n in ("kp", "kd") if s.nominal[n] > 0] or ["kp"]  # a velocity loop has no kp
        params = {"kp": param("kp_factor", "kp", "factor", 0.25, 4.0, 1.0),
                  "kd": param("kd_factor", s.damping, "factor", 0.1, 6.0, 1.0)}  # fmt: skip
        sizes = {"kp": (0.6, 0.8, 0.91, 1.1, 1.3, 1.7), "kd": (0.5, 0.8, 1.25, 1.8, 3.0)}
        starts = [tuple(x if k == n else 1.0 for k in there) for n in there for x in sizes[n]]
        return [Variant(tuple(params[n] for n in there), tuple(starts))]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        m, believed = case.regimes, case.scales.nominal  # the torque that the other gains make more or less
        more = (values.get("kp_factor", 1.0) - 1) * believed["kp"] * m["_error"]
        return np.abs(more - (values.get("kd_factor", 1.0) - 1) * believed["kd"] * m["_speed"])


class ControllerTerm(Effect):
    """A term of the drive's loop that the believed law lacks: feed-forward of speed or acceleration, an integral.

    A cascade of a position and a speed loop is a PD with a speed feed-forward and an integral (`dexsim.actuator.laws`).
    """

    id = "controller_term"
    words = "has a loop with a term that the believed law lacks"
    shows = "with the target's speed or acceleration, or as a slow drift of the error"
    experiment = (
        "constant speeds from slow to fast, and long holds against a load: a feed-forward acts only while the target "
    )
    experiment += "moves, an integral creeps on after it"
    classes = ("loop",)
    motions = ("ladder", "holds")
    kinds = 2
    demo = {"speed_feedforward": 0.06}
    leads = True

    def variants(self, s: Scales) -> list[Variant]:
        kp, kd = s.nominal["kp"], s.nominal["kd"]
        inertia = s.inertia / (s.nominal["torque_limit"] if s.voltage else 1.0)
        force, length = ("N", "m") if s.slide else ("N.m", "rad")
        unit = f"1/{length}" if s.voltage else f"{force}/{length}"
        speed, integral = max(kd, 0.02 * kp), kp / 0.5
        return [
            _kind(
                "speed_feedforward",
                "speed_feedforward",
                3 * max(kd, 0.2 * kp),
                f"{unit}.s",
                (0.3 * speed, speed, 2.5 * speed),
            ),
            _kind(
                "acceleration_feedforward",
                "acceleration_feedforward",
                6 * inertia,
                f"{unit}.s2",
                (0.5 * inertia, inertia, 2 * inertia),
            ),
            _kind("integral", "integral_gain", kp / 0.02, f"{unit}/s", (0.3 * integral, integral, 4 * integral)),
        ]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        m = case.regimes
        if note["kind"] == "integral":
            return m["position error"]
        return np.abs(m["_command_rate"]) if note["kind"] == "speed_feedforward" else m["acceleration"]

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {"gain": fit.entry("gain", fit.variant.params[0].unit), "kind": word(fit.variant.note["kind"])}


def _kind(kind: str, column: str, high: float, unit: str, starts: tuple[float, ...]) -> Variant:
    gain = param("gain", column, "set", 0.0, high, 0.0, unit)
    return Variant((gain,), tuple((x,) for x in starts), kind.replace("_", " "), note={"kind": kind})


class Deadband(Effect):
    """A firmware that ignores small position errors."""

    id = "deadband"
    words = "ignores small position errors"
    shows = "at small errors"
    experiment = "small steps of increasing size"
    classes = ("friction or dead zone",)  # counted from its edge it is a friction's torque while the joint lags behind
    kinds = 3
    every_kind = True  # the slopes of one say little of another: that counted from its edge pulls to where it ends
    demo = {"deadband": 0.03}

    def variants(self, s: Scales) -> list[Variant]:
        top = max(2.5 * s.error, 6 * s.sigma)
        p = param("width", "deadband", "set", 0.0, top, 0.0, "m" if s.slide else "rad")
        starts = tuple((f * top,) for f in (0.01, 0.02, 0.04, 0.07, 0.12, 0.2, 0.3, 0.45, 0.65))
        kinds = (("no torque inside", 0.0), ("damped inside", 1.0), ("counted from its edge", 2.0))
        return [
            Variant((p,), starts, label, (("deadband_kind", k),))
            for label, k in kinds
            if k != 1.0 or s.nominal["kd"] > 0
        ]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return (case.regimes["position error"] < values.get("width", 0.0)).astype(float)
