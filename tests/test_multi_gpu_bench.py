"""The parts of benchmarks.multi_gpu that decide: shares, efficiency, packing."""

from __future__ import annotations

import csv
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.multi_gpu import Job, efficiency, pack, series


def _rows(n, kept=0.002, dropped=0.001, length=100.0):
    return [
        {
            "end/time_out": repr(kept),
            "end/dropped": repr(dropped),
            "length": repr(length),
            "collect_s": "0.5",
            "learn_s": "0.25",
            "steps": str(1000 * (k + 1)),
            "rate": "1",
        }
        for k in range(n)
    ]


def test_share_is_of_the_episodes_that_ended_lately():
    rows = _rows(30) + _rows(30, dropped=0.0)
    found = series(rows)
    assert (
        found["share"][20] == pytest.approx(2 / 3)
        and found["share"][-1] == 1.0
        and found["time_s"][-1] == pytest.approx(45)
    )
    assert 2 / 3 < found["share"][34] < 1  # half of the window
    assert found["share"][:9].max() == 0.0  # not a full window yet


def test_first_episodes_that_began_at_random_ages_do_not_count():
    found = series(_rows(40, dropped=0.0, length=381.0))
    first = np.flatnonzero(found["share"])[0]
    assert 24 * first >= 381 - 24  # an episode's length after the start


def test_no_rows_yet():
    assert all(len(v) == 0 for v in series([]).values())


def test_the_iteration_that_reaches_a_level_counts_and_its_rate_does_not(tmp_path):
    rows = _rows(30) + _rows(10, dropped=0.0)
    rows[-1]["rate"] = "100000"
    job = Job.__new__(Job)
    job.name, job.count, job.folder, job.first_row_s = "1_gpu", 1, tmp_path, 1.0
    job._log, job.process = open(tmp_path / "log", "w"), SimpleNamespace(returncode=130)
    with open(tmp_path / "progress.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    found = job.result()
    assert found["reached"]["0.97"]["iterations"] == 40 and found["steps_per_s"] == 1.0


def test_efficiency_is_by_gpu_against_the_smallest_count():
    runs = [{"name": "8_gpu", "gpus": 8, "steps_per_s": 720.0}, {"name": "1_gpu", "gpus": 1, "steps_per_s": 100.0},
            {"name": "fixed_8_gpu", "gpus": 8, "steps_per_s": 400.0}, {"name": "2_gpu", "gpus": 2, "error": "x"}]
    assert efficiency(runs) == {"8_gpu": pytest.approx(0.9), "1_gpu": 1.0}
    assert efficiency([]) == {}


def test_packing():
    assert pack([1, 2, 4, 8], 8, True) == [[8], [4, 2, 1]]
    assert pack([1, 2, 4, 8], 8, False) == [[8], [4], [2], [1]]


def test_it_learns_until_there_is_a_rate(tmp_path):
    """However long the first iterations took: asked to stop before, it would have no result."""
    asked = []
    job = Job.__new__(Job)
    job.folder, job.first_row_s, job.stopped = tmp_path, 1.0, False
    job.process = SimpleNamespace(send_signal=asked.append)
    for n in (1, 5, 6):
        with open(tmp_path / "progress.csv", "w", newline="") as file:
            writer = csv.DictWriter(file, list(_rows(1)[0]))
            writer.writeheader()
            writer.writerows(_rows(n))
        job.watch(learn_s=0.5, until=2.0, end=float("inf"))
        assert len(asked) == (n > 5)


@pytest.mark.slow
def test_one_process_is_started_stopped_and_read(tmp_path):
    import time

    job = Job("1_gpu", ["0"], ["task=grasp", "device=cpu", "worlds=2", "sim.threads=1"], tmp_path)
    end = time.perf_counter() + 600  # of a busy machine; it ends itself once it has a rate
    while job.process.poll() is None:
        time.sleep(0.5)
        job.watch(learn_s=0.0, until=2.0, end=end)
        assert time.perf_counter() < end, job.process.kill()
    found = job.result()
    assert found["status"] == 130 and found["steps_per_s"] > 0 and found["start_s"] > 0, (
        tmp_path / "1_gpu.log"
    ).read_text()[-2000:]
    assert (tmp_path / "1_gpu" / "last.pt").exists()
