"""A fleet's diagnoses: which machine differs, where, and what moved since."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from dexsim.cli.main import main
from dexsim.errors import UserError
from dexsim.gap import demo, fleet


def diagnosis(**found: tuple[float, float, float] | None) -> dict:
    """Return a diagnosis of effects EFFECT__JOINT=(value, low, high)."""
    return {
        "verdict": "explained",
        "findings": [
            {"effect": name.split("__")[0], "confidence": 0.9, "where": {"joints": [name.split("__")[1]], "taxels": [],
             "topics": []}, "parameters": {} if v is None else
             {"shape": {"value": "x", "unit": "1"},
              "delay": {"value": v[0], "low": v[1], "high": v[2], "unit": "s"}}}
            for name, v in found.items()
        ],
    }  # fmt: skip


NEAR = (0.02, 0.018, 0.022)


def rows(found: dict, before: dict | None = None) -> dict[tuple[str, str], fleet.Row]:
    return {(r.effect, r.place): r for r in fleet.compare(found, before or {})}


def test_what_all_have_is_of_the_type_and_what_one_has_is_its_own():
    found = rows({
        "a": diagnosis(lag__elbow=NEAR), "b": diagnosis(lag__elbow=(0.021, 0.019, 0.023), backlash__wrist=None),
        "c": diagnosis(lag__elbow=(0.019, 0.017, 0.021)),
    })  # fmt: skip
    assert found["lag", "elbow"].words == "all 3 machines: what is believed of the type is wrong"
    assert found["backlash", "wrist"].words == "only b" and list(found)[0] == ("backlash", "wrist")
    assert not any(c.apart or c.moved for r in found.values() for c in r.cells.values())


def test_the_same_effect_of_another_size_is_told():
    found = rows({n: diagnosis(lag__elbow=NEAR) for n in "abc"} | {"d": diagnosis(lag__elbow=(0.04, 0.038, 0.042))})
    assert found["lag", "elbow"].words.endswith("another size in d")
    assert [n for n, c in found["lag", "elbow"].cells.items() if c.apart] == ["d"]
    two = rows({"a": diagnosis(lag__elbow=NEAR), "d": diagnosis(lag__elbow=(0.04, 0.038, 0.042))})
    assert "another" not in two["lag", "elbow"].words  # of two nobody knows which is the odd one


def test_what_drifted_since_is_told():
    before = {n: diagnosis(lag__elbow=NEAR) for n in "ab"}
    now = {"a": diagnosis(lag__elbow=(0.03, 0.028, 0.032)), "b": diagnosis(lag__elbow=NEAR, backlash__wrist=None)}
    found = rows(now, before)
    assert found["lag", "elbow"].words.endswith("drifted since: a")
    assert found["backlash", "wrist"].words == "only b; drifted since: b"
    assert "drifted" not in rows(before, before)["lag", "elbow"].words


def test_the_page_has_every_machine_and_escapes_names():
    found = {"a<b": diagnosis(lag__elbow=NEAR), "c": diagnosis(lag__elbow=None)}
    text = fleet.page(found, {"d": "error: <none>"}, fleet.compare(found, {}))
    assert "a&lt;b" in text and "<none>" not in text and "18 ms" not in text and "0.018" in text


def test_folders_and_what_is_in_them(tmp_path, monkeypatch):
    for name in ("a", "b"):
        (tmp_path / "logs" / name).mkdir(parents=True)
        (tmp_path / "logs" / name / "x.csv").touch()
    (tmp_path / "logs" / "b" / "servo.yaml").touch()
    (tmp_path / "logs" / "empty").mkdir()
    monkeypatch.chdir(tmp_path)
    for pattern in ("logs/*/", str(tmp_path / "logs/*")):
        names = {n: [p.name for p in ps] for n, ps in fleet.machines(pattern).items()}
        assert names == {"a": ["x.csv"], "b": ["x.csv"]}
    with pytest.raises(UserError, match="no folder with recordings"):
        fleet.machines("lgs/*/")
    (tmp_path / "more" / "a").mkdir(parents=True)
    (tmp_path / "more" / "a" / "y.csv").touch()
    with pytest.raises(UserError, match="two folders are named a"):
        fleet.machines("*/*/")


@pytest.mark.parametrize("argument, words", [
    ("before=none", "must be the folder of an earlier"), ("on=mars", "must be local"), ("wrld=1", "does not exist"),
])  # fmt: skip
def test_a_slip_is_one_line(argument, words, tmp_path, monkeypatch, capsys):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "x.csv").touch()
    monkeypatch.chdir(tmp_path)
    assert main(["diagnose", "fleet=*/", argument]) == 2
    assert words in capsys.readouterr().err and not (tmp_path / "out").exists()


@pytest.mark.slow
def test_three_machines_of_which_one_has_a_late_drive(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name, hidden in (("one", "none"), ("two", "command_delay"), ("three", "none")):
        _, model, servo, _ = demo.make(Path("logs", name), hidden, seed=ord(name[1]), joint="knuckle")
        model.rename("rig.xml"), servo.rename("rig.yaml")
    Path("logs/broken").mkdir()
    Path("logs/broken/a.mcap").write_bytes(b"no recording")  # said of it, as of a recording that shows nothing
    Path("logs/false").mkdir()
    Path("logs/false/a.mcap").write_bytes(Path("logs/one/motion_1.mcap").read_bytes())
    Path("logs/false/servo.yaml").write_text("joints: 3")
    assert main(["diagnose", "fleet=logs/*/", "model=rig.xml", "servo=rig.yaml", "out=out", "replay=none"]) == 1
    said = capsys.readouterr().out
    for words in ("command delay @ knuckle: only two", "false: not diagnosed: error:", "broken: cannot be judged"):
        assert words in said, words
    data = json.loads(Path("out/fleet.json").read_text())
    assert data["machines"] == {"broken": "unusable", "one": "none", "three": "none", "two": "explained"}
    assert "only two" in Path("out/report.html").read_text() and Path("out/two/report.html").is_file()
    # again into the same place, and against itself: nothing has moved
    for name in ("broken/a", "false/a", "three/motion_1"):
        Path("logs", f"{name}.mcap").unlink()
    again = ["diagnose", "fleet=logs/*/", "model=rig.xml", "servo=rig.yaml", "out=out2", "before=out", "replay=none"]
    assert main([*again, "at_once=2"]) == 0 and "drifted" not in capsys.readouterr().out
