"""A term of the drive's loop that the believed law lacks: feed-forward of speed or acceleration, an integral."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import Effect, FittedEffect, Variant, param, word
from dexsim.gap.plant.columns import Scales

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case


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
