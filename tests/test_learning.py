"""Learning: resume is bitwise, checkpoints survive what can go wrong, the gymnasium view keeps its conventions."""

from __future__ import annotations

import errno
import io
import math
import os
import pickle
import random
import resource
import signal
import subprocess

import dummy_task
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from dexsim.errors import UserError
from dexsim.learning import checkpoint
from dexsim.learning.gym_env import GymVectorEnv
from dexsim.learning.meter import Meter
from dexsim.learning.ppo import action_noise, load_policy, plain_policy
from dexsim.learning.runner import Runner
from dexsim.paths import CONFIGS

torch.set_num_threads(1)  # tiny networks: more threads only wait for each other
SMALL = {"hidden_dims": [16, 16]}


def config(**task):
    agent = OmegaConf.to_container(OmegaConf.load(CONFIGS / "agent" / "ppo.yaml"))
    agent["actor"] |= SMALL
    agent["critic"] |= SMALL
    return {"task": {"steps": 20} | task, "agent": agent, "seed": 3, "save_interval": 10, "choices": {"task": "dummy"}}


def runner(seed=3, worlds=8, average=0, **task):
    torch.manual_seed(seed)
    np.random.seed(seed)
    random.seed(seed)
    cfg = config(**task) | {"average": average}
    return Runner(dummy_task.make_env(cfg, worlds, "cpu", seed, "none"), cfg, {"dexsim": "test"})


def test_first_actions_scales_the_actors_means_and_nothing_else(tmp_path):
    def made(factor):
        torch.manual_seed(3)
        cfg = config() | {"first_actions": factor}
        return Runner(dummy_task.make_env(cfg, 8, "cpu", 3, "none"), cfg, {"dexsim": "test"})

    whole, near = made(1.0), made(0.01)
    obs = whole.env.get_observations()
    whole.alg.get_policy().eval(), near.alg.get_policy().eval()
    a, b = whole.alg.get_policy()(obs), near.alg.get_policy()(obs)
    assert a.abs().max() > 0.01
    torch.testing.assert_close(b, 0.01 * a, rtol=1e-4, atol=1e-7)
    for part in ("actor", "critic"):
        one, other = whole.payload()[part], near.payload()[part]
        differ = {k for k in one if not torch.equal(one[k], other[k])}
        assert differ == ({"mlp.4.weight", "mlp.4.bias"} if part == "actor" else set())
    checkpoint.save(tmp_path / "near.pt", near.payload())  # a resume starts where it stopped, not a hundredth of it
    again = made(0.01)
    again.restore(checkpoint.load(tmp_path / "near.pt"), "near.pt")
    again.alg.get_policy().eval()
    assert torch.equal(again.alg.get_policy()(obs), b)


def test_the_average_is_the_mean_of_the_weights_and_changes_nothing_of_what_is_learned(tmp_path):
    plain, weights = runner(), []
    plain.learn(4, lambda row: weights.append({k: v.clone() for k, v in plain.alg.get_policy().state_dict().items()}))
    half = runner(average=100)
    half.learn(2)
    checkpoint.save(tmp_path / "half.pt", half.payload())
    made = runner(seed=77, average=100)
    made.restore(checkpoint.load(tmp_path / "half.pt"), "half.pt")
    made.learn(4)
    payload = made.payload()
    for name, value in plain.payload()["actor"].items():
        assert torch.equal(value, payload["learner"][name]), name
        if value.is_floating_point():
            torch.testing.assert_close(payload["actor"][name], torch.stack([w[name] for w in weights]).mean(0))
    obs = made.env.get_observations()
    saved = load_policy(checkpoint.policy_only(payload), made.env, "policy.pt")
    assert torch.equal(made.policy()(obs), saved(obs)) and not torch.equal(saved(obs), plain.policy()(obs))


@pytest.mark.parametrize("factor", [0, -1.0, 2, "little", True, math.nan])
def test_first_actions_must_be_a_share(factor):
    with pytest.raises(UserError, match="first_actions.*above 0 and at most 1"):
        cfg = config() | {"first_actions": factor}
        Runner(dummy_task.make_env(cfg, 8, "cpu", 3, "none"), cfg, {"dexsim": "test"})


@pytest.fixture(scope="module")
def trained():
    made = runner()
    made.learn(2)
    return made


@pytest.fixture
def saved(trained, tmp_path):
    return checkpoint.save(tmp_path / "last.pt", trained.payload())


def test_resume_is_bitwise_the_unbroken_run(tmp_path):
    whole, rows = runner(), []
    whole.learn(4, rows.append)
    half = runner()
    half.learn(2)
    checkpoint.save(tmp_path / "half.pt", half.payload())
    torch.manual_seed(99), np.random.seed(99), random.seed(99)  # a new process starts anywhere
    rest, later = runner(seed=77), []
    rest.restore(checkpoint.load(tmp_path / "half.pt"), "half.pt")
    assert (rest.iteration, rest.steps) == (2, 2 * 24 * 8)
    rest.learn(4, later.append)
    for part in ("actor", "critic"):
        for (name, a), b in zip(whole.payload()[part].items(), rest.payload()[part].values()):
            assert torch.equal(a, b), (part, name)
    assert torch.equal(whole.env.get_observations()["actor"], rest.env.get_observations()["actor"])
    assert [r["Loss/value"] for r in rows[2:]] == [r["Loss/value"] for r in later]
    assert [r["iteration"] for r in later] == [3, 4]
    assert whole.alg.learning_rate == rest.alg.learning_rate
    assert torch.equal(torch.rand(3), torch.rand(3)) is False  # generators are live, not frozen


def test_episodes_that_begin_anew_on_resume_do_not_end_together(tmp_path, monkeypatch):
    """An environment that keeps its episodes (the dummy) goes on with their ages; of one that begins them all anew they
    are spread as at the first start, the same each time the checkpoint is resumed."""
    made = runner(worlds=64, steps=1000)
    made.learn(1)
    saved = checkpoint.save(tmp_path / "last.pt", made.payload())

    def ages_after_resume():
        torch.manual_seed(99)
        again = runner(seed=77, worlds=64, steps=1000)
        again.restore(checkpoint.load(saved), "last.pt")
        begun = again.env.episode_length_buf.clone()
        again.learn(2, stop=lambda: True)  # nothing is learned: what is at its beginning
        return begun, again.env.episode_length_buf

    before, retained = ages_after_resume()
    assert torch.equal(before, made.env.episode_length_buf) and torch.equal(retained, before)
    keep = dummy_task.DummyEnv.load_state_dict

    def anew(self, state):
        keep(self, state)
        self.reset_all()

    monkeypatch.setattr(dummy_task.DummyEnv, "load_state_dict", anew)
    before, spread = ages_after_resume()
    assert not before.any() and len(spread.unique()) > 50 and 700 < spread.max() < 1000
    assert torch.equal(ages_after_resume()[1], spread)


def test_resume_restores_the_learning_rate_and_normalization(saved, trained):
    again = runner(seed=5)
    again.restore(checkpoint.load(saved), "last.pt")
    assert again.alg.learning_rate == trained.alg.learning_rate
    assert again.alg.optimizer.param_groups[0]["lr"] == trained.alg.learning_rate
    count = [v for k, v in again.payload()["actor"].items() if k.endswith("normalizer.count")]
    assert count and int(count[0]) == 2 * 24 * 8


def test_learning_improves_the_dummy_task():
    made, rows = runner(worlds=32), []
    made.learn(15, rows.append)
    first, last = (np.mean([r["step_reward"] for r in part]) for part in (rows[:3], rows[-3:]))
    assert last > first + 0.2


def test_divergence_is_one_clear_line():
    made = runner()
    made.alg.critic.mlp[0].weight.data[0, 0] = math.nan
    with pytest.raises(UserError, match="diverged at iteration 1 .*learning_rate"):
        made.learn(1)
    made = runner()
    made.alg.optimizer.step = lambda: made.alg.critic.mlp[-1].bias.data.fill_(math.inf)
    made.alg.num_learning_epochs = made.alg.num_mini_batches = 1  # the only loss is from before the step
    made.alg.storage.mini_batch_generator = first_only(made.alg.storage.mini_batch_generator)
    with pytest.raises(UserError, match="weights not finite"):
        made.learn(1)


def first_only(generator):
    return lambda *args: (batch for batch, _ in zip(generator(*args), range(1)))


def test_stop_drops_a_rollout_and_keeps_the_counters():
    made, calls = runner(), []

    def stop():
        calls.append(1)
        return len(calls) > 24 + 5

    assert made.learn(10, stop=stop) is False
    assert made.iteration == 1 and made.steps == 24 * 8
    assert made.learn(2) is True and made.iteration == 2


def test_observation_buffers_changed_in_place_reach_storage_in_time():
    """The dummy hands out its own state; PPO must store what the action was chosen on, not what came after."""
    made, seen = runner(), []
    act = made.alg.act

    def spy(obs):
        seen.append(obs["actor"].clone())
        return act(obs)

    made.alg.act = spy
    update = made.alg.update
    stored = []
    made.alg.update = lambda: (stored.append(made.alg.storage.observations["actor"].clone()), update())[1]
    made.learn(1)
    assert torch.equal(torch.stack(seen), stored[0])
    assert not torch.equal(seen[0], seen[1])


def test_agent_settings_rsl_rl_does_not_know():
    cfg = config()
    cfg["agent"]["algorithm"]["nonsense"] = 1
    with pytest.raises(UserError, match="nonsense"):
        Runner(dummy_task.make_env(cfg, 4, "cpu", 0, "none"), cfg, {})


def test_checkpoint_round_trip(saved, trained):
    data = checkpoint.load(saved)
    assert data["config"] == trained.full_cfg
    assert data["layout"] == {
        "joints": ["left", "right"],
        "action": [["left", -1.0, 1.0, "-"], ["right", -1.0, 1.0, "-"]],
        "observations": {"actor": [["x", 2]], "critic": [["x", 2], ["x clean", 2]]},
    }
    assert data["iteration"] == 2 and set(data["git"]) == {"commit", "dirty"}
    obs = trained.env.get_observations()
    policy = load_policy(data, trained.env, "last.pt")
    with torch.no_grad():
        assert torch.equal(policy(obs), trained.policy()(obs))
    trained.alg.train_mode()


def test_a_policy_is_played_with_the_noise_of_its_training(saved, trained):
    data, obs = checkpoint.load(saved), trained.env.get_observations()
    still = load_policy(data, trained.env, "last.pt")
    with torch.no_grad():
        for share in (0.5, 1.0):
            noisy = load_policy(data, trained.env, "last.pt", noise=share)
            off = torch.cat([noisy(obs) - still(obs) for _ in range(400)])
            torch.testing.assert_close(off.std(0), share * action_noise(data["actor"]), rtol=0.1, atol=0)
            assert off.mean(0).abs().max() < 0.1 * off.std()
    assert action_noise({k: x for k, x in data["actor"].items() if "distribution" not in k}) is None


def test_policy_file_is_small_and_plays(saved, trained, tmp_path):
    small = checkpoint.save(tmp_path / "policy.pt", checkpoint.policy_only(trained.payload()))
    assert small.stat().st_size < 0.5 * saved.stat().st_size
    data = checkpoint.load(small)
    assert not set(checkpoint.TRAIN_KEYS) & set(data)
    load_policy(data, trained.env, "policy.pt")
    with pytest.raises(UserError, match="only a policy"):
        runner().restore(data, "policy.pt")


def full_disk(monkeypatch, *, at):
    def refuse(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(checkpoint.os, at, refuse)


@pytest.mark.parametrize("at", ["fsync", "replace"])
def test_full_disk_keeps_the_previous_checkpoint(saved, trained, monkeypatch, at):
    before = saved.read_bytes()
    full_disk(monkeypatch, at=at)
    with pytest.raises(UserError, match="disk is full.*previous file there is whole"):
        checkpoint.save(saved, trained.payload())
    assert saved.read_bytes() == before
    assert os.listdir(saved.parent) == ["last.pt"]  # nothing half-written left over


def test_a_write_the_system_cuts_short_keeps_the_previous_checkpoint(saved, trained):
    """A real refusal by the kernel in the middle of the write (a file size limit), in a process of its own."""
    before = saved.read_bytes()
    child = os.fork()
    if child == 0:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
        try:
            checkpoint.save(saved, {**trained.payload(), "iteration": 99})
        except UserError:
            os._exit(7)
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
    assert saved.read_bytes() == before and os.listdir(saved.parent) == ["last.pt"]


def test_unwritable_folder(trained, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot save .*Not a directory"):
        checkpoint.save(tmp_path / "file" / "last.pt", trained.payload())


def test_missing_checkpoint_names_what_is_there(saved):
    with pytest.raises(UserError, match=r"no such checkpoint; in .* there are last\.pt"):
        checkpoint.load(saved.with_name("lost.pt"))
    with pytest.raises(UserError, match="a folder, not a checkpoint"):
        checkpoint.load(saved.parent)


@pytest.mark.parametrize("keep", [0, 1, 100, -1, -100])
def test_truncated_checkpoint(saved, keep):
    data = saved.read_bytes()
    saved.write_bytes(data[:keep])
    with pytest.raises(UserError, match="truncated|empty"):
        checkpoint.load(saved)


def test_damaged_checkpoint(saved, trained):
    data = bytearray(saved.read_bytes())
    needle = trained.payload()["actor"]["mlp.0.weight"].numpy().tobytes()
    at = bytes(data).index(needle)
    data[at] ^= 0xFF
    saved.write_bytes(data)
    with pytest.raises(UserError, match="damaged"):
        checkpoint.load(saved)


class Evil:
    def __reduce__(self):
        return os.mkdir, (Evil.path,)


@pytest.mark.parametrize("wrap", ["zip", "legacy", "pickle"])
def test_pickled_code_is_refused_and_not_run(tmp_path, trained, wrap):
    Evil.path = str(tmp_path / "ran")
    file = tmp_path / "evil.pt"
    payload = {"format": checkpoint.FORMAT, "version": 1, "config": Evil()}
    if wrap == "pickle":
        file.write_bytes(pickle.dumps(payload))
    else:
        torch.save(payload, file, _use_new_zipfile_serialization=wrap == "zip")
    with pytest.raises(UserError, match="refused.*(code)"):
        checkpoint.load(file)
    assert not (tmp_path / "ran").exists()


def test_other_format_version_and_foreign_files(saved, tmp_path):
    data = torch.load(saved, weights_only=True)
    torch.save(data | {"version": 2, "versions": {"dexsim": "9.9"}}, tmp_path / "new.pt")
    with pytest.raises(UserError, match="format version 2, this dexsim reads version 1.*9.9"):
        checkpoint.load(tmp_path / "new.pt")
    torch.save({"model": torch.zeros(3)}, tmp_path / "other.pt")
    with pytest.raises(UserError, match="not a dexsim checkpoint"):
        checkpoint.load(tmp_path / "other.pt")
    torch.save({k: v for k, v in data.items() if k != "critic"}, tmp_path / "part.pt")
    with pytest.raises(UserError, match="lacks critic"):
        checkpoint.load(tmp_path / "part.pt")
    (tmp_path / "text.pt").write_text("hello")
    with pytest.raises(UserError, match="not a checkpoint"):
        checkpoint.load(tmp_path / "text.pt")


def test_layout_of_another_environment_is_named(saved, trained):
    data = checkpoint.load(saved)
    here = checkpoint.layout_of(trained.env)
    checkpoint.check_layout(data, here, "x")
    with pytest.raises(UserError, match=r"entry 0 .* was x \(2\), here it is y \(2\)"):
        checkpoint.check_layout(data, here | {"observations": {"actor": [["y", 2]]}}, "x")
    with pytest.raises(UserError, match="joints left, right"):
        checkpoint.check_layout(data, here | {"joints": ["right", "left"]}, "x")


def test_random_state_round_trip_through_a_file(tmp_path):
    torch.save(checkpoint.rng_state(), tmp_path / "rng.pt")
    first = torch.rand(3), np.random.rand(3), random.random(), random.gauss(0, 1), np.random.randn()
    checkpoint.set_rng_state(torch.load(tmp_path / "rng.pt", weights_only=True))
    second = torch.rand(3), np.random.rand(3), random.random(), random.gauss(0, 1), np.random.randn()
    assert torch.equal(first[0], second[0]) and np.array_equal(first[1], second[1]) and first[2:] == second[2:]


def test_git_state_outside_a_checkout(tmp_path):
    assert checkpoint.git_state(tmp_path) == {"commit": "unknown", "dirty": False}


def test_git_state_of_a_checkout_and_in_words(tmp_path):
    git = lambda *args: subprocess.run(  # noqa: E731
        ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b.c", *args],
        check=True,
        capture_output=True,
        text=True,
    ).stdout.strip()
    code = tmp_path / "__init__.py"
    code.write_text("")
    git("init", "-q")
    git("add", ".")
    git("commit", "-qm", "first")
    commit = git("rev-parse", "HEAD")
    assert checkpoint.git_state(tmp_path) == {"commit": commit, "dirty": False}
    code.write_text("changed = True")
    state = checkpoint.git_state(tmp_path)
    assert state == {"commit": commit, "dirty": True}
    data = {"git": state, "iteration": 3, "steps": 4096}
    assert checkpoint.provenance(data) == f"iteration 3, 4,096 steps, trained at commit {commit[:12]}+changes"
    data["git"] = {"commit": commit, "dirty": None, "note": "found by its settings"}
    assert checkpoint.provenance(data).endswith(f"commit {commit[:12]}, written in afterwards")
    data["git"] = checkpoint.git_state(tmp_path / "elsewhere")
    assert checkpoint.provenance(data).endswith("commit unknown")


def test_meter_against_plain_sums():
    generator = np.random.default_rng(0)
    rewards, dones = generator.normal(size=(30, 5)), generator.random((30, 5)) < 0.2
    meter, returns, lengths = Meter(5, "cpu"), [], []
    total, age = np.zeros(5), np.zeros(5)
    for t in range(30):
        log = {"a": float(t), "b": torch.tensor([1.0, 3.0])} | ({"c": math.nan if t % 2 else 4.0})
        meter.add(torch.tensor(rewards[t], dtype=torch.float32), torch.tensor(dones[t]), log)
        total, age = total + rewards[t], age + 1
        returns += total[dones[t]].tolist()
        lengths += age[dones[t]].tolist()
        total[dones[t]] = age[dones[t]] = 0
    row = meter.read()
    assert row["reward"] == pytest.approx(np.mean(returns), rel=1e-5)
    assert row["length"] == pytest.approx(np.mean(lengths)) and row["episodes"] == len(returns)
    assert row["step_reward"] == pytest.approx(rewards.mean(), abs=1e-6)
    assert (row["Episode/a"], row["Episode/b"], row["Episode/c"]) == (14.5, 2.0, 4.0)
    meter.add(torch.zeros(5), torch.zeros(5), {"d/e": math.nan})
    assert set(meter.read()) == {"step_reward"}  # no episode ended, nothing reported


def test_plain_policies():
    env = dummy_task.make_env(config(), 6, "cpu", 0, "none")
    obs = env.get_observations()
    assert torch.equal(plain_policy("zero", env, 0)(obs), torch.zeros(6, 2))
    a, b, c = (plain_policy("random", env, s)(obs) for s in (1, 1, 2))
    assert torch.equal(a, b) and not torch.equal(a, c) and bool((a.abs() <= 1).all())
    assert torch.equal(plain_policy("scripted", env, 0)(obs), -10 * obs["actor"])


def test_gymnasium_conventions():
    from gymnasium.vector import AutoresetMode, VectorEnv

    envs = GymVectorEnv(dummy_task.make_env(config(steps=3), 4, "cpu", 0, "none"))
    assert isinstance(envs, VectorEnv) and envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    obs, info = envs.reset(seed=5)
    assert obs in envs.observation_space and obs.dtype == np.float32 and info["critic"].shape == (4, 4)
    again, _ = envs.reset(seed=5)
    assert np.array_equal(obs, again)
    envs.action_space.seed(0)
    for step in range(1, 7):
        before = obs
        action = envs.action_space.sample()
        obs, reward, terminated, truncated, info = envs.step(action)
        assert obs in envs.observation_space and reward.shape == terminated.shape == truncated.shape == (4,)
        assert terminated.dtype == truncated.dtype == bool and not (terminated & truncated).any()
        if step % 3 == 0:  # the time limit: truncated, restarted in the same step, last observation kept
            assert truncated.all() and info["_final_obs"].all()
            assert np.allclose(info["final_obs"], before + 0.1 * np.clip(action, -1, 1), atol=1e-6)
            assert not np.allclose(info["final_obs"], obs)
        else:
            assert not truncated.any() and "final_obs" not in info
    with pytest.raises(UserError, match="shape"):
        envs.step(np.zeros((3, 2)))
    with pytest.raises(UserError, match="actor, critic"):
        GymVectorEnv(dummy_task.make_env(config(), 4, "cpu", 0, "none"), group="pixels")


def test_encode_needs_no_file():
    assert isinstance(torch.load(io.BytesIO(checkpoint.encode({"config": {}})), weights_only=True), dict)
