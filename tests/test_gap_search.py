"""The search's judgement of what lasts: fits of their own without each condition, the verdict's word, temperature's reference."""

from __future__ import annotations

import numpy as np
import pytest

from dexsim.gap import judge
from dexsim.gap.fit import Fitter
from dexsim.gap.prepare import REFERENCE, build
from dexsim.gap.search import JointSearch, Member, subset
from tests.test_gap import model, plant_run


def searched(changes: dict[str, float]) -> JointSearch:
    runs = [plant_run(name, kind, 5.0, changes, seed) for name, kind, seed in (("a", 0, 1), ("b", 1, 2), ("c", 2, 3))]
    return JointSearch(build(model(), runs)[0], [0, 1, 2], None, [0, 1, 2])


def test_refold_fits_each_condition_left_out_better_than_one_step_does():
    s = searched({"torque_limit": 0.12})
    none = s.start()
    member, start = next((Member(m.effect, m.variant), x) for _, _, m, x in s.scan(none) if m.id == "torque_limit")
    step = s.fit((member,), start, none)
    s.cross(step)
    own = s.refold(step)
    assert own.refitted and own.left_out is not step.left_out and own.fit is step.fit
    for number, x, y in zip(np.unique(s.fold_of), step.folds, own.folds, strict=True):
        fitter = Fitter(s.case.plant, subset(s.long, s.fold_of != number), s.r)
        loss = [fitter.loss(fitter.evaluate(step.fit.params, g)[None])[0] for g in (x, y)]
        assert loss[1] <= 1.02 * loss[0]
    assert own.left_out.sum() <= 1.15 * step.left_out.sum()  # what is free to fit noise does, a little


@pytest.mark.parametrize(("confidence", "group", "word"), [(0.9, [], "explained"), (0.5, [], "partly_explained"), (0.5, ["lag", "command_delay"], "explained")])
def test_an_error_that_is_gone_under_doubtful_names_is_not_explained(confidence, group, word):
    finding = {"held_out": {"before": 0.01}, "confidence": confidence, "indistinguishable": group}
    assert judge.verdict([finding], 1e-3, 1e-2, 9e-3, 1.1e-3, False) == word


def test_temperature_counts_from_that_of_a_data_sheet():
    runs = [plant_run(name, 0, 3.0, {}, seed) for name, seed in (("a", 1), ("b", 2))]
    for run, heat in zip(runs, (40.0, 55.0), strict=True):
        run.temperature = np.full((len(run.t), 1), heat)
    case = build(model(), runs)[0]
    from dexsim.gap.plant_columns import SERIES_INDEX

    warmth = case.plant.series[:, SERIES_INDEX["warmth"]]
    assert warmth.min() == pytest.approx(40 - REFERENCE) and warmth.max() == pytest.approx(55 - REFERENCE)
    assert case.scales.warm == pytest.approx(55 - REFERENCE)
    runs[1].temperature[:] = 40.5  # hardly any spread: nothing can be said of temperature
    assert build(model(), runs)[0].scales.warm == 0.0
