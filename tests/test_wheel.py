"""What a stranger installs: the wheel alone, in an environment of its own, from an empty folder outside the
repository."""

from __future__ import annotations

import importlib
import importlib.metadata
import json
import os
import runpy
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest
import yaml
from fresh import call

from dexsim.cli.main import COMMANDS, dispatch, first_screen
from dexsim.console import program
from dexsim.errors import UserError

ROOT = Path(__file__).resolve().parents[1]


def test_every_command_is_there_and_on_the_first_screen():
    for name, command in COMMANDS.items():
        module, _, function = command.where.partition(":")
        assert callable(getattr(importlib.import_module(module), function))
        assert f"\n  {name:<15}{command.about}\n" in first_screen()
    assert all(len(line) <= 120 for line in first_screen().splitlines())


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_help_of_each_command(name, capsys):
    assert dispatch([name, "--help"]) == 0
    said = capsys.readouterr().out
    assert f"dexsim {name}" in said, said.splitlines()[0]
    assert dispatch(["help", name]) == 0 and capsys.readouterr().out == said


def test_what_is_no_command(capsys):
    with pytest.raises(UserError, match="unknown command 'trian': did you mean train"):
        dispatch(["trian"])
    assert dispatch([]) == 2 and capsys.readouterr().out == first_screen()


@pytest.mark.parametrize("job", program.DOORS)
def test_the_scripts_at_the_top_are_doors(job, capsys, monkeypatch):
    """They name themselves in help pages, as `dexsim` names itself."""
    monkeypatch.setattr(sys, "argv", [f"{job}.py", "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(ROOT / f"{job}.py"), run_name="__main__")
    said = capsys.readouterr().out
    assert ended.value.code == 0 and said.startswith(f"usage: python {job}.py ")
    assert f"dexsim {job}" not in said.replace(f"-m dexsim {job}", "")


def test_hints_name_what_was_typed(monkeypatch):
    text = "dexsim train, python play.py, torchrun -m dexsim train, dexsim audit"
    for called, said in (
        ("/home/a/.venv/bin/dexsim", "dexsim train, dexsim play, torchrun -m dexsim train, dexsim audit"),
        ("train.py", "python train.py, python play.py, torchrun -m dexsim train, dexsim audit"),
        (
            "/x/dexsim/__main__.py",
            "python -m dexsim train, python -m dexsim play, torchrun -m dexsim train, dexsim audit",
        ),
    ):
        monkeypatch.setattr(sys, "argv", [called])
        assert program.words(text) == said
    monkeypatch.setattr(sys, "argv", ["train.py"])
    assert program.torchrun("train", 2) == "torchrun --nproc_per_node=2 train.py"


@pytest.mark.slow
def test_the_wheel_holds_what_commands_read(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    for path in (ROOT / "dexsim").rglob("*"):
        if path.is_file() and "__pycache__" not in path.parts:
            assert path.relative_to(ROOT).as_posix() in names
    assert {n.split("/")[0].partition("-")[0] for n in names} == {"dexsim"}


@pytest.mark.slow
def test_from_an_empty_folder(installed, tmp_path):
    where = call(installed, tmp_path, "python", "-c", "import dexsim; print(dexsim.__file__)").strip()
    assert Path(where).is_relative_to(installed.parent), f"{where}: not the wheel"
    package = Path(where).parent
    before = {p for p in package.rglob("*") if "__pycache__" not in p.parts}
    assert call(installed, tmp_path, "dexsim", "--help") == first_screen()
    assert "task=" in call(installed, tmp_path, "dexsim", "train", "--help")

    said = call(installed, tmp_path, "dexsim", "diagnose", "demo=true")
    assert "command_delay" in said and "What was hidden" in said
    assert (tmp_path / "out/demo/report.html").is_file()
    recording = min((tmp_path / "out/demo/recordings").glob("*.mcap"))
    assert "states" in call(installed, tmp_path, "python", "-m", "dexsim", "audit", recording)

    said = call(
        installed,
        tmp_path,
        "dexsim",
        "train",
        "task=grasp",
        "device=cpu",
        "worlds=4",
        "iterations=1",
        "final_episodes=0",
        "run=first",
    )
    assert "play it:  dexsim play checkpoint=runs/grasp/first/policy.pt" in said
    assert yaml.safe_load((tmp_path / "runs/grasp/first/config.yaml").read_text())["worlds"] == 4
    call(
        installed,
        tmp_path,
        "dexsim",
        "play",
        "checkpoint=runs/grasp/first/policy.pt",
        "device=cpu",
        "worlds=2",
        "episodes=2",
        "video=false",
    )
    metrics = json.loads((tmp_path / "runs/grasp/first/play/metrics.json").read_text())
    assert metrics.keys() >= {
        "hold_rate", "hold_rate_pushed", "hold_rate_kept_out_shapes", "force_command_correlation", "episodes"
    }  # fmt: skip
    assert {p.name for p in tmp_path.iterdir()} == {"out", "runs"}
    assert {p for p in package.rglob("*") if "__pycache__" not in p.parts} == before, "a command wrote into the package"


@pytest.mark.slow
def test_uvx_runs_the_wheel(wheel, tmp_path):
    """No installation at all: uv resolves the wheel's own dependencies and fetches them. Two choices are made for it:
    the release of torch that these tests run on, since its newest brings gigabytes of CUDA along, and where pip, too,
    would look for it."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    wanted = [sys.executable, "-m", "pip", "config", "get", "global.find-links"]
    folders = os.environ.get("PIP_FIND_LINKS") or subprocess.run(wanted, capture_output=True, text=True).stdout.strip()
    torch = importlib.metadata.version("torch")
    if folders:
        clean["UV_FIND_LINKS"] = ",".join(folders.split())
    elif torch.endswith("+cpu"):
        clean["UV_TORCH_BACKEND"] = "cpu"
    done = subprocess.run(
        [Path(sysconfig.get_path("scripts")) / "uvx", "--python", sys.executable, "--with", f"torch=={torch}",
         "--from", wheel, "dexsim", "diagnose", "demo=true"],
        cwd=tmp_path, capture_output=True, text=True, timeout=800, env=clean,
    )  # fmt: skip
    assert done.returncode == 0 and "What was hidden" in done.stdout, done.stdout + done.stderr
    assert (tmp_path / "out/demo/report.html").is_file()
