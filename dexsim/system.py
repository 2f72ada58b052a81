"""Operating systems and containers: where they differ, in one place. All of dexsim asks here and names none itself.

Looked up at each call, so that a test can take away what a system lacks.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import signal
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

RENDERERS = {"linux": ("egl", "osmesa"), "darwin": ("cgl",), "win32": ("wgl",)}
"""OpenGL that MuJoCo can open without a window, by `sys.platform`; Linux: a GPU's or Mesa's, then a CPU's."""
INSTALL = "sudo apt-get install libegl1 libosmesa6, or the like of your system"
SHARED = Path("/dev/shm")
_STILL_ACTIVE, _QUERY = 259, 0x1000  # Windows: GetExitCodeProcess, PROCESS_QUERY_LIMITED_INFORMATION
OUT_OF_TIME = (24, 9)  # SIGXCPU, and SIGKILL where that was not enough
_CRASHES = (-6, -11, 0xC0000005, 0xC0000409)  # SIGABRT, SIGSEGV; Windows: access violation, abort


def stop_signals() -> dict[int, str]:
    """Return signals that ask a program to end, with their names: Ctrl-C, SIGTERM, and a terminal that closes (SIGHUP;
    on Windows SIGBREAK). A SIGHUP that is ignored already (nohup) is left out."""
    found = {int(signal.SIGINT): "Ctrl-C", int(signal.SIGTERM): "SIGTERM"}
    for name in ("SIGHUP", "SIGBREAK"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) != signal.SIG_IGN:
            found[int(number)] = name
    return found


def hand_signals() -> dict[int, str]:
    """Return all signals that end or halt a program and that it can handle, with their names: each lets go of a
    hand."""
    names = "QUIT USR1 USR2 XCPU TSTP TTIN TTOU ALRM VTALRM PROF IO PWR".split()
    found = {getattr(signal, f"SIG{name}", None): f"SIG{name}" for name in names}
    found |= {getattr(signal, "SIGTSTP", None): "Ctrl-Z", getattr(signal, "SIGQUIT", None): "SIGQUIT (Ctrl-\\)"}
    return stop_signals() | {int(number): name for number, name in found.items() if number is not None}


def leave_terminal() -> None:
    """Take this process out of the reach of the terminal's keys."""
    if hasattr(os, "setsid"):
        os.setsid()


def terminal_gone(number: int) -> bool:
    """Return whether a signal says that nobody reads what is printed any more."""
    return number in (getattr(signal, "SIGHUP", None), getattr(signal, "SIGBREAK", None))


def key_pressed() -> bool:
    """Return whether a line waits at the terminal (on Windows: a key), and take it away."""
    if sys.platform == "win32":  # its select knows sockets only
        import msvcrt

        return bool(msvcrt.kbhit() and msvcrt.getwch())
    return bool(select.select([sys.stdin], [], [], 0)[0] and sys.stdin.readline())


def parent() -> int:
    """Return the process that began this one; another once that has ended."""
    return os.getppid()


def lives(pid: int) -> bool:
    """Return whether there is a process of this number on this machine."""
    if sys.platform == "win32":  # os.kill(pid, 0) is Ctrl-C there
        return _lives_on_windows(pid)
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
    return True


def _lives_on_windows(pid: int) -> bool:
    kernel = ctypes.windll.kernel32  # type: ignore[attr-defined]  # not of Linux
    handle = kernel.OpenProcess(_QUERY, False, pid)
    if not handle:
        return bool(kernel.GetLastError() == 5)  # access denied: somebody else's
    status = ctypes.c_ulong()
    kernel.GetExitCodeProcess(handle, ctypes.byref(status))
    kernel.CloseHandle(handle)
    return status.value == _STILL_ACTIVE


def stop(pid: int) -> None:
    """Ask a process to end as Ctrl-C does; on Windows, which cannot, end it. One that is gone is no error."""
    with contextlib.suppress(OSError):
        os.kill(pid, signal.SIGTERM if sys.platform == "win32" else signal.SIGINT)


def cores() -> int:
    """Return cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def memory() -> tuple[int, int] | None:
    """Free and total bytes of memory, None where the system does not tell (macOS, Windows)."""
    if "SC_AVPHYS_PAGES" not in getattr(os, "sysconf_names", ()):
        return None
    page = os.sysconf("SC_PAGE_SIZE")
    return os.sysconf("SC_AVPHYS_PAGES") * page, os.sysconf("SC_PHYS_PAGES") * page


@cache
def _libc() -> ctypes.CDLL | None:
    """Return GNU's C library, which alone keeps freed memory so; None elsewhere."""
    try:
        found = ctypes.CDLL(None)
        found.malloc_trim.argtypes, found.malloc_trim.restype = [ctypes.c_size_t], ctypes.c_int
    except (OSError, AttributeError, TypeError):  # other C libraries; Windows knows no library without a name
        return None
    return found


def give_back() -> None:
    """Give the C library's free pages, of all its arenas, back to the system, in some milliseconds.

    It keeps what is freed between two pieces that are still in use: of environments made and closed one after the other
    some 40 MB, at places that change with their sizes, so that memory seems to grow although as much as before is in
    use."""
    libc = _libc()
    if libc is not None:
        libc.malloc_trim(0)


def shared_memory() -> int | None:
    """Return bytes that are free in /dev/shm, which GPUs of one machine talk through; None where there is none."""
    try:
        about = os.statvfs(SHARED)
    except (AttributeError, OSError):  # Windows; macOS, some containers
        return None
    return about.f_bavail * about.f_frsize


def after_fork(forget: Callable[[], None]) -> None:
    """Call `forget` in every process that is a fork of this one; Windows has none."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=forget)


def renderers() -> tuple[str, ...]:
    """Return offscreen OpenGL to try in turn; only the one that MUJOCO_GL asks for, where this system knows it."""
    known = RENDERERS.get(sys.platform, RENDERERS["linux"])
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    return (wanted,) if wanted in known else known


def renderer_environment(name: str) -> dict[str, str]:
    """Return environment of a process that renders by one of :func:`renderers`."""
    return {"MUJOCO_GL": name} | ({"PYOPENGL_PLATFORM": name} if name in RENDERERS["linux"] else {})


def renderer() -> str | None:
    """Return the first of :func:`renderers` that opens, None where none does: each is tried in a process of its own,
    since a driver may crash."""
    probe = "import mujoco; c = mujoco.GLContext(8, 8); c.make_current()"
    for name in renderers():
        env = os.environ | renderer_environment(name)
        if subprocess.run([sys.executable, "-c", probe], env=env, capture_output=True, timeout=60).returncode == 0:
            return name
    return None


def no_renderer() -> str:
    """Say how to get an offscreen OpenGL here."""
    if sys.platform in ("darwin", "win32"):
        return "it needs a session with a screen (not ssh), or a driver of the graphics card"
    return f"install one: {INSTALL}"


def start_method() -> str:
    """Return how a process is begun that works for this one: as a fork of it where that is safe."""
    return "fork" if sys.platform == "linux" else "spawn"


def limit(seconds: float, more: int) -> None:
    """Limit this process to so much processor time [s] and so many bytes more than it has, where the system can."""
    try:
        import resource
    except ImportError:  # Windows
        return
    whole = max(1, round(seconds))
    try:
        has = int(Path("/proc/self/statm").read_text("ascii").split()[5]) * resource.getpagesize()
    except OSError:
        has = 0
    for name, soft, hard in (("CORE", 0, 0), ("CPU", whole, whole + 1), ("DATA", has + more, has + more)):
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(getattr(resource, f"RLIMIT_{name}"), (soft, hard))


def at_work(pid: int) -> tuple[bool, int]:
    """Return (whether a process sleeps, what processor time it has used), where the system tells."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text("utf-8", "replace").rpartition(")")[2].split()
    except OSError:
        return False, 0
    return fields[0] == "S", int(fields[11]) + int(fields[12])


def crashed(status: int) -> bool:
    """Return whether an exit status says that a process was brought down by its driver."""
    return status in _CRASHES
