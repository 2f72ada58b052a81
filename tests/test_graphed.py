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
from dexsim.learning.rollout import Rollout  # isort: skip

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


def learn(alg: PPO, updater, updates: int, seed: int = 1, size: float = 1.0, far: float = 0.0) -> list[dict]:
    """`updates` rollouts of noise whose rewards depend on the actions, each followed by an update. size: of rewards;
    far: added to a number that is seen."""
    torch.manual_seed(seed)
    losses = []
    for _ in range(updates):
        with torch.no_grad():
            for _ in range(STEPS):
                obs = observations()
                obs["a"][0, 0] += far
                actions = alg.act(obs)
                rewards = -size * (actions - obs["a"][:, :3]).square().sum(1)
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
        assert b == pytest.approx(a, rel=1e-5, abs=1e-6)
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


def test_a_rollout_stores_what_rsl_rl_stores():
    """Actions drawn from the actor's Gaussian; values, log-probabilities, returns, advantages to rounding."""
    theirs, ours = ppo(), ppo()
    rollout, drawn = Rollout(ours), []
    theirs.actor.distribution.sample = lambda: drawn[-1].clone()
    with torch.no_grad():
        for _ in range(STEPS):
            obs, rewards = observations(), torch.randn(WORLDS)
            dones, time_outs = torch.rand(WORLDS) < 0.3, torch.rand(WORLDS) < 0.3
            drawn.append(rollout.act(obs))
            theirs.act(obs)
            rollout.store(rewards, dones, time_outs)
            theirs.process_env_step(obs, rewards, dones, {"time_outs": time_outs})
        last = observations()
        for one in (theirs, rollout):
            one.compute_returns(last)
    a, b = theirs.storage, ours.storage
    for name in ("actions", "dones", "values", "actions_log_prob", "returns", "advantages"):
        torch.testing.assert_close(getattr(b, name), getattr(a, name), rtol=1e-5, atol=1e-6)
    for mine, other in zip(b.distribution_params, a.distribution_params, strict=True):
        assert torch.equal(mine, other)
    z = (b.actions - b.distribution_params[0]) / b.distribution_params[1]
    assert abs(float(z.mean())) < 0.2 and 0.85 < float(z.std()) < 1.15


@pytest.mark.parametrize("size", [1.0, 1e5])
def test_half_precision_descends_as_single_does(size):
    """One step from the same rollout, whatever the rewards' size: weights move the same way, by as much."""
    steps = []
    for half in (False, True):
        alg = ppo(schedule="fixed", num_learning_epochs=1, num_mini_batches=1, use_clipped_value_loss=False,
                  use_mixed_precision=half)  # fmt: skip
        before = torch.cat([p.detach().flatten() for p in (*alg.actor.mlp.parameters(), *alg.critic.mlp.parameters())])
        learn(alg, GraphedUpdate(alg), 1, size=size)
        after = torch.cat([p.detach().flatten() for p in (*alg.actor.mlp.parameters(), *alg.critic.mlp.parameters())])
        gradient = torch.cat([p.grad.flatten() for p in (*alg.actor.mlp.parameters(), *alg.critic.mlp.parameters())])
        assert after.isfinite().all() and (after != before).any()
        steps.append(gradient)
    single, halved = steps
    assert not torch.equal(single, halved)
    assert float((single - halved).norm() / single.norm()) < 5e-3


def test_inputs_out_of_the_range_of_half_precision_are_learned_from_in_single():
    """An observation far from its mean, as a first one in unfamiliar units: weights of single precision, to the bit."""
    weights = []
    for half in (False, True):
        alg = ppo(use_mixed_precision=half)
        learn(alg, GraphedUpdate(alg), 1, far=1e6)
        weights.append(torch.cat([p.detach().flatten() for p in alg.critic.parameters()]))
    assert weights[0].isfinite().all() and torch.equal(*weights)


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
    (lambda a: setattr(a, "critic", torch.nn.Linear(1, 1)), "MLPModel"),
    (lambda a: setattr(a.actor, "distribution", None), "Gaussian"),
    (lambda a: setattr(a, "optimizer", torch.optim.SGD(a.actor.parameters(), lr=1.0)), "Adam"),
])  # fmt: skip
def test_what_cannot_be_recorded_is_said(change, word):
    alg = ppo()
    change(alg)
    assert word in unsupported(alg)
