"""Where the loop reads the motor's encoder and the joint's is reported, what the readout is off by moves nothing."""

import numpy as np
import pytest
from test_gap import model, plant_run

from dexsim.gap.effects.catalogue import EFFECTS
from dexsim.gap.plant.case import build
from dexsim.gap.plant.columns import INDEX
from dexsim.gap.search.scan import scan_catalogue
from dexsim.gap.search.search import JointSearch

APART = {"loop_encoder": "motor", "position_encoder": "joint"}


def built(servo, count: int = 1):
    runs = [plant_run(f"r{k}", k, 3.0, {}, seed=k, servo=servo) for k in range(count)]
    for r in runs:
        r.smooth()
    return runs, build(model(), runs)[0]


def test_a_readout_is_shifted_and_stretched_and_the_motion_stays():
    _, case = built(APART)
    windows = case.plant.windows(None)
    base = np.repeat(case.plant.base()[None], 3, 0)
    base[1, :, INDEX["readout_offset"]] = 0.01
    base[2, :, INDEX["readout_scale"]] = 1.05
    base[:, :, INDEX["position_offset"]] = 0.02  # of the loop's own encoder, which the readout comes after
    # each begins where the joint truly was, so that what it does after a moment is the same
    q, torque = case.plant.simulate(base, windows)
    late = case.plant.t[windows.sample_row] > 1.0
    assert np.allclose(q[1][late] - q[0][late], 0.01, atol=1e-4)
    assert np.allclose(q[2][late], 1.05 * q[0][late], atol=1e-4)
    assert np.allclose(torque[1][late], torque[0][late], atol=2e-3) and np.ptp(torque[0]) > 0.1
    both = case.plant.base()[None].copy()
    # of the loop's encoder too: it holds what it reads, the joint stands elsewhere
    both[..., INDEX["position_offset"]] = 0.01
    assert np.abs(case.plant.simulate(both, windows)[0][0][late] - q[0][late]).max() < 5e-3


@pytest.mark.parametrize("two_encoders", [True, False])
def test_a_readout_is_asked_for_where_there_are_two_encoders(two_encoders):
    _, case = built(APART if two_encoders else None)
    for effect in ("position_offset", "position_scale"):
        columns = {c for v in EFFECTS[effect].variants(case.scales) for p in v.params for c in p.columns}
        assert any(c.startswith("readout_") for c in columns) is two_encoders
    search = JointSearch(case, [0], None, [0])
    assert any(p.key == "zero" for p in search.all_nuisances) is two_encoders


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_offset_of_the_effort_beyond_what_its_zero_may_be_off_by_is_found(sign):
    """In a strong drive that hardly works, what the zero may be off by is large beside the torques that it gives: the
    belief then stands further out than a tenth of them."""
    runs, case = built({"torque_limit": 20.0, "no_load_speed": 60.0})
    run, zero = runs[0], case.scales.effort_zero
    effort = case.plant.simulate(case.plant.base()[None], case.plant.windows(None))[1][0]
    noise = np.random.default_rng(0).normal(0.0, 1e-3, len(effort))
    run.torque = (effort + sign * 2.5 * zero + noise)[:, None]
    case = build(model(), runs)[0]
    assert zero > 0.1 * case.scales.tau
    search = JointSearch(case, [0], None, [0])
    shares = {member.id: share for share, _, member, _ in reversed(scan_catalogue(search, search.start()))}
    assert shares["current_sensor"] > 0.9
