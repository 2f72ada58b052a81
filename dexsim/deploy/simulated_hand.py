"""A simulated hand behind the SDK's fields: units, signs, rounding, rates and latency of the real one, physics of
training.

`SimulatedHand` is the hand on its bench, in simulated time. `SimulatedXHand` is the driver: with a real clock the hand
lives in a process of its own, as a real one does, and the two share memory; with a `VirtualClock` it is advanced in
place.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import time
from typing import Any

import numpy as np

from dexsim import system
from dexsim.calibration.file import Calibration
from dexsim.deploy.driver import PASSIVE, POSITION, Clock, HandCommand, HandState
from dexsim.errors import UserError
from dexsim.tactile.layout import touch_shape
from dexsim.tasks.env import hand_of

POSITION_LSB = 2 * np.pi / 4096
"""rad a count of the hand's 12-bit encoders."""
KP_NOMINAL = 100.0
"""The firmware's kp that the servo table stands for: what most users send."""
BUS_PERIOD = 0.010
"""s of a bus cycle: a command goes out and a state comes back (RS485: 9.6 ms measured by users)."""
SPEED_LSB = 1e-3
"""rad/s a count of the speed that newer firmware reports."""
TIMESTEP = 0.0035  # s of physics, about
AWAY = 0.25  # m above its place, where an object waits to be put into the hand
VISION_PERIOD = 1 / 30


class SimulatedHand:
    """Hand, object and physics of a bundle's training config, one world, spoken to in the SDK's terms.

    The object hangs in its place until `release`. camera: see the object through a rendered depth image and its mask,
    else its height is given with the config's noise. grip: a bundle's `grip`, of a task that starts with the object in
    the hand: the object is out of reach until `present`, and then held there until `release`; an IMU in it says how it
    is turned, with the config's noise, drift and delay. Deterministic for a seed, in simulated time.
    """

    def __init__(
        self,
        config: dict[str, Any],
        calibration: Calibration,
        seed: int = 0,
        camera: bool = False,
        shape: str | None = None,
        grip: dict[str, Any] | None = None,
    ):
        import copy

        import torch

        from dexsim.tasks import make_env

        cfg = copy.deepcopy(config)
        control = float(cfg["sim"]["control_period"])
        self.dt = control / max(1, round(control / TIMESTEP))
        cfg["sim"] |= {"timestep": self.dt, "threads": 1, "engine": "mujoco"}
        # felt once a bus cycle: as many readings are kept as a delay needs
        cfg["tactile"] |= {"raw": True, "period": 0.5 * BUS_PERIOD}
        cfg["device"], cfg["worlds"] = "cpu", 1
        if shape is not None:
            cfg["task"]["objects"]["train"] = [shape]
            cfg["task"]["objects"]["held_out"] = [s for s in cfg["task"]["objects"]["held_out"] if s != shape] or [
                "box"
            ]
        grasps = None
        if grip is not None:
            from dexsim.tasks.stable_grasps import CUBE, GraspSet, called

            objects, held = cfg["task"]["objects"], grip.get("object", CUBE)
            names = tuple(dict.fromkeys(called(name) for name in (*objects["train"], *objects["held_out"])))
            if held not in names:
                raise UserError(f"shape={shape}: the policy begins with '{held}' in the hand; leave shape= out")
            rows = (grip["object_edge_m"], grip["hand"], grip["target"], grip["object_pose"])
            which = torch.tensor([names.index(held)])
            grasps = GraspSet(*(torch.tensor([x], dtype=torch.float32) for x in rows), shape=which, names=names)
        self.env = make_env(cfg, 1, "cpu", seed, "mujoco", grasps)
        self.taxels = touch_shape(self.env.hand)
        self.calibration, self.noise = calibration, float(config["task"]["sensors"].get("vision_z_noise", 0.0))
        self.rng = np.random.default_rng(seed)
        env, self._torch = self.env, torch
        self.imu = None
        if grip is not None:
            env.reset_all()
            self.imu = SimulatedImu(config, env, self.rng)
        self.time, self.sequence, self.held = 0.0, 0, True
        self._nominal = env.servo.params.clone()
        self._start = env.object_pose.clone().double(), torch.zeros(1, 6, dtype=torch.float64)
        self._away = torch.zeros(7, dtype=torch.float64)
        self._away[2] = AWAY if grip is not None else 0.0
        self.target = env.q[0].double().numpy().copy()
        self.camera = None
        if camera:
            self.camera = SimulatedCamera(self.env)
        self._seen: tuple[np.ndarray, float] | None = None
        self._look_at = 0.0
        self.lie_flat()

    def lie_flat(self) -> None:
        """The hand open and free, as it is before anybody drives it; the object waits over it."""
        env, torch = self.env, self._torch
        q = torch.as_tensor(np.clip(np.full(env.num_actions, 0.05), *env.hand.limits.T))[None]
        env.engine.t.qpos[:, env.joint_q] = q.to(env.engine.t.qpos.dtype)
        env.engine.t.qvel.zero_()
        env.servo.reset(None, q)
        self.relax()
        self._hold()

    def _hold(self) -> None:
        t = self.env.engine.t
        t.qpos[:, self.env.object_q] = (self._start[0] + self._away).to(t.qpos.dtype)
        t.qvel[:, self.env.object_v] = 0.0

    def present(self) -> None:
        """Somebody holds the object where the fingers will close on it."""
        self._away.zero_()

    def release(self) -> None:
        """The object is let go."""
        self.present()
        self.held = False

    def command(self, c: HandCommand) -> None:
        """Takes effect now (the bus has carried it). tor_max limits the motors, kp scales the servo's stiffness."""
        if c.mode == PASSIVE:
            return self.relax()
        if c.mode != POSITION:
            raise UserError(
                f"simulated hand: mode {c.mode} is not simulated; use {POSITION} (position) or {PASSIVE} (passive)"
            )
        s, torch = self.env.servo, self._torch
        s.state[:, :, s.slots["enabled"]] = 1.0
        limit = np.abs(np.asarray(c.tor_max, float)) * 1e-3 / self.calibration.current_per_torque
        base = self.env.servo.params
        nominal = self._nominal
        from dexsim.actuator.columns import INDEX

        k = INDEX["torque_limit"]
        base[..., k] = torch.minimum(nominal[..., k], torch.as_tensor(limit, dtype=base.dtype))
        base[..., INDEX["kp"]] = nominal[..., INDEX["kp"]] * (c.kp / KP_NOMINAL)
        self.target = np.array(c.position, float)
        s.send(torch.as_tensor(self.target)[None])

    def relax(self) -> None:
        """Mode 0: the motors are off; the gears still damp."""
        s = self.env.servo
        s.state[:, :, s.slots["enabled"]] = 0.0

    def advance(self, t: float) -> None:
        """Simulate up to time t [s since the start]; poses, touch and vision are then of that time."""
        env, e = self.env, self.env.engine
        steps = int(round((t - self.time) / self.dt))
        if steps <= 0:
            return
        for _ in range(steps):
            if self.held:
                self._hold()
            e.step(1, env.servo.before_each)
        self.time += steps * self.dt
        env.touch.launch()
        env.read_state()
        if self.imu is not None:
            self.imu.measure(self.time)
        if self.time >= self._look_at:
            self._look_at = self.time + VISION_PERIOD
            self._look()

    def _look(self) -> None:
        place = None
        if self.camera is not None:
            place = self.camera.see(self.time)
        else:
            place = self.env.object_pose[0, :3].double().numpy().copy()
            place[2] += self.noise * self.rng.standard_normal()
        if place is not None:
            self._seen = place, self.time

    def place(self) -> tuple[np.ndarray, float] | None:
        """The object as last seen, [3] m, and when [s]."""
        return self._seen

    def orientation(self) -> tuple[np.ndarray, float] | None:
        """How the object is turned, [4] w x y z, as its IMU last said, and when [s]; None without one."""
        return None if self.imu is None else self.imu.newest(self.time)

    def state(self, now: float) -> HandState:
        """The state as the SDK would give it, arriving at host time `now`."""
        env = self.env
        self.sequence += 1
        position = np.round(env.servo.position()[0].double().numpy() / POSITION_LSB) * POSITION_LSB
        current = np.clip(
            np.round(1e3 * self.calibration.current(env.torque[0].double().numpy())), -32768, 32767
        ).astype(np.int16)
        tactile = np.zeros((*self.taxels, 3), np.int16)
        if not tactile.size:
            pass
        elif env.touch.raw3 is not None:
            counts = env.touch.raw3[0].double().numpy() / (self.calibration.lsb * self.calibration.axis_sign)
            tactile[:] = np.clip(np.round(counts), [-128, -128, 0], [127, 127, 255])
        else:
            assert env.touch.raw is not None  # a hand that touches
            tactile[..., 2] = np.clip(np.round(env.touch.raw[0].double().numpy() / self.calibration.lsb), 0, 255)
        speed = np.round(env.servo.velocity()[0].double().numpy() / SPEED_LSB) * SPEED_LSB
        return HandState(now, self.sequence, position.astype(np.float32), current, np.full(len(position), 30.0),
                         np.zeros(len(position), np.int64), tactile,
                         np.clip(speed, -32.768, 32.767))  # fmt: skip


class SimulatedImu:
    """An IMU inside the object, 100 readings a second, as training has it: late by `imu.delay`, noisy, a little tilted,
    its heading drifting (middle of the randomized delay, one draw of the others)."""

    def __init__(self, config: dict[str, Any], env: Any, rng: np.random.Generator):
        draw = lambda name: float(rng.uniform(*env.sampler.range(name)[:2]))  # noqa: E731
        sense = config["task"]["sensors"]
        self._env, self._rng = env, rng
        self.delay = float(np.mean(env.sampler.range("imu.delay")[:2]))
        self._noise, self._walk = float(sense["imu_noise"]), float(sense["imu_heading_walk"])
        self._rate, self._tilt = draw("imu.heading_rate"), np.array([draw("imu.tilt"), draw("imu.tilt"), 0.0])
        self._heading, self._at = 0.0, 0.0
        self._past: list[tuple[float, np.ndarray]] = []

    def measure(self, t: float) -> None:
        """A reading of time t [s]."""
        import torch

        from dexsim import rotation

        step = t - self._at
        self._at = t
        self._heading += self._rate * step + self._walk * np.sqrt(max(step, 0.0)) * self._rng.standard_normal()
        off = rotation.from_vector(
            torch.as_tensor(self._tilt + self._noise * self._rng.standard_normal(3), dtype=torch.float32)
        )
        drift = rotation.about(torch.tensor([0.0, 0.0, 1.0]), torch.tensor(self._heading, dtype=torch.float32))
        q = rotation.normalize(rotation.multiply(drift, rotation.multiply(off, self._env.object_pose[0, 3:])))
        self._past.append((t, q.double().numpy()))
        if len(self._past) > 200:
            del self._past[:100]

    def newest(self, t: float) -> tuple[np.ndarray, float] | None:
        """The newest reading that has arrived by time t."""
        at, q = next(
            ((at, q) for at, q in reversed(self._past) if at <= t - self.delay + 1e-9),
            self._past[0] if self._past else (0.0, None),
        )
        return None if q is None else (q, at)


class SimulatedCamera:
    """A depth camera beside the hand: MuJoCo's offscreen depth and segmentation of the object, 160 x 120 pixels.

    It looks along the palm's plane from the fingers' side, a little from above, so that the mask's centroid is at the
    height of the object's middle. Needs OpenGL, chosen by MUJOCO_GL before MuJoCo is imported
    (`choose_gl`); raises UserError without.
    """

    WIDTH, HEIGHT, FOVY = 160, 120, 45.0

    def __init__(self, env: Any):
        import mujoco

        self._mujoco, self._env = mujoco, env
        self._model = env.drawn_model(0)
        self._model.vis.global_.offwidth, self._model.vis.global_.offheight = self.WIDTH, self.HEIGHT
        self._model.vis.global_.fovy = self.FOVY
        self._data = mujoco.MjData(self._model)
        self._geoms = [self._model.geom(s).id for s in env.scene.slots]
        try:
            self._renderer = mujoco.Renderer(self._model, self.HEIGHT, self.WIDTH)
        except Exception as error:  # whatever a driver raises
            raise UserError(
                f"vision=camera: no OpenGL for offscreen rendering ({str(error).splitlines()[0]});"
                f" {system.no_renderer()}; or use vision=truth"
            ) from None
        self._view = mujoco.MjvCamera()
        self._view.lookat[:] = [0.05, 0.0, 0.05]
        self._view.distance, self._view.azimuth, self._view.elevation = 0.45, 200.0, -12.0
        self.pose = self._pose()

    def _pose(self) -> Any:
        from dexsim.deploy.vision import CameraPose

        a, e = np.radians(self._view.azimuth), np.radians(self._view.elevation)
        forward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        right = np.array([np.sin(a), -np.cos(a), 0.0])
        up = np.cross(right, forward)
        position = self._view.lookat - self._view.distance * forward
        focal = 0.5 * self.HEIGHT / np.tan(np.radians(self.FOVY) / 2)
        return CameraPose(position, np.stack([right, up, -forward], 1), focal, (self.WIDTH / 2, self.HEIGHT / 2))

    def frame(self) -> Any:
        """Depth and mask now (`dexsim.deploy.vision.Frame`)."""
        from dexsim.deploy.vision import Frame

        mujoco, r = self._mujoco, self._renderer
        self._data.qpos[:] = self._env.engine.t.qpos[0].numpy()
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        r.enable_depth_rendering()
        r.update_scene(self._data, self._view)
        depth = r.render().copy()
        r.disable_depth_rendering()
        r.enable_segmentation_rendering()
        r.update_scene(self._data, self._view)
        ids = r.render()
        r.disable_segmentation_rendering()
        mask = np.isin(ids[..., 0], self._geoms) & (ids[..., 1] == int(mujoco.mjtObj.mjOBJ_GEOM))
        return Frame(depth, mask, self._env.engine.t.time[0].item())

    def see(self, now: float) -> np.ndarray | None:
        """The object's place [3] m by the paper's rule, None where it is hidden."""
        from dexsim.deploy.vision import centroid

        return centroid(self.frame(), self.pose)


def choose_gl() -> str:
    """The OpenGL that renders without a screen here, put into MUJOCO_GL for processes yet to start: each is tried in a
    process of its own, since a driver may crash. Raises UserError where there is none."""
    import subprocess
    import sys

    probe = "import mujoco; c = mujoco.GLContext(8, 8); c.make_current()"
    for name in system.renderers():
        env = system.renderer_environment(name)
        done = subprocess.run([sys.executable, "-c", probe], env=os.environ | env, capture_output=True, timeout=60)
        if done.returncode == 0:
            os.environ.update(env)
            return name
    raise UserError(f"vision=camera: no OpenGL for offscreen rendering; {system.no_renderer()}; or use vision=truth")


# -- the driver
# -----------------------------------------------------------------------------------------------------------------
_PLACE, _TURNED = slice(-9, -5), slice(-5, None)
"""The end of a state: place, its time; orientation, its time. Before it: time, sequence; position, current,
temperature, error, speed of every joint."""
_PRESENT, _RELEASE = 1.0, 2.0


def _shared(context: Any, joints: int, taxels: tuple[int, int]) -> tuple:
    """Two slots of state (the newest by its count) and two of commands: one writer each, no locks. A command: number,
    mode, position, tor_max, kp, what is done with the object."""
    touch = 3 * int(np.prod(taxels))
    state, command = 2 + 5 * joints + 9, 2 + 2 * joints + 2
    return (context.RawArray(ctypes.c_double, 2 * state), context.RawArray(ctypes.c_int16, 2 * max(touch, 1)),
            context.RawValue(ctypes.c_int64, -1),
            context.RawArray(ctypes.c_double, 2 * command), context.RawValue(ctypes.c_int64, -1),
            context.RawValue(ctypes.c_int, 0))  # fmt: skip


class SimulatedXHand:
    """The driver of a simulated hand (see the module). clock: a `VirtualClock` keeps it in this process, in step.

    latency [s]: from a state's measurement until `read` gives it, on top of the bus period.
    """

    name = "simulated hand"

    def __init__(
        self,
        config: dict[str, Any],
        calibration: Calibration,
        clock: Clock | None = None,
        seed: int = 0,
        camera: bool = False,
        shape: str | None = None,
        latency: float = 0.002,
        grip: dict[str, Any] | None = None,
    ):
        self.clock, self.latency = clock or Clock(), latency
        self._args = (config, calibration, seed, camera, shape, grip)
        hand = hand_of(config)
        self.joints, self.taxels = len(hand.joints), touch_shape(hand)
        self._process: multiprocessing.context.SpawnProcess | None = None
        self.hand: SimulatedHand | None = None
        self._queue: list[tuple[float, Any]] = []

    def open(self) -> dict[str, str]:
        info = {
            "driver": "simulated",
            "serial": "sim",
            "bus": f"{1 / BUS_PERIOD:g} Hz",
            "latency_s": f"{self.latency:g}",
        }
        if type(self.clock) is not Clock:
            self.hand = SimulatedHand(*self._args)
            self._zero, self._cycle = self.clock.now(), 0
            self._state: HandState | None = None
            self._commands: list[HandCommand] = []
            return info
        if self._args[3]:
            choose_gl()
        context = multiprocessing.get_context("spawn")
        shared = _shared(context, self.joints, self.taxels)
        self._views = _views(shared)
        self._number, self._object = 0, 0.0
        process = context.Process(target=_live, args=(self._args, shared, self.latency), daemon=True)
        process.start()
        self._process = process
        limit = time.monotonic() + 180.0
        while self._views["newest"].value < 0:  # kernels compile on a first start
            if not process.is_alive():
                raise UserError("the simulated hand's process ended at its start; its message stands above")
            if time.monotonic() > limit:
                raise UserError("the simulated hand did not start within 180 s")
            time.sleep(0.02)
        return info

    def read(self) -> HandState | None:
        if self.hand is not None:
            return self._step(self.hand)
        v = self._views
        while True:
            k = v["newest"].value
            if k < 0:
                return None
            row, touch = v["state"][k % 2].copy(), v["touch"][k % 2].copy()
            if v["newest"].value - k < 2:
                break  # else the slot was written over while it was copied
        part = row[2:-9].reshape(5, self.joints)
        return HandState(row[0], int(row[1]), part[0].astype(np.float32), part[1].astype(np.int16), part[2],
                         part[3].astype(np.int64),
                         touch[: 3 * int(np.prod(self.taxels))].reshape(*self.taxels, 3), part[4])  # fmt: skip

    def place(self, now: float) -> tuple[np.ndarray, float] | None:
        """HeightSource: the object as the simulated camera last saw it."""
        return self._object_seen("place", _PLACE)

    def orientation(self, now: float) -> tuple[np.ndarray, float] | None:
        """OrientationSource: as the object's IMU last said."""
        return self._object_seen("orientation", _TURNED)

    def _object_seen(self, what: str, part: slice) -> tuple[np.ndarray, float] | None:
        if self.hand is not None:
            seen = getattr(self.hand, what)()
            return None if seen is None else (seen[0], seen[1] + self._zero)
        v = self._views
        row = v["state"][v["newest"].value % 2, part].copy()
        return None if not np.isfinite(row[-1]) else (row[:-1], float(row[-1]))

    def send(self, command: HandCommand) -> None:
        if self.hand is not None:
            self._commands.append(command)
        else:
            self._post(command.mode, command.position, command.tor_max, command.kp)

    def relax(self) -> None:
        if self.hand is not None:
            self._commands = [HandCommand(self.hand.target, np.zeros(self.joints), mode=PASSIVE)]
            self.hand.relax()
        elif self._process is not None:
            self._post(PASSIVE, np.zeros(self.joints), np.zeros(self.joints), 0)

    def present(self) -> None:
        """The object is held out."""
        if self.hand is not None:
            self.hand.present()
        else:
            self._object = _PRESENT

    def started(self) -> None:
        """The policy begins: the object is let go."""
        if self.hand is not None:
            self.hand.release()
        else:
            self._object = _RELEASE

    def close(self) -> None:
        self.relax()
        if self._process is not None:
            self._views["stop"].value = 1
            self._process.join(5.0)
            if self._process.is_alive():
                self._process.terminate()
            self._process = None

    def _post(self, mode: int, position: np.ndarray, tor_max: np.ndarray, kp: float) -> None:
        v = self._views
        self._number += 1
        row, end = v["command"][self._number % 2], 2 + self.joints
        row[:2], row[2:end], row[end:-2], row[-2:] = (self._number, mode), position, tor_max, (kp, self._object)
        v["sent"].value = self._number

    def _step(self, hand: SimulatedHand) -> HandState | None:
        """In place: the bus cycles that have passed since the last call."""
        passed = int((self.clock.now() - self.latency - self._zero) / BUS_PERIOD + 1e-6)
        while self._cycle <= passed:
            for c in self._commands:
                hand.command(c)
            self._commands = []
            t = self._cycle * BUS_PERIOD
            hand.advance(t)
            self._state = hand.state(self._zero + t + self.latency)
            self._cycle += 1
        return self._state


def _views(raw: tuple) -> dict[str, Any]:
    states, touches, newest, commands, sent, stop = raw
    return {
        "state": np.frombuffer(states, np.float64).reshape(2, -1),
        "touch": np.frombuffer(touches, np.int16).reshape(2, -1), "newest": newest,
        "command": np.frombuffer(commands, np.float64).reshape(2, -1), "sent": sent, "stop": stop,
    }  # fmt: skip


def _live(args: tuple, raw: tuple, latency: float) -> None:
    """The hand's own process: one bus cycle after the other until it is told to stop or its parent is gone."""
    import signal

    import torch

    from dexsim.sim.quiet import quiet_warp

    for number in set(system.stop_signals()) - {signal.SIGTERM}:  # the loop's to handle: it relaxes first
        signal.signal(number, signal.SIG_IGN)
    lives = multiprocessing.parent_process().is_alive  # type: ignore[union-attr]  # this is a child
    torch.set_num_threads(1)
    quiet_warp("cpu")
    v = _views(raw)
    try:
        hand = SimulatedHand(*args)
    except UserError as error:
        print(f"error: {error}", flush=True)
        os._exit(2)
    for k in range(1, 4):
        hand.advance(k * BUS_PERIOD)  # compiles what is left
    zero, taken, count = time.monotonic() - hand.time, 0, -1
    due = time.monotonic()
    while not v["stop"].value and lives():
        number = v["sent"].value
        if number > taken:
            row = v["command"][number % 2].copy()
            taken = number
            end = 2 + hand.env.num_actions
            hand.command(HandCommand(row[2:end], row[end:-2], kp=int(row[-2]), mode=int(row[1])))
            if row[-1] == _PRESENT:
                hand.present()
            elif row[-1] == _RELEASE:
                hand.release()
        now = time.monotonic()
        if now - zero - hand.time > 0.25:  # too slow a machine: simulated time stands still rather than jump
            zero = now - hand.time - BUS_PERIOD
        hand.advance(now - zero)
        wait = due + latency - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        state = hand.state(time.monotonic())
        count += 1
        slot = v["state"][count % 2]
        slot[0], slot[1] = state.time, state.sequence
        slot[2:-9] = np.concatenate([state.position, state.current, state.temperature, state.error, state.velocity])
        for part, seen in ((_PLACE, hand.place()), (_TURNED, hand.orientation())):
            slot[part] = np.append(seen[0], seen[1] + zero) if seen is not None else np.nan
        v["touch"][count % 2, : state.tactile.size] = state.tactile.reshape(-1)
        v["newest"].value = count
        due = max(due + BUS_PERIOD, time.monotonic() - BUS_PERIOD)
        wait = due - time.monotonic()
        if wait > 0:
            time.sleep(wait)
