"""From recordings to one simulated case a joint: measurements, the model along them, typical sizes, noise."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import mujoco
import numpy as np
from scipy.ndimage import uniform_filter1d

from dexsim.actuator.columns import INDEX as SERVO_INDEX
from dexsim.actuator.columns import NAMES as SERVO_NAMES
from dexsim.actuator.reference import over_time, shown_position, torque_along
from dexsim.actuator.table import ALL, ServoTable
from dexsim.gap import compute
from dexsim.gap.plant.batch import JointPlant, Windows, nominal_row
from dexsim.gap.plant.columns import DRAGGERS, INDEX, SERIES_INDEX, Scales, expand
from dexsim.gap.plant.mechanics import JointConstants, along, chain
from dexsim.gap.read import Run, spans
from dexsim.gap.read.noise import BESIDE, noise, noise_of, noises
from dexsim.gap.rules import BELIEF, SEARCH
from dexsim.recording.mechanism import QUICK
from dexsim.recording.smooth import local_polynomial

PHYSICAL = 0.0  # slope of the torque limit while braking of a drive that nothing is said of: full torque
STEPPED = 0.1  # of how far a joint goes: a first target farther from where it rests is a step
REFERENCE = 25.0  # degC: at which the figures of a data sheet hold
HALF_SECOND, FEWEST_SAMPLES = 0.5, 12  # s, and samples: numerics of the parts of a recording that may ring by itself
FEWEST_OF_ALL = 2 * FEWEST_SAMPLES  # of a whole recording, of whose differences a moment or a correlation is taken


@dataclass
class Case:
    """One joint's problem: its plant over all runs, its sizes and its noise (sigma rad, sigma_torque N.m or 0)."""

    joint: str
    index: int
    plant: JointPlant
    constants: JointConstants
    scales: Scales
    sigma: float
    quantum: float
    sigma_torque: float
    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)  # servo columns believed in a range
    unknown: tuple[str, ...] = ()
    stated: frozenset[str] = frozenset()  # servo columns of which the believed table says anything
    regimes: dict[str, np.ndarray] = field(default_factory=dict)  # what residuals are set against, by measurement row
    moved: bool = True
    loop_rate: float | None = None
    # of what the model says, by nuisance, where more than `BELIEF.tolerance` is known
    factors: dict[str, tuple[float, float]] = field(default_factory=dict)
    # its friction was read off the recorded torque: what the loop's error does not show is not doubted but known
    told: bool = False


def intervals_of(active: np.ndarray, case: Case, runs: list[Run], use: list[int]) -> list[dict]:
    """Stretches of time in which `active` [n] bool holds, by recording, short gaps joined; the longest 400."""
    out: list[dict] = []
    for r in use:
        rows = case.plant.rows(r)
        t, on = case.plant.t[rows], active[rows]
        merged = spans(t, on, 0.03)
        out += [{"recording": runs[r].name, "start": round(float(a), 4), "end": round(float(b), 4)} for a, b in merged]
    out.sort(key=lambda w: w["start"] - w["end"])
    out = out[:400]
    return sorted(out, key=lambda w: (w["recording"], w["start"]))


def quiet_noise(signals: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], quantum: float) -> float | None:
    """Return standard deviation of the measurement noise of a joint that rings by itself, from half seconds in which it
    does not; None where it does not ring. signals: times [S] s, positions [S] and what these miss local cubics by
    (`misfit`) [S - 2 BESIDE], of recordings.

    A joint that rings faster than its readings misses any smooth curve as noise does, and sample by sample the two
    cannot be told apart. But a sensor is not noisier at one time than at another but by how fast it moves (readings'
    times vary): a joint rings where it is louder by far (`BELIEF.rings`) than where it moves as fast or faster, and
    does so often (`BELIEF.ringing`)."""
    levels, speeds = [], []
    for t, x, miss in signals:
        if not len(miss):
            continue
        mid, q = t[BESIDE:-BESIDE], x[BESIDE:-BESIDE]
        part = ((mid - mid[0]) / HALF_SECOND).astype(int)
        ends = np.r_[0, np.flatnonzero(np.diff(part)) + 1, len(part)]  # times grow
        for a, b in zip(ends[:-1], ends[1:], strict=True):
            if b - a >= FEWEST_SAMPLES:
                levels.append(max(float(np.median(np.abs(miss[a:b]))) / 0.6745, quantum / np.sqrt(12), 1e-9))
                since = mid[a:b] - mid[a:b].mean()
                speeds.append(abs(float(since @ q[a:b]) / float(since @ since)))  # the slope of a straight line
    level = np.array(levels)[np.argsort(speeds)]
    # of the parts as fast or faster a few are needed to say what is usual there
    few = BELIEF.quiet_parts
    usual = [np.partition(level[i:], few)[few] for i in range(len(level) - few)]
    if not usual or np.mean(level[: len(usual)] > BELIEF.rings * np.array(usual)) <= BELIEF.ringing:
        return None
    return float(np.median(level[level < 2 * np.quantile(level, 0.1)]))


# autocorrelation of white noise's third differences, 2 to 4 samples apart: those are its weights 1, -3, 3, -1
WHITE = (0.3, -0.05, 0.0)


def usual_noise(runs: Sequence[Run], j: int, own: float, limits: np.ndarray) -> float | None:
    """Return standard deviation of the measurement noise of joint j, if it rings all the time, by the other joints'
    encoders; None where it does not seem to. own: by its samples; limits [J]: of the drives' torque.

    A joint that rings without a pause shows no noise of its own. It scatters by far more than the others of its
    machine that move as far (`BELIEF.noisier`; readings whose times vary are noisier where a joint moves), and not as
    a worse sensor does: its readings are not white (`BELIEF.coloured`), by their third differences, in which a slow
    motion is nothing, or where it rings too fast for that, they are those of a swing of steady size, which is seldom
    at its middle (`BELIEF.steady`), or its motor's torque scatters by even more than they do."""
    ways = np.mean([_way(r.t, r.q) for r in runs], 0)
    others = [k for k, way in enumerate(ways) if k != j and way > 0.5 * ways[j]]
    if len(others) < BELIEF.others:
        return None
    usual = float(np.median([_of_recordings(runs, [noise_of(r, k)[0] for r in runs]) for k in others]))
    if own <= BELIEF.noisier * usual:
        return None
    read = [r.readings(j)[1] for r in runs]
    apart = np.mean([_coloured(q) for q in read], 0) - WHITE
    if np.abs(apart).max() >= BELIEF.coloured or np.mean([_kurtosis(q) for q in read]) < BELIEF.steady:
        return usual
    return usual if _torque_scatter(runs, j, others, limits) > BELIEF.noisier * own / usual else None


def _kurtosis(x: np.ndarray) -> float:
    """Return fourth moment over the square of the second of the second differences of a signal x [S], what is far out
    left out; a normal distribution's where it is too short to tell."""
    second = np.abs(np.diff(x, 2))
    second = second[second < 4 * np.median(second) / 0.6745] if len(second) else second
    if len(second) < FEWEST_OF_ALL:
        return 3.0
    return float(np.mean(second**4) / np.mean(second**2) ** 2)


def _torque_scatter(runs: Sequence[Run], j: int, others: Sequence[int], limits: np.ndarray) -> float:
    """By how much the logged torque of joint j scatters, x what those of others do, each as a part of its drive's
    limit; 0 where it is not logged."""
    torques = [(r.t, r.torque) for r in runs if r.torque is not None and np.isfinite(r.torque[:, [j, *others]]).all()]
    if not torques:
        return 0.0
    each = [np.median([noise(t, torque[:, k])[0] for t, torque in torques]) / limits[k] for k in (j, *others)]
    return float(each[0] / np.median(each[1:]))


def _way(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return [J] how far joints with positions q [S, J] at t [S] s go in half a second, in the mean."""
    later = np.minimum(np.searchsorted(t, t + HALF_SECOND), len(t) - 1)
    return np.abs(q[later] - q).mean(0)


def _coloured(x: np.ndarray) -> np.ndarray:
    """Return [3] autocorrelation of the third differences of a signal x [S], 2 to 4 samples apart; white noise's where
    it is too short to tell. What a sudden motion adds is cut off."""
    third = np.diff(x, 3)
    cut = 3 * float(np.median(np.abs(third))) / 0.6745 if len(third) else 0.0
    if len(third) < FEWEST_OF_ALL or cut <= 0.0:
        return np.array(WHITE)
    third = np.clip(third, -cut, cut)
    return np.array([np.mean(third[k:] * third[:-k]) for k in (2, 3, 4)]) / np.mean(third**2)


def demand(
    row: np.ndarray, voltage: bool, cmd: np.ndarray, q: np.ndarray, v: np.ndarray, clip: bool = True
) -> np.ndarray:
    """Return motor torque [S] that the believed law gives along the measured motion, delay and lag aside. N.m"""
    p = lambda n: row[SERVO_INDEX[n]]  # noqa: E731
    pd = p("kp") * (cmd - q) - p("kd") * v
    return torque_along(pd, v, p("torque_limit"), p("no_load_speed"), voltage, limited=clip)


@dataclass
class Motion:
    """What a mechanism's joints do along its runs. mech: by run the times [n] s and series [J, n, E] of `along`;
    constants: of the joints; rows [J, C]: what is believed of the drives, by run; others: by joint those that may drag
    it, the nearest first; used: what was made of the plants of the joints that were asked for, by joint."""

    mech: list[tuple[np.ndarray, np.ndarray]]
    constants: list[JointConstants]
    rows: list[np.ndarray]
    others: dict[int, list[int]]
    used: dict[int, Any]


def build(
    model: mujoco.MjModel, runs: list[Run], device: str = "cpu", dt: float = 1e-3, only: set[str] | None = None
) -> list[Case]:
    """Return one case a joint (of `only`), over all runs (training and held-out alike: indices are those of `runs`)."""
    voltage = runs[0].servo.drive == "voltage"
    m = moved(model, runs, lambda j, plant: plant, device, dt, only)
    torques = []
    for run, row in zip(runs, m.rows, strict=True):
        noises(run)  # once, before every joint asks for it
        cmd = run.command_at(run.t)
        each = zip(row, cmd.T, run.q.T, run.vs.T, strict=True)
        torques.append(np.stack([demand(p, voltage, c, q, v) for p, c, q, v in each], 1))
    wanted = list(m.used)
    return compute.each(len(wanted), lambda k: _case(runs, m, wanted[k], torques))


def moved(
    model: mujoco.MjModel,
    runs: list[Run],
    use: Callable[[int, JointPlant], Any],
    device: str = "cpu",
    dt: float = 1e-3,
    only: set[str] | None = None,
    added: bool = True,
) -> Motion:
    """Return the joints (of `only`) along all runs. use(j, plant): what is made of each one's plant, which is not kept
    here; added: also what a mass that is added, or a tilt, would do to them."""
    joints = runs[0].joints
    J = len(joints)
    servo = runs[0].servo
    voltage = servo.drive == "voltage"
    for run in runs:
        run.smooth()
    found = compute.each(len(runs), lambda i: along(model, runs[i], joints, added))
    mech, constants = [(times, series) for times, series, _ in found], found[0][2]
    rows = [_believed(run, joints) for run in runs]
    given = [_given(run, row, *m, voltage) for run, row, m in zip(runs, rows, mech, strict=True)] if J > 1 else []
    wanted = [j for j in range(J) if only is None or joints[j] in only]
    others = {j: _draggers(model, joints, j, runs) for j in wanted}

    def one(k: int) -> Any:
        j = wanted[k]
        joint, c, dragging = joints[j], constants[j], others[j]
        rotor = c.armature if c.armature > 0 else 0.3 * _inertia(mech, j)
        out = JointPlant(
            joint, c, dt, voltage, servo.encoder("loop", [joint])[0], servo.encoder("position", [joint])[0], device
        )
        believed = [_drags(run, row[j], dragging) for run, row in zip(runs, rows, strict=True)]
        for i, run in enumerate(runs):
            exact = _shown(run, j, servo)
            if J > 1:
                mech[i][1][j][:, SERIES_INDEX["others_torque"]] = np.delete(given[i], j, 1).sum(1)
            for n, o in enumerate(dragging[:DRAGGERS]):
                exact[f"drag{n}"] = run.qs[:, o] - run.qs[0, o]
                _linked(mech[i][0], mech[i][1][j], mech[i][1][o], n, constants[o].armature)
            effort = None if run.torque is None else run.torque[:, j]
            out.add(
                nominal_row(believed[i], rotor),
                mech[i][0],
                mech[i][1][j],
                *_sent(run, j),
                run.t,
                run.q[:, j],
                effort,
                exact,
                None if run.read is None else run.read[:, j],
            )
        out.left_out = {i for i, run in enumerate(runs) if joint in run.left_out}
        out.finish()
        return use(j, out)

    used = dict(zip(wanted, compute.each(len(wanted), one), strict=True))
    return Motion(mech, constants, rows, others, used)


def _sent(run: Run, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Return times [K] s and values [K] of a joint's targets. Where the first is a step away from a joint that rests,
    what was sent before is not known: it is where the joint is, as a replay takes it, until that one acts."""
    t, targets, (_, q) = run.cmd_t, run.cmd[:, j], run.readings(j)
    way = np.ptp(q)
    if t[0] < run.t[0] or abs(targets[0] - q[0]) < STEPPED * way or np.abs(q[:3] - q[0]).max() > 0.01 * way:
        return t, targets
    return np.r_[t[0] - 1.0, t], np.r_[q[0], targets]


def _shown(run: Run, j: int, servo: ServoTable) -> dict[str, np.ndarray]:
    """Return what a recording prescribes of joint j's drive, by name of `SERIES`."""
    exact = {}
    if run.supply is not None and servo.supply_voltage:
        exact["supply"] = _mean(run.supply / servo.supply_voltage, run.t, 0.05)
    if run.enabled is not None:
        exact["enabled"] = (run.enabled[:, j] > 0.5).astype(float)
    if run.temperature is not None:
        exact["warmth"] = run.temperature[:, j] - REFERENCE
    return exact


def _inertia(mech: Sequence[tuple[np.ndarray, np.ndarray]], j: int) -> float:
    """Return a joint's inertia about itself, typical of all runs [kg.m2]."""
    return float(np.median([np.median(m[1][j][:, SERIES_INDEX["inertia"]]) for m in mech]))


def _believed(run: Run, joints: Sequence[str]) -> np.ndarray:
    """Return [J, C] servo columns of a recording, with what is believed of a drive of which nothing is said: that it
    brakes with its full torque."""
    rows = run.servo.nominal(joints)
    for row, joint in zip(rows, joints, strict=True):
        if not _stated(run.servo, joint, "braking_slope"):
            row[SERVO_INDEX["braking_slope"]] = PHYSICAL
    return rows


def _stated(table: ServoTable, joint: str, column: str) -> bool:
    return any(column in table.entries.get(key, {}) for key in (ALL, joint))


def _of_recordings(runs: Sequence[Run], values: Sequence[float]) -> float:
    """Return median over recordings of each one's median over its pieces (a contact cuts one into several): noise is
    the sensor's, and a recording that moves too fast to tell the two apart counts once."""
    by: dict[str, list[float]] = {}
    for run, value in zip(runs, values, strict=True):
        by.setdefault(run.name, []).append(value)
    return float(np.median([np.median(x) for x in by.values()]))


def _case(runs: Sequence[Run], m: Motion, j: int, torques: Sequence[np.ndarray]) -> Case:
    """Return joint j's case. torques [S, J]: what the drives' laws give along each run."""
    table, joint, voltage = runs[0].servo, runs[0].joints[j], runs[0].servo.drive == "voltage"
    plant, constants, rows, mech, others = m.used[j], m.constants[j], m.rows, m.mech, m.others[j]
    inertia, (ranges, unknown) = _inertia(mech, j), _open_figures(table, joint)
    cat = lambda get: np.concatenate([get(i) for i in range(len(runs))])  # noqa: E731
    t = plant.t
    q, v, a = (cat(lambda i, n=n: getattr(runs[i], n)[:, j]) for n in ("qs", "vs", "as_"))
    tau = cat(lambda i: torques[i][:, j])
    cmd = cat(lambda i: runs[i].command_at(runs[i].t)[:, j])
    asked = cat(
        lambda i: demand(
            rows[i][j], voltage, runs[i].command_at(runs[i].t)[:, j], runs[i].q[:, j], runs[i].vs[:, j], clip=False
        )
    )
    limit = rows[0][j][SERVO_INDEX["torque_limit"]]
    estimates = [noise_of(run, j) for run in runs]
    told = [i for i in range(len(runs)) if i not in plant.left_out]
    sigma, quantum = (_of_recordings([runs[i] for i in told], [estimates[i][k] for i in told]) for k in (0, 1))
    quiet = quiet_noise([(*runs[i].readings(j), noises(runs[i])[2][j]) for i in told], quantum)
    sigma = min(sigma, quiet) if quiet is not None else sigma
    usual = usual_noise([runs[i] for i in told], j, sigma, rows[0][:, SERVO_INDEX["torque_limit"]])
    sigma = min(sigma, usual) if usual is not None else sigma

    def series(name: str) -> np.ndarray:
        each = [np.interp(runs[i].t, mech[i][0], mech[i][1][j][:, SERIES_INDEX[name]]) for i in range(len(runs))]
        return np.concatenate(each)

    gravity, load_t, load_i = series("gravity_cos"), series("load_cos"), series("load_inertia")
    spring = max(float(np.median([r[j][SERVO_INDEX["kp"]] for r in rows])) * (limit if voltage else 1.0), 1e-9)
    load = gravity + series("rest") + inertia * a
    tau_scale = max(
        min(_big(tau), 3 * _big(load) + 1e-12) if _big(tau) > 0 else _big(load),
        1e-3 * spring * max(np.ptp(q), 1e-6),
        1e-9,
    )
    effort_noise = _effort_noise(plant, runs, j)
    scales = Scales(
        tau=tau_scale,
        demand=max(_big(asked, 99.8) if not voltage else limit, tau_scale),
        speed=max(_big(v), 1e-6),
        peak_speed=max(_big(v, 99.8), 1e-6),
        error=max(_big(cmd - plant.q, 90), sigma),
        stiffness=spring,
        inertia=inertia,
        gravity=_big(gravity, 99),
        span=max(float(np.ptp(q)), 1e-9),
        sigma=sigma,
        nominal=_nominal(rows, j),
        others=tuple(runs[0].joints[o] for o in others[:DRAGGERS]),
        others_torque=_big(plant.series[:, SERIES_INDEX["others_torque"]], 99),
        load_torque=_big(load_t),
        load_inertia=float(np.median(load_i)),
        tilt={k: _big(np.hypot(series(f"tilt_{k}_cos"), 0)) for k in "xyz"},
        warm=_warmth(runs, j),
        slide=constants.slide,
        voltage=voltage,
        effort=effort_noise > 0,
        saturates=float(np.mean(np.abs(asked) >= limit * 0.98)),
        unknown=unknown,
        base_friction=constants.friction,
        base_damping=constants.damping,
        armature=constants.armature,
        own_torque=_big(series("own_cos")),
        own_inertia=float(np.median(series("own_inertia"))),
        leaf_mass=constants.leaf_mass,
        own_mass=constants.own_mass,
        velocity_loop=table.loop == "velocity",
        apart=plant.loop == "motor" and plant.position == "joint",
    )
    regimes = _regimes(t, plant.run_of, q, v, a, load, tau, asked, limit, cmd, runs, j)
    regimes |= {"_gravity": gravity} | _drags_of(runs, others)
    regimes |= {"_error": cmd - plant.q, "_speed": v} | _rates(runs, torques, j)
    regimes |= {"_added": load_t, "_added_own": series("own_cos")}
    regimes["_others"] = cat(lambda i: np.abs(np.delete(torques[i], j, 1)).sum(1))
    stated = frozenset(n for k in (joint, ALL) for n in table.entries.get(k, {}))
    return Case(
        joint,
        j,
        plant,
        constants,
        scales,
        sigma,
        quantum,
        effort_noise,
        ranges,
        unknown,
        stated,
        regimes,
        scales.span > 6 * sigma,
        table.loop_rate,
    )


def _big(x: np.ndarray, percentile: float = 95) -> float:
    """Return a typical large size of x [n]; 0 of nothing."""
    return float(np.percentile(np.abs(x), percentile)) if len(x) else 0.0


def _nominal(rows: Sequence[np.ndarray], j: int) -> dict[str, float]:
    """Return what is believed of joint j's drive, by column: the median of the recordings, limits that are none made
    finite."""
    nominal = {name: float(np.median([r[j][i] for r in rows])) for i, name in enumerate(SERVO_NAMES)}
    return nominal | {k: min(nominal[k], 1e9) for k in ("torque_limit", "no_load_speed")}


def _effort_noise(plant: JointPlant, runs: Sequence[Run], j: int) -> float:
    """Return rms of the recorded torque's noise [N.m]; 0 where it was recorded for less than half of the time."""
    if np.isfinite(plant.torque).mean() <= 0.5:
        return 0.0
    e = [noise(run.t, np.nan_to_num(run.torque[:, j]))[0] for run in runs if run.torque is not None]
    return max(float(np.median(e)), 0.01 * _big(plant.torque[np.isfinite(plant.torque)]), 1e-9)


def _warmth(runs: Sequence[Run], j: int) -> float:
    """Return degC by which joint j's drive is warmer or colder than its data sheet, at most; 0 where its temperature
    hardly changes or is not recorded."""
    logged = [run.temperature[:, j] for run in runs if run.temperature is not None]  # of all runs or none
    if not logged:
        return 0.0
    heat = np.concatenate(logged)
    return float(max(np.ptp(heat), np.abs(heat - REFERENCE).max())) if np.ptp(heat) >= SEARCH.warmth else 0.0


def _open_figures(table: ServoTable, joint: str) -> tuple[dict[str, tuple[float, float]], tuple[str, ...]]:
    """Return (columns that are believed in a range, those of which nothing is believed)."""
    values = {name: table.value(joint, name) for name in SERVO_NAMES}
    ranges = {n: (v.low, v.high) for n, v in values.items() if not v.unknown and v.low < v.high}
    return ranges, tuple(n for n, v in values.items() if v.unknown)


def _drags_of(runs: Sequence[Run], others: Sequence[int]) -> dict[str, np.ndarray]:
    """Return how far the joints that may drag this one have moved since a recording's first sample."""

    def moved_by(run: Run, k: int) -> np.ndarray:
        return run.qs[:, others[k]] - run.qs[0, others[k]] if k < len(others) else np.zeros(len(run.t))

    return {f"_drag{k}": np.concatenate([moved_by(run, k) for run in runs]) for k in range(DRAGGERS)}


def _rates(runs: Sequence[Run], torques: Sequence[np.ndarray], j: int) -> dict[str, np.ndarray]:
    """Return how fast joint j's command and torque change."""
    command = [np.gradient(np.interp(r.t, r.cmd_t, r.cmd[:, j]), r.t) for r in runs]
    torque = [np.gradient(x[:, j], r.t) for x, r in zip(torques, runs, strict=True)]
    return {"_command_rate": np.concatenate(command), "_torque_rate": np.concatenate(torque)}


def _regimes(
    t: np.ndarray, run_of: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray, load: np.ndarray, tau: np.ndarray,
    asked: np.ndarray, limit: float, cmd: np.ndarray, runs: Sequence[Run], j: int,
) -> dict[str, np.ndarray]:  # fmt: skip
    """Return variables [n] of each measured sample, that a residual may depend on."""
    small = 0.02 * np.percentile(np.abs(v), 95) + 1e-12
    since = np.concatenate([_since_reversal(t[run_of == r], v[run_of == r], small) for r in np.unique(run_of)])
    out = {
        "time since reversal": since,
        "speed": np.abs(v),
        "acceleration": np.abs(a),
        "load": np.abs(load),
        "position": q,
        "direction": np.sign(v),
        "driven against its load": np.sign(v * tau),
        "position error": np.abs(cmd - q),
        "saturation": np.abs(asked) / limit if np.isfinite(limit) else np.zeros_like(t),
        "time": t.copy(),
    }
    out |= {"_torque": tau, "_asked": asked, "_load": load, "_friction": 0.0 * tau}
    logged = [r.temperature[:, j] for r in runs if r.temperature is not None]  # of all runs or none
    if logged:
        out["temperature"] = np.concatenate(logged)
    J = len(runs[0].joints)
    for o in range(J):
        if o != j and J <= 16:
            out[f"motion of {runs[0].joints[o]}"] = np.abs(np.concatenate([r.vs[:, o] for r in runs]))
    return out


def _since_reversal(t: np.ndarray, v: np.ndarray, small: float) -> np.ndarray:
    """Return [n] s at times t [n] since the speed v [n] changed its sign, at most 9; less than `small` is no speed."""
    sign = np.where(np.abs(v) < small, 0, np.where(v > 0, 1, -1))
    moves = np.flatnonzero(sign)
    turns = moves[1:][sign[moves[1:]] != sign[moves[:-1]]]
    at = np.searchsorted(turns, np.arange(len(t)), side="right") - 1
    last = np.r_[t[turns], -np.inf][at]  # before any: infinitely long ago
    return np.minimum(t - last, 9.0)


def _linked(times: np.ndarray, series: np.ndarray, other: np.ndarray, k: int, armature: float) -> None:
    """Writes rate, acceleration and link-side torque of another joint (its series [n, E] at times [n]) as dragger k of
    a joint."""
    speed = other[:, SERIES_INDEX["v"]]
    acceleration = np.gradient(speed, times)
    series[:, SERIES_INDEX[f"drag_v{k}"]] = speed
    series[:, SERIES_INDEX[f"drag_a{k}"]] = acceleration
    load = (
        (other[:, SERIES_INDEX["inertia"]] - armature) * acceleration
        + other[:, SERIES_INDEX["gravity_cos"]]
        + other[:, SERIES_INDEX["rest"]]
    )
    series[:, SERIES_INDEX[f"pull{k}"]] = load


def dragged_by(case: Case, others: Sequence[Case]) -> Case:
    """Return the case with other joints, at most `DRAGGERS` of the same recordings, in the place of the last of those
    that may drag it."""
    first = DRAGGERS - len(others)
    plant, regimes, series = copy.copy(case.plant), dict(case.regimes), np.copy(case.plant.series)
    for n, other in enumerate(others, first):
        for run in range(plant.runs):
            here, there = plant.grid(run), other.plant.series[plant.grid(run)]
            _linked(plant.dt * np.arange(len(there)), series[here], there, n, other.constants.armature)
            series[here, SERIES_INDEX[f"drag{n}"]] = there[:, SERIES_INDEX["q"]] - there[0, SERIES_INDEX["q"]]
        q = [other.plant.q[plant.rows(run)] for run in range(plant.runs)]
        regimes[f"_drag{n}"] = np.concatenate([x - x[0] for x in q])
    plant.set_series(series)
    names = (*case.scales.others[:first], *(x.joint for x in others))
    return replace(case, plant=plant, scales=replace(case.scales, others=names), regimes=regimes)


def _draggers(model: mujoco.MjModel, joints: Sequence[str], j: int, runs: Sequence[Run]) -> list[int]:
    """Return other joints that move, the nearest in the kinematic tree first."""
    moved = [o for o in range(len(joints)) if o != j and max(np.ptp(r.qs[:, o]) for r in runs) > 0.01]
    chains = [{*chain(model, model.jnt_bodyid[model.joint(n).id])} for n in joints]

    def far(o: int) -> tuple[float, int]:
        return len(chains[j] ^ chains[o]) - 0.1 * len(chains[j] & chains[o]), o

    return sorted(moved, key=far)


def _given(run: Run, rows: np.ndarray, times: np.ndarray, series: np.ndarray, voltage: bool) -> np.ndarray:
    """Return [n, J] |motor torque| of each joint (servo columns rows [J, C]) at times [n] along the motion that is
    prescribed: by commands of those moments, which are finer than the samples. N.m"""
    cmd = run.command_at(times)
    q, v = SERIES_INDEX["q"], SERIES_INDEX["v"]
    return np.abs(np.stack([demand(rows[j], voltage, cmd[:, j], x[:, q], x[:, v]) for j, x in enumerate(series)], 1))


def _drags(run: Run, row: np.ndarray, others: list[int]) -> np.ndarray:
    """Return a joint's servo columns [C] with `coupling_from` counted among the plant's draggers (joints `others`, of
    which the first four are simulated, and the one that is believed to drag goes first), not among the mechanism's
    joints."""
    row = row.copy()
    if row[SERVO_INDEX["coupling"]]:
        name = (run.counted or run.joints)[int(row[SERVO_INDEX["coupling_from"]])]
        source = run.joints.index(name) if name in run.joints else -1
        if source in others:
            others.remove(source)
            others.insert(0, source)
        else:  # it stands still
            row[SERVO_INDEX["coupling"]] = 0.0
    row[SERVO_INDEX["coupling_from"]] = 0.0
    return row


def _mean(x: np.ndarray, t: np.ndarray, seconds: float) -> np.ndarray:
    """Return moving mean over +- seconds."""
    n = max(int(round(seconds / max(float(np.median(np.diff(t))), 1e-6))), 1)
    return uniform_filter1d(x, 2 * n + 1, mode="nearest")


# -- motions sharper than their samples -------------------------------------------------------------------------------
# Motions sharper than their samples: what joints that hang on each other do to each other, from the simulation's own
# accelerations.
#
# Differentiating samples smears out every start and stop, and the neighbours of a joint feel its acceleration. Here
# each joint is simulated along the recording with what is believed, and only the small difference from what was
# measured is smoothed. Once something was fitted, `refine_motion_by_fits` does the same with that: what is left to be
# smoothed is smaller, and so is its error.

WIDTH = 0.06  # s: of the smoothing of the difference
EVERY = 2e-3  # s between the samples of the refined motion
TURN = 1e-4  # rad: over which the change of an encoder's slope is taken
PASSES = 2  # of building the cases along the motion that they show


def refined_cases(
    model: mujoco.MjModel, runs: list[Run], device: str, dt: float, only: set[str] | None = None
) -> list[Case]:
    """Return a case a joint (of `only`), built along refined motions (`Run.fine`) where there are several joints."""
    if len(runs[0].joints) < 2:
        return build(model, runs, device, dt)
    for _ in range(PASSES):
        by_joint = moved(model, runs, lambda j, plant: _alone(runs, j, plant), device, dt, added=False).used
        _refine(runs, _beside(runs, [*by_joint], [*by_joint.values()]))
    return build(model, runs, device, dt, only)


def _beside(runs: Sequence[Run], joints: Sequence[int], motions: Sequence[Sequence[tuple]]) -> list[list[tuple]]:
    """Return by joint and run the motions (times, position, speed, acceleration) of plants of these joints, with what
    was measured beside them, smoothed: of all joints of a run at once."""

    def one(i: int) -> list[tuple]:
        run, each = runs[i], [by_run[i] for by_run in motions]
        t, q = run.t, run.q[:, joints]
        left = q - np.stack([np.interp(t, times, x) for times, x, _, _ in each], 1)
        rest = np.stack(run.local(WIDTH)(left))
        # a belief that is far off leaves much of the motion to the smoothing, which must not cut what is fast
        far = np.std(left - rest[0], 0) > [SEARCH.enough * noise_of(run, j)[0] for j in joints]
        if far.any():
            rest[:, :, far] = local_polynomial(t, left[:, far], WIDTH, QUICK)
        return [
            (times, *(x + np.interp(times, t, y) for x, y in zip(known, rest[:, :, k], strict=True)))
            for k, (times, *known) in enumerate(each)
        ]

    return [list(by_run) for by_run in zip(*compute.each(len(runs), one), strict=True)]


def _refine(runs: Sequence[Run], motions: Sequence[Sequence[tuple]]) -> None:
    """Writes `Run.fine`, of what each joint does in each run."""
    for i, run in enumerate(runs):
        columns = [by_run[i] for by_run in motions]
        run.fine = (columns[0][0], *(np.stack([c[k] for c in columns], 1) for k in (1, 2, 3)))


def coupled(cases: Sequence[Case]) -> bool:
    """Return whether the joints' motions reach each other through the mechanism."""
    return any(float(np.std(c.plant.series[:, SERIES_INDEX["rest"]])) > SEARCH.coupled * c.scales.tau for c in cases)


def refine_motion_by_fits(
    model: mujoco.MjModel, runs: list[Run], cases: Sequence[Case], fitted: Sequence[Any], device: str, dt: float
) -> list[Case]:
    """Return the cases built anew along motions refined with what was fitted to each (trials, in the order of the
    cases); joints without a case move as they did. Where a joint's encoder was found not to show its position, the
    others are moved by where it is."""
    at, was = [], [run.fine for run in runs]
    place = [runs[0].joints.index(case.joint) for case in cases]
    for case, trial in zip(cases, fitted, strict=True):
        at.append(expand(case.plant, trial.fit.params, trial.fit.x[None], trial.fixed))
    made = compute.each(len(cases), lambda k: _alone(runs, place[k], cases[k].plant, at[k]))
    motion = _beside(runs, place, made)
    misread = [k for k, trial in enumerate(fitted) if any(m.effect.misreads for m in trial.members)]

    def built(own: int | None) -> list[Case]:
        def shown(j: int, i: int) -> tuple[np.ndarray, ...]:
            if j not in place:
                assert (fine := was[i]) is not None  # as `refined_cases` leaves it
                return fine[0], *(x[:, j] for x in fine[1:])
            k = place.index(j)
            return true_motion(motion[k][i], at[k][0, i]) if k in misread and k != own else motion[k][i]

        _refine(runs, [[shown(j, i) for i in range(len(runs))] for j in range(len(runs[0].joints))])
        return build(model, runs, device, dt, {case.joint for case in cases})

    out = built(None)
    for k in misread:  # what a case holds of its own joint is what was measured
        out[k] = built(k)[k]
    for new, old in zip(out, cases, strict=True):
        new.ranges, new.unknown, new.factors, new.told = old.ranges, old.unknown, old.factors, old.told
        new.plant.nominal = old.plant.nominal  # with what the recorded torque told
        new.scales.nominal.update(old.scales.nominal)
    return out


def true_motion(shown: tuple[np.ndarray, ...], row: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return motion (times, q, v, a) as an encoder shows it -> as it is, by plant parameters [C]."""
    t, q, v, a = shown
    p = {name: row[i] for name, i in INDEX.items()}
    x = (q - p["position_offset"]) / p["position_scale"]
    for _ in range(3):
        x = x + (q - over_time(shown_position, p, t, x)[0]) / p["position_scale"]
    rate = over_time(shown_position, p, t, x)[1]
    before, after = (over_time(shown_position, p, t, x + step)[1] for step in (-TURN, TURN))
    speed = v / rate
    return t, x, speed, (a - (after - before) / (2 * TURN) * speed**2) / rate


def _alone(runs: Sequence[Run], j: int, plant: JointPlant, at: np.ndarray | None = None) -> list[tuple]:
    """By run the times [n] s, and position, speed and acceleration [n] of joint j as its plant moves free from the
    first sample on; at [1, R, C]: plant parameters (None: believed)."""
    every, out = max(int(round(EVERY / plant.dt)), 1), []
    step = every * plant.dt
    for i, run in enumerate(runs):
        whole = plant.windows(None, [i], every_run=True, between=True)
        window = whole.window[:1].copy()
        steps = np.arange(0, window[0, 1], every, dtype=np.int32)
        n = len(steps)
        window[0, 3:5] = 0, n
        times, of = whole.window_t[0] + plant.dt * steps, np.zeros(n, int)
        seen = Windows(window, whole.window_t[:1], steps, np.zeros(n), of, of, whole.run[:1])
        x = plant.simulate(plant.base()[None] if at is None else at, seen)[0][0]
        # the belief does not follow at all
        if not np.isfinite(x).all() or np.abs(x - np.interp(times, run.t, run.q[:, j])).max() > 1.0:
            x = np.interp(times, run.t, run.qs[:, j])
        v = np.gradient(x, step)
        v = np.convolve(np.pad(v, 1, mode="edge"), [0.25, 0.5, 0.25], mode="valid")
        out.append((times, x, v, np.gradient(v, step)))
    return out
