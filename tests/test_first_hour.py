"""`dexsim deploy check`: each step says what the hand behind the fake is like, and a fault lets go of it."""

from __future__ import annotations

import json
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
import yaml
from bundles import make_checkpoint

from dexsim import export
from dexsim.cli import first_hour
from dexsim.cli.main import main
from dexsim.deploy.driver import PASSIVE, VirtualClock
from dexsim.deploy.fake_xhand import FakeXHand, Faults, LaggingHand
from dexsim.deploy.vendor import VendorXHand
from dexsim.errors import UserError
from dexsim.hand import load_hand
from dexsim.recording.reader import read

JOINTS = "thumb_bend_joint,index_joint1"
STEPS = ["connection", "cycles", "signs", "limp", "zero", "taxels", "latency", "lowest"]


def walk(out, hand=LaggingHand, steps=STEPS, more=(), **faults):
    """Return (status, check.json, the fake, what was said)."""
    clock, said = VirtualClock(5.0), []
    package = partial(FakeXHand, make=hand, faults=Faults(**{"outlier": 0.0, "press": 11} | faults))
    driver = VendorXHand("auto", clock, package, side="right")
    given = first_hour.KEYS | {"yes": "true", "joints": JOINTS, "port": "fake"} | dict(more)
    status = first_hour.walk(driver, load_hand("xhand"), clock, steps, given, out, said.append)
    return status, json.loads((out / "check.json").read_text()), driver.body._sdk, "\n".join(said)


class Sticky(LaggingHand):
    """Needs a current to move at all, follows late, and turns one joint the wrong way if asked."""

    def __init__(self, need=0.0, wrong=False, dead=0.0):
        super().__init__(least=need)
        self.wrong, self.dead, self.past = wrong, dead, []

    def command(self, c):
        self.past.append((self.time, c))
        due = [c for t, c in self.past if t <= self.time - self.dead + 1e-9]
        if due:
            super().command(due[-1])
        if self.wrong:
            self.target[4] = 1.34 - self.target[4]


@pytest.mark.slow
def test_all_steps_of_a_good_hand(tmp_path):
    status, found, fake, said = walk(tmp_path)
    assert status == 0 and not found["stopped"] and "the hand is let go: " in said
    steps = found["steps"]
    assert {n: s["verdict"] for n, s in steps.items()} == dict.fromkeys(STEPS, "good") | {"limp": "look"}
    assert steps["connection"]["figures"]["serial"] == "FAKE0001"
    assert 100 < steps["cycles"]["figures"]["rate_Hz"] < 106
    assert steps["cycles"]["figures"]["jitter_rad"] == pytest.approx(0.0014, rel=0.2)
    assert steps["taxels"]["figures"]["ring"]["guess"] == "as in our layout"
    assert all(q[3].max() <= 300 for _, q in fake.trips), "no step goes beyond excite_current="
    low, high = load_hand("xhand").limits.T
    sent = np.stack([q[2] for _, q in fake.trips if q[0] != PASSIVE])
    assert (sent >= low - 1e-6).all() and (sent <= high + 1e-6).all() and fake.trips[-1][1][0] == PASSIVE
    page = (tmp_path / "report.html").read_text()
    assert "Cycle times" in page and "data:image/png" in page and "look</span> Does letting go" in page
    assert len(read(tmp_path / "check.mcap", audit=False).states.position) > 2000


@pytest.mark.slow
def test_what_is_planted_is_found(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    _, late, *_ = walk(tmp_path / "a", partial(Sticky, dead=0.05), ["latency"])
    _, soon, *_ = walk(tmp_path / "b", Sticky, ["latency"])
    median = lambda d: np.median(sum(d["steps"]["latency"]["figures"]["ms"].values(), []))  # noqa: E731
    assert median(late) - median(soon) == pytest.approx(50, abs=12) and median(soon) < 30


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hand", "steps", "faults", "says"),
    [
        (partial(Sticky, need=155.0), ["signs", "lowest"], {}, "needed more than current=: thumb_bend_joint 200 mA"),
        (partial(Sticky, wrong=True), ["signs"], {}, "index_joint1 went the wrong way"),
        (partial(Sticky, need=1000.0), ["signs"], {}, "thumb_bend_joint went 0.00 of"),
        (LaggingHand, ["zero"], {"board": 3}, "boards that say nothing: ring"),
        (LaggingHand, ["taxels"], {"press": 119}, "columns are mirrored"),
        (LaggingHand, ["taxels"], {"press": -1}, "nobody pressed it"),
        (partial(LaggingHand, start=0.4, push=-0.06), ["limp"], {"limp": "never"}, "still resists"),
    ],
)
def test_each_step_says_what_is_wrong(tmp_path, hand, steps, faults, says):
    _, _, _, said = walk(tmp_path, hand, steps, **faults)
    assert says in said


@pytest.mark.slow
def test_the_lowest_current_is_the_one_that_moves_it(tmp_path):
    _, found, *_ = walk(tmp_path, partial(Sticky, need=155.0), ["signs", "lowest"])
    assert found["steps"]["lowest"]["figures"]["mA"] == {"thumb_bend_joint": 160.0, "index_joint1": 160.0}


@pytest.mark.slow
@pytest.mark.parametrize("dead", [pytest.param(-1, marks=pytest.mark.slow), 37])
def test_the_calibration_finds_a_dead_taxel_and_the_force_of_a_current(tmp_path, monkeypatch, dead):
    monkeypatch.setattr(first_hour, "PRESSES", 30)
    more = {"joints": "index_joint1"}
    _, found, _, said = walk(tmp_path, LaggingHand, ["taxels", "calibrate"], more, dead=dead)
    step, right = found["steps"]["calibrate"], "0 dead" if dead < 0 else f"dead: [{dead}]"
    assert (tmp_path / "calibration" / "calibration.yaml").is_file(), said
    assert all(right in text for text in step["figures"]["pads"].values()), said
    of = yaml.safe_load((tmp_path / "calibration" / "calibration.yaml").read_text())["joints"]["index_joint1"]
    assert of["alpha"]["value"] == pytest.approx(12, rel=0.05), "six taxels of 0.02 counts a mA, of 0.1 N"
    lever = of["beta"]["value"]
    assert step["figures"]["A_per_Nm"]["index_joint1"] == pytest.approx(lever / 12, rel=0.1), said


@pytest.mark.parametrize("fault", [{"refuse_s": 3.0}, {"freeze_s": 3.0}, {"silent_s": 3.0}])
def test_a_fault_in_a_step_lets_go_and_keeps_the_report(tmp_path, fault):
    status, found, fake, said = walk(tmp_path, **fault)
    assert status == 1 and found["stopped"] and "let go:" in said and (tmp_path / "report.html").is_file()
    assert not any(q[3].any() for t, q in fake.trips if t > 3.2)


def test_the_command_line_is_checked_before_anything_moves(tmp_path, capsys):
    for argument, says in (("steps=all", "steps=all"), ("current=2", "current=2"), ("joints=x", "joints=x"),
                           ("port=fake:x=1", "x: unknown; valid"), ("yes=1", "yes=1"), ("z=1", "'z=1'")):  # fmt: skip
        args = [] if argument.startswith("port") else ["port=fake"]
        assert main(["deploy", "check", *args, "yes=true", f"out={tmp_path / 'o'}", argument]) == 2, argument
        err = capsys.readouterr().err
        assert says in err and err.count("\n") == 1
    with pytest.raises(UserError, match="must be xhand or sim"):
        first_hour.make_driver(first_hour.KEYS | {"driver": "x"}, load_hand("xhand"))


SERVO = """
drive: torque
joints:
  "*": {kp: 4.0, torque_limit: 1.1}
  index_joint1: {kp: {value: 1.9, low: 1.7, high: 2.1}, delay: {value: 0.05, low: 0.045, high: 0.055}}
fitted: {index_joint1: {kp: 1.9}}
"""


@pytest.mark.slow
def test_a_hand_is_held_against_what_a_bundle_was_trained_for(tmp_path, monkeypatch):
    """Slower by 60 ms, softer by its fitted drive, short of its range by half a radian, of another force for a
    current: each is said."""
    monkeypatch.setattr(first_hour, "PRESSES", 30)

    class Short(Sticky):
        def advance(self, t):
            self.target[4] = min(self.target[4], 1.4)
            super().advance(t)

    made = export.export(str(make_checkpoint(tmp_path / "policy.pt")), tmp_path / "bundle", steps=2)
    (tmp_path / "servo.yaml").write_text(SERVO)
    given = {"bundle": str(made), "joints": "index_joint1"}
    steps = ["cycles", "signs", "latency", "taxels", "calibrate", "bundle"]
    _, found, _, said = walk(tmp_path, partial(Short, dead=0.06), steps, given)
    step = found["steps"]["bundle"]
    assert step["verdict"] == "look" and "your hand is slower than what this policy was trained for" in said
    assert step["figures"]["latency_ms"] - step["figures"]["trained_ms"] > 30
    assert "index_joint1: kp is 1.9 N.m/rad, training drew 3 to 5" in said
    assert "index_joint1: delay is 0.05 s, training drew 0.01 to 0.025" in said
    assert "the policy's targets go farther than the hand: index_joint1" in said and "short of their range" in said
    assert "encoders at rest 0.0014 rad, in training 0.003" in said
    here, trained = step["figures"]["A_per_Nm"]["index_joint1"]
    assert here == found["steps"]["calibrate"]["figures"]["A_per_Nm"]["index_joint1"]
    assert (abs(here / trained - 1) > 0.2) == (f"index_joint1 {here:.2f} for {trained:.2f}" in said), said
    assert abs(here / trained - 1) > 0.2, "the fake's force of a current is another than the bundle's"


@pytest.mark.slow
def test_the_whole_hour_on_the_fake_with_the_simulated_hand(tmp_path):
    """In simulated time, with the excitation, its audit, its diagnosis and the calibration of touch."""
    done = subprocess.run(
        [sys.executable, "-m", "dexsim", "deploy", "check", "port=fake:press=11", "yes=true", f"out={tmp_path / 'o'}",
         "joints=index_joint1,index_joint2", "excite_current=1500", "kinds=steps", "limit=60"],
        capture_output=True, text=True, timeout=800,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    names = {p.name for p in (tmp_path / "o").iterdir()}
    assert names >= {"report.html", "check.json", "check.mcap", "excite.mcap", "servo.yaml", "audit.txt", "calibration"}
