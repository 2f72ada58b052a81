"""The parts of the scale and soak benchmarks that decide: bisection, lines, slopes."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import scale, soak
from dexsim.errors import UserError


def test_line_is_the_slope_of_the_large_counts():
    rows = [
        {"worlds": n, "simulate_bytes": 2**28 + 5000 * n + (10**7 if n < 1024 else 0)}
        for n in (1, 16, 1024, 8192, 65_536)
    ]
    fit = scale.line(rows, "simulate_bytes")
    assert fit["bytes_per_world"] == pytest.approx(5000, rel=1e-6) and fit["fixed_bytes"] == pytest.approx(
        2**28, rel=1e-6
    )
    assert scale.line(rows, "train_bytes") is None


class _Device:
    """A stand-in for child processes: counts up to `limit` fit."""

    def __init__(self, limit):
        self.limit, self.rows = limit, []

    def left(self):
        return 1000.0

    def run(self, n, mode):
        row = {"worlds": n, "mode": mode} | ({} if n <= self.limit else {"error": "out of memory"})
        self.rows.append(row)
        return row


@pytest.mark.parametrize("guess", [150_000, 200_000, 300_000])
def test_search_finds_the_limit_from_a_wrong_guess(guess):
    bench = _Device(210_000)
    found = scale.search(bench, "train", 131_072, guess)
    assert found["fits"] <= 210_000 < found["fails"] <= 1.08 * found["fits"] and found["why"] == "out of memory"


def test_search_without_time_claims_nothing():
    bench = _Device(210_000)
    bench.left = lambda: 5.0
    assert scale.search(bench, "train", 131_072, 400_000) == {"fits": 131_072, "fails": None, "why": None}


def test_why_a_child_failed():
    assert scale.reason("torch.OutOfMemoryError: CUDA out of memory. Tried", 1) == "out of memory"
    assert scale.reason("RuntimeError: Failed to allocate 12 bytes on device 'cuda:0'", 1) == "out of memory"
    assert scale.reason("x\nValueError: no such\n", 3) == "status 3: ValueError: no such"


@pytest.mark.slow
def test_one_count_is_measured(tmp_path, capsys):
    assert scale.main(["counts=1,2", "device=cpu", "seconds=120", f"out={tmp_path}"]) == 0
    import json

    rows = json.loads((tmp_path / "scale.json").read_text())["rows"]
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["rows"] == rows
    assert [r["worlds"] for r in rows] == [1, 2] and all(r["step_s"] > 0 and r["train_bytes"] >= 1e6 for r in rows)
    assert (tmp_path / "scale.png").stat().st_size > 1000


def _rows(n=400, leak_mib_per_hour=0.0, slower_ms_per_hour=0.0, seed=0):
    rng = np.random.default_rng(seed)
    wall = np.cumsum(np.full(n, 9.0))  # an hour
    cpu = np.cumsum(0.5 + slower_ms_per_hour * 1e-3 * wall / 3600 + 0.02 * rng.standard_normal(n))
    heap = 300 + leak_mib_per_hour * wall / 3600 + rng.standard_normal(n)
    ones = np.ones(n)
    return np.stack([np.arange(n), wall, cpu, 0.4 * cpu, heap + 200, heap, 6 * ones, 2 * ones, ones], 1)


def test_soak_finds_a_leak_and_a_slowdown_and_no_false_ones():
    flat = soak.summary(_rows())
    assert flat["heap_mib"]["low"] < 0 < flat["heap_mib"]["high"] and flat["cpu_ms"]["low"] < 0 < flat["cpu_ms"]["high"]
    assert flat["files"]["per_hour"] == flat["files"]["low"] == 0
    bad = soak.summary(_rows(leak_mib_per_hour=20, slower_ms_per_hour=50))
    assert bad["heap_mib"]["low"] > 10 and bad["heap_mib"]["high"] < 30
    assert 20 < bad["cpu_ms"]["low"] < 50 < bad["cpu_ms"]["high"] < 80


def test_soak_too_short_is_said():
    with pytest.raises(UserError, match="minutes"):
        soak.summary(_rows(n=20))


def test_soak_figure(tmp_path):
    rows = _rows()
    assert soak.draw(rows, soak.summary(rows), tmp_path / "soak.png").stat().st_size > 1000
