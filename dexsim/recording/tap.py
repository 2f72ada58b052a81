"""Recording a running simulation: rows of a few worlds, copied on the device at every physics step."""

# No `from __future__ import annotations`: Warp resolves a kernel's annotations from the closure.

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
import yaml

from dexsim import outputs, yaml_text
from dexsim.actuator.columns import COLUMNS, NAMES
from dexsim.actuator.reference import measured_position
from dexsim.actuator.table import ServoTable
from dexsim.console.folders import make
from dexsim.errors import UserError
from dexsim.recording.realistic import realistic as as_hardware
from dexsim.recording.schema import COMMANDS, DEFAULTS, IMU, OBJECT_POSE, STATES, TACTILE, Recording, Series, States
from dexsim.recording.writer import write
from dexsim.sim.scene import OBJECT


@cache
def copy_kernel(real: type) -> wp.Kernel:
    """Return the kernel that copies a row of each chosen world: time, then positions, speeds and motor torques. The
    slot written goes round, and is kept on the device so that the launch can be part of a graph."""

    @wp.kernel(module="unique", enable_backward=False)
    def copy_rows(
        worlds: wp.array(dtype=int), at_q: wp.array(dtype=int), at_v: wp.array(dtype=int), time: wp.array(dtype=real),
        qpos: wp.array2d(dtype=real), qvel: wp.array2d(dtype=real), torque: wp.array2d(dtype=real),
        slot: wp.array(dtype=int), rows: wp.array3d(dtype=real),
    ):  # fmt: skip
        s, c = wp.tid()
        w = worlds[s]
        q = at_q.shape[0]
        v = q + at_v.shape[0]
        value = time[w]
        if c > v:
            value = torque[w, c - 1 - v]
        elif c > q:
            value = qvel[w, at_v[c - 1 - q]]
        elif c > 0:
            value = qpos[w, at_q[c - 1]]
        rows[slot[0], s, c] = value

    return copy_rows


@wp.kernel(enable_backward=False)
def next_slot(count: int, slot: wp.array(dtype=int)):
    slot[0] = (slot[0] + 1) % count


LEAST = 2.0
"""s: an episode that ends sooner (the object fell at once) gives way to a longer one of the same world."""
EVERY = 32
"""Control steps between two copies to the host, which wait for the device."""


class PlayRecorder:
    """Records an episode of chosen worlds of a hand environment; others are not touched.

    worlds: which ones, or how many from the first. The first whole episode that lasts `least` s is kept, else the
    longest. A launch a physics step copies the chosen rows on the device; they come to the host every `EVERY` control
    steps, so that no step waits for them. Attach before the episodes begin; `save` writes what there is. An episode's
    recording ends when the world is reset, or when gravity turns (a recording has one direction of gravity).
    """

    def __init__(self, env: Any, worlds: int | Sequence[int], config: dict[str, Any], least: float = LEAST):
        for name in ("engine", "servo", "touch", "objects", "target"):
            if not hasattr(env, name):
                raise UserError(f"record=...: this task cannot be recorded (its environment has no {name})")
        try:
            chosen = list(range(worlds)) if isinstance(worlds, int) else [int(w) for w in worlds]
        except (TypeError, ValueError):
            chosen = []
        if not chosen or len(set(chosen)) != len(chosen) or min(chosen) < 0 or max(chosen) >= env.num_envs:
            raise UserError(
                f"record_worlds={worlds}: must be a number from 1 to {env.num_envs}, the number of worlds, or a list of"
                f" different ones, 0 to {env.num_envs - 1}"
            )
        self.env, self.config = env, config
        engine, servo = env.engine, env.servo
        self.worlds = torch.tensor(chosen, device=env.device)
        self.joints = tuple(servo.joints)
        J, K, count = len(self.joints), env.decimation, len(chosen)
        with wp.ScopedDevice(engine.device):
            at = int(engine.mjm.jnt_qposadr[engine.joint(f"{OBJECT}_free")]) + np.arange(7)
            self._kernel, e = copy_kernel(engine.real), engine.wp
            at_q = np.concatenate([engine.qpos_index(self.joints), at, engine.qpos_index(env.hand.sensed)])
            self._slot = wp.zeros(1, dtype=int)
            self._rows = wp.zeros((K, count, 1 + len(at_q) + 2 * J), dtype=engine.real)
            where: list[wp.array] = [wp.array(x, dtype=int) for x in (chosen, at_q, engine.dof_index(self.joints))]
            self._args = [*where, e.time, e.qpos, e.qvel, servo._torque, self._slot, self._rows]
        self._rows_t = wp.to_torch(self._rows)
        self._servo_before, self._step = servo.before_each, env.step
        self._imu = env.task.get("perception") == "imu"  # an IMU in the object
        self._waiting: list[torch.Tensor] = []
        self._shapes: list[torch.Size] = []
        self.tracks: list[_Track] = [_Track(w, env.dt, least) for w in chosen]
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

    def _recorded_step(self, actions: torch.Tensor) -> tuple[Any, torch.Tensor, torch.Tensor, dict[str, Any]]:
        env, w = self.env, self.worlds
        self._slot.zero_()
        o = env.objects
        # what an episode is about, as it is before a step may end it; copies
        things = (o.variant, o.size, o.mass, o.friction, o.stiffness, o.damping_ratio)
        about = [env.servo.params[w], *(x[w] for x in things)]
        about += [env.object_velocity[w, 3:], *([env.seen[w]] if self._imu else [])]
        out = self._step(actions)
        raw = env.touch.raw3 if env.touch.raw3 is not None else env.touch.raw
        after = [self._rows_t.permute(1, 0, 2), env.target[w], env.engine.field("opt.gravity")[w], env.done[w]]
        after += [raw[w]] if raw is not None else []
        parts = [*about, *after]
        self._shapes = [p.shape[1:] for p in parts]
        self._waiting.append(torch.cat([p.reshape(len(w), -1).double() for p in parts], 1))
        if len(self._waiting) >= EVERY:
            self._fetch()
            if all(track.over for track in self.tracks):
                self.detach()
        return out

    def _fetch(self) -> None:
        """Move what waits on the device to the tracks."""
        if not self._waiting:
            return
        flat = torch.stack(self._waiting).cpu().numpy()
        self._waiting.clear()
        edges = np.cumsum([0, *(int(np.prod(s)) for s in self._shapes)])
        cut = list(zip(edges[:-1], edges[1:], self._shapes, strict=True))
        for step in flat:
            for track, row in zip(self.tracks, step, strict=True):
                pieces = [row[a:b].reshape(s) for a, b, s in cut]
                about, spin, rest = pieces[:7], pieces[7], pieces[8:]
                turned = np.concatenate([rest.pop(0), spin]) if self._imu else None
                rows, target, gravity, done = rest[:4]
                track.add(about, turned, rows, target, gravity, done, rest[4] if len(rest) > 4 else None)

    def recordings(self) -> list[Recording]:
        """Return what was recorded so far, one a world that has anything."""
        self._fetch()
        for track in self.tracks:
            track.finish()
        return [self._recording(track) for track in self.tracks if track.episode.times]

    def claim(self, path: str | Path) -> None:
        """Check that what `save` would write can be written, and is not there yet. Raises UserError: before a long
        play, rather than after it."""
        make(outputs.mcap(path).parent, "record=")
        for to in self._paths(path).values():
            outputs.new(to, "record=")

    def _paths(self, path: str | Path) -> dict[int, Path]:
        """Return world -> its file."""
        path = outputs.mcap(path)
        if len(self.tracks) == 1:
            return {self.tracks[0].world: path}
        return {t.world: path.with_name(f"{path.stem}_w{t.world}.mcap") for t in self.tracks}

    def save(self, path: str | Path, realistic: bool = False, seed: int = 0) -> list[Path]:
        """Write `path` (several worlds: NAME_w0.mcap, ...), like the hardware would have seen it if `realistic`."""
        make(outputs.mcap(path).parent, "record=")
        out = []
        for k, recording in enumerate(self.recordings()):
            if realistic:
                recording = as_hardware(recording, seed + k, self.env.servo.current_per_torque.double().cpu().numpy())
            assert recording.config is not None  # ours have one
            world = yaml_text.parse(recording.config, path)["recorded_world"]["index"]
            to = self._paths(path)[world]
            write(to, recording)
            out.append(to)
        return out

    def _recording(self, track: "_Track") -> Recording:
        J, e = len(self.joints), track.episode
        rows = np.concatenate(e.rows)
        t = rows[:, 0] - rows[0, 0]
        start = float(rows[0, 0])
        command_t = np.array(e.times) - start
        sensed = len(self.env.hand.sensed)
        q, pose, follower, v, torque = np.split(rows[:, 1:], np.cumsum([J, 7, sensed, J]), 1)
        # as the encoders show it: with what the drives are in this episode
        q, slope = measured_position(dict(zip(NAMES, e.about[0].T, strict=True)), q, self.env.servo.features)
        parts = [Series(t, x, STATES, t.copy()) for x in (q, slope * v, torque)]
        world, servo = self._world(track.world, e.about)
        assert e.gravity is not None  # set with the first row
        gravity = " ".join(f"{g:g}" for g in e.gravity)
        notes = f"world {track.world} of a play; object {world['object']['shape']}"
        meta = DEFAULTS | {
            "source": "sim",
            "robot": self.env.hand.robot,
            "joint_names": ",".join(self.joints),
            "effort_is": "torque_Nm",
            "effort_sign": "+1",
            "tactile_unit": "N",
            "tactile_lsb": "1",
            "gravity": gravity,
            "notes": "; ".join([notes, *e.notes]),
            "servo": yaml.safe_dump(
                self._believed() or self.env.servo.table.to_dict() | {"joints": servo}, sort_keys=False
            ),
        }
        tactile, imu = None, None
        if e.touch:
            force = np.stack(e.touch)
            if force.ndim == 3:  # normal forces only
                force = np.stack([np.zeros_like(force), np.zeros_like(force), force], -1)
            tactile = Series(np.array(e.touch_times) - start, force, TACTILE)
        if e.turned:
            value = np.stack(e.turned)
            # no accelerometer is simulated: not a number, as a driver that has none says
            imu = Series(
                command_t, np.concatenate([value, np.full((len(value), 3), np.nan)], 1), IMU, command_t.copy(), "object"
            )
        config = yaml.safe_dump(self.config | {"recorded_world": world}, sort_keys=False)
        return Recording(
            Path("play.mcap"),
            meta,
            self.joints,
            Series(command_t, np.stack(e.targets), COMMANDS, command_t.copy()),
            States(*parts),
            tactile=tactile,
            object_pose=Series(t, pose, OBJECT_POSE, t.copy(), "palm"),
            imu=imu,
            config=config,
            start_ns=1_000_000_000,
        ).with_followers(self.env.hand.sensed, follower)

    def _believed(self) -> dict[str, Any] | None:
        """Return the drives as the policy believes them, where it plays in another world (reality=), which does not
        tell its own: a recording from there says no more than one of a real hand."""
        belief = self.config.get("belief")
        return ServoTable.from_dict(belief["servo"]).to_dict() if belief else None

    def _world(self, index: int, about: list[np.ndarray]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return what differs in a world: object and drives, as plain data."""
        params, variant, size, mass, friction, stiffness, damping = about
        shape = self.env.objects.scene.variants[int(variant)].shape
        servo = {
            joint: {
                name: float(params[j, c])
                for c, name in enumerate(NAMES)
                if np.isfinite(params[j, c]) and params[j, c] != COLUMNS[c].neutral
            }
            for j, joint in enumerate(self.joints)
        }
        about_object = {"shape": shape.name, "kind": shape.kind, "size": [float(x) for x in size]} | {
            k: float(v)
            for k, v in (("mass", mass), ("friction", friction), ("stiffness", stiffness), ("damping_ratio", damping))
        }
        return {"index": index, "object": about_object}, servo


@dataclass
class _Episode:
    """One episode's samples, in the engine's time [s]."""

    about: list[np.ndarray] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    targets: list[np.ndarray] = field(default_factory=list)
    rows: list[np.ndarray] = field(default_factory=list)
    touch: list[np.ndarray] = field(default_factory=list)
    touch_times: list[float] = field(default_factory=list)
    turned: list[np.ndarray] = field(default_factory=list)
    gravity: np.ndarray | None = None
    notes: list[str] = field(default_factory=list)


class _Track:
    """One world: the episode that is kept and the one that goes on."""

    def __init__(self, world: int, dt: float, least: float) -> None:
        self.world, self.dt, self.least = world, dt, least
        self.episode, self._now = _Episode(), _Episode()
        self.over, self._waits = False, False

    def finish(self) -> None:
        """End the episode that goes on; the longer one is kept."""
        if len(self._now.times) > len(self.episode.times):
            self.episode = self._now
        self._now, self._waits = _Episode(), False
        self.over = self.over or len(self.episode.times) * self.dt >= self.least

    def add(
        self, about: list[np.ndarray], turned: np.ndarray | None, rows: np.ndarray, target: np.ndarray,
        gravity: np.ndarray, done: np.ndarray, touch: np.ndarray | None,
    ) -> None:  # fmt: skip
        """Add one control step: what the episode is `about` and how its IMU was turned [7] as they were before it, rows
        [K, W], target [J] and touch as they are after it."""
        if self.over:
            return
        e, start = self._now, float(rows[0, 0])
        if e.times and start <= e.times[-1]:  # reset in between
            self.finish()
            if self.over:
                return
            e = self._now
        if e.gravity is not None and not self._waits and np.abs(gravity - e.gravity).max() > 0.05:
            e.notes.append("ends where gravity turns")
            self._waits = True  # for the world's next episode
        if not self._waits:
            if not e.times:
                e.about, e.gravity = about, gravity
            if not (done and not e.times):  # else the episode's only step
                e.rows.append(rows)
                e.times.append(start)
                # a reset has replaced the last target: the one before stands
                e.targets.append(e.targets[-1] if done else target)
                if turned is not None:
                    e.turned.append(turned)
                if touch is not None and not done:
                    e.touch.append(touch)
                    e.touch_times.append(start + self.dt)
        if done:
            self.finish()
