"""Touch of a hand that is not the xHand: its pads, its fingertip under the press rig, a mirrored hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import press_rig
import pytest

from dexsim.errors import UserError
from dexsim.gap.touch import diagnosis
from dexsim.gap.touch import plant as touch_plant
from dexsim.gap.touch import read as touch_read
from dexsim.hand import Hand, load_hand
from dexsim.import_hand.importing import Settings, import_hand
from dexsim.recording import read
from dexsim.recording.mechanism import mechanism
from dexsim.tactile.file import load
from dexsim.tactile.sensors import Sensors
from tests import hands
from tests.tactile_fixtures import touch_result


@pytest.fixture(scope="module")
def claw(tmp_path_factory) -> Hand:
    """Return four fingers, the thumb first, pads of 8 x 6 taxels."""
    place = tmp_path_factory.mktemp("claw")
    import_hand(hands.write(place / "robot"), place / "hand", Settings(pads=(8, 6), drops=0), picture=False)
    return load_hand(place / "hand")


def pressed(folder: Path, hand: Hand, finger: str, seconds: float, **planted):
    """Return (mechanism, recordings) of a press rig of that hand's finger."""
    paths, model, servo = press_rig.record(folder, 3, seconds, seed=4, finger=finger, hand=hand, **planted)
    m = mechanism(model, servo, hand=hand)
    return m, [read(p, joints=m.joints, audit=False) for p in paths]


@pytest.mark.parametrize("mirror", [False, True])
def test_the_plant_reads_what_a_hands_taxels_read(claw, tmp_path, mirror):
    """Imported, and a left xHand: the diagnosis's own contact gives the readings of the kernels that train."""
    hand, finger = (load_hand("xhand", mirror=True), "mid") if mirror else (claw, "middle")
    m, recordings = pressed(tmp_path, hand, finger, 3.0)
    data = touch_read.collect(recordings, m, m.sensors)
    assert len(data.runs) == 3 and {r.name for r in data.runs} == {finger} and not data.blind and not data.notes
    for run in data.runs:
        assert run.z.shape[1] == (120 if mirror else 48) and run.z.max() > 0.3
        on, loaded = run.z.max(1) > 0, run.z.max(0) > 0.3
        error = touch_plant.readings(run, touch_plant.neutral())[on] - run.z[on]
        assert np.sqrt(np.mean(error[:, loaded] ** 2)) < 0.05


@pytest.mark.slow
def test_a_weak_taxel_is_named_on_the_hands_own_pad(claw, tmp_path):
    k = Sensors(claw).middle(2)
    m, recordings = pressed(tmp_path, claw, "middle", 5.0, gains={k: 0.4})
    result = touch_result(recordings, m, set(), allowed={"tactile_gain"})
    (f,) = result.findings
    assert f.effect == "tactile_gain" and list(f.taxels) == [f"2:{k}"], f
    assert f.parameters["gain"]["value"] == pytest.approx(0.4, abs=0.08) and result.names[2] == "middle"
    assert result.error.shape == (4, 48)
    path = tmp_path / "tactile.yaml"
    assert diagnosis.save_tactile(diagnosis.handed(result.findings, result.facts, result.names), path)
    assert list(load(path, claw)["tactile"]["pads"]) == ["middle"]
    with pytest.raises(UserError, match=r"pads\.middle: no such pad; pads: thumb, index, mid"):
        load(path)  # of the xHand


def test_taxels_beside_one_another_are_found_without_a_lattice(claw):
    at = Sensors(claw)
    loose = replace(claw, fingers=tuple(replace(f, pad=_without_rows(f.pad)) for f in claw.fingers))
    other = Sensors(loose)
    assert at.lattice(1) == (6, 8) and other.lattice(1) is None
    for pad in range(4):
        by_lattice, by_distance = at.beside(pad), other.beside(pad)
        assert all(set(a) <= set(b) for a, b in zip(by_lattice, by_distance, strict=True))
        assert max(map(len, by_distance)) <= 8 and np.allclose(other.mixing(pad).sum(0), 1.0)
    assert len(other.skin(1, fine=4).points) == 48 and 0 <= other.middle(1) < 48


def _without_rows(pad):
    return type(pad)(taxels=pad.taxels, kind=pad.kind, rows=0, skin=pad.skin)


def test_a_hand_without_touch_says_so(tmp_path):
    from tests.made_hand import made_hand
    from tests.recordings import signal

    hand = load_hand(made_hand(tmp_path / "made", pads=False))
    m = mechanism(hand.folder)
    r = replace(signal(joints=hand.joints, tactile=True), joints=hand.joints)
    result = touch_result([r], m, set())
    assert not result.findings and any("made_left has no touch pads" in note for note in result.notes)
