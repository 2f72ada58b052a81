"""The recorded PPO update: the same program, not recorded, against rsl-rl's own on the same rollouts."""

from __future__ import annotations

import copy
from types import SimpleNamespace

import pytest

from dexsim.learning.ppo import agent_errors

import torch  # isort: skip  (ppo sets what rsl-rl needs before it is imported)
from rsl_rl.algorithms import PPO  # isort: skip
from tensordict import TensorDict  # isort: skip

from dexsim.learning.graphed import GraphedUpdate, sample_without_waiting, unsupported  # isort: skip

WORLDS, STEPS = 12, 8
MODEL = {"class_name": "MLPModel", "hidden_dims": [16, 8], "activation": "elu", "obs_normalization": True}


def ppo(**settings) -> PPO:
    """Return a small PPO; the same settings give the same weights."""
    torch.manual_seed(0)
    obs = observations()
    env = SimpleNamespace(num_envs=WORLDS, num_actions=3)
    cfg = {
        "num_steps_per_env": STEPS, "multi_gpu": None, "obs_groups": {"actor": ["a"], "critic": ["a", "b"]},
        "actor": MODEL | {
            "distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 0.6, "std_type": "log"}
        },
        "critic": MODEL,
        "algorithm": {"class_name": "PPO", "num_learning_epochs": 3, "num_mini_batches": 4, **settings},
    }  # fmt: skip
    with agent_errors():
        return PPO.construct_algorithm(obs, env, copy.deepcopy(cfg), "cpu")


def observations() -> TensorDict:
    return TensorDict({"a": torch.randn(WORLDS, 5) * 3 + 1, "b": torch.randn(WORLDS, 4)}, batch_size=[WORLDS])


def learn(alg: PPO, updater, updates: int, seed: int = 1) -> list[dict]:
    """`updates` rollouts of noise whose rewards depend on the actions, each followed by an update."""
    torch.manual_seed(seed)
    losses = []
    for _ in range(updates):
        with torch.no_grad():
            for _ in range(STEPS):
                obs = observations()
                actions = alg.act(obs)
                rewards = -(actions - obs["a"][:, :3]).square().sum(1)
                alg.process_env_step(obs, rewards, torch.rand(WORLDS) < 0.1, {})
            alg.compute_returns(observations())
        state = torch.get_rng_state()  # the record draws no samples that nobody uses
        losses.append(updater.update())
        torch.set_rng_state(state)
    return losses


@pytest.mark.parametrize("settings", [
    {}, {"schedule": "fixed", "learning_rate": 3e-3}, {"desired_kl": 1e-4}, {"desired_kl": 10.0},
    {"use_clipped_value_loss": False, "normalize_advantage_per_mini_batch": True, "entropy_coef": 0.1,
     "max_grad_norm": 0.01},
])  # fmt: skip
def test_it_learns_what_rsl_rl_learns(settings):
    """Three updates: losses, learning rate, weights, normalization and the optimizer's memory, to rounding."""
    theirs, ours = ppo(**settings), ppo(**settings)
    assert unsupported(ours) is None
    before = copy.deepcopy(ours.save())
    expected, got = learn(theirs, theirs, 3), learn(ours, GraphedUpdate(ours), 3)
    for a, b in zip(expected, got, strict=True):
        assert b == pytest.approx(a, rel=1e-5)
    assert ours.learning_rate == pytest.approx(theirs.learning_rate, rel=1e-12)
    a, b = theirs.save(), ours.save()
    for part in ("actor_state_dict", "critic_state_dict"):
        for name, value in a[part].items():
            torch.testing.assert_close(b[part][name], value, rtol=1e-5, atol=1e-6)
        assert any((before[part][name] != b[part][name]).any() for name in b[part])
    assert b["optimizer_state_dict"]["param_groups"] == a["optimizer_state_dict"]["param_groups"]
    for k, state in a["optimizer_state_dict"]["state"].items():
        for name, value in state.items():
            torch.testing.assert_close(b["optimizer_state_dict"]["state"][k][name], value, rtol=1e-4, atol=1e-7)


def test_actions_are_drawn_as_ever():
    """Without the look at the standard deviation: the same numbers, and weights that load as before."""
    theirs, ours = ppo(), ppo()
    sample_without_waiting(ours.actor)
    for _ in range(3):
        obs, state = observations(), torch.get_rng_state()
        with torch.no_grad():
            a = theirs.act(obs)
            torch.set_rng_state(state)
            assert torch.equal(a, ours.act(obs)) and not ours.transition.actions.requires_grad
    assert ours.actor.state_dict().keys() == theirs.actor.state_dict().keys()
    assert learn(theirs, theirs, 2) == learn(ours, ours, 2)


def test_the_adaptive_rate_moves_both_ways():
    """Within rsl-rl's bounds: down where a mini-batch moves the policy too far, up where it hardly does."""
    rates = {}
    for kl in (1e-6, 10.0):
        alg = ppo(desired_kl=kl)
        learn(alg, GraphedUpdate(alg), 1)
        rates[kl] = alg.learning_rate
    assert 1e-5 <= rates[1e-6] < 1e-3 < rates[10.0] <= 1e-2


@pytest.mark.parametrize("change, word", [
    (lambda a: setattr(a, "is_multi_gpu", True), "several"), (lambda a: setattr(a, "rnd", object()), "RND"),
    (lambda a: setattr(a, "use_mixed_precision", True), "mixed"),
    (lambda a: setattr(a, "critic", torch.nn.Linear(1, 1)), "MLPModel"),
    (lambda a: setattr(a, "optimizer", torch.optim.SGD(a.actor.parameters(), lr=1.0)), "Adam"),
])  # fmt: skip
def test_what_cannot_be_recorded_is_said(change, word):
    alg = ppo()
    change(alg)
    assert word in unsupported(alg)
