"""What is not finite: worlds that diverge cost their episode and no run, rewards and observations that are not numbers
reach no learner, and a policy of NaN is refused by name."""

from __future__ import annotations

import math

import dummy_task
import pytest
import torch
from bundles import make_checkpoint
from test_learning import config, runner
from worlds import grasp_env

from dexsim.errors import UserError
from dexsim.learning import checkpoint
from dexsim.learning.ppo import load_policy

torch.set_num_threads(1)
N = 8
NAN, INF = math.nan, math.inf


@pytest.fixture(scope="module")
def made():
    return grasp_env(worlds=N)


@pytest.fixture
def env(made):
    """On C MuJoCo, as it was before the last test."""
    rewards, observe = made.rewards, made.observe
    made.reset_all()
    made.check()
    yield made
    made.rewards, made.observe = rewards, observe
    made.reset_all()
    made._wrong, made._steps_since = None, 0


def poison(env, world: int, k: int) -> None:
    """Make a world's state no number, in one of the ways that it may come about."""
    t, value = env.engine.t, (NAN, INF, -INF)[k % 3]
    where = (t.qpos, t.qvel, env.outside_force)[k % 3]
    if where is env.outside_force:
        where[world, 0] = 1e8  # N
    elif k % 2:
        where[world] = value
    else:
        where[world, k % where.shape[1]] = value


def step_many(env, steps: int, tmp_path) -> int:
    env.dump_folder = tmp_path
    before = int(env.nan_count)
    for k in range(steps):
        poison(env, (3 * k) % N, k)
        obs, reward, done, extras = env.step(torch.rand(N, 12) * 2 - 1)
        for group, value in obs.items():
            assert bool(value.isfinite().all()), group
        env.outside_force.zero_()
        assert bool(reward.isfinite().all())
        assert bool(done[(3 * k) % N]) or env.engine.kind == "warp", k  # which makes a unit quaternion of NaN
        if k % 8 == 7:
            env.check()  # once an iteration
    return int(env.nan_count) - before


def test_worlds_that_diverge_end_no_run_on_c_mujoco(env, tmp_path):
    assert step_many(env, 40, tmp_path) >= 40
    assert env.engine.peaks()["contacts"] < 60 and 0 < len(list(tmp_path.iterdir())) <= 10


@pytest.mark.slow
def test_worlds_that_diverge_end_no_run_on_warp(tmp_path):
    assert step_many(grasp_env(worlds=N, engine="warp"), 40, tmp_path) >= 30


def test_one_diverged_world_leaves_the_others_as_they_are(made):
    """Bitwise the same worlds beside it, in the step that it is lost in."""
    made.reset_all()
    for _ in range(30):
        made.step(torch.full((N, 12), 0.2))
    t = made.engine.t
    state = [x.clone() for x in (t.qpos, t.qvel, t.time, made.engine._warmstart, made.servo.state)]
    results = []
    for bad in (False, True):
        for own, saved in zip((t.qpos, t.qvel, t.time, made.engine._warmstart, made.servo.state), state):
            own.copy_(saved)
        if bad:
            t.qpos[3, 5] = NAN
        made.engine.step(2, made.servo.before_each)
        results.append((t.qpos.clone(), t.pair_normal.clone()))
    others = torch.arange(N) != 3
    assert torch.equal(results[0][0][others], results[1][0][others]) and torch.equal(
        results[0][1][others], results[1][1][others]
    )
    assert not results[1][1][3].any() and bool(t.flags[3]) and not t.flags[others].any()


@pytest.mark.parametrize("value", [NAN, INF])
def test_a_reward_that_is_no_number_ends_the_worlds_episode_only(env, value):
    rewards = env.rewards

    def spoiled():
        out = rewards()
        out["grip"] = torch.where(torch.arange(N) == 2, torch.full((N,), value), out["grip"])
        return out

    env.rewards = spoiled
    _, reward, done, extras = env.step(torch.zeros(N, 12))
    assert (
        bool(reward.isfinite().all()) and float(reward[2]) == 0 and bool(done[2]) and not bool(extras["time_outs"][2])
    )
    assert done.sum() == 1
    env.check()


def test_an_observation_that_is_no_number_is_not_seen_and_ends_the_episode(env):
    observe, spoil = env.observe, [True]

    def spoiled(advance):
        out = observe(advance)
        if spoil[0]:
            out["actor"][4, 7], out["critic"][5, 0] = NAN, INF
        return out

    env.observe = spoiled
    obs, _, done, _ = env.step(torch.zeros(N, 12))
    assert bool(obs["actor"].isfinite().all()) and bool(obs["critic"].isfinite().all()) and not done.any()
    spoil[0] = False
    _, _, done, _ = env.step(torch.zeros(N, 12))
    assert done.nonzero().flatten().tolist() == [4, 5]
    _, _, done, _ = env.step(torch.zeros(N, 12))
    assert not done.any()


def test_a_setting_that_makes_all_rewards_no_numbers_is_named(env):
    rewards = env.rewards
    env.rewards = lambda: rewards() | {"force_near": torch.full((N,), NAN)}
    for _ in range(24):
        env.step(torch.zeros(N, 12))
    with pytest.raises(UserError, match="reward force_near 100 %") as error:
        env.check()
    assert "\n" not in str(error.value)


# -- learning
# -------------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("what", ["reward", "observation"])
def test_an_environment_that_hands_out_nan_is_one_line(what):
    made = runner()
    step = made.env.step

    def spoiled(actions):
        obs, reward, done, extras = step(actions)
        (reward if what == "reward" else obs["actor"])[0] = NAN
        return obs, reward, done, extras

    made.env.step = spoiled
    with pytest.raises(UserError, match=f"^iteration 1: The {what}.*NaN") as error:
        made.learn(1)
    assert "\n" not in str(error.value)


def test_a_diverging_run_says_which_weights_and_when():
    made = runner()
    made.learn(1)
    made.alg.optimizer.step = lambda: made.alg.critic.mlp[-1].bias.data.fill_(INF)
    made.alg.num_learning_epochs = made.alg.num_mini_batches = 1
    with pytest.raises(UserError, match=r"diverged at iteration 2 .*critic\.mlp\.4\.bias: weights not finite"):
        made.learn(2)
    made = runner()
    update = made.alg.update
    made.alg.update = lambda: (update(), made.alg.actor.obs_normalizer._mean.fill_(NAN))[0]
    with pytest.raises(UserError, match=r"actor\.obs_normalizer\._mean: weights not finite"):
        made.learn(1)


def test_play_and_export_refuse_weights_that_are_not_finite(tmp_path):
    from dexsim import export

    good = checkpoint.load(make_checkpoint(tmp_path / "policy.pt"))
    for value, says in ((NAN, "actor.mlp.0.weight holds 1 of"), (1e38, "actions are not finite")):
        bad = good | {"actor": {k: v.clone() for k, v in good["actor"].items()}}
        bad["actor"]["mlp.0.weight"][0, 0] = value
        if value == 1e38:
            bad["actor"]["mlp.0.weight"][:] = value
        file = checkpoint.save(tmp_path / "bad.pt", bad)
        with pytest.raises(UserError, match=says):
            export.export(str(file), tmp_path / f"out{value}", steps=2)
    made = runner()
    payload = made.payload()
    payload["actor"]["mlp.0.weight"] = payload["actor"]["mlp.0.weight"] * INF
    with pytest.raises(UserError, match="not finite"):
        load_policy(checkpoint.load(checkpoint.save(tmp_path / "dummy.pt", payload)), made.env, "dummy.pt")


def test_a_policy_of_nan_is_not_played():
    made = runner()
    payload = made.payload()
    payload["actor"] = {k: v.clone() for k, v in payload["actor"].items()}
    for k in (0, 2, 4):
        payload["actor"][f"mlp.{k}.weight"][:] = 3e38
    with pytest.raises(UserError, match="x.pt: its policy's actions are not finite"):
        load_policy(payload, dummy_task.make_env(config(), 4, "cpu", 0, "none"), "x.pt")
