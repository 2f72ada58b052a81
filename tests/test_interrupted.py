"""Starts at the same time, kills and signals: no shared folders, no files left behind, what was learned or recorded is
kept."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
import time
from pathlib import Path

import dummy_task
import pytest
import shell
import yaml

from dexsim import files
from dexsim.cli import folder
from dexsim.console import stop as stops
from dexsim.console.stop import Stop
from dexsim.errors import UserError
from dexsim.learning import checkpoint
from dexsim.view import plots

STARTS = 12
QUICK = (
    "task=dummy",
    "device=cpu",
    "worlds=4",
    "final_episodes=0",
    "agent.actor.hidden_dims=[8]",
    "agent.critic.hidden_dims=[8]",
)


@pytest.fixture
def place(tmp_path, monkeypatch):
    """An empty working directory, in which no curves are drawn: that takes longer than such a training."""
    monkeypatch.setattr(plots, "curves", lambda columns, path, title: path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def configs(tmp_path):
    return shell.configs(tmp_path)


def start(cfg, barrier, answers):
    barrier.wait()
    try:
        answers.put(str(folder.for_run(cfg)))
    except UserError as error:
        answers.put(f"error: {error}")


def at_once(**cfg) -> list[str]:
    """Return what STARTS processes that start together are given."""
    fork = multiprocessing.get_context("fork")
    barrier, answers = fork.Barrier(STARTS), fork.Queue()
    cfg = {"out": None, "run": None, "choices": {"task": "dummy"}} | cfg
    processes = [fork.Process(target=start, args=(cfg, barrier, answers)) for _ in range(STARTS)]
    for p in processes:
        p.start()
    found = [answers.get(timeout=60) for _ in processes]
    for p in processes:
        p.join()
    return found


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_starts_at_once_share_no_folder(place):
    found = at_once()
    assert len(set(found)) == STARTS and not [x for x in found if "error" in x]
    for setting in ({"run": "a"}, {"out": "b"}):
        found = at_once(**setting)
        got = [x for x in found if not x.startswith("error")]
        assert len(got) == 1 and all(
            "already holds a run" in x or "taken by another" in x for x in found if x not in got
        ), found
    assert not list(place.rglob("*.tmp"))


def killed_inside_a_write(path: Path) -> None:
    child = os.fork()
    if child == 0:
        checkpoint.os.fsync = lambda _: os.kill(os.getpid(), signal.SIGKILL)
        checkpoint.write(path, bytes(100_000))
    os.waitpid(child, 0)


def test_what_killed_runs_left_is_removed_at_the_next_start(place, capsys):
    run = Path("runs/dummy/old")
    run.mkdir(parents=True)
    (run / "last.pt").write_bytes(b"whole")
    for _ in range(3):
        killed_inside_a_write(run / "last.pt")
    assert len(list(run.glob(".*.tmp"))) == 3 and (run / "last.pt").read_bytes() == b"whole"
    keep = [
        run / f".last.pt.{files.HOST}.{os.getpid()}.tmp",
        run / ".last.pt.another-machine.1.tmp",
        run / "mine.tmp",
        run / ".notes.tmp",
    ]
    for path in keep:
        path.write_bytes(b"x")
    gone = run / ".model_10.pt.another-machine.2.tmp"
    gone.write_bytes(b"x")
    os.utime(gone, (time.time() - 2 * 86400,) * 2)
    folder.for_run({"out": None, "run": None, "choices": {"task": "dummy"}})
    assert sorted(run.glob("*.tmp")) == sorted(keep) and (run / "last.pt").exists()
    assert "tidied   4 unfinished file(s) of killed runs, 0.3 MiB" in capsys.readouterr().out


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGTERM, signal.SIGINT])
def test_a_signal_in_training_saves_and_says_how_to_go_on(place, configs, monkeypatch, capfd, number):
    step, count = dummy_task.DummyEnv.step, []

    def hit(self, actions):
        count.append(1)
        if len(count) == 60:
            os.kill(os.getpid(), number)
        return step(self, actions)

    monkeypatch.setattr(dummy_task.DummyEnv, "step", hit)
    assert shell.call("train", configs, *QUICK, "iterations=1000", "run=a") == 128 + number
    out = capfd.readouterr().out
    assert "stopped after 2 iterations" in out and "resume=runs/dummy/a/last.pt" in out
    assert checkpoint.load("runs/dummy/a/last.pt")["iteration"] == 2
    assert yaml.safe_load(Path("runs/dummy/a/config.yaml").read_text())["task"]["name"] == "dummy"


def test_nohup_is_left_alone():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Stop() as stop:
            stop.gently = True
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stop.requested() and signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_terminal_that_is_gone_keeps_nothing_from_being_saved(monkeypatch):
    class Gone:
        def write(self, text):
            raise OSError(5, "Input/output error")

    sent = []
    monkeypatch.setattr(stops.os, "dup2", lambda a, b: sent.append(b))
    monkeypatch.setattr(sys, "stdout", Gone())
    stops.without_terminal()
    assert sent == [1]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_a_signal_in_play_keeps_what_was_recorded(place, configs, monkeypatch, capfd, number):
    from dexsim.cli import play
    from dexsim.recording import tap

    saved = []

    class Tap:
        claim = staticmethod(lambda path: None)

        def __init__(self, *_):
            pass

        def save(self, path, *_):
            os.kill(os.getpid(), number)  # a second one, in the middle of it
            saved.append(path)
            return [Path(path)]

    monkeypatch.setattr(tap, "PlayRecorder", Tap)
    monkeypatch.setattr(play, "replay", lambda *_: os.kill(os.getpid(), number))
    code = shell.call(
        "play", configs, "policy=zero", "task=dummy", "device=cpu", "record=x.mcap", f"out={place / 'out'}"
    )
    assert code == 128 + number and saved == ["x.mcap"] and "mcap     x.mcap" in capfd.readouterr().out


def test_the_python_api_trains_in_the_folder_that_it_claimed(place, monkeypatch):
    """`dexsim.train` claims the folder before the run does: once, not twice."""
    import dexsim
    from dexsim.cli import train as training

    ran = []
    monkeypatch.setattr(training, "_run", lambda start, make_env, ranks, stop, where, open_: ran.append(where) or 0)
    where = dexsim.train(worlds=2, iterations=1, device="cpu", out=place / "mine")
    assert ran == [where] == [place / "mine"]
    with pytest.raises(UserError, match="already holds a run"):
        dexsim.train(worlds=2, iterations=1, device="cpu", out=place / "mine")


def test_a_closed_environment_gives_everything_back_at_once():
    """Without Python's search for circles: the engine is gone, and so are its threads, of each of several."""
    import gc
    import weakref

    import torch
    from worlds import grasp_env

    def threads():
        return len(os.listdir("/proc/self/task"))

    gc.collect()
    gc.disable()
    try:
        counts = []
        for _ in range(3):
            env = grasp_env("sim.threads=2", worlds=2)
            env.step(torch.zeros(2, 12))
            held = [weakref.ref(x) for x in (env.engine, env.servo, env.touch, env.objects, env.engine.t.qpos)]
            env.close()
            env.close()
            assert [ref() for ref in held] == [None] * len(held)
            counts.append(threads())
        assert counts[0] == counts[1] == counts[2], counts
    finally:
        gc.enable()


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="of GNU's C library")
def test_a_closed_environment_leaves_no_free_pages_behind():
    """What the C library could still give back after `close` is little; without it, it keeps some 40 MiB."""
    import torch
    from worlds import grasp_env

    def heap() -> float:
        status = Path("/proc/self/status").read_text()
        return float(status.split("RssAnon:")[1].split()[0]) / 1024  # kB

    for worlds in (24, 3, 16):
        env = grasp_env("sim.threads=2", worlds=worlds)
        env.step(torch.zeros(worlds, 12))
        env.close()
    after = heap()
    ctypes.CDLL(None).malloc_trim(0)
    assert after - heap() < 5.0, f"{after - heap():.1f} MiB could still be given back"
