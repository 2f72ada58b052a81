"""A few kills at random moments of each work; `python -m tests.kills` does hundreds."""

from __future__ import annotations

import contextlib
import sys

import forked
import pytest


def kills(*args: str):
    return forked.run("tests.kills", *args)


@pytest.mark.slow
def test_recordings_survive():
    done = kills("count=4", "kinds=write", "seed=1")
    assert done.returncode == 0 and '"kills": 4, "lost": 0' in done.stdout, done.stdout + done.stderr


def spoiled(*args: str) -> None:
    """Run with a writer that does not write beside its place."""
    from dexsim import files
    from tests import kills

    files.beside = contextlib.contextmanager(lambda path: (yield path))
    sys.exit(kills.main(list(args)))


@pytest.mark.slow
def test_what_is_lost_is_told():
    program = forked.Forked(spoiled, "count=12", "kinds=write", "seed=1")
    out, err = program.communicate(600)
    assert program.returncode == 1 and '"lost": 0' not in out, out + err


@pytest.mark.slow
def test_all_kinds_survive():
    done = kills("count=20", "seed=2")
    assert done.returncode == 0 and '"kills": 20, "lost": 0' in done.stdout, done.stdout + done.stderr
