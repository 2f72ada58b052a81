"""The torque route through gravity and coupled joints, at 100 Hz: friction read off the recorded torque of a two-link
arm."""

from __future__ import annotations

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from dexsim.actuator.columns import INDEX
from dexsim.actuator.table import ServoTable
from dexsim.gap.search import logged_torque
from dexsim.gap.search.inverse_dynamics import body, motion
from dexsim.gap.search.search import SearchedJoint

ARM = """<mujoco><compiler angle="radian"/><worldbody><body name="upper">
 <joint name="shoulder" axis="0 1 0" armature="0.02" damping="0.05"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" mass="2"/><body name="lower" pos="0 0 -0.4">
 <joint name="elbow" axis="0 1 0" armature="0.01"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="1"/></body></body></worldbody></mujoco>"""
JOINTS = ("shoulder", "elbow")
COULOMB, VISCOUS, OFFSET = (0.5, 0.2), (0.3, 0.1), (0.05, -0.03)


def arm() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ARM)


def run(
    model: mujoco.MjModel,
    seed: int,
    seconds: float = 20.0,
    rate: float = 100.0,
    friction=COULOMB,
    viscous=VISCOUS,
    pushed=None,
):
    """Return a recording of the arm by exact inverse dynamics; pushed(t) [S]: what something outside adds to the elbow,
    N.m."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, seconds, 1 / rate)
    w = 2 * np.pi * np.array([[0.21, 0.53, 0.83], [0.33, 0.47, 1.07]])
    size, phase = np.array([[0.5, 0.3, 0.1], [0.6, 0.3, 0.1]]), rng.uniform(0, 6, (2, 3))
    wave = lambda f: np.stack([(size[j] * f(j, w[j] * t[:, None] + phase[j])).sum(1) for j in (0, 1)], 1)  # noqa: E731
    q, v, a = (
        wave(lambda j, x: np.sin(x)),
        wave(lambda j, x: w[j] * np.cos(x)),
        wave(lambda j, x: -(w[j] ** 2) * np.sin(x)),
    )
    data, torque = mujoco.MjData(model), np.empty_like(q)
    for i in range(len(t)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[i], v[i], a[i]
        mujoco.mj_inverse(model, data)
        torque[i] = data.qfrc_inverse
    torque += np.array(friction) * np.sign(v) + np.array(viscous) * v + np.array(OFFSET)
    if pushed is not None:
        torque[:, 1] -= pushed(t)  # the motor gives less of what the body needs
    torque += 0.02 * rng.standard_normal(q.shape)
    return SimpleNamespace(
        name=f"run{seed}.mcap",
        joints=JOINTS,
        t=t,
        q=q + 1e-5 * rng.standard_normal(q.shape),
        cmd_t=t,
        cmd=q,
        torque=torque,
        read=None,
        gravity=np.array([0, 0, -9.81]),
        duration=float(t[-1] - t[0]),
    )


def cases() -> list[SimpleNamespace]:
    scales = lambda: SimpleNamespace(nominal={"efficiency": 1.0})  # noqa: E731
    return [SimpleNamespace(joint=j, index=k, moved=True, scales=scales()) for k, j in enumerate(JOINTS)]


def test_friction_of_coupled_joints_under_gravity_is_read_off_at_100_hz():
    model = arm()
    runs = [run(model, 0), run(model, 1)]
    given = logged_torque.identify_joints(cases(), runs, [0], [1], model=model)
    assert [x.case.joint for x in given] == list(JOINTS) and given[0].judges == ["run1.mcap"]
    for joint, coulomb, viscous in zip(given, COULOMB, VISCOUS, strict=True):
        x = joint.inverse
        assert x.value["coulomb_friction"] == pytest.approx(coulomb, rel=0.05)
        assert x.value["viscous_friction"] == pytest.approx(viscous, rel=0.1)  # beyond the model's own damping
        assert x.residual < 0.05 and not x.refused
        assert abs(x.value.get("gravity", 0.0)) < 0.02
    assert given[0].inverse.value["inertia"] == pytest.approx(
        np.median(body(model, np.array([0, 0, -9.81]), JOINTS, moved(runs[0])).inertia[:, 0]), rel=0.05
    )


def moved(r):
    return motion(r.t, r.q, r.torque, 10.0)


def test_a_heavier_arm_is_not_taken_for_friction():
    model, heavy = arm(), arm()
    heavy.body_mass[:] *= 1.1
    heavy.body_inertia[:] *= 1.1
    x = logged_torque.identify_joints(cases(), [run(heavy, 0)], [0], [], model=model)[0].inverse
    assert x.value["gravity"] == pytest.approx(0.1, abs=0.02)
    assert x.value["coulomb_friction"] == pytest.approx(COULOMB[0], rel=0.05)


def test_what_is_held_out_takes_no_part():
    model = arm()
    r = run(model, 0, 40.0)
    r.torque[r.t > 30, 0] += 5.0
    given = logged_torque.identify_joints(
        cases(), [r], [0], [0], model=model, span_train={0: (0.0, 29.5)}, span_test={0: (30.0, 40.0)}
    )
    assert given[0].inverse.value["coulomb_friction"] == pytest.approx(COULOMB[0], rel=0.05)


@pytest.mark.parametrize("fitted_weighs", (True, False))
def test_gravity_may_matter_in_what_is_fitted_alone_or_in_what_is_held_out_alone(fitted_weighs):
    heavy, light = arm(), arm()
    light.opt.gravity[2] = -0.01  # as good as lying
    runs = [run(heavy, 0), run(light, 1)] if fitted_weighs else [run(light, 0), run(heavy, 1)]
    for r, m in zip(runs, (heavy, light) if fitted_weighs else (light, heavy), strict=True):
        r.gravity = m.opt.gravity.copy()
    given = logged_torque.identify_joints(cases(), runs, [0], [1], model=heavy)
    assert [x.judges for x in given] == [["run1.mcap"]] * 2
    for k, x in enumerate(joint.inverse for joint in given):
        assert x.low["coulomb_friction"] < COULOMB[k] < x.high["coulomb_friction"]
        assert all(np.isfinite(n.after) for n in x.named)


def test_a_negative_friction_is_a_refusal_with_a_reason():
    model = arm()
    r = run(model, 0, friction=(0.5, -0.2))
    given = logged_torque.identify_joints(cases(), [r], [0], [], model=model)
    x = given[1].inverse
    assert x.value["coulomb_friction"] == 0.0 and "negative coulomb friction" in x.refused["coulomb_friction"]
    assert "negative coulomb friction" in logged_torque.torque_texts(given)[1] and not given[0].inverse.refused
    for c in cases():
        c.unknown, c.told, c.ranges = ("coulomb_friction",), False, {}
    given[1].case.unknown, given[1].case.told = ("coulomb_friction",), False
    said = logged_torque.believe(given[1:])
    assert len(said) == 1 and "no coulomb friction is taken" in said[0] and not given[1].case.told


def test_readings_too_slow_say_nothing():
    model = arm()
    assert logged_torque.identify_joints(cases(), [run(model, 0, rate=50.0)], [0], [], model=model) == []


def test_the_torques_figures_are_handed_on_where_the_loop_is_not_the_believed_one():
    model = arm()
    given = logged_torque.identify_joints(cases(), [run(model, 0)], [0], [], model=model)
    case, x = given[0].case, given[0].inverse
    case.unknown, case.ranges, case.factors, case.told = ("coulomb_friction", "viscous_friction"), {}, {}, False
    case.scales = SimpleNamespace(nominal={"friction_asymmetry": 0.0}, inertia=x.value["inertia"])
    case.plant = SimpleNamespace(nominal=np.zeros((1, len(INDEX))))
    logged_torque.believe(given[:1])
    servo = ServoTable.from_dict(
        {"drive": "torque", "joints": {"*": {"kp": 80.0, "coulomb_friction": "unknown", "viscous_friction": "unknown"}}}
    )
    nuisance = {"coulomb_friction@shoulder": 9.0}
    trial = SimpleNamespace(members=(), fit=SimpleNamespace(params=[], x=np.zeros(0)))
    search = SimpleNamespace(polished={}, deadline=SimpleNamespace(over=lambda: True))
    searched = [SearchedJoint(case, search, SimpleNamespace(none=trial, best=trial))]
    (own,) = logged_torque.told(
        given[:1], searched, [], None, [SimpleNamespace(joint="shoulder", sound=False)]
    ).values()
    assert own.over(lambda table, spec: ["written"])(servo, None) == ["written"]
    assert "as the recorded torque tells it" in own.note(nuisance)
    friction = servo.value("shoulder", "coulomb_friction")
    assert friction.value == pytest.approx(COULOMB[0], rel=0.05) and friction.low < friction.value < friction.high
    assert nuisance["coulomb_friction@shoulder"] == pytest.approx(friction.value, abs=1e-5)
    assert servo.value("shoulder", "viscous_friction").value == pytest.approx(VISCOUS[0], rel=0.1)
    assert servo.value("elbow", "coulomb_friction").unknown
    notes: list[str] = []
    # of the elbow the torque told nothing
    stage = lambda joint, fit, high=1.1: SimpleNamespace(joint=joint, fit=fit, slope_high=high)  # noqa: E731
    stages = [stage("shoulder", 0.1), stage("elbow", 0.1)]
    given[1].case.told = False
    assert logged_torque.unknown_controllers(given, stages, notes) == {"shoulder"}
    assert "controller is another" in notes[0]
    assert logged_torque.unknown_controllers(given, [stage("shoulder", 0.9)], notes) == set()
    # a law that surely pushes the other way is not the drive's, however well its mirror image fits; one that may be is
    assert logged_torque.unknown_controllers(given, [stage("shoulder", 0.9, -0.05)], notes) == {"shoulder"}
    assert "gives the opposite of the torque" in notes[1]
    assert logged_torque.unknown_controllers(given, [stage("shoulder", 0.9, 0.05)], notes) == set()
