"""The rotation on a real hand: its observation from readings, and its part of a bundle."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import torch

from dexsim import rotation
from dexsim.calibration.file import Calibration
from dexsim.deploy.driver import HandState
from dexsim.deploy.manifests import Observe, grip
from dexsim.deploy.measure import COMMON, ORIENTATION, Given, Measure, floats32, tensor
from dexsim.errors import UserError
from dexsim.tasks import observations_rotate
from dexsim.typed import convert

OPTIONS = ("imu",)
ROWS = COMMON | {
    "joint_velocity": ("rad/s", "joint", "joints"), "last_action": ("1", "joint", "joints"),
    "relative_orientation": (
        "1", "object", "6d: the matrix's first two columns, one after the other; quaternion: w x y z"),
}  # fmt: skip


def check(m: Any) -> None:
    """Raise UserError for a manifest that lacks what this task needs."""
    if m.task_settings is None or m.grip is None:
        raise UserError(f"lacks task_settings or grip, which task={m.task} needs")
    convert(m.task_settings.observe, Observe, "task_settings.observe")
    if not np.linalg.norm(m.task_settings.goal.axis) > 1e-3:
        raise UserError(f"task_settings.goal.axis={m.task_settings.goal.axis}: must have a length")


def parts(env: Any) -> dict[str, Any]:
    """Return the same for the rotation. `task_settings` is what the observation and the goal depend on; `grip` the held
    pose that is most like all others: where the fingers wait for the cube, and the targets they close to."""
    task, g = env.task, env.grasps
    imu, targets = task["perception"] == "imu", task["observe"].get("last_action", "step") != "step"
    held = grip(g)
    settings = {k: copy.deepcopy(task[k]) for k in ("perception", "history", "observe", "goal")}
    settings["reward"] = {"delta_rot": task["reward"]["delta_rot"]}
    return {
        "scaling": {"last_action": "(target - middle) / half of action.low..high"} if targets else {},
        "initial_pose": held["hand"],
        "rates": {"imu_delay_s": [float(x) for x in env.sampler.range("imu.delay")[:2]]} if imu else {},
        "normalization": {},
        "task_settings": settings,
        "grip": held | {"pose_is": "x y z m, quaternion w x y z, palm frame",
                        "edges_trained_m": [round(float(x), 6) for x in (g.edge.min(), g.edge.max())]},
        "perception": {"object_orientation": "an IMU inside the object: to a frame whose z is the palm's normal, up;"
                                             " any heading" if imu else "none",
                       "goal": "the orientation first seen, turned by goal.angle about goal.axis; the next one once the"
                               " angle left is below"
                               " reward.delta_rot" if imu else "none: the policy turns without end",
                       "history": "none" if imu else f"{task['history']} control steps, newest first; the first fills"
                                                     " all",
                       "critic": "not deployed"},
    }  # fmt: skip


def signals_of(env: Any) -> dict[str, torch.Tensor]:
    """Return what the last observation of a simulated task was built from, noise and all."""
    widths = {name: width // env.history for name, width, _ in env.describe()["observations"]["actor"]}
    frames = env.obs["actor"].view(env.num_envs, env.history, -1).clone()
    row = dict(zip(widths, frames[:, 0].split([*widths.values()], 1), strict=True))
    blind = env.task["perception"] == "proprioception"
    return {
        "joint_position": row.get("joint_angle", env.q), "joint_velocity": row.get("joint_velocity", env.qd),
        "orientation": env.seen.clone(), "goal": env.goal_seen(), "sent": env.sent(),
        "touch_force": env.contact_force(), "touch_centre": env.contact_centre().flatten(1),
        "fingertip": row.get("fingertip_position", env.tips.flatten(1)),
        "past": torch.roll(frames, -1, 1) if blind else frames[:, :0], "fresh": env.episode_length_buf == 0,
        "follower": row.get("follower_angle", env.q[:, :0]),
    }  # fmt: skip


class Measured(Measure):
    """The rotation: keeps the goal, the history and the last angles.

    goal [1, 4]: the orientation to reach, in the IMU's frame (None without one); goals: how many were reached. In
    training a goal is reached by its angle and by the drift of the cube, which no IMU measures: here the angle decides.
    """

    def __init__(self, bundle: Any, calibration: Calibration):
        super().__init__(bundle, calibration)
        manifest = self.manifest
        self.task = manifest["task_settings"]
        self.needs = ORIENTATION if self.task["perception"] == "imu" else None
        self.axis, self.turn = observations_rotate.axis_and_turn(self.task["goal"], calibration.hand.mirror)
        low, high = (np.array(manifest["action"][k], np.float32) for k in ("low", "high"))
        self._middle, self._half = torch.from_numpy((low + high) / 2), torch.from_numpy((high - low) / 2)
        self.frame = manifest["policy"]["observation_size"] // int(self.task["history"])

    def reset(self) -> None:
        """Begin a new episode: the next orientation gives the first goal."""
        self.goal: torch.Tensor | None = None
        self.goals = 0
        self._past: np.ndarray | None = None
        self.hand.forget()

    def signals(
        self, state: HandState, seen: np.ndarray | None, command: list[float], target: np.ndarray, action: np.ndarray
    ) -> Given:
        """See `Measure.observe`; moves the goal on where it is reached. seen [4]: the object's orientation w x y z as
        its IMU says, in whose frame the goal is; past [H, D]: the last H frames, the newest first (without an IMU);
        fresh: an episode begins."""
        q = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
        if self.needs is not None:
            q = rotation.normalize(tensor(seen))
            self._aim(q)
        tips, force, centre = self.touched(state, self.task["observe"]["force_weighted"])
        none = np.zeros((0, 0)) if self.needs is not None else np.zeros((int(self.task["history"]), self.frame))
        sent = observations_rotate.sent(
            tensor(np.clip(np.nan_to_num(action), -1.0, 1.0)), tensor(target), self._middle, self._half,
            self.task["observe"].get("last_action", "step"))  # fmt: skip
        return floats32(
            joint_position=state.position, joint_velocity=self.hand.velocity(state), orientation=q[0], sent=sent[0],
            goal=(q if self.goal is None else self.goal)[0], touch_force=force, touch_centre=centre, fingertip=tips,
            past=none if self._past is None else self._past, fresh=self._past is None,
            follower=self.hand.followers(state))  # fmt: skip

    def built(self, given: Given) -> np.ndarray:
        relative = observations_rotate.relative(
            tensor(given["orientation"]), tensor(given["goal"]), self.task["observe"]["orientation"])  # fmt: skip
        frame = self.row(given, {"joint_velocity": given["joint_velocity"], "last_action": given["sent"],
                                 "relative_orientation": relative.numpy()})[None]  # fmt: skip
        if self.needs is not None:
            return frame
        past = np.tile(frame, (len(given["past"]), 1)) if given["fresh"] else given["past"]
        self._past = np.concatenate([frame, past[:-1]]).astype(np.float32)
        return self._past.reshape(1, -1)

    def _aim(self, q: torch.Tensor) -> None:
        """Set the first goal, or the next where this one is reached."""
        # rotation.error(q, goal): the angle whose half has the cosine |<q, goal>|; tangent of the half, accurate near 0
        reached = False
        if self.goal is not None:
            away = rotation.multiply(rotation.conjugate(q), self.goal)[0].tolist()
            reached = 2 * math.atan2(math.hypot(*away[1:]), abs(away[0])) < float(self.task["reward"]["delta_rot"])
        self.goals += reached
        if self.goal is None or reached:
            self.goal = observations_rotate.next_goal(q, self.axis, self.turn, self.task["goal"]["keep_tilt"])
