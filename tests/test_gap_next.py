"""The next experiment: the motion on which two fitted hypotheses disagree most, within limits, ready to send."""

from __future__ import annotations

import numpy as np
import press_rig
import pytest
from test_gap import demo, model, plant_run

from dexsim.actuator.table import ServoTable
from dexsim.gap.diagnosis import Settings, diagnose, save
from dexsim.gap.effects.catalogue import CLASSES, EFFECTS, members, separating
from dexsim.gap.plant.case import build
from dexsim.gap.read import conditions
from dexsim.gap.report import next_recording
from dexsim.gap.search.search import JointSearch, Member
from dexsim.recording import excitation, read
from dexsim.recording.mechanism import Mechanism


@pytest.fixture(scope="module")
def hypotheses():
    """Return a search whose recordings are one slow motion, with two hypotheses fitted to it: dry friction, and
    friction that grows with speed."""
    import mujoco

    runs = [plant_run(f"r{k}", 0, 5.0, {"coulomb_friction": 0.05}, seed=k) for k in range(2)]
    for r in runs:
        r.smooth()
    case = build(model(), runs)[0]
    search = JointSearch(case, [0, 1], None, conditions(runs))
    search.fitted = {}
    none = search.start()
    trials = {}
    for e in ("coulomb_friction", "viscous_friction", "command_delay"):
        v = EFFECTS[e].variants(case.scales)[0]
        trials[e] = search.fit((Member(EFFECTS[e], v),), np.array(v.starts[1]), none, quick=True)
    servo = {
        "joints": {
            "*": {
                "kp": 2.0,
                "kd": 0.04,
                "torque_limit": 0.8,
                "no_load_speed": 12.0,
                "coulomb_friction": 0.015,
                "viscous_friction": 0.004,
            }
        }
    }
    return (
        Mechanism(mujoco.MjSpec.from_string(demo.MODEL), ("joint",), ServoTable.from_dict(servo), "pendulum"),
        search,
        none,
        trials,
    )


@pytest.mark.slow
def test_the_same_hypothesis_disagrees_nowhere_and_others_do(hypotheses):
    m, search, none, trials = hypotheses
    same = next_recording.choose(
        m, search, trials["coulomb_friction"], trials["coulomb_friction"], kinds=("steps", "triangles")
    )
    assert max(same.scores.values()) < 1e-9
    assert not same.settles and same.text.startswith("none settles it")
    other = next_recording.choose(
        m, search, trials["coulomb_friction"], trials["viscous_friction"], kinds=("steps", "triangles")
    )
    assert other.scores[other.chosen[0]] == max(other.scores.values()) > 1.0
    assert other.settles and f"{max(other.scores.values()):.1f} times the noise" in other.text


def test_every_class_has_the_experiment_that_separates_it():
    assert all(len(members(c)) > 1 and separating(sorted(members(c))) == said for c, said in CLASSES.items())
    assert {c for e in EFFECTS.values() for c in e.classes} == set(CLASSES) and "turned over" in separating(
        ["payload", "position_offset"]
    )
    assert (
        separating(["lag", "command_delay"]) != EFFECTS["lag"].experiment
        and separating(["lag", "backlash"]) == EFFECTS["lag"].experiment
    )


def test_what_refitted_figures_make_up_for_does_not_count(hypotheses):
    """A hypothesis that differs from another by a gain inside its belief only is no different."""
    from copy import deepcopy

    m, search, none, trials = hypotheses
    moved = deepcopy(none)
    k = [p.key for p in moved.fit.params].index("kp")
    moved.fit.x[k] = np.clip(moved.fit.x[k] - 0.03, 0.95, 1.05)
    p = excitation.plan(m, ["joint"], ["steps"], repeats=0)
    gain = next_recording.disagreement(m, search.case, search, none, moved, p)["steps"]
    real = next_recording.disagreement(
        m, search.case, search, trials["coulomb_friction"], trials["viscous_friction"], p
    )["steps"]
    assert gain < 0.3 * real


@pytest.mark.slow
@pytest.mark.parametrize(
    ("allowed", "seconds"),
    [
        pytest.param({"tactile_gain", "contact_stiffness"}, 4.0, id="few"),
        pytest.param(None, 6.0, id="all", marks=pytest.mark.slow),
    ],
)
def test_touch_asks_for_the_same_presses_with_a_load_cell(allowed, seconds, tmp_path):
    paths, rig, servo = press_rig.record(tmp_path / "rig", 2, seconds, seed=6, load_cell=False, stiffness=4500.0)
    d = diagnose(Settings(paths, tmp_path / "out", None, str(rig), str(servo), allowed=allowed), say=lambda _: None)
    written = save(d, tmp_path / "out")
    n = d.data["next_recording"]
    assert n and "load cell" in n["why"] and tmp_path / "out" / "next_recording.mcap" in written
    sent = read(tmp_path / "out" / n["commands"], audit=False)
    first = [read(p, audit=False) for p in paths]
    assert sent.joints == first[0].joints and any(
        sent.commands.value.shape == r.commands.value.shape and np.allclose(sent.commands.value, r.commands.value)
        for r in first
    )
