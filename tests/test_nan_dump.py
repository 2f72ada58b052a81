"""A world that is not finite: dumped with what led there, and replayed."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from worlds import grasp_env

from dexsim.console.ending import guard
from dexsim.errors import UserError
from dexsim.tasks import nan_dump, nan_replay

N = 4


@pytest.fixture(scope="module")
def env():
    return grasp_env(worlds=N)


def blow_up(env, world: int) -> dict[str, np.ndarray]:
    """Return one control step in which a huge force tears the object of one world; returns its state just before."""
    env.outside_force[world, 0] = 1e8  # N
    t = env.engine.t
    before = {"qpos": t.qpos[world].numpy().copy(), "qvel": t.qvel[world].numpy().copy(),
              "mass": env.engine.field("body_mass")[world].numpy().copy()}
    action = torch.linspace(-0.5, 0.5, N * 12).reshape(N, 12)
    env.step(action)
    env.outside_force.zero_()
    assert bool(env.done[world]), "the world survived: the test says nothing"
    return before | {"action": action[world].numpy()}


def test_a_dump_holds_the_state_before_the_step(env, tmp_path, capsys):
    env.dump_folder = tmp_path
    env.reset_all()
    for _ in range(5):
        env.step(torch.zeros(N, 12))
    env.check()
    assert not list(tmp_path.iterdir()), "nothing went wrong yet"
    before = blow_up(env, 2)
    env.step(torch.zeros(N, 12))  # the world has a new episode by now; the dump must not
    env.check()
    data = nan_dump.load(tmp_path / "nan_0.npz")
    assert int(data["world"]) == 2 and int(data["episode_step"]) == 6
    np.testing.assert_array_equal(data["qpos"], before["qpos"])
    np.testing.assert_array_equal(data["qvel"], before["qvel"])
    np.testing.assert_array_equal(data["field.body_mass"], before["mass"])
    np.testing.assert_allclose(data["action"], before["action"])
    said = capsys.readouterr().out
    assert sum("nan_0.npz" in line for line in said.splitlines()) == 1
    env.check()
    assert len(list(tmp_path.iterdir())) == 1, "written once"
    blow_up(env, 0)
    env.check()
    assert int(nan_dump.load(tmp_path / "nan_1.npz")["world"]) == 0


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mujoco", pytest.param("warp", marks=pytest.mark.slow)])
def test_a_replay_fails_again_and_a_sound_world_repeats_its_step(tmp_path, capsys, engine):
    env = grasp_env(worlds=N, engine=engine)
    env.dump_folder = tmp_path
    for _ in range(5):
        env.step(torch.full((N, 12), 0.2))
    blow_up(env, 1)
    env.check()
    assert bool(nan_replay.replay(tmp_path / "nan_0.npz", engine=engine).nan[0])
    assert nan_replay.main([str(tmp_path / "nan_0.npz"), f"engine={engine}"]) == 0
    assert "it fails again" in capsys.readouterr().out
    # a step that stays finite, dumped as if it had not: the replay moves the world as the environment did
    env.reset_all()
    for _ in range(40):  # until the object lies in the hand
        env.step(torch.full((N, 12), 0.2))
    keep, env._reset_done = env._reset_done, lambda: None
    env.step(torch.full((N, 12), 0.3))
    env._reset_done = keep
    env._nan_dump.after(torch.arange(N) == 3)
    env.check()
    again = nan_replay.replay(tmp_path / "nan_1.npz", engine=engine).engine.t
    torch.testing.assert_close(again.qpos[0], env.engine.t.qpos[3], rtol=0, atol=1e-5)
    torch.testing.assert_close(again.qvel[0], env.engine.t.qvel[3], rtol=0, atol=1e-3)


@pytest.mark.limits
def test_a_file_that_is_none(tmp_path, capsys):
    (tmp_path / "x.npz").write_bytes(b"PK\x03\x04 torn")
    with pytest.raises(UserError, match="x.npz"):
        nan_dump.load(tmp_path / "x.npz")
    assert guard(nan_replay.main, [str(tmp_path / "missing.npz")]) == 2
    assert "missing.npz" in capsys.readouterr().err
