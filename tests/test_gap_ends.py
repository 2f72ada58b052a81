"""Ends of motion that the model does not have."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from dexsim.actuator.table import ServoTable
from dexsim.gap.plant.case import build
from dexsim.gap.plant.columns import INDEX
from dexsim.gap.read import Run, inputs

XML = """<mujoco><compiler angle="radian"/><worldbody><body><joint name="a" axis="0 {y} {z}"{more}/>
 <geom type="capsule" size="0.01" fromto="0 0 0 0.1 0 0" mass="{mass}"/></body></worldbody></mujoco>"""


def run_of(stop: float | None, lag: float = 0.02, reach: float = 1.5) -> Run:
    t = np.arange(0, 20, 0.02)
    cmd = reach * np.sin(2 * np.pi * t / 5)
    q = np.interp(t - lag, t, cmd)
    if stop is not None:
        q = np.maximum(q, stop)
    q = np.round(q / 0.0015) * 0.0015
    servo = ServoTable.from_dict({"drive": "torque", "joints": {"*": {"kp": 5.0, "torque_limit": 2.0}}}, source="test")
    return Run("a.mcap", ("a",), t, cmd[:, None], t, q[:, None], servo, np.array([0.0, 0.0, -9.81]))


def model_of(y: int = 0, z: int = 1, more: str = "", mass: float = 0.1) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML.format(y=y, z=z, more=more, mass=mass))


def test_an_end_that_the_model_lacks_is_found_and_used():
    model = model_of(more=' range="-2.7 2.7" limited="true"')
    said = inputs.used_end_stops(model, [run_of(None, reach=0.8), run_of(-1.03)])
    assert len(said) == 1 and "meets an end of its motion at -1.0" in said[0] and "-2.7" in said[0]
    low, high = model.jnt_range[0]
    assert low == pytest.approx(-1.03, abs=3e-3) and high == 2.7 and model.jnt_limited[0]


@pytest.mark.parametrize("angle", ["radian", "degree"])
def test_a_range_that_the_recordings_show_to_be_another_is_written(angle):
    """An end that is met narrows a joint's range, a motion beyond it takes it away, and else nothing is changed."""
    unit = 180 / np.pi if angle == "degree" else 1.0
    more = f' range="{-2.7 * unit} {2.7 * unit}" limited="true"'
    spec = mujoco.MjSpec.from_string(XML.format(y=0, z=1, more=more, mass=0.1).replace("radian", angle))
    used = spec.compile()
    assert inputs.with_ranges(spec, used)[1] == []
    used.jnt_range[0] = (-1.03, 2.7)
    changed, said = inputs.with_ranges(spec, used)
    made = mujoco.MjSpec.from_string(changed.to_xml()).compile()
    assert made.jnt_range[0] == pytest.approx([-1.03, 2.7], abs=1e-6) and "range of a is -1.03 to 2.7" in said[0]
    used.jnt_limited[0] = 0
    changed, said = inputs.with_ranges(spec, used)
    assert not mujoco.MjSpec.from_string(changed.to_xml()).compile().jnt_limited[0] and "taken away" in said[0]
    assert spec.compile().jnt_range[0] == pytest.approx([-2.7, 2.7])  # what was given is as it was


def test_a_joint_that_follows_has_no_end():
    model = model_of()
    assert inputs.used_end_stops(model, [run_of(None), run_of(None, reach=0.5)]) == [] and not model.jnt_limited[0]


def test_what_gravity_may_hold_is_no_end():
    # 5 N.m/rad * 0.47 rad asked for at most, 1.5 N.m of gravity about a level axis
    model = model_of(y=1, z=0, mass=3.0)
    assert inputs.used_end_stops(model, [run_of(-1.03)]) == []


def test_one_meeting_may_be_a_hand_in_the_way():
    run = run_of(-1.03)
    run = Run(run.name, run.joints, run.cmd_t, run.cmd, run.t[:300], run.q[:300], run.servo, run.gravity)
    assert inputs.used_end_stops(model_of(), [run]) == []


def test_an_end_met_only_in_what_is_held_out_is_neither_used_nor_judged():
    model, held = model_of(more=' range="-2.7 2.7" limited="true"'), run_of(-1.03)
    assert inputs.used_end_stops(model, [run_of(None, reach=0.8)]) == []
    spans = inputs.unforeseen_end_stops(model, [held])["a.mcap"]
    assert len(spans) == 4 and all(b - a == pytest.approx(1.25, abs=0.4) for a, b in spans)
    inside = np.zeros(len(held.t), bool)
    for a, b in spans:
        inside |= (held.t >= a) & (held.t <= b)
    assert (held.q[~inside, 0] > -1.03 + 0.01).all() and inside.mean() < 0.35
    inputs.used_end_stops(model, [held])  # the same end, shown to the fit: nothing is unforeseen about it
    assert inputs.unforeseen_end_stops(model, [held]) == {}


@pytest.mark.parametrize(
    "column, value", [("position_offset", 0.5), ("position_offset", -0.5), ("position_scale", 0.7)]
)
def test_no_end_is_where_a_joint_was_recorded_to_be(column, value):
    """An encoder that misreads shows a joint, about a hinge that gravity does not turn, within its range: a loop that
    goes by it moves the joint as without, to where the model has a stop (an error of scale but for its gains)."""
    plant = build(model_of(more=' range="-1.6 1.6" limited="true"'), [run_of(None)])[0].plant
    rows = np.repeat(plant.base()[None], 2, 0)
    rows[1, :, INDEX[column]] = value
    sound, misread = plant.simulate(rows, plant.windows(None, [0], every_run=True))[0]
    assert np.ptp(sound) > 2.9 and np.abs(misread - sound).max() < (1e-6 if column == "position_offset" else 0.1)
