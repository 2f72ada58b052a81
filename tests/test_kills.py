"""A few kills at random moments of each work; `python -m tests.kills` does hundreds."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def kills(*args: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "tests.kills", *args], cwd=ROOT, capture_output=True, text=True, timeout=600
    )


@pytest.mark.slow
def test_recordings_survive():
    done = kills("count=4", "kinds=write", "seed=1")
    assert done.returncode == 0 and '"kills": 4, "lost": 0' in done.stdout, done.stdout + done.stderr


@pytest.mark.slow
def test_what_is_lost_is_told():
    """A writer that does not write beside its place is found out."""
    spoiled = (
        "import sys, contextlib; sys.path.insert(0, '.'); from dexsim import files; from tests import kills;"
        "files.beside = contextlib.contextmanager(lambda path: (yield path)); sys.exit(kills.main(sys.argv[1:]))"
    )
    command = [sys.executable, "-c", spoiled, "count=12", "kinds=write", "seed=1"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 1 and '"lost": 0' not in done.stdout, done.stdout + done.stderr


@pytest.mark.slow
def test_all_kinds_survive():
    done = kills("count=20", "seed=2")
    assert done.returncode == 0 and '"kills": 20, "lost": 0' in done.stdout, done.stdout + done.stderr
