"""What is written of each joint, chosen by replay in the engine and the servo that train policies.

Of a joint there are candidates: as it is believed, its belief refitted, a plain least squares, what was found. Each is
written as the files would be, and the whole mechanism runs free over all that was held out of the fit, all judged
joints at once, under the same commands; the others follow their recording. Joint by joint the candidate is written
that follows best. Then the files are replayed as they are, by the function of `play replay=`: that is the number of
the report. In C MuJoCo or, for the choice and where asked, in MuJoCo-Warp: every candidate and every recording is a
world of one batch.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch

from dexsim.actuator.columns import COLUMNS, DELAYS
from dexsim.actuator.columns import INDEX as SERVO_INDEX
from dexsim.actuator.servo import FIELDS, Servo
from dexsim.actuator.table import ALL, ServoTable
from dexsim.gap import compute
from dexsim.gap.plant.case import REFERENCE, Case
from dexsim.gap.read import Run
from dexsim.gap.read.channels import own_readings
from dexsim.gap.rules import BELIEF, JUDGE, SEARCH
from dexsim.hand.couplings import Couplings
from dexsim.recording.mechanism import (
    BEFORE,
    HEAVY,
    SOON,
    STEP,
    Led,
    Mechanism,
    begun,
    held_joints,
    setpoints_at,
)
from dexsim.recording.schema import Recording, Series
from dexsim.sim import make_engine

if TYPE_CHECKING:
    from dexsim.gap.plant.batch import Windows

REPLAY = ("mujoco", "warp", "none")
TURNS = 2  # times that the best of each joint together is tried
PROBE = 1.0  # s of what was held out that are replayed first, for how long all of it takes
HEAT, WORTH = 0.1, 20.0  # of each part by which what is far behind is told, where a part is as long [s]
BEHIND = 2.0  # x the error of another: no whole replay of it
KINDS = 0.7  # of the time that there is for the choice: what every joint as its own kind may take
MORE = 2.0  # times as much of it is replayed, or none again
LEAST = 0.1  # of each part held out: by less nothing is chosen
FAR = 0.1  # of the error: by more the engine that trains and the search's own plant differ
STEPPED = 4  # worlds that a step takes as long for as for what is around them
REPLAYED, TOLD = "what may be written", 500  # steps from one word on it to the next
SHORTEST = 5.0  # s: shorter runs share a batch, longer ones one with those of up to twice their time
WARM_EVERY = 0.1  # s: how often a drive's temperature is renewed
LOOK = 20  # steps from one look to the next at whether anything touches, where contacts are not simulated
BELIEVED = "believed"  # candidate: nothing is changed
WHOLE = ", as fitted"  # of a fit's candidate: with the figures that else only absorb the search's plant's inaccuracy
# of candidates that follow alike the first is written
ORDER = ("found", f"found{WHOLE}", "refitted", BELIEVED, f"refitted{WHOLE}", "plain")


@dataclass(frozen=True)
class Candidate:
    """One way to write a joint. name: of `ORDER`; plant: rms [rad or m] that it leaves of what was held out in the
    search's own plant; write(table, spec): puts it into the files' content and returns what it changed of the model, in
    words; missing: what of it training cannot be given."""

    name: str
    plant: float
    write: Callable[[ServoTable, mujoco.MjSpec], list[str]]
    missing: tuple[str, ...] = ()

    @property
    def found(self) -> bool:
        """Whether it is what was found."""
        return self.name.startswith("found")


@dataclass
class World:
    """One free run: what drives it and where it begins. All in the units the encoders report, J joints of the
    mechanism.

    rows [J, C]: servo columns; table: of the drive (its kind and clock); gravity [3]; duration s; q, v [J]: first
    position and speed; target [J]: in force before the first of the commands; stamps [K] s from the start, targets [K,
    J] (NaN keeps the last); enabled: None or (times, [n, J]); warmth: the same, in degC above the reference; home [J]:
    from where a joint that drags another is counted (None: q); setpoint: None or of `setpoints_at`; led: joints that
    follow their recording, in every world of a batch the same; figures [3, J]: `FIELDS` of the joints in the world's
    own model (None: as in the batch's); spec: of its batch (None: everybody's)."""

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
    setpoint: np.ndarray | None = None
    led: Led | None = None
    figures: np.ndarray | None = None
    spec: mujoco.MjSpec | None = None

@dataclass
class Replayed:
    """What the files leave of what was held out, replayed as they are by the function of `play replay=`: rms [rad or m]
    over all judged joints, by joint, and by recording and joint; engine; step_s; parts: (recording, start s, end s);
    share: of each part, from its begin."""

    error: float
    joints: dict[str, float]
    recordings: dict[str, dict[str, float]]
    parts: list[tuple[str, float, float]]
    engine: str = "C MuJoCo"
    step_s: float = STEP
    share: float = 1.0

    def entry(self) -> dict[str, Any]:
        """As `diagnosis.json` has it."""
        parts = [{"recording": name, "start": round(a, 4), "end": round(b, 4)} for name, a, b in self.parts]
        return {"error": self.error, "joints": self.joints, "engine": self.engine, "step_s": self.step_s} | {
            "recordings": self.recordings,
            "parts": parts,
        }


@dataclass
class Written:
    """What is written of each joint. candidates: by joint; errors: rms [rad or m] by joint and candidate's name, of the
    replay (of the search's own plant where nothing was replayed); chosen: a candidate's name by joint; replayed: the
    files as they are, None where they were not."""

    candidates: dict[str, list[Candidate]]
    errors: dict[str, dict[str, float]]
    chosen: dict[str, str]
    by_replay: bool = False
    replayed: Replayed | None = None
    share: float = 1.0  # of each part held out, from its begin, that is replayed
    kept: Kept | None = None  # None where nothing was held out or is replayed

    def candidate(self, joint: str) -> Candidate:
        """Return what is written of a joint."""
        return next(c for c in self.candidates[joint] if c.name == self.chosen[joint])

    def plain(self, joint: str) -> bool:
        """Return whether the plain model of a joint is written."""
        return self.chosen[joint] == "plain"

    def beaten(self, joint: str, noise: float) -> bool:
        """Return whether the plain model of a joint is written although something was found, and follows better in the
        search's own plant too. noise: of the joint [rad or m]."""
        plant = {c.name: c.plant for c in self.candidates[joint]}
        alike = max((1 + BELIEF.tolerance) * plant.get("plain", math.inf), JUDGE.within * noise)
        return self.plain(joint) and plant.get("found", 0.0) > alike

    def reason(self, case: Case) -> str:
        """Return why the plain model of a joint is written and not what was found, in words."""
        k, unit, mine = 1e3, "mm" if case.scales.slide else "mrad", self.errors[case.joint]
        where = "in the engine that trains" if self.by_replay else "in the search's own plant"
        return (
            f"a plain least squares follows what was held out to {k * mine['plain']:.3g} {unit}, what was found to "
            f"{k * min(x for n, x in mine.items() if n.startswith('found')):.3g} ({where})"
        )

    def differences(self, judged: Mapping[str, Mapping[str, float]]) -> list[str]:
        """Return joints on which the replay differs from the search's own plant by more than a tenth, each with the
        reason, in words. judged: `sigma` of each."""
        out = []
        for joint, engine in self.replayed.joints.items() if self.replayed is not None else ():
            written, noise = self.candidate(joint), judged[joint]["sigma"]
            if abs(engine - written.plant) <= FAR * written.plant or max(engine, written.plant) <= noise:
                continue
            why = (
                f"its servo has no {', '.join(written.missing)}"
                if written.missing
                else "there each joint is simulated alone along the others' recorded motion, from a fitted state, "
                "with figures refitted that the files do not carry (inertia and gravity within their tolerance)"
            )
            out.append(
                f"{joint}: what is written ({written.name}) leaves {1e3 * engine:.3g} mrad in the engine that trains "
                f"and {1e3 * written.plant:.3g} in the search's own plant: {why}"
            )
        return out


def choose(errors: Mapping[str, float], noise: float) -> str:
    """Choose the candidate that is written of a joint, by what each leaves: the least error; of those as good, to what
    is believed of figures or to the noise, the first of `ORDER`. What was found is none of them where a belief is
    better. As good as the noise: `JUDGE.within` x what the search's plant may leave, which is as much of the noise."""
    quiet = JUDGE.within**2 * noise
    alike = max((1 + BELIEF.tolerance) * min(errors.values()), quiet)
    belief = min((x for n, x in errors.items() if n.startswith(("refitted", BELIEVED))), default=math.inf)
    named = min(alike, max(belief, quiet))
    return next(n for n in ORDER if n in errors and errors[n] <= (named if n.startswith("found") else alike))


def files(
    m: Mechanism, cases: Sequence[Case], choice: Mapping[str, Candidate]
) -> tuple[ServoTable, mujoco.MjSpec, list[str]]:
    """Return (servo table, model, what changed of the model, in words): what is handed on with one candidate a
    joint."""
    table, spec, said = copy.deepcopy(m.table), m.spec.copy(), []
    table.fitted = {c.joint: {} for c in cases}
    for case in cases:
        for name, i in SERVO_INDEX.items():  # what all recordings state of their drive and the file does not
            stated = {float(row[i]) for row in case.plant.nominal}
            if name in case.stated and len(stated) == 1 and not table.value(case.joint, name).unknown:
                value = stated.pop()
                if value != table.value(case.joint, name).value:
                    table.set(case.joint, name, value)
        said += choice[case.joint].write(table, spec)
    return table, spec, said


def rows_of(table: ServoTable, run: Run, joints: Sequence[str]) -> np.ndarray:
    """Return [J, C] servo columns in one run, of a table that was fitted: as `mechanism.of_recording` lays them over
    what the recording says itself."""
    rows = run.servo.nominal(joints).copy()
    mine = table.nominal(joints)
    for joint, factors in (table.fitted or {}).items():
        j = joints.index(joint)
        for name in table.entries.get(joint, {}):
            i = SERVO_INDEX[name]
            rows[j, i] = rows[j, i] * factors[name] if name in factors else mine[j, i]
    if run.supply is not None and run.servo.supply_voltage:
        rows[:, SERVO_INDEX["supply"]] *= float(np.mean(run.supply)) / run.servo.supply_voltage
    return rows


def worlds_of(
    m: Mechanism,
    runs: Sequence[Run],
    recordings: Mapping[str, Recording],
    cases: Sequence[Case],
    table: ServoTable,
    windows: Windows,
    begins: dict[int, tuple] | None = None,
) -> list[World]:
    """Return one world a window (a whole run, or the part of it that was held out), driven by a fitted table and begun
    as `play replay=` begins. begins: how that is by window, filled where it is not known: it is the same of any
    table."""
    out, begins = [], {} if begins is None else begins
    model = m.spec.compile()
    rest = np.array([model.qpos0[model.joint(j).qposadr[0]] for j in m.joints])
    dofs = [model.joint(j).dofadr[0] for j in m.joints]
    figures = np.stack([getattr(model, name)[dofs] for name in FIELDS])
    mine = Mechanism(m.spec, m.joints, table, m.robot)
    for w in range(len(windows.window)):
        run = runs[int(windows.run[w])]
        start = _start(recordings[run.name], float(windows.window_t[w]))
        held = held_joints(mine, recordings[run.name].joints)
        rows = rows_of(table, run, m.joints)
        scale, offset = rows[:, SERVO_INDEX["position_scale"]], rows[:, SERVO_INDEX["position_offset"]]
        q, home = scale * rest + offset, scale * rest + offset
        place = [m.joints.index(j) for j in run.joints]
        if w not in begins:
            begins[w] = begun(recordings[run.name], m, start)
        initial, v, paths = begins[w]
        q = np.where(np.isfinite(initial), initial, q)
        sent = max(int(np.searchsorted(run.cmd_t, start - BEFORE)) - 1, 0)
        targets = np.full((len(run.cmd_t) - sent, len(m.joints)), np.nan)
        targets[:, place] = run.cmd[sent:]
        target = q.copy()
        if run.cmd_t[sent] < start:
            target[place] = run.cmd[sent]
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
        home[place] = q[place]
        led = Led({j: paths[j] for j in held if j in paths})
        end = float(cases[0].plant.t[windows.sample_row[windows.sample_window == w][-1]])
        out.append(
            World(
                rows,
                run.servo,
                np.asarray(run.gravity, float),
                end - start,
                q,
                v,
                target,
                run.cmd_t[sent:] - start,
                targets,
                enabled,
                warmth,
                home,
                setpoints_at(recordings[run.name], mine, rows, Series(run.cmd_t, run.cmd), run.joints, start, STEP),
                led if held else None,
                figures,
            )
        )
    return out


def frame_of(m: Mechanism, spec: mujoco.MjSpec) -> str:
    """Return what worlds of one batch have in common of their models: all but the joints' `World.figures`."""
    spec = spec.copy()
    for joint in map(spec.joint, m.joints):
        joint.armature, joint.frictionloss = 0.0, 0.0
        joint.damping = [0.0, *np.ravel(joint.damping)[1:]]
    return str(spec.to_xml())


def free_runs(
    spec: mujoco.MjSpec,
    joints: Sequence[str],
    worlds: Sequence[World],
    device: str = "cpu",
    timestep: float = STEP,
    engine: str = "auto",
    progress: Callable[..., None] | None = None,
) -> list:
    """Return reported positions [T, J] of each world at every step, from its first position and speed on, as one batch
    a drive and gravity. progress: of `compute.watched`."""
    groups: dict[tuple, list[int]] = {}
    for i, w in enumerate(worlds):
        # as long as the longest of a batch all of it runs
        length = math.ceil(math.log2(max(w.duration / SHORTEST, 1.0)))
        groups.setdefault((id(w.spec), w.gravity.tobytes(), w.table.drive, w.table.control_rate, length), []).append(i)
    # on several cores in as many parts, those that take longest first
    cores, parts = compute.cores() if device == "cpu" else 1, list[tuple[list[World], list[int]]]()
    whole = sum(w.duration for w in worlds)
    for members in groups.values():
        together = [worlds[i] for i in members]
        count = math.ceil(cores * sum(w.duration for w in together) / whole)
        longest = sorted(members, key=lambda i: -worlds[i].duration)
        parts += [(together, longest[k::count]) for k in range(min(count, len(members)))]
    parts.sort(key=lambda x: -max(worlds[i].duration for i in x[1]))

    def part(k: int) -> Callable[[], list]:
        together, mine = parts[k]
        how = device, timestep, engine, partial(tell, k)
        return _without_resting(together[0].spec or spec, joints, [worlds[i] for i in mine], together, how)

    out: list = [np.zeros((0, len(joints)))] * len(worlds)
    sizes = [max(worlds[i].duration for i in mine) * (STEPPED + len(mine)) for _, mine in parts]
    with compute.watched(sizes, cores, REPLAYED, progress) as tell:
        for (_, mine), moved in zip(parts, compute.forked(len(parts), part, cores), strict=True):
            for i, q in zip(mine, moved, strict=True):
                out[i] = q
    return out


def _without_resting(
    spec: mujoco.MjSpec,
    joints: Sequence[str],
    worlds: Sequence[World],
    group: Sequence[World],
    how: tuple[str, float, str, Callable[[float], None]],
) -> Callable[[], list]:
    """Return what moves worlds (`_batch`) by C MuJoCo: without the fingers that rest, from a posture that nothing tells
    of, and that nothing ties to the others. With them where something touches."""
    whole = lambda: _batch(spec, joints, worlds, group, *how)  # noqa: E731
    keep = _moving(spec.compile(), joints, group) if how[2] == "mujoco" else []
    if len(keep) in (0, len(joints)):
        return whole()
    names, light, table = [joints[j] for j in keep], spec.copy(), worlds[0].table
    for thing in (*(light.joint(j) for j in joints if j not in names), *light.keys):
        light.delete(thing)
    by_joint = ((n, getattr(table, n)) for n in ("entries", "current_per_torque", "loop_encoder", "position_encoder"))
    own: dict[str, Any] = {n: {j: x[j] for j in (*names, ALL) if j in x} for n, x in by_joint if isinstance(x, dict)}
    table = replace(table, fitted=None, **own)
    part = lambda x: None if x is None else (x[0], x[1][:, keep])  # noqa: E731
    of = lambda w: replace(  # noqa: E731
        w, table=table, rows=w.rows[keep], q=w.q[keep], v=w.v[keep], target=w.target[keep],
        targets=w.targets[:, keep], enabled=part(w.enabled), warmth=part(w.warmth),
        home=None if w.home is None else w.home[keep], setpoint=None if w.setpoint is None else w.setpoint[keep],
        figures=None if w.figures is None else w.figures[:, keep],
    )  # fmt: skip
    shape = light.compile()
    for geom in light.geoms:  # what does not touch is no part of what moves, but for its inertia
        geom.contype = geom.conaffinity = 0
    light.compiler.discardvisual = light.compiler.fusestatic = True
    run = _batch(light, names, [*map(of, worlds)], [*map(of, group)], *how, shape=shape)

    def moved() -> list:
        found = run()
        if not found:
            return whole()()
        out = [np.tile(w.q, (len(q), 1)) for w, q in zip(worlds, found, strict=True)]
        for x, q in zip(out, found, strict=True):
            x[:, keep] = q
        return out

    return moved


def _moving(model: mujoco.MjModel, joints: Sequence[str], worlds: Sequence[World]) -> list[int]:
    """Return numbers of the joints but for those of trees of bodies that rest in all worlds; all, where one may act on
    another otherwise than by touch."""
    rows = np.stack([w.rows for w in worlds])
    column = lambda name: rows[:, :, SERVO_INDEX[name]]  # noqa: E731
    if model.neq or model.ntendon or model.nu or model.nsensor or column("sag").any() or column("coupling").any():
        return list(range(len(joints)))
    at, dofs = ([int(getattr(model.joint(j), x)[0]) for j in joints] for x in ("qposadr", "dofadr"))
    rest = column("position_scale") * model.qpos0[at] + column("position_offset")
    told: np.ndarray = np.logical_or.reduce(column("kp") <= 0)
    for w, q in zip(worlds, rest, strict=True):
        told |= np.isfinite(w.targets).any(0) | (w.q != q) | (w.target != q) | (w.v != 0)
        told |= [w.led is not None and j in w.led.joints for j in joints]
        told |= np.zeros(len(joints), bool) if w.enabled is None else (w.enabled[1] < 1).any(0)
    tree = model.dof_treeid
    busy = {int(tree[d]) for d in range(model.nv) if d not in dofs or told[dofs.index(d)]}
    return [j for j, d in enumerate(dofs) if int(tree[d]) in busy]


def _batch(
    spec: mujoco.MjSpec,
    joints: Sequence[str],
    worlds: Sequence[World],
    group: Sequence[World],
    device: str,
    timestep: float,
    kind: str,
    tell: Callable[[float], None],
    shape: mujoco.MjModel | None = None,
) -> Callable[[], list]:
    """Return what moves these of a group's worlds: as they do in a batch of all of it. tell: how much of it is done;
    shape: the model with what may touch, where `spec` is without; nothing is returned where it does."""
    spec = spec.copy()
    spec.option.timestep, spec.option.gravity = timestep, worlds[0].gravity
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    led = worlds[0].led.joints if worlds[0].led is not None else []
    for joint in led:
        spec.joint(joint).armature = HEAVY
    N = len(worlds)
    solid = shape or spec.compile()
    # one thread: a step of some worlds is shorter than the way to another thread and back
    engine = make_engine(spec, N, device, kind, fields=FIELDS, threads=1)
    rows = np.stack([w.rows for w in group])
    table = copy.deepcopy(worlds[0].table)
    for name in DELAYS:  # the queue must hold the longest
        table.set(joints[0], name, float(rows[:, :, SERVO_INDEX[name]].max()))
    spacing = np.concatenate([np.diff(w.stamps) for w in group])
    spacing = spacing[spacing > 1e-6]
    varied = [c.name for i, c in enumerate(COLUMNS) if (rows[:, :, i] != c.neutral).any()]
    rows = np.stack([w.rows for w in worlds])
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
    _own_figures(engine, servo, worlds, led)
    scale = rows[:, :, SERVO_INDEX["position_scale"]]
    address, dofs = engine.qpos_index(joints), engine.dof_index(joints)
    qpos, qvel = np.tile(engine.mjm.qpos0, (N, 1)), np.zeros((N, engine.mjm.nv))
    qpos[:, address] = servo.unmeasured(up(np.stack([w.q for w in worlds]))).cpu().numpy()
    qvel[:, dofs] = np.stack([w.v for w in worlds]) / scale
    servo.home.copy_(servo.unmeasured(up(np.stack([w.q if w.home is None else w.home for w in worlds]))))
    ties = Couplings(engine.mjm, joints)
    qpos = ties.complete(torch.as_tensor(qpos)).numpy() if ties.tied else qpos
    engine.set_state(torch.ones(N, dtype=torch.bool, device=engine.t.qpos.device), up(qpos), up(qvel))
    now = np.stack([w.target for w in worlds])
    servo.reset(None, up(now))
    free = np.full((len(joints), 2), np.nan)
    servo.begin_setpoint(up(np.stack([free if w.setpoint is None else w.setpoint for w in worlds])))
    # a drive that has been on before: its integral holds the load, as in the plant
    if rows[:, :, SERVO_INDEX["integral_gain"]].any():
        held = _gravity(engine.mjm, qpos, dofs) / np.maximum(rows[:, :, SERVO_INDEX["efficiency"]], 0.01)
        if worlds[0].table.drive == "voltage":
            held /= rows[:, :, SERVO_INDEX["torque_limit"]] * rows[:, :, SERVO_INDEX["supply"]]
        servo.state[:, :, servo.slots["integral"]] = up(held)
    steps = int(math.ceil(max(w.duration for w in worlds) / timestep)) + 2
    seen = torch.zeros(steps, N, len(joints), dtype=real, device=engine.t.qpos.device)
    heated = "warmth" in varied or "rare" in servo.features
    changes = Changes(servo, worlds, now, steps, timestep, up, heated)
    path = _path(engine, servo, worlds, led, timestep * np.arange(steps)) if led else lambda k: None

    def moved() -> list:
        q = _stepped(engine, servo, changes, seen, path, tell, solid, shape is not None)
        tell(1.0)
        return [] if q is None else [*np.moveaxis(q.cpu().numpy().astype(float), 1, 0)]

    return moved


def _own_figures(engine: Any, servo: Servo, worlds: Sequence[World], led: Sequence[str]) -> None:
    """Give each world the armature, damping and dry friction of its own model; those of `led` joints are `HEAVY`."""
    dofs, own = engine.dof_index(servo.joints).tolist(), [i for i, w in enumerate(worlds) if w.figures is not None]
    if not own:
        return
    figures = np.stack([w.figures for i in own if (w := worlds[i]).figures is not None], 1)
    figures[FIELDS.index("dof_armature")][:, [servo.joints.index(j) for j in led]] = HEAVY
    bases = {"dof_damping": "damping", "dof_frictionloss": "frictionloss", "dof_armature": "armature"}
    for name, x in zip(FIELDS, figures, strict=True):
        for values, columns in ((engine.field(name), dofs), (getattr(servo, f"base_{bases[name]}"), range(len(dofs)))):
            values[np.ix_(own, columns)] = torch.as_tensor(x, dtype=values.dtype, device=values.device)
    engine.set_const()
    weight = engine.field("dof_invweight0")
    servo.inertia.copy_((1.0 / weight[:, dofs]).expand_as(servo.inertia))


def _path(
    engine: Any, servo: Servo, worlds: Sequence[World], joints: Sequence[str], t: np.ndarray
) -> Callable[[int], None]:
    """Return what leads joints along their recordings in step k: their state before the servo acts, their acceleration
    after it (`_stepped` calls it twice)."""
    mine = [servo.joints.index(j) for j in joints]
    offset, scale = (servo.column(f"position_{x}")[:, mine].cpu().numpy() for x in ("offset", "scale"))
    each = [w.led.at(t, o, s) for w, o, s in zip(worlds, offset, scale, strict=True) if w.led is not None]
    to = lambda x: torch.as_tensor(np.stack(x, 1), dtype=engine.t.qpos.dtype, device=engine.t.qpos.device)  # noqa: E731
    q, v, a = (to(x) for x in zip(*each, strict=True))
    index = lambda x: torch.as_tensor(x, device=q.device).long()  # noqa: E731
    at, dofs = index(engine.qpos_index(joints)), index(engine.dof_index(joints))
    force, begun = HEAVY * a, [False]

    def lead(k: int) -> None:  # index_copy_ takes a third of an assignment's time, and there are three a step
        if begun[0]:
            engine.t.qfrc_applied.index_copy_(1, dofs, force[k])
        else:
            engine.t.qpos.index_copy_(1, at, q[k])
            engine.t.qvel.index_copy_(1, dofs, v[k])
        begun[0] = not begun[0]

    return lead


def _stepped(
    engine: Any,
    servo: Servo,
    changes: Changes,
    seen: torch.Tensor,
    lead: Callable[[int], None],
    tell: Callable[[float], None],
    solid: mujoco.MjModel,
    alone: bool,
) -> torch.Tensor | None:
    """Return the positions that each step of the engine shows [S, N, J], into `seen` where it is not faster otherwise;
    lead: of `_path`; tell: how much of it is done; solid: the model; alone: None where something touches.

    C MuJoCo takes two thirds of the time without contacts. They are simulated from where something first touches in a
    world: the batch goes back to the look before, so that it moves as with contacts from the begin."""
    steps, k = len(seen), 0
    if engine.kind == "mujoco":  # nothing in a step that is not needed: there are 2000 a second
        turned = None if servo.at_rotor else torch.zeros(steps, *engine.t.qpos.shape, dtype=engine.t.qpos.dtype)
        at, kept = engine.t.qpos.numpy(), None if turned is None else turned.numpy()
        own = (servo.state, servo.params, servo.torque)
        data, memory = mujoco.MjData(solid), [*engine.changed(), *(x.numpy() for x in own), changes.now]

        def before_each() -> None:
            nonlocal k
            if not k % TOLD:
                tell(k / steps)
            if k in changes.when:
                changes.before(k)
            lead(k)
            if kept is None:
                seen[k].copy_(servo.position())
            else:
                kept[k] = at
            servo.before_each()
            lead(k)
            k += 1

        met = np.array([_touching(solid, data, q) for q in at])
        if alone and met.any():
            return None
        engine.contacts(met)
        while k < steps:
            before, first = [x.copy() for x in memory], k
            engine.step(min(LOOK, steps - k), before_each)
            new = [i for i in np.flatnonzero(~met) if _touching(solid, data, at[i])]
            if new and alone:
                return None
            if new:
                met[new], k = True, first
                engine.contacts(met)
                for x, y in zip(memory, before, strict=True):
                    x[...] = y
        if turned is not None:
            seen = servo.measured(turned[:, :, servo.qpos])
    else:  # a step is a graph of launches
        for k in range(steps):
            if not k % TOLD:
                tell(k / steps)
            changes.before(k)
            lead(k)
            seen[k].copy_(servo.position())

            def forces(k: int = k) -> None:
                servo.before_each()
                lead(k)

            engine.step(1, forces)
    return seen


def _touching(model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray) -> bool:
    """Return whether anything of a model touches at qpos [nq]."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    return bool(data.ncon)


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
        self._servo, self._worlds, self.now, self._timestep, self._up = servo, worlds, now, timestep, up
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
        last, turn, step = self.now[i], 0, -1
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
            mask, stamp = np.zeros(len(self.now), bool), np.zeros(len(self.now))
            for i, new, at in turn:
                self.now[i], mask[i], stamp[i] = new, True, at
            servo.send(up(self.now), up(mask, torch.bool), up(stamp))
        for i, on in self._freed.get(k, ()):
            servo.state[i, :, servo.slots["enabled"]] = up(on)
        if self._warm and k % self._renewed == 0:
            for i in self._warm:
                when, heat = self._worlds[i].warmth or (np.zeros(0), np.zeros((0, 0)))
                now = [np.interp(k * self._timestep, when, x) for x in heat.T]
                servo.params[i, :, SERVO_INDEX["warmth"]] = up(now)


def _gravity(model: mujoco.MjModel, qpos: np.ndarray, dofs: np.ndarray) -> np.ndarray:
    """Return [N, J] torque [N.m] that holds the joints at rest at qpos [N, nq]: gravity less springs."""
    data, out = mujoco.MjData(model), []
    for q in qpos:
        data.qpos[:], data.qvel[:] = q, 0.0
        mujoco.mj_forward(model, data)
        out.append((data.qfrc_bias - data.qfrc_passive)[dofs])
    return np.array(out)


# -- the choice -------------------------------------------------------------------------------------------------------


def write_best(
    m: Mechanism,
    runs: Sequence[Run],
    recordings: Mapping[str, Recording],
    cases: Sequence[Case],
    candidates: dict[str, list[Candidate]],
    noise: Mapping[str, float],
    test: list[int],
    span_test: dict[int, tuple[float, float]] | None,
    device: str = "cpu",
    engine: str = "mujoco",
    room: Callable[[], float] = lambda: math.inf,
    progress: Callable[..., None] | None = None,
) -> Written:
    """Choose of each joint the candidate that follows what was held out best. noise: floor of each joint [rad or m];
    engine: of `REPLAY`; none: by the search's own plant; room: s that there are for it; too few: by the begin of each
    part held out, by the search's own plant where that is less than `LEAST`. progress: of `compute.watched`. Raises
    UserError where the model or a drive does not serve the engine."""
    errors = {j: {c.name: c.plant for c in given} for j, given in candidates.items()}
    windows = [c.plant.windows(None, test, span=span_test, every_run=True) for c in cases]
    if engine == "none" or not cases or not len(windows[0].window):
        return Written(candidates, errors, {j: choose(x, noise[j]) for j, x in errors.items()})
    by = {j: {c.name: c for c in given} for j, given in candidates.items()}
    kept, kinds = Kept(m, runs, recordings, cases, windows[0], progress), kinds_of(by)
    # of each part; s of a choice
    share, pace = min(1.0, PROBE / max(kept.seconds)) if math.isfinite(room()) else 1.0, 0.0

    def replayed(choices: Sequence[dict[str, str]], of: float = 1.0) -> list[dict[str, float]]:
        """Return rms by joint of each choice; of: of the share of each part."""
        nonlocal pace
        if not choices:
            return []
        begun = time.monotonic()
        given = [files(m, cases, {j: by[j][name] for j, name in x.items()})[:2] for x in choices]
        found = kept.missed(given, of * share, device, engine)
        pace = max(pace, (time.monotonic() - begun) / len(choices))
        return [{j: rms(x) for j, x in missed.items()} for missed in found]

    def raced(choices: Sequence[dict[str, str]]) -> list[dict[str, float]]:
        """Return rms by joint of each choice; of what is far behind after the first of each part, as many times that of
        another as there."""
        if share * max(kept.seconds) < WORTH:
            return replayed(choices)
        first = replayed(choices, HEAT)
        late = behind(choices, first, noise)
        ahead = [k for k in range(len(choices)) if k not in late]
        # beside them what is likely to be chosen, which is asked for next: together they take less time than in turn
        likely = {j: choose({c[j]: x[j] for c, x in zip(choices, first, strict=True)}, noise[j]) for j in by}
        out = dict(zip(ahead, replayed([*(choices[k] for k in ahead), likely]), strict=False))
        for k in late:
            lead = {j: min(ahead, key=lambda i: first[i][j]) for j in by}  # noqa: B023
            out[k] = {j: first[k][j] * out[i][j] / max(first[i][j], 1e-12) for j, i in lead.items()}
        if not late <= behind(choices, [out[k] for k in range(len(choices))], noise):
            out |= zip(sorted(late), replayed([choices[k] for k in sorted(late)]), strict=True)
        return [out[k] for k in range(len(choices))]

    while True:
        done = list(zip(kinds, raced(kinds), strict=True))
        more = KINDS * room() / max(pace * len(kinds), 1e-9)
        if share >= 1.0 or more < MORE:
            break
        share = min(1.0, share * more)
    if share < LEAST:
        out = write_best(m, runs, recordings, cases, candidates, noise, test, span_test, engine="none")
        return replace(out, share=float(np.clip(share * room() / pace, share, 1.0)), kept=kept)
    chosen = composed(by, errors, noise, done, replayed, lambda count: count * pace > room())
    return Written(candidates, errors, chosen, True, share=share, kept=kept)


def rms(missed: Sequence[np.ndarray]) -> float:
    """Return the rms of parts, each (sum of squares, number)."""
    square, count = np.sum(missed, 0)
    return math.sqrt(square / max(count, 1.0))


class Kept:
    """What was held out of the fit, replayed. windows: of all of it; progress: of `compute.watched`; recordings,
    starts, ends [W] s of each part."""

    def __init__(
        self,
        m: Mechanism,
        runs: Sequence[Run],
        recordings: Mapping[str, Recording],
        cases: Sequence[Case],
        windows: Windows,
        progress: Callable[..., None] | None = None,
    ):
        self._progress = progress
        self.m, self.runs, self.cases, self.windows, self.by_name = m, runs, cases, windows, recordings
        t = cases[0].plant.t
        self.recordings = [recordings[runs[int(r)].name] for r in windows.run]
        self.starts = [_start(r, float(x)) for r, x in zip(self.recordings, windows.window_t, strict=True)]
        count = range(len(self.starts))
        self.ends = [float(t[windows.sample_row[windows.sample_window == k][-1]]) for k in count]
        self._begins: dict[int, tuple] = {}
        self._known, self._specs = dict[tuple, np.ndarray](), dict[str, mujoco.MjSpec]()

    @property
    def seconds(self) -> list[float]:
        """How long each part is [s]."""
        return [b - a for a, b in zip(self.starts, self.ends, strict=True)]

    def spans(self, share: float) -> list[tuple[float, float]]:
        """Return begin and end [s] of the first share of each part."""
        return [(a, a + share * (b - a)) for a, b in zip(self.starts, self.ends, strict=True)]

    def missed(
        self,
        given: Sequence[tuple[ServoTable, mujoco.MjSpec]],
        share: float = 1.0,
        device: str = "cpu",
        engine: str = "mujoco",
    ) -> list[dict[str, list[np.ndarray]]]:
        """Return by joint, of each part: sum of squares and number of what files (servo table, model), replayed, miss
        of its readings; none of recordings that do not tell of a joint. What makes the same worlds is replayed once;
        models that differ in armature, damping and friction alone run as one batch."""
        asked, new = list[list[tuple]](), dict[tuple, World]()
        for table, spec in given:
            frame = frame_of(self.m, spec)
            spec = self._specs.setdefault(frame, spec)
            mine = replace(self.m, spec=given[len(asked)][1])
            worlds = worlds_of(mine, self.runs, self.by_name, self.cases, table, self.windows, self._begins)
            asked.append([])
            for k, w in enumerate(worlds):
                w.duration, w.spec = share * w.duration, spec
                led, figures = [] if w.led is None else w.led.joints, b"" if w.figures is None else w.figures.tobytes()
                what = k, share, engine, frame, figures, w.rows.tobytes(), tuple(led)
                asked[-1].append(what)
                if what not in self._known:
                    new[what] = w
        device = "cpu" if engine == "mujoco" else device
        found = free_runs(self.m.spec, self.m.joints, [*new.values()], device, STEP, engine, progress=self._progress)
        for what, q in zip(new, found, strict=True):
            self._known[what] = self._missed(what[0], share, q)
        return [{c.joint: [self._known[x][i] for x in parts] for i, c in enumerate(self.cases)} for parts in asked]

    def _missed(self, k: int, share: float, q: np.ndarray) -> np.ndarray:
        """Return [cases, 2] of part k."""
        r, run, (a, b) = self.recordings[k], int(self.windows.run[k]), self.spans(share)[k]
        t = a + STEP * np.arange(round((b - a) / STEP) + 1)
        return np.array([
            _missed(r, c.joint, t, q[: len(t), self.m.joints.index(c.joint)])
            if run not in c.plant.left_out and c.joint in r.joints else np.zeros(2)
            for c in self.cases
        ])  # fmt: skip


def behind(
    choices: Sequence[Mapping[str, str]], missed: Sequence[Mapping[str, float]], noise: Mapping[str, float]
) -> set[int]:
    """Return numbers of the choices that are not written of any joint (`choose`), whatever the rest of a replay shows:
    of each joint another is the same, or misses half as much, or comes before it in `ORDER` and misses no more than
    noise does. missed: rms by joint of each; noise: floor by joint."""
    out: set[int] = set()

    def lost(k: int, i: int, j: str) -> bool:
        mine, other = ORDER.index(choices[k][j]), ORDER.index(choices[i][j])
        quiet = missed[i][j] <= JUDGE.within**2 * noise[j]
        return other == mine or (quiet and other < mine) or BEHIND * missed[i][j] < missed[k][j]

    for k in sorted(range(len(choices)), key=lambda k: -max(missed[k].values())):
        others = [i for i in range(len(choices)) if i != k and i not in out]
        if all(any(lost(k, i, j) for i in others) for j in noise if j in choices[k]):
            out.add(k)
    return out


def kinds_of(by: Mapping[str, Collection[str]]) -> list[dict[str, str]]:
    """Return choices: every joint as its own kind, of `ORDER`, where it has such a candidate, else as its first."""
    there = [k for k in ORDER if any(k in x for x in by.values())]
    return [{j: k if k in x else min(x, key=ORDER.index) for j, x in by.items()} for k in there]


def composed(
    by: Mapping[str, Collection[str]],
    errors: dict[str, dict[str, float]],
    noise: Mapping[str, float],
    done: list[tuple[dict[str, str], dict[str, float]]],
    replayed: Callable[[Sequence[dict[str, str]]], list[dict[str, float]]],
    passed: Callable[[int], bool] = lambda count: False,
) -> dict[str, str]:
    """Return a candidate's name by joint. by: names of each joint's candidates; errors: filled with what each leaves
    [rad or m] where all joints are of its kind; noise: floor by joint; done: what every joint as its own kind leaves
    (`kinds_of`), by joint; replayed: the same of whole choices; passed: whether there is no time for so many more."""
    # the best of each together; where joints pull at one another that may be none of them: then each is asked once more
    # with what the others now are
    first = len(done)
    for choice, found in done:
        for j, name in choice.items():
            errors[j][name] = found[j]
    here = {j: dict(x) for j, x in errors.items()}  # with what the others are by then
    chosen = {j: choose(x, noise[j]) for j, x in here.items()}
    # the better of belief and plain model of each joint: replayed beside the first, it takes hardly more time
    plainly = {j: [n for n in (BELIEVED, "plain") if n in x] for j, x in by.items()}
    quiet = {j: JUDGE.within**2 * noise[j] for j in by}
    left = lambda j, name: max(errors[j][name], quiet[j])  # noqa: E731

    def safe_of(other: dict[str, str]) -> dict[str, str]:
        best = {j: min(x, key=errors[j].__getitem__) if x else other[j] for j, x in plainly.items()}
        alike = {j: {n, *(k for k in plainly[j] if left(j, k) <= left(j, n))} for j, n in best.items()}
        return next((c for c, _ in done[:first] if all(c[j] in alike[j] for j in by)), best)

    while chosen not in [c for c, _ in done] and len(done) < first + TURNS and not passed(1):
        safe = safe_of(chosen)
        together = replayed([chosen, *([] if passed(2) or safe in [c for c, _ in done] else [safe])])[0]
        done.append((chosen, together))
        # what is as good as the noise stays
        far = {j: max(quiet[j], math.sqrt(1 + SEARCH.tie) * here[j][chosen[j]]) for j in by}
        moved = [j for j in by if together[j] > far[j] and len(by[j]) > 1]
        swaps = [(j, k) for j in moved for k in by[j] if k != chosen[j]]
        if passed(len(swaps)):
            break
        for (j, k), found in zip(swaps, replayed([chosen | {j: k} for j, k in swaps]), strict=True):
            here[j][k] = found[j]
        for j in by:
            here[j][chosen[j]] = together[j]
        chosen = {j: choose(x, noise[j]) for j, x in here.items()}
    # of all that was replayed as a whole, and that: what nowhere follows much worse than it; that choice before others
    # that do as well
    safe = safe_of(chosen)
    if safe not in [c for c, _ in done] and not passed(1):
        done += zip([safe], replayed([safe]), strict=True)
    worst = lambda x: max([x[j] / left(j, safe[j]) for j in by if plainly[j]], default=1.0)  # noqa: E731
    fair = [(c, x) for c, x in done if worst(x) <= 1 + BELIEF.tolerance] or [min(done, key=lambda d: worst(d[1]))]
    alike = lambda c: BELIEF.tolerance if c == chosen else 0.0  # noqa: E731
    total = lambda d: sum(math.log(max(d[1][j], quiet[j])) - alike(d[0]) for j in by)  # noqa: E731
    return min(fair, key=total)[0]


def _start(r: Recording, start: float) -> float:
    """Return where a replay begins [s] of what was recorded from `start` on: with the recording where that is its
    begin."""
    first = float(r.states.position.t[0])
    return 0.0 if start - first < STEP and first <= SOON else start


def _missed(r: Recording, joint: str, t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return [2] sum of squares and number of what a free run q [T] at t [T] s misses of a joint's readings."""
    state = r.states.position
    seen = np.asarray(state.value[:, r.joints.index(joint)], float)
    on = own_readings(state.t, seen) & (state.t >= t[0] - 1e-9) & (state.t <= t[-1] + 1e-9)
    d = seen[on] - np.interp(state.t[on], t, q)
    return np.array([np.nansum(d**2), np.isfinite(d).sum()]) if np.isfinite(q).all() else np.array([np.inf, 1.0])


def replay_files(kept: Kept, table: ServoTable, spec: mujoco.MjSpec, share: float = 1.0) -> Replayed:
    """Replay the files over all that was held out, as `play replay=` does with each recording or part of one. share: of
    each part, from its begin."""
    (missed,) = kept.missed([(table, spec)], share)
    each: dict[str, dict[str, list[np.ndarray]]] = {}
    for joint, parts in missed.items():
        for r, x in zip(kept.recordings, parts, strict=True):
            if x[1]:
                each.setdefault(r.path.name, {}).setdefault(joint, []).append(x)
    return Replayed(
        rms([x for parts in missed.values() for x in parts]),
        {j: rms(x) for j, x in missed.items()},
        {name: {j: rms(x) for j, x in given.items()} for name, given in each.items()},
        [(r.path.name, *x) for r, x in zip(kept.recordings, kept.spans(share), strict=True)],
        share=share,
    )
