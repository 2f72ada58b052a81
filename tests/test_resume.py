"""A resumed run is the unbroken one, bit for bit, where its worlds were kept; and says so where they are not."""

from __future__ import annotations

import pytest
import torch
from worlds import task_cfg

from dexsim.cli import start
from dexsim.errors import UserError
from dexsim.learning import checkpoint
from dexsim.learning.ranks import seed_all
from dexsim.learning.runner import Runner
from dexsim.paths import CONFIGS
from dexsim.tasks import make_env, worlds

torch.set_num_threads(1)
SMALL = ("agent.actor.hidden_dims=[16,16]", "agent.critic.hidden_dims=[16,16]", "sim.threads=1",
         "agent.num_steps_per_env=8")  # fmt: skip
FEELS = ("tactile=full", "randomize.servo.delay=[0.0,0.01]")
"""A sensor with hysteresis, shear, noise and delay, and drives that are late: all memory there is."""
ENDS = ("task.episode_s=0.3",)
"""Episodes that end in the middle of what is compared."""


def runner(task: str, engine: str, *settings: str, seed: int = 3, n: int = 5) -> Runner:
    cfg = task_cfg(*SMALL, f"sim.engine={engine}", f"seed={seed}", *settings, worlds=n, task=task)
    seed_all(seed)
    env = make_env(cfg, n, "cpu", seed, engine)
    env.step(torch.zeros(n, 12))  # as train.py does, to compile
    return Runner(env, cfg, {"dexsim": "test"})


def same(a: Runner, b: Runner) -> None:
    for part in ("actor", "critic"):
        for name, value in a.payload()[part].items():
            assert torch.equal(value, b.payload()[part][name]), (part, name)
    for name, value in a.env.keep_worlds().items():
        assert torch.equal(value.nan_to_num(), b.env.keep_worlds()[name].nan_to_num()), name


def resumed(path, task: str, engine: str, *settings: str) -> Runner:
    torch.manual_seed(99)
    out = runner(task, engine, *settings, seed=3)
    out.env.step(torch.ones(out.env.num_envs, 12))  # a process that has been elsewhere
    out.restore(checkpoint.load(path), str(path))
    return out


WARP = pytest.param("grasp", "warp", FEELS, marks=pytest.mark.slow, id="grasp-warp")


@pytest.mark.slow
@pytest.mark.parametrize(("task", "engine", "settings"),
                         [("grasp", "mujoco", FEELS), ("rotate", "mujoco", FEELS),
                          ("rotate_fingertips", "mujoco", FEELS), WARP])  # fmt: skip
def test_resume_is_the_unbroken_run(tmp_path, task, engine, settings):
    settings = (*settings, *ENDS)
    whole, rows = runner(task, engine, *settings), []
    whole.learn(4, rows.append)
    half, first = runner(task, engine, *settings), []
    half.learn(2, first.append)
    path = checkpoint.save(tmp_path / "half.pt", half.payload())
    rest, later = resumed(path, task, engine, *settings), []
    assert rest.resumed == "the worlds go on where they were"
    rest.learn(4, later.append)
    same(whole, rest)
    assert not torch.equal(half.payload()["actor"]["mlp.0.weight"], rest.payload()["actor"]["mlp.0.weight"])
    timed = ("collect_s", "learn_s")
    assert [{k: v for k, v in r.items() if k not in timed} for r in rows] == [
        {k: v for k, v in r.items() if k not in timed} for r in first + later
    ]


@pytest.mark.slow
def test_so_is_one_that_was_broken_off_in_a_rollout(tmp_path):
    """Ctrl-C comes anywhere: what is saved is the end of the last iteration, its running normalization too."""
    whole = runner("grasp", "mujoco", *ENDS)
    whole.learn(3)
    half, requested = runner("grasp", "mujoco", *ENDS), []
    assert half.learn(9, stop=lambda: len(requested) > 19 or requested.append(1)) is False and half.iteration == 2
    path = checkpoint.save(tmp_path / "half.pt", half.payload())
    half.learn(3)  # the one that was stopped could itself go on
    same(whole, half)
    rest = resumed(path, "grasp", "mujoco", *ENDS)
    rest.learn(3)
    same(whole, rest)


def test_every_part_that_changes_is_kept():
    """What a step changes of tensors by world, and is read by the next, is among what is kept: those left out are made
    anew by each step."""
    for task in ("grasp", "rotate"):
        made = runner(task, "mujoco", *FEELS, n=23)
        env, retained = made.env, {t.data_ptr() for t, _, _ in worlds.live(made.env).values()}
        own = {k: v for k, v in vars(env).items() if isinstance(v, torch.Tensor) and v.dim() and v.shape[0] == 23}
        before = {k: v.clone() for k, v in own.items()}
        for k in range(30):
            env.step(torch.full((23, 12), 0.5 * (-1) ** k))
        changed = {k for k, v in own.items() if not torch.equal(v, before[k]) and v.data_ptr() not in retained}
        computed = {"_action_in", "reward", "done", "time_out", "tip_force", "finger_force", "self_force", "palm_force",
                    "d_rot", "d_pos", "reached", "dropped", "_dropped", "tipped", "nan_end"}  # fmt: skip
        assert changed <= computed, changed - computed


@pytest.mark.slow
def test_worlds_that_cannot_be_this_runs(tmp_path):
    made = runner("grasp", "mujoco")
    path = checkpoint.save(tmp_path / "last.pt", made.payload())
    for setting, word in (("servo=ideal", "servo"), ("task.rewards.grip=0.1", "task"), ("tactile=full", "tactile")):
        other = runner("grasp", "mujoco", setting)
        other.restore(checkpoint.load(path), "last.pt")
        assert other.resumed == f"episodes begin anew ({word} differs from the checkpoint's)"
    without = runner("grasp", "mujoco", "save_worlds=false")
    assert "worlds" not in without.payload() and "worlds" not in checkpoint.policy_only(made.payload())
    plain = checkpoint.save(tmp_path / "plain.pt", without.payload())
    again = resumed(plain, "grasp", "mujoco")
    assert "save_worlds=true keeps them" in again.resumed and again._fresh


def test_worlds_of_an_earlier_dexsim_begin_anew(tmp_path):
    """Whose tasks had memory of other names: the run goes on, its episodes do not."""
    data = runner("grasp", "mujoco").payload()
    data["worlds"]["env.z_before"] = data["worlds"].pop("env.z_seen")
    again = resumed(checkpoint.save(tmp_path / "last.pt", data), "grasp", "mujoco")
    assert again.resumed == "episodes begin anew (the checkpoint's are of another dexsim)"


@pytest.mark.parametrize(("name", "spoil", "words"), [
    ("mujocoengine.geom_dataid", lambda x: x.fill_(10**6), r"geom_dataid holds 1000000, must lie in \[-1, \d+\]"),
    ("tactile.shape_id", lambda x: x.fill_(-7), r"shape_id holds -7"),
    ("objects.variant", lambda x: x.fill_(2**40), r"variant holds"),
    ("env.z_delay", lambda x: x.fill_(99), r"z_delay holds 99"),
    ("mujocoengine.qpos", lambda x: x.resize_(3, 3), r"qpos is float64 \[3, 3\], here it is float64 \[5, 19\]"),
    ("mujocoengine.qvel", None, "qvel is missing"),
    ("rng", lambda x: x.resize_(4), "rng is not that of this device"),
])  # fmt: skip
def test_worlds_that_a_stranger_made(tmp_path, name, spoil, words):
    """Whole numbers that index memory are checked before anything is changed."""
    made = runner("grasp", "mujoco")
    payload, before = made.payload(), made.env.keep_worlds()
    if spoil is None:
        del payload["worlds"][name]
    else:
        spoil(payload["worlds"][name])
    path = checkpoint.save(tmp_path / "last.pt", payload)
    with pytest.raises(UserError, match=f"damaged checkpoint.*{words}"):
        made.restore(checkpoint.load(path), "last.pt")
    assert set(before) == set(made.env.keep_worlds())


def test_the_setting(monkeypatch):
    with pytest.raises(UserError, match="save_worlds=maybe: must be true, false or null"):
        start.for_train(["task=grasp", "device=cpu", "save_worlds=maybe"], CONFIGS)
    monkeypatch.setattr("dexsim.learning.runner.SMALL", 1000)
    assert not runner("grasp", "mujoco").saves_worlds and runner("grasp", "mujoco", "save_worlds=true").saves_worlds
