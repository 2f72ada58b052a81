"""Sweeps: Hydra expands the lists, each job is the script in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
import shell

from dexsim.cli import sweep
from dexsim.errors import UserError
from dexsim.paths import CONFIGS

STUB = """import sys, pathlib
out = pathlib.Path(next(a for a in sys.argv if a.startswith("out="))[4:])
(out / "argv.txt").write_text("\\n".join(sys.argv[1:]))
(out / "progress.csv").write_text("iteration,step_reward\\n1,0.5\\n2,1.5\\n")
sys.exit(3 if "seed=2" in sys.argv else 0)
"""


@pytest.fixture
def script(tmp_path):
    path = tmp_path / "stub.py"
    path.write_text(STUB)
    return path


@pytest.mark.slow
def test_every_combination_runs_once_in_its_own_folder(script, tmp_path, capfd):
    argv = ["--multirun", "task=grasp", "servo=xhand,ideal", "seed=1,3", "iterations=7", f"sweep={tmp_path / 's'}"]
    assert sweep.run(argv, CONFIGS, [sys.executable, str(script)]) == 0
    runs = {p.parent.name: set(p.read_text().split("\n")) for p in (tmp_path / "s").glob("*/argv.txt")}
    assert set(runs) == {"0", "1", "2", "3"}
    assert {tuple(sorted(x for x in r if x[:5] in ("servo", "seed="))) for r in runs.values()} == {
        (f"seed={k}", f"servo={name}") for k in (1, 3) for name in ("xhand", "ideal")}
    assert all({"task=grasp", "iterations=7", f"out={tmp_path / 's' / name}"} <= r for name, r in runs.items())
    out = capfd.readouterr().out
    table = out[out.index("\nsweep "):]
    # what is common is not repeated
    assert "servo=ideal seed=3" in table and "iterations=7" not in table and "1" in table


@pytest.mark.slow
def test_a_task_of_ones_own_is_swept_over_what_it_declares(script, tmp_path, monkeypatch):
    (tmp_path / "mine_swept.py").write_text(
        "from dexsim.tasks import Task, reward\n\n\nclass Mine(Task):\n    @reward\n    def one(self):\n"
        "        return self.age\n"
    )
    monkeypatch.chdir(tmp_path)
    argv = ["-m", "task=mine_swept:Mine", "task.rewards.one=1,2"]
    assert sweep.run(argv, CONFIGS, [sys.executable, str(script)]) == 0
    runs = sorted(p.read_text().split("\n")[1:3] for p in tmp_path.glob("runs/mine/sweep_*/*/argv.txt"))
    assert runs == [["task=mine_swept:Mine", f"task.rewards.one={k}"] for k in (1, 2)]


def test_a_failed_job_is_told_and_the_others_still_run(script, tmp_path, capfd):
    assert sweep.run(["-m", "seed=1,2,3", f"sweep={tmp_path / 's'}"], CONFIGS, [sys.executable, str(script)]) == 1
    assert [json.loads((tmp_path / "s" / "jobs" / f"{k}.json").read_text())["status"] for k in range(3)] == [0, 3, 0]


@pytest.mark.parametrize(
    "argv, said", [(["wrlds=1,2"], "wrlds"), (["task=grsp,grasp"], "grsp"), (["seed=1,2", "out=x"], "sweep=FOLDER"),
                   (["seed=1,2", "hydra/launcher=joblib"], "on=local at_once=8"), (["seed=1", "on=x"], "must be local")]
)
def test_a_slip_is_one_line(argv, said, script, tmp_path):
    with pytest.raises(UserError, match=said) as error:
        sweep.run(["--multirun", *argv, f"sweep={tmp_path / 's'}"], CONFIGS, [sys.executable, str(script)])
    assert "\n" not in str(error.value)


def test_a_sweep_is_not_written_over(script, tmp_path):
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "x").touch()
    with pytest.raises(UserError, match="already holds a sweep"):
        sweep.run(["-m", "seed=1,2", f"sweep={tmp_path / 's'}"], CONFIGS, [sys.executable, str(script)])


def test_without_multirun_a_list_is_still_refused(capfd):
    done = subprocess.run([sys.executable, str(shell.ROOT / "train.py"), "seed=1,2"], capture_output=True, text=True)
    assert done.returncode == 2 and "--multirun" in done.stderr


@pytest.mark.slow
def test_a_sweep_of_real_runs(tmp_path):
    done = subprocess.run(
        [
            sys.executable,
            str(shell.ROOT / "train.py"),
            "--multirun",
            "task=grasp",
            "device=cpu",
            "worlds=2",
            "iterations=1",
            "final_episodes=0",
            "seed=1,2",
            "sim.threads=1",
            f"sweep={tmp_path / 's'}",
        ],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert all((tmp_path / "s" / str(k) / "last.pt").exists() for k in range(2))
