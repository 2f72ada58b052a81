"""From a hand's reading to the signals that the policy's observation is built from."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from dexsim import rotation
from dexsim.calibration.file import Calibration
from dexsim.deploy.driver import HandState
from dexsim.deploy.kinematics import HandKinematics
from dexsim.tasks import observations, observations_rotate

PLACE, ORIENTATION = "place", "orientation"
"""What a policy needs to know of the object, beside what the hand reads."""


def for_bundle(manifest: dict[str, Any], calibration: Calibration) -> Measure | TurnMeasure:
    """The measure of a bundle's task."""
    period = float(manifest["rates"]["policy_period_s"])
    if manifest["task"] == "rotate":
        return TurnMeasure(calibration, manifest, period)
    width = {row["name"]: row["stop"] - row["start"] for row in manifest["observation"]}
    made = Measure(calibration, manifest["normalization"]["force_max_N"], period)
    made.touch, made.commands = "contact_force" in width, width.get("force_command", 1)
    return made


class Measure:
    """The grasp: turns readings into observations; keeps what has memory: the first x, y of the object and its last
    height.

    period: the policy's [s], over which the height's difference is taken. force_max: F_max [N] of training. touch:
    whether the policy has rows of touch (task.observe.touch). commands: 2 for a policy whose thumb has one of its own
    (task.command.thumb), which is given the others'.
    """

    needs: str | None = PLACE

    def __init__(self, calibration: Calibration, force_max: float, period: float):
        self.calibration, self.force_max, self.period = calibration, float(force_max), float(period)
        self.touch, self.commands = True, 1
        self.hand = HandKinematics(calibration.hand)
        self.reset()

    def reset(self) -> None:
        """A new episode: the next object position is the first."""
        self._xy: np.ndarray | None = None
        self._z: torch.Tensor | None = None

    @torch.inference_mode()
    def observe(
        self, state: HandState, seen: np.ndarray | None, command: float, target: np.ndarray, action: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """One control step: (observation [1, D] float32, touch forces [P] N). seen [3] m: the object, palm frame, which
        is needed; command 0..1."""
        assert seen is not None
        s = self.signals(state, seen, command)
        force = s.touch_force[0].numpy()
        if not self.touch:  # it is shown and recorded all the same
            s = s._replace(touch_force=s.touch_force[:, :0], touch_centre=s.touch_centre[:, :0])
        return self.observation(s), force

    def signals(self, state: HandState, place: np.ndarray, command: float) -> observations.Signals:
        """See `observe`; of touch, all that the hand feels."""
        c = self.calibration
        tips, position, rotation_ = self.hand(state.position)
        force, centre = self.hand.touch(c.normal_force(state.tactile), position, rotation_)
        if self._xy is None:
            self._xy = np.array(place[:2], float)
        z = _tensor([place[2]])[0]
        vz = torch.zeros_like(z) if self._z is None else observations.height_speed(z, self._z, self.period)
        self._z = z
        return observations.Signals(
            _tensor(state.position), _tensor(c.torque_norm(np.asarray(state.current, float) * 1e-3)),
            _tensor(self._xy), z, vz,
            _tensor(force), _tensor(centre), _tensor(tips),
            _tensor([command] * self.commands))  # fmt: skip

    def observation(self, signals: observations.Signals) -> np.ndarray:
        """[1, D] float32, by the builder that training used."""
        return observations.build(signals, self.force_max).numpy()


class TurnMeasure:
    """The rotation: turns readings into observations; keeps the goal, the history and the last angles.

    goal [1, 4]: the orientation to reach, in the IMU's frame (None without one); goals: how many were reached. In
    training a goal is reached by its angle and by the drift of the cube, which no IMU measures: here the angle decides.
    """

    def __init__(self, calibration: Calibration, manifest: dict[str, Any], period: float):
        self.calibration, self.period, self.task = calibration, float(period), manifest["task_settings"]
        self.needs = ORIENTATION if self.task["perception"] == "imu" else None
        self.hand = HandKinematics(calibration.hand)
        goal = self.task["goal"]
        axis = torch.tensor([float(x) for x in goal["axis"]])
        self.axis = axis / axis.norm()
        self.turn = rotation.about(self.axis, torch.tensor(math.radians(float(goal["angle"]))))
        low, high = (np.array(manifest["action"][k], np.float32) for k in ("low", "high"))
        self._middle, self._half = torch.from_numpy((low + high) / 2), torch.from_numpy((high - low) / 2)
        self.frame = sum(row[1] for row in observations_rotate.rows(self.task, *self._sizes(), frames=1))
        self.reset()

    def _sizes(self) -> tuple[int, int, int]:
        hand = self.calibration.hand
        return len(hand.joints), len(hand.fingers), len(self.calibration.gain)

    def reset(self) -> None:
        """A new episode: the next orientation gives the first goal."""
        self.goal: torch.Tensor | None = None
        self.goals = 0
        self._past: torch.Tensor | None = None
        self._last: tuple[float, np.ndarray] | None = None
        self._speed = np.zeros(len(self.calibration.hand.joints))

    @torch.inference_mode()
    def observe(
        self, state: HandState, seen: np.ndarray | None, command: float, target: np.ndarray, action: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """One control step: (observation [1, D] float32, touch forces [P] N). seen [4]: the object's orientation w x y
        z as its IMU says; target [J] rad: the last ones sent; action [J]: the last. The command is not used."""
        s = self.signals(state, seen, target, action)
        out = observations_rotate.build(s, self.task)
        if self.task["perception"] == "proprioception":
            self._past = out.view(1, -1, self.frame)
        return out.numpy(), s.touch_force[0].numpy()

    def signals(
        self, state: HandState, seen: np.ndarray | None, target: np.ndarray, action: np.ndarray
    ) -> observations_rotate.Signals:
        """See `observe`; moves the goal on where it is reached."""
        imu = self.task["perception"] == "imu"
        q = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
        if imu:
            q = rotation.normalize(_tensor(seen))
            self._aim(q)
        normal = self.calibration.normal_force(state.tactile)
        tips, position, turned = self.hand(state.position)
        force, centre = self.hand.touch(normal, position, turned, weighted=self.task["observe"]["force_weighted"])
        fresh = not imu and self._past is None
        past = (
            torch.zeros(1, 0, 0)
            if imu
            else torch.zeros(1, int(self.task["history"]), self.frame)
            if self._past is None
            else self._past
        )
        sent = observations_rotate.sent(
            _tensor(np.clip(np.nan_to_num(action), -1.0, 1.0)), _tensor(target), self._middle, self._half,
            self.task["observe"].get("last_action", "step"))  # fmt: skip
        return observations_rotate.Signals(
            _tensor(state.position), _tensor(self._velocity(state)), q, q if self.goal is None else self.goal, sent,
            _tensor(force), _tensor(centre), _tensor(tips), past, torch.tensor([fresh]))  # fmt: skip

    def _aim(self, q: torch.Tensor) -> None:
        """The first goal, or the next where this one is reached."""
        # rotation.error(q, goal): the angle whose half has the cosine |<q, goal>|; tangent of the half, accurate near 0
        reached = False
        if self.goal is not None:
            away = rotation.multiply(rotation.conjugate(q), self.goal)[0].tolist()
            reached = 2 * math.atan2(math.hypot(*away[1:]), abs(away[0])) < float(self.task["reward"]["delta_rot"])
        self.goals += reached
        if self.goal is None or reached:
            self.goal = observations_rotate.next_goal(q, self.axis, self.turn, self.task["goal"]["keep_tilt"])

    def _velocity(self, state: HandState) -> np.ndarray:
        """[J] rad/s: the firmware's, or the difference of the last two readings that were acted on."""
        if state.velocity is not None and np.isfinite(state.velocity).all():
            return np.asarray(state.velocity, float)
        q = np.asarray(state.position, float)
        if self._last is not None and state.time > self._last[0]:
            self._speed = (q - self._last[1]) / (state.time - self._last[0])
        self._last = state.time, q
        return self._speed


def _tensor(x: object) -> torch.Tensor:
    """float32 with a leading axis of one hand."""
    return torch.from_numpy(np.asarray(x, np.float32)[None])
