"""A mechanism on servos, driven by time-stamped commands: the simulated half of a recording.

Any MuJoCo model serves: the xHand alone in the air, a one-joint test bench, another robot.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import yaml

from dexsim import model_file, yaml_text
from dexsim.actuator.columns import COLUMNS, INDEX
from dexsim.actuator.table import ALL, ServoTable
from dexsim.errors import UserError
from dexsim.hand import Hand, load_hand
from dexsim.hand.couplings import Couplings
from dexsim.hand.schema import FILE as HAND_FILE
from dexsim.recording.schema import COMMANDS, COMMANDS_FIX, DEFAULTS, STATES, Recording, Series, States
from dexsim.recording.smooth import local_polynomial

if TYPE_CHECKING:
    from dexsim.sim import ContactPair
    from dexsim.tactile.sensors import Sensors

XHAND = "xhand"  # the hand where no model is given
STEP = 5e-4  # s of the physics, in a replay and where a diagnosis replays what it wrote; the error is of first order
HEAVY = 1e6  # kg.m2 (kg): the rotor of a joint that is led along a path, so that nothing but its path moves it
BEFORE = 0.6  # s: commands sent so long before a replay begins are sent, for they may still act
QUICK = 4  # degree of the polynomials that smooth what is fast
SOON = 0.05  # s: a recording whose first reading is later begins with that
RESTS = 0.2  # of a joint's largest speed: slower, it is at rest where a replay begins
MARGIN = 12  # readings before the start that tell the speed there
REFERENCE = 25.0  # degC: at which the figures of a data sheet hold
WARM = frozenset(c.name for c in COLUMNS if c.name.startswith("thermal"))  # columns that act with the temperature
MAX_SPEED = 2.0  # rad/s (m/s) where the servo states no no_load_speed


@dataclass
class Mechanism:
    """A model and what is believed of its drives. joints: the driven ones, in the order of every [J] array; hand: where
    the model is one; part_of: the hand whose fingertips a model carries that is none itself (a press rig)."""

    spec: mujoco.MjSpec
    joints: tuple[str, ...]
    table: ServoTable
    robot: str
    hand: Hand | None = None
    part_of: Hand | None = None

    @property
    def whose(self) -> Hand:
        """The hand that it is, or whose parts it carries: where nothing is said, the xHand."""
        return self.hand or self.part_of or load_hand(XHAND)

    @cached_property
    def sensors(self) -> Sensors:
        """The touch sensors that it may carry."""
        from dexsim.tactile.sensors import Sensors

        return Sensors(self.whose)

    @property
    def limits(self) -> np.ndarray:
        """Position limits [J, 2], infinite where the model has none."""
        model = self.spec.compile()
        rows = [model.joint(j) for j in self.joints]
        return np.array([model.jnt_range[j.id] if model.jnt_limited[j.id] else (-np.inf, np.inf) for j in rows])

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Position limits by joint, where the model has them."""
        return {j: (float(a), float(b)) for j, (a, b) in zip(self.joints, self.limits, strict=True) if np.isfinite(a)}

    def column(self, name: str) -> np.ndarray:
        """Return a servo column's nominal value [J]."""
        return self.table.nominal(self.joints)[:, INDEX[name]]

    @property
    def speeds(self) -> np.ndarray:
        """Largest speeds [J]: the no-load speeds, MAX_SPEED where infinite."""
        speed = self.column("no_load_speed")
        return np.where(np.isfinite(speed), speed, MAX_SPEED)


def of_hand(
    hand: Hand, servo: str | Path | dict | None = None, gravity: Sequence[float] | np.ndarray | None = None
) -> Mechanism:
    """Return the mechanism of a hand alone, in its palm frame; servo, gravity as in `mechanism`. Raises UserError."""
    spec = hand.spec()
    _hold_friction(spec)
    if gravity is not None:
        spec.option.gravity = [float(g) for g in gravity]
    return Mechanism(spec, hand.joints, _table(hand.servo_path if servo is None else servo), hand.robot, hand)


def mechanism(
    model: str | Path | None = None, servo: str | Path | dict | None = None, joints: Sequence[str] | None = None,
    gravity: Sequence[float] | np.ndarray | None = None, hand: Hand | None = None,
) -> Mechanism:  # fmt: skip
    """Return the mechanism in a MuJoCo or URDF file with the servo in a YAML file (or mapping), or in the folder of a
    hand (its hand.yaml names servo and joints); by default `hand`, or the xHand, and its own.

    joints: the driven ones; by default those of the hand, else every hinge and slide of the model. gravity: [3] m/s2,
    world frame. hand: beside a model, the one whose fingertips it carries. Raises UserError for a model or servo that
    does not serve.
    """
    part_of, hand = (hand, None) if model is not None else (None, hand)
    if (folder := XHAND if model is None else _hand_folder(model)) is not None:
        own = of_hand(hand or load_hand(folder), servo)
        spec, robot, table, hand = own.spec, own.robot, own.table, own.hand
        joints = own.joints if joints is None else joints
    else:
        assert model is not None  # else the folder is the xHand's
        path = Path(model).expanduser()
        spec = model_file.read(path, f"model={model}", _undriven)
        _hold_friction(spec, hardest=True)
        _moved(spec.compile(), f"model={model}")
        robot = path.stem
        if servo is None:
            raise UserError(f"model={model}: say which servo drives it with servo=FILE (a servo.yaml)")
        table = _table(servo)
        _uncoupled(spec, table)
    if gravity is not None:
        spec.option.gravity = [float(g) for g in gravity]
    hinges = [
        j.name for j in spec.joints if j.type in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE) and j.name
    ]
    chosen = tuple(joints) if joints is not None else tuple(hinges)
    for joint in chosen:
        if joint not in hinges:
            raise UserError(f"joint '{joint}' is not in {model or 'the xHand'}; its joints: {', '.join(hinges)}")
    if not chosen:
        raise UserError(f"model={model}: has no named hinge or slide joint to drive")
    return Mechanism(spec, chosen, table, robot, hand, None if hand else part_of)


def _undriven(spec: mujoco.MjSpec) -> None:
    """Takes a model's own actuators away, and what refers to them: the servo drives its joints, and an actuator at
    control 0 would hold them, or pull at their tendons, beside it."""
    for group in (spec.actuators, spec.sensors, spec.keys):
        for item in list(group):
            spec.delete(item)


def _uncoupled(spec: mujoco.MjSpec, table: ServoTable) -> None:
    """Takes away equalities between two joints that both have a drive of their own in the servo's file."""
    for e in list(spec.equalities):
        if e.type == mujoco.mjtEq.mjEQ_JOINT and e.name1 in table.entries and e.name2 in table.entries:
            spec.delete(e)


def stated_hand(name: str | None, mirror: bool = False) -> Hand | None:
    """Return the hand of a command's settings hand= and hand_mirror=; None where neither is stated. Raises
    UserError."""
    return load_hand(name or XHAND, mirror) if name or mirror else None


def _hand_folder(model: str | Path) -> Path | None:
    """Return the folder of a hand.yaml, where `model` is one."""
    path = Path(model).expanduser()
    path = path.parent if path.name == HAND_FILE else path
    return path if (path / HAND_FILE).is_file() else None


def _moved(model: mujoco.MjModel, where: str) -> None:
    """Raise UserError for a joint that moves nothing."""
    for k in range(model.njnt):
        if not model.dof_M0[model.jnt_dofadr[k]] > 0:
            raise UserError(
                f"{where}: joint '{model.joint(k).name}' moves nothing that has mass or inertia; give its body a "
                "mass, or the joint an armature"
            )


def for_recording(
    recording: Recording,
    model: str | Path | None = None,
    servo: str | Path | dict | None = None,
    hand: Hand | None = None,
) -> Mechanism:
    """Return the mechanism that a recording was made with (`of_recording`), from a model and a servo file."""
    return of_recording(mechanism(model, servo, None, recording.gravity, hand), recording)


def of_recording(m: Mechanism, recording: Recording) -> Mechanism:
    """Return the mechanism as a recording was made with it: its gravity, its `servo` over the believed table, its
    joints driven (the model's others stay where they are, driven to their initial position). What was fitted to
    recordings (`fitted` of the table) goes before what a recording says of its drive, but for columns in which those
    differed: of them its factor is on the recording's own."""
    spec = m.spec.copy()
    spec.option.gravity = [float(g) for g in recording.gravity]
    out = Mechanism(spec, m.joints, m.table, m.robot, m.hand, m.part_of)
    followers = () if m.hand is None else m.hand.couplings.passive
    missing = [j for j in recording.joints if j not in out.joints and j not in followers]
    if missing:
        raise UserError(
            f"recording {recording.path} has joints that the model has not: {', '.join(missing)};"
            f" its joints: {', '.join(out.joints)}"
        )
    if recording.meta.get("servo"):
        over = yaml_text.parse(recording.meta["servo"], f"servo of {recording.path}")
        own, fitted = m.table.to_dict(), m.table.fitted or {}
        stated = {j: dict(columns or {}) for j, columns in (over.get("joints") or {}).items()}
        for joint, factors in fitted.items():
            said = stated.get(ALL, {}) | stated.get(joint, {})
            stated[joint] = {c: x for c, x in said.items() if c in factors or c not in own["joints"].get(joint, {})}
        over["joints"] = stated
        out.table = ServoTable.from_dict(merged(own, over), source=f"servo of {recording.path}")
        for joint, column, factor in [(j, c, f) for j, x in fitted.items() for c, f in x.items()]:
            if column in stated[joint]:
                out.table.set(joint, column, factor * (out.table.value(joint, column).value or 0.0))
    return out


def driven(recording: Recording, m: Mechanism) -> Recording:
    """Return a recording without the joints of the hand that have no drive: those are measured, and follow."""
    return recording if m.hand is None else recording.without(m.hand.couplings.passive)


def held_joints(m: Mechanism, joints: Sequence[str]) -> list[str]:
    """Return those of recorded `joints` that no servo drives, or that were not among those that the servo's file was
    fitted to: a free run of the others is only judged where these move as they did."""
    table = m.table
    driven = lambda j: j in table.entries or ALL in table.entries  # noqa: E731
    return [j for j in joints if not driven(j) or (table.fitted is not None and j not in table.fitted)]


def merged(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Return `over` laid over `base`, mapping by mapping; the servo file's value mappings {value, low, high} are
    replaced whole."""
    out = copy.deepcopy(base)
    for key, value in over.items():
        if isinstance(value, dict) and isinstance(out.get(key), dict) and "value" not in value:
            out[key] = merged(out[key], value)
        else:
            out[key] = copy.deepcopy(value)
    return out


@dataclass
class Run:
    """What the simulation did, one row a physics step. t [T] s, in a replay the recording's; position, velocity,
    torque, target [T, J] (as the encoders and the current report; target: the last one sent); qpos [F, nq] and
    pair_normal [F, P] (N, of each contact pair) every `frame_s`."""

    t: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    torque: np.ndarray
    target: np.ndarray
    qpos: np.ndarray
    frame_s: float
    model: mujoco.MjModel
    pair_normal: np.ndarray


def drive(
    m: Mechanism, commands: Series, columns: Sequence[str], duration: float, initial: np.ndarray | None = None,
    timestep: float = 0.002, enabled: Series | None = None, frame_s: float = 0.02, pairs: Sequence[ContactPair] = (),
    follow: tuple[str, Series] | None = None, velocity: np.ndarray | None = None, target: np.ndarray | None = None,
    columns_of: Mapping[str, Series] | None = None, led: Led | None = None, setpoint: np.ndarray | None = None,
) -> Run:  # fmt: skip
    """Simulate `duration` s of the mechanism under time-stamped commands, from rest.

    commands: value [T, len(columns)], targets of the joints named in `columns`; NaN keeps the last. initial [J]:
    start of the mechanism's joints (NaN or None: the model's own); velocity [J]: their speed then (None: at rest);
    target [J]: in force then (NaN or None: the start). enabled: like commands, 0 frees a joint. pairs: contact pairs to
    measure. follow: (name of a free joint, poses [T, 7]): a body that is led along a recorded path. columns_of: servo
    columns that change, by name [T, J]. led: joints that follow a path. setpoint: of `setpoints_at`. Deterministic.
    Engine: C MuJoCo.
    """
    import torch

    from dexsim.actuator.servo import FIELDS, Servo
    from dexsim.sim import make_engine

    spec = m.spec.copy()
    for joint in led.joints if led is not None else ():
        spec.joint(joint).armature = HEAVY
    spec.option.timestep = timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    engine = make_engine(spec, 1, "cpu", "mujoco", fields=FIELDS, pairs=pairs, threads=1)
    steps = max(1, round(duration / timestep))
    stamps = np.asarray(commands.t, float)
    spacing = float(np.percentile(np.diff(stamps), 5)) if len(stamps) > 2 else None
    varied = tuple(columns_of or ())
    servo = Servo(engine, m.joints, m.table, control_period=max(spacing, 1e-3) if spacing else None, varied=varied)
    qpos, qvel = torch.as_tensor(engine.mjm.qpos0)[None].clone(), torch.zeros_like(engine.t.qvel)
    address = engine.qpos_index(m.joints)
    dofs = engine.dof_index(m.joints)
    scale, offset = (servo.column(f"position_{name}")[0].double().numpy().copy() for name in ("scale", "offset"))
    start = qpos[0, address].numpy().copy()
    if initial is not None:
        known = servo.unmeasured(torch.as_tensor(np.nan_to_num(initial))[None])[0].numpy()
        start = np.where(np.isfinite(initial), known, start)
    qpos[0, address] = torch.as_tensor(start)
    if velocity is not None:
        qvel[0, dofs] = torch.as_tensor(velocity / scale)
    lead = None
    if follow is not None:
        leading = engine.joint(follow[0])
        q, v = int(engine.mjm.jnt_qposadr[leading]), int(engine.mjm.jnt_dofadr[leading])
        lead, lead_speed = _path(follow[1], steps, timestep)
        qpos[0, q : q + 7] = torch.as_tensor(lead[0])
    qpos = Couplings(engine.mjm, m.joints).complete(qpos) if m.hand and m.hand.couplings.passive else qpos
    engine.set_state(torch.ones(1, dtype=torch.bool), qpos, qvel)
    now = np.where(np.isfinite(initial), initial, start) if initial is not None else start.copy()
    now = np.where(np.isfinite(target), target, now) if target is not None else now
    servo.reset(None, torch.as_tensor(now)[None])
    if setpoint is not None:
        servo.begin_setpoint(torch.as_tensor(setpoint)[None])
    place = np.array([m.joints.index(c) for c in columns])
    J = len(m.joints)
    out = {name: np.zeros((steps, J)) for name in ("position", "velocity", "torque", "target")}
    q_view, v_view, torque_view = engine.t.qpos[0].numpy(), engine.t.qvel[0].numpy(), servo.torque[0].numpy()
    applied = engine.t.qfrc_applied[0].numpy()
    if led is not None:
        mine = [m.joints.index(j) for j in led.joints]
        held_q, held_v, pull = led.at(np.arange(steps) * timestep, offset[mine], scale[mine])
        led_q, led_v = address[mine], dofs[mine]
    changed = [(servo.column(name)[0].numpy(), x) for name, x in (columns_of or {}).items()]
    on = None if enabled is None else (enabled.t, np.nan_to_num(enabled.value, nan=1.0) > 0.5)
    state = {"k": 0, "command": 0, "enabled": 0}
    every = max(1, round(frame_s / timestep))

    def before_each() -> None:
        k, t = state["k"], state["k"] * timestep
        # stamps within this step are known to it: the servo lets each act from its own time on
        while state["command"] < len(stamps) and stamps[state["command"]] < t + timestep:
            row = commands.value[state["command"]]
            new = np.where(np.isfinite(row), row, now[place])
            if (new != now[place]).any():  # the same target again changes nothing
                now[place] = new
                servo.send(torch.as_tensor(now)[None], stamp=float(stamps[state["command"]]))
            state["command"] += 1
        while on is not None and state["enabled"] < len(on[0]) and on[0][state["enabled"]] <= t:
            said = torch.as_tensor(on[1][state["enabled"]])
            servo.state[0, torch.as_tensor(place), servo.slots["enabled"]] = said.to(servo.state.dtype)
            state["enabled"] += 1
        if changed and k % every == 0:
            for column, x in changed:
                column[:] = x.value[max(int(np.searchsorted(x.t, t, side="right")) - 1, 0)]
        if led is not None:
            q_view[led_q], v_view[led_v] = held_q[k], held_v[k]
        if lead is not None:
            engine.t.qpos[0, q : q + 7] = torch.as_tensor(lead[k])
            engine.t.qvel[0, v : v + 6] = torch.as_tensor(lead_speed[k])
        # views of the engine's memory: `servo.position()` and the like, without a tensor a step
        if servo.features:  # an eccentric encoder, or one before a play
            out["position"][k], out["velocity"][k] = servo.position()[0].numpy(), servo.velocity()[0].numpy()
        else:
            out["position"][k] = scale * q_view[address] + offset
            out["velocity"][k] = scale * v_view[dofs]
        out["target"][k] = now
        servo.before_each()
        if led is not None:
            applied[led_v] = HEAVY * pull[k]
        out["torque"][k] = torque_view
        state["k"] = k + 1

    frames, forces = [], []
    for first in range(0, steps, every):
        frames.append(engine.t.qpos[0].numpy().copy())
        engine.step(min(every, steps - first), before_each)
        forces.append(engine.t.pair_normal[0].numpy().copy())
    return Run(
        np.arange(steps) * timestep, **out, qpos=np.array(frames), frame_s=every * timestep, model=engine.mjm,
        pair_normal=np.array(forces).reshape(len(frames), len(pairs)),
    )  # fmt: skip


def recorded(
    run: Run, m: Mechanism, commands: Series, columns: Sequence[str], rate: float = 200.0, start_ns: int = 1_000_000_000
) -> Recording:
    """Return the run as a simulated recording: commands as sent, states `rate` times a second (Hz; at most the physics
    rate), torque in N.m. `realistic` makes of it what the hardware would have delivered."""
    every = max(1, round(1.0 / rate / (run.t[1] - run.t[0]))) if len(run.t) > 1 else 1
    t = run.t[::every]
    value = np.full((len(commands), len(m.joints)), np.nan)
    value[:, [m.joints.index(c) for c in columns]] = commands.value
    gravity = " ".join(f"{g:g}" for g in m.spec.option.gravity)
    meta = {
        "schema": "1", "source": "sim", "robot": m.robot, "joint_names": ",".join(m.joints), "effort_is": "torque_Nm",
        "effort_sign": "+1", "gravity": gravity, "servo": yaml.safe_dump(m.table.to_dict(), sort_keys=False),
    }  # fmt: skip
    series = lambda x, topic: Series(t, x[::every], topic, t.copy())  # noqa: E731
    sensed = () if m.hand is None else m.hand.sensed
    frames = np.arange(len(run.qpos)) * run.frame_s
    angles = [np.interp(t - run.t[0], frames, run.qpos[:, run.model.joint(j).qposadr[0]]) for j in sensed]
    out = Recording(
        Path("simulated.mcap"), DEFAULTS | meta, m.joints, Series(commands.t, value, COMMANDS, commands.t.copy()),
        States(series(run.position, STATES), series(run.velocity, STATES), series(run.torque, STATES)),
        start_ns=start_ns, hand=m.hand,
    )  # fmt: skip
    return out.with_followers(sensed, np.stack(angles, 1) if sensed else np.zeros((len(t), 0)))


def replay(
    recording: Recording, m: Mechanism, timestep: float = STEP, pairs: Sequence[ContactPair] = (),
    follow: str | None = None, hold: str = "recorded", start: float = 0.0, end: float | None = None,
) -> Run:  # fmt: skip
    """Drive the mechanism with a recording's commands from its first position and speed at `start` s or later on, to
    `end` s (None: of the recording), as a free run without correction; supply and temperatures as they were recorded.
    The run's times are the recording's.

    pairs: contact pairs to measure. follow: name of the free joint that is led along the recorded object's path. hold:
    joints that no servo drives, or that its file was not fitted to (`held_joints`), follow their recording where it is
    `recorded`; `limp`: nothing moves those without a servo.
    """
    recording = driven(recording, m)
    commands, state = recording.targets(), recording.states.position
    if not len(commands):
        raise UserError(f"recording {recording.path} has no commands: nothing to replay; {COMMANDS_FIX}")
    last = max(recording.duration, float(commands.t[-1]))
    if not 0 <= start < (last if end is None else min(end, last)):
        raise UserError(
            f"start={start:g} end={last if end is None else end:g}: must lie in the recording, 0 to {last:g} s"
        )
    start = max(start, float(state.t[0])) if len(state) and state.t[0] > SOON else start
    place, target = [m.joints.index(j) for j in recording.joints], np.full(len(m.joints), np.nan)
    initial, velocity, paths = begun(recording, m, start)
    held = [j for j in (held_joints(m, recording.joints) if hold == "recorded" else []) if j in paths]
    first = max(int(np.searchsorted(commands.t, start - BEFORE)) - 1, 0)
    if commands.t[first] < start:
        target[place] = commands.value[first]
    given = Series(np.asarray(commands.t[first:], float) - start, commands.value[first:])
    enabled = recording.enabled
    if enabled is not None:
        now = max(int(np.searchsorted(enabled.t, start, side="right")) - 1, 0)
        enabled = Series(np.asarray(enabled.t[now:], float) - start, enabled.value[now:])
    pose = recording.object_pose
    path = None if follow is None or pose is None else (follow, replace(pose, t=np.asarray(pose.t) - start))
    begins = setpoints_at(recording, m, m.table.nominal(m.joints), commands, recording.joints, start, timestep)
    run = drive(
        m, given, recording.joints, (last if end is None else end) - start + timestep, initial, timestep, enabled,
        pairs=pairs, follow=path, velocity=velocity, target=target,
        columns_of=_recorded_columns(recording, m, place, start),
        led=Led({j: paths[j] for j in held}) if held else None, setpoint=begins,
    )  # fmt: skip
    return replace(run, t=run.t + start)


def setpoints_at(
    recording: Recording, m: Mechanism, rows: np.ndarray, commands: Series, columns: Sequence[str], start: float,
    dt: float,
) -> np.ndarray | None:  # fmt: skip
    """Return setpoint and its speed [J, 2] of a mechanism's joints with servo columns `rows` [J, C] at `start` s in a
    recording, after its commands [K, len(columns)] since its begin; None where no profile limits any, NaN as of
    `setpoint.setpoints`."""
    if np.isinf(rows[:, [INDEX[name] for name in ("profile_speed", "profile_acceleration")]]).all():
        return None
    from dexsim.actuator.setpoint import setpoints

    place, t = [m.joints.index(j) for j in columns], np.asarray(commands.t, float)
    if m.table.control_rate:
        t = np.ceil(t * m.table.control_rate - 1e-3) / m.table.control_rate
    first = float(recording.states.position.t[0])
    first = first if first > SOON else 0.0
    q, v, _ = begun(recording, m, first)
    sent = np.concatenate([q[None, place], commands.value])
    last = np.maximum.accumulate(np.where(np.isfinite(sent), np.arange(len(sent))[:, None], 0))
    sent = np.take_along_axis(sent, last, 0)[1:]
    out = np.full((len(m.joints), 2), np.nan)
    out[place] = setpoints(rows[place], np.stack([q, v], 1)[place], t, sent, first, np.array([start]), dt)[:, 0]
    return out


def begun(
    recording: Recording, m: Mechanism, start: float
) -> tuple[np.ndarray, np.ndarray, dict[str, tuple[np.ndarray, ...]]]:
    """Return (position [J] of the mechanism's joints at the first reading from `start` s on, NaN where there is none,
    their speed [J] then, of the recorded joints the path from there: times from `start`, position, speed, acceleration
    [n])."""
    initial, velocity, paths = np.full(len(m.joints), np.nan), np.zeros(len(m.joints)), {}
    for j, joint in enumerate(recording.joints):
        t, x = _seen(recording.states.position, j)
        on = t >= start - 1e-9
        if not on.any():
            continue
        t, x = t[max(int(np.argmax(on)) - MARGIN, 0) :], x[max(int(np.argmax(on)) - MARGIN, 0) :]
        first, k = int(np.argmax(t >= start - 1e-9)), m.joints.index(joint)
        speed = local_polynomial(t, x[:, None])[1][:, 0]
        initial[k] = x[first]
        velocity[k] = speed[first] if abs(speed[first]) > RESTS * np.abs(speed).max() else 0.0
        paths[joint] = t - start, *(y[:, 0] for y in followed(t, x[:, None]))
    return initial, velocity, paths


def followed(t: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return position, speed and acceleration [S, J] of a recorded motion x [S, J] at t [S] s, fast motion not cut."""
    return local_polynomial(t, x, degree=QUICK)


def _seen(series: Series, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Return times and values of one column where it was recorded."""
    if not len(series):
        return np.zeros(0), np.zeros(0)
    x = np.asarray(series.value, float).reshape(len(series), -1)[:, j]
    ok = np.isfinite(x) & np.r_[True, np.diff(series.t) > 1e-6]
    return np.asarray(series.t, float)[ok], x[ok]


def _recorded_columns(recording: Recording, m: Mechanism, place: list[int], start: float) -> dict[str, Series]:
    """Return servo columns that a recording gives: the supply, as a share of the table's, and temperatures above the
    reference, where a column of the table depends on them."""
    out, table = {}, m.table
    supply, heat = recording.supply_voltage, recording.temperature
    if supply is not None and table.supply_voltage and len(t_x := _seen(supply, 0)[0]):
        share = np.mean(_seen(supply, 0)[1]) / table.supply_voltage * m.column("supply")
        out["supply"] = Series(t_x[:1], share[None])
    if heat is not None and len(heat) and any(c in WARM for columns in table.entries.values() for c in columns):
        value = np.zeros((len(heat), len(m.joints)))
        value[:, place] = np.nan_to_num(heat.value - REFERENCE)
        out["warmth"] = Series(np.asarray(heat.t, float) - start, value)
    return out


@dataclass
class Led:
    """Joints that follow a path, whatever the dynamics: by name times [n] s and position, speed, acceleration [n] as
    their encoders report them."""

    paths: dict[str, tuple[np.ndarray, ...]]

    @property
    def joints(self) -> list[str]:
        """Their names."""
        return list(self.paths)

    def at(self, t: np.ndarray, offset: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return position, speed and acceleration [T, J] of the joints at times t [T] s; offset, scale [J]: of their
        encoders. Position and speed belong together: a cubic between readings; beyond them a joint rests."""
        from scipy.interpolate import CubicHermiteSpline

        out = []
        for times, q, v, a in self.paths.values():
            at = np.clip(t, times[0], times[-1])
            curve = CubicHermiteSpline(times, q, v)
            on = (t >= times[0]) & (t <= times[-1])
            out.append((curve(at), np.where(on, curve(at, 1), 0.0), np.where(on, np.interp(at, times, a), 0.0)))
        q, v, a = (np.stack(x, 1) for x in zip(*out, strict=True))
        return (q - offset) / scale, v / scale, a / scale


def _path(poses: Series, steps: int, timestep: float) -> tuple[np.ndarray, np.ndarray]:
    """Return poses [K, 7] at each physics step, and the speeds [K, 6] (linear in the world, angular in the body) that
    led there."""
    value = poses.value.copy()
    turned = np.cumprod(np.where((value[1:, 3:] * value[:-1, 3:]).sum(1) < 0, -1.0, 1.0))
    value[1:, 3:] *= turned[:, None]  # q and -q are one orientation: take the near one
    at = np.stack([np.interp(np.arange(steps) * timestep, poses.t, x) for x in value.T], 1)
    at[:, 3:] /= np.linalg.norm(at[:, 3:], axis=1, keepdims=True)
    speed = np.zeros((steps, 6))
    speed[1:, :3] = np.diff(at[:, :3], axis=0) / timestep
    for k in range(1, steps):
        mujoco.mju_subQuat(speed[k, 3:], at[k, 3:], at[k - 1, 3:])
    speed[:, 3:] /= timestep
    return at, speed


def _table(servo: str | Path | dict) -> ServoTable:
    return ServoTable.from_dict(servo) if isinstance(servo, dict) else ServoTable.load(Path(servo).expanduser())


def _hold_friction(spec: mujoco.MjSpec, hardest: bool = False) -> None:
    """Let dry friction hold as in the hand's tasks; hardest: as hard as MuJoCo can, where a model says nothing of it.
    By MuJoCo's defaults a stuck joint creeps, by 20 mrad in some seconds."""
    said = mujoco.MjSpec().worldbody.add_body().add_joint()
    usual = [*said.solimp_friction, *said.solref_friction]
    for joint in spec.joints:
        if not hardest:
            joint.solimp_friction, joint.solref_friction = [0.999, 0.9999, 1e-3, 0.5, 2.0], [0.01, 1.0]
        elif [*joint.solimp_friction, *joint.solref_friction] == usual:
            joint.solimp_friction, joint.solref_friction = [0.9999, 0.9999, 1e-3, 0.5, 2.0], [0.002, 1.0]
