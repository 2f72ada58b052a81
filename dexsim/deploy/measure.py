"""From a hand's reading to the signals that the policy's observation is built from."""

from __future__ import annotations

import numpy as np
import torch

from dexsim.calibration.file import Calibration
from dexsim.deploy.driver import HandState
from dexsim.deploy.kinematics import HandKinematics
from dexsim.deploy.observations import Signals, build, height_speed


class Measure:
    """Turns readings into observations; keeps what has memory: the first x, y of the object and its last height.

    period: the policy's [s], over which the height's difference is taken. force_max: F_max [N] of training.
    """

    def __init__(self, calibration: Calibration, force_max: float, period: float):
        self.calibration, self.force_max, self.period = calibration, float(force_max), float(period)
        self.hand = HandKinematics()
        self.reset()

    def reset(self) -> None:
        """A new episode: the next object position is the first."""
        self._xy: np.ndarray | None = None
        self._z: torch.Tensor | None = None

    def signals(self, state: HandState, place: np.ndarray, command: float) -> Signals:
        """One control step. place [3] m: the object as last seen, palm frame; command 0..1."""
        c = self.calibration
        tips, position, rotation = self.hand(state.position)
        force, centre = self.hand.touch(c.normal_force(state.tactile), position, rotation)
        if self._xy is None:
            self._xy = np.array(place[:2], float)
        z = _tensor([place[2]])[0]
        vz = torch.zeros_like(z) if self._z is None else height_speed(z, self._z, self.period)
        self._z = z
        return Signals(
            _tensor(state.position), _tensor(c.torque_norm(np.asarray(state.current, float) * 1e-3)), _tensor(self._xy), z, vz,
            _tensor(force), _tensor(centre), _tensor(tips), _tensor([command])[0])  # fmt: skip

    def observation(self, signals: Signals) -> np.ndarray:
        """[1, 66] float32, by the builder that training used."""
        return build(signals, self.force_max).numpy()


def _tensor(x: object) -> torch.Tensor:
    """float32 with a leading axis of one hand."""
    return torch.from_numpy(np.asarray(x, np.float32)[None])
