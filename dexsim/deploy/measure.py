"""From a hand's reading to the signals that the policy's observation is built from.

Each task has a module `dexsim.deploy.of_<task>` that knows how; tasks of declared terms share `of_terms`. Such a module
has `OPTIONS` (what `dexsim deploy` can be told for it), `SIGNALS` (the builder of its observation: `Signals`, `build`,
`ROWS`), `check` (of a manifest), `build` (an observation of signals, by a manifest), `Measured` (what the loop calls)
and `parts` (of a manifest, by an environment). Which rows there are follows from what the task declares.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
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

    def observe(
        self, state: HandState, seen: np.ndarray | None, command: list[float], target: np.ndarray, action: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return one control step: (observation [1, D] float32, touch forces [P] N). seen: what `needs` names; command:
        of `commanded`; target [J] rad: the last ones sent; action [J]: the last."""
        raise NotImplementedError

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


def tensor(x: object) -> torch.Tensor:
    """Return float32 with a leading axis of one hand."""
    return torch.from_numpy(np.asarray(x, np.float32)[None])
