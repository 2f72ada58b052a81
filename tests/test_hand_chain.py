"""Everything for a hand out of one URDF file, as docs/your_hand.md does it: imported with its picture, trained for two
iterations, exported, run in the simulated deployment, and a hidden effect of one joint named from its recordings."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from dexsim import export
from dexsim.calibration.file import Calibration
from dexsim.cli import start
from dexsim.cli import train as training
from dexsim.deploy import bundle
from dexsim.deploy.driver import VirtualClock
from dexsim.deploy.loop import Loop, LoopSettings
from dexsim.deploy.simulated_hand import SimulatedXHand
from dexsim.gap import command
from dexsim.hand import load_hand
from dexsim.import_hand.command import main as import_hand
from dexsim.paths import CONFIGS
from dexsim.recording import mechanism, write
from dexsim.recording.realistic import realistic
from dexsim.recording.schema import COMMANDS, Series
from tests import hands

JOINT, DELAY = "middle_1", 0.06


pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def hand(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("chain")
    assert import_hand([str(hands.write(place / "robot")), f"out={place / 'hand'}", "drops=0"]) == 0
    assert (place / "hand" / "picture.png").stat().st_size > 20_000
    return place / "hand"


def test_trained_exported_and_deployed(hand, tmp_path):
    out = tmp_path / "run"
    argv = ["task=grasp", f"hand={hand}", "device=cpu", "worlds=4", "sim.threads=1", "iterations=2", "final_episodes=0"]
    assert training.run(start.for_train([*argv, f"out={out}"], CONFIGS)) == 0
    made = export.export(str(out / "policy.pt"), tmp_path / "bundle", steps=8)
    assert export.check(made)
    b = bundle.load(made)
    assert b.hand.joints == load_hand(hand).joints and b.manifest["fingers"] == list(load_hand(hand).finger_names)
    calibration, clock = Calibration.from_dict(b.manifest["calibration"], "bundle", None, b.hand), VirtualClock()
    driver = SimulatedXHand(b.config, calibration, clock, seed=1, grip=b.manifest.get("grip"))
    settings = LoopSettings(seconds=0.5, home_speed=5.0, wait=0.2, grip=0.3, command=0.5)
    report = Loop(b, driver, driver, calibration, settings, clock, keep=True).run()
    assert report.ended == "done" and report.acts >= 10, report.ended
    assert np.isfinite(report.actions).all() and report.targets[0].shape == (9,)


def test_a_hidden_effect_is_named(hand, tmp_path):
    """A target that one joint acts on 60 ms late, in three recordings of that finger; the others are believed right."""
    paths = []
    for k in range(3):
        real = mechanism.mechanism(hand)
        real.table.set(JOINT, "delay", float(real.column("delay")[real.joints.index(JOINT)]) + DELAY)
        t, rng = np.arange(0.0, 6.0, 0.01), np.random.default_rng(k)
        knots = np.cumsum(np.r_[0.0, rng.uniform(0.4, 0.9, 30)])
        q = 0.7 + 0.3 * np.sin(2 * np.pi * rng.uniform(0.3, 0.6) * t)
        q += np.interp(t, np.sort(np.r_[knots, knots + 0.2])[:40], np.repeat(rng.uniform(-0.2, 0.2, 20), 2))
        commands = Series(t, q[:, None], COMMANDS, t.copy())
        rest = load_hand(hand).pose("open")
        run = mechanism.drive(real, commands, (JOINT,), 6.0, np.where([j == JOINT for j in real.joints], q[0], rest))
        paths.append(tmp_path / f"r{k}.mcap")
        write(paths[-1], realistic(mechanism.recorded(run, mechanism.mechanism(hand), commands, (JOINT,)), seed=k))
    out = tmp_path / "diagnosed"
    argv = [f"recordings=[{paths[0]},{paths[1]}]", f"held_out=[{paths[2]}]", f"model={hand}", f"joints=[{JOINT}]",
            "effects=[command_delay,lag,coulomb_friction,backlash]", "next=false", f"out={out}"]  # fmt: skip
    assert command.main(argv) == 0
    (f,) = json.loads((out / "diagnosis.json").read_text())["findings"]
    assert f["effect"] == "command_delay" and f["where"]["joints"] == [JOINT]
    assert f["parameters"]["delay"]["value"] == pytest.approx(DELAY, abs=0.005)  # over what is believed
    assert "first joint (middle_1)" in (out / "report.html").read_text()
