"""The skills of examples/: short, a package of their own, and learning for two iterations."""

from __future__ import annotations

import importlib
import sys
import tomllib
from pathlib import Path

import pytest

import dexsim

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
