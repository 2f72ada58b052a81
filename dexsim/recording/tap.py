"""Recording a running simulation: rows of a few worlds, copied on the device at every physics step."""

# No `from __future__ import annotations`: Warp resolves a kernel's annotations from the closure.

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
import yaml

from dexsim.actuator.columns import COLUMNS, INDEX, NAMES
from dexsim.errors import UserError
from dexsim.recording.realistic import realistic as as_hardware
from dexsim.recording.schema import COMMANDS, DEFAULTS, OBJECT_POSE, STATES, TACTILE, Recording, Series, States
from dexsim.recording.writer import write
from dexsim.sim.scene import OBJECT

SCALE, OFFSET = INDEX["position_scale"], INDEX["position_offset"]


@lru_cache(maxsize=None)
def copy_kernel(real):
    """One row of each chosen world: time, then reported position, speed and motor torque of every joint, then the
    object's pose. The slot written goes round, and is kept on the device so that the launch can be part of a graph."""

    @wp.kernel(module="unique", enable_backward=False)
    def copy_rows(
        worlds: wp.array(dtype=int),
        q_index: wp.array(dtype=int),
        v_index: wp.array(dtype=int),
        object_q: int,
        time: wp.array(dtype=real),
        qpos: wp.array2d(dtype=real),
        qvel: wp.array2d(dtype=real),
        torque: wp.array2d(dtype=real),
        params: wp.array3d(dtype=real),
        slot: wp.array(dtype=int),
        rows: wp.array3d(dtype=real),
    ):
        s, c = wp.tid()
        w = worlds[s]
        joints = q_index.shape[0]
        value = time[w]
        if c >= 1 and c <= joints:
            j = c - 1
            value = params[w, j, SCALE] * qpos[w, q_index[j]] + params[w, j, OFFSET]
        elif c > joints and c <= 2 * joints:
            j = c - 1 - joints
            value = params[w, j, SCALE] * qvel[w, v_index[j]]
        elif c > 2 * joints and c <= 3 * joints:
            value = torque[w, c - 1 - 2 * joints]
        elif c > 3 * joints:
            value = qpos[w, object_q + c - 1 - 3 * joints]
        rows[slot[0], s, c] = value

    return copy_rows


@wp.kernel(enable_backward=False)
def next_slot(count: int, slot: wp.array(dtype=int)):
    slot[0] = (slot[0] + 1) % count


class PlayRecorder:
    """Records the first whole episode of the first `count` worlds of a hand environment; others are not touched.

    A launch a physics step copies the chosen rows on the device; one copy a control step brings them to the host.
    Attach before the episodes begin; `save` writes what there is. An episode's recording ends when the world is
    reset, or when gravity turns (a recording has one direction of gravity).
    """

    def __init__(self, env: Any, count: int, config: dict[str, Any]):
        for name in ("engine", "servo", "touch", "objects", "target"):
            if not hasattr(env, name):
                raise UserError(f"record=...: this task cannot be recorded (its environment has no {name})")
        if not 1 <= count <= env.num_envs:
            raise UserError(f"record_worlds={count}: must lie in [1, {env.num_envs}], the number of worlds")
        self.env, self.config = env, config
        engine, servo = env.engine, env.servo
        self.worlds = torch.arange(count, device=env.device)
        self.joints = tuple(servo.joints)
        J, K = len(self.joints), env.decimation
        with wp.ScopedDevice(engine.device):
            self._args = [
                wp.array(list(range(count)), dtype=int), wp.array(engine.qpos_index(self.joints), dtype=int),
                wp.array(engine.dof_index(self.joints), dtype=int),
                int(engine.mjm.jnt_qposadr[engine.joint(f"{OBJECT}_free")]),
                engine.wp.time, engine.wp.qpos, engine.wp.qvel, servo._torque, servo._params,
                wp.zeros(1, dtype=int), wp.zeros((K, count, 1 + 3 * J + 7), dtype=engine.real),
            ]  # fmt: skip
        self._slot, self._rows = self._args[-2], self._args[-1]
        self._rows_t = wp.to_torch(self._rows)
        self._kernel = copy_kernel(engine.real)
        self._servo_before, self._step = servo.before_each, env.step
        self.tracks: list[_Track] = [_Track() for _ in range(count)]
        # one object, kept: the engine knows a recorded step by its callbacks
        servo.before_each = self._before_each
        env.step = self._recorded_step

    def detach(self) -> None:
        """Let the environment go on without recording."""
        self.env.servo.before_each, self.env.step = self._servo_before, self._step

    def _before_each(self) -> None:
        self._servo_before()
        wp.launch(self._kernel, dim=self._rows.shape[1:], inputs=self._args, device=self.env.engine.device)
        wp.launch(next_slot, dim=1, inputs=[self._rows.shape[0], self._slot], device=self.env.engine.device)

    def _recorded_step(self, actions: torch.Tensor):
        env = self.env
        if all(track.over for track in self.tracks):
            return self._step(actions)
        self._slot.zero_()
        for k, track in enumerate(self.tracks):
            if not track.times and not track.over:
                track.world = _world(env, k)
        out = self._step(actions)
        n = len(self.tracks)
        parts = [self._rows_t.permute(1, 0, 2), env.target[:n], env.engine.field("opt.gravity")[:n], env.done[:n]]
        raw = env.touch.raw3 if env.touch.raw3 is not None else env.touch.raw
        if raw is not None:
            parts.append(raw[:n])
        shapes = [p.shape[1:] for p in parts]
        flat = torch.cat([p.reshape(n, -1).double() for p in parts], 1).cpu().numpy()
        edges = np.cumsum([0, *(int(np.prod(s)) for s in shapes)])
        for k, track in enumerate(self.tracks):
            pieces = [flat[k, a:b].reshape(s) for a, b, s in zip(edges[:-1], edges[1:], shapes, strict=True)]
            track.add(*pieces[:4], pieces[4] if raw is not None else None, env.dt)
        return out

    def recordings(self) -> list[Recording]:
        """What was recorded so far, one a world that has anything."""
        return [self._recording(track) for track in self.tracks if track.times]

    def save(self, path: str | Path, realistic: bool = False, seed: int = 0) -> list[Path]:
        """Write `path` (several worlds: NAME_w0.mcap, ...), like the hardware would have seen it if `realistic`."""
        path = Path(path).expanduser()
        path = path if path.suffix == ".mcap" else path.with_name(path.name + ".mcap")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"record={path}: {error.strerror}") from None
        out = []
        recordings = self.recordings()
        for k, recording in enumerate(recordings):
            if realistic:
                recording = as_hardware(recording, seed + k, self.env.servo.current_per_torque.double().cpu().numpy())
            to = path if len(self.tracks) == 1 else path.with_name(f"{path.stem}_w{k}.mcap")
            write(to, recording)
            out.append(to)
        return out

    def _recording(self, track: "_Track") -> Recording:
        J = len(self.joints)
        rows = np.concatenate(track.rows)
        t = rows[:, 0]
        command_t = np.array(track.times)
        parts = [Series(t, rows[:, 1 + k * J : 1 + (k + 1) * J], STATES, t.copy()) for k in range(3)]
        pose = Series(t, rows[:, 1 + 3 * J :], OBJECT_POSE, t.copy(), "palm")
        servo = self.env.servo.table
        gravity = " ".join(f"{g:g}" for g in track.gravity)
        notes = f"world {track.world['index']} of a play; object {track.world['object']['shape']}"
        meta = DEFAULTS | {
            "source": "sim",
            "robot": "xhand_right",
            "joint_names": ",".join(self.joints),
            "effort_is": "torque_Nm",
            "effort_sign": "+1",
            "tactile_unit": "N",
            "tactile_lsb": "1",
            "gravity": gravity,
            "notes": "; ".join([notes, *track.notes]),
            "servo": yaml.safe_dump(servo.to_dict() | {"joints": track.servo}, sort_keys=False),
        }
        tactile = None
        if track.touch:
            force = np.stack(track.touch)
            if force.ndim == 3:  # normal forces only
                force = np.stack([np.zeros_like(force), np.zeros_like(force), force], -1)
            tactile = Series(np.array(track.touch_times), force, TACTILE)
        config = yaml.safe_dump(self.config | {"recorded_world": track.world}, sort_keys=False)
        return Recording(
            Path("play.mcap"),
            meta,
            self.joints,
            Series(command_t, np.stack(track.targets), COMMANDS, command_t.copy()),
            States(*parts),
            tactile=tactile,
            object_pose=pose,
            config=config,
            start_ns=1_000_000_000,
        )


class _Track:
    """The episode of one world."""

    def __init__(self) -> None:
        self.world: dict[str, Any] = {}
        self.servo: dict[str, Any] = {}
        self.times: list[float] = []
        self.targets: list[np.ndarray] = []
        self.rows: list[np.ndarray] = []
        self.touch: list[np.ndarray] = []
        self.touch_times: list[float] = []
        self.gravity: np.ndarray | None = None
        self.notes: list[str] = []
        self.over = False

    def add(
        self,
        rows: np.ndarray,
        target: np.ndarray,
        gravity: np.ndarray,
        done: np.ndarray,
        touch: np.ndarray | None,
        dt: float,
    ) -> None:
        """One control step: rows [K, W], target [J] and touch as they are after it."""
        start = float(rows[0, 0])
        if not self.over and self.times and start <= self.times[-1]:
            self.over = True  # reset in between
        if not self.over and self.gravity is not None and np.abs(gravity - self.gravity).max() > 0.05:
            self.over = True
            self.notes.append("ends where gravity turns")
        if self.over:
            return
        self.servo = self.world.pop("servo", self.servo)
        self.gravity = gravity if self.gravity is None else self.gravity
        self.over = bool(done)
        if self.over and not self.times:  # the episode's only step
            return
        self.rows.append(rows)
        self.times.append(start)
        # a reset has replaced the last target: the one before stands
        self.targets.append(self.targets[-1] if done else target)
        if touch is not None and not done:
            self.touch.append(touch)
            self.touch_times.append(start + dt)


def _world(env: Any, k: int) -> dict[str, Any]:
    """What differs in this world: object and drives, as plain data."""
    o = env.objects
    variant = env.scene.variants[int(o.variant[k])]
    params = env.servo.params[k].double().cpu().numpy()
    servo = {
        joint: {
            name: float(params[j, c])
            for c, name in enumerate(NAMES)
            if np.isfinite(params[j, c]) and params[j, c] != COLUMNS[c].neutral
        }
        for j, joint in enumerate(env.servo.joints)
    }
    return {
        "index": k,
        "servo": servo,
        "object": {
            "shape": variant.shape.name,
            "kind": variant.shape.kind,
            "size": [float(x) for x in o.size[k]],
            "mass": float(o.mass[k]),
            "friction": float(o.friction[k]),
            "stiffness": float(o.stiffness[k]),
            "damping_ratio": float(o.damping_ratio[k]),
        },
    }
