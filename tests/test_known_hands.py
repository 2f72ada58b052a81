"""Hands of MuJoCo Menagerie by name, where a copy of it lies."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from dexsim.errors import UserError
from dexsim.hand import HANDS, load_hand
from dexsim.import_hand import known


def test_a_name_finds_the_right_hand_of_a_copy(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path / "cache"))
    with pytest.raises(UserError, match="no copy of MuJoCo Menagerie.*MUJOCO_MENAGERIE.*dexsim.hands.*git clone"):
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
    with pytest.raises(UserError, match="robot_descriptions:leap_hand_mj_description: .*pip install dexsim.hands"):
        known.model("robot_descriptions:leap_hand_mj_description")


def test_a_package_that_is_installed_fetches_the_hand(tmp_path, monkeypatch):
    """Stand-ins of both packages, as they are called today."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path / "cache"))
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    (tmp_path / "site" / "robot_descriptions").mkdir(parents=True)
    (tmp_path / "site" / "mujoco_menagerie.py").write_text(
        "from pathlib import Path\nclass MenagerieError(Exception): pass\nclass get:\n"
        "    def __init__(self, name):\n        if name != 'leap_hand': raise MenagerieError(f'Unknown robot {name}')\n"
        f"    def path(self): return Path({str(tmp_path)!r})\n"
    )
    (tmp_path / "right_hand.xml").write_text("<mujoco/>")
    (tmp_path / "site" / "robot_descriptions" / "__init__.py").write_text("")
    (tmp_path / "site" / "robot_descriptions" / "claw.py").write_text("URDF_PATH = 'somewhere/claw.urdf'")
    (tmp_path / "site" / "robot_descriptions" / "far.py").write_text("raise OSError('no network')")
    assert known.model("menagerie:leap_hand") == tmp_path / "right_hand.xml"
    assert known.model("robot_descriptions:claw") == Path("somewhere/claw.urdf")
    for name, said in (
        ("menagerie:leaf", "Unknown robot leaf"),
        ("robot_descriptions:far", "OSError: no network"),
        ("robot_descriptions:none", "no such description"),
    ):
        with pytest.raises(UserError, match=said):
            known.model(name)


def test_a_named_hand_is_imported_where_it_is_asked_for(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MUJOCO_MENAGERIE", str(tmp_path / "copy"))
    (tmp_path / "copy").mkdir()
    with pytest.raises(UserError, match="hand=menagerie:claw: menagerie:claw: no such robot in"):
        load_hand("menagerie:claw")
    (tmp_path / "copy" / "claw").mkdir()
    requested = []

    def run(words, **_):
        requested.append(words[2:])
        shutil.copytree(HANDS / "xhand", tmp_path / "hands" / "claw")
        shutil.copy(load_hand("xhand").servo_path, tmp_path / "hands" / "claw" / "drives.yaml")
        file = tmp_path / "hands" / "claw" / "hand.yaml"
        file.write_text(re.sub("servo: .*", "servo: drives.yaml", file.read_text()))
        return subprocess.CompletedProcess(words, 0, "", "")

    monkeypatch.setattr(subprocess, "run", run)
    assert load_hand("menagerie:claw").joints == load_hand("xhand").joints
    load_hand("menagerie:claw")
    assert requested == [["dexsim", "import-hand", "menagerie:claw", "out=hands/claw"]]
