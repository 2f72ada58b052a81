"""The comparison of sets of sensors: rows differ in what they say, pairs are judged as was fixed."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks import tools
from benchmarks.touch_matters import analysis, rows, unpaired
from benchmarks.touch_matters.__main__ import chosen, common, following
from benchmarks.touch_matters.judge import columns, metrics_of
from dexsim.errors import UserError


def test_rows_differ_from_the_first_in_their_settings_only():
    def flat(node, path=""):
        for k, v in node.items():
            if isinstance(v, dict):
                yield from flat(v, f"{path}{k}.")
            else:
                yield f"{path}{k}", str(v)

    first = dict(flat(tools.config(["task=rotate_fingertips", "device=cpu"])))
    for row in rows.EVERY:
        own = dict(flat(tools.config(["task=rotate_fingertips", "device=cpu", *row.settings])))
        assert {k for k in own if own[k] != first.get(k)} == {s.partition("=")[0] for s in row.settings}, row.key


@pytest.fixture(autouse=True)
def fewer_draws(monkeypatch):
    """Of each bootstrap: its percentiles are known well enough for what is told here."""
    monkeypatch.setattr(analysis, "DRAWS", 500)


def seeds(means, rng, spread=1.0):
    return [rng.normal(m, spread, 200) for m in means]


def test_a_difference_that_seeds_agree_on_is_decided_and_one_that_they_do_not_is_not():
    rng = np.random.default_rng(1)
    full = seeds([30, 32, 29, 31, 33], rng)
    assert analysis.paired(full, seeds([20, 21, 18, 22, 23], rng), rng)["verdict"] == "more"
    assert analysis.paired(seeds([20, 21, 18, 22, 23], rng), full, rng)["verdict"] == "fewer"
    mixed = analysis.paired(full, seeds([20, 45, 18, 40, 23], rng), rng)
    assert mixed["verdict"] == "undecided" and mixed["interval"][0] < 0 < mixed["interval"][1]


def test_five_pairs_are_no_narrower_than_students_t():
    """Bootstrapping five pairs alone is too narrow: 2.78 standard errors, not about 1.8."""
    rng = np.random.default_rng(2)
    a, b = seeds([10, 14, 12, 16, 13], rng, 0.01), seeds([10, 10, 10, 10, 10], rng, 0.01)
    low, high = analysis.paired(a, b, rng)["interval"]
    error = np.std([0, 4, 2, 6, 3], ddof=1) / np.sqrt(5)
    assert high - low == pytest.approx(2 * 2.776 * error, rel=0.02)


def test_one_pair_is_refused():
    with pytest.raises(UserError, match="two pairs"):
        analysis.paired([np.ones(3)], [np.ones(3)], np.random.default_rng(0))


def test_a_correction_over_several_orderings_is_holms():
    """Worked by hand: 0.01 x 4, 0.02 x 3, 0.03 x 2, and 0.035 x 1 raised to the one before it."""
    p = {"a": 0.03, "b": 0.01, "c": 0.035, "d": 0.02}
    assert analysis.holm(p) == pytest.approx({"b": 0.04, "d": 0.06, "a": 0.06, "c": 0.06})
    assert analysis.holm({"a": 0.9, "b": 0.8}) == {"b": 1.0, "a": 1.0}


def test_p_and_interval_of_pairs_say_the_same():
    """At p = 0.05 Student's interval ends at 0."""
    each = np.array([1.0, 2.0, 4.0, -1.0, 3.0])
    at = each - analysis.over_seeds(each)[0]
    assert analysis.over_seeds(at)[0] == pytest.approx(0, abs=1e-12) and analysis.against_zero(at) == pytest.approx(
        0.05
    )
    assert analysis.against_zero(np.ones(3)) == 0 and analysis.against_zero(np.zeros(3)) == 1


def test_a_row_of_other_seeds_is_compared_without_pairs(tmp_path):
    for seed, n in ((11, 30), (12, 34), (13, 32)):
        judged(tmp_path, "full", seed, "training", [n] * 4)
    for seed, n in ((1, 24), (2, 36)):
        judged(tmp_path, "bits", seed, "training", [n] * 4)
    data = analysis.summary(analysis.read(tmp_path))
    assert data["differences"] == {}
    low, high = data["unpaired"]["training"]["bits"]["interval"]
    # Welch's: errors 2/sqrt(3) and 6, 1.074 degrees of freedom (Welch and Satterthwaite), t = 10.80
    assert (low + high) / 2 == pytest.approx(2.0) and high - low == pytest.approx(2 * 6.110 * 10.80, rel=0.01)
    assert "not paired" in analysis.markdown(data)


def judged(folder, row, seed, world, successes):
    folder = folder / row / f"seed{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    trial = [[n, 60.0, "capped", "up", 0.05, 0.1, 0.8] for n in successes]
    metrics = {"trials": trial, "ends": {"dropped": 0, "leaned": 0, "nan": 0, "capped": len(trial)},
               "seconds_to_fall": 60.0, "touched_by_others": 0.01,
               "seconds_per_success": 60.0 / float(np.mean(successes))}  # fmt: skip
    data = {"row": row, "seed": seed, "world": world, "steps": 10, "iteration": 1, "metrics": metrics}
    (folder / f"{world}.json").write_text(json.dumps(data))


def test_trainings_of_several_folders_are_one_set_without_pairs(tmp_path):
    for folder, seed, n in (("a", 11, 30), ("a", 12, 34), ("b", 11, 32)):
        judged(tmp_path / folder, "full", seed, "training", [n] * 4)
    for folder, seed, n in (("a", 11, 4), ("b", 12, 8)):
        judged(tmp_path / folder, "no_pose", seed, "training", [n] * 4)
    found, steps = unpaired.gathered([tmp_path / "a", tmp_path / "b"], "training")
    assert steps == 10
    assert sorted(found["full"]["successes"]) == [30, 32, 34] and sorted(found["no_pose"]["seconds"]) == [7.5, 15]
    text = unpaired.markdown(found, unpaired.claimed("no_pose:successes,no_pose:seconds"))
    line = next(x for x in text.splitlines() if x.startswith("| no pose"))
    # Welch's, by hand: errors 2/sqrt(3) and 2, 1.69 degrees of freedom, t = 5.18
    more = 26 - 5.18 * np.sqrt(4 / 3 + 4), 26 + 5.18 * np.sqrt(4 / 3 + 4)
    assert unpaired.welch(np.array([30.0, 34, 32]), np.array([4.0, 8]))["interval"] == pytest.approx(more, rel=0.01)
    # times: geometric means 10.61 s and (60^3 / (30 * 34 * 32))^(1/3) s
    assert "| 10.61 | 5.65 (" in line and "no_pose:successes` p =" in text and "no_pose:seconds` p =" in text


def test_one_training_has_an_interval_where_all_rows_spread_alike(tmp_path):
    for seed, n in ((11, 30), (12, 34), (13, 32)):
        judged(tmp_path, "full", seed, "training", [n] * 4)
    for seed, n in ((11, 20), (12, 26)):
        judged(tmp_path, "bits", seed, "training", [n] * 4)
    for seed, n in ((11, 1), (12, 9)):
        judged(tmp_path, "no_pose", seed, "training", [n] * 4)  # would widen it, were it not left out
    judged(tmp_path, "taxels_5", 11, "training", [25] * 4)
    found, _ = unpaired.gathered([tmp_path], "training")
    by = {k: v["successes"] for k, v in found.items()}
    spread, free = unpaired.pooled_spread(by)
    # squares about the rows' means: 8 of three trainings, 18 of two
    assert (spread, free) == (pytest.approx(np.sqrt(26 / 3)), 3)
    half = 3.1824 * np.sqrt(26 / 3) * np.sqrt(1 / 3 + 1)  # Student's, 3 degrees of freedom
    ends = unpaired.alike(by["full"], by["taxels_5"], spread, free)
    assert ends == pytest.approx([7 - half, 7 + half], rel=1e-4)
    lines = unpaired.markdown(found, []).splitlines()
    assert f"| +7.0 ({7 - half:+.1f} to {7 + half:+.1f}) |" in next(x for x in lines if x.startswith("| 5 taxels"))
    assert unpaired.pooled_spread({"full": np.ones(1)})[1] == 0
    assert len({x.count("|") for x in lines if x.startswith("|")}) == 1


def test_shares_are_of_what_everything_makes_and_the_figure_is_drawn(tmp_path):
    for seed, n in ((1, 30), (2, 34), (3, 32)):
        judged(tmp_path / "a", "full", seed, "training", [n] * 4)
        judged(tmp_path / "a", "no_touch", seed, "training", [n - 8] * 4)
    found, _ = unpaired.gathered([tmp_path / "a"], "training")
    share, (low, high) = unpaired.shares(found)["no_touch"]
    # Welch's by hand: errors 2/sqrt(3) each, 4 degrees of freedom, t = 2.776
    assert share == pytest.approx(24 / 32)
    assert [low, high] == pytest.approx([share - 2.776 * np.sqrt(8 / 3) / 32, share + 2.776 * np.sqrt(8 / 3) / 32],
                                        rel=1e-3)  # fmt: skip
    assert unpaired.PAPER["no_touch"] == pytest.approx(1.1 / 25.1) and unpaired.PAPER["no_pose"] < 0.5
    unpaired.main([f"out={tmp_path / 'a'}:{tmp_path / 'a'}", f"figure={tmp_path / 'f.png'}"])
    assert (tmp_path / "f.png").stat().st_size > 10_000
    judged(tmp_path / "c", "full", 1, "training", [20] * 4)  # nothing to compare with: only its dot
    unpaired.main([f"out={tmp_path / 'c'}", f"figure={tmp_path / 'g.png'}"])
    assert (tmp_path / "g.png").stat().st_size > 10_000
    judged(tmp_path / "b", "no_touch", 1, "training", [20] * 4)
    with pytest.raises(UserError, match="no training with everything at 0.0 M steps"):
        unpaired.main([f"out={tmp_path / 'b'}", f"figure={tmp_path / 'f.png'}"])


def test_trainings_of_other_steps_are_not_compared(tmp_path):
    judged(tmp_path, "full", 1, "training", [30] * 4)
    judged(tmp_path, "no_pose", 1, "training", [3] * 4)
    path = tmp_path / "no_pose" / "seed1" / "training.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"steps": 5_000_000}))
    with pytest.raises(UserError, match="5.0 M in .*no_pose/seed1"):
        unpaired.gathered([tmp_path], "training")
    with pytest.raises(UserError, match="nothing judged there in world=wide"):
        unpaired.gathered([tmp_path], "wide")
    with pytest.raises(UserError, match="claims=no_pose:time: must be ROW:successes or ROW:seconds"):
        unpaired.claimed("no_pose:time")


def test_one_training_in_two_folders_is_not_two(tmp_path):
    for folder in ("a", "b"):
        judged(tmp_path / folder, "full", 1, "training", [30, 31])
    with pytest.raises(UserError, match="b/full/seed1 is the training of .*a/full/seed1 again"):
        unpaired.gathered([tmp_path / "a", tmp_path / "b"], "training")
    judged(tmp_path / "b", "full", 1, "training", [31, 30])  # the same seed trained again: other trials
    assert len(unpaired.gathered([tmp_path / "a", tmp_path / "b"], "training")[0]["full"]["successes"]) == 2


def test_successes_a_doubling_of_the_taxels_are_a_line_through_all_trainings():
    """Exact line: 2 successes a doubling from 5 taxels on, the same to either side of it."""
    at = {k: 10 + 2 * np.log2(n / 5) for k, n in (("taxels_5", 5), ("taxels_25", 25), ("full", 600))}
    found = unpaired.slope({k: np.array([v - 1, v + 1]) for k, v in at.items()})
    assert found["slope"] == pytest.approx(2) and found["trainings"] == 6
    # Student's, 4 degrees of freedom: residuals of 1 each
    x = np.repeat(np.log2([5, 25, 600]), 2)
    half = 2.776 * np.sqrt(6 / 4 / ((x - x.mean()) ** 2).sum())
    assert found["interval"] == pytest.approx([2 - half, 2 + half], rel=1e-3)
    assert unpaired.slope({"full": np.ones(5)}) is None and unpaired.slope({"bits": np.ones(5)}) is None


def test_the_page_is_made_of_what_was_judged(tmp_path):
    for seed in range(1, 6):
        for world in rows.WORLDS:
            judged(tmp_path, "full", seed, world, [30 + seed] * 4)
            judged(tmp_path, "no_touch", seed, world, [10 + seed] * 4)
            judged(tmp_path, "no_force", seed, world, [30 + (-1) ** seed * 5] * 4)
    analysis.main([f"out={tmp_path}"])
    text = (tmp_path / "touch_matters.md").read_text()
    line = next(x for x in text.splitlines() if x.startswith("| no touch at all"))
    assert "| 13.0 (11.0-15.0) |" in line and "+20.0 (+20.0 to +20.0), holds" in line
    assert "`no_touch` p = 0, `no_force` p =" in text and "Not trained: `plain_centre`" in text
    assert "undecided" in next(x for x in text.splitlines() if x.startswith("| no contact force"))
    assert (tmp_path / "touch_matters.png").stat().st_size > 10_000
    with pytest.raises(UserError, match="nothing judged"):
        analysis.main([f"out={tmp_path / 'none'}"])


def test_rows_are_judged_where_all_have_come(tmp_path):
    class Job:
        def __init__(self, folder):
            self.folder = folder

    for name, kept in (("a", (25, 50, 75)), ("b", (25, 50))):
        (tmp_path / name / "train_0").mkdir(parents=True)
        for k in kept:
            (tmp_path / name / "train_0" / f"model_{k}.pt").touch()
    assert common([Job(tmp_path / "a"), Job(tmp_path / "b")]) == 50
    assert common([Job(tmp_path / "a"), Job(tmp_path / "c")]) is None


def test_going_on_takes_no_folder_that_is_there(tmp_path):
    """A training that was packed and unpacked has its furthest folder only."""
    assert following(tmp_path) == 0
    (tmp_path / "train_1").mkdir()
    assert following(tmp_path) == 2


def test_a_row_that_is_not_is_named():
    assert [[r.key for r in turn] for turn in chosen("full,no_pose/bits")] == [["full", "no_pose"], ["bits"]]
    with pytest.raises(UserError, match="nonsense"):
        chosen("full,nonsense")


def test_each_seeds_metrics_are_of_its_own_trials():
    trials = [[3, 10.0, "dropped", "up", 0.05, 0.1, 0.8, 1.0], [5, 20.0, "capped", "up", 0.05, 0.1, 0.8, 0.0]]
    m = metrics_of(trials, 20.0, 50)
    assert m["consecutive_successes"]["average"] == 4 and m["capped"] == 1 and m["seconds_to_fall"] == 15
    assert m["ends"] == {"dropped": 1, "leaned": 0, "nan": 0, "capped": 1}
    assert m["touched_by_others"] == pytest.approx(1 / 30)


def test_muted_rows_are_those_columns():
    layout = [["joint_angle", 12], ["contact_centre", 15], ["contact_force", 5], ["gravity", 3]]
    assert columns(layout, ["contact_force", "gravity"]) == list(range(27, 35))
    with pytest.raises(UserError, match="mute=touch: the actor has joint_angle"):
        columns(layout, ["touch"])
