"""The grasp on a real hand: its observation from readings, and its part of a bundle."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from dexsim.deploy.driver import HandState
from dexsim.deploy.manifests import floats
from dexsim.deploy.measure import PLACE, Measure, commanded, tensor
from dexsim.errors import UserError
from dexsim.tasks import observations

OPTIONS = ("vision", "place", "shape")
SIGNALS = observations


def check(m: Any, source: object, again: str) -> None:
    """Raise UserError for a manifest that lacks what this task needs."""
    if m.normalization.force_max_N is None:
        raise UserError(f"{source}: lacks normalization.force_max_N, which task={m.task} needs; {again}")


def build(s: observations.Signals, m: dict[str, Any]) -> torch.Tensor:
    """Return the observation [N, D] that a manifest states."""
    names = [row["name"] for row in m["observation"]]
    return observations.build(s, names, float(m["normalization"]["force_max_N"]))


def parts(env: Any) -> dict[str, Any]:
    """Return the parts of a manifest that differ between tasks."""
    return {
        "scaling": {
            "joint_torque": "torque [N.m] / normalization.tau_max",
            "contact_force": "force [N] / normalization.force_max_N",
            "force_command": "the commanded share of normalization.force_max_N",
        },
        "initial_pose": floats(env.pose0),
        "rates": {"height_delay_s": [float(x) for x in env.task["sensors"]["vision_delay"]]},
        "normalization": {"force_max_N": float(env.f_max)},
        "perception": {"object_height": "vision: a depth image and the object's mask; z of the mask's centroid from the"
                                        " palm's centre,"
                                        " along the palm's normal", "object_xy": "held at the first value",
                       "object_velocity": "finite difference of z over one policy period", "critic": "not deployed"},
    }  # fmt: skip


def signals_of(env: Any) -> observations.Signals:
    """Return what the last observation of a simulated task was built from, noise and all."""
    s = env.sensed
    followers = env.q[:, :0]
    if env.hand.sensed:  # with its noise, which is nowhere else
        widths = {name: width for name, width, _ in env.describe()["observations"]["actor"]}
        parts = env.obs["actor"].split([*widths.values()], 1)
        followers = dict(zip(widths, parts, strict=True))["follower_angle"].clone()
    return observations.Signals(
        s.joint_position, s.joint_torque, env.first_xy, env.z_seen, env.height_speed(), env.touch.force[:, : env.pads],
        env.touch.centre[:, : env.pads], s.tip, env.force_command(), followers)  # fmt: skip


class Measured(Measure):
    """The grasp: keeps the first x, y of the object and its last height."""

    needs = PLACE

    def reset(self) -> None:
        """Begin a new episode: the next object position is the first."""
        self._xy: np.ndarray | None = None
        self._z: torch.Tensor | None = None

    def commanded(self, given: Any) -> list[float]:
        """Return the commanded force, a share of F_max (0.5 for None). Raises UserError."""
        return commanded(given, [0.5], str(self.manifest["task"]), 0.0, 1.0)

    @torch.inference_mode()
    def observe(
        self, state: HandState, seen: np.ndarray | None, command: list[float], target: np.ndarray, action: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return one control step: (observation [1, D] float32, touch forces [P] N). seen [3] m: the object, palm
        frame, which is needed; command: one number, 0..1."""
        assert seen is not None
        s = self.signals(state, seen, command)
        return build(s, self.manifest).numpy(), s.touch_force[0].numpy()

    def signals(self, state: HandState, place: np.ndarray, command: list[float]) -> observations.Signals:
        """See `observe`; of touch, all that the hand feels."""
        tips, force, centre = self.touched(state)
        width = {row["name"]: row["stop"] - row["start"] for row in self.manifest["observation"]}
        said = [*command] * width.get("force_command", 1)  # the thumb's own is the others'
        if self._xy is None:
            self._xy = np.array(place[:2], float)
        z = tensor([place[2]])[0]
        vz = torch.zeros_like(z) if self._z is None else observations.height_speed(z, self._z, self.period)
        self._z = z
        return observations.Signals(
            tensor(state.position), tensor(self.calibration.torque_norm(np.asarray(state.current, float) * 1e-3)),
            tensor(self._xy), z, vz,
            tensor(force), tensor(centre), tensor(tips),
            tensor(said), self.hand.followers(state))  # fmt: skip
