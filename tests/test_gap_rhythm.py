"""An encoder that is read more seldom than it is logged is told from one that turns slowly, and from stick and slip."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from dexsim.actuator.table import ServoTable
from dexsim.gap import demo
from dexsim.gap.read import Run, channels
from tests.test_gap import SERVO, model

STEP = 1.5e-3  # rad, of the encoder


def motion(seconds: float = 4.0, rate: float = 240.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 1 / rate) + rng.uniform(0, 1e-3, int(seconds * rate))
    return t, np.round((0.5 * np.sin(5.0 * t) + 0.2 * np.sin(13.0 * t)) / STEP) * STEP


def held(t: np.ndarray, q: np.ndarray, period: float, begin: float = 0.013) -> np.ndarray:
    """Return what is logged of an encoder that is read every `period` s."""
    beat = np.floor((t - begin) / period)
    first = np.searchsorted(beat, beat)
    return q[first]


@pytest.mark.parametrize("period", [0.03, 0.05, 0.08])
def test_the_rhythm_of_readings_is_found_and_one_of_each_is_kept(period):
    t, q = motion()
    reading = held(t, q, period)
    assert channels.rhythm(t, reading) == pytest.approx(period, rel=0.01)
    new = ~channels.between_readings(t, reading, period)
    assert new.sum() == pytest.approx(4.0 / period, abs=2)
    beat = np.floor((t - 0.013) / period)
    assert len(np.unique(beat[new])) == new.sum()
    # what stands still for a while is read as well
    still = np.where(t < 2.0, 0.3, reading)
    assert (~channels.between_readings(t, still, period))[t < 2.0].sum() == pytest.approx(2.0 / period, abs=2)


def test_what_is_no_rhythm():
    t, q = motion()
    assert channels.rhythm(t, q) == 0.0  # each sample is read
    ramp = np.round(0.1 * t / 0.006) * 0.006  # past a coarse encoder's steps, one at a time
    assert channels.rhythm(t, ramp) == 0.0
    rng = np.random.default_rng(1)
    slips = np.cumsum(rng.exponential(0.06, 200))
    size = np.cumsum(np.round(rng.uniform(1, 20, 200)) * STEP)
    slipping = size[np.clip(np.searchsorted(slips, t), 0, 199)]
    assert channels.rhythm(t, slipping) == 0.0
    assert np.isnan(channels.rhythm(t, np.full_like(t, 0.2)))  # it tells nothing


def test_a_joint_that_is_read_seldom_is_named_and_judged_by_its_readings():
    table = ServoTable.from_dict({"joints": {"*": SERVO}})
    runs = []
    for k in range(3):
        t, q = motion(seed=k)
        reading = held(t, q, 0.05)
        runs.append(Run(f"r{k}", ("joint",), t, q[:, None], t, reading[:, None], table, np.array([0, 0, -9.81])))
    found, out, _ = channels.inspect(runs, model(), {})
    assert [f.effect for f in found] == ["bad_channel"] and "every 50 ms" in found[0].regime and not out
    assert all(len(r.t) == pytest.approx(80, abs=2) for r in runs)


def test_a_drive_without_a_loop_is_told_its_torque_by_targets_far_off():
    """What its gain makes of them is within what it gives; through a usual gain they are of another unit."""
    t, q = motion()
    limited = mujoco.MjModel.from_xml_string(demo.MODEL)
    limited.jnt_limited[0], limited.jnt_range[0] = 1, (-1.0, 1.0)
    for kp, named in ((3e-4, []), (2.0, ["bad_channel"])):
        table = ServoTable.from_dict({"joints": {"*": SERVO | {"kp": kp}}})
        far = 800.0 * np.sign(np.sin(5.0 * t))
        run = Run("r", ("joint",), t, far[:, None], t, q[:, None], table, np.array([0, 0, -9.81]))
        assert [f.effect for f in channels.inspect([run], limited, {})[0]] == named
