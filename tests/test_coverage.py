"""benchmarks.coverage: the shares are those of known samples; recordings and policies go through the same contact."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks import coverage
from dexsim.errors import UserError
from dexsim.hand import load_hand
from dexsim.paths import CONFIGS
from dexsim.tactile.layout import hand_layout


def samples(n: int, force: tuple, centre: tuple, seed: int = 0, blocks: int = 20) -> coverage.Contacts:
    rng = np.random.default_rng(seed)
    return coverage.Contacts(rng.uniform(*force, n), rng.uniform(*centre, (n, 2)), np.arange(n) % blocks)


def test_what_lies_within_is_covered_and_what_does_not_is_not():
    ours = samples(20000, (0.1, 8.0), (-0.005, 0.005))
    same = coverage.envelope(ours, samples(5000, (0.1, 8.0), (-0.005, 0.005), 1))
    assert same["force_covered"] > 0.995 and same["centre_covered"] > 0.995 and same["region_visited"] > 0.95
    inside = coverage.envelope(ours, samples(5000, (1.0, 4.0), (-0.0019, 0.0019), 1))
    assert inside["force_covered"] == inside["centre_covered"] == 1.0 and inside["region_visited"] < 0.3
    half = coverage.envelope(ours, samples(5000, (4.0, 12.0), (0.0, 0.02), 1))
    assert half["force_covered"] == pytest.approx(0.5, abs=0.03)
    # a cell of 2 mm reaches over the edge
    assert half["centre_covered"] == pytest.approx((0.006 / 0.02) ** 2, abs=0.03)
    assert half["force_interval"][0] < 0.5 < half["force_interval"][1] and np.diff(half["force_interval"])[0] < 0.06
    assert same["centre_training_halves"] > 0.99 and same["force_training_halves"] > 0.99
    assert coverage.envelope(ours, samples(3, (1, 2), (0, 1)))["force_covered"] is None


def test_samples_of_one_world_count_as_one():
    """Ten worlds, five of them wholly inside and five wholly outside: the interval is that of ten draws, not of
    10,000."""
    block = np.repeat(np.arange(10), 1000)
    low, high = coverage.interval(block < 5, block, np.random.default_rng(0))
    assert low == pytest.approx(0.2, abs=0.05) and high == pytest.approx(0.8, abs=0.05)
    assert coverage.interval(np.ones(9, bool), np.zeros(9, int), np.random.default_rng(0)) is None


def test_a_region_of_too_few_samples_is_seen_in_trainings_own_halves():
    few = coverage.envelope(samples(200, (0.1, 8.0), (-0.02, 0.02)), samples(5000, (0.1, 8.0), (-0.02, 0.02), 1))
    assert few["centre_training_halves"] < 0.4 and few["centre_covered"] < 0.6
    alone = coverage.halves(samples(300, (0.1, 8.0), (0.0, 0.01), blocks=1), np.random.default_rng(0))
    assert alone is None


def test_contact_centres_lie_on_the_pad():
    """A force on one taxel alone gives its own position in the pad's plane, exactly."""
    layout = hand_layout(load_hand())
    force, local = np.array([[0.0, 2.0, 0.05, 0.0, 3.0]]), layout.point[None, :, 7]
    out = coverage.of_contact(force, local, np.array([3]))
    # a force at rest is no contact
    assert [len(c.force) for c in out] == [0, 1, 0, 0, 1] and out[1].block.tolist() == [3]
    for f in (1, 4):
        plane = coverage.planes()[f]
        back = plane.middle + out[f][1][0] @ plane.axes
        assert np.linalg.norm(back - layout.point[f, 7]) < 0.007  # what the plane leaves out is the pad's own curvature


def test_the_command_line_is_checked():
    for argv, text in (([], "checkpoint=PATH"), (["checkpoint=a.pt"], "reality=bench, or recording"),
                       (["checkpoint=a.pt", "reality=bench", "recording=b.mcap"], "reality=bench, or recording"),
                       (["checkpoint=a.pt", "reality=bench", "seconds=0"], "seconds=0"),
                       (["checkpoint=a.pt", "reality=bench", "other_seconds=x"], "other_seconds=x"),
                       (["checkpoint=a.pt", "reality=bench", "other_worlds=0"], "other_worlds=0")):
        with pytest.raises(UserError, match=text):
            coverage.main(argv)


def test_trainings_side_may_play_on_a_gpu(tmp_path, monkeypatch):
    """The other world is played on the CPU whatever `device` says, which is for training's side."""
    asked = []

    def played(argv, worlds, seconds, seed):
        asked.append(argv)
        return [samples(300, (0.1, 8.0), (-0.005, 0.005), seed)] * 5

    monkeypatch.setattr(coverage, "played", played)
    assert coverage.main(["checkpoint=checkpoints/rotate.pt", "device=cuda", "reality=bench", f"out={tmp_path}"]) == 0
    ours, theirs = asked
    assert [a for a in ours if a.startswith("device=")] == ["device=cuda"]
    begun = coverage.start.for_play([*theirs, "worlds=2"], CONFIGS)
    assert begun.cfg["device"] == "cpu" and begun.cfg["reality"]["name"] == "bench"


@pytest.mark.slow
def test_against_the_other_world_and_a_recording(tmp_path):
    """The included checkpoint for a second, against the other world and against its own recording."""
    from dexsim.cli import play, start

    common = ["checkpoint=checkpoints/rotate.pt", "worlds=4", "seconds=1", "device=cpu"]
    assert coverage.main([*common, "reality=bench", f"out={tmp_path}"]) == 0
    found = json.loads((tmp_path / "coverage.json").read_text())["fingers"]
    assert (
        set(found) == {"thumb", "index", "mid", "ring", "pinky"} and (tmp_path / "coverage.png").stat().st_size > 1000
    )
    begun = start.for_play(
        [
            "checkpoint=checkpoints/rotate.pt",
            "episodes=1",
            "video=false",
            f"record={tmp_path}/a.mcap",
            "device=cpu",
            "task.evaluation.cap_s=2",
            "tactile=raw",
            f"out={tmp_path}/play",
        ],
        CONFIGS,
    )
    assert play.run(begun) == 0
    touch = coverage.recorded(str(tmp_path / "a.mcap"), {})
    assert sum(len(c.force) for c in touch) > 5 and set(np.concatenate([c.block for c in touch])) <= {0, 1, 2}
    assert all(np.abs(c.centre).max() < 0.03 for c in touch if len(c.centre))
