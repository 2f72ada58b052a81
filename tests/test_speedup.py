"""benchmarks.speedup: what it makes of the parts' printouts, and what it says of those that no longer fit."""

from __future__ import annotations

import json
import sys

import pytest

from benchmarks import speedup
from dexsim.errors import UserError


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.setattr(speedup.tools, "config", lambda settings: {"device": "cpu"})
    return lambda *settings: speedup.Run([*settings, f"out={tmp_path}", "worlds=4,8"])


def test_rates_of_both_settings_stand_beside_each_other(run, monkeypatch, capsys):
    asked = []

    def of(self, name, module, *arguments):
        asked.append((name, module, arguments))
        return {"rows": [{"steps_per_s": 2000.0 if "sim.solver=mujoco" in arguments else 5000.0}]}

    monkeypatch.setattr(speedup.Run, "of", of)
    r = run("parts=learning")
    r.learning()
    assert [a[0] for a in asked] == ["learning_4_hand", "learning_4_mujoco", "learning_8_hand", "learning_8_mujoco"]
    assert ["sim.collision=mujoco" in a[2] for a in asked] == [False, True, False, True]
    assert "4 worlds: training 2,000 -> 5,000 steps a second (2.50x)" in capsys.readouterr().out
    assert json.loads((r.out / "speedup.json").read_text())["learning"]["8"]["hand"]["steps_per_s"] == 5000.0


def test_what_does_not_fit_is_left_out_and_named(run, capsys):
    r = run("limit_s=10")
    assert r.of("rotate", "minutes") is None
    assert r.found["left_out"] == ["rotate"]


def test_a_part_that_fails_says_why(run, monkeypatch):
    monkeypatch.setattr(speedup.sys, "executable", sys.executable)
    with pytest.raises(UserError, match="grasp ended with status"):
        run().of("grasp", "no_such_benchmark")


def test_part_is_one_of_those_there_are(run):
    with pytest.raises(UserError, match="parts=peers: must be of physics, learning, grasp, rotate"):
        run("parts=peers")


def test_last_line_of_json():
    assert speedup.last_json('a\n{"x": 1}\n{"x": 2}\nend') == {"x": 2}
    with pytest.raises(UserError, match="no JSON line"):
        speedup.last_json("nothing")


def test_one_part_that_fails_does_not_cost_the_others(tmp_path, monkeypatch, capsys):
    def of(self, name, module, *arguments):
        if module == "collision":
            raise UserError("no GPU")
        return {"rows": [{"steps_per_s": 1.0}]}

    monkeypatch.setattr(speedup.tools, "config", lambda settings: {"device": "cpu"})
    monkeypatch.setattr(speedup.Run, "of", of)
    with pytest.raises(UserError, match="physics failed: see above"):
        speedup.main(["parts=physics,learning", "worlds=4", f"out={tmp_path}"])
    found = json.loads((tmp_path / "speedup.json").read_text())
    assert found["failed"] == {"physics": "no GPU"} and set(found["learning"]["4"]) == {"hand", "mujoco"}
