"""Recordings made for tests: a plain pendulum-like signal with every topic, without physics."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dexsim.recording import Recording, Series, States
from dexsim.recording.schema import (
    COMMANDS,
    DEFAULTS,
    EXTERNAL_FORCE,
    IMU,
    OBJECT_POSE,
    STATES,
    SUPPLY,
    TACTILE,
    TEMPERATURES,
)
from tools.assets import xhand

META = DEFAULTS | {"source": "real", "robot": "rig", "effort_is": "current_A", "tactile_lsb": "0.1", "joint_names": ""}


def signal(
    seconds: float = 8.0,
    joints: tuple[str, ...] = ("a", "b"),
    rate: float = 100.0,
    lag: float = 0.03,
    seed: int = 0,
    tactile: bool = False,
) -> Recording:
    """Return the joints that follow sines with a lag; an effort like a proportional servo's; nothing wrong with it."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, seconds, 1 / rate)
    f, size = rng.uniform(0.3, 0.9, len(joints)), rng.uniform(0.1, 0.16, len(joints))

    def at(time: np.ndarray) -> np.ndarray:
        return size * (np.sin(2 * np.pi * f * time[:, None]) + 0.3 * np.sin(2 * np.pi * 2.7 * f * time[:, None]))

    command, position = at(t), at(t - lag) + 1e-4 * rng.standard_normal((len(t), len(joints)))
    velocity = (at(t - lag + 1e-4) - at(t - lag - 1e-4)) / 2e-4
    effort = 4.0 * (command - position) + 1e-3 * rng.standard_normal(position.shape)
    out = Recording(
        Path("made.mcap"),
        META | {"joint_names": ",".join(joints)},
        joints,
        Series(t, command, COMMANDS, t.copy()),
        States(*(Series(t + 1e-3, x, STATES, t.copy()) for x in (position, velocity, effort))),
        start_ns=1_700_000_000_000_000_000,
    )
    out.temperature = Series(t[::10], np.full((len(t[::10]), len(joints)), 31.5), TEMPERATURES)
    out.supply_voltage = Series(t[::10], np.full(len(t[::10]), 24.0), SUPPLY)
    if tactile:
        touch = np.zeros((len(t), 5, 120, 3))
        touch[..., 2] = np.round(40 * np.abs(np.sin(2 * np.pi * 0.4 * t))[:, None, None] * rng.random((5, 120)))
        out.tactile = Series(t, touch, TACTILE)
        pose = np.tile([0.05, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0], (len(t), 1))
        out.object_pose = Series(t, pose, OBJECT_POSE, t.copy(), "palm")
        out.external_force = Series(t, np.ones((len(t), 6)), EXTERNAL_FORCE, t.copy(), "load_cell")
        imu = np.tile([1.0, 0, 0, 0, 0, 0, 0, 0, 0, 9.81], (len(t), 1))
        out.imu = Series(t, imu, IMU, t.copy(), "object")
    return out


HAND = xhand.JOINTS
