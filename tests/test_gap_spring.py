"""A spring at a joint that the model lacks: its law against MuJoCo's own, its neutral value, its way into the model."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from dexsim.actuator.table import ServoTable
from dexsim.gap.effects import FittedEffect
from dexsim.gap.effects.catalogue import EFFECTS
from dexsim.gap.plant.case import build
from dexsim.gap.plant.columns import INDEX, SERIES_INDEX
from dexsim.gap.read import Run, conditions
from dexsim.gap.search.hypotheses import named
from dexsim.gap.search.search import JointSearch, Member, Trial, search_joint

MODEL = """<mujoco><compiler angle="{angle}"/><option gravity="0 0 0" timestep="0.0005"/><worldbody>
<body><joint name="a" axis="0 1 0" damping="2e-4" {spring}/><geom type="sphere" size="1e-3" mass="0.2" pos="0 0 -0.1"/>
</body></worldbody></mujoco>"""
OFF = ServoTable.from_dict({"joints": {"*": {"kp": 0.0, "kd": 0.0, "torque_limit": 1.0}}})
STIFFNESS, PRELOAD = 0.3, -0.06  # N.m/rad, N.m
MOST = 0.02  # of the swing
TIMES = np.arange(0.0, 1.5, 0.01)


def model_text(spring: str = "", angle: str = "degree") -> str:
    return MODEL.format(spring=spring, angle=angle)


def case_of(text: str):
    """Return the joint's case along a motion of its own; its drive is off."""
    q = 0.5 + 0.3 * np.sin(9 * TIMES)
    run = Run("x", ("a",), TIMES, np.zeros((len(TIMES), 1)), TIMES, q[:, None], OFF, np.zeros(3))
    return build(mujoco.MjModel.from_xml_string(text), [run])[0]


def moved(case, **columns) -> np.ndarray:
    params = case.plant.base()[None].copy()
    for name, value in columns.items():
        params[..., INDEX[name]] = value
    return case.plant.simulate(params, case.plant.windows(None))[0][0]


def mujoco_path(model: mujoco.MjModel, q0: float, v0: float) -> np.ndarray:
    data, out = mujoco.MjData(model), []
    data.qpos[0], data.qvel[0] = q0, v0
    for t in TIMES:
        while data.time < t - 1e-9:
            mujoco.mj_step(model, data)
        out.append(float(data.qpos[0]))
    return np.array(out)


def test_the_law_and_the_model_that_is_handed_on_are_mujocos_spring():
    case = case_of(model_text())
    q = moved(case, spring=STIFFNESS, spring_preload=PRELOAD)
    spec = mujoco.MjSpec.from_string(model_text())
    said = EFFECTS["joint_spring"].to_model(spec, case, {"stiffness": STIFFNESS, "preload": PRELOAD}, {})
    assert "0.3" in said[0] and "springref 0.2" in said[0]
    start = case.plant.series[0]
    expected = mujoco_path(spec.compile(), float(start[SERIES_INDEX["q"]]), float(start[SERIES_INDEX["v"]]))
    assert np.ptp(expected) > 0.4  # it swings about its rest at 0.2
    assert np.abs(q - expected).max() < MOST * np.ptp(expected)


def test_without_stiffness_and_preload_there_is_no_spring():
    case = case_of(model_text())
    plain = moved(case)
    assert np.array_equal(plain, moved(case, spring=0.0, spring_preload=0.0))
    assert np.abs(plain - moved(case, spring_preload=0.01)).max() > 1e-3


def test_with_a_play_the_spring_pulls_the_motor():
    """Behind the play it would keep it closed and no play would show: the joint stays until the motor, pulled from the
    middle of the play, has crossed half of it."""
    run = Run("x", ("a",), TIMES, np.zeros((len(TIMES), 1)), TIMES, np.full((len(TIMES), 1), 0.5), OFF, np.zeros(3))
    case = build(mujoco.MjModel.from_xml_string(model_text()), [run])[0]
    gap, pull, rotor = 0.2, 0.05, 1e-3  # rad, N.m, kg.m2
    q = moved(case, backlash=gap, rotor=rotor, spring_preload=pull)
    met = np.sqrt(gap * rotor / pull)  # s: gap / 2 = (pull / rotor) t^2 / 2
    assert np.abs(q[met - 0.01 > TIMES] - 0.5).max() < 1e-4
    assert q[np.searchsorted(TIMES, met + 0.1)] < 0.4
    assert np.abs(moved(case, spring_preload=pull)[TIMES < met] - 0.5).max() > 0.02  # without a play at once


@pytest.mark.parametrize("angle", ["radian", "degree"])
def test_a_spring_is_added_to_the_models_own(angle):
    ref = 1.0 if angle == "radian" else float(np.degrees(1.0))
    text = model_text(f'stiffness="0.1" springref="{ref}"', angle)
    spec, case = mujoco.MjSpec.from_string(text), case_of(text)
    EFFECTS["joint_spring"].to_model(spec, case, {"stiffness": STIFFNESS, "preload": PRELOAD}, {})
    model = spec.compile()
    data = mujoco.MjData(model)
    for q in (-0.4, 0.0, 0.7):
        data.qpos[0] = q
        mujoco.mj_forward(model, data)
        assert data.qfrc_spring[0] == pytest.approx(-0.1 * (q - 1.0) - STIFFNESS * q - PRELOAD, abs=1e-9)


def test_where_it_rests_is_said_where_its_stiffness_is_sure():
    case = case_of(model_text())
    effect = EFFECTS["joint_spring"]
    variant = effect.variants(case.scales)[0]
    value = {"stiffness": STIFFNESS, "preload": PRELOAD}
    sure = FittedEffect(variant, value, {"stiffness": (0.2, 0.4), "preload": (-0.08, -0.04)}, case, None)
    p = effect.parameters(sure)
    assert p["rest"]["value"] == pytest.approx(0.2) and p["rest"]["low"] == pytest.approx(0.1)
    assert p["rest"]["high"] == pytest.approx(0.4) and p["stiffness"]["unit"] == "N.m/rad"
    loose = FittedEffect(variant, value, {"stiffness": (0.0, 0.4), "preload": (-0.08, -0.04)}, case, None)
    assert "rest" not in effect.parameters(loose)


KP = 1e-4  # N.m/rad of the loop that stands for none
FREE = ServoTable.from_dict({"joints": {"*": {"kp": KP, "kd": 0.0, "torque_limit": 0.3, "coulomb_friction": 0.01,
                                              "viscous_friction": 0.01}}})  # fmt: skip


def driven(seed: int, **columns) -> Run:
    """Return 4 s of steps of torque, open loop, of the plant with some columns changed."""
    rng = np.random.default_rng(seed)
    t, at = np.arange(0.0, 4.0, 0.01), np.arange(0.0, 4.0, 0.25)
    torque = rng.uniform(0.02, 0.12, len(at)) * np.where(np.arange(len(at)) % 2, -1.0, 1.0)
    run = Run(f"r{seed}", ("a",), at, torque[:, None] / KP, t, 0.1 * np.sin(4 * t)[:, None], FREE, np.zeros(3))
    for _ in range(2):  # the series are those of the motion itself
        run.qs = None
        run.smooth()
        run.q = moved(build(mujoco.MjModel.from_xml_string(model_text()), [run])[0], **columns)[:, None]
    run.qs, run.q = None, np.round(run.q / 1.5e-3) * 1.5e-3
    run.smooth()
    return run


def searched(**columns):
    runs = [driven(seed, **columns) for seed in range(3)]
    case = build(mujoco.MjModel.from_xml_string(model_text()), runs)[0]
    return search_joint(JointSearch(case, [0, 1, 2], None, conditions(runs)))


@pytest.mark.parametrize("stiffness, preload, gone", [(0.0, 0.0, True), (0.0, PRELOAD, False), (0.3, 0.0, False)])
def test_a_preload_without_stiffness_is_a_spring_still(stiffness, preload, gone):
    case = build(mujoco.MjModel.from_xml_string(model_text()), [driven(0)])[0]
    spring = Member(EFFECTS["joint_spring"], EFFECTS["joint_spring"].variants(case.scales)[0])
    trial = Trial((spring,), SimpleNamespace(params=named(spring), x=np.array([stiffness, preload])))
    assert object.__new__(JointSearch).shrunk(trial) == gone


@pytest.mark.slow
def test_a_spring_is_named_and_sized_where_no_loop_holds_the_joint():
    best = searched(spring=STIFFNESS, spring_preload=PRELOAD).best
    assert [m.id for m in best.members][:1] == ["joint_spring"]
    assert best.fit.value("joint_spring.stiffness") == pytest.approx(STIFFNESS, rel=0.1)
    assert best.fit.value("joint_spring.preload") == pytest.approx(PRELOAD, rel=0.2)


UNEVEN, LEVEL = 0.9, 0.01  # of friction by direction, N.m


def test_a_friction_that_differs_by_direction_is_a_spring_without_stiffness():
    run = driven(0)
    case = build(mujoco.MjModel.from_xml_string(model_text()), [run])[0]
    uneven = moved(case, friction_asymmetry=UNEVEN)
    assert np.abs(uneven - moved(case, spring_preload=0.5 * UNEVEN * LEVEL)).max() < 1e-9
    assert np.abs(uneven - moved(case)).max() > 1e-2


def test_it_is_not_looked_for_where_a_loop_holds_the_joint_stiffer():
    run = driven(0, spring=STIFFNESS)
    free = build(mujoco.MjModel.from_xml_string(model_text()), [run])[0].scales
    effect = EFFECTS["joint_spring"]
    assert effect.variants(free) and not effect.unseen(free)
    held = replace(free, stiffness=2.0 * free.tau / free.span)
    assert not effect.variants(held) and "stiffer" in effect.unseen(held)
