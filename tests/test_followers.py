"""Joints without a drive that have an encoder: observed, recorded, read back, deployed."""

from __future__ import annotations

import shutil
import time

import numpy as np
import pytest
import torch
from worlds import grasp_env

from dexsim.deploy.driver import HandState
from dexsim.deploy.kinematics import HandKinematics
from dexsim.deploy.process import BusDriver
from dexsim.errors import UserError
from dexsim.hand import load_hand
from dexsim.import_hand import poses
from dexsim.import_hand.importing import import_hand
from dexsim.recording import read, write
from dexsim.recording.mechanism import drive, driven, of_hand, recorded, replay
from dexsim.recording.schema import COMMANDS, Series
from tests.test_import_faithful import jaws, settings

FOLLOW = "".join(f'<joint joint1="second{k}" joint2="first{k}" polycoef="0 0.8 0 0 0"/>' for k in range(3))
READ = "".join(f'<jointpos joint="second{k}"/><jointpos joint="first{k}"/>' for k in range(3))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    where = tmp_path_factory.mktemp("followers")
    text = jaws(after=f"<equality>{FOLLOW}</equality><sensor>{READ}</sensor>")
    (where / "jaws.xml").write_text(text)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(poses, "STARTS", 1)
        import_hand(where / "jaws.xml", where / "hand", settings(), picture=False)
    return where / "hand"


def test_sensors_of_the_file_say_which_joints_are_measured(folder):
    hand = load_hand(folder)
    assert hand.joints == ("first0", "first1", "first2") and hand.sensed == ("second0", "second1", "second2")
    assert load_hand("xhand").sensed == ()


def test_a_joint_with_a_drive_is_no_follower(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "hand")
    file = tmp_path / "hand" / "hand.yaml"
    text = file.read_text()
    assert "sensed: [second0" in text
    file.write_text(text.replace("sensed: [second0", "sensed: [first0"))
    with pytest.raises(UserError, match="sensed: 'first0' is no joint without a drive; there are second0"):
        load_hand(tmp_path / "hand")


@pytest.mark.parametrize("group", ["actor", "critic"])
def test_a_policy_observes_them(folder, group):
    env = grasp_env(f"hand={folder}", "task.sensors.joint_noise=0", worlds=2, engine="mujoco")
    env.step(torch.full((2, 3), 0.3))
    widths = {name: width for name, width, _ in env.describe()["observations"][group]}
    seen = dict(zip(widths, env.obs[group].split([*widths.values()], 1), strict=True))
    assert widths["follower_angle"] == 3
    np.testing.assert_allclose(seen["follower_angle"], env.followers(), atol=1e-6)
    np.testing.assert_allclose(env.followers(), 0.8 * env.q, atol=5e-3)


def test_recordings_have_them_and_a_replay_lets_them_follow(folder, tmp_path):
    m = of_hand(load_hand(folder), gravity=(0, 0, 0))
    t = np.arange(0, 1.0, 0.01)
    sent = Series(t, 0.3 * np.sin(4 * t)[:, None] * np.ones(3), COMMANDS)
    run = drive(m, sent, m.joints, 1.0)
    made = recorded(run, m, sent, m.joints)
    assert made.joints == (*m.joints, "second0", "second1", "second2")
    np.testing.assert_allclose(made.states.position.value[:, 3:], 0.8 * made.states.position.value[:, :3], atol=0.02)
    write(tmp_path / "a.mcap", made)
    back = read(tmp_path / "a.mcap")
    assert back.joints == made.joints
    np.testing.assert_allclose(back.states.position.value, made.states.position.value, atol=1e-9)
    alone = driven(back, m)
    assert alone.joints == m.joints and np.isfinite(alone.commands.value).all()
    again = replay(back, m)
    at = np.searchsorted(again.t, t)
    np.testing.assert_allclose(again.position[at[20:]], run.position[np.searchsorted(run.t, t)[20:]], atol=0.02)


def test_the_deployed_loop_asks_the_driver_for_them(folder):
    hand = load_hand(folder)
    where = HandKinematics(hand)
    q = hand.pose("cupped")
    state = HandState(0.0, 1, q, np.zeros(3))
    with pytest.raises(UserError, match="reads no angle of second0, second1, second2"):
        where.followers(state)
    state.follower = np.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(where.followers(state), [0.1, 0.2, 0.3], atol=1e-6)
    tips, *_ = where(q)
    moved, *_ = where(q, 0.8 * q + 0.2)
    assert (np.linalg.norm(moved - tips, axis=1) > 2e-3).all()  # the fingertips are where the encoders say
    np.testing.assert_allclose(where(q, 0.8 * q)[0], tips, atol=1e-4)


class Told:
    """A hand behind its bus that is read, and nothing else."""

    def __init__(self, clock):
        self.clock, self.due = clock, 0.0

    def open(self):
        return {}

    def cycle(self, command):
        self.clock.sleep_until(self.clock.now() + 0.01)
        joints = np.array([0.1, 0.2, 0.3], np.float32)
        return HandState(self.clock.now(), 1, joints, np.zeros(3), follower=np.array([0.4, 0.5]))

    def problem(self):
        return ""

    def released(self):
        return True, "limp"

    def seen(self):
        return np.full(9, np.nan)

    def handle(self, what):
        pass

    close = open


def test_a_driver_in_its_own_process_passes_them_on():
    driver = BusDriver(Told, 3, (0, 0), sensed=2)
    driver.open()
    try:
        limit = time.monotonic() + 20.0
        while (state := driver.read()) is None and time.monotonic() < limit:
            time.sleep(0.01)
        assert state is not None and state.follower.tolist() == [0.4, 0.5] and state.velocity is None
    finally:
        driver.close()
