"""A joint that something outside pushes in stretches of time: said with when and how hard, and not taken for physics of
its own."""

from __future__ import annotations

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from test_gap_torque_route import ARM, arm, run

from dexsim.gap.finding import Finding
from dexsim.gap.inquiry import Judged
from dexsim.gap.judge import conclude
from dexsim.gap.search import logged_torque

SPANS = ((4.0, 6.5), (11.0, 12.5), (16.0, 18.0))


def shove(t: np.ndarray, size: float = 6.0) -> np.ndarray:
    """Return N.m on the elbow: half waves within SPANS."""
    return sum(size * np.where((t > a) & (t < b), np.sin(np.pi * (t - a) / (b - a)), 0.0) for a, b in SPANS)


def test_pushes_are_told_with_when_and_how_hard():
    model = arm()
    runs = [run(model, 0, pushed=shove), run(model, 1)]
    pushes = logged_torque.find_pushes(model, runs, [0, 1])
    assert [p.joint for p in pushes] == ["elbow"]
    (push,) = pushes
    assert push.clear and push.torque == pytest.approx(6.0, rel=0.1) and set(push.spans) == {"run0.mcap"}
    t = runs[0].t
    inside = lambda spans: np.any([(t >= a) & (t <= b) for a, b in spans], 0)  # noqa: E731
    found, true = inside(push.spans["run0.mcap"]), np.abs(shove(t)) > 0.25 * 6.0
    assert (found & true).sum() / (found | true).sum() > 0.8
    finding = push.finding()
    assert finding.effect == "external_force" and finding.confidence >= 0.8 and len(finding.when) == 3
    assert finding.parameters["torque"]["low"] < 6.0 < finding.parameters["torque"]["high"] * 1.05
    assert "in 3 stretches of time, forwards" in finding.regime


@pytest.mark.parametrize("size", [3.0, 6.0])
@pytest.mark.parametrize("cogging", [0.0, 0.08])
def test_the_size_of_a_push_lies_inside_its_interval(size, cogging):
    """For a steady push: the largest sample is not its size. At its edges the torque's filter swings over by an eighth,
    and the body is not exactly what the fit can say."""
    model, true = arm(), []
    steady = lambda t: size * np.any([(t > a) & (t < b) for a, b in SPANS], 0)  # noqa: E731
    for k in (0, 1):
        r = run(model, 2 * k, pushed=steady if k == 0 else None, friction=(0.1, 0.05))
        r.torque[:, 1] += cogging * size * np.sin(25.0 * r.q[:, 1])  # cogging
        true.append(r)
    (push,) = (p for p in logged_torque.find_pushes(model, true, [0, 1]) if p.joint == "elbow")
    torque = push.finding().parameters["torque"]
    assert torque["low"] < size < torque["high"] and torque["value"] == pytest.approx(size, rel=0.06)
    assert torque["high"] - torque["low"] < 0.5 * size
    sample = logged_torque.Push("elbow", 0.906, (0.7, 1.0), 0.5, True, False).finding().parameters["torque"]
    assert (sample["value"], sample["low"], sample["high"]) == (0.906, 0.7, 1.0)


def test_nothing_is_told_where_nothing_pushes():
    model = arm()
    assert logged_torque.find_pushes(model, [run(model, 0), run(model, 1, friction=(1.5, 0.6))], [0, 1]) == []


def test_what_lasts_no_longer_than_a_jump_of_the_target_is_no_push():
    """The drive asks for it; what pushes on after a jump, as what a joint hits does, is told."""
    t = np.arange(0, 20, 0.01)
    jump = SimpleNamespace(cmd_t=t, cmd=np.stack([np.sin(0.3 * t), 1.0 * (t > 5.0)], 1))
    thrown = lambda a, b, joints=(0, 1): logged_torque.thrown((a, b), jump, joints)  # noqa: E731
    assert thrown(4.9, 5.15) and not thrown(4.9, 5.15, (0,))
    assert not thrown(4.9, 5.5) and not thrown(7.0, 7.1)


def test_what_friction_carries_at_rest_and_noise_are_no_push():
    model, rng = arm(), np.random.default_rng(3)
    r = run(model, 0)  # from 12 s on it stands, its motors pulling within their friction
    start = int(np.argmax(r.t > 12.0))
    r.q[start:] = r.q[start] + 1e-5 * rng.standard_normal((len(r.t) - start, 2))
    data = mujoco.MjData(model)
    data.qpos[:] = r.q[start]
    mujoco.mj_forward(model, data)
    r.torque[start:] = data.qfrc_bias + 0.9 * np.array([0.5, 0.2]) * np.sin(2 * np.pi * 0.5 * r.t[start:])[:, None]
    assert logged_torque.find_pushes(model, [r], [0]) == []
    loud = run(model, 1)
    loud.torque += 8.0 * rng.standard_normal(loud.torque.shape)
    assert logged_torque.find_pushes(model, [loud], [0]) == []


def test_a_joint_that_rests_between_counts_or_is_not_asked_about_is_pushed_by_nobody(monkeypatch):
    model, rng = arm(), np.random.default_rng(4)
    r = run(model, 0)
    slow = lambda n: rng.standard_normal(len(r.t) // n + 1).repeat(n)[: len(r.t)]  # noqa: E731
    r.torque[:, 1] = slow(20)
    assert logged_torque.find_pushes(model, [r], [0], asked=["shoulder"]) == []
    r.q[:, 1] = 0.4 + 0.0015 * (slow(40) > 0)  # its encoder says one of two counts
    assert logged_torque.find_pushes(model, [r], [0]) == []
    monkeypatch.setattr(logged_torque, "TRAVEL", 0.0)
    assert [p.joint for p in logged_torque.find_pushes(model, [r], [0])] == ["elbow"]


def test_a_torque_that_is_not_the_joints_own_claims_nothing_of_it():
    model = arm()
    r = run(model, 0)
    r.torque[:, 1] = np.random.default_rng(0).standard_normal(len(r.t) // 20 + 1).repeat(20)[: len(r.t)]
    (push,) = logged_torque.find_pushes(model, [r], [0])
    assert not push.clear and push.finding().confidence < 0.5
    size = {"torque": {"value": 0.5, "low": 0.4, "high": 0.6, "unit": "N.m"}}
    held = {"before": 0.02, "after": 0.01}
    of = lambda effect, joint: Finding(effect, 0.7, "", [joint], held_out=held, parameters=size)  # noqa: E731
    data = {
        "noise_floor": {"position_rad": 0.01},
        "held_out": {},
        "baseline": {},
        "unexplained": {"depends_on": []},
    }
    d = SimpleNamespace(data=data, notes=[], sentence="", mechanism=None, joints={}, outcomes=[], touch=None)
    d.findings = [of("torque_ripple", "elbow"), of("coulomb_friction", "shoulder")]
    d.ringing, d.judged = frozenset(), Judged(held | {"before_low": 0.02, "error": "position_rmse_rad"})
    conclude.claim_push(d, [push])
    assert [f.effect for f in d.findings] == ["external_force", "coulomb_friction"]
    assert len(d.notes) == 1
    conclude.decide(d)
    assert d.data["verdict"] == "partly_explained"  # the friction is not sure
    assert d.sentence.startswith("Joint shoulder") and "elbow" not in d.sentence  # what is known of that is a hint
    assert [f.get("hint", False) for f in d.data["findings"]] == [False, True]
    push.clear = True
    d.findings = [push.finding()]
    conclude.decide(d)
    assert d.sentence.startswith("Joint elbow is pushed by something outside") and d.data["verdict"] == "unknown"


@pytest.mark.slow
def test_a_diagnosis_says_it_first_and_judges_by_the_rest(tmp_path):
    from benchmarks.real.common import rig, save
    from dexsim.gap.diagnosis import Settings, diagnose

    model, made = arm(), []
    believed = {
        "kp": 80.0,
        "kd": 3.0,
        "torque_limit": 40.0,
        "coulomb_friction": "unknown",
        "viscous_friction": "unknown",
    }
    _, servo = rig(tmp_path, "arm", ARM, {"drive": "torque", "joints": {"*": believed}})
    for k in range(3):
        r = run(model, k, pushed=shove if k == 1 else None)
        cmd = r.q + (r.torque + 3.0 * np.gradient(r.q, r.t, axis=0)) / 80.0
        made.append(save(tmp_path / f"r{k}.mcap", r.joints, r.t, cmd, r.t, r.q, effort=r.torque, gravity="0 0 -9.81"))
    settings = Settings(
        made[:2],
        tmp_path,
        made[2:],
        str(tmp_path / "arm.xml"),
        str(servo),
        next_recording=False,
        replay="none",
        allowed={"viscous_friction"},
        joints={"elbow"},
    )
    d = diagnose(settings, say=lambda _: None)
    assert d.sentence.startswith("Joint elbow is pushed by something outside")
    first = d.data["findings"][0]
    assert first["effect"] == "external_force" and {w["recording"] for w in first["when"]} == {"r1.mcap"}
    assert all(f["confidence"] < 0.5 for f in d.data["findings"][1:])
    assert any("judged by the" in n for n in d.notes)  # without those stretches
    assert d.servo.value("elbow", "coulomb_friction").value == pytest.approx(0.2, rel=0.05)
