"""A shared supply that sags: under the load of other joints, and under a drive's own where it sets a voltage."""

from dataclasses import replace

import numpy as np
import pytest
from test_gap import model, plant_run

from dexsim.gap.effects.catalogue import EFFECTS
from dexsim.gap.plant.case import build
from dexsim.gap.plant.columns import INDEX, SERIES_INDEX
from dexsim.gap.read import conditions
from dexsim.gap.search.scan import scan_catalogue, shortlisted
from dexsim.gap.search.search import JointSearch, Member

SAGS = {"sag_torque": 0.15, "sag_own": 0.3}


def sagging_case(sags: dict[str, float]):
    """Return a joint beside another one whose motor gives up to 2 N.m; its supply sags."""
    runs = [plant_run(f"r{k}", k, 5.0, {}, seed=k) for k in (0, 1, 3)]
    for r in runs:
        r.smooth()
    case = build(model(), runs)[0]
    series = case.plant.series.copy()
    series[:, SERIES_INDEX["others_torque"]] = 1.0 + np.sin(np.arange(len(series)) * 0.005)
    case.plant.set_series(series)
    case.scales = replace(case.scales, others=("other",), others_torque=2.0)
    g = case.plant.base()[None].copy()
    for name, value in sags.items():
        g[..., INDEX[name]] = value
    windows = case.plant.windows(None)
    case.plant.q[windows.sample_row] = np.round(case.plant.simulate(g, windows)[0][0] / case.quantum) * case.quantum
    return runs, case


def test_a_drive_that_sets_a_voltage_gives_less_of_everything():
    """Held against gravity: what the loop asks for times what is left of the supply, its own share included."""
    _, case = sagging_case({})
    windows = case.plant.windows(None)
    base = np.repeat(case.plant.base()[None], 2, 0)
    for name, value in SAGS.items():
        base[1, :, INDEX[name]] = value
    base[:, :, INDEX["kd"]] = 0.0
    # steps of the grid, at which the effort is not shown between two samples
    q, torque = case.plant.simulate(base, windows)
    others = case.plant.series[:, SERIES_INDEX["others_torque"]]
    assert 0 < np.abs(torque[1]).max() < np.abs(torque[0]).max()
    limit = case.plant.base()[0, INDEX["torque_limit"]]
    assert np.abs(torque[1]).max() <= limit * (1 - SAGS["sag_torque"] * others.min())
    assert np.sqrt(np.mean((q[1] - q[0]) ** 2)) > 5 * case.sigma


@pytest.mark.slow
def test_a_supply_that_sags_under_the_drives_own_load_is_found():
    runs, case = sagging_case(SAGS)
    search = JointSearch(case, [0, 1, 2], None, conditions(runs))
    none = search.start()
    speed, all_ = EFFECTS["supply_sag"].variants(case.scales)
    ranked = [(m.id, m.variant.label) for _, _, m, _ in scan_catalogue(search, none)]
    assert ranked[0] == ("supply_sag", all_.label)
    found = search.fit((Member(EFFECTS["supply_sag"], all_),), np.array(all_.starts[2]), none)
    # what the speed limit alone loses does not follow it
    less = search.fit((Member(EFFECTS["supply_sag"], speed),), np.array(speed.starts[1]), none)
    assert none.fit.loss > 5 and less.fit.loss > 0.8 * none.fit.loss and found.fit.loss < 1.5
    assert found.fit.value("supply_sag.own") == pytest.approx(SAGS["sag_own"], rel=0.25)
    assert found.fit.value("supply_sag.sag") == pytest.approx(SAGS["sag_torque"], rel=0.15)


def test_both_kinds_of_sag_are_tried_where_one_is_listed():
    """What a scan's slopes say of a sag where limits are reached ranks its kinds badly."""
    runs, case = sagging_case({})
    speed, all_ = (Member(EFFECTS["supply_sag"], v) for v in EFFECTS["supply_sag"].variants(case.scales))
    other = Member(EFFECTS["payload"], EFFECTS["payload"].variants(case.scales)[0])
    rows = [(0.5, 0.0, speed, None), (0.4, 0.0, other, None), (0.3, 0.0, all_, None)]
    assert [row[2] for row in shortlisted(rows, 1, 10.0, ())] == [speed, all_]


def test_a_voltage_drives_supply_is_the_servos():
    _, case = sagging_case({})
    assert len(EFFECTS["supply_sag"].variants(replace(case.scales, voltage=True))) == 1
