"""Logging to Weights & Biases: its package stood in for by one that writes down what it is told."""

from __future__ import annotations

import importlib
import importlib.util
import json
import sys
from pathlib import Path

import pytest
import shell

from dexsim.learning import checkpoint
from dexsim.view import plots

STAND_IN = """import json, os
class Error(Exception): pass
def note(*what):
    with open("told.jsonl", "a") as file: file.write(json.dumps(what, default=str) + "\\n")
class config:
    update = staticmethod(
        lambda value: note("config", {k: v["task"]["name"] for k, v in value.items() if k == "env_cfg"})
    )
def save(path, base_path): note("file", path)
def init(project, entity, name, config):
    if os.environ.get("REFUSED"): raise Error("api_key not configured (no-tty)\\ncall wandb login")
    note("init", project, name, os.environ["WANDB_DIR"])
def log(row, step): note("log", row, step)
def finish(): note("finish")
"""
QUICK = ("task=dummy", "device=cpu", "worlds=4", "iterations=2", "final_episodes=0", "agent.logger=wandb", "run=first")


@pytest.fixture
def configs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(plots, "curves", lambda columns, path, title: path)  # takes longer than such a training
    monkeypatch.delenv("WANDB_DIR", raising=False)
    return shell.configs(tmp_path)


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """rsl-rl looks for wandb once, when it is imported: what it found then is exchanged too."""
    import dexsim.learning.ppo  # noqa: F401  imports rsl-rl as dexsim wants it

    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / "wandb.py").write_text(STAND_IN)
    monkeypatch.syspath_prepend(tmp_path / "lib")
    monkeypatch.delitem(sys.modules, "wandb", raising=False)
    monkeypatch.setattr("rsl_rl.utils.wandb_log_writer.wandb", importlib.import_module("wandb"))
    yield
    sys.modules.pop("wandb", None)


@pytest.mark.skipif(importlib.util.find_spec("wandb") is not None, reason="wandb is installed")
def test_not_installed_is_one_line_before_anything_is_built(configs, capfd):
    Path("wandb").mkdir()  # what its runs leave is no package
    assert shell.call("train", configs, *QUICK) == 2
    said = capfd.readouterr()
    assert (
        said.err
        == "error: agent.logger=wandb: Weights & Biases is not installed here; pip install wandb, then wandb login\n"
    )
    assert "compiling" not in said.out and not Path("runs").exists()


def test_a_run_is_told_to_wandb(configs, stand_in, capfd):
    assert shell.call("train", configs, *QUICK, "agent.wandb_project=hands") == 0, capfd.readouterr().err
    stated = [json.loads(line) for line in Path("told.jsonl").read_text().splitlines()]
    assert stated[0] == ["init", "hands", "first", "runs/dummy/first"] and ["config", {"env_cfg": "dummy"}] in stated
    assert stated[-1] == ["finish"]
    rewards = [(row, step) for what, row, step in (t for t in stated if t[0] == "log") if "Train/step_reward" in row]
    assert [step for _, step in rewards] == [1, 2]
    assert list(Path("runs/dummy/first").glob("events.out.tfevents.*")), "TensorBoard is written as well"
    assert checkpoint.load("runs/dummy/first/policy.pt")["config"]["agent"]["logger"] == "tensorboard"
    Path("told.jsonl").unlink()
    more = [s for s in QUICK if not s.startswith(("run=", "iterations=", "agent.", "task="))]
    assert shell.call("train", configs, "resume=runs/dummy/first/last.pt", "iterations=3", "run=second", *more) == 0
    assert not Path("told.jsonl").exists(), "a resume logs there only when asked again"


def test_not_logged_in_is_one_line(configs, stand_in, capfd, monkeypatch):
    monkeypatch.setenv("REFUSED", "1")
    assert shell.call("train", configs, *QUICK) == 2
    assert capfd.readouterr().err.endswith(
        "error: agent.logger=wandb: api_key not configured (no-tty) (wandb login; or WANDB_MODE=offline, and wandb "
        "sync later)\n"
    )
