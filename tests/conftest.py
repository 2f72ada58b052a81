"""Settings of every test."""

from __future__ import annotations

import gc
import os
import shutil
import signal
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from dexsim import guard

for threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(threads, "1")
"""Before NumPy and torch are loaded, here and in programs that tests start. Their threads wait for each other by
spinning: where other work shares the cores, products of small matrices take ten times as long with two threads as with
one."""


def pytest_configure(config) -> None:
    """Let programs that tests start be interrupted and hung up, also where the tests themselves run in the background
    of a shell without job control, or under nohup, which has SIGINT or SIGHUP ignored for them."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in (signal.SIGHUP, signal.SIGTERM):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)


LONGEST = [f"test_{name}.py" for name in ("reproduce", "wheel", "ranks", "resume", "soak", "benchmarks")]


def pytest_collection_modifyitems(items) -> None:
    """Put files with tests of half a minute and more first: a worker that has done its own takes over the last of
    another's, and they should be short ones."""
    items.sort(key=lambda item: item.path.name not in LONGEST)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item) -> None:
    """Let quick tests that are not of the limits on strangers' files (mark `limits`) read them in their own process:
    each reader would be a fork of it, which takes longer than most of these tests."""
    guard.inside = not {mark.name for mark in item.iter_markers()} & {"limits", "slow"}


def pytest_collection(session) -> None:
    """Collect no garbage until all is loaded: there is none among it."""
    gc.disable()


def pytest_collection_finish(session) -> None:
    """Freeze what is loaded by now (torch, Warp, MuJoCo, some million objects) until the end: looking through it for
    garbage again and again took a tenth of all tests' processor time. A deployment's loop thaws what it froze, and
    would thaw this too."""
    gc.enable()
    gc.collect()
    gc.freeze()
    gc.unfreeze = lambda: None


ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def wheel(tmp_path_factory) -> Path:
    """Return the wheel, built from a copy so that nothing is left in the repository."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    shutil.copytree(ROOT / "dexsim", source / "dexsim", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "checkpoints", source / "checkpoints")
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-deps",
        "--no-index",
        "--no-build-isolation",
        "--wheel-dir",
        out,
        source,
    ]
    subprocess.run(command, check=True)
    (made,) = out.glob("dexsim-*.whl")
    return made


@pytest.fixture(scope="session")
def installed(wheel, tmp_path_factory) -> Path:
    """Return the `bin` folder of a fresh environment with this wheel, and the dependencies of the one that runs the
    tests."""
    home = tmp_path_factory.mktemp("fresh")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", home], check=True)
    python = home / "bin" / "python"
    subprocess.run(
        [sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", "--no-index", wheel],
        check=True,
    )
    ask = [python, "-c", "import sysconfig; print(sysconfig.get_paths()['purelib'])"]
    own = Path(subprocess.run(ask, check=True, capture_output=True, text=True).stdout.strip())
    theirs = sorted({sysconfig.get_paths()[k] for k in ("purelib", "platlib")})
    # their .pth files, this checkout among them, are not read
    (own / "dependencies.pth").write_text("\n".join(theirs) + "\n")
    return home / "bin"
