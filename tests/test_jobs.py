"""Many jobs through one executor: processes here, Dask, Slurm; one that is lost is begun again, nothing runs twice."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import slurm

from dexsim.console import jobs
from dexsim.errors import UserError
from dexsim.system import lives

ROOT = Path(__file__).resolve().parents[1]
STUB = """import os, pathlib, sys, time
out = pathlib.Path(next(a for a in sys.argv if a.startswith("out="))[4:])
out.mkdir(exist_ok=True)
(out / "env.txt").write_text(os.environ.get("CUDA_VISIBLE_DEVICES", "none"))
(out / "argv.txt").write_text(" ".join(sys.argv[1:]))
(out / "last.pt").touch()
print("said", sys.argv[1], flush=True)
time.sleep(float(sys.argv[2]))
sys.exit(int(sys.argv[3]))
"""


def made(folder: Path, *jobs_of: tuple[tuple[str, ...], ...], resumes: bool = False) -> list[jobs.Job]:
    """Return jobs of a program that waits (s) and ends with a status: ((name, seconds, status), ...) each."""
    (folder / "stub.py").write_text(STUB)
    program = (sys.executable, str(folder / "stub.py"))
    return [
        jobs.Job(tuple((*c, f"out={folder / str(k)}") for c in commands), folder / str(k), program, resumes)
        for k, commands in enumerate(jobs_of)
    ]


def note(job: jobs.Job) -> dict:
    return json.loads(job.note.read_text())


def test_commands_in_turn_until_one_fails(tmp_path, capsys):
    work = made(tmp_path, (("a", "0", "0"), ("b", "0", "0")), (("a", "0", "3"), ("b", "0", "0")))
    assert jobs.run(work, jobs.Engine()) == [0, 3]
    assert work[0].note.with_suffix(".txt").read_text() == "said a\nsaid b\n"
    assert work[1].note.with_suffix(".txt").read_text() == "said a\n" and note(work[1])["status"] == 3
    said = capsys.readouterr().out
    assert "0: done; 1 of 2, about" in said and "1: status 3; 2 of 2" in said


def test_each_gpu_has_one_job_at_a_time(tmp_path):
    work = made(tmp_path, *[(("a", "0.3", "0"),)] * 4)
    began = time.monotonic()
    assert jobs.run(work, jobs.Engine(devices=["5", "7"])) == [0] * 4
    assert time.monotonic() - began >= 0.6
    assert sorted((job.folder / "env.txt").read_text() for job in work) == ["5", "5", "7", "7"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_reaches_what_runs_and_begins_nothing_more(number, tmp_path):
    work = made(tmp_path, *[(("a", "60", "0"),)] * 3)
    threading.Timer(1.5, lambda: os.kill(os.getpid(), number)).start()
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        jobs.run(work, jobs.Engine(at_once=2))
    assert time.monotonic() - began < 20 and not work[2].note.exists()
    assert not any(note(job)["pid"] and lives(note(job)["pid"]) for job in work[:2])


@pytest.mark.parametrize("argument, words", [
    ("on=mars", "must be local, slurm, dask"), ("on=local=x", "must be"), ("at_once=0", "whole number from 1"),
    ("slurm.partition=x", "only with on=slurm"),
])  # fmt: skip
def test_a_slip_is_one_line(argument, words):
    with pytest.raises(UserError, match=words):
        jobs.taken([argument])


def test_what_is_taken_and_what_is_left():
    engine, rest = jobs.taken(["seed=1", "on=slurm", "slurm.time=9", "at_once=4"], ["0"])
    assert rest == ["seed=1"] and engine == jobs.Engine("slurm", 4, ["0"], {"time": "9"})


@pytest.mark.parametrize("on, module", [("slurm", "submitit"), ("dask", "distributed")])
def test_an_engine_that_is_not_here_is_one_line(on, module, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UserError, match="dexsim\\[cluster\\]"):
        jobs.run(made(tmp_path, (("a", "0", "0"),)), jobs.Engine(on))


def test_a_machine_without_slurm_and_a_scheduler_that_is_not_there(monkeypatch, tmp_path):
    work = made(tmp_path, (("a", "0", "0"),))
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(UserError, match="no sbatch"):
        jobs.run(work, jobs.Engine("slurm"))
    monkeypatch.setattr(jobs, "REACH_S", 1)
    with pytest.raises(UserError, match="no Dask scheduler answers"):
        jobs.run(work, jobs.Engine("dask=tcp://127.0.0.1:9"))


@pytest.mark.slow
def test_dask_begins_again_what_a_killed_worker_had(tmp_path):
    """Two workers, one is killed in the middle of a job: its process, an orphan, is ended; the job goes on elsewhere
    from what it had saved, and what it left stands aside."""
    pytest.importorskip("distributed")
    work = made(tmp_path, *[(("train", "4", "0"),)] * 3, resumes=True)
    orphan: list[int] = []

    def kill() -> None:
        while not (work[0].folder / "last.pt").exists():
            time.sleep(0.05)
        orphan.append(note(work[0])["pid"])
        stat = Path(f"/proc/{orphan[0]}/stat").read_text()
        os.kill(int(stat.rpartition(")")[2].split()[1]), signal.SIGKILL)  # its parent, the worker

    thread = threading.Thread(target=kill)
    thread.start()
    # what goes on is `train resume=... out=...` of the stub, which has no seconds and no status: it fails as 1
    status = jobs.run(work, jobs.Engine("dask", at_once=2))
    thread.join()
    assert status[1:] == [0, 0] and note(work[0])["attempt"] == 2 and not lives(orphan[0])
    aside = work[0].note.with_name("0_lost_1")
    assert (aside / "last.pt").exists() and note(work[0])["commands"][0][1] == f"resume={aside / 'last.pt'}"


@pytest.mark.slow
@pytest.mark.skipif(not slurm.here(), reason="Slurm is not installed (apt-get install slurm-wlm), or not root")
def test_slurm_runs_them(tmp_path):
    with slurm.one_node(tmp_path / "slurm"):
        work = made(tmp_path, (("a", "1", "0"),), (("a", "0", "3"),), (("a", "0", "0"), ("b", "0", "0")))
        assert jobs.run(work, jobs.Engine("slurm", slurm={"partition": "all", "time": "5"})) == [0, 3, 0]
        assert work[2].note.with_suffix(".txt").read_text() == "said a\nsaid b\n"
        with pytest.raises(UserError, match="slurm.NAME=.*partitoin"):
            jobs.run(work[:1], jobs.Engine("slurm", slurm={"partitoin": "all"}))
        with pytest.raises(UserError, match="on=slurm: sbatch refuses"):
            jobs.run(work[:1], jobs.Engine("slurm", slurm={"partition": "none"}))
        torchrun = tmp_path / "bin" / "torchrun"  # says what it was asked, and where
        torchrun.parent.mkdir()
        torchrun.write_text('#!/bin/sh\necho "$SLURM_CPUS_PER_TASK $@"\n')
        torchrun.chmod(0o755)
        here = ["--wait", "--time=5", "--nodes=1", "--gpus-per-node=0", "--cpus-per-task=1", "--output=said.txt"]
        env = os.environ | {"PATH": f"{torchrun.parent}:{os.environ['PATH']}", "GPUS_PER_NODE": "3"}
        batch = ["sbatch", *here, ROOT / "recipes/slurm.sbatch", "task=grasp"]
        subprocess.run(batch, cwd=tmp_path, timeout=90, env=env)
        said = (tmp_path / "said.txt").read_text()
        endpoint = rf"--rdzv_endpoint={socket.gethostname().split('.')[0]}:29\d\d\d --rdzv_id=\d+"
        whole = rf"1 --nnodes=1 --nproc_per_node=3 --rdzv_backend=c10d {endpoint} -m dexsim train task=grasp\n"
        assert re.fullmatch(whole, said), said
