"""Every benchmark says what it does and which settings it has, without running."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import forked
import pytest

ROOT = Path(__file__).parents[1]
COMMANDS = sorted(
    {p.stem for p in (ROOT / "benchmarks").glob("*.py") if "__main__" in p.read_text(encoding="utf-8")}
    | {p.parent.name for p in (ROOT / "benchmarks").glob("*/__main__.py")}
)


def test_commands_are_found():
    assert {"step", "learning", "planted", "concealed", "loop", "real"} <= set(COMMANDS)


def ends_well(done, name):
    assert done.returncode == 0, done.stderr
    assert f"benchmarks.{name}" in done.stdout
    assert "train.py [key=value" not in done.stdout  # its own, not that of the command behind it


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_help_names_the_command_and_ends_well(name):
    ends_well(forked.run(f"benchmarks.{name}", "--help"), name)


@pytest.mark.slow
def test_help_from_a_shell():
    command = [sys.executable, "-m", "benchmarks.planted", "--help"]
    ends_well(subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120), "planted")


@pytest.mark.slow
@pytest.mark.parametrize("module", ["benchmarks.loop.worlds", "dexsim.tasks.reality"])
def test_help_of_what_writes_files(module):
    done = forked.run(module, "--help")
    assert done.returncode == 0 and module in done.stdout, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "setting", "said"),
    [
        ("planted", "case=3", "error: 'case=3' is not a setting"),
        ("concealed", "case=3", "error: 'case=3' is not a setting"),
        ("step", "steps=none", "error: steps=none"),
    ],
)
def test_a_wrong_setting_is_one_line_and_status_2(name, setting, said):
    done = forked.run(f"benchmarks.{name}", setting)
    assert done.returncode == 2
    assert done.stderr.strip().startswith(said) and len(done.stderr.strip().splitlines()) == 1
