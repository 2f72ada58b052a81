"""Other operating systems and poorer machines, by switching off what they lack (tests/lesser.py)."""

from __future__ import annotations

import ast
import ctypes
import json
import os
import re
import signal
import subprocess
import sys
import types
from pathlib import Path

import pytest

from dexsim import files, system
from dexsim.console.stop import Stop

ROOT = Path(__file__).resolve().parents[1]
LESSER = Path(__file__).with_name("lesser.py")
ONLY_HERE = (
    "SIGHUP", "sched_getaffinity", "register_at_fork", "sysconf", "statvfs", "fcntl", "osmesa", "/dev/shm", "getppid",
    "os.kill(", "sys.platform", "import resource", "import pwd", "os.fork", "killpg", "setsid", "CDLL", "sys.stdin]",
    "symlink_to(", "/proc/", "os.uname", "os.nice", "setpriority", "mkfifo", "AF_UNIX", "getuid", "posix_",
)  # fmt: skip
"""For one system, or different between them."""


def run(name: str, folder: Path, *commands: list[str]) -> subprocess.CompletedProcess:
    """Return the commands on a lesser system, in a folder."""
    env = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")} | {
        "PYTHONPATH": str(ROOT), "PYTHONWARNDEFAULTENCODING": "1", "PYTHONUTF8": "0", "LC_ALL": "C",
        "PYTHONCOERCECLOCALE": "0", "OMP_NUM_THREADS": "1",
    }  # fmt: skip
    return subprocess.run(
        [sys.executable, LESSER, name], cwd=folder, env=env, input="\n".join(map(json.dumps, commands)), text=True,
        capture_output=True, timeout=600,
    )  # fmt: skip


def code_lines(path: Path):
    """Return the lines of a file that are neither comment nor docstring, roughly: those with a call or an attribute."""
    return [line.split("#")[0] for line in path.read_text("utf-8").splitlines()]


def test_systems_are_named_in_one_file():
    found = [
        f"{path.relative_to(ROOT)}: {word}"
        for path in sorted((ROOT / "dexsim").rglob("*.py"))
        for line in code_lines(path)
        for word in ONLY_HERE
        if word in line and ("(" in line or "import" in line) and '"""' not in line and path.name != "system.py"
    ]
    assert not found, "\n".join(found)


def test_text_is_read_and_written_as_utf_8():
    """What a system takes where nothing is said differs. Of calls with a mode of bytes nothing is asked."""
    found = []
    for path in sorted((ROOT / "dexsim").rglob("*.py")):
        code = path.read_text("utf-8")
        if not re.search(r"open\(|_text\(|text=|universal_newlines", code):
            continue
        for call in (n for n in ast.walk(ast.parse(code)) if isinstance(n, ast.Call)):
            name = getattr(call.func, "attr", getattr(call.func, "id", ""))
            said = [k.arg for k in call.keywords]
            texts = [a.value for a in call.args if isinstance(a, ast.Constant) and isinstance(a.value, str)]
            if name == "open" and (isinstance(call.func, ast.Name) or texts and set(texts[0]) <= set("rwaxb+")):
                plain = "encoding" not in said and not any("b" in t for t in texts)
            elif name in ("read_text", "write_text"):
                plain = "encoding" not in said and not {"utf-8", "ascii"} & set(texts)
            else:
                plain = bool({"text", "universal_newlines"} & set(said)) and "encoding" not in said
            if plain:
                found.append(f"{path.relative_to(ROOT)}:{call.lineno}: {ast.unparse(call)[:80]}")
    assert not found, "\n".join(found)


def test_a_key_ends_a_wait_on_each_system(monkeypatch):
    read, write = os.pipe()
    with os.fdopen(read) as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        assert not system.key_pressed()
        os.write(write, b"\n")
        assert system.key_pressed() and not system.key_pressed()
    os.close(write)
    keys = ["q"]
    monkeypatch.setitem(sys.modules, "msvcrt", types.SimpleNamespace(kbhit=lambda: bool(keys), getwch=keys.pop))
    monkeypatch.setattr(system, "sys", types.SimpleNamespace(platform="win32"))
    assert system.key_pressed() and not system.key_pressed()


@pytest.mark.parametrize("platform, names", [("linux", ("egl", "osmesa")), ("darwin", ("cgl",)), ("win32", ("wgl",))])
def test_each_system_has_its_opengl(monkeypatch, platform, names):
    monkeypatch.setattr(system, "sys", types.SimpleNamespace(platform=platform))
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    assert system.renderers() == names
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    assert system.renderers() == (("osmesa",) if platform == "linux" else names)
    assert ("PYOPENGL_PLATFORM" in system.renderer_environment(names[0])) == (platform == "linux")


def test_a_process_is_asked_for_without_a_signal_on_windows(monkeypatch):
    """Windows' answers, given by a stand-in for its kernel: running, ended, not there, somebody else's."""
    requested = []

    class Kernel:
        def OpenProcess(self, rights, inherit, pid):
            requested.append(pid)
            return pid if pid < 3 else 0

        def GetLastError(self):
            return 5 if requested[-1] == 4 else 87

        def GetExitCodeProcess(self, handle, status):
            status._obj.value = 259 if handle == 1 else 0

        def CloseHandle(self, handle):
            pass

    monkeypatch.setattr(system, "sys", types.SimpleNamespace(platform="win32"))
    monkeypatch.setattr(ctypes, "windll", types.SimpleNamespace(kernel32=Kernel()), raising=False)
    monkeypatch.setattr(os, "kill", lambda *_: pytest.fail("a signal was sent"))
    assert [system.lives(k) for k in (1, 2, 3, 4)] == [True, False, False, True]
    assert files.abandoned(f".a.pt.{files.HOST}.2.tmp") and not files.abandoned(f".a.pt.{files.HOST}.1.tmp")


def test_processes_of_this_system():
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    assert system.lives(os.getpid()) and system.lives(1) and not system.lives(ended.pid)


def test_signals_that_are_there(monkeypatch):
    hangup = signal.SIGHUP
    monkeypatch.delattr(signal, "SIGHUP")
    assert set(system.stop_signals()) == {signal.SIGINT, signal.SIGTERM} and not system.terminal_gone(hangup)
    with Stop() as stop:
        stop.gently = True
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.requested() and stop.status == 143
    monkeypatch.setattr(signal, "SIGBREAK", hangup, raising=False)  # Windows: the window is closed
    with Stop() as stop:
        stop.gently = True
        monkeypatch.setattr("dexsim.console.stop.without_terminal", lambda: None)
        os.kill(os.getpid(), hangup)
        assert stop.requested() and stop.status == 128 + hangup


def test_each_answer_where_what_it_asks_is_taken_away(monkeypatch, tmp_path):
    """No affinity, fork, session, count of pages, /proc, C library or `resource`; on macOS and on Windows."""
    with monkeypatch.context() as less:
        for name in ("sched_getaffinity", "register_at_fork", "setsid", "statvfs", "sysconf_names"):
            less.delattr(os, name)
        less.setitem(sys.modules, "resource", None)
        less.setattr(system, "SHARED", tmp_path / "none")
        less.setattr(system, "Path", lambda *_: tmp_path / "none")
        less.setattr(ctypes, "CDLL", lambda name: ctypes)  # has no malloc_trim
        system._libc.cache_clear()
        assert system.cores() == os.cpu_count() and system.memory() is None and system.shared_memory() is None
        assert system.at_work(os.getpid()) == (False, 0) and system._libc() is None
        for call in (system.give_back, system.leave_terminal, lambda: system.after_fork(pytest.fail)):
            call()
        system.limit(1.0, 1)  # nothing is limited
        requested = []
        less.setattr(os, "kill", lambda pid, number: requested.append(number))
        for platform, how, words in (("win32", signal.SIGTERM, "screen"), ("darwin", signal.SIGINT, "screen"),
                                     ("linux", signal.SIGINT, "apt-get")):  # fmt: skip
            less.setattr(system, "sys", types.SimpleNamespace(platform=platform))
            system.stop(7)
            assert requested.pop() == how and words in system.no_renderer()
            assert system.start_method() == ("fork" if platform == "linux" else "spawn")
        for name in ("SIGHUP", "SIGQUIT", "SIGUSR1", "SIGTSTP", "SIGXCPU", "SIGALRM", "SIGPWR"):
            less.delattr(signal, name)
        assert {signal.SIGINT, signal.SIGTERM} < set(system.hand_signals())
    system._libc.cache_clear()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["win32", "darwin", "linux"])
def test_a_lesser_system_trains_plays_and_diagnoses(name, tmp_path):
    small = ["device=cpu", "worlds=2"]
    done = run(
        name, tmp_path,
        ["train", "task=grasp", *small, "iterations=1", "final_episodes=0", "run=a"],
        ["play", "checkpoint=runs/grasp/a/policy.pt", *small, "episodes=2", f"video={str(name != 'linux').lower()}"],
        ["diagnose", "demo=true"],
        ["audit", "out/demo/recordings/motion_1.mcap"],
        ["excite", "joints=index_joint1", "kinds=steps", "out=excited"],
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-3000:]
    assert (tmp_path / "out/demo/report.html").is_file() and (tmp_path / "excited").is_dir()
    assert ("no video: no OpenGL" in done.stdout) == (name != "linux"), done.stdout  # and the play went on


@pytest.mark.slow
def test_a_container_without_shared_memory(tmp_path):
    """A /dev/shm in which nothing can be made: what processes share goes into the folder of temporary files."""
    script = "mount -t tmpfs -o size=4k none /dev/shm && head -c 4096 /dev/zero > /dev/shm/full && exec \"$@\""
    if subprocess.run(["unshare", "-m", "sh", "-c", script, "x", "true"], capture_output=True).returncode:
        pytest.skip("no mounts of its own here")
    program = "from dexsim import system; print(system.shared_memory())"
    env = os.environ | {"PYTHONPATH": f"{ROOT}:{Path(__file__).parent}"}
    run = ["unshare", "-m", "sh", "-c", script, "x", sys.executable]
    done = subprocess.run([*run, "-c", program], env=env, capture_output=True, text=True)
    assert done.stdout.strip() == "0", done.stderr
    done = subprocess.run(
        [*run, "-m", "dexsim", "deploy", "bundle=" + str(bundle(tmp_path)), "driver=sim", "seconds=2",
         "stale=9", "late=9", "hang=9", "overruns=99999"],
        cwd=tmp_path, env=env, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr


def bundle(folder: Path) -> Path:
    """Return a bundle of the included policy of the grasp."""
    done = subprocess.run(
        [sys.executable, "-m", "dexsim", "export", f"checkpoint={ROOT / 'checkpoints/grasp.pt'}", "out=bundle"],
        cwd=folder, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / "bundle"
