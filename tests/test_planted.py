"""The planted benchmark: what a case hides, and how large it is."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from benchmarks import planted


def test_effects_and_sizes_take_turns():
    entries = planted.plan(3, 6 * len(planted.PLANTS))
    counts = Counter(e["effect"] for e in entries)
    assert counts.pop("none") == len(planted.PLANTS) and set(counts.values()) == {5}
    assert {e["tier"] for e in entries} == {*planted.TIERS, "none"}


@pytest.mark.slow
def test_an_effect_changes_the_motion_by_what_its_size_says_and_repeats(tmp_path):
    made = []
    for name in ("first", "again"):
        entry = {"effect": "coulomb_friction", "tier": "medium"}
        made.append(planted.make(entry, 3, 7, tmp_path / name))
        assert sorted(p.name for p in (tmp_path / name).iterdir()) == [
            "a.mcap", "b.mcap", "c.mcap", "d.mcap", "rig.xml", "servo.yaml"]  # fmt: skip
    assert made[0] == made[1] and made[0]["times_noise"] == pytest.approx(8.0, rel=0.3)
    from dexsim.recording import read

    first, again = (read(tmp_path / name / "a.mcap").states.position.value for name in ("first", "again"))
    assert np.array_equal(first, again, equal_nan=True)
