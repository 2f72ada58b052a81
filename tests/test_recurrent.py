"""Recurrent policies: their state begins anew with each episode, in a play, in a bundle and in the loop."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from bundles import make_checkpoint

from dexsim import export
from dexsim.deploy import bundle
from dexsim.learning import checkpoint
from dexsim.learning.ppo import load_policy

LSTM = ("agent=ppo_lstm", "agent.actor.rnn_hidden_dim=16")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lstm")
    path = make_checkpoint(folder / "policy.pt", *LSTM, task="rotate")
    return path, export.export(str(path), folder / "bundle", steps=12)


def test_a_bundle_carries_the_state(made):
    assert export.check(made[1])
    b = bundle.load(made[1])
    assert b.recurrent and b.manifest["policy"]["state"] == {"h": [1, 16], "c": [1, 16]}
    row = np.ones((1, b.manifest["policy"]["observation_size"]), np.float32)
    one, two = b.act(row), b.act(row)
    b.begin()
    assert not np.allclose(one, two) and np.array_equal(b.act(row), one)


def test_state_begins_anew_with_each_episode(made):
    from dexsim.tasks import make_env

    data = checkpoint.load(made[0])
    env = make_env(data["config"], 2, "cpu", 0, "mujoco")
    policy = load_policy(data, env, "x")
    obs = env.get_observations()
    env.episode_length_buf = torch.tensor([0, 0])
    first = policy(obs).clone()
    env.episode_length_buf = torch.tensor([0, 1])  # the first world begins again, the second goes on
    second = policy(obs)
    assert torch.equal(first[0], second[0]) and not torch.allclose(first[1], second[1])
