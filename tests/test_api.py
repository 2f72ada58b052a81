"""`import dexsim`: the names are there, documented and lazy; the notebook uses them rightly."""

from __future__ import annotations

import ast
import importlib.util
import inspect
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import dexsim

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
NAMES = [n for n in dexsim.__all__ if n != "__version__"]


def cells(notebook: Path) -> list[str]:
    """Return the code cells of a notebook."""
    return [
        "".join(c["source"])
        for c in json.loads(notebook.read_text(encoding="utf-8"))["cells"]
        if c["cell_type"] == "code"
    ]


def test_importing_dexsim_loads_nothing_heavy():
    look = (
        "import sys, dexsim; print(sorted({'torch', 'mujoco', 'warp', 'numpy', 'hydra', 'scipy'} & "
        "set(sys.modules)), len(dir(dexsim)))"
    )
    done = subprocess.run([sys.executable, "-c", look], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["[]", str(len(dexsim.__all__))]


@pytest.mark.parametrize("name", NAMES)
def test_each_name_is_documented(name):
    thing = getattr(dexsim, name)
    assert f"\n{name} " in dexsim.__doc__, "dexsim/__init__.py lists it"
    assert inspect.getdoc(thing)
    if inspect.isfunction(thing):
        assert set(inspect.signature(thing).parameters) | {"return"} == set(thing.__annotations__)


def test_a_wrong_name_is_answered():
    with pytest.raises(AttributeError, match="has no attribute 'diagnos'; it has Diagnosis"):
        dexsim.diagnos  # noqa: B018


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda p: p.stem)
def test_a_notebook_imports_and_calls_what_there_is(notebook):
    """Every import is found, every `dexsim.NAME` exists, and each call's arguments fit the function's signature."""
    called = set()
    for source in cells(notebook):
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.Import):
                for alias in node.names:
                    assert importlib.util.find_spec(alias.name), alias.name
            elif isinstance(node, ast.ImportFrom):
                assert importlib.util.find_spec(node.module), node.module
            elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "dexsim":
                assert node.attr in dexsim.__all__, node.attr
            if isinstance(node, ast.Call) and ast.unparse(node.func).startswith("dexsim."):
                function = eval(ast.unparse(node.func))
                inspect.signature(function).bind(*node.args, **{k.arg: k.value for k in node.keywords})
                called.add(ast.unparse(node.func))
    assert len(called) >= 8


def test_notebooks_are_found():
    assert [p.stem for p in NOTEBOOKS] == ["first_steps"]


@pytest.mark.slow
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda p: p.stem)
def test_a_notebook_runs(notebook, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    names: dict = {}
    for source in cells(notebook):
        exec(compile(source, notebook.name, "exec"), names)
    delay = names["fitted"].value("joint", "delay")
    assert delay.low < names["hidden"]["delay"] < delay.high, "the diagnosis found what was hidden"
    assert names["metrics"]["episodes"] == 8
    assert {p.name for p in tmp_path.iterdir()} == {"out"}


def test_settings_are_those_of_the_command_line():
    cfg = dexsim.settings("rotate", ["worlds=3", "device=cpu", "servo=ideal"])
    assert (cfg["task"]["name"], cfg["worlds"], cfg["choices"]["servo"]) == ("rotate", 3, "ideal")


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: dexsim.settings("grasp", ["wrlds=3"]), "unknown setting 'wrlds'"),
        (lambda: dexsim.settings("grab"), "task=grab: no such task; task can be grasp"),
        (lambda: dexsim.settings("grasp", "worlds=3"), "must be a list"),
        (lambda: dexsim.settings("grasp", ["--help"]), "is no setting"),
        (lambda: dexsim.make_env(checkpoint="none.pt"), "none.pt"),
        (lambda: dexsim.train(worlds=0, device="cpu"), "worlds=0: must be a whole number from 1"),
        (lambda: dexsim.play(policy="clever"), "policy=clever: must be random, zero or scripted"),
        (lambda: dexsim.play(), "say what to play"),
        (lambda: dexsim.read_recording("none.mcap"), "none.mcap"),
        (lambda: dexsim.diagnose("none.mcap"), "none.mcap"),
        (lambda: dexsim.diagnose(["a.mcap"], effects="backlash"), "must be a list of names"),
        (lambda: dexsim.diagnose(["a.mcap"], device="gpu"), "device=gpu: must be cpu or cuda"),
        (lambda: dexsim.demo_recordings("here", effect="gremlin"), "effect=gremlin: must be one of"),
    ],
)
def test_bad_input_is_one_line(call, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(dexsim.UserError) as error:
        call()
    assert words in str(error.value) and "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


def test_a_recording_there_and_back(tmp_path):
    """demo_recordings -> read -> write -> read: the same; its replay has the same joints and follows the commands."""
    paths, model, servo, hidden = dexsim.demo_recordings(tmp_path / "made", "coulomb_friction", seed=1)
    assert len(paths) == 4 and hidden
    recording = dexsim.read_recording(paths[0], joints=["joint"])
    again = dexsim.read_recording(dexsim.write_recording(tmp_path / "copy" / "a.mcap", recording), joints=["joint"])
    np.testing.assert_array_equal(again.states.position.value, recording.states.position.value)
    np.testing.assert_allclose(again.commands.t, recording.commands.t, atol=1e-9)
    simulated = dexsim.replay_recording(recording, model, servo)
    at = np.interp(simulated.states.position.t, recording.states.position.t, recording.states.position.value[:, 0])
    assert simulated.joints == ("joint",) and np.sqrt(np.mean((simulated.states.position.value[:, 0] - at) ** 2)) < 0.1
    with pytest.raises(dexsim.UserError, match="timestep=1: must be a number from 0.0001 to 0.02 s"):
        dexsim.replay_recording(recording, model, servo, timestep=1)


@pytest.mark.slow
def test_an_environment_a_policy_and_its_episodes(tmp_path, monkeypatch):
    import torch

    monkeypatch.chdir(tmp_path)
    checkpoint = ROOT / "checkpoints" / "grasp.pt"
    env = dexsim.make_env(checkpoint=checkpoint, worlds=2, device="cpu", seed=3)
    action = dexsim.load_policy(checkpoint, env)(env.get_observations())
    assert action.shape == (2, env.num_actions) and torch.isfinite(action).all()
    with pytest.raises(dexsim.UserError, match=r"rotate\.pt"):
        dexsim.load_policy(ROOT / "checkpoints" / "rotate.pt", env)
    plain = dexsim.make_env("grasp", worlds=2, device="cpu", seed=3, settings=["tactile=raw"])
    _, reward, done, _ = plain.step(torch.zeros(2, plain.num_actions))
    assert reward.shape == done.shape == (2,)
    metrics = dexsim.play(
        policy="zero", episodes=2, device="cpu", settings=["worlds=2"], out=tmp_path / "it's here, [played]"
    )
    assert metrics["episodes"] == 2 and (tmp_path / "it's here, [played]" / "metrics.json").is_file()


@pytest.mark.slow
def test_wrong_names_are_red_in_an_editor(tmp_path):
    from mypy import api

    lines = ('env.stpe(1)', 'dexsim.train(taks="x")', "dexsim.PPO(gama=0.9)", "dexsim.diagnose([]).findngs")
    page = tmp_path / "typo.py"
    page.write_text("\n".join(("import dexsim", "env = dexsim.make_env()", *lines)) + "\n")
    said = api.run(["--config-file", str(ROOT / "pyproject.toml"), "--follow-imports=silent", str(page)])[0]
    assert [f"typo.py:{k}:" in said for k in range(1, 7)] == [False, False, True, True, True, True], said
