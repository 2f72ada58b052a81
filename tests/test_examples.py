"""The skills of examples/: short, a package of their own, and learning for two iterations."""

from __future__ import annotations

import importlib
import sys
import tomllib
from pathlib import Path

import pytest
import torch

import dexsim
from dexsim import rotation

FOLDER = Path(__file__).resolve().parents[1] / "examples"
PACKAGE = tomllib.loads((FOLDER / "pyproject.toml").read_text(encoding="utf-8"))
SKILLS = PACKAGE["project"]["entry-points"]["dexsim.tasks"]


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    yield
    for name in [m for m in sys.modules if m.startswith("dexsim_examples")]:
        del sys.modules[name]


@pytest.mark.parametrize("name", SKILLS)
def test_a_skill_is_one_short_file(name):
    module, _, kind = SKILLS[name].partition(":")
    lines = (FOLDER / f"{module.replace('.', '/')}.py").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 150
    made = getattr(importlib.import_module(module), kind)
    assert made.__doc__ and dexsim.settings(made)["task"]["name"] == name


@pytest.mark.slow
@pytest.mark.parametrize("name", SKILLS)
def test_a_skill_learns(name, tmp_path):
    module, _, kind = SKILLS[name].partition(":")
    made = getattr(importlib.import_module(module), kind)
    few = ["final_episodes=4", "agent.num_steps_per_env=8", "task.evaluation.cap_s=1", "task.episode_s=1"]
    where = dexsim.train(made, worlds=4, iterations=2, device="cpu", settings=few, out=tmp_path / "run")
    assert (where / "policy.pt").is_file() and (where / "play" / "metrics.json").is_file()


@pytest.mark.slow
def test_reorient_sees_a_cube_alike_whichever_face_is_up():
    made = importlib.import_module("dexsim_examples.reorient").Reorient
    env = dexsim.make_env(task=made, worlds=96, device="cpu", seed=4)
    drawn = torch.randn(96, 4, generator=torch.Generator().manual_seed(4))
    env.object_pose[:, 3:] = rotation.normalize(drawn)
    before = env.cube_turn(), env.to_goal(), *env.measure(env.object_pose)
    relabelled = env.alike.repeat(2, 1)  # each of the 24 turns of a cube onto itself
    env.object_pose[:, 3:] = rotation.multiply(env.object_pose[:, 3:].clone(), relabelled)
    env.commands["goal"].copy_(rotation.multiply(env.commands["goal"].clone(), relabelled))
    after = env.cube_turn(), env.to_goal(), *env.measure(env.object_pose)
    for seen, again in zip(before, after, strict=True):
        torch.testing.assert_close(again, seen, atol=2e-5, rtol=0)
    up = torch.tensor([0.0, 0.0, 1.0]).expand(96, 3)
    tipped = rotation.rotate(env.commands["goal"], rotation.rotate(rotation.conjugate(env.object_pose[:, 3:]), up))
    torch.testing.assert_close(before[3].cos(), tipped[:, 2], atol=1e-5, rtol=0)
