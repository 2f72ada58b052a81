"""A model's friction acts on the motor or on the joint, and it does not say which: where a play or an elasticity parts
the two, a diagnosis finds out, and hands it on."""

import mujoco
import numpy as np
import pytest
import test_gap
from test_gap import mechanism_of, plant_run
from test_gap_confirm import best_of

from dexsim.gap import demo
from dexsim.gap.effects.catalogue import EFFECTS
from dexsim.gap.judge.handed_on import model_changes, servo_changes, values_of
from dexsim.gap.plant.case import build
from dexsim.gap.plant.columns import INDEX
from dexsim.gap.read import conditions
from dexsim.gap.search.fit import intervals
from dexsim.gap.search.search import JointSearch, Member

FRICTION, DAMPING = 0.06, 0.004
MODEL = demo.MODEL.replace('armature="4e-4"', f'armature="4e-4" frictionloss="{FRICTION}" damping="{DAMPING}"')
ON_MOTOR = {"loop_encoder": "motor"}
PLAY = {"backlash": 0.05, "rebound": 0.1}


def runs_of(monkeypatch, hidden: dict[str, float], text: str = MODEL, kinds=(0, 1, 3)):
    """Runs of a plant that follows a model, and the case that a diagnosis makes of them."""
    monkeypatch.setattr(test_gap, "model", lambda: mujoco.MjModel.from_xml_string(text))
    runs = [plant_run(f"r{k}", k, 4.0, hidden, seed=k, servo=ON_MOTOR) for k in kinds]
    for r in runs:
        r.smooth()
    return runs, build(mujoco.MjModel.from_xml_string(text), runs)[0]


def test_friction_on_the_motor_is_the_servos_and_makes_no_difference_without_a_play(monkeypatch):
    runs, case = runs_of(monkeypatch, PLAY, kinds=(0,))
    free = build(mujoco.MjModel.from_xml_string(demo.MODEL), runs)[0]

    def simulated(case, **columns):
        g = case.plant.base()[None].copy()
        for name, value in columns.items():
            g[..., INDEX[name]] = value
        return case.plant.simulate(g, case.plant.windows(None))[0][0]

    own = test_gap.SERVO
    as_servos = simulated(
        free,
        **PLAY,
        coulomb_friction=own["coulomb_friction"] + FRICTION,
        viscous_friction=own["viscous_friction"] + DAMPING,
    )
    on_motor, on_joint = simulated(case, **PLAY, motor_share=1.0), simulated(case, **PLAY, motor_share=0.0)
    assert np.allclose(on_motor, as_servos, atol=1e-12)
    # friction behind the play holds the joint inside it
    assert np.sqrt(np.mean((on_motor - on_joint) ** 2)) > 3e-3
    assert np.array_equal(simulated(case, motor_share=1.0), simulated(case, motor_share=0.0))


@pytest.fixture(scope="module")
def found():
    """Return a play with most of the model's friction before it: (runs, case, search, without it, with it)."""
    with pytest.MonkeyPatch.context() as patch:
        runs, case = runs_of(patch, PLAY | {"motor_share": 0.8})
    search = JointSearch(case, [0, 2], None, conditions(runs))
    none = search.start()
    variant = EFFECTS["backlash"].variants(case.scales)[0]
    play = search.fit((Member(EFFECTS["backlash"], variant),), np.array([0.05, 0.1]), none)
    return runs, case, search, none, search.thorough(play)


def test_a_fit_finds_on_which_side_the_friction_acts(found):
    _, _, _, none, play = found
    assert none.fit.loss > 10 and play.fit.loss < 1.5
    assert play.fit.value("motor_share") == pytest.approx(0.8, abs=0.15)
    assert play.fit.value("backlash.gap") == pytest.approx(PLAY["backlash"], rel=0.05)


def test_the_side_on_which_the_friction_acts_is_handed_on_and_the_engine_does_the_same(found):
    runs, case, search, none, play = found
    m = mechanism_of(runs[0].servo)
    m.spec = mujoco.MjSpec.from_string(MODEL)
    share = play.fit.value("motor_share")
    assert not any("friction" in x for x in model_changes(m.spec.copy(), case, none, {}))
    spec, table = m.spec.copy(), runs[0].servo
    said = model_changes(spec, case, play, values_of(play))
    model = spec.compile()
    assert model.dof_frictionloss[0] == pytest.approx((1 - share) * FRICTION) and "went to its motor" in said[-1]
    assert model.dof_damping[0] == pytest.approx((1 - share) * DAMPING)
    believed = table.value("joint", "coulomb_friction").value
    servo_changes(table, case, play, intervals(play.fit, search.blocks), ["joint"])
    own = believed * play.fit.value("coulomb_friction")
    assert table.value("joint", "coulomb_friction").value == pytest.approx(own + share * FRICTION, abs=1e-6)
    c = best_of(m, runs, case, {"refitted": none, "found": play})
    engine, plant = c.errors["joint"]["found"], c.candidates["joint"][1].plant
    assert c.errors["joint"]["refitted"] > 3 * engine and engine < max(1.7 * plant, 0.8e-3), c.errors
