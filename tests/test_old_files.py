"""Files that older versions wrote: each loads, or one line says the command that converts it. tests/old/VERSION/ was
written by that version: 0.1.0 by commit 560b8a7, its hand by ca1db89."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from dexsim.actuator.table import ServoTable
from dexsim.cli.main import main
from dexsim.hand import load_hand
from dexsim.learning import checkpoint
from dexsim.recording import read

OLD = Path(__file__).with_name("old") / "0.1.0"
SMALL = ("device=cpu", "worlds=2")


def test_a_checkpoint_a_hand_a_servo_and_a_recording_are_read():
    data = checkpoint.load(OLD / "last.pt")
    assert data["versions"]["dexsim"] == "0.1.0" and data["iteration"] == 2
    hand = load_hand(str(OLD / "hand"))
    assert [f.name for f in hand.fingers] == ["finger0", "finger1", "finger2"] and len(hand.joints) == 9
    servo = yaml.safe_load((OLD / "servo.yaml").read_text("utf-8"))
    assert ServoTable.load(OLD / "servo.yaml") is not None and servo["joints"]["knuckle"]["delay"]["value"] > 0.019
    assert read(OLD / "motion_3.mcap").joints == ("knuckle",)


def test_a_bundle_gives_the_answers_of_then(capsys):
    assert main(["export", f"check={OLD / 'bundle'}"]) == 0
    assert capsys.readouterr().out.count("(ok)") >= 3


@pytest.mark.slow
def test_a_training_goes_on_and_its_policy_plays(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["train", f"resume={OLD / 'last.pt'}", "iterations=3", "final_episodes=0", *SMALL[:1], "run=on"]) == 0
    assert checkpoint.load("runs/grasp/on/last.pt")["iteration"] == 3
    assert main(["play", f"checkpoint={OLD / 'policy.pt'}", "episodes=2", "video=false", *SMALL]) == 0


@pytest.mark.slow
def test_a_hand_learns_and_a_servo_replays(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    hand = ["train", "task=grasp", f"hand={OLD / 'hand'}", "iterations=1", "final_episodes=0", "run=hand", *SMALL]
    assert main(hand) == 0
    rig = [f"model={OLD / 'rig.xml'}", f"servo={OLD / 'servo.yaml'}"]
    assert main(["play", f"replay={OLD / 'motion_3.mcap'}", *rig, "out=replayed", "video=false"]) == 0
