"""A recording in a hand's place: the loop sees what was recorded, its commands go nowhere."""

from __future__ import annotations

import numpy as np

from dexsim.calibration.file import Calibration
from dexsim.deploy.driver import Clock, HandCommand, HandState
from dexsim.errors import UserError
from dexsim.hand import Hand
from dexsim.recording.schema import Recording, Series

EPS = 1e-6  # s, of rounding in stored times


class ReplayHand:
    """A HandDriver that gives a recording's samples at the clock's time; also a HeightSource, from its object pose, and
    an OrientationSource, from the IMU in the object or else its pose.

    Simulated recordings are in N.m and N: they are given as the current and counts that `calibration` makes of them,
    not rounded. A simulated effort stamped t is of the physics step that begins at t, so the newest one *before* the
    clock is given.
    """

    name = "replay"

    def __init__(self, recording: Recording, calibration: Calibration, clock: Clock):
        hand: Hand = calibration.hand
        missing = [j for j in hand.joints if j not in recording.joints]
        if missing:
            raise UserError(f"recording {recording.path}: lacks {', '.join(missing)}: not of {hand.name}")
        self.recording, self.calibration, self.clock = recording, calibration, clock
        self.sent: list[tuple[float, np.ndarray]] = []
        self.relaxed = False
        self._order = [recording.joints.index(j) for j in hand.joints]
        effort = recording.signed_effort()
        self._current = None
        if effort is not None:
            value = np.nan_to_num(effort.value[:, self._order])
            amps = (
                calibration.current(value) if recording.effort_is == "torque_Nm" else value * calibration.current_sign
            )
            self._current = effort.t, amps * 1e3
        speed = recording.states.velocity
        self._speed = None if speed is None or not np.isfinite(speed.value).any() else speed.value[:, self._order]
        self._counts = None
        if recording.tactile is not None:
            newtons = recording.tactile_newtons()
            assert newtons is not None  # there is touch
            self._counts = newtons.t, newtons.value / (calibration.lsb * calibration.axis_sign)

    def open(self) -> dict[str, str]:
        return {"recording": str(self.recording.path)}

    def read(self) -> HandState | None:
        now, q = self.clock.now(), self.recording.states.position
        i = int(np.searchsorted(q.t, now + EPS, side="right")) - 1
        if i < 0:
            return None
        current, tactile = np.zeros(len(self._order)), np.zeros((*self.calibration.gain.shape, 3))
        if self._current is not None:
            live = self.recording.effort_is != "torque_Nm"
            k = int(np.searchsorted(self._current[0], now + (EPS if live else -EPS), side="right")) - 1
            current = self._current[1][k] if k >= 0 else current
        if self._counts is not None:
            k = int(np.searchsorted(self._counts[0], now + EPS, side="right")) - 1
            tactile = self._counts[1][k] if k >= 0 else tactile
        return HandState(float(q.t[i]), i, q.value[i, self._order], current, tactile=tactile,
                         velocity=None if self._speed is None else self._speed[i])  # fmt: skip

    def send(self, command: HandCommand) -> None:
        self.sent.append((self.clock.now(), command.position.copy()))

    def relax(self) -> None:
        self.relaxed = True

    def close(self) -> None:
        self.relax()

    def place(self, now: float) -> tuple[np.ndarray, float] | None:
        return _newest(self.recording.object_pose, now, slice(0, 3))

    def orientation(self, now: float) -> tuple[np.ndarray, float] | None:
        imu = self.recording.imu
        if imu is not None and np.isfinite(imu.value[:, :4]).any():
            return _newest(imu, now, slice(0, 4))
        return _newest(self.recording.object_pose, now, slice(3, 7))


def _newest(series: Series | None, now: float, part: slice) -> tuple[np.ndarray, float] | None:
    if series is None:
        return None
    i = int(np.searchsorted(series.t, now + EPS, side="right")) - 1
    return None if i < 0 else (series.value[i, part], float(series.t[i]))
