"""A second law for each effect that has one: other physics under the same name, so that what is measured is not how
well the tool knows one formula.

The law of a case is drawn by a generator of its own (`draw`), so that a seed gives the same rigs, motions and sizes to
search among whether laws are drawn or not. Where the second law has no parameter of the first, the truth holds an
equivalent: the first law's value that does the same in the recordings to fit, as each entry says. Effects that are
numbers rather than laws (a zero error, a scale, a rotor's inertia, gains, a sensor's gain on a pad; how stiff a contact
is, whose stiffening is an effect by itself) have none.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.concealed import plant
from benchmarks.concealed.effects import KINDS, Kind

AMBIENT = plant.AMBIENT
LAWS = ("two", "one")
Shown = dict[str, np.ndarray]


@dataclass(frozen=True)
class Law:
    """The second law of a form of an effect.

    first, second: both laws in words. apply(p, s, unit, inertia): as `Kind.apply`. report(L, n): values that take the
    place of those of `Kind.report`, of logs L [M] of the fitted recordings, one after another, and true parameters n.
    own: as `Kind.own`, None: the same. possible(p): whether a joint can have it.
    """

    first: str
    second: str
    apply: Callable
    report: Callable = lambda L, n: {}
    own: Callable | None = None
    possible: Callable = lambda p: True


def _with(kind: str, **more) -> Callable:
    """Return the form's own change, with parameters of the second law beside it."""
    return lambda p, s, u, i: KINDS[kind].apply(p, s, u, i) | more


def _share(x: np.ndarray, of: np.ndarray) -> float:
    """Return least-squares factor of x over `of`; 1 where there is nothing to compare."""
    return float(np.sum(x * of) / np.sum(of * of)) if np.any(of) else 1.0


def _viscous(L: Shown, n: dict) -> dict:
    """Return the coefficient that takes as much energy from the recorded motion."""
    v = np.abs(L["speed"])
    return {"coefficient": n["viscous"] + n["shear"] * _share(v / (1 + v / n["shear_speed"]), v)}


def _load(L: Shown, n: dict) -> dict:
    """Return the fractions that take as much energy, of motion that drives the load and of motion that it drives."""
    out, force, speed = {}, np.abs(L["load"]), np.abs(L["speed"])
    for key, name, on in (("fraction", "load", L["load"] * L["speed"] >= 0),
                          ("fraction_backdriven", "load_back", L["load"] * L["speed"] < 0)):  # fmt: skip
        bent = n["load_unit"] * (force / n["load_unit"]) ** n["load_power"]
        whole = np.sum((force * speed)[on])
        out[key] = n[name] * float(np.sum((bent * speed)[on]) / whole) if whole else n[name]
    return out


def _stiffness(L: Shown, n: dict) -> dict:
    """Load over twist at the rms load."""
    rms = float(np.sqrt(np.mean(L["load"] ** 2)))
    roots = np.roots([n["hardening"] ** -2, 0.0, 1.0, -rms])
    linear = float(roots[np.argmin(np.abs(roots.imag))].real)  # stiffness at no load times the twist
    return {"stiffness": n["spring"] * rms / linear if linear else n["spring"]}


def chance_of(recording: int) -> int:
    """Return where the row of chance of a recording's delays begins."""
    return 997 * recording


def late(delay: float, jitter: float, recordings: int, seconds: float) -> float:
    """Mean s from a message's sending to its acting, of recordings of some seconds each."""
    count = int(seconds / (plant.MESSAGE * plant.TICK))
    at = [plant.arrivals(delay, jitter, chance_of(k), count) for k in range(recordings)]
    return float(np.mean(np.stack(at) - np.arange(count) * plant.MESSAGE * plant.TICK))


def _eccentricity(L: Shown, n: dict) -> dict:
    """Return the amplitude of the one harmonic that comes nearest over the recorded angles."""
    q = L["position"]
    error = plant.encoded(q, 0.0, 0.0, n["eccentric"], n["eccentric_at"], n["second_harmonic"])
    fit = np.linalg.lstsq(np.stack([np.sin(q), np.cos(q)], 1), error, rcond=None)[0]
    return {"eccentricity": float(np.hypot(*fit))}


def _ecc_own(L: Shown, n: dict, o: dict) -> np.ndarray:
    return np.abs(plant.encoded(L["position"], 0.0, 0.0, n["eccentric"], n["eccentric_at"], n["second_harmonic"]))


def _tooth(L: Shown, n: dict, o: dict) -> np.ndarray:
    return np.abs(np.mod(n["per_turn"] * L["position"] + n["phase"] + np.pi, 2 * np.pi) / np.pi - 1)


def _soft_own(L: Shown, n: dict, o: dict) -> np.ndarray:
    """Return how much more the drive would have given as it is believed."""
    if n["voltage"]:
        gave = n["torque_limit"] * (plant.soft_limit(L["asked"], 1.0, n["knee"]) - L["speed"] / n["no_load_speed"])
        believed = o["torque_limit"] * (np.clip(L["asked"], -1, 1) - L["speed"] / o["no_load_speed"])
        return np.abs(believed - gave)
    room = np.maximum(1 - np.abs(L["speed"]) / n["no_load_speed"], 0)
    most = o["torque_limit"] * room
    return np.abs(np.clip(L["asked"], -most, most) - plant.soft_limit(L["asked"], n["torque_limit"] * room, n["knee"]))


def _corner_own(L: Shown, n: dict, o: dict) -> np.ndarray:
    line = o["torque_limit"] * np.maximum(1 - np.abs(L["speed"]) / o["no_load_speed"], 0)
    bent = n["torque_limit"] * np.clip(2 * (1 - np.abs(L["speed"]) / n["no_load_speed"]), 0, 1)
    return np.abs(np.clip(L["asked"], -line, line) - np.clip(L["asked"], -bent, bent))


def effort(tau: np.ndarray, current: dict[str, float], at: np.ndarray) -> np.ndarray:
    """Return the torque as a current sensor tells it; at [M]: share of the recording that is over."""
    full = current["current_full"]
    seen = full * np.tanh(tau / full) if full else tau
    return current["current_gain"] * seen + current["current_offset"] * (1 + current["current_drift"] * (2 * at - 1))


HEALTHY = {"current_gain": 1.0, "current_offset": 0.0, "current_full": 0.0, "current_drift": 0.0}
"""A current sensor as it should be: gain, offset N.m, the torque N.m towards which it saturates (0: none), share by
which its offset is smaller at the start of a recording and larger at its end."""

SECOND: dict[str, Law] = {
    "coulomb": Law("LuGre bristles", "ideal dry friction", _with("coulomb", bristle=0.0)),
    "coulomb_asymmetric": Law("LuGre bristles", "ideal dry friction", _with("coulomb_asymmetric", bristle=0.0)),
    # the peak at no speed and the speed at which 1/e of it is left are the same numbers
    "stribeck": Law("exp(-(|v|/vs)^2)", "exp(-|v|/vs)", _with("stribeck", peak_power=1.0),
                    own=lambda L, n, o: np.exp(-np.abs(L["speed"]) / n["peak_speed"]) * np.abs(L["slip"])),
    "viscous": Law("c v", "c v / (1 + |v|/v0), grease that thins", lambda p, s, u, i: {"shear": 0.4 * s * u}, _viscous),
    **{kind: Law("f |load|", "f |load|^(2/3)", lambda p, s, u, i, kind=kind: KINDS[kind].apply(p, s, u, i)
                 | {"load_power": 2 / 3, "load_unit": u}, _load) for kind in ("load", "load_one_way")},
    "backlash": Law("damped impacts", "rebounding teeth", _with("backlash", impact=0.1)),
    "compliance": Law("k d", "k d (1 + (k d / h)^2), hardening", lambda p, s, u, i:
                      KINDS["compliance"].apply(p, s, u, i) | {"hardening": 1.5 * u}, _stiffness),
    "delay": Law("the same for all", "half as much more or less from message to message, mean told",
                 _with("delay", jitter=0.5)),  # what is reported needs the base's own delay: `reported`
    # the sum of the stages' time constants is the mean delay of either law
    "lag": Law("first order", "second order", _with("lag", lag_order=2.0)),
    "speed_filter": Law("first order", "second order", _with("speed_filter", speed_order=2.0)),
    # the most that the drive gives at rest, and the speed at which nothing is left, are the same numbers
    "torque_limit": Law("sharp", "approached: x / (1 + |x/limit|^4)^(1/4)", _with("torque_limit", knee=4.0),
                        own=_soft_own),
    "speed_limit": Law("a line from rest on", "full up to half of the speed, then a line",
                       _with("speed_limit", corner=1.0), own=_corner_own,
                       possible=lambda p: not p["voltage"]),  # back-EMF is a line
    "sag": Law("by the others' torque", "by the others' torque times duty",
               lambda p, s, u, i: {"sag_duty": 2.0 * s / u},
               # least squares of what the supply lost on the others' torque
               lambda L, n: {"sag": _share(1 - L["supply"], L["others"])}),
    # the amplitude is half of peak to peak
    "ripple": Law("sine", "sawtooth", _with("ripple", sawtooth=1.0), own=_tooth),
    "warm_motor": Law("by the logged temperature", "by the winding's, which runs ahead of it",
                      lambda p, s, u, i: KINDS["warm_motor"].apply(p, s, u, i) | {"core": 0.6 * p["heat"]},
                      # least squares of the change on the logged temperature
                      lambda L, n: {"per_degree": n["thermal_torque"]
                                    * _share(L["winding"] - AMBIENT, L["temperature"] - AMBIENT)}),
    "warm_grease": Law("1 + a T", "exp(a T)", _with("warm_grease", exponential=1.0),
                       lambda L, n: {"per_degree": _share(np.expm1(n["thermal_friction"]
                                                                   * (L["temperature"] - AMBIENT)),
                                                          L["temperature"] - AMBIENT)}),
    "coupling": Law("by the angle", "by the angle's sine (a lever)", _with("coupling", arm=1.0),
                    lambda L, n: {"ratio": n["couple"] * _share(np.sin(L["source"]), L["source"])}),
    "eccentric": Law("one harmonic", "two harmonics", _with("eccentric", second_harmonic=0.35), _eccentricity,
                     own=_ecc_own),
    "payload": Law("a point", "a ball", _with("payload", bulk=0.8)),
    "deadband": Law("the whole error beyond it", "the error from its edge on", _with("deadband", subtract=1.0)),
    "current_gain": Law("a factor", "a factor that saturates", lambda p, s, u, i: {}, lambda L, n:
                        {"gain": _share(effort(L["torque"], n | {"current_offset": 0.0}, 0.0), L["torque"])}),
    "current_offset": Law("constant", "grows by half its mean either way in a recording, mean told",
                          lambda p, s, u, i: {}),
}  # fmt: skip


def fault(kind: str, second: bool, size: float, unit: float) -> dict[str, float]:
    """Return what a fault of a size changes of a HEALTHY current sensor: gain, or offset in typical torques `unit`
    [N.m]."""
    if kind == "current_gain":
        return {"current_gain": 1 + size} | ({"current_full": 4 * unit} if second else {})
    return {"current_offset": size * unit} | ({"current_drift": 0.5} if second else {})


def draw(kinds: list[str], p: list[dict], laws: str, seed: int, number: int) -> list[Law | None]:
    """Return the second law, or None for the first, of each form at a joint with parameters p; even chances where it
    has two.

    laws: "two" draws, "one" gives the first. Raises ValueError for another.
    """
    if laws not in LAWS:
        raise ValueError(f"laws={laws}: must be {' or '.join(LAWS)}")
    rng = np.random.default_rng([seed, 3, number])
    heads = rng.uniform(size=len(kinds)) < 0.5
    return [SECOND[k] if laws == "two" and has_two(k, own) and head else None for k, own, head in zip(kinds, p, heads)]


def has_two(kind: str, p: dict) -> bool:
    """Return whether a form has a second law at a joint with parameters p."""
    return kind in SECOND and SECOND[kind].possible(p)


def reported(kind: Kind, law: Law | None, logs: list[Shown], n: dict, o: dict) -> dict[str, float]:
    """Return {key: value} as the catalogue names them: `Kind.report`, with the equivalents of a second law.

    logs: of the recordings to fit; n, o: parameters of the joint as they are and as they are believed.
    """
    values = kind.report(n, o)
    if law is not None:
        together = {k: np.concatenate([np.asarray(L[k], float) for L in logs]) for k in logs[0]}
        values = values | law.report(together, n)
        if law is SECOND["delay"]:
            seconds = len(logs[0]["torque"]) * plant.TICK
            values = values | {"delay": late(n["delay"], n["jitter"], len(logs), seconds) - o["delay"]}
    return {k: float(v) for k, v in values.items()}


def described(kind: str, law: Law | None, p: dict) -> dict[str, str]:
    """Return what the truth says of the law: "first", "second", or "only" where there is one, and in words."""
    if not has_two(kind, p):
        return {"law": "only"}
    pair = SECOND[kind]
    return {"law": "second", "law_is": pair.second} if law else {"law": "first", "law_is": pair.first}
