"""The plain model that an engineer fits first, of every joint: PD gains, torque limit, no-load speed, Coulomb and
viscous friction, delay, lag, added inertia, offset.

A small bounded least squares by simulation on a few windows of what is fitted, from the best of guesses all over the
bounds. Whatever else a diagnosis finds has to follow what was held out better than this, or this is what is handed on.

What recorded motions say against its friction: a stretch that begins at rest and moves the joint on needs, at its best
moment, more driving torque than dry friction. The drive's part is known where the drive is off (0) or its torque was
recorded, and is otherwise at most its limit; gravity and the other joints' pull are the model's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import mujoco
import numpy as np

from dexsim.actuator.columns import DRY_FRICTION
from dexsim.actuator.columns import INDEX as SERVO
from dexsim.actuator.reference import dry_friction, gear_load_friction
from dexsim.actuator.table import ServoTable
from dexsim.gap.effects.body import add_armature
from dexsim.gap.plant.case import Case
from dexsim.gap.plant.columns import INDEX, SERIES_INDEX, Param, expand
from dexsim.gap.plant.free_run import free_run
from dexsim.gap.read import pieces
from dexsim.gap.rules import BELIEF, JUDGE, SEARCH, TORQUE
from dexsim.gap.search.fit import Box, Fitter, Residuals, slopes_of
from dexsim.gap.search.hypotheses import subset

WINDOW, WINDOWS = 2.0, 12  # s of a window, and how many: more would say little more
GUESSES, BEST = 96, 2  # all over the bounds; of them so many are fitted, beside what is believed
AT_ONCE = 49  # guesses that are simulated together: between them there is a look at the clock
ITERATIONS = 10  # of the fit from each guess
WHOLE, FAR = 1200.0, 0.05  # s of recordings that are run whole; rad (m) from which an error there counts linearly
WIDER = 2.0  # x what is believed, a figure or the ends of its stated range: so far it may be off
LATEST, SLOWEST = 0.08, 0.05  # s: delay, lag
MOST_INERTIA, LEAST_INERTIA = 5.0, -0.5  # x the model's about the joint, that is added
OFFSET = 1.0  # of a joint's typical torque
COSTS = 1e-3  # of the loss: figures that do less than this together stay as they are believed
UNSTATED = ("braking_slope",)  # what is believed of an unknown drive is not the servo table's default (`plant.case`)
UNITS = {
    "torque_limit": "N.m",
    "no_load_speed": "rad/s",
    "coulomb_friction": "N.m",
    "viscous_friction": "N.m.s/rad",
    "delay": "s",
    "lag": "s",
    "inertia": "kg.m2",
    "offset": "N.m",
}


@dataclass
class Baseline:
    """Of one joint. value: figures that were fitted, in their units, servo columns but for `inertia` (added) and
    `offset` (a constant torque); factor: of columns in which the recordings differ, on what each states; error_before,
    error: rms of a free run over what was held out [rad or m] with what is believed and with them; squares [n]: those
    errors squared; at_bound: figures that stopped there, x what is believed (None: not tied to it); beside: columns of
    which the servo's file says nothing, as they were when it was judged, where the file's default is another."""

    joint: str
    value: dict[str, float]
    error_before: float
    error: float
    squares_before: np.ndarray = field(repr=False)
    squares: np.ndarray = field(repr=False)
    slide: bool = False
    at_bound: dict[str, float | None] = field(default_factory=dict)
    beside: dict[str, float] = field(default_factory=dict)
    factor: dict[str, float] = field(default_factory=dict)

    def entry(self) -> dict[str, Any]:
        """As `diagnosis.json` has it."""

        def unit(n: str) -> str:
            hinge = UNITS.get(n, "1")
            return hinge.replace("N.m", "N").replace("rad", "m").replace("kg.m2", "kg") if self.slide else hinge

        return {
            "error_before": self.error_before,
            "error": self.error,
            "parameters": {n: {"value": x, "unit": unit(n)} for n, x in self.value.items()},
            "at_bound": self.at_bound,
        }


def plain_model(case: Case, train: Sequence[int]) -> list[Param]:
    """Return what is fitted of a joint: around its belief, within its stated range where it has one; friction from none
    to what drives it."""
    s, out = case.scales, []

    def factor(name: str) -> None:
        value = s.nominal[name]
        if 0 < value < 1e8:
            low, high = case.ranges.get(name, (0.0, 0.0))
            low, high = (low / WIDER, WIDER * high) if high > low else (value / WIDER, WIDER * value)
            columns = s.damping if name == "kd" else (name,)
            out.append(Param(name, columns, "factor", min(low / value, 1.0), max(high / value, 1.0), 1.0))

    def most(name: str, high: float) -> None:
        value = min(s.nominal[name], high)
        out.append(Param(name, (name,), "set", 0.0, high, value, UNITS[name]))

    factor("kp")
    if s.nominal["kd"] > 0:
        factor("kd")
    elif s.nominal["kp"] > 0:  # a loop that is said not to damp: up to critical damping
        stiffness = s.nominal["kp"] * (s.nominal["torque_limit"] if s.voltage else 1.0)
        out.append(
            Param(
                "kd",
                ("kd",),
                "set",
                0.0,
                2.0 * s.nominal["kp"] * float(np.sqrt(s.inertia / max(stiffness, 1e-12))),
                0.0,
            )
        )
    factor("torque_limit")
    factor("no_load_speed")
    if not case.told:  # friction that the recorded torque has told is known
        room = min(min(room_for_friction(case, train).values()) - case.constants.friction, s.tau)
        stated = case.ranges.get("coulomb_friction", (0.0, 0.0))[1]
        room = min(room, WIDER * stated) if stated > 0 else room
        if room > 0:
            most("coulomb_friction", room)
        most("viscous_friction", max(3 * s.tau / s.speed, 2 * s.nominal["viscous_friction"]))
    out.append(Param("offset", ("bias",), "set", -OFFSET * s.tau, OFFSET * s.tau, 0.0, UNITS["offset"]))
    most("delay", max(LATEST, 2 * s.nominal["delay"]))
    most("lag", max(SLOWEST, 2 * s.nominal["lag"]))
    least = max(LEAST_INERTIA * s.inertia, -case.constants.armature)  # what the model's rotor can give
    out.append(Param("inertia", ("armature",), "add", least, MOST_INERTIA * s.inertia, 0.0, UNITS["inertia"]))
    return out


def fitted(
    case: Case,
    train: Sequence[int],
    span: dict | None = None,
    seed: int = 0,
    passed: Callable[[], bool] = lambda: False,
) -> tuple[list[Param], np.ndarray] | None:
    """Return the plain model of a joint, fitted on runs `train` (span: part of each run, s; passed: whether time is up,
    the best by then is taken): its parameters and their values [P]. None where there is nothing to fit."""
    windows = case.plant.windows(WINDOW, list(train), span=span)
    if not len(windows.window):
        return None
    pick = np.zeros(len(windows.window), bool)
    pick[np.unique(np.linspace(0, len(pick) - 1, WINDOWS).astype(int))] = True
    params = plain_model(case, train)
    fitter = Fitter(
        case.plant,
        subset(windows, pick),
        Residuals(case.sigma, sigma_q0=0.7 * case.sigma, sigma_v0=max(case.sigma / 0.02, 0.02 * case.scales.speed)),
        passed,
    )
    fits = _fits(fitter, params, np.random.default_rng(seed))
    # what is believed, the fit from there, or else the best, by how whole recordings are followed; there a few steps
    whole = case.plant.windows(None, list(train), span=span)
    t = case.plant.t[whole.sample_row]
    seconds = [np.ptp(t[whole.sample_window == w]) for w in range(len(whole.window))]
    some = np.cumsum(seconds) - seconds[0] <= WHOLE
    runs = Fitter(case.plant, subset(whole, some), Residuals(case.sigma, huber=max(FAR / case.sigma, 3.0)), passed)
    box = Box(params)
    start = np.clip(box.centre, box.low, box.high)
    tried = np.array([start, *fits])
    left = runs.loss(runs.residuals(params, tried))
    best = tried[int(np.flatnonzero(left <= (1 + SEARCH.apart) * left.min())[0])]
    if passed():
        return params, best
    slopes = slopes_of(runs.fit(params, x0=best, iterations=0))
    fit = runs.fit(params, x0=best, iterations=ITERATIONS, tolerance=5e-3, slopes=slopes, exact=False)
    return params, _put_back(runs, params, start, fit.x)


def _put_back(runs: Fitter, params: list[Param], start: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return a fit x [P] with what no recording tells as it is believed (start [P]): as many figures as leave the loss
    the same to `COSTS`, those that do least first. A limit that no motion reaches is one of them."""
    loss = lambda x: runs.loss(runs.residuals(params, x))  # noqa: E731
    order = np.argsort(loss(np.where(np.eye(len(params), dtype=bool), start, x)), kind="stable")
    tried = np.where(np.argsort(order)[None] < np.arange(len(params) + 1)[:, None], start, x)
    left = loss(tried)
    return tried[np.flatnonzero(left <= (1 + COSTS) * left[0])[-1]]


def judged(
    case: Case,
    plain: tuple[list[Param], np.ndarray] | None,
    test: Sequence[int],
    span: dict | None = None,
    whole: Any = None,
) -> Baseline | None:
    """Return the plain model of a joint (`fitted`) on runs `test` (span: part of each run, s). whole: the plant on
    which free runs are judged (None: the case's own). None where nothing was fitted or there is nothing to judge."""
    here = replace(case, plant=whole or case.plant)
    kept = here.plant.windows(None, list(test), span=span)
    if plain is None or not len(kept.window):
        return None
    params, x = plain
    measured = here.plant.q[kept.sample_row]
    before = (measured - free_run(here, [], np.zeros(0), kept, underway=True)[0]) ** 2
    after = (measured - free_run(here, params, x, kept, underway=True)[0]) ** 2
    value = {
        p.key: float(v * case.scales.nominal[p.key] if p.mode == "factor" else v)
        for p, v in zip(params, x, strict=True)
    }
    differ = {n for n in SERVO if len({float(row[SERVO[n]]) for row in case.plant.nominal}) > 1}
    factor = {p.key: float(v) for p, v in zip(params, x, strict=True) if p.mode == "factor" and p.key in differ}
    stopped = {
        p.key: float(v) if p.mode == "factor" else None
        for p, v in zip(params, x, strict=True)
        if v >= p.high - 1e-3 * p.span or (v <= p.low + 1e-3 * p.span and p.low != 0)
    }
    rms = lambda e: float(np.sqrt(np.mean(e)))  # noqa: E731
    beside = {n: case.scales.nominal[n] for n in UNSTATED if n not in case.stated}
    return Baseline(
        case.joint, value, rms(before), rms(after), before, after, case.scales.slide, stopped, beside, factor
    )


def _fits(fitter: Fitter, params: list[Param], rng: np.random.Generator) -> list[np.ndarray]:
    """Return [P] each, least squares from the best of guesses all over the bounds, and from what is believed."""
    box = Box(params)
    low, high, start = box.low, box.high, np.clip(box.centre, box.low, box.high)
    # a Latin square
    cells = np.stack([rng.permutation(GUESSES) for _ in params], 1) + rng.uniform(size=(GUESSES, len(params)))
    share = cells / GUESSES
    # factors evenly in their logarithm; the rest denser near none
    spread = np.array([p.mode == "factor" and p.low > 0 for p in params])
    safe = np.where(spread, low, 1.0)
    about = np.where(spread, 0.0, np.clip(start, low, high) * (low < 0))  # none, of what may be on both sides
    up = about + (high - about) * np.maximum(2 * share - 1, 0) ** 2 + (low - about) * np.maximum(1 - 2 * share, 0) ** 2
    one_sided = low + (high - low) * share**2
    guesses = np.where(spread, safe * (np.where(spread, high, 2.0) / safe) ** share, np.where(low < 0, up, one_sided))
    guesses = np.concatenate([start[None], guesses])
    loss = np.full(len(guesses), np.inf)
    for i in range(0, len(guesses), AT_ONCE):
        if i and fitter.passed():
            break
        loss[i : i + AT_ONCE] = fitter.loss(fitter.residuals(params, guesses[i : i + AT_ONCE]))
    order = np.argsort(loss)[:BEST]
    return [
        fitter.fit(params, x0=guesses[k], iterations=ITERATIONS, tolerance=5e-3).x
        for k in dict.fromkeys([0, *order.tolist()])
    ]


def overall(given: Sequence[Baseline], handed_on: Sequence[str] = ()) -> dict[str, Any]:
    """Return all joints together as `diagnosis.json` has them; empty where there is none. handed_on: joints of which it
    is written."""
    if not given:
        return {}
    rms = lambda parts: float(np.sqrt(np.mean(np.concatenate(parts))))  # noqa: E731
    return {
        "error_before": rms([b.squares_before for b in given]),
        "error": rms([b.squares for b in given]),
        "parameters": sorted({n for b in given for n in b.value}),
        "joints": {b.joint: b.entry() for b in given},
        "handed_on": list(handed_on),
    }


def forbidden(case: Case, trial: Any, train: Sequence[int]) -> str:
    """Return why a fitted hypothesis of a joint cannot be: its friction forbids a motion that was recorded. Empty where
    none is forbidden."""
    row = expand(case.plant, trial.fit.params, trial.fit.x[None])[0, 0]
    dry = {n: float(row[INDEX[n]]) for n in DRY}
    # than was believed: that is not this answer's
    more = any(dry[n] > (1 + BELIEF.tolerance) * case.scales.nominal.get(n, 0.0) + 1e-12 for n in HOLDING)
    return forbids(case, train, dry["coulomb_friction"], dry["friction_asymmetry"], dry) if more else ""


def write(plain: Baseline, table: ServoTable, spec: mujoco.MjSpec) -> list[str]:
    """Writes the plain model of a joint into the servo table and the model; returns what changed of the model, in
    words."""
    for name, x in (plain.beside | plain.value | {"standin_constant": plain.value.get("offset", 0.0)}).items():
        if name in SERVO and (x or name != "standin_constant"):
            table.set(plain.joint, name, round(x, 9))
    if table.loop == "velocity" and "kd" in plain.value:
        table.set(plain.joint, "speed_feedforward", round(plain.value["kd"], 9))
    if plain.factor and table.fitted is not None:
        table.fitted.setdefault(plain.joint, {}).update({n: round(x, 9) for n, x in plain.factor.items()})
    added = plain.value.get("inertia", 0.0)
    return [add_armature(spec, plain.joint, added)] if added else []


def left_by_what_is_handed_on(data: dict[str, Any]) -> float | None:
    """Return error [rad or m] that is left where it is the plain model of every judged joint that is handed on; None
    where it is not. data: of `overall`."""
    return data["error"] if data and set(data["handed_on"]) == set(data["joints"]) else None


def text(data: dict[str, Any], unit: str) -> str:
    """Return one line for a person."""
    if not data:
        return ""
    said = (
        f"A plain least squares (gains, limits, friction, delay, lag, inertia, offset) leaves "
        f"{1e3 * data['error']:.3g} {unit} of {1e3 * data['error_before']:.3g} on what was held out"
    )
    return said + (f"; use it for {', '.join(data['handed_on'])}: it is what is written" if data["handed_on"] else "")


def stopped(data: dict[str, Any]) -> list[str]:
    """Return sentences about figures of the plain model that ended at the bounds of what was tried."""
    out = []
    for joint, b in data.get("joints", {}).items():
        of = {n.replace("_", " "): x for n, x in b["at_bound"].items()}
        ended = [f"{n} ({x:.3g} x what is believed)" if x is not None else n for n, x in of.items()]
        if ended:
            more = "; a range in servo.yaml lets it go to twice and half of its ends" * any(of.values())
            out.append(
                f"{joint}: the plain least squares ends at its bound in {' and '.join(ended)}: what is believed of the "
                f"drive is further off than was tried, or another law acts{more}"
            )
    return out


# columns of dry friction that may hold a joint at rest
HOLDING = (*DRY_FRICTION, "gear_load_friction", "gear_load_friction_backdriven")
DRY = (*HOLDING, "friction_asymmetry", "stribeck_speed", "stribeck_exponent", "gear_load_power", "gear_load_unit")


def room_for_friction(case: Case, runs: Sequence[int], dry: Mapping[str, float] | None = None) -> dict[int, float]:
    """By direction (1, -1): the largest dry friction [N.m] with which every motion of these runs that began at rest
    could begin; infinite where none did. dry: columns `DRY`, whose breakaway and share of the load it has to leave room
    for (it is below 0 where those alone are too much)."""
    out = {1: np.inf, -1: np.inf}
    gives = BELIEF.gives_slide if case.scales.slide else BELIEF.gives  # so far it moves without sliding
    plant, speed = case.plant, case.regimes["_speed"]
    for r in runs:
        rows = plant.rows(r)
        t, q, v = plant.t[rows], plant.q[rows], speed[rows]
        if len(t) < 3:
            continue
        drive, pull = _drive(case, r), _series(case, r, "gravity_cos") + _series(case, r, "rest")
        for way in (1, -1):
            on = way * v > JUDGE.slides * case.scales.speed
            net = drive[way] - way * pull
            free = TORQUE.room * net - (_beyond_coulomb(dry, way, q, drive[way], pull) if dry else 0.0)
            for a, b in pieces(on):
                if a == 0 or abs(q[b - 1] - q[a]) < max(gives, 20 * case.sigma):
                    continue
                a = max(a - 2, 0)  # the torque that set it off is from just before
                drives = net[a:b] > 0
                out[way] = min(out[way], float(np.max(free[a:b][drives])) if drives.any() else 0.0)
    return out


def _beyond_coulomb(
    dry: Mapping[str, float], way: int, q: np.ndarray, drive: np.ndarray, pull: np.ndarray
) -> np.ndarray:
    """Return [S] dry friction [N.m] of a joint at rest that is about to move to one side, beyond its Coulomb friction:
    what it takes to break away, and what grows with the torques on its gear. drive: most torque that way; where that is
    not known the motor's share is left out."""
    motor = np.where(np.isfinite(drive), way * drive, 0.0)
    level = dry_friction(dict(dry) | {"coulomb_friction": 0.0}, q, np.full_like(q, way * 1e-9), motor, -pull)
    shares = dry["gear_load_friction"], dry["gear_load_friction_backdriven"]
    level = level + gear_load_friction(pull, way, *shares, dry["gear_load_power"], max(dry["gear_load_unit"], 1e-12))
    return level * (1 + 0.5 * way * dry["friction_asymmetry"])


def forbids(
    case: Case, runs: Sequence[int], friction: float, asymmetry: float = 0.0, dry: Mapping[str, float] | None = None
) -> str:
    """Return why a dry friction [N.m] (its asymmetry as in servo.yaml; dry: what is beside it, see `room_for_friction`)
    cannot be: a motion was recorded that it forbids. Empty where none is."""
    most = room_for_friction(case, runs)
    for way, room in room_for_friction(case, runs, dry).items():
        level = friction * (1 + 0.5 * way * asymmetry) + case.constants.friction
        if level > room:
            unit, where = "N" if case.scales.slide else "N.m", "forwards" if way > 0 else "backwards"
            return (
                f"a dry friction of {level + most[way] - room:.3g} {unit} would hold the joint, but it was recorded "
                f"setting itself in motion {where} with at most {most[way]:.3g} {unit} to drive it"
            )
    return ""


def _series(case: Case, run: int, name: str) -> np.ndarray:
    """Return a prescribed column at the samples of a run."""
    plant = case.plant
    rows = plant.rows(run)
    part = plant.series[plant._grid[run] : plant._grid[run + 1], SERIES_INDEX[name]]
    return np.interp(plant.t[rows] - plant.t[rows][0], plant.dt * np.arange(len(part)), part)


def _drive(case: Case, run: int) -> dict[int, np.ndarray]:
    """By direction: the most torque [S] that the drive may give that way."""
    plant = case.plant
    rows = plant.rows(run)
    shown, on = plant.torque[rows], _series(case, run, "enabled") > 0.5
    limit = float(plant.nominal[run][SERVO["torque_limit"]])
    limit = max(limit, case.ranges.get("torque_limit", (0.0, limit))[1])
    if "torque_limit" in case.unknown:
        limit = np.inf
    return {way: np.where(~on, 0.0, np.where(np.isfinite(shown), way * np.nan_to_num(shown), limit)) for way in (1, -1)}
