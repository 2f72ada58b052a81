"""Programs as forks of a server that has loaded the large libraries, once for all: an interpreter of its own spends six
seconds of processor time on importing them. dexsim's and the benchmarks' own files are imported anew by each.

For tests that are not about how a program is started from a shell.
"""

from __future__ import annotations

import multiprocessing
import os
import runpy
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload([
    "hydra", "mujoco", "mujoco_warp", "rosbags.typesys", "rsl_rl.models", "rsl_rl.runners", "scipy.optimize",
    "scipy.signal", "scipy.spatial", "scipy.stats", "tensordict", "torch.distributed.run", "trimesh", "warp",
])  # fmt: skip
"""It begins with the first program, and ends with the tests."""


class Forked:
    """`work(*arguments)` in a process, in the folder `cwd`, with `env` beside the environment: as `subprocess.Popen`
    with pipes and text=True. It leads a session of its own."""

    def __init__(
        self, work: Callable[..., Any], *arguments: object, cwd: Path = ROOT, env: dict[str, str] | None = None
    ) -> None:
        self._folder = tempfile.TemporaryDirectory()
        self._texts = [Path(self._folder.name, name) for name in ("out", "err")]
        env = dict(os.environ) | (env or {})
        self._process = SERVER.Process(target=_child, args=(work, arguments, str(cwd), env, self._texts))
        self._process.start()
        self.pid = self._process.pid

    def poll(self) -> int | None:
        return self._process.exitcode

    @property
    def returncode(self) -> int | None:
        return self._process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        """Return its status. Raises TimeoutExpired after `timeout` s."""
        self._process.join(timeout)
        if self._process.exitcode is None:
            raise subprocess.TimeoutExpired(str(self._process), timeout)
        return self._process.exitcode

    def terminate(self) -> None:
        self._process.terminate()

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        """Return what it printed. Raises TimeoutExpired after `timeout` s."""
        self.wait(timeout)
        out, err = (path.read_text() if path.exists() else "" for path in self._texts)
        return out, err


def run(module: str, *arguments: str, timeout: float = 600.0) -> subprocess.CompletedProcess[str]:
    """Return `python -m module arguments` in the repository's folder. Raises TimeoutExpired after `timeout` s."""
    program = Forked(_program, module, arguments)
    try:
        out, err = program.communicate(timeout)
    except subprocess.TimeoutExpired:
        os.killpg(program.pid, 9)
        raise
    return subprocess.CompletedProcess([module, *arguments], program.returncode, out, err)


def script(path: str, *arguments: str) -> None:
    """Run `python path arguments`; for `Forked`."""
    sys.argv = [path, *arguments]
    runpy.run_path(path, run_name="__main__")


def _program(module: str, arguments: tuple[str, ...]) -> None:
    sys.argv = [module, *arguments]
    sys.path.insert(0, os.getcwd())
    runpy.run_module(module, run_name="__main__", alter_sys=True)


def _child(work: Callable[..., Any], arguments: tuple, cwd: str, env: dict[str, str], texts: list[Path]) -> None:
    """Work in the process: multiprocessing prints an error that ends it, and knows what SystemExit means."""
    os.setsid()
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(env)
    for number, path in enumerate(texts, 1):
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(file, number)
        os.close(file)
    work(*arguments)
