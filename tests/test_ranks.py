"""Training by several processes, on the CPU: torchrun, gloo, two ranks of the dummy task."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import forked
import pytest
import rank_main
import shell
import torch

from dexsim.console import ending
from dexsim.errors import UserError
from dexsim.learning import checkpoint
from dexsim.learning.meter import Meter
from dexsim.learning.ranks import Ranks

MAIN = Path(__file__).with_name("rank_main.py")
QUICK = ("task=dummy", "device=cpu", "worlds=4", "final_episodes=0")


@pytest.fixture(scope="module")
def configs(tmp_path_factory):
    return shell.configs(tmp_path_factory.mktemp("ranks"))


TORCHRUN = ("--standalone", "--nproc_per_node=2")


def torchrun(configs, folder, mode, *settings) -> subprocess.Popen:
    """Return torchrun of rank_main.py in `folder`, in a process group of its own."""
    env = os.environ | {
        "OMP_NUM_THREADS": "1",
        "REPORT": str(folder / "report"),
        "PYTHONPATH": f"{shell.ROOT}:{MAIN.parent}",
    }
    argv = [str(configs), mode, *QUICK, *settings]
    command = [sys.executable, "-m", "torch.distributed.run", *TORCHRUN, str(MAIN), *argv]
    return subprocess.Popen(
        command, cwd=folder, env=env, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True
    )


def forks(configs, folder, mode, *settings) -> forked.Forked:
    """Return the same, but that torchrun and its ranks are forks: three times less to import."""
    argv = [str(configs), mode, *QUICK, *settings]
    env = {"OMP_NUM_THREADS": "1", "REPORT": str(folder / "report")}
    return forked.Forked(rank_main.launched, list(TORCHRUN), argv, cwd=folder, env=env)


def finish(process, seconds=100):
    """Return (status, stdout, stderr) of a run; killed with its children where it does not end in time."""
    try:
        out, err = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        raise
    return process.returncode, out, err


def wait_for(path, process, seconds=90):
    end = time.monotonic() + seconds
    while not path.exists():
        assert process.poll() is None and time.monotonic() < end, finish(process, 5)
        time.sleep(0.1)


# --- one process

def test_one_process_is_the_leader_and_needs_nothing():
    ranks = Ranks({})
    assert ranks.leader and ranks.size == 1 and ranks.seed(7) == ranks.seed(7, 5) == 7
    with ranks.joined("cpu"), ranks.one_compiles(), ranks.only_leader_prints():
        assert ranks.tell("x") == "x" and ranks.any(True) and not ranks.any(False)
        assert ranks.sum(torch.ones(2)).tolist() == [1, 1]
    assert ranks.device(None, 0) is None and ranks.device("cuda:1", 2) == "cuda:1"


def environment(rank, size, here=None):
    return {
        "WORLD_SIZE": str(size),
        "RANK": str(rank),
        "LOCAL_RANK": str(rank % (here or size)),
        "LOCAL_WORLD_SIZE": str(here or size),
        "MASTER_ADDR": "localhost",
    }


def test_each_rank_gets_the_gpu_of_its_number():
    assert [Ranks(environment(k, 8)).device(None, 8) for k in range(8)] == [f"cuda:{k}" for k in range(8)]
    assert Ranks(environment(9, 16, 8)).device(None, 8) == "cuda:1"  # the second machine's second
    assert Ranks(environment(1, 2)).device("cpu", 8) == "cpu"
    assert Ranks(environment(1, 2)).device(None, 0) is None  # a machine without a GPU
    with pytest.raises(UserError, match="--nproc_per_node=2"):
        Ranks(environment(0, 4)).device(None, 2)  # said by every rank, so that the first can say it
    with pytest.raises(UserError, match="--nproc_per_node=1 or device=cpu"):
        Ranks(environment(0, 4)).device("cuda", 0)
    with pytest.raises(UserError, match="leave device= away"):
        Ranks(environment(1, 2)).device("cuda:0", 2)


def test_seeds_differ_between_ranks_and_neighbouring_runs():
    seeds = {Ranks(environment(k, 8)).seed(seed) for k in range(8) for seed in range(1, 50)}
    assert len(seeds) == 8 * 49
    # a resumed run does not repeat itself
    assert Ranks(environment(1, 8)).seed(1, 100) != Ranks(environment(1, 8)).seed(1)


def test_without_torchrun_is_said():
    with pytest.raises(UserError, match="start several processes with torchrun"):
        Ranks({"WORLD_SIZE": "2"})


def test_meter_sums_over_ranks():
    """Two meters read with the other's sums added say the same as one meter that saw everything."""
    torch.manual_seed(0)
    together, parts = Meter(4, "cpu"), [Meter(2, "cpu"), Meter(2, "cpu")]
    for step in range(6):
        reward, done = torch.rand(4), torch.rand(4) > 0.6
        log = torch.rand(4)
        log[3] = float("nan") if step % 2 else log[3]  # a rank with nothing to report
        together.add(reward, done, None)
        for half, meter in enumerate(parts):
            meter.add(reward[2 * half: 2 * half + 2], done[2 * half: 2 * half + 2], {"a": log[2 * half + 1]})
    sums = []
    for meter in parts:
        meter.read(lambda s: sums.append(s.clone()) or s)
    for meter in parts:
        assert meter.read() == {"step_reward": 0.0}
    again = Meter(2, "cpu")
    again._logs = {("a",): [torch.zeros(1)]}
    found = again.read(lambda s: sums[0] + sums[1])
    expected = together.read()
    assert {k: found[k] for k in expected} == pytest.approx(expected)
    assert "Episode/a" in found


def test_the_first_of_a_machine_says_what_all_find_wrong(monkeypatch, capsys):
    """Others wait, since torchrun ends all once one has ended; where nobody has ended it, one speaks as well."""
    waited = []
    monkeypatch.setattr(ending.time, "sleep", waited.append)

    def wrong(argv):
        raise UserError(f"worlds={argv[0]}")

    for rank, before in ((0, []), (1, [ending.FIRST_SPEAKS_S])):
        for name, value in environment(rank, 2).items():
            monkeypatch.setenv(name, value)
        assert ending.guard(wrong, ["0"]) == 2 and waited == before
        assert capsys.readouterr().err == "error: worlds=0\n"


# --- two processes

@pytest.fixture(scope="module")
def learned(configs, tmp_path_factory):
    """Return a folder in which two ranks trained into run/, and what they printed."""
    folder = tmp_path_factory.mktemp("learned")
    status, out, err = finish(forks(configs, folder, "report", "iterations=3", "out=run"))
    assert status == 0, err
    return folder, out


@pytest.mark.slow
def test_two_ranks_learn_one_policy(learned):
    folder, out = learned
    a, b = (json.loads((folder / "report" / f"{k}.json").read_text()) for k in (0, 1))
    assert a["before"] != b["before"] and a["first_x"] != b["first_x"] and a["x"] != b["x"]  # seeds of their own
    assert a["after"] == b["after"] and a["rate"] == b["rate"]  # one policy, its normalization included
    assert a["steps"] == b["steps"] == 3 * 24 * 4 * 2
    assert out.count("compiling kernels") == 1 and "2, 4 worlds each" in out and out.count("learned from") == 1
    with open(folder / "run" / "progress.csv") as file:
        rows = list(csv.DictReader(file))
    assert [int(r["steps"]) for r in rows] == [192, 384, 576]
    assert len(list((folder / "run").glob("events.*"))) == 1
    assert sorted(p.name for p in folder.iterdir()) == ["report", "run"]
    assert checkpoint.load(folder / "run" / "last.pt")["config"]["seed"] == 1


@pytest.mark.slow
def test_two_ranks_resume(configs, learned, tmp_path):
    last = learned[0] / "run" / "last.pt"
    status, out, err = finish(forks(configs, tmp_path, "report", f"resume={last}", "iterations=5", "out=again"))
    assert status == 0, err
    c, d = (json.loads((tmp_path / "report" / f"{k}.json").read_text()) for k in (0, 1))
    assert c["from"] == d["from"] == 3 and c["steps"] == 5 * 24 * 4 * 2 and c["after"] == d["after"]
    assert c["x"] != d["x"]  # rank 1 did not repeat rank 0's worlds


@pytest.mark.slow
@pytest.mark.parametrize("lost, by", [(1, 0), (0, 1)])
def test_a_killed_rank_ends_the_run(configs, tmp_path, lost, by):
    process = forks(configs, tmp_path, "slow", "iterations=100000", "out=run", "save_interval=1")
    wait_for(tmp_path / "run" / "model_2.pt", process)
    os.kill(int((tmp_path / "report" / f"{lost}.pid").read_text()), signal.SIGKILL)
    status, out, err = finish(process)  # the others would wait for it for half an hour (COMPILE_LIMIT)
    assert status != 0
    lines = [x for x in err.splitlines() if x.startswith("error:")]
    assert len(lines) == 1, err
    assert (
        f"rank {lost} is gone" in lines[0]
        and "torchrun --nproc_per_node=2 -m dexsim train resume=run/last.pt" in lines[0]
    )
    saved = checkpoint.load(tmp_path / "run" / "last.pt")  # whole: a training goes on from it
    goes_on = (f"resume={tmp_path / 'run' / 'last.pt'}", f"iterations={saved['iteration'] + 1}")
    assert shell.call("train", configs, *goes_on, f"out={tmp_path / 'again'}") == 0
    assert checkpoint.load(tmp_path / "again" / "last.pt")["iteration"] == saved["iteration"] + 1


@pytest.mark.slow
def test_ctrl_c_saves_once(configs, tmp_path):
    process = torchrun(configs, tmp_path, "slow", "iterations=100000", "out=run", "save_interval=1")
    wait_for(tmp_path / "run" / "model_2.pt", process)
    # a terminal's Ctrl-C reaches torchrun and both ranks; torchrun passes it on again
    os.killpg(process.pid, signal.SIGINT)
    status, out, err = finish(process)
    assert status != 0 and out.count("stopping and saving") == 1 and out.count("saved run/last.pt") == 1, (out, err)
    done = int(out.split("stopped after ")[1].split()[0])
    assert checkpoint.load(tmp_path / "run" / "last.pt")["iteration"] == done >= 2


@pytest.mark.slow
@pytest.mark.parametrize(
    "mode, said",
    [
        ("fail0", "error: contact overflow, say"),
        ("fail1", "error: rank 1: contact overflow, say"),
        ("bug1", "error: rank 1: ValueError: a bug, say"),
    ],
)
def test_an_error_of_one_rank_is_said_once(configs, tmp_path, mode, said):
    status, out, err = finish(forks(configs, tmp_path, mode, "iterations=100000", "out=run"))
    lines = [x for x in err.splitlines() if x.startswith("error:")]
    assert status != 0 and len(lines) == 1 and lines[0].startswith(said), err
    assert "run/last.pt" in lines[0] and checkpoint.load(tmp_path / "run" / "last.pt")["iteration"] >= 1
    assert ("in step" in err) == (mode == "bug1")  # a traceback for our bugs only


@pytest.mark.slow
def test_a_wrong_setting_is_said_once(configs, tmp_path):
    status, out, err = finish(forks(configs, tmp_path, "plain", "wrlds=3"))
    assert (
        status != 0
        and len([x for x in err.splitlines() if x.startswith("error:")]) == 1
        and "did you mean worlds?" in err
    )


@pytest.mark.slow
def test_two_ranks_of_the_grasp(tmp_path):
    small = ("task=grasp", "device=cpu", "worlds=2", "iterations=2", "final_episodes=0", "out=run", "sim.threads=1")
    argv = [str(shell.ROOT / "train.py"), *small]
    process = forked.Forked(rank_main.launched, list(TORCHRUN), argv, cwd=tmp_path, env={"OMP_NUM_THREADS": "1"})
    status, out, err = finish(process, 300)
    assert status == 0 and out.count("learned from") == 1, (out, err)
    assert checkpoint.load(tmp_path / "run" / "last.pt")["steps"] == 2 * 24 * 2 * 2
