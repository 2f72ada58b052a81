"""Hands of MuJoCo Menagerie by name, where a copy of it lies."""

from __future__ import annotations

from pathlib import Path

import pytest

from dexsim.errors import UserError
from dexsim.hand import load_hand
from dexsim.import_hand import known


def test_a_name_finds_the_right_hand_of_a_copy(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path / "cache"))
    with pytest.raises(UserError, match="no copy of MuJoCo Menagerie here.*MUJOCO_MENAGERIE.*git clone"):
        known.model("menagerie:leap_hand")
    robot = tmp_path / "copy" / "leap_hand"
    robot.mkdir(parents=True)
    for name in ("left_hand", "right_hand", "scene_right"):
        (robot / f"{name}.xml").write_text("<mujoco/>")
    monkeypatch.setenv("MUJOCO_MENAGERIE", str(tmp_path / "copy"))
    assert known.model("menagerie:leap_hand") == robot / "right_hand.xml"
    assert known.model("menagerie:leap_hand/left_hand") == robot / "left_hand.xml"
    assert known.model("here/robot.urdf") == Path("here/robot.urdf")
    with pytest.raises(UserError, match="no such robot in .*hands there: leap_hand"):
        known.model("menagerie:leaf_hand")
    with pytest.raises(UserError, match="no such robot"):
        known.model("menagerie:../copy")
    with pytest.raises(UserError, match="dexsim import-hand menagerie:leap_hand out=hands/leap_hand"):
        load_hand("menagerie:leap_hand")
