"""`python -m MODULE ARGUMENTS` in a fork of this process, which has the large libraries loaded: a new interpreter would
spend seconds on importing them. dexsim's and the benchmarks' own files are imported anew."""

from __future__ import annotations

import os
import runpy
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path

# for what they load
import mujoco_warp  # noqa: F401
import rosbags.typesys  # noqa: F401
import scipy.optimize  # noqa: F401
import scipy.signal  # noqa: F401
import scipy.stats  # noqa: F401
import trimesh  # noqa: F401

import dexsim.cli.play
import dexsim.cli.train  # noqa: F401

ROOT = Path(__file__).parents[1]


def run(module: str, *arguments: str, timeout: float = 120.0) -> subprocess.CompletedProcess[str]:
    """Its status and what it printed. Raises TimeoutExpired after `timeout` s."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        sys.stdout.flush(), sys.stderr.flush()
        pid = os.fork()
        if pid == 0:
            os._exit(_child(module, arguments, out.fileno(), err.fileno()))
        end = time.monotonic() + timeout
        while (done := os.waitpid(pid, os.WNOHANG))[0] == 0:
            if time.monotonic() > end:
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
                raise subprocess.TimeoutExpired(module, timeout)
            time.sleep(0.005)
        texts = []
        for file in (out, err):
            file.seek(0)
            texts.append(file.read().decode())
    return subprocess.CompletedProcess([module, *arguments], os.waitstatus_to_exitcode(done[1]), *texts)


def _child(module: str, arguments: tuple[str, ...], out: int, err: int) -> int:
    """Runs the module as a program; its exit status."""
    os.dup2(out, 1), os.dup2(err, 2)
    sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
    status = 0
    try:
        os.chdir(ROOT)
        for name in [n for n in sys.modules if n.partition(".")[0] in ("dexsim", "benchmarks")]:
            del sys.modules[name]
        sys.argv = [module, *arguments]
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as ending:
        if isinstance(ending.code, str):
            print(ending.code, file=sys.stderr)
        status = ending.code if isinstance(ending.code, int) else int(ending.code is not None)
    except BaseException:
        traceback.print_exc()
        status = 1
    finally:
        sys.stdout.flush(), sys.stderr.flush()
    return status
