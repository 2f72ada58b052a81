"""The process in which files of strangers are read: what it answers, and what ends it."""

from __future__ import annotations

import ctypes
import gc
import os
import signal
import socket
import threading
import time

import numpy as np
import pytest

from dexsim import files, guard, model_file
from dexsim.errors import UserError

pytestmark = pytest.mark.limits


def _arrays(n):
    return {"a": np.arange(n), "none": np.zeros(0), "text": "x"}


def _raise(error):
    raise error


def _deep():
    return _deep()


def _spin():
    while True:
        pass


ENDS = {
    "a fault of the library": (lambda: os.kill(os.getpid(), signal.SIGSEGV), "breaks the library.*SIGSEGV"),
    "its end": (lambda: os._exit(3), "breaks the library.*exit status 3"),
    "memory": (lambda: np.ones(1 << 28), "needs more than 1 GiB of memory.*DEXSIM_LIMITS=10"),
    "processor time": (_spin, "takes more than"),
    "depth": (_deep, "nested too deeply"),
    "any error": (lambda: _raise(KeyError("x")), r"cannot be read \(KeyError: 'x'\)"),
    "an error of ours": (lambda: _raise(UserError("file x: field y: 3")), "^file x: field y: 3$"),
    "an end of Python": (lambda: _raise(SystemExit(4)), "cannot be read"),
}


@pytest.mark.parametrize("kind", ENDS)
def test_whatever_ends_a_reader_is_one_line(kind, monkeypatch, capfd):
    monkeypatch.setattr(guard, "SECONDS", 1.0)
    function, said = ENDS[kind]
    with pytest.raises(UserError, match=said) as error:
        guard.call(function, what="file x")
    assert str(error.value).startswith("file x") and "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


def test_an_answer_comes_back_whole():
    out = guard.call(_arrays, 300_000, what="file x")
    assert (out["a"] == np.arange(300_000)).all() and out["a"].flags.writeable
    assert out["none"].shape == (0,) and out["text"] == "x"
    guard.call(_arrays, 10, what="file x", wanted=False)


def test_only_regular_files_are_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    there = socket.socket(socket.AF_UNIX)
    there.bind(str(tmp_path / "socket"))
    for name in ("pipe", "socket", "/dev/zero"):
        begun = time.monotonic()
        with pytest.raises(UserError, match="a device, a pipe or a socket"):
            guard.call(lambda name=name: open(tmp_path / name).read(), what="file x")
        assert time.monotonic() - begun < 5
    there.close()


def _opened_by_c(path):
    return ctypes.CDLL(None).open(path.encode(), os.O_RDONLY)


def test_a_library_that_waits_for_a_pipe_is_ended(tmp_path, monkeypatch):
    """As C code opens one: no hook of Python's sees it."""
    monkeypatch.setattr(guard, "WAITING_S", 0.5)
    monkeypatch.setattr(threading, "active_count", lambda: 1)  # whatever other tests have begun
    os.mkfifo(tmp_path / "pipe")
    begun = time.monotonic()
    with pytest.raises(UserError, match="^file x: names a pipe"):
        guard.call(_opened_by_c, str(tmp_path / "pipe"), what="file x")
    assert time.monotonic() - begun < 3, "not tried again in a new process, as a lock is"


def test_a_process_begun_anew_works_in_the_folder_of_now(tmp_path, monkeypatch):
    """Its own would be that in which the program began."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(guard.system, "start_method", lambda: "spawn")
    assert guard.call(os.getcwd, what="file x") == str(tmp_path)


def test_the_holes_of_a_sparse_file_give_no_limits(tmp_path):
    path = tmp_path / "sparse"
    path.write_bytes(b"x")
    os.truncate(path, 1 << 40)
    assert files.check(path, "file", 1 << 41) < 1 << 20
    (tmp_path / "m.xml").write_text('<mujoco><include file="sparse"/><asset><mesh file="big.xml"/></asset></mujoco>')
    (tmp_path / "big.xml").symlink_to(path)
    assert model_file.weight(tmp_path / "m.xml") < 1 << 20
    path.write_bytes(bytes(3000))
    assert files.check(path, "file") == 3000


def test_limits_grow_with_the_file_and_where_it_is_trusted(monkeypatch):
    monkeypatch.setattr(guard, "BYTES", 16 << 20)
    with pytest.raises(UserError, match="needs more than 0.0156 GiB"):
        guard.call(np.ones, 1 << 27, what="file x")  # more than any process has free of its own
    assert len(guard.call(np.ones, 1 << 22, what="file x", size=10 << 20)) == 1 << 22
    monkeypatch.setenv(guard.TRUSTED, "10")
    assert len(guard.call(np.ones, 1 << 22, what="file x")) == 1 << 22
    monkeypatch.setenv(guard.TRUSTED, "0.5")
    with pytest.raises(UserError, match="DEXSIM_LIMITS=0.5"):
        guard.call(np.ones, 1, what="file x")


LOCK = threading.Lock()


def _under_the_lock(x):
    with LOCK:
        return x + 1


@pytest.mark.slow
def test_a_lock_that_a_thread_held_at_the_fork_is_no_pipe():
    """A fork copies a held lock, and nobody there lets go of it."""
    free = threading.Event()

    def hold():
        with LOCK:
            free.wait(30)

    holder = threading.Thread(target=hold, daemon=True)
    holder.start()
    try:
        assert guard.call(_under_the_lock, 1, what="file x") == 2
    finally:
        free.set()
        holder.join()


class _Ends:
    """Leaves a file behind when it is collected."""

    def __init__(self, mark):
        self.me, self.mark = self, mark

    def __del__(self):
        self.mark.touch()


def test_a_fork_collects_nothing_of_the_program(tmp_path):
    """What a program no longer needs may end a thread, a server or a folder, which are the program's to end."""
    gc.disable()
    try:
        _Ends(tmp_path / "ended")
        guard.call(gc.collect, what="file x")
        assert not (tmp_path / "ended").exists()
    finally:
        gc.enable()
    gc.collect()
    assert (tmp_path / "ended").exists()
