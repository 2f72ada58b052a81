"""The servo.yaml format: what is read, what is written back, and how mistakes are answered."""

from __future__ import annotations

import math

import numpy as np
import pytest
import yaml

from dexsim.actuator import COLUMNS, ServoTable, describe
from dexsim.actuator.columns import INDEX, NAMES
from dexsim.errors import UserError
from dexsim.paths import CONFIGS
from tools.assets.xhand import JOINTS

SERVOS = CONFIGS / "servo"

EXAMPLE = """
drive: torque
joints:
  "*":              {kp: 1.5, kd: 0.03, torque_limit: 1.1, no_load_speed: 8.63}
  index_bend_joint: {kp: 0.8, torque_limit: 0.4, delay: [0.0, 0.02], lag: unknown}
  mid_joint1:       {coulomb_friction: {value: 0.02, low: 0.01, high: 0.05}, kd: 3e-2}
current_per_torque: {"*": 0.9, mid_joint1: unknown}
control_rate: 100
loop_rate: 1000
loop_encoder: {"*": joint, mid_joint1: motor}
position_encoder: motor
supply_voltage: 24.0
"""
JOINTS_HERE = ["mid_joint1", "index_bend_joint", "other"]


@pytest.fixture
def example(tmp_path) -> ServoTable:
    path = tmp_path / "servo.yaml"
    path.write_text(EXAMPLE)
    return ServoTable.load(path)


def test_the_more_specific_wins_and_the_absent_is_ideal(example):
    table = example.nominal(JOINTS_HERE)
    np.testing.assert_array_equal(table[:, INDEX["kp"]], [1.5, 0.8, 1.5])
    np.testing.assert_array_equal(table[:, INDEX["torque_limit"]], [1.1, 0.4, 1.1])
    np.testing.assert_array_equal(table[:, INDEX["delay"]], [0.0, 0.01, 0.0])  # middle of its range
    np.testing.assert_array_equal(table[:, INDEX["coulomb_friction"]], [0.02, 0.0, 0.0])
    named = {"kp", "kd", "torque_limit", "no_load_speed", "delay", "coulomb_friction"}
    for c in COLUMNS:
        if c.name not in named:
            assert (table[:, INDEX[c.name]] == c.neutral).all()


def test_ranges_and_unknowns(example):
    low, high = example.bounds(JOINTS_HERE)
    assert (low[1, INDEX["delay"]], high[1, INDEX["delay"]]) == (0.0, 0.02)
    assert (low[0, INDEX["coulomb_friction"]], high[0, INDEX["coulomb_friction"]]) == (0.01, 0.05)
    assert low[0, INDEX["kp"]] == high[0, INDEX["kp"]] == 1.5
    unknown = example.unknown(JOINTS_HERE)
    assert unknown.sum() == 1 and unknown[1, INDEX["lag"]]
    assert high[1, INDEX["lag"]] == COLUMNS[INDEX["lag"]].high
    assert example.nominal(JOINTS_HERE)[1, INDEX["lag"]] == 0.0
    np.testing.assert_array_equal(example.current(JOINTS_HERE), [np.nan, 0.9, 0.9])
    assert example.encoder("loop", JOINTS_HERE) == ["motor", "joint", "joint"]
    assert example.encoder("position", JOINTS_HERE) == ["motor"] * 3
    assert (example.control_rate, example.loop_rate, example.supply_voltage) == (100.0, 1000.0, 24.0)


def test_round_trip(example, tmp_path):
    example.set("mid_joint1", "load_friction", 0.2, 0.1, 0.3)
    example.set("mid_joint1", "lag", None)
    example.set("*", "torque_limit", math.inf)
    path = tmp_path / "fitted.yaml"
    example.save(path)
    again = ServoTable.load(path)
    assert again.to_dict() == example.to_dict()
    np.testing.assert_array_equal(again.nominal(JOINTS_HERE), example.nominal(JOINTS_HERE))
    np.testing.assert_array_equal(again.bounds(JOINTS_HERE), example.bounds(JOINTS_HERE))
    written = yaml.safe_load(path.read_text())["joints"]["mid_joint1"]
    assert written["load_friction"] == {"value": 0.2, "low": 0.1, "high": 0.3} and written["lag"] == "unknown"
    assert [p.name for p in tmp_path.iterdir() if p.suffix == ".part"] == []


DYNAMIXEL = {"xl330_m288": 0.52, "xc330_m288": 0.93}  # N.m at stall, 5 V


@pytest.mark.parametrize("name", sorted(p.stem for p in SERVOS.glob("*.yaml")))
def test_shipped_servos(name):
    table = ServoTable.load(SERVOS / f"{name}.yaml")
    table.check_joints(JOINTS)
    if name in DYNAMIXEL:  # one motor, the same at every joint
        np.testing.assert_allclose(table.nominal(JOINTS)[:, INDEX["torque_limit"]], DYNAMIXEL[name], rtol=1e-6)
        return
    nominal = table.nominal(JOINTS)
    strong = [j for j in JOINTS if j not in ("thumb_rota_joint2", "index_bend_joint") and not (
        j.endswith("_joint2") and not j.startswith("thumb"))]  # fmt: skip
    limit = nominal[:, INDEX["torque_limit"]]
    np.testing.assert_array_equal(limit, [1.1 if j in strong else 0.4 for j in JOINTS])
    np.testing.assert_array_equal(nominal[:, INDEX["kp"]], np.where(limit > 1, 4.0, 1.5))
    if name == "xhand":
        np.testing.assert_array_equal(nominal[:, INDEX["no_load_speed"]], np.where(limit > 1, 8.63, 14.38))
    else:
        assert (nominal[:, INDEX["delay"]] == 0).all() and np.isinf(nominal[:, INDEX["no_load_speed"]]).all()


@pytest.mark.parametrize(
    "text, said",
    [
        ("joints: {j: {kp: -1}}", ["joints.j.kp=-1", "0 to 100000 N.m/rad"]),
        ("joints: {j: {kpp: 1}}", ["joints.j.kpp", "Did you mean 'kp'", "coulomb_friction"]),
        ("joints: {j: {kp: fast}}", ["joints.j.kp=fast", "must be a number or 'unknown'", "N.m/rad"]),
        ("joints: {j: {kp: .nan}}", ["joints.j.kp", "a number"]),
        ("joints: {j: {kp: true}}", ["joints.j.kp", "a number"]),
        ("joints: {j: {kp: [2, 1]}}", ["joints.j.kp", "must rise"]),
        ("joints: {j: {kp: [1, 2, 3]}}", ["joints.j.kp", "[low, high]"]),
        ("joints: {j: {kp: {value: 3, low: 1, high: 2}}}", ["joints.j.kp", "must rise"]),
        ("joints: {j: {kp: {low: 1, high: 2}}}", ["joints.j.kp", "{value, low, high}"]),
        ("joints: {j: {torque_limit: [1, .inf]}}", ["joints.j.torque_limit", "no middle"]),
        ("joints: {j: 3}", ["joints.j (3)", "expected `object"]),
        ("joints: [1]", ["joints ([1])", "expected `object"]),
        ("drive: volt", ["drive ('volt')", "torque, voltage"]),
        ("joint: {}", ["'joint'", "Did you mean 'joints'"]),
        ("control_rate: 0", ["control_rate (0.0)", "> 0"]),
        ("supply_voltage: high", ["supply_voltage ('high')"]),
        ("loop_encoder: rotor", ["loop_encoder ('rotor')", "joint, motor"]),
        ("loop_encoder: {j: moto}", ["loop_encoder.j ('moto')", "joint, motor"]),
        ("[1, 2]", ["expected a mapping", "drive"]),
        ("joints: {j: {kp: 1", ["cannot be read as YAML"]),
        ("", ["expected a mapping"]),
    ],
)
def test_mistakes_are_answered_in_one_line(text, said, tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(UserError) as error:
        ServoTable.load(path)
    message = str(error.value)
    assert "mine.yaml" in message and "\n" not in message
    for part in said:
        assert part in message, message


def test_mistakes_found_when_used(tmp_path):
    with pytest.raises(UserError, match="does not exist.*servo_file="):
        ServoTable.load(tmp_path / "none.yaml")
    table = ServoTable.from_dict({"joints": {"mid_joint": {"kp": "unknown"}}}, "mine.yaml")
    with pytest.raises(UserError, match="mine.yaml: joint 'mid_joint'.*Did you mean 'mid_joint"):
        table.check_joints(JOINTS)
    with pytest.raises(UserError, match="kp is unknown"):
        table.nominal(["mid_joint"])
    with pytest.raises(UserError, match="voltage needs joints.j.torque_limit"):
        ServoTable.from_dict({"drive": "voltage", "joints": {"*": {"kp": 1}}}).nominal(["j"])
    with pytest.raises(UserError, match="joints.j.delay=-0.1: must be a number or .unknown.; allowed: 0 to 0.5 s"):
        table.set("j", "delay", -0.1)
    with pytest.raises(UserError, match="cannot be written"):
        table.save(tmp_path / "no" / "folder" / "servo.yaml")


def test_description_lists_every_column():
    text = describe()
    assert len(text.splitlines()) == len(NAMES) + 1
    for c in COLUMNS:
        assert c.low <= c.neutral <= c.high and c.unit in text and c.name in text
