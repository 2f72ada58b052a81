"""Effects that a concealed rig can hide: how the plant gets it, what `diagnosis.json` should say of it, where it
acts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Kind:
    """An effect as the plant has it, at one joint.

    effect: id of the catalogue, "" outside it. span: smallest and largest size. apply(p, s, unit, inertia): parameters
    that change, by true values p of the joint. report(new, old): {key: value} as the catalogue names them. own(L, new,
    old): [M] strength of the effect at every millisecond of a log L (arrays of the plant, with `command`, `others`,
    `source`).
    joints: least number. signal: "position", or "effort" where motion is unaffected. group: "drive" is tried on every
    rig.
    """

    effect: str
    span: tuple[float, float]
    apply: Callable
    report: Callable
    own: Callable
    joints: int = 1
    signal: str = "position"


def _plus(name):
    return lambda p, s, u, i: {name: p[name] + s}


def _torque(name):
    return lambda p, s, u, i: {name: p[name] + s * u}


def _less(name):
    return lambda p, s, u, i: {name: p[name] * (1 - s)}


def _moving(L, n, o):
    return np.abs(L["slip"]) > 0.5


def _clipped(L, n, o):
    """Return how much more the drive would have given as it is believed."""
    def give(p):
        if p["voltage"]:
            return p["torque_limit"] * (np.clip(L["asked"], -1, 1) - L["speed"] / p["no_load_speed"])
        most = p["torque_limit"] * np.maximum(1 - np.abs(L["speed"]) / p["no_load_speed"], 0)
        return np.clip(L["asked"], -most, most)

    return np.abs(give(o) - give(n))


def _late(L, n, o):
    return np.abs(np.gradient(_logged(L["command"])))


def _logged(x):
    """Return a signal as a log of 100 Hz tells it: commands come, and torque follows them, in steps of 10 ms."""
    return np.convolve(x, np.ones(10) / 10, "same")


def _acceleration(L):
    return np.abs(np.gradient(np.convolve(L["speed"], np.ones(31) / 31, "same")))  # commands come in steps of 10 ms


KINDS: dict[str, Kind] = {
    "coulomb": Kind("coulomb_friction", (0.0025, 1.0), _torque("coulomb"), lambda n, o: {"torque": n["coulomb"]},
                    _moving),
    "coulomb_asymmetric": Kind("coulomb_friction", (0.05, 1.9), lambda p, s, u,
                               i: {"asymmetry": s, "coulomb": p["coulomb"] + 0.15 * s * u},
                               lambda n, o: {"torque": n["coulomb"], "asymmetry": n["asymmetry"]}, _moving),
    "stribeck": Kind("stribeck_friction", (0.0025, 1.2), lambda p, s, u, i: {"peak": s * u}, lambda n,
                     o: {"peak": n["peak"], "v_s": n["peak_speed"]},
                     lambda L, n, o: np.exp(-((L["speed"] / n["peak_speed"]) ** 2)) * np.abs(L["slip"])),
    "viscous": Kind("viscous_friction", (0.0025, 1.0), lambda p, s, u, i: {"viscous": p["viscous"] + 0.2 * s * u},
                    lambda n, o: {"coefficient": n["viscous"]},
                    lambda L, n, o: np.abs(L["speed"])),
    "load": Kind("load_friction", (0.005, 0.8), lambda p, s, u, i: {"load": s, "load_back": s}, lambda n,
                 o: {"fraction": n["load"], "fraction_backdriven": n["load_back"]},
                 lambda L, n, o: np.abs(L["load"] * L["slip"])),
    "load_one_way": Kind("load_friction", (0.005, 0.8), lambda p, s, u, i: {"load": 0.4 * s, "load_back": s},
                         lambda n, o: {"fraction": n["load"], "fraction_backdriven": n["load_back"]}, lambda L, n,
                         o: np.abs(L["load"] * L["slip"])),
    "backlash": Kind("backlash", (0.0005, 0.4), _plus("play"), lambda n, o: {"gap": n["play"]}, lambda L, n,
                     o: _after(L["free"] > 0, 0.01)),
    "compliance": Kind("compliance", (0.005, 1.5), lambda p, s, u, i: {"spring": 10 * u / s}, lambda n,
                       o: {"stiffness": n["spring"]}, lambda L, n, o: np.abs(L["load"])),
    "delay": Kind("command_delay", (0.000125, 0.1), _plus("delay"), lambda n, o: {"delay": n["delay"] - o["delay"]},
                  _late),
    "lag": Kind("lag", (0.000125, 0.1), _plus("lag"), lambda n, o: {"time_constant": n["lag"]}, lambda L, n,
                o: np.abs(np.gradient(_logged(L["torque"])))),
    "speed_filter": Kind("lag", (0.00025, 0.1), _plus("speed_lag"), lambda n, o: {"time_constant": n["speed_lag"]},
                         lambda L, n, o: _acceleration(L)),
    "torque_limit": Kind("torque_limit", (0.05, 0.9), _less("torque_limit"), lambda n,
                         o: {"torque": n["torque_limit"]}, _clipped),
    "speed_limit": Kind("torque_speed_limit", (0.06, 0.95), _less("no_load_speed"), lambda n,
                        o: {"no_load_speed": n["no_load_speed"]}, _clipped),
    "sag": Kind("supply_sag", (0.0025, 0.6), lambda p, s, u, i: {"sag": s / u}, lambda n, o: {"sag": n["sag"]},
                lambda L, n, o: np.abs(L["others"]), joints=2),
    "ripple": Kind("torque_ripple", (0.005, 1.5), lambda p, s, u, i: {"ripple": s * u}, lambda n,
                   o: {"amplitude": n["ripple"], "per_turn": n["per_turn"]},
                   lambda L, n, o: np.abs(np.sin(n["per_turn"] * L["position"] + n["phase"]))),
    "warm_motor": Kind("thermal", (7.5e-05, 0.02), lambda p, s, u, i: {"thermal_torque": -s}, lambda n,
                       o: {"per_degree": n["thermal_torque"]},
                       lambda L, n, o: np.abs(L["torque"] * (L["temperature"] - 25.0))),
    "warm_grease": Kind("thermal", (0.00025, 0.1), lambda p, s, u, i: {"thermal_friction": s if s > 0.018 else -s},
                        lambda n, o: {"per_degree": n["thermal_friction"]},
                        lambda L, n, o: np.abs(L["slip"] * (L["temperature"] - 25.0))),
    "coupling": Kind("joint_coupling", (0.0005, 0.5), lambda p, s, u, i: {"couple": s}, lambda n,
                     o: {"ratio": n["couple"]}, lambda L, n, o: np.abs(L["source"]), joints=2),
    "offset": Kind("position_offset", (0.00025, 0.5), _plus("offset"), lambda n, o: {"offset": n["offset"]}, lambda L,
                   n, o: np.ones(len(L["torque"]))),
    "scale": Kind("position_scale", (0.00075, 0.3), _plus("scale"), lambda n, o: {"scale": n["scale"]}, lambda L, n,
                  o: np.abs(L["position"])),
    "eccentric": Kind("position_scale", (0.0005, 0.2), _plus("eccentric"), lambda n,
                      o: {"eccentricity": n["eccentric"]},
                      lambda L, n, o: np.abs(np.sin(L["position"] + n["eccentric_at"]))),
    "payload": Kind("payload", (0.06, 2.0), lambda p, s, u, i: {"extra": s * p["mass"]}, lambda n,
                    o: {"mass": n["extra"]}, lambda L, n, o: np.abs(np.sin(L["position"]))),
    "inertia": Kind("inertia", (0.05, 8.0), lambda p, s, u, i: {"rotor": p["rotor"] + s * i}, lambda n,
                    o: {"armature": n["rotor"] - o["rotor"]},
                    lambda L, n, o: _acceleration(L)),
    "gain": Kind("gain_mismatch", (0.07, 0.7), _less("kp"), lambda n, o: {"kp_factor": n["kp"] / o["kp"]}, lambda L, n,
                 o: np.abs(L["command"] - L["position"])),
    "damping": Kind("gain_mismatch", (0.07, 0.9), _less("kd"), lambda n, o: {"kd_factor": n["kd"] / o["kd"]}, lambda L,
                    n, o: np.abs(L["speed"])),
    "deadband": Kind("deadband", (0.0005, 0.3), _plus("deadband"), lambda n, o: {"width": n["deadband"]},
                     lambda L, n, o: np.abs(L["command"] - L["position"]) < n["deadband"]),
    "current_gain": Kind("current_sensor", (0.02, 1.5), lambda p, s, u, i: {}, lambda n,
                         o: {"gain": n["current_gain"]}, lambda L, n, o: np.abs(L["torque"]), signal="effort"),
    "current_offset": Kind("current_sensor", (0.005, 1.0), lambda p, s, u, i: {}, lambda n,
                           o: {"offset": n["current_offset"]}, lambda L, n, o: np.ones(len(L["torque"])),
                           signal="effort"),
}  # fmt: skip
OUTSIDE: dict[str, Kind] = {
    "dwell_stiction": Kind("", (0.02, 1.5), lambda p, s, u, i: {"dwell": s * u}, lambda n, o: {}, _moving),
    "cable_spring": Kind("", (0.02, 3.0), lambda p, s, u, i: {"cable": s * u}, lambda n, o: {}, lambda L, n,
                         o: np.abs(L["position"])),
    "compliant_mount": Kind("", (0.01, 1.0), lambda p, s, u, i: {"mount": 0.1 * s / u}, lambda n, o: {}, lambda L, n,
                            o: np.abs(L["load"])),
    "damaged_tooth": Kind("", (0.02, 3.0), lambda p, s, u, i: {"tooth": s * u}, lambda n, o: {}, lambda L, n,
                          o: np.abs(L["position"] - n["tooth_at"]) < n["tooth_width"]),
    "bus_stalls": Kind("", (0.01, 0.4), lambda p, s, u, i: {}, lambda n, o: {}, _late),
}  # fmt: skip
ALL = KINDS | OUTSIDE
BY_EFFECT: dict[str, list[str]] = {}
for _name, _kind in KINDS.items():
    BY_EFFECT.setdefault(_kind.effect, []).append(_name)


def _after(x: np.ndarray, seconds: float) -> np.ndarray:
    """Return true for some time around each moment of x."""
    n = max(int(seconds / 1e-3), 1)
    return np.convolve(x.astype(float), np.ones(2 * n + 1), "same") > 0


def stalled(command: np.ndarray, size: float, rng: np.random.Generator) -> np.ndarray:
    """Commands [J, M] as they arrive on a bus that stalls for `size` seconds about once a second."""
    out, M = command.copy(), command.shape[1]
    at = 0.0
    while True:
        at += rng.exponential(1.0) + 0.1
        a = int(at * 1000)
        if a >= M:
            return out
        b = min(a + int(1000 * size * rng.uniform(0.6, 1.4)), M)
        out[:, a:b] = out[:, a : a + 1]
        at = b / 1000
