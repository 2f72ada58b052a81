"""What goes into a drive and comes out of it: delay and lag, the encoder, the current sensor."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects import ByTorque, Effect, FittedEffect, Variant, entry, param
from dexsim.gap.plant.columns import Scales
from dexsim.gap.rules import SEARCH

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case
    from dexsim.gap.search.inverse_dynamics import Columns


class CommandDelay(Effect):
    """A transport delay of the commands beyond what is believed."""

    id = "command_delay"
    words = "acts on its commands later than believed"
    shows = "in proportion to speed"
    experiment = "steps and a fast chirp"
    classes = ("late",)
    motions = ("steps", "chirp")
    demo = {"delay": 0.02}

    def variants(self, s: Scales) -> list[Variant]:
        delay = param("delay", "delay", "add", -s.nominal["delay"], 0.2, 0.0, "s")
        return [Variant((delay,), ((0.003,), (0.006,), (0.012,), (0.02,), (0.035,), (0.08,)))]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return np.abs(case.regimes["_command_rate"])


class Lag(Effect):
    """A lag of the drive's torque, of first order or of second, or of the speed that its loop measures."""

    id = "lag"
    by_torque = "lag"
    words = "builds its torque up with a lag"
    alike_by_torque = ("lag", "command_delay")
    shows = "at high acceleration"
    experiment = "steps and a fast chirp"
    classes = ("late",)
    motions = ("steps", "chirp")
    rings = True

    def lacks(self, variant: Variant) -> tuple[str, str] | None:
        second = ("lag_stages", 2.0) in variant.fixed
        return ("second order of lag", "training has one of first order with the same mean delay") if second else None

    def variants(self, s: Scales) -> list[Variant]:
        out = [
            Variant(
                (param("time_constant", "lag", "set", 0.0, 0.3, s.nominal["lag"], "s"),),
                ((0.003,), (0.006,), (0.012,), (0.025,), (0.06,)),
                "drive",
                laws=(("second order", (("lag_stages", 2.0),)),),
            )
        ]
        if s.nominal["kd"] > 0:
            out.append(
                Variant(
                    (param("time_constant", "speed_lag", "set", 0.0, 0.3, 0.0, "s"),),
                    ((0.006,), (0.012,), (0.03,), (0.08,)),
                    "velocity filter",
                    note={"of": "speed"},
                )
            )
        return out

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        m = case.regimes
        return np.abs(m["_torque_rate"]) if note.get("of", "drive") == "drive" else m["acceleration"]

    def torque_columns(self, own: Columns) -> dict[str, Callable[[Columns], np.ndarray]]:
        return {self.by_torque: lambda d: d.rise}

    def parameters_by_torque(self, found: ByTorque) -> dict[str, Any]:  # the coefficient: of the rate of acceleration
        return {"time_constant": found.entry("s", over=found.joint["inertia"])}

    def size_by_torque(self, found: ByTorque) -> str:
        return f"{1e3 * found.value / found.joint['inertia']:.2g} ms"

    def refused_by_torque(self, value: float, joint: dict[str, float], slowest: float) -> str | None:
        # late, and its first term alone is fitted, which serves up to a radian of the lowest cutoff
        return None if 0 < value < abs(joint["inertia"]) / (2 * np.pi * slowest) else ""


class SetpointProfile(Effect):
    """A setpoint that the firmware moves towards the target at a limited speed, a limited acceleration, or both."""

    id = "setpoint_profile"
    words = "moves its setpoint at a limited speed or acceleration"
    shows = "in large steps, and at the start and end of motions"
    experiment = "steps of several sizes, and a slow motion: small ones are followed at once, large ones take longer"
    classes = ("limits at speed",)
    motions = ("steps", "ladder")
    demo = {"profile_speed": 2.0, "profile_acceleration": 30.0}

    def variants(self, s: Scales) -> list[Variant]:
        peak = s.peak_speed
        fast, steep = min(s.nominal["profile_speed"], 30 * peak), min(s.nominal["profile_acceleration"], 400 * peak)
        speed = param("speed", "profile_speed", "set", 0.2 * peak, 30 * peak, fast, "rad/s")
        # from rest to the peak speed in 2.5 ms to 2 s
        bend = param("acceleration", "profile_acceleration", "set", 0.5 * peak, 400 * peak, steep, "rad/s2")
        speeds, rises = (0.5, 0.7, 0.85, 1.0, 1.2, 1.6), (0.012, 0.04, 0.1, 0.7)
        both = tuple((x * peak, peak / t) for x, t in zip((1.0, 0.8, 1.3, 1.0), rises, strict=True))
        return [
            Variant((speed,), tuple((x * peak,) for x in speeds), "speed"),
            Variant((bend,), tuple((peak / t,) for t in rises), "acceleration"),
            Variant((speed, bend), both, "speed and acceleration", refines=True),
        ]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        m = case.regimes
        behind = np.abs(m["_error"])
        return behind * (m["speed"] > 0.7 * values["speed"]) if "speed" in values else behind


class PositionOffset(Effect):
    """An encoder's zero error."""

    id = "position_offset"
    words = "has an encoder zero error"
    shows = "with the pose"
    experiment = "static poses over the whole range"
    classes = ("zero or gravity",)
    motions = ("holds",)
    misreads = True

    def variants(self, s: Scales) -> list[Variant]:
        if s.gravity < 0.02 * s.tau and not s.apart:  # a loop's own encoder alone turns all, and gravity alone tells
            return []
        p = param("offset", "position_offset", "add", -0.6, 0.6, 0.0, "m" if s.slide else "rad")
        starts = ((-0.2,), (-0.07,), (-0.02,), (0.02,), (0.07,), (0.2,))
        if s.apart:  # of the encoder that reports, or of the loop's own as well
            read = param("offset", "readout_offset", "add", -0.6, 0.6, 0.0, "m" if s.slide else "rad")
            return [Variant((read,), starts, "readout"), Variant((p,), starts, "both encoders")]
        return [Variant((p,), starts)]

    def unseen(self, s: Scales) -> str:
        return "" if self.variants(s) else "gravity hardly acts on the joint, so its zero leaves no trace"


class PositionScale(Effect):
    """An encoder's scale error, or its eccentricity."""

    id = "position_scale"
    words = "has an encoder that is not linear in the position"
    shows = "with the pose"
    experiment = "the full range against a protractor or the stops"
    misreads = True
    parts_motor = True

    def variants(self, s: Scales) -> list[Variant]:
        out = [
            Variant(
                (param("scale", "position_scale", "set", 0.7, 1.4, 1.0),),
                ((0.85,), (0.94,), (0.98,), (1.02,), (1.06,), (1.15,)),
                "scale",
            )
        ]
        if s.apart:  # of the encoder that reports alone: the loop does not know
            read = param("scale", "readout_scale", "set", 0.7, 1.4, 1.0)
            out.insert(0, Variant((read,), out[0].starts, "scale of the readout"))
        if not s.slide and s.span > 0.5:
            e = min(0.2, 0.3 * s.span)
            params = (
                param("ecc_sin", "eccentric_sin", "set", -e, e, 0.0, "rad"),
                param("ecc_cos", "eccentric_cos", "set", -e, e, 0.0, "rad"),
            )
            out.append(
                Variant(params, ((0.2 * e, 0.0), (-0.2 * e, 0.0), (0.0, 0.2 * e), (0.0, -0.2 * e)), "eccentricity")
            )
            # its zero may have been set anywhere along the turn, and not where the model has it
            params = (params[0], param("ecc_cos", ("eccentric_cos", "position_offset"), "add", -e, e, 0.0, "rad"))
            out.append(
                Variant(
                    params,
                    ((0.05 * e, 0.2 * e), (-0.05 * e, -0.2 * e), (0.2 * e, 0.2 * e), (-0.2 * e, 0.2 * e)),
                    "eccentricity, its zero elsewhere",
                    complexity_price=SEARCH.imitates,
                )
            )
        return out

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        q = case.regimes["position"]
        if "scale" in values:
            return np.abs(q)
        return np.abs(values.get("ecc_sin", 0.0) * np.sin(q) + values.get("ecc_cos", 0.0) * (np.cos(q) - 1))

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        if "scale" in fit.value:
            return {"scale": fit.entry("scale", "1")}
        size = np.hypot(fit.value["ecc_sin"], fit.value["ecc_cos"])
        half = 0.5 * max(np.ptp(fit.interval["ecc_sin"]), np.ptp(fit.interval["ecc_cos"]))
        return {"eccentricity": entry(size, max(size - half, 0.0), size + half, "rad")}


class CurrentSensor(Effect):
    """Gain, offset or lost sign of the reading of the current: the motion is unaffected."""

    id = "current_sensor"
    words = "shows its effort with a wrong gain or offset"
    shows = "in the effort alone"
    experiment = "a hold under a known load"
    classes = ("static load",)
    effort_only = True

    def variants(self, s: Scales) -> list[Variant]:
        if not s.effort:
            return []
        gain = param("gain", "effort_gain", "set", -1.5, 3.0, 1.0)
        # beyond what the zero may be refitted to: a start nearer by than the belief stands says that it should go back
        far = max(0.1 * s.tau, 3.0 * s.effort_zero)
        most = max(s.tau, 2.0 * far)
        offset = param("offset", "effort_offset", "set", -most, most, 0.0, "N.m")
        return [Variant((gain, offset), ((0.7, 0.0), (1.3, 0.0), (1.0, far), (1.0, -far), (-1.0, 0.0)))]

    def unseen(self, s: Scales) -> str:
        return super().unseen(s) if s.effort else "no effort is recorded (or current_per_torque is unknown)"

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return np.abs((values.get("gain", 1.0) - 1) * case.regimes["_torque"] + values.get("offset", 0.0))

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        out = {"gain": fit.entry("gain", "1")}
        per = fit.table.current([fit.case.joint])[0]
        known = bool(np.isfinite(per))
        return out | {"offset": fit.entry("offset", "A" if known else fit.force, times=per if known else 1.0)}
