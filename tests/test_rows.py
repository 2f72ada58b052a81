"""`benchmarks.rows`: trains and judges rows by the product's commands, goes on where it was, and compares them."""

from __future__ import annotations

import json
import math

import pytest

from benchmarks import rows
from dexsim.errors import UserError


def test_difference_of_rows_has_an_interval_over_seeds():
    difference, low, high, word = rows.compare([25.0, 26.0, 24.0], [10.0, 11.0, 12.0])
    assert difference == pytest.approx(14.0) and 10 < low < difference < high < 18 and word == "holds"
    assert rows.compare([10.0, 11.0, 12.0], [25.0, 26.0, 24.0])[3] == "the reverse holds"
    assert rows.compare([10.0, 30.0], [11.0, 28.0])[3] == "undecided"
    assert rows.compare([10.0], [30.0, 31.0])[3] == "undecided, one seed"


def test_claims_name_rows_of_their_table():
    for table in rows.TABLES.values():
        assert {name for pair in table.claims for name in pair} <= set(table.rows)
        assert all(math.isnan(r.paper) or r.paper > 0 for r in table.rows.values())


def test_what_was_judged_is_not_repeated(tmp_path, monkeypatch, capsys):
    requested = []

    def attempt(job, env=None):
        status = max(run([*job.program, *command]) for command in job.commands)
        job.note.parent.mkdir(parents=True, exist_ok=True)
        job.note.write_text(json.dumps({"done": len(job.commands)}))
        return status

    def run(command):
        requested.append(command[3:])
        out = next(a.removeprefix("out=") for a in command if a.startswith("out="))
        if command[3] == "play":
            value = 20.0 + len(requested) + 10 * ("full" in out)
            folder = rows.Path(out)
            folder.mkdir(parents=True)
            (folder / "metrics.json").write_text(json.dumps({"consecutive_successes": {"average": value}}))
        return 0

    monkeypatch.setattr(rows.jobs, "attempt", attempt)
    argv = ["table=rotation", "rows=full,no_touch", "seeds=1,2", f"out={tmp_path}", "worlds=8", "judge=episodes=4"]
    first = rows.main(argv)
    assert len(requested) == 8 and {"task=rotate", "device=cpu", "seed=1", "worlds=8"} <= set(requested[0])
    assert {"seed=1001", "episodes=4"} <= set(requested[1])
    assert "| everything, 6D orientation > no touch at all |" in capsys.readouterr().out
    assert rows.main(argv) == first and len(requested) == 8


def test_wrong_table_and_row_are_one_line():
    with pytest.raises(UserError, match="table=walk: must be rotation, grasp, skin, fingertips"):
        rows.main(["table=walk"])
    with pytest.raises(UserError, match="rows=nothing: must be of both, force, torque"):
        rows.main(["table=grasp", "rows=nothing"])
