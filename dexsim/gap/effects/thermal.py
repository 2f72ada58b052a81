"""Torque constant, friction or resistance that drift with the temperature."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dexsim.gap.effects.effect import SLOW, Effect, FittedEffect, Variant, param, word
from dexsim.gap.plant.case import REFERENCE, Case
from dexsim.gap.plant.columns import INDEX, Scales

MIN_WARMTH = 2.0  # degC: a smaller change of temperature tells nothing
ORDERED = 0.9  # correlation of ranks from which on a temperature follows the clock


class Thermal(Effect):
    """Torque constant, friction or resistance that drift with the temperature."""

    id = "thermal"
    words = "changes as it warms up"
    shows = "with temperature"
    experiment = "the same motion cold and warm, in random order"
    classes = ("drive weakens",)
    kinds = 2

    def variants(self, s: Scales) -> list[Variant]:
        if s.warm < MIN_WARMTH:
            return []
        out = []
        for of, column in (
            ("torque_constant", "thermal_torque"),
            ("friction", "thermal_friction"),
            ("resistance", "thermal_resistance"),
        ):
            if of == "resistance" and not s.voltage:
                continue
            if of == "friction" and not (s.nominal["coulomb_friction"] > 0 or s.nominal["viscous_friction"] > 0):
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

    def unseen(self, s: Scales) -> str:
        if s.warm <= 0:
            return "no temperature is recorded"
        if s.warm < MIN_WARMTH:
            return f"the temperature changes by {s.warm:.1f} degC, less than {MIN_WARMTH:g}"
        return super().unseen(s)

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        m = case.regimes
        warm = np.abs(m["temperature"] - REFERENCE) if "temperature" in m else m["time"]
        moving = (m["speed"] > SLOW * case.scales.speed).astype(float)
        return warm * (moving if note.get("of") == "friction" else np.abs(m["_torque"]))

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {"per_degree": fit.entry("per_degree", "1/degC"), "of": word(fit.variant.note["of"])}

    def doubts(self, case: Case, runs: Sequence[int]) -> list[str]:
        follows = temperature_follows(case, runs)
        return [f"temperature follows {follows}, so it may stand for anything that changes with it"] if follows else []


def temperature_follows(case: Case, runs: Sequence[int]) -> str:
    """What the temperature follows, in words: the clock since the first recording (then whatever drifts looks like
    heat), or the gain that the drive was set to; empty where it follows neither."""
    if "temperature" not in case.regimes or not len(runs):
        return ""
    warm, clock = [], []
    for k, r in enumerate(runs):
        rows = case.plant.rows(r)
        t = case.plant.t[rows]
        warm.append(case.regimes["temperature"][rows])
        clock.append(k + (t - t[0]) / max(float(t[-1] - t[0]), 1e-9))
    if abs(_rank_correlation(np.concatenate(clock), np.concatenate(warm))) > ORDERED:
        return "the clock"
    if len(warm) < 3:
        return ""
    means = np.array([x.mean() for x in warm])
    if abs(_rank_correlation(np.arange(float(len(means))), means)) > ORDERED:
        return "the order of the recordings"
    gain = np.array([case.plant.nominal[r][INDEX["kp"]] for r in runs])
    return "the gain" if abs(_rank_correlation(gain, means)) > ORDERED else ""


def _rank_correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Spearman's, with ties at their middle rank; 0 where one does not change."""
    if np.ptp(a) <= 0 or np.ptp(b) <= 0:
        return 0.0

    def ranks(x: np.ndarray) -> np.ndarray:
        _, inverse, count = np.unique(x, return_inverse=True, return_counts=True)
        return (np.cumsum(count) - 0.5 * (count - 1))[inverse]

    return float(np.corrcoef(ranks(a), ranks(b))[0, 1])
