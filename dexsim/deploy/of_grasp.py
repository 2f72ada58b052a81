"""The grasp on a real hand: its observation from readings, and its part of a bundle."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from dexsim.deploy.driver import HandState
from dexsim.deploy.manifests import floats
from dexsim.deploy.measure import COMMON, PLACE, Given, Measure, commanded, floats32
from dexsim.errors import UserError
from dexsim.tasks import observations

OPTIONS = ("vision", "place", "shape")
ROWS = COMMON | {
    "joint_torque": ("tau/tau_max", "joint", "joints"), "object_position": ("m", "palm", "x y z"),
    "object_velocity": ("m/s", "palm", "x y z"), "contact_force": ("F/F_max", "taxel, along the normal", "fingers"),
    "force_command": ("F/F_max", "none", "one"),
}  # fmt: skip


def check(m: Any) -> None:
    """Raise UserError for a manifest that lacks what this task needs."""
    if m.normalization.force_max_N is None:
        raise UserError(f"lacks normalization.force_max_N, which task={m.task} needs")


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


def signals_of(env: Any) -> dict[str, torch.Tensor]:
    """Return what the last observation of a simulated task was built from, noise and all."""
    s = env.sensed
    followers = env.q[:, :0]
    if env.hand.sensed:  # with its noise, which is nowhere else
        widths = {name: width for name, width, _ in env.describe()["observations"]["actor"]}
        parts = env.obs["actor"].split([*widths.values()], 1)
        followers = dict(zip(widths, parts, strict=True))["follower_angle"].clone()
    return {
        "joint_position": s.joint_position, "joint_torque": s.joint_torque, "object_xy": env.first_xy,
        "object_z": env.z_seen, "object_vz": env.height_speed(), "touch_force": env.touch.force[:, : env.pads],
        "touch_centre": env.touch.centre[:, : env.pads], "fingertip": s.tip, "command": env.force_command(),
        "follower": followers,
    }  # fmt: skip


class Measured(Measure):
    """The grasp: keeps the first x, y of the object and its last height."""

    needs = PLACE

    def reset(self) -> None:
        """Begin a new episode: the next object position is the first."""
        self._xy: np.ndarray | None = None
        self._z = np.float32(0.0)

    def commanded(self, given: Any) -> list[float]:
        """Return the commanded force, a share of F_max (0.5 for None); where the policy takes the thumb's own after it,
        both, or one number for both. Raises UserError."""
        usual = [0.5] * (np.size(given) if np.size(given) == self.commands() else 1)
        return commanded(given, usual, str(self.manifest["task"]), 0.0, 1.0)

    def commands(self) -> int:
        """Count the commands that the policy takes."""
        rows = (x for x in self.manifest["observation"] if x["name"] == "force_command")
        return sum(x["stop"] - x["start"] for x in rows) or 1

    def signals(
        self, state: HandState, seen: np.ndarray | None, command: list[float], target: np.ndarray, action: np.ndarray
    ) -> Given:
        """See `Measure.observe`; seen [3] m: the object, palm frame, which is needed; command: 0..1. Of touch, all that
        the hand feels; torque over tau_max, positive along positive joint position."""
        assert seen is not None
        tips, force, centre = self.touched(state)
        z = np.float32(seen[2])
        if self._xy is None:
            self._xy, self._z = np.array(seen[:2], float), z
        vz, self._z = observations.height_speed(z, self._z, self.period), z
        return floats32(
            joint_position=state.position, object_xy=self._xy, object_z=z, object_vz=vz, touch_force=force,
            joint_torque=self.calibration.torque_norm(np.asarray(state.current, float) * 1e-3), touch_centre=centre,
            fingertip=tips, follower=self.hand.followers(state),
            command=command if len(command) > 1 else command * self.commands())  # fmt: skip

    def built(self, given: Given) -> np.ndarray:
        xy, z, vz = (np.atleast_1d(given[k]) for k in ("object_xy", "object_z", "object_vz"))
        return self.row(given, {
            "joint_torque": given["joint_torque"], "object_position": np.concatenate([xy, z]),
            "object_velocity": np.concatenate([np.zeros_like(xy), vz]), "force_command": given["command"],
            "contact_force": given["touch_force"] / np.float32(self.manifest["normalization"]["force_max_N"]),
        })[None]  # fmt: skip
