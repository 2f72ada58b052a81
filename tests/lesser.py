"""Another operating system, as far as taking away goes: `python lesser.py SYSTEM`, then commands of dexsim as JSON
lists, a line each, from standard input. It ends with the first status that is not 0.

SYSTEM: win32 (no fork, no SIGHUP, none of the modules and calls of Unix, no symbolic links, no C library without a
name, a select for sockets only, and a signal 0 is Ctrl-C), darwin (no
affinity, no /dev/shm, no count of free pages) or linux. On each a file that is opened without its encoding named is an
error, since what it would be is another on Windows."""

from __future__ import annotations

import ctypes
import importlib
import json
import os
import select
import signal
import sys
import types
import warnings

UNIX = {
    "darwin": ((), ("sched_getaffinity",)),
    "win32": (
        ("fcntl", "resource", "pwd", "grp", "termios", "tty"),
        ("fork", "forkpty", "register_at_fork", "sched_getaffinity", "statvfs", "sysconf", "sysconf_names", "getuid",
         "geteuid", "getpgid", "setsid", "killpg", "uname", "mkfifo", "nice"),
    ),
}  # fmt: skip


def refused(why: str):
    """Return a call that is refused."""

    def call(*_, **__):
        raise OSError(why)

    return call


def become(name: str) -> None:
    """Take away what the system lacks, and let `dexsim.system` know its name."""
    for library in ("imageio_ffmpeg", "matplotlib.figure", "mujoco", "onnxruntime", "rsl_rl.runners", "torch", "warp"):
        importlib.import_module(library)  # as built for this system, in which they look around while they load
    warnings.filterwarnings("error", category=EncodingWarning, module=r"dexsim\b")
    modules, calls = UNIX.get(name, ((), ()))
    for module in modules:
        sys.modules[module] = None
    for call in calls:
        delattr(os, call)
    if name == "darwin":
        os.sysconf_names = {k: v for k, v in os.sysconf_names.items() if k != "SC_AVPHYS_PAGES"}
    if name == "win32":
        del signal.SIGHUP, signal.SIGKILL
        kill = os.kill

        def careful(pid: int, number: int) -> None:
            assert number, "os.kill(pid, 0) sends Ctrl-C there"
            kill(pid, number)

        os.kill = careful
        load = ctypes.CDLL.__init__

        def named(self, name, *rest, **more):
            if name is None:
                raise TypeError("argument of type 'NoneType' is not iterable")
            load(self, name, *rest, **more)

        ctypes.CDLL.__init__ = named
        os.symlink = refused("a required privilege is not held by the client")
        select.select = refused("an operation was attempted on something that is not a socket")
    from dexsim import system

    system.sys = types.SimpleNamespace(platform=name)
    if name == "win32":
        system._lives_on_windows = lambda pid: True
    if name != "linux":
        system.SHARED = system.Path("/no/such/folder")


if __name__ == "__main__":
    become(sys.argv[1])
    from dexsim.cli.main import main

    for line in sys.stdin:
        sys.argv = ["dexsim", *json.loads(line)]
        if status := main(sys.argv[1:]):
            sys.exit(status)
