"""The planted benchmark: how large an effect is, is what a refit leaves of it."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import planted


@pytest.mark.slow
def test_what_refitted_figures_take_over_is_no_size_and_sizes_grow_to_what_is_wanted():
    rng = np.random.default_rng([5, 2, 0])
    b = planted.rig(rng, "damped")
    b["off"] = planted._off(rng, b)
    runs = planted._not_the_hardest_last(b, planted._runs(b, rng, "damped"))
    noise = 5e-4
    kind = planted.PLANTS["coulomb_friction"]
    sizes = np.geomspace(*kind.span, 5)
    # inside the beliefs
    hidden = planted._joined(
        b["off"], {"*kp": 0.999 * 1.05 / b["off"]["*kp"], "*gravity_scale": 1.04 / b["off"]["*gravity_scale"]}
    )
    tries = [b["off"], *(planted._joined(b["off"], kind.change(b, s)) for s in sizes), hidden]
    cases, q, _ = planted._simulate(b, runs, tries, 1e-3, 2)
    none = planted._apply(cases[0].plant.base()[0], b["off"])
    assert np.sqrt(np.mean((q[-1] - q[0]) ** 2)) > 2 * noise
    assert planted._left(cases[0], q[-1], none, noise) < 1.2
    pick, ratio = planted._sized(cases[0], tries[:-1], q[:-1], noise, 4.0)
    assert pick >= 1 and ratio == pytest.approx(planted._left(cases[0], q[pick], none, noise))
    others = [planted._left(cases[0], q[i], none, noise) for i in (max(pick - 1, 1), min(pick + 1, len(sizes)))]
    assert all(abs(np.log(ratio / 4.0)) <= abs(np.log(x / 4.0)) + 1e-9 for x in others)
