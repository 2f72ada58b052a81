"""The few final hypotheses once more, in the engine and the servo that train policies.

The search simulates each joint alone in the gap's own plant. Here the whole mechanism runs free over what was held out
of the fit, all joints at once, under the same commands: in C MuJoCo or, where asked, in MuJoCo-Warp, with the servo's
columns and model fields that are handed on, and nothing else. Every hypothesis and every recording is a world of one
batch.
"""

from __future__ import annotations

import copy
import itertools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch

from dexsim.actuator.columns import COLUMNS, DELAYS
from dexsim.actuator.columns import INDEX as SERVO_INDEX
from dexsim.actuator.servo import FIELDS, Servo
from dexsim.actuator.table import ServoTable
from dexsim.errors import UserError
from dexsim.gap.effects.catalogue import model_columns
from dexsim.gap.judge.handed_on import columns_beside, handed, model_changes, moved_friction, undamped
from dexsim.gap.plant.batch import Windows
from dexsim.gap.plant.case import REFERENCE, Case
from dexsim.gap.plant.columns import SERIES_INDEX, expand
from dexsim.gap.plant.free_run import free_run
from dexsim.gap.read import Run
from dexsim.gap.rules import JUDGE
from dexsim.gap.search.search import Trial
from dexsim.recording.mechanism import Mechanism
from dexsim.sim import make_engine

if TYPE_CHECKING:
    from dexsim.gap.plant.batch import Windows

STEP = 5e-4  # s: of the engine; its error is of first order in it
REPLAY = ("mujoco", "warp", "none")
TASKS = 0.007  # s: the step at which the tasks train (configs/config.yaml)
WARM_EVERY = 0.1  # s: how often a drive's temperature is renewed
BEFORE = 0.6  # s: commands sent so long before the first sample are sent, for they may still act
MOST = 8.0  # s of what was held out that is replayed at most: a step of the engine is a turn of Python
PILOT, LEAST = 0.1, 1.0  # s that are replayed to see how long it takes, and at least


class NoTime(Exception):
    """Less can be replayed in the time that there is than would say anything."""


@dataclass
class Hypothesis:
    """A name and the fitted trial of each joint that has one; joints without one are driven as believed."""

    name: str
    trials: dict[str, Trial]


@dataclass
class World:
    """One free run: what drives it and where it begins. All in the units the encoders report, J joints of the
    mechanism.

    rows [J, C]: servo columns; table: of the drive (its kind and clock); gravity [3]; duration s; q, v [J]: first
    position and speed; target [J]: in force before the first of the commands; stamps [K] s from the start, targets [K,
    J] (NaN keeps the last); enabled: None or (times, [n, J]); warmth: the same, in degC above the reference; home [J]:
    from where a joint that drags another is counted (None: q)."""

    rows: np.ndarray
    table: ServoTable
    gravity: np.ndarray
    duration: float
    q: np.ndarray
    v: np.ndarray
    target: np.ndarray
    stamps: np.ndarray
    targets: np.ndarray
    enabled: tuple[np.ndarray, np.ndarray] | None = None
    warmth: tuple[np.ndarray, np.ndarray] | None = None
    home: np.ndarray | None = None


@dataclass
class Confirmation:
    """What the engine leaves. engine: which; errors: rms [rad] over all joints by hypothesis, in the engine and in the
    gap's own plant; joints: the same of the final hypothesis by joint; missing: fitted parameters that training cannot
    be given; recordings: replayed; agrees: see `agree`."""

    engine: str
    step_s: float
    errors: dict[str, tuple[float, float]]
    joints: dict[str, tuple[float, float]]
    missing: list[str]
    recordings: list[str]
    agrees: bool
    floor: float
    at_tasks_step: float = math.nan
    simulated: dict[str, np.ndarray] = field(default_factory=dict)

    def text(self, unit: str = "mrad") -> str:
        """The result in a sentence; unit: what a thousandth of the position's is called."""
        engine, plant = list(self.errors.values())[min(1, len(self.errors) - 1)]
        if self.agrees:
            together = ", all joints at once," if len(self.joints) > 1 else ""
            return f"Replayed in the engine that trains{together or ','} {1e3 * engine:.3g} {unit} are left: confirmed."
        believed = next(iter(self.errors.values()))[0]
        removed = believed - engine >= JUDGE.removed * max(believed - self.floor, 0.0)
        if not self.missing and len(self.errors) > 1 and removed:
            return (
                f"Replayed in the engine that trains, {1e3 * engine:.3g} {unit} of {1e3 * believed:.3g} are left, "
                "more than in the search's own plant."
            )
        because = (
            f"its servo has no {', '.join(self.missing)}" if self.missing else "where the search takes each joint alone"
        )
        return (
            f"Not confirmed by the engine that trains: it leaves {1e3 * engine:.3g} {unit} where the search's own "
            f"plant leaves {1e3 * plant:.3g} ({because})."
        )

    def entry(self) -> dict[str, Any]:
        """As diagnosis.json has it."""
        out = {
            "engine": self.engine,
            "step_s": self.step_s,
            "recordings": self.recordings,
            "agrees": self.agrees,
            "not_handed_on": self.missing,
        }
        out["engine_at_tasks_step"] = {"step_s": TASKS, "after": self.at_tasks_step}
        out |= {name: {"engine": a, "plant": b} for name, (a, b) in self.errors.items()}
        return out | {"joints": {j: {"engine": a, "plant": b} for j, (a, b) in self.joints.items()}}


def servo_rows(m: Mechanism, run: Run, index: int, cases: Sequence[Case], h: Hypothesis) -> np.ndarray:
    """[J, C] servo columns of the mechanism's joints in one run, with what the hypothesis hands on."""
    rows = run.servo.nominal(m.joints).copy()
    for case in cases:
        trial = h.trials.get(case.joint)
        if trial is None:
            continue
        plant = expand(case.plant, trial.fit.params, trial.fit.x[None])[0, index]
        j = m.joints.index(case.joint)
        for p in trial.fit.params:
            for name in p.columns if handed(p, case) else ():
                if name in SERVO_INDEX:
                    c = COLUMNS[SERVO_INDEX[name]]
                    rows[j, SERVO_INDEX[name]] = np.clip(plant[SERVO_INDEX[name]], c.low, c.high)
        kd = SERVO_INDEX["kd"]
        rows[j, kd] = max(rows[j, kd] - undamped(trial, rows[j, SERVO_INDEX["kp"]]), 0.0)
        for name, value in columns_beside(case, trial, m.joints).items():
            rows[j, SERVO_INDEX[name]] = value
        for name, more in moved_friction(case, trial).items():
            rows[j, SERVO_INDEX[name]] += more
    if run.supply is not None and run.servo.supply_voltage:
        rows[:, SERVO_INDEX["supply"]] *= float(np.mean(run.supply)) / run.servo.supply_voltage
    return rows


def model_of(m: Mechanism, cases: Sequence[Case], h: Hypothesis) -> tuple[mujoco.MjSpec, bool]:
    """(model with the fields that the hypothesis hands on, whether anything differs)."""
    spec, changed = m.spec.copy(), False
    for case in cases:
        trial = h.trials.get(case.joint)
        if trial is not None:
            changed |= bool(model_changes(spec, case, trial, values_of(trial)))
    return spec, changed


def values_of(trial: Trial) -> dict[str, dict[str, float]]:
    """Fitted values of each member by parameter."""
    known = dict(zip([p.key for p in trial.fit.params], trial.fit.x, strict=True))
    return {x.id: {p.key: float(known[f"{x.id}.{p.key}"]) for p in x.variant.params} for x in trial.members}


def missing_of(h: Hypothesis) -> list[str]:
    """Fitted parameters of effects that neither the servo's table nor the model has, as effect@joint."""
    out = []
    for joint, trial in h.trials.items():
        for x in trial.members:
            columns = {c for p in x.variant.params for c in p.columns}
            fixed = {name for name, value in x.variant.fixed if value}
            if (columns | fixed) - set(SERVO_INDEX) - model_columns():
                out.append(f"{x.id} ({x.variant.label})@{joint}" if x.variant.label else f"{x.id}@{joint}")
    return sorted(out)


def worlds_of(m: Mechanism, runs: Sequence[Run], cases: Sequence[Case], h: Hypothesis, windows: Windows) -> list[World]:
    """One world a window (a whole run, or the part of it that was held out)."""
    out = []
    at_rest = m.spec.compile()
    rest = np.array([at_rest.qpos0[at_rest.joint(j).qposadr[0]] for j in m.joints])
    for w in range(len(windows.window)):
        r = int(windows.run[w])
        run, start = runs[r], float(windows.window_t[w])
        rows = servo_rows(m, run, r, cases, h)
        scale, offset = rows[:, SERVO_INDEX["position_scale"]], rows[:, SERVO_INDEX["position_offset"]]
        q, v, home = scale * rest + offset, np.zeros(len(m.joints)), scale * rest + offset
        for case in cases:
            series = case.plant.series[windows.window[w, 0]]
            j = m.joints.index(case.joint)
            q[j], v[j] = series[SERIES_INDEX["q"]], series[SERIES_INDEX["v"]]
        place = [m.joints.index(j) for j in run.joints]
        first = int(np.clip(np.searchsorted(run.cmd_t, start - BEFORE) - 1, 0, len(run.cmd_t) - 1))
        targets = np.full((len(run.cmd_t) - first, len(m.joints)), np.nan)
        targets[:, place] = run.cmd[first:]
        target = q.copy()
        target[place] = run.cmd[first]
        enabled = None
        if run.enabled is not None:
            on = np.ones((len(run.t), len(m.joints)))
            on[:, place] = run.enabled
            enabled = (run.t - start, on)
        warmth = None
        if run.temperature is not None:
            heat = np.zeros((len(run.t), len(m.joints)))
            heat[:, place] = np.nan_to_num(run.temperature - REFERENCE)
            warmth = (run.t - start, heat)
        home[place] = run.qs[0] if run.qs is not None else run.q[0]
        samples = windows.sample_row[windows.sample_window == w]
        end = float(cases[0].plant.t[samples[-1]])
        out.append(
            World(
                rows,
                run.servo,
                np.asarray(run.gravity, float),
                end - start,
                q,
                v,
                target,
                run.cmd_t[first:] - start,
                targets,
                enabled,
                warmth,
                home,
            )
        )
    return out


def free_runs(
    spec: mujoco.MjSpec,
    joints: Sequence[str],
    worlds: Sequence[World],
    device: str = "cpu",
    timestep: float = STEP,
    engine: str = "auto",
    torque: bool = False,
) -> list:
    """Reported positions [T, J] of each world at every step, from its first position and speed on, as one batch a drive
    and gravity; torque: (positions, motor torques [T, J] as their current shows them) instead."""
    groups: dict[tuple, list[int]] = {}
    for i, w in enumerate(worlds):
        groups.setdefault((w.gravity.tobytes(), w.table.drive, w.table.control_rate), []).append(i)
    out: list = [np.zeros((0, len(joints)))] * len(worlds)
    for members in groups.values():
        for i, q in zip(
            members, _batch(spec, joints, [worlds[i] for i in members], device, timestep, engine, torque), strict=True
        ):
            out[i] = q
    return out


def _batch(
    spec: mujoco.MjSpec,
    joints: Sequence[str],
    worlds: Sequence[World],
    device: str,
    timestep: float,
    kind: str,
    torque: bool,
) -> list:
    spec = spec.copy()
    spec.option.timestep, spec.option.gravity = timestep, worlds[0].gravity
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    N = len(worlds)
    # one thread: a step of some worlds is shorter than the way to another thread and back
    engine = make_engine(spec, N, device, kind, fields=FIELDS, threads=1)
    rows = np.stack([w.rows for w in worlds])
    table = copy.deepcopy(worlds[0].table)
    for name in DELAYS:  # the queue must hold the longest
        table.set(joints[0], name, float(rows[:, :, SERVO_INDEX[name]].max()))
    spacing = np.concatenate([np.diff(w.stamps) for w in worlds])
    spacing = spacing[spacing > 1e-6]
    varied = [c.name for i, c in enumerate(COLUMNS) if (rows[:, :, i] != c.neutral).any()]
    servo = Servo(
        engine,
        joints,
        table,
        control_period=max(float(np.percentile(spacing, 5)), 1e-3) if len(spacing) else None,
        varied=varied,
    )
    real = engine.t.qpos.dtype
    up = lambda x, dtype=real: torch.as_tensor(np.asarray(x), dtype=dtype, device=engine.t.qpos.device)  # noqa: E731
    servo.params.copy_(up(rows))
    scale = rows[:, :, SERVO_INDEX["position_scale"]]
    address, dofs = engine.qpos_index(joints), engine.dof_index(joints)
    qpos, qvel = np.tile(engine.mjm.qpos0, (N, 1)), np.zeros((N, engine.mjm.nv))
    qpos[:, address] = servo.unmeasured(up(np.stack([w.q for w in worlds]))).cpu().numpy()
    qvel[:, dofs] = np.stack([w.v for w in worlds]) / scale
    servo.home.copy_(servo.unmeasured(up(np.stack([w.q if w.home is None else w.home for w in worlds]))))
    engine.set_state(torch.ones(N, dtype=torch.bool, device=engine.t.qpos.device), up(qpos), up(qvel))
    now = np.stack([w.target for w in worlds])
    servo.reset(None, up(now))
    # a drive that has been on before: its integral holds the load, as in the plant
    if rows[:, :, SERVO_INDEX["integral_gain"]].any():
        held = _gravity(engine.mjm, qpos, dofs) / np.maximum(rows[:, :, SERVO_INDEX["efficiency"]], 0.01)
        if worlds[0].table.drive == "voltage":
            held /= rows[:, :, SERVO_INDEX["torque_limit"]] * rows[:, :, SERVO_INDEX["supply"]]
        servo.state[:, :, servo.slots["integral"]] = up(held)
    steps = int(math.ceil(max(w.duration for w in worlds) / timestep)) + 2
    seen = torch.zeros(steps, N, len(joints), dtype=real, device=engine.t.qpos.device)
    given = torch.zeros_like(seen) if torque else None
    heated = "warmth" in varied or "rare" in servo.features
    changes = Changes(servo, worlds, now, steps, timestep, up, heated)
    seen = _stepped(engine, servo, changes, seen, given)
    q, *tau = (x.cpu().numpy().astype(float) for x in (seen, given) if x is not None)
    return [(q[:, i], tau[0][:, i]) if tau else q[:, i] for i in range(N)]


def _stepped(
    engine: Any, servo: Servo, changes: Changes, seen: torch.Tensor, given: torch.Tensor | None
) -> torch.Tensor:
    """The positions that each step of the engine shows [S, N, J], into `seen` where it is not faster otherwise; given
    [S, N, J]: filled with the drives' torques."""
    steps = len(seen)
    step = itertools.count()
    if engine.kind == "mujoco":  # one call, and nothing in a step that is not needed: there are 2000 a second
        turned = None if servo.at_rotor else torch.zeros(steps, *engine.t.qpos.shape, dtype=engine.t.qpos.dtype)
        at, kept = engine.t.qpos.numpy(), None if turned is None else turned.numpy()

        def before_each() -> None:
            k = next(step)
            if k in changes.when:
                changes.before(k)
            if kept is None:
                seen[k].copy_(servo.position())
            else:
                kept[k] = at
            servo.before_each()
            if given is not None:
                given[k].copy_(servo.torque)

        engine.step(steps, before_each)
        if turned is not None:
            seen = servo.measured(turned[:, :, servo.reported_q])
    else:  # a step is a graph of launches
        for k in step:
            if k == steps:
                break
            changes.before(k)
            seen[k].copy_(servo.position())
            engine.step(1, servo.before_each)
            if given is not None:
                given[k].copy_(servo.torque)
    return seen


class Changes:
    """What the worlds are told in which step: targets, drives that are freed, temperatures. servo: theirs; now [N, J]:
    targets in force; up: an array as a tensor beside the servo's; heated: whether temperatures matter to the drives;
    when: the steps in which anything is new."""

    def __init__(
        self,
        servo: Servo,
        worlds: Sequence[World],
        now: np.ndarray,
        steps: int,
        timestep: float,
        up: Callable[..., torch.Tensor],
        heated: bool,
    ):
        self._servo, self._worlds, self._now, self._timestep, self._up = servo, worlds, now, timestep, up
        self._sent: dict[int, list[list[tuple[int, np.ndarray, float]]]] = {}
        self._freed: dict[int, list[tuple[int, np.ndarray]]] = {}
        begins = timestep * np.arange(steps)
        for i, w in enumerate(worlds):
            self._sends(i, w, begins + timestep)
            if w.enabled is not None:
                row = np.maximum(np.searchsorted(w.enabled[0], begins, side="right") - 1, 0)
                on = w.enabled[1][row] > 0.5
                before = np.vstack([np.ones((1, on.shape[1]), bool), on[:-1]])
                for k in np.flatnonzero((on != before).any(1)):
                    self._freed.setdefault(int(k), []).append((i, on[k]))
        self._warm = [i for i, w in enumerate(worlds) if heated and w.warmth is not None]
        self._renewed = max(1, round(WARM_EVERY / timestep))
        self.when = {*self._sent, *self._freed, *(range(0, steps, self._renewed) if self._warm else ())}

    def _sends(self, i: int, w: World, ends: np.ndarray) -> None:
        """World i's targets by the step within which they are stamped; several of one step follow each other."""
        at = np.searchsorted(ends, np.maximum.accumulate(w.stamps), side="right") if len(w.stamps) else np.zeros(0, int)
        last, turn, step = self._now[i], 0, -1
        for k, row, stamp in zip(at, w.targets, w.stamps, strict=True):
            if k == len(ends):
                break
            new = np.where(np.isfinite(row), row, last)
            if not (new != last).any() and "controller" not in self._servo.features:
                continue  # a target sent again has no speed
            turn, step, last = turn + 1 if k == step else 0, k, new
            turns = self._sent.setdefault(int(k), [])
            if turn == len(turns):
                turns.append([])
            turns[turn].append((i, new, float(stamp)))

    def before(self, k: int) -> None:
        """Tells the worlds what is new in step k."""
        servo, up = self._servo, self._up
        for turn in self._sent.get(k, ()):
            mask, stamp = np.zeros(len(self._now), bool), np.zeros(len(self._now))
            for i, new, at in turn:
                self._now[i], mask[i], stamp[i] = new, True, at
            servo.send(up(self._now), up(mask, torch.bool), up(stamp))
        for i, on in self._freed.get(k, ()):
            servo.state[i, :, servo.slots["enabled"]] = up(on)
        if self._warm and k % self._renewed == 0:
            for i in self._warm:
                when, heat = self._worlds[i].warmth or (np.zeros(0), np.zeros((0, 0)))
                now = [np.interp(k * self._timestep, when, x) for x in heat.T]
                servo.params[i, :, SERVO_INDEX["warmth"]] = up(now)


def _gravity(model: mujoco.MjModel, qpos: np.ndarray, dofs: np.ndarray) -> np.ndarray:
    """[N, J] torque [N.m] that holds the joints at rest at qpos [N, nq]: gravity less springs."""
    data, out = mujoco.MjData(model), []
    for q in qpos:
        data.qpos[:], data.qvel[:] = q, 0.0
        mujoco.mj_forward(model, data)
        out.append((data.qfrc_bias - data.qfrc_passive)[dofs])
    return np.array(out)


def confirm(
    m: Mechanism,
    runs: Sequence[Run],
    cases: Sequence[Case],
    hypotheses: Sequence[Hypothesis],
    test: list[int],
    span_test: dict[int, tuple[float, float]] | None,
    floor: float,
    device: str = "cpu",
    replay: str = "mujoco",
    timestep: float = STEP,
    finer: Sequence[Case] = (),
    room: float = math.inf,
) -> Confirmation | None:
    """Replays the hypotheses (the first is the believed one, the second, if any, the final one, others its rivals) over
    what was held out. finer: the cases with the plants in which the errors of the search's own plant are judged; room:
    s that it may take, by a pilot: of each recording less is replayed where it would take longer. None where nothing
    can be replayed. Raises UserError where the model or a drive does not serve, NoTime."""
    device = "cpu" if replay == "mujoco" else device
    windows = [c.plant.windows(None, test, span=span_test, every_run=True) for c in cases]
    if not cases or not len(windows[0].window):
        return None
    seconds = np.cumsum(windows[0].window[:, 1]) * cases[0].plant.dt
    use = np.flatnonzero(seconds <= max(MOST, seconds[0]))
    errors, joints, simulated = {}, {}, {}
    final = min(1, len(hypotheses) - 1)
    parts = [model_of(m, cases, h) for h in hypotheses]
    worlds = [[w for i, w in enumerate(worlds_of(m, runs, cases, h, windows[0])) if i in use] for h in hypotheses]
    plain = [i for i, (_, changed) in enumerate(parts) if not changed]
    groups = ([plain] if plain else []) + [[i] for i in range(len(parts)) if i not in plain]
    most = MOST
    worlds = [_until(x, most) for x in worlds]
    if room < math.inf:
        run = lambda s: free_runs(parts[0][0], m.joints, _until(worlds[0], s), device, timestep, replay)  # noqa: E731
        most = min(most, _affordable(run, room, len(groups), len(parts) + timestep / TASKS))
        worlds = [_until(x, most) for x in worlds]
    found: dict[int, list[np.ndarray]] = {}
    for group in groups:
        q = free_runs(parts[group[0]][0], m.joints, [w for i in group for w in worlds[i]], device, timestep, replay)
        for k, i in enumerate(group):
            found[i] = q[k * len(use) : (k + 1) * len(use)]

    def told(case: Case, ws: Windows) -> np.ndarray:
        """[n] bool: samples of the windows replayed, in recordings that tell of this joint."""
        t = case.plant.t[ws.sample_row] - ws.window_t[ws.sample_window]
        left_out = np.isin(ws.run[ws.sample_window], list(case.plant.left_out))
        return np.isin(ws.sample_window, use) & (t <= most) & ~left_out

    def error(q: list[np.ndarray], step: float, case: Case, ws: Windows) -> tuple[np.ndarray, np.ndarray]:
        """(simulated position, squared error) [n] of one joint at its samples."""
        on = told(case, ws)
        t = case.plant.t[ws.sample_row[on]] - ws.window_t[ws.sample_window[on]]
        out = np.empty(len(t))
        for k, w in enumerate(use):
            here = ws.sample_window[on] == w
            x = q[k][:, m.joints.index(case.joint)]
            out[here] = np.interp(t[here], step * np.arange(len(x)), x)
        return out, (case.plant.q[ws.sample_row[on]] - out) ** 2

    rms = lambda x: float(np.sqrt(np.mean(np.concatenate(x))))  # noqa: E731
    for i, h in enumerate(hypotheses):
        square, own = [], []
        for case, ws, fine in zip(cases, windows, finer or cases, strict=True):
            trial, on = h.trials[case.joint], told(case, ws)
            if not on.any():
                continue
            same = ws if fine is case else fine.plant.windows(None, test, span=span_test, every_run=True)
            fast = free_run(
                fine, trial.fit.params, trial.fit.x, same, [f for x in trial.members for f in x.variant.fixed]
            )[0][on]
            there, miss = error(found[i], timestep, case, ws)
            square.append(miss)
            own.append((case.plant.q[ws.sample_row[on]] - fast) ** 2)
            if i == final:
                joints[case.joint] = (rms(square[-1:]), rms(own[-1:]))
                simulated[case.joint] = there
        errors[h.name] = (rms(square), rms(own))
    coarse = free_runs(parts[final][0], m.joints, worlds[final], device, TASKS, replay)
    at_tasks_step = rms([error(coarse, TASKS, case, ws)[1] for case, ws in zip(cases, windows, strict=True)])
    engine, plant = errors[hypotheses[final].name]
    before = errors[hypotheses[0].name][1] if final else 0.0
    if not np.isfinite(engine):
        raise UserError("the engine's state did not stay finite")
    names = list(dict.fromkeys(runs[int(r)].name for r in windows[0].run[use]))
    return Confirmation(
        "MuJoCo-Warp" if replay == "warp" else "C MuJoCo",
        timestep,
        errors,
        joints,
        missing_of(hypotheses[final]),
        names,
        agree(engine, plant, floor, before),
        floor,
        at_tasks_step,
        simulated,
    )


def _until(worlds: Sequence[World], most: float) -> list[World]:
    """The worlds, for so many s at most."""
    return [replace(w, duration=min(w.duration, most)) for w in worlds]


def _affordable(run: Callable[[float], Any], room: float, groups: int, times: float) -> float:
    """s of each recording that can be replayed in `room` s, by how long `run` (s that are replayed) takes for one
    hypothesis: `times` as often in all, in `groups` engines and one more. Raises NoTime."""
    took = []
    for pilot in (PILOT, 2 * PILOT):
        begun = time.monotonic()
        run(pilot)
        took.append(time.monotonic() - begun)
    each = max(took[1] - took[0], 0.1 * took[1]) / PILOT
    fixed = max(took[1] - 2 * PILOT * each, 0.0)
    most = (room - sum(took) - (groups + 1) * fixed) / (times * each)
    if most < LEAST:
        raise NoTime
    return most


def agree(engine: float, plant: float, floor: float, before: float) -> bool:
    """Whether the engine's replay confirms the plant's: it leaves no more than JUDGE.within times as much, or what it
    leaves beyond that is JUDGE.earns beside the error before (the figures by which the plant absorbs its own
    inaccuracy are not handed on)."""
    return engine <= max(JUDGE.within * max(plant, floor), math.hypot(plant, JUDGE.earns * before))
