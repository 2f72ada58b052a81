"""What a diagnosis hands on: servo.yaml as the centre and width of randomization, model.xml as the hand."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from test_gap import demo, motion
from worlds import grasp_cfg, grasp_env

from dexsim.actuator.columns import INDEX
from dexsim.actuator.table import ServoTable
from dexsim.errors import UserError
from dexsim.gap.diagnosis import Settings, diagnose, save
from dexsim.gap.finding import Finding
from dexsim.recording import write
from dexsim.recording.mechanism import drive, mechanism, recorded
from dexsim.recording.realistic import realistic
from dexsim.recording.schema import COMMANDS, Series
from tools.assets import xhand

JOINT = "index_joint2"


@pytest.fixture(scope="module")
def hand_servo(tmp_path_factory):
    """Return the servo.yaml of a diagnosis of one xHand joint that hides dry friction, and the folder."""
    folder = tmp_path_factory.mktemp("handed")
    m = mechanism()
    m.table.set(JOINT, "coulomb_friction", 0.06)
    paths = []
    for k in range(3):
        t, value = motion(k, 5.0, k)
        q = 0.8 + 0.5 * value / np.abs(value).max()
        value = np.tile(q, (1, 1)).T
        initial = np.full(12, 0.1)
        initial[xhand.JOINTS.index(JOINT)] = q[0]
        series = Series(t, value, COMMANDS, t.copy())
        run = drive(m, series, [JOINT], 5.0, initial, timestep=0.002)
        r = realistic(recorded(run, m, series, [JOINT]), seed=k)
        r.meta["servo"] = ""
        j = r.joints.index(JOINT)
        r.joints = (JOINT,)
        r.meta["joint_names"] = JOINT
        for s in (r.commands, r.states.position):
            s.value = s.value[:, j : j + 1]
        r.states.effort = r.states.velocity = None
        path = folder / f"{k}.mcap"
        write(path, r)
        paths.append(path)
    d = diagnose(Settings(paths, folder / "out", next_recording=False), say=lambda _: None)
    save(d, folder / "out")
    return d, folder / "out"


@pytest.mark.slow
def test_fit_becomes_centre_and_width_of_randomization(hand_servo):
    """Recording -> diagnosis -> `train.py servo_file=`: the fitted column of that joint is drawn from its interval, in
    every world."""
    d, out = hand_servo
    assert any(f["effect"] == "coulomb_friction" and f["where"]["joints"] == [JOINT] for f in d.data["findings"]), (
        d.data["findings"]
    )
    value = ServoTable.load(out / "servo.yaml").value(JOINT, "coulomb_friction")
    assert value.low < value.value < value.high and value.value == pytest.approx(0.06, rel=0.2)
    env = grasp_env(f"servo_file={out / 'servo.yaml'}", worlds=64)
    j, c = xhand.JOINTS.index(JOINT), INDEX["coulomb_friction"]
    drawn = env.servo.params[:, j, c].double()
    wide = value.high - value.low
    assert float(drawn.min()) >= value.low - 1e-9 and float(drawn.max()) <= value.high + 1e-9
    assert float(drawn.max() - drawn.min()) > 0.8 * wide and float(drawn.mean()) == pytest.approx(
        0.5 * (value.low + value.high), abs=0.2 * wide
    )
    first = drawn.clone()
    env.reset_all()
    assert not torch.equal(first, env.servo.params[:, j, c].double())  # anew at each episode
    # not diagnosed: the configured randomization
    other = env.servo.params[:, xhand.JOINTS.index("mid_joint2"), c].double()
    assert not ((other >= value.low) & (other <= value.high)).all()


@pytest.mark.parametrize(
    "fitted, low, high, sure, after",
    [
        (0.25, 0.2, 0.3, 0.14, (0.2, 1.09)),
        (1.5, 1.4, 1.6, 0.5, (1.09, 1.6)),
        (1.0, 0.9, 1.2, 0.3, (0.9, 1.2)),
        (0.25, 0.2, 0.3, 0.75, (0.2, 0.67)),
        (1.0, 0.99, 1.01, 0.999, (0.99, 1.01)),
    ],
)
def test_what_is_doubted_is_handed_on_with_a_range_towards_what_was_believed(fitted, low, high, sure, after):
    """An effect that is not sure: its range is widened to the belief (1.09), half of the way at 0.75; its fitted value
    stays, other columns do not move."""
    from types import SimpleNamespace

    from dexsim.gap.judge.handed_on import widen

    table = ServoTable.from_dict({"joints": {"*": {"kp": 2.0, "torque_limit": 1.09}}})
    table.set(JOINT, "torque_limit", fitted, low, high)
    table.set(JOINT, "delay", 0.02, 0.018, 0.022)
    case = SimpleNamespace(joint=JOINT, scales=SimpleNamespace(nominal={"torque_limit": 1.09, "delay": 0.01}))
    member = SimpleNamespace(variant=SimpleNamespace(params=[SimpleNamespace(columns=("torque_limit",))]))
    assert widen(table, case, member, sure) == (after != (low, high))
    now, other = table.value(JOINT, "torque_limit"), table.value(JOINT, "delay")
    assert (now.value, now.low, now.high) == (fitted, *after) and (other.low, other.high) == (0.018, 0.022)


def test_what_reproduces_what_was_held_out_is_handed_on_as_fitted_whatever_its_name_is_worth():
    """By hand: half of a tenth less error earns 0.5, a rival with 0.4 takes 0.4 of it; at a confidence of 0.5 the way
    to the belief (1.09) is then 1 - 0.3 of 0.84."""
    from types import SimpleNamespace

    from dexsim.gap.judge.handed_on import earned, widen

    rivals = lambda others: [{"effect": "lag", "confidence": c} for c in others]  # noqa: E731
    held = lambda after: {"before": 1.0, "after": after}  # noqa: E731
    found = lambda after, *others: Finding("", 1.0, "", held_out=held(after), alternatives=rivals(others))  # noqa: E731
    assert [earned(found(x)) for x in (1.2, 1.0, 0.95, 0.9, 0.2)] == pytest.approx(
        [0.0, 0.0, 0.5, 1.0, 1.0]
    ) and earned(Finding("", 1.0, "")) == 0.0
    assert earned(found(0.95, 0.3, 0.1)) == pytest.approx(0.3)
    case = SimpleNamespace(joint=JOINT, scales=SimpleNamespace(nominal={"torque_limit": 1.09}))
    member = SimpleNamespace(variant=SimpleNamespace(params=[SimpleNamespace(columns=("torque_limit",))]))
    for worth, high in ((0.0, 1.09), (0.3, 0.25 + 0.7 * 0.84), (1.0, 0.3)):
        table = ServoTable.from_dict({"joints": {"*": {"kp": 2.0, "torque_limit": 1.09}}})
        table.set(JOINT, "torque_limit", 0.25, 0.2, 0.3)
        assert widen(table, case, member, 0.5, worth) == (high > 0.3) and table.value(
            JOINT, "torque_limit"
        ).high == pytest.approx(high)


PLAY = {
    "backlash": {"value": 0.03, "low": 0.02, "high": 0.04},
    "rebound": 0.1,
    "speed_lag": {"value": 0.01, "low": 0.005, "high": 0.02},
    "eccentric_sin": {"value": 0.05, "low": 0.04, "high": 0.06},
    "sag": {"value": 0.05, "low": 0.02, "high": 0.08},
    "coupling": {"value": 0.1, "low": 0.05, "high": 0.15},
    "coupling_from": 4,
    "thermal_friction": 0.02,
    "warmth": {"value": 10.0, "low": 0.0, "high": 25.0},
}


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mujoco", pytest.param("warp", marks=pytest.mark.slow)])
def test_training_has_the_play_and_the_rest_of_it(engine, tmp_path):
    """A servo.yaml with all of it trains: drawn inside the intervals at each episode, on that joint alone; the joint
    hangs in its play; the policy sees what the eccentric encoder reports; no host synchronisation."""
    from test_nosync import NoSync, _strict

    table = xhand_table()
    for name, value in PLAY.items():
        table.set(
            JOINT, name, *((value["value"], value["low"], value["high"]) if isinstance(value, dict) else (value,))
        )
    table.loop_encoder = "motor"
    table.save(tmp_path / "servo.yaml")
    env = grasp_env(f"servo_file={tmp_path / 'servo.yaml'}", worlds=16, engine=engine)
    assert env.servo.features == {"play", "sag", "rare"} and env.servo.misread
    j = xhand.JOINTS.index(JOINT)
    for name, value in PLAY.items():
        if isinstance(value, dict):
            x = env.servo.column(name)
            assert value["low"] - 1e-6 <= float(x[:, j].min()) < float(x[:, j].max()) <= value["high"] + 1e-6
    assert not env.servo.column("backlash")[:, [k for k in range(12) if k != j]].any()
    for _ in range(3):
        env.step(torch.zeros(16, 12))
    if engine == "warp":
        with pytest.MonkeyPatch.context() as strict, NoSync():
            _strict(strict)
            for _ in range(3):
                env.step(torch.zeros(16, 12))
    q = env.engine.t.qpos[:, env.joint_q[j]]
    rotor = env.servo.state[:, j, env.servo.slots["rotor"]]
    gap = env.servo.column("backlash")[:, j]
    assert ((rotor - q).abs() < 0.5 * gap + 0.02).all() and ((rotor - q).abs() > 1e-4).any()
    seen = env.servo.measured(env.engine.t.qpos[:, env.joint_q])[:, j]
    torch.testing.assert_close(env.q[:, j].double(), seen.double(), atol=1e-6, rtol=0)
    assert (env.q[:, j] - q).abs().max() > 1e-3
    assert torch.isfinite(env.q).all() and not env.nan.any()


@pytest.mark.slow
def test_a_hand_with_play_in_every_joint_holds_what_it_catches(tmp_path):
    """Light links behind a gap, in contact at the tasks' step of 7 ms: objects are not thrown, nothing diverges."""
    table = xhand_table()
    for joint in xhand.JOINTS:
        table.set(joint, "backlash", 0.03, 0.02, 0.04)
    table.loop_encoder = "motor"
    table.save(tmp_path / "servo.yaml")
    caught = []
    for settings in ((), (f"servo_file={tmp_path / 'servo.yaml'}",)):
        env = grasp_env(*settings, worlds=16, seed=1)
        policy, obs = env.scripted_policy(), env.get_observations()
        fastest = 0.0
        for k in range(70):  # 1.5 s: caught
            obs, *_ = env.step(policy(obs))
            fastest = max(fastest, float(env.object_velocity[:, :3].norm(dim=1).max())) if k > 2 else 0.0
        caught.append(int((env.object_pose[:, 2] > 0.0).sum()))
        assert not env.nan.any() and fastest < 3.0, fastest
    assert caught[1] >= caught[0] - 3 and caught[0] >= 10, caught


def test_model_file_is_the_hand_that_trains(tmp_path):
    from types import SimpleNamespace

    from dexsim.gap.judge.handed_on import model_changes, save_model

    spec = xhand.hand_spec()
    case = SimpleNamespace(joint=JOINT)
    said = model_changes(spec, case, None, {"inertia": {"armature": 3e-4}, "payload": {"mass": 0.015}})
    assert len(said) == 2
    path = tmp_path / "model.xml"
    save_model(spec, path)
    plain, changed = xhand.hand_spec().compile(), mujoco.MjModel.from_xml_path(str(path))
    assert changed.body_mass.sum() == pytest.approx(plain.body_mass.sum() + 0.015)
    env = grasp_env(f"model_file={path}", worlds=2)
    e = env.engine
    dof = e.dof_index([JOINT])[0]
    base = grasp_env(worlds=2).engine
    assert e.mjm.dof_armature[dof] == pytest.approx(base.mjm.dof_armature[base.dof_index([JOINT])[0]] + 3e-4)
    assert e.mjm.body_mass.sum() == pytest.approx(base.mjm.body_mass.sum() + 0.015, rel=1e-6)
    env.step(torch.zeros(2, 12))
    for text, word in (
        ("nowhere.xml", "no such file"),
        (str(_write(tmp_path / "other.xml", demo.MODEL)), "is not a model of hand=xhand: it lacks thumb_bend_joint"),
    ):
        with pytest.raises(UserError, match=word):
            grasp_env(f"model_file={text}", worlds=2)


@pytest.mark.parametrize(("kd", "after"), [(0.1, 0.096), (0.002, 0.0), ("unknown", None)])
def test_damping_that_a_loops_age_takes_is_not_handed_on(kd, after):
    """kp (q - age v): a loop that acts on where the joint was 1 ms ago has kp * age less damping; where kd is unknown
    there is none to take it from."""
    from types import SimpleNamespace

    from dexsim.gap.judge.handed_on import missing_of, servo_changes
    from dexsim.gap.plant.columns import Param

    table = ServoTable.from_dict({"joints": {"*": {"kp": 4.0, "kd": kd}}})
    age = Param("feedback_delay", ("feedback_delay",), "set", 0.0, 0.003, 0.0, "s", nuisance=True)
    case = SimpleNamespace(
        joint=JOINT, ranges={}, constants=SimpleNamespace(armature=1e-4), scales=SimpleNamespace(nominal={})
    )
    trial = SimpleNamespace(members=(), fit=SimpleNamespace(params=(age,), x=np.array([0.001])))
    servo_changes(table, case, trial, np.array([[0.0, 0.002]]), xhand.JOINTS)
    assert missing_of(case, trial) == ()
    assert table.value(JOINT, "kd").value == (None if after is None else pytest.approx(after))


def xhand_table() -> ServoTable:
    return ServoTable.from_dict(grasp_cfg()["servo"])


def _write(path, text):
    path.write_text(text)
    return path

