"""The long runs' own parts: what grows is told from what is flat, and each part does its work."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.soak import __main__ as soak
from tests.soak import parts
from tests.soak.watch import COLUMNS, Watch, grows, judge, look

pytestmark = pytest.mark.limits

ROOT = Path(__file__).parents[1]


def rows(leak_mib: float = 0.0, files: int = 0, n: int = 400) -> list[tuple[float, ...]]:
    """Return a run of 200 s whose memory saws by 50 MiB and warms up, and what it loses over the whole of it."""
    rng, t = np.random.default_rng(0), np.arange(n) * 0.5
    heap = 400 + 200 * (1 - np.exp(-t / 5)) + 50 * (t % 3) / 3 + rng.normal(0, 2, n) + leak_mib * t / t[-1]
    opened = 5 + rng.integers(0, 2, n) + np.floor(files * t / t[-1])
    saved = 350 + np.floor(leak_mib * t / t[-1])
    return [(a, h, h + 300, f, 3, float("nan"), m, a / 10) for a, h, f, m in zip(t, heap, opened, saved, strict=True)]


def test_a_leak_is_told_from_what_comes_and_goes():
    found = judge(rows())
    assert grows(found) == [] and abs(found["heap_mib"]["growth"]) < 10 and "gpu_mib" not in found
    assert found["heap_mib"]["low"] <= found["heap_mib"]["growth"] <= found["heap_mib"]["high"]
    leak = judge(rows(leak_mib=60))["heap_mib"]  # 60 MiB in 200 s, and 20 things done
    assert leak["per_hour_low"] < 18 * 60 < leak["per_hour_high"] and abs(leak["per_unit"] - 3.0) < 0.6
    assert grows(judge(rows(leak_mib=60))) == ["heap_mib", "kept_mib"] and grows(judge(rows(files=8))) == ["files"]
    assert judge(rows(n=100)) == {}, "too short to judge"


def test_a_child_is_watched_until_it_ends(tmp_path):
    hold = "import time; f = [open('/dev/null') for _ in range(40)]; x = bytearray(64 << 20); time.sleep(0.8)"
    turns = iter([None, None, *((k, 5.0) for k in range(1000))])
    watch = Watch(subprocess.Popen([sys.executable, "-c", hold]), every=0.05, done=lambda: next(turns),
                  path=tmp_path / "x.csv")  # fmt: skip
    while watch.is_alive() and len(watch.rows) < 3:
        time.sleep(0.01)
    assert "\n0" in (tmp_path / "x.csv").read_text(), "rows are written as they come"
    watch.join()
    seen = np.array(watch.rows)
    written = np.genfromtxt(tmp_path / "x.csv", delimiter=",", names=True)
    assert list(written["done"]) == list(seen[:, 7]) and set(written["kept_mib"]) == {5.0}
    assert np.allclose(written["heap_mib"], seen[:, 1], rtol=1e-4)
    assert len(seen) > 5 and seen[:, 1].max() > 64 and seen[:, 3].max() >= 43 and np.isnan(seen[:, 5]).all()


def test_amounts_are_shared_out():
    made = soak.commands(
        soak.SETTINGS | {"training": "1h", "worlds": "100", "processes": "deploy:4", "diagnoses": "0"}, Path("x")
    )
    assert set(made) == {"training", "deploy0", "deploy1", "deploy2", "deploy3", "envs", "plays"}
    assert "iterations=72" in made["training"]  # 3600 s of 100 worlds, 24 steps of 21 ms each: 71.4
    assert made["deploy2"][2:4] == ["deploy", "6.0"] and made["envs"][2:4] == ["envs", "1000.0"]


def test_how_far_a_part_is_is_known_while_it_runs(tmp_path):
    s = soak.SETTINGS | {"worlds": "100", "training": "1h"}
    assert soak.done(s, tmp_path, "training") is None and soak.done(s, tmp_path, "deploy") is None
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "progress.csv").write_text("iteration,steps,reward\n")
    assert soak.done(s, tmp_path, "training") is None
    (tmp_path / "run" / "progress.csv").write_text("iteration,steps,reward\n1,2400,0.5\n71,170400,0.7\n72,1728")
    worked, saved = soak.done(s, tmp_path, "training")
    assert worked == pytest.approx(71 * 100 * 24 * 0.021 / 3600) and np.isnan(saved)  # 72 is not whole
    (tmp_path / "deploy").mkdir()
    parts.tell(tmp_path / "deploy", 0.25, between=False)
    assert soak.done(s, tmp_path, "deploy")[0] == 0.25 and np.isnan(soak.done(s, tmp_path, "deploy")[1])
    parts.tell(tmp_path / "deploy", 0.5)
    worked, saved = soak.done(s, tmp_path, "deploy")
    assert worked == 0.5 and abs(saved - look(os.getpid())[0]) < 50


LEAKS = """
import sys, time
from pathlib import Path
import numpy as np
from dexsim.system import give_back
from tests.soak import parts
rng, kept = np.random.default_rng(0), []
for k in range(100):
    pieces = [bytearray(int(n)) for n in rng.integers(1000, 300_000, 60)]  # an environment, of some 9 MB
    time.sleep(0.04)
    kept.append(bytearray(int(float(sys.argv[2]) * 2**20)))
    del pieces
    give_back()
    parts.tell(Path(sys.argv[1]), k + 1)
"""


@pytest.mark.slow
@pytest.mark.parametrize("leak_mib", [0.0, 0.5])
def test_a_leak_of_a_piece_of_work_is_found_in_what_the_process_keeps(leak_mib, tmp_path):
    """0.5 MiB of each of 100 pieces: 38 MiB of what is judged. Without a leak, what comes and goes is none."""
    watch = Watch(
        subprocess.Popen([sys.executable, "-c", LEAKS, str(tmp_path), str(leak_mib)], cwd=ROOT),
        every=0.01,
        done=lambda: soak.done(soak.SETTINGS | {"envs": "100"}, tmp_path.parent, tmp_path.name),
    )
    watch.join()
    # since it tells what it keeps: on a busy machine its imports take longer than what is left out as its warming up
    found = judge([row for row in watch.rows if np.isfinite(row[COLUMNS.index("kept_mib")])])
    assert watch.child.wait() == 0 and ("kept_mib" in grows(found)) == bool(leak_mib), found["kept_mib"]
    assert abs(found["kept_mib"]["per_unit"] - leak_mib) < 0.1, found["kept_mib"]


def alive(group: int) -> bool:
    """Return whether a process of a group is left, but for those that wait to be asked how they ended."""
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            state, _, of = stat.read_text().rpartition(") ")[2].split()[:3]
            if int(of) == group and state != "Z":
                return True
    return False


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_it_leaves_no_process_behind_where_it_is_ended(number, tmp_path):
    """One of two parts ends when it is asked, the other ignores it and has a child that does; what came is judged."""
    stubborn = """
import signal, subprocess, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
print("up", flush=True)
time.sleep(60)
"""
    program = f"""
import signal, sys
from pathlib import Path
from tests.soak import __main__ as soak
for n in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
    signal.signal(n, signal.default_int_handler if n == signal.SIGINT else signal.SIG_DFL)
soak.PATIENCE = 0.5
soak.commands = lambda s, out: {{"plays": ["-c", {stubborn!r}], "envs": ["-c", "import time; time.sleep(60)"]}}
popen = soak.subprocess.Popen
def noted(*a, **k):
    child = popen(*a, **k)
    with open({str(tmp_path / "pids")!r}, "a") as file:
        print(child.pid, file=file, flush=True)
    return child
soak.subprocess.Popen = noted
sys.exit(soak.main(["out={tmp_path}"]))
"""
    main = subprocess.Popen([sys.executable, "-c", program], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    pids, log = tmp_path / "pids", tmp_path / "plays.log"
    end = time.monotonic() + 60
    begun = lambda: pids.exists() and len(pids.read_text().split()) == 2 and "up" in log.read_text()  # noqa: E731
    while time.monotonic() < end and not begun():
        time.sleep(0.02)
    groups = [int(x) for x in pids.read_text().split()]
    assert all(map(alive, groups))
    main.send_signal(number)
    said, _ = main.communicate(timeout=60)
    assert main.returncode == 128 + number and said.count("ended early") == 2, said
    assert not any(map(alive, groups)) and len(json.loads((tmp_path / "soak.json").read_text())["parts"]) == 2


@pytest.mark.slow
def test_each_part_does_its_work(tmp_path):
    small = ["training=0.001h", "worlds=2", "deploy=0.002h", "envs=2", "diagnoses=1", "plays=1", f"out={tmp_path}"]
    done = subprocess.run(
        [sys.executable, "-m", "tests.soak", *small], cwd=ROOT, capture_output=True, text=True, timeout=800
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert (
        "2 environments made" in done.stdout and "1 diagnoses" in done.stdout and "0.002 h of the loop" in done.stdout
    )
    assert (tmp_path / "run" / "last.pt").exists() and "1 plays" in done.stdout
    found = json.loads((tmp_path / "soak.json").read_text())["parts"]
    assert {k: v["done"] for k, v in found.items() if k != "training"} == pytest.approx(
        {"deploy": 0.002, "envs": 2, "diagnoses": 1, "plays": 1}, abs=0.002)  # fmt: skip
    assert found["training"]["done"] >= 0.001
