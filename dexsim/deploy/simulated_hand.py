"""A simulated hand behind the SDK's fields: units, signs, rounding, rates and latency of the real one, physics of
training.

`SimulatedHand` is the hand on its bench, in simulated time. `SimulatedXHand` is the driver: with a real clock the hand
lives in a process of its own, as a real one does, and the two share memory; with a `VirtualClock` it is advanced in
place.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from dexsim.calibration.file import Calibration
from dexsim.deploy.driver import PASSIVE, POSITION, Clock, HandCommand, HandState
from dexsim.deploy.fake_xhand import FakeXHand, Faults
from dexsim.deploy.process import HANG, BusDriver
from dexsim.deploy.vendor import VendorXHand
from dexsim.errors import UserError
from dexsim.tactile.layout import touch_shape
from dexsim.tasks import registry
from dexsim.tasks.building import hand_of

POSITION_LSB = 2 * np.pi / 4096
"""rad a count of the hand's 12-bit encoders."""
KP_NOMINAL = 100.0
"""The firmware's kp that the servo table stands for: what most users send."""
BUS_PERIOD = 0.010
"""s of a bus cycle: a command goes out and a state comes back (RS485: 9.6 ms measured by users)."""
LATENCY = 0.002
"""s from a state's measurement until `read` gives it, on top of the bus period."""
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
        self, config: dict[str, Any], calibration: Calibration, seed: int = 0, camera: bool = False,
        shape: str | None = None, grip: dict[str, Any] | None = None,
    ):  # fmt: skip
        import copy

        import torch

        from dexsim.tasks import make_env

        cfg = copy.deepcopy(config)
        registry.name_class(registry.of_config(cfg))  # looked at by whoever began this, perhaps in another process
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
        self.calibration, self.noise = calibration, float(
            (config["task"].get("sensors") or {}).get("vision_z_noise", 0.0)
        )
        self.rng = np.random.default_rng(seed)
        env, self._torch = self.env, torch
        self.imu = None
        if grip is not None:
            env.reset_all()
            if "imu.delay" in env.sampler.ranges:
                self.imu = SimulatedImu(config, env, self.rng)
        self.time, self.sequence, self.held = 0.0, 0, True
        self._nominal = env.servo.params.clone()
        self._start = env.object_pose.clone().double(), torch.zeros(1, 6, dtype=torch.float64)
        self._away = torch.zeros(7, dtype=torch.float64)
        self._away[2] = AWAY if grip is not None else 0.0
        self.target = env.q[0].double().numpy().copy()
        self.camera = SimulatedCamera(self.env) if camera else None
        self._seen: tuple[np.ndarray, float] | None = None
        self._look_at = 0.0
        self.lie_flat()

    def lie_flat(self) -> None:
        """Place the hand open and free, as before anybody drives it; the object waits over it."""
        env, torch = self.env, self._torch
        q = torch.as_tensor(np.clip(np.full(env.num_actions, 0.05), *env.hand.limits.T))[None]
        env.engine.t.qpos[:, env.joint_q] = q.to(env.engine.t.qpos.dtype)
        env.engine.t.qvel.zero_()
        env.servo.reset(None, q)
        self.relax()
        self._hold()

    def _hold(self) -> None:
        t = self.env.engine.t
        if not self.env.scene.free:
            return
        t.qpos[:, self.env.object_q] = (self._start[0] + self._away).to(t.qpos.dtype)
        t.qvel[:, self.env.object_v] = 0.0

    def present(self) -> None:
        """Hold the object where the fingers will close on it."""
        self._away.zero_()

    def release(self) -> None:
        """Let the object go."""
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
        """Turn the motors off (mode 0); the gears still damp."""
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
        if self.camera is not None:
            place = self.camera.see(self.time)
        else:
            place = self.env.object_pose[0, :3].double().numpy().copy()
            place[2] += self.noise * self.rng.standard_normal()
        if place is not None:
            self._seen = place, self.time

    def place(self) -> tuple[np.ndarray, float] | None:
        """Return the object as last seen, [3] m, and when [s]."""
        return self._seen

    def orientation(self) -> tuple[np.ndarray, float] | None:
        """Return how the object is turned, [4] w x y z, as its IMU last said, and when [s]; in truth, without one."""
        if self.imu is None:
            return self.env.object_pose[0, 3:].double().numpy().copy(), self.time
        return self.imu.newest(self.time)

    def state(self, now: float) -> HandState:
        """Return the state as the SDK would give it, arriving at host time `now`."""
        env = self.env
        self.sequence += 1
        position = np.round(env.servo.position()[0].double().numpy() / POSITION_LSB) * POSITION_LSB
        current = np.clip(
            np.round(1e3 * self.calibration.current(env.torque[0].double().numpy())), -32768, 32767
        ).astype(np.int16)
        tactile = np.zeros((*self.taxels, 3), np.int16)
        sheared, normal = env.touch.raw3, env.touch.raw
        if tactile.size and sheared is not None:
            counts = sheared[0].double().numpy() / (self.calibration.lsb * self.calibration.axis_sign)
            tactile[:] = np.clip(np.round(counts), [-128, -128, 0], [127, 127, 255])
        elif tactile.size:
            assert normal is not None  # a hand that touches
            tactile[..., 2] = np.clip(np.round(normal[0].double().numpy() / self.calibration.lsb), 0, 255)
        speed = np.round(env.servo.velocity()[0].double().numpy() / SPEED_LSB) * SPEED_LSB
        return HandState(now, self.sequence, position.astype(np.float32), current, np.full(len(position), 30.0),
                         np.zeros(len(position), np.int64), tactile,
                         np.clip(speed, -32.768, 32.767), follower=self._followers())  # fmt: skip

    def _followers(self) -> np.ndarray | None:
        """Return angles of joints without a drive, as their encoders count them."""
        if not self.env.hand.sensed:
            return None
        return np.round(self.env.followers()[0].double().numpy() / POSITION_LSB) * POSITION_LSB


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
        """Take a reading at time t [s]."""
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
        """Return the newest reading that has arrived by time t."""
        at, q = next(
            ((at, q) for at, q in reversed(self._past) if at <= t - self.delay + 1e-9),
            self._past[0] if self._past else (0.0, None),
        )
        return None if q is None else (q, at)


class SimulatedCamera:
    """A depth camera beside the hand: MuJoCo's offscreen depth and segmentation of the object, 160 x 120 pixels.

    It looks along the palm's plane from the fingers' side, a little from above, so that the mask's centroid is at the
    height of the object's middle. Raises UserError where no OpenGL opens.
    """

    WIDTH, HEIGHT, FOVY = 160, 120, 45.0

    def __init__(self, env: Any):
        import mujoco

        from dexsim.view.frames import renderer

        self._mujoco, self._env = mujoco, env
        self._model = env.drawn_model(0)
        self._model.vis.global_.offwidth, self._model.vis.global_.offheight = self.WIDTH, self.HEIGHT
        self._model.vis.global_.fovy = self.FOVY
        self._data = mujoco.MjData(self._model)
        self._geoms = [self._model.geom(s).id for s in env.objects.scene.slots]
        self._renderer = renderer(self._model, self.HEIGHT, self.WIDTH)
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
        """Return depth and mask now (`dexsim.deploy.vision.Frame`)."""
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
        """Return the object's place [3] m by the paper's rule, None where it is hidden."""
        from dexsim.deploy.vision import centroid

        return centroid(self.frame(), self.pose)


# -- the driver
class SimulatedBody:
    """The hand's side of `SimulatedXHand`: a bus cycle every `BUS_PERIOD`, whose state is there `LATENCY` later."""

    def __init__(self, clock: Clock, make: Callable[[], SimulatedHand]):
        self.clock, self.hand = clock, make()
        self._last: HandCommand | None = None

    def open(self) -> dict[str, str]:
        if type(self.clock) is Clock:
            for k in range(1, 4):
                self.hand.advance(k * BUS_PERIOD)  # compiles what is left
        self._zero = self.clock.now() - self.hand.time
        self._cycle = round(self.hand.time / BUS_PERIOD)
        return {
            "driver": "simulated", "serial": "sim", "bus": f"{1 / BUS_PERIOD:g} Hz", "latency_s": f"{LATENCY:g}",
        }  # fmt: skip

    @property
    def due(self) -> float:
        """When the next state is there [s]."""
        return self._zero + self._cycle * BUS_PERIOD + LATENCY

    def cycle(self, command: HandCommand | None) -> HandState:
        """Return the command acts, the hand is simulated to the next cycle's time; its state, when it is there."""
        if command is not None and command is not self._last:
            self.hand.command(command)
            self._last = command
        late = self.clock.now() - self.due
        if late > 0.25 and type(self.clock) is Clock:  # too slow a machine: time stands still rather than jump
            self._zero += late
        self.hand.advance(self._cycle * BUS_PERIOD)
        if type(self.clock) is Clock:
            self.clock.sleep_until(self.due)
        state = self.hand.state(max(self.due, self.clock.now()) if type(self.clock) is Clock else self.due)
        self._cycle += 1
        return state

    def problem(self) -> str:
        return ""

    def released(self) -> tuple[bool, str] | None:
        return (True, "limp: simulated motors are off") if self._last and self._last.mode == PASSIVE else None

    def seen(self) -> np.ndarray:
        """Place, its time; orientation, its time."""
        out = np.full(9, np.nan)
        for part, look in ((slice(0, 4), self.hand.place()), (slice(4, 9), self.hand.orientation())):
            if look is not None:
                out[part] = np.append(look[0], look[1] + self._zero)
        return out

    def handle(self, what: int) -> None:
        {1: self.hand.present, 2: self.hand.release}.get(what, lambda: None)()

    def close(self) -> None:
        pass


class SimulatedXHand(BusDriver):
    """The driver of a simulated hand (see the module). clock: a `VirtualClock` keeps it in this process, in step; how:
    as `SimulatedHand` takes it."""

    name = "simulated hand"

    def __init__(
        self, config: dict[str, Any], calibration: Calibration, clock: Clock | None = None, hang: float = HANG,
        **how: Any,
    ):  # fmt: skip
        make, hand = partial(SimulatedBody, make=simulated(config, calibration, **how)), hand_of(config)
        super().__init__(make, len(hand.joints), touch_shape(hand), clock, hang, 180.0, len(hand.sensed))

    @property
    def hand(self) -> SimulatedHand:
        """The hand itself, where it lives in this process."""
        assert isinstance(self.body, SimulatedBody)
        return self.body.hand


def faked(
    config: dict[str, Any], calibration: Calibration, faults: str = "", hang: float = HANG, serial: str | None = None,
    clock: Clock | None = None, **how: Any,
) -> VendorXHand:  # fmt: skip
    """Return the xHand's own driver, on a fake of the vendor's package with the simulated hand behind it. faults: see
    `dexsim.deploy.fake_xhand.Faults`; how: as `SimulatedHand` takes it. Raises UserError."""
    side = hand_of(config).handedness
    text = faults if "side=" in faults else f"side={side[0].upper()}," + faults
    driver = VendorXHand("auto", clock, fake_package(config, calibration, text, **how), serial, side, hang)
    driver.start = 180.0  # kernels compile on a first start
    return driver


def fake_package(config: dict[str, Any], calibration: Calibration, faults: str, **how: Any) -> Any:
    """Return what gives the fake of the vendor's package, with the simulated hand behind it; see `faked`."""
    return partial(FakeXHand, make=simulated(config, calibration, **how), faults=Faults.parse(faults))


def simulated(config: dict[str, Any], calibration: Calibration, **how: Any) -> Callable[[], SimulatedHand]:
    """Return what makes the hand, here or in another process. Raises UserError where nobody that may has named the
    task."""
    registry.task_class(config)
    return partial(_physics, config, calibration, **how)


def _physics(config: dict[str, Any], calibration: Calibration, **how: Any) -> SimulatedHand:
    """Return the hand; in a process of its own it uses one thread."""
    import multiprocessing

    import torch

    from dexsim.sim.quiet import quiet_warp

    if multiprocessing.parent_process() is not None:
        torch.set_num_threads(1)
        quiet_warp("cpu")
    return SimulatedHand(config, calibration, **how)
