"""The grasp without touch in its observation, and with a thumb that has a command of its own."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from worlds import grasp_env

from dexsim.calibration.file import Calibration
from dexsim.deploy.driver import HandState
from dexsim.deploy.measure import for_bundle
from dexsim.errors import UserError

FEW = ("task.objects.train=[box]", "task.objects.held_out=[sphere]")


def steps(env, count: int) -> list[dict]:
    env.reset_all()
    still = torch.zeros(env.num_envs, env.num_actions)
    return [env.step(still)[0] for _ in range(count)]


def rows(env):
    return env.describe()["observations"]["actor"]


def test_without_touch_the_actor_lacks_its_rows_and_the_critic_does_not():
    measured, blind = grasp_env(*FEW), grasp_env(*FEW, "task.observe.touch=false")
    names = [row[0] for row in rows(blind)]
    assert [row[0] for row in rows(measured) if row[0] not in names] == ["contact_force", "contact_centre"]
    a, b = steps(measured, 2)[-1], steps(blind, 2)[-1]
    assert b["actor"].shape[1] == sum(row[1] for row in rows(blind)) == a["actor"].shape[1] - 4 * measured.pads
    assert b["critic"].shape == a["critic"].shape
    assert ["contact_force" in [r[0] for r in blind.describe()["observations"][k]] for k in ("actor", "critic")] == [
        False, True]  # fmt: skip
    measured.close(), blind.close()


def test_the_thumb_has_a_command_of_its_own():
    env = grasp_env(*FEW, "task.command.thumb=[0.2,0.4]", "task.command.hold_s=[0.1,0.2]", worlds=16)
    seen = torch.stack([obs["actor"][:, -2:] for obs in steps(env, 20)])  # [T, N, 2]
    others, own = seen[..., 0], seen[..., 1]
    assert 0.2 <= float(own.min()) and float(own.max()) <= 0.4 and float(others.max()) > 0.5
    changed = [x[1:] != x[:-1] for x in (others, own)]
    assert torch.equal(*changed) and 0 < int(changed[0].sum()) < changed[0].numel()  # drawn together
    assert abs(float(torch.corrcoef(torch.stack([others.flatten(), own.flatten()]))[0, 1])) < 0.5
    assert float(env.rewards()["thumb_near"].abs().max()) > 0
    env.close()


def test_late_in_a_training_forces_are_paid_more_sharply():
    env = grasp_env(*FEW, "task.late.from=0.6")
    steps(env, 30)
    before = {name: value.clone() for name, value in env.rewards().items()}
    env.trained(0.59)
    assert all(torch.equal(value, before[name]) for name, value in env.rewards().items())
    env.trained(0.6)
    now = env.rewards()
    assert float(before["worst"].abs().max()) > 0 and torch.allclose(now["worst"], 2 * before["worst"])
    assert env._shape().force_sigma == pytest.approx(0.06) and torch.equal(now["grip"], before["grip"])
    assert env.cfg["task"]["reward"]["force_sigma"] == 0.15  # a resume begins with what was said
    env.close()


@pytest.mark.parametrize(
    "setting",
    [
        "task.late.from=1.2", "task.late.from=null", "task.late.rewards.worst=.nan", "task.late.reward.force_sigma=0",
        "task.reward.force_sigma=null", "task.reward.force_sigma=0", "task.reward.torque_sigma=0",
        "task.reward.reach_length=0", "task.reward.contact_threshold=.nan", "task.reward.centre_y=.inf",
    ],
)  # fmt: skip
def test_a_reward_of_no_use_is_refused_with_its_range(setting):
    with pytest.raises(UserError, match=f"{setting.split('=')[0]}=.*must"):
        grasp_env(*FEW, setting)


def test_without_one_it_is_paid_for_a_band():
    env = grasp_env(*FEW)
    steps(env, 1)
    assert bool((env.thumb_command < 0).all()) and float(env.rewards()["thumb_near"].abs().max()) == 0
    env.close()


def test_a_share_of_commands_is_zero_and_asks_no_finger_to_touch():
    env = grasp_env(*FEW, "task.command.zero=0.5", "task.command.hold_s=[0.05,0.1]", worlds=64)
    seen = torch.stack([obs["actor"][:, -1] for obs in steps(env, 20)])
    assert 0.3 < float((seen == 0).float().mean()) < 0.7 and float(seen.max()) > 0.9
    command = env.command.clone()
    assert bool((command == 0).any()) and bool((command > 0.1).any())
    env.tip_force.zero_()
    off = env.rewards()
    weight = env.task["rewards"]["force"]
    assert torch.allclose(off["force"][command == 0], torch.tensor(4 * weight))
    assert not off["force"][command > 0.1].any()
    assert not off["grip"].any()  # nor does the thumb touch
    env.tip_force[:, env.opposing] = 5.0
    thumb = env.rewards()
    full = env.task["rewards"]["grip"]
    assert torch.allclose(thumb["grip"][command == 0], torch.tensor(full))
    assert not thumb["grip"][command > 0.1].any()
    env.tip_force[:, env.others] = 2.0  # more than is asked
    assert bool((env.rewards()["force"] < thumb["force"])[command == 0].all())
    env.close()


@pytest.mark.parametrize("value", ["0.5", "[0.5]", "[0.6,0.4]", "[0,1.5]", "[a,b]"])
def test_a_range_that_is_none_is_refused(value):
    with pytest.raises(UserError, match="task.command.thumb"):
        grasp_env(*FEW, f"task.command.thumb={value}")


def test_touch_is_or_is_not():
    with pytest.raises(UserError, match="task.observe.touch=half"):
        grasp_env(*FEW, "task.observe.touch=half")


@pytest.mark.parametrize(("pads", "commands"), [(5, 1), (0, 1), (5, 2)])
def test_a_robots_loop_builds_what_the_policy_was_trained_with(pads, commands):
    """For a hand at rest that presses one taxel with 10 counts."""
    table, at = [], 0
    touch = {"contact_force": pads, "contact_centre": 3 * pads} if pads else {}
    widths = {"joint_angle": 12, "joint_torque": 12, "object_position": 3, "object_velocity": 3, **touch,
              "fingertip_position": 15, "force_command": commands}  # fmt: skip
    for name, width in widths.items():
        table.append({"name": name, "start": at, "stop": at + width})
        at += width
    manifest = {"task": "grasp", "observation": table, "normalization": {"force_max_N": 10.0},
                "rates": {"policy_period_s": 0.02}}  # fmt: skip
    measure = for_bundle(SimpleNamespace(manifest=manifest), Calibration.default())
    tactile = np.zeros((5, 120, 3), np.int16)
    tactile[1, 7, 2] = 10
    state = HandState(0.0, 0, np.zeros(12), np.zeros(12), tactile=tactile)
    built, force = measure.observe(state, np.array([0.05, 0.0, 0.1]), [0.7], np.zeros(12), np.zeros(12))
    assert built.shape == (1, at) and built[0, -commands:] == pytest.approx(0.7)
    assert force.shape == (5,) and force[1] > 0 and force[[0, 2, 3, 4]].max() == 0  # known to the loop all the same
    assert measure.commanded(None) == [0.5]
    if commands == 2:
        assert measure.commanded([0.7, 0.2]) == [0.7, 0.2]
        both = measure.observe(state, np.array([0.05, 0.0, 0.1]), [0.7, 0.2], np.zeros(12), np.zeros(12))[0]
        assert both[0, -2:] == pytest.approx([0.7, 0.2])
    else:
        with pytest.raises(UserError, match="1 number"):
            measure.commanded([0.7, 0.2])
    row = next((r for r in table if r["name"] == "contact_force"), None)
    assert (row is None) == (pads == 0)
    if row is not None:
        assert built[0, row["start"] : row["stop"]] == pytest.approx(force / 10.0)
