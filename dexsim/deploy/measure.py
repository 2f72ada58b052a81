"""From a hand's reading to the signals that the policy's observation is built from.

Each task has a module `dexsim.deploy.of_<task>` that knows how; tasks of declared terms share `of_terms`. Such a module
has `OPTIONS` (what `dexsim deploy` can be told for it), `check` (of a manifest), `Measured` (what the loop calls) and
`parts` (of a manifest, by an environment); one that builds its rows here, not by a network of the bundle's own, also
`ROWS` (unit, frame and order of each) and `signals_of` (what an environment's last observation was built from). Which
rows there are follows from what the task declares.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dexsim.calibration.file import Calibration
from dexsim.deploy.driver import HandState
from dexsim.deploy.kinematics import HandKinematics
from dexsim.errors import UserError

PLACE, ORIENTATION, POSE = "place", "orientation", "pose"
"""What a policy needs to know of the object, beside what the hand reads; also the method of an eye that tells it."""
COMMON = {
    "joint_angle": ("rad", "joint", "joints"), "follower_angle": ("rad", "joint", "joints without a drive"),
    "contact_force": ("N", "taxel, along the normal", "fingers"),
    "contact_centre": ("m", "palm", "fingers, x y z each"), "fingertip_position": ("m", "palm", "fingers, x y z each"),
}  # fmt: skip
"""Unit, frame and order of rows. Palm: origin at the palm's centre, x along the fingers, z out of the palm."""
Given = Mapping[str, np.ndarray]
"""What one control step's observation is built from, by name, float32."""


class Measure:
    """Turns readings into observations, and keeps what has memory. needs: PLACE, ORIENTATION, POSE or None."""

    needs: str | None = None

    def __init__(self, bundle: Any, calibration: Calibration):
        self.manifest, self.calibration = bundle.manifest, calibration
        self.period = float(self.manifest["rates"]["policy_period_s"])
        self.hand = HandKinematics(calibration.hand)
        self.reset()

    def reset(self) -> None:
        """Begin a new episode."""
        raise NotImplementedError

    def commanded(self, given: Any) -> list[float]:
        """Return the numbers that the policy is told: those given, or the usual ones for None. Raises UserError."""
        return commanded(given, [], str(self.manifest["task"]))

    def signals(
        self, state: HandState, seen: np.ndarray | None, command: list[float], target: np.ndarray, action: np.ndarray
    ) -> Given:
        """See `observe`; moves on what is remembered of readings."""
        raise NotImplementedError

    def built(self, given: Given) -> np.ndarray:
        """Return the observation [1, D] of signals; moves the past on."""
        raise NotImplementedError

    @torch.inference_mode()
    def observe(
        self, state: HandState, seen: np.ndarray | None, command: list[float], target: np.ndarray, action: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return one control step: (observation [1, D] float32, touch forces [P] N). seen: what `needs` names; command:
        of `commanded`; target [J] rad: the last ones sent; action [J]: the last."""
        given = self.signals(state, seen, command, target, action)
        return self.built(given), given["touch_force"]

    def row(self, given: Given, own: Given) -> np.ndarray:
        """Return the rows of the manifest's table [D], one after another: `own` ones by name, else those of COMMON."""
        rows = {
            "joint_angle": given["joint_position"], "follower_angle": given.get("follower", np.zeros(0)),
            "contact_force": given["touch_force"], "contact_centre": given["touch_centre"],
            "fingertip_position": given["fingertip"],
        } | dict(own)  # fmt: skip
        return np.concatenate([rows[r["name"]].ravel() for r in self.manifest["observation"]]).astype(np.float32)

    def touched(self, state: HandState, weighted: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return tips [F, 3] m, force [P] N and centre [P, 3] m of each pad, palm frame."""
        tips, position, turned = self.hand(state.position, state.follower)
        force, centre = self.hand.touch(self.calibration.normal_force(state.tactile), position, turned, weighted)
        return tips, force, centre


def of(task: str) -> Any:
    """Return the module of a task's observations, by the name of the task in a manifest."""
    own = f"of_{task}"
    named = {p.stem for p in Path(__file__).parent.glob("of_*.py")}
    return importlib.import_module(f"dexsim.deploy.{own if own in named else 'of_terms'}")


def for_bundle(bundle: Any, calibration: Calibration) -> Any:
    """Return the measure of a bundle's task."""
    return of(bundle.manifest["task"]).Measured(bundle, calibration)


def commanded(given: Any, usual: Sequence[float], task: str, low: float = -1e6, high: float = 1e6) -> list[float]:
    """Return the numbers given, one or several, or the usual ones for None. Raises UserError."""
    if given is None:
        return list(usual)
    numbers = [float(x) for x in np.ravel(given)]
    text = f"command={','.join(f'{x:g}' for x in numbers)}: the policy is of task={task}, which takes"
    if not usual:
        raise UserError(f"{text} no command")
    if len(numbers) != len(usual) or not all(low <= x <= high for x in numbers):
        raise UserError(f"{text} {len(usual)} number{'s' * (len(usual) > 1)} in [{low:g}, {high:g}]")
    return numbers


def floats32(**given: Any) -> dict[str, np.ndarray]:
    """Return numbers by name as float32."""
    return {k: np.asarray(x, np.float32) for k, x in given.items()}


def tensor(x: object) -> torch.Tensor:
    """Return float32 with a leading axis of one hand."""
    return torch.from_numpy(np.asarray(x, np.float32)[None])
