"""Agents beside plain PPO: a student of a teacher that sees more, symmetric samples, histories."""

from __future__ import annotations

import pytest
import torch
from bundles import QUIET_TURN, make_checkpoint
from tensordict import TensorDict
from worlds import task_cfg

import dexsim
from dexsim import export, rotation
from dexsim.cli.main import main
from dexsim.deploy import bundle as bundles
from dexsim.errors import UserError
from dexsim.learning import checkpoint
from dexsim.learning.ppo import load_policy
from dexsim.learning.symmetry import augmented
from dexsim.tasks import make_env

SMALL = ("preset=none", "device=cpu", "worlds=4", "iterations=2", "final_episodes=0", "agent.num_steps_per_env=4")
"""A training of seconds."""
NETS = tuple(f"agent.{net}.hidden_dims=[16]" for net in ("actor", "critic"))


@pytest.fixture(scope="module")
def teacher(tmp_path_factory):
    out = tmp_path_factory.mktemp("agents") / "teacher"
    assert main(["train", "task=rotate", *SMALL, *NETS, "agent.obs_groups.actor=[critic]", f"out={out}"]) == 0
    return out / "policy.pt"


@pytest.mark.slow
def test_a_student_with_touch_alone_learns_from_a_privileged_teacher(teacher, tmp_path, capsys):
    out = tmp_path / "student"
    learn = ["train", "task=rotate", "agent=distill", *SMALL, "task.perception=proprioception",
             "agent.student.hidden_dims=[16]"]  # fmt: skip
    with pytest.raises(UserError, match=r"agent.teacher.checkpoint=null: name the policy.pt of a teacher"):
        dexsim_main(learn)
    assert main([*learn, f"agent.teacher.checkpoint={teacher}", f"out={out}"]) == 0
    requested = dexsim.Distillation(teacher=teacher, hidden_dims=(16,)).settings()
    assert requested == ["agent=distill", f"agent.teacher.checkpoint='{teacher}'", "agent.student.hidden_dims=[16]"]
    data, taught = checkpoint.load(out / "last.pt"), checkpoint.load(teacher)
    assert data["config"]["agent"]["teacher"]["hidden_dims"] == [16]
    for name, weight in taught["actor"].items():  # which learns no more
        assert torch.equal(data["critic"][name], weight), name
    env = dexsim.make_env(checkpoint=out / "policy.pt", worlds=2, device="cpu")
    policy = dexsim.load_policy(out / "policy.pt", env)
    assert policy(env.get_observations()).shape == (2, 12)
    # the teacher file is not needed to go on, nor to export
    capsys.readouterr()
    assert main(["train", f"resume={out / 'last.pt'}", "iterations=3", f"out={tmp_path / 'on'}"]) == 0
    assert "after 2 iterations" in capsys.readouterr().out
    assert export.check(export.export(str(out / "policy.pt"), tmp_path / "bundle", steps=4))
    with pytest.raises(UserError, match="acts by the observations critic, which no hand measures"):
        export.export(str(teacher), tmp_path / "none", steps=4)


def dexsim_main(argv):
    from dexsim.cli import commands

    return commands.train(argv[1:])


@pytest.mark.parametrize("preset", ["cpu", "cuda"])
def test_a_preset_changes_what_an_agent_has(preset):
    from dexsim.cli import start
    from dexsim.paths import CONFIGS

    begun = start.for_train(["task=rotate", "agent=distill", "device=cpu", f"preset={preset}"], CONFIGS).cfg
    assert begun["worlds"] in (256, 8192) and "gamma" not in begun["agent"]["algorithm"]
    assert begun["agent"]["num_steps_per_env"] == (12 if preset == "cuda" else 24)


def test_a_cube_is_the_same_from_each_side():
    """Rows of a cube whose own frame is turned are those that the declared symmetry makes of the rows before."""
    env = make_env(task_cfg("task.sensors.joint_noise=0", "task.sensors.tip_noise=0", worlds=3, task="rotate"), 3,
                   "cpu", 0, "mujoco")  # fmt: skip
    q = torch.nn.functional.normalize(torch.randn(3, 4, generator=torch.Generator().manual_seed(1)), dim=1)
    env.object_pose[:, 3:] = q
    env.seen.copy_(q)
    before = {k: v.clone() for k, v in env.observe(advance=False).items()}
    every, _ = augmented(env, TensorDict(before, batch_size=[3]), None)
    assert every.batch_size[0] == 12
    com, goal = env.objects.com.clone(), env.goal.clone()
    for k in (1, 2, 3):
        turn = rotation.about(torch.tensor([0.0, 0.0, 1.0]), torch.tensor(k * torch.pi / 2))
        for own, value in ((env.object_pose[:, 3:], q), (env.seen, q), (env.goal, goal)):
            own.copy_(rotation.multiply(value, turn.expand_as(value)))
        env.objects.com.copy_(rotation.rotate(rotation.conjugate(turn).expand(3, 4), com))
        now = env.observe(advance=False)
        for group, value in now.items():
            assert torch.allclose(every[group][3 * k : 3 * k + 3], value, atol=2e-5), (k, group)
        assert not torch.allclose(now["actor"], before["actor"], atol=1e-2)


@pytest.mark.slow
def test_symmetric_samples_are_learned_from(tmp_path, capsys):
    learn = [*SMALL, "agent.actor.hidden_dims=[16]", "agent.critic.hidden_dims=[16]", "agent=ppo_symmetric"]
    assert main(["train", "task=rotate", *learn, f"out={tmp_path / 'a'}"]) == 0
    header, *rows = (tmp_path / "a" / "progress.csv").read_text().splitlines()
    at = header.split(",").index("Loss/symmetry")
    assert all(float(row.split(",")[at]) >= 0 for row in rows)
    assert main(["train", "task=grasp", *learn, f"out={tmp_path / 'b'}"]) == 2
    assert "task grasp declares no symmetry" in capsys.readouterr().err


@pytest.mark.slow
def test_a_left_hands_policy_is_the_right_ones_mirrored(tmp_path):
    """The mirrored world goes the mirrored way: rows are those of the right hand but for their signs, and the policy,
    its first layer's signs changed, acts the same."""
    still = (*QUIET_TURN, "task.critic=paper", "randomize.object.com=0", "randomize.initial.target=0", "hand_mirror=")
    path = make_checkpoint(tmp_path / "policy.pt", task="rotate")
    data = checkpoint.load(path)
    seen, acted = [], []
    for mirror in ("false", "true"):
        env = make_env(task_cfg(*still[:-1], still[-1] + mirror, worlds=6, task="rotate"), 6, "cpu", 4, "mujoco")
        policy, obs = load_policy(data, env, "x"), env.get_observations()
        signs = env.mirror_signs() if env.hand.mirror else torch.ones(65)
        rows, actions = [], []
        for _ in range(6):
            action = policy(obs)
            rows.append(obs["actor"] * signs)
            actions.append(action.detach())
            obs = env.step(0.3 * action.detach())[0]
        seen.append(torch.stack(rows)), acted.append(torch.stack(actions))
    assert torch.allclose(seen[0][0], seen[1][0], atol=2e-5) and torch.allclose(acted[0][0], acted[1][0], atol=2e-4)
    assert (seen[0] - seen[1]).abs().median() < 1e-4  # contacts of hulls are found from the other side
    bundle = export.export(str(path), tmp_path / "left", steps=4, mirror=True)
    assert export.check(bundle) and bundles.load(bundle).hand.handedness == "left"
