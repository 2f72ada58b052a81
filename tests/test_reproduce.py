"""benchmarks.reproduce: rows are settings that train.py takes, interrupted runs go on, the table says what the trials
say."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import forked
import numpy as np
import pytest
import torch

from benchmarks.reproduce import __main__ as command
from benchmarks.reproduce import jobs, own, pack, report, rows
from benchmarks.reproduce.schedule import Schedule
from dexsim import outputs
from dexsim.cli import start
from dexsim.errors import UserError
from dexsim.learning import checkpoint
from dexsim.paths import CONFIGS

ROOT = Path(__file__).parents[1]


def plan(out: Path, task: str = "rotate", **changed) -> jobs.Plan:
    return replace(
        jobs.Plan(out, task, 400.0, 100, None, {"simulation": 10, "reality": 5}, 60.0, "bench", 1, (), "cpu"), **changed
    )


def train_file(path: Path, iteration: int) -> None:
    """A training's checkpoint that says how far it came, and nothing else of use."""
    path.parent.mkdir(parents=True, exist_ok=True)
    checkpoint.save(path, dict.fromkeys((*checkpoint.KEYS, *checkpoint.TRAIN_KEYS), {}) | {
        "kind": "train", "iteration": iteration, "steps": 100 * iteration,
        "config": {"agent": {}, "task": {}, "choices": {}}, "git": {"commit": "", "dirty": False},
        "layout": {"joints": [], "action": [], "observations": {}}, "rng": checkpoint.rng_state(),
        "optimizer": {"state": {0: {"exp_avg": torch.ones(9)}}, "param_groups": []}})
    (path.parent / "progress.csv").write_text(
        "iteration,steps\n" + "".join(f"{i},{100 * i}\n" for i in range(1, iteration + 1))
    )


def put(job: jobs.Job, p: jobs.Plan, world: str, successes: list[int], fall: float = 30.0, iteration: int = 2) -> None:
    """Metrics of a judged policy, and the checkpoint of its training."""
    path = job.metrics(p, world)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"episodes": len(successes), "capped": 1, "cap_s": 60.0, "seconds_to_fall": fall,
                                "consecutive_successes": {"all": sorted(successes)}}))
    (path.parent / "judged.json").write_text(
        json.dumps(
            {
                "iteration": iteration,
                "steps": 100 * iteration,
                "episodes": p.episodes[world],
                "cap_s": p.cap if p.task == "rotate" else None,
                "reality": p.reality if world == "reality" else None,
            }
        )
    )
    train_file(job.folder(p) / "train_0" / "last.pt", iteration)


def test_rows_are_settings_of_train():
    seen = set()
    for table, task in rows.TASK.items():
        for row in [*rows.TABLES[table], *(rows.OURS if table == "rotation" else ())]:
            cfg = start.for_train([f"task={task}", "device=cpu", *row.settings], CONFIGS).cfg
            seen.add(json.dumps(cfg, sort_keys=True))
    assert len(seen) == 7 + 4 + 3  # each differs from every other
    assert all(np.mean(r.listed) == pytest.approx(r.paper["average"]) for r in rows.ROTATION)
    assert all(np.median(r.listed) == pytest.approx(r.paper["median"]) for r in rows.ROTATION)


def test_the_rotation_rows_keep_the_reward_they_were_trained_with():
    """All but `paper_reward` with the term `spin` that the default leaves out; a user's own setting comes after a
    row's; what was begun goes on with its own config."""
    kept = {
        r.key: start.for_train(["task=rotate", "device=cpu", *r.settings], CONFIGS).cfg["task"]
        for r in (*rows.ROTATION, *rows.OURS)
    }
    assert {k: t["rewards"]["spin"] for k, t in kept.items()} == {k: 0.0 if k == "paper_reward" else 0.01 for k in kept}
    assert kept["paper_reward"] == start.for_train(["task=rotate", "device=cpu"], CONFIGS).cfg["task"]
    changed = [k for k in kept["full"] if kept["full"][k] != kept["paper_reward"][k]]
    assert changed == ["rewards"]  # it differs from the row with everything in that alone


def test_a_row_begins_with_its_settings_and_goes_on_with_its_own(tmp_path, monkeypatch):
    p, job, children = plan(tmp_path), jobs.Job(rows.ROTATION[0], 1), Children(monkeypatch)
    p = replace(p, extra=("task.rewards.spin=0",))
    jobs.train(job, p, None, silent)
    begun = children.commands[0]
    assert begun.index("task.rewards.spin=0.01") < begun.index("task.rewards.spin=0")  # the last one counts
    jobs.train(job, replace(p, extra=(), steps=2 * p.steps), None, silent)
    assert any(a.startswith("resume=") for a in children.commands[1]) and not any(
        "spin" in a for a in children.commands[1]
    )


def test_the_torque_row_is_paid_for_no_contact_force():
    """Every reward of the default task that looks at the commanded force is off in it; R_torque is off in the force
    row."""
    weights = {
        r.key: start.for_train(["task=grasp", "device=cpu", *r.settings], CONFIGS).cfg["task"]["rewards"]
        for r in rows.GRASP
    }
    by_command = {"force", "force_near", "worst"}  # `torque` is the other half of the ablation
    assert {k for k, w in weights["both"].items() if w != weights["torque"][k]} == by_command
    assert all(weights["torque"][k] == 0 != weights["both"][k] for k in by_command)
    assert {k for k, w in weights["both"].items() if w != weights["force"][k]} == {"torque"} and weights["force"][
        "torque"
    ] == 0


def test_the_command_line_is_checked():
    for argv, text in (
        (["table=chess"], "table=chess"),
        (["table=rotation", "rows=full,half"], "rows=full,half"),
        (["table=rotation", "rows=full", "budget=-1"], "budget=-1"),
        (["table=grasp", "rows=both", "seeds=0.5"], "seeds=0.5"),
        (["table=rotation", "rows=full", "judge=me"], "judge=me"),
        (["table=rotation", "rows=full", "fit=true"], "fit=true"),
        (["table=rotation", "rows=full", "stages=0.5,0.2"], "stages=0.5,0.2"),
    ):
        with pytest.raises(UserError, match=text):
            command.main([*argv, "device=cpu"])


def test_averages_orderings_and_intervals(tmp_path):
    """Rows of known trials: the pooled numbers are theirs, a clear difference holds, a reversed one is called so."""
    p = plan(tmp_path)
    by = {
        "full": 20,
        "quaternion": 3,
        "plain_centre": 10,
        "no_force": 12,
        "neither": 30,
        "no_touch": 1,
        "no_orientation": 20,
    }
    every = [jobs.Job(r, s) for s in (1, 2) for r in rows.ROTATION]
    for job in every:
        centre = by[job.row.key]
        put(job, p, "simulation", [centre - 1, centre, centre, centre + 1] * 5, fall=2.0 * centre)
    text, data, _ = report.rotation(p, every)
    full = data["rows"]["full"]["simulation"]
    assert full["average"] == 20.0 and full["trials"] == 40 and full["seconds_per_success"] == pytest.approx(2.0)
    assert full["interval"][0] <= 20.0 <= full["interval"][1] and full["interval"][1] - full["interval"][0] < 1.0
    assert full["steps"] == [200, 200] and full["by_seed"] == [20.0, 20.0]
    verdict = {(c["first"], c["second"], c["quantity"]): c["here"] for c in data["orderings"]["simulation"]}
    assert verdict["full", "quaternion", "average"].startswith("holds (+17.0")
    assert verdict["full", "neither", "average"].startswith("reversed (-10.0")
    assert verdict["full", "no_orientation", "average"].startswith("undecided")
    # 2 s a success in every row
    assert verdict["no_orientation", "full", "seconds_per_success"].startswith("undecided")
    assert full["seconds_by_seed"] == pytest.approx([2.0, 2.0]) and "| 2.00 (2.00, 2.00) | 40.0 (40.0, 40.0) |" in text
    assert {c["here"] for c in data["orderings"]["reality"]} == {"not judged"}
    assert "| quaternion instead of 6D | 3.0 (" in text and "2.9, 2.5, 5.24, 15.2" in text


def test_learning_curves_are_those_of_the_longest_training(tmp_path):
    p, job = plan(tmp_path), jobs.Job(rows.ROTATION[0], 1)
    for k, count in ((0, 2), (1, 5)):
        folder = job.folder(p) / f"train_{k}"
        folder.mkdir(parents=True)
        (folder / "progress.csv").write_text("iteration,steps,task/successes_per_minute\n1,1000000,\n"
                                             + "".join(f"{i},{i}000000,{3 * i}\n" for i in range(2, count + 1)))
    steps, successes = report.learning(p, [job, jobs.Job(rows.ROTATION[1], 1)])[job.row][0]
    assert steps.tolist() == [2.0, 3.0, 4.0, 5.0] and successes.tolist() == [6.0, 9.0, 12.0, 15.0]
    report.write("rotation", p, [job], {"command": "x", "device": "y"})
    assert (tmp_path / "rotation_learning.png").stat().st_size > 1000


def test_an_ordering_is_not_decided_within_what_seeds_do(tmp_path):
    """Seeds of one row 30 apart: a difference of 15 between two other rows says nothing, one of 300 does."""
    p = plan(tmp_path)
    every = [jobs.Job(r, s) for r in rows.ROTATION for s in (1, 2)]
    average = {"full": 320, "quaternion": 20, "plain_centre": 305}
    for job in every:
        put(
            job,
            p,
            "simulation",
            [average.get(job.row.key, 100) + (30 * job.seed if job.row.key == "no_force" else 0)] * 20,
        )
    verdict = {
        (c["first"], c["second"], c["quantity"]): c["here"]
        for c in report.rotation(p, every)[1]["orderings"]["simulation"]
    }
    assert verdict["full", "plain_centre", "average"].startswith("undecided (+15.0")
    assert verdict["full", "quaternion", "average"].startswith("holds (+300.0")
    # by hand: variances 0 in six rows and 450 in one, 7 degrees of freedom, t = 2.3646
    assert report._between_seeds([[100.0, 100.0]] * 6 + [[130.0, 160.0]]) == pytest.approx(
        2.3646 * (450 / 7) ** 0.5, rel=1e-4
    )


def test_seeds_that_differ_widen_the_interval(tmp_path):
    p = plan(tmp_path)
    every = [jobs.Job(rows.ROTATION[0], s) for s in (1, 2)]
    put(every[0], p, "simulation", [10] * 50)
    put(every[1], p, "simulation", [20] * 50)
    row = report.rotation(p, every)[1]["rows"]["full"]["simulation"]
    assert row["average"] == 15.0 and row["interval"] == [10.0, 20.0]


def judged(
    p: jobs.Plan, key: str, seed: int, world: str, successes: list[int], iteration: int = 2, stage: str = ""
) -> jobs.Job:
    """A row's seed, judged as it stood after 100 * iteration steps; stage: folder of a stage's judging."""
    job = jobs.Job(next(r for r in (*rows.ROTATION, *rows.OURS) if r.key == key), seed)
    put(job, p, world, successes, iteration=iteration)
    if stage:
        target = job.folder(p) / stage / world
        target.mkdir(parents=True)
        for name in ("metrics.json", "judged.json"):
            (job.folder(p) / world / name).rename(target / name)
    return job


def test_rows_of_our_own_are_compared_at_the_same_steps(tmp_path):
    """Ours after 200 steps: against the first row's judging of then, at a stage, not against what it became after
    400."""
    p, ours = plan(tmp_path), []
    for seed in (1, 2):
        for world, at_200, at_400 in (("simulation", 60, 100), ("reality", 30, 90)):
            judged(p, "full", seed, world, [at_200 + seed] * 10, stage="at_0.0002M")
            judged(p, "full", seed, world, [at_400] * 10, iteration=4)
            ours += [judged(p, "fixed", seed, world, [(60 if world == "simulation" else 36) + seed] * 10),
                     judged(p, "curriculum", seed, world, [200 if seed == 1 else 190] * 10)]
    ours = list(dict.fromkeys(ours))
    text, data, draw = own.table(p, ours)
    said = data["against"]
    assert said["fixed"]["simulation"]["difference"] == 0.0 and said["fixed"]["simulation"]["here"].startswith(
        "undecided (+0.0"
    )
    assert (
        said["curriculum"]["reality"]["here"].startswith("more (+163.5")
        and said["curriculum"]["reality"]["to_steps"] == 200
    )
    # by hand: variances of pairs 0.5, 0.5, 50 over 3 degrees of freedom, t = 3.1824; the difference of two rows of two
    # seeds
    half = 3.1824 * (51 / 3) ** 0.5
    assert said["curriculum"]["reality"]["interval"] == pytest.approx([163.5 - half, 163.5 + half], rel=1e-3)
    losses = data["lost_in_the_other_world"]
    assert losses["fixed"]["lost"] == pytest.approx(1 - 37.5 / 61.5) and losses["fixed"]["by_seed"] == pytest.approx(
        [1 - 37 / 61, 1 - 38 / 62]
    )
    assert (
        losses["full"]["lost"] == pytest.approx(1 - 31.5 / 61.5)
        and losses["fixed"]["interval"][0] >= 1 - 38 / 62 - 1e-9
    )
    assert (
        "Trained without randomization, 2 of 2 seeds lose at least a third" in text
        and "| everything, 6D orientation (the paper's first row), 0.0002 M steps | 61.5 (" in text
    )
    from matplotlib.figure import Figure
    axes = Figure().subplots(1, 2)
    draw(axes)
    assert [t.get_text() for t in axes[0].get_xticklabels()] == ["full", "fixed", "curriculum"]
    assert len(axes[0].patches) == 6 and len(axes[1].get_legend_handles_labels()[0]) == 2


def test_rows_of_our_own_without_their_reference(tmp_path):
    """The first row judged at other steps, or under another cap; seeds of ours at different steps; one seed: said, not
    compared."""
    p = plan(tmp_path)
    judged(p, "full", 1, "simulation", [50] * 10, iteration=4)
    job = judged(p, "fixed", 1, "simulation", [60] * 10)
    assert own.table(p, [job])[1]["against"]["fixed"]["simulation"]["here"] == "`full` was not judged at these steps"
    judged(replace(p, cap=30.0), "full", 1, "simulation", [50] * 10)
    assert own.table(p, [job])[1]["against"]["fixed"]["simulation"]["difference"] is None
    judged(p, "full", 1, "simulation", [50] * 10)
    text, data, _ = own.table(p, [job])
    assert data["against"]["fixed"]["simulation"]["here"].startswith("undecided, one seed a row (+10.0")
    assert data["lost_in_the_other_world"] == {"full": None, "fixed": None} and "randomization | not judged |" in text
    pair = [job, judged(p, "fixed", 2, "simulation", [60] * 10, iteration=3)]
    assert own.table(p, pair)[1]["against"]["fixed"]["simulation"]["here"] == "its seeds have different steps"


def test_own_rows_have_a_table_of_their_own(tmp_path):
    p = plan(tmp_path)
    every = [judged(p, key, 1, "simulation", [5] * 10) for key in ("full", "fixed")]
    names = [path.name for path in report.write("rotation", p, every, {"command": "x", "device": "y"})]
    assert names == ["rotation.md", "rotation_own.md"]
    assert (
        "without randomization" not in (tmp_path / "rotation.md").read_text()
        and "| everything, trained without" in (tmp_path / "rotation_own.md").read_text()
    )
    assert set(json.loads((tmp_path / "rotation.json").read_text())["rows"]) == {"full"}
    assert (
        set(json.loads((tmp_path / "rotation_own.json").read_text())["rows"]) == {"fixed"}
        and (tmp_path / "rotation_own.png").stat().st_size > 1000
    )
    (tmp_path / "rotation.md").unlink()
    assert [path.name for path in report.write("rotation", p, every[1:], {"command": "x", "device": "y"})] == [
        "rotation_own.md"
    ]
    assert not (tmp_path / "rotation.md").exists()


def test_the_grasp_table(tmp_path):
    p = plan(tmp_path, "grasp")
    every = [jobs.Job(r, 1) for r in rows.GRASP]
    for job, corr in zip(every, (0.95, 0.8, 0.9), strict=True):
        put(job, p, "simulation", [0])
        path = job.metrics(p, "simulation")
        path.write_text(
            json.dumps(
                {
                    "hold_rate": 0.9,
                    "contact_force_range_N": [3.0, 40.0],
                    "joint_torque_range_Nm": [0.1, 0.8],
                    "force_command_correlation": corr,
                    "torque_command_correlation": 0.7,
                }
            )
        )
    text, data, _ = report.grasp(p, every)
    assert [o["here"] for o in data["orderings"]["simulation"]] == [
        "so for one seed each (0.950, 0.800)",
        "not so for one seed each (0.800, 0.900)",
    ]
    assert [o["here"] for o in data["orderings"]["reality"]] == ["not judged"] * 2
    assert "| R_force + R_torque | 0.90 (0.90) | 3.00 (3.00) | 40.00 (40.00) |" in text
    near = jobs.Job(rows.TORQUE_NEAR, 1)  # a row of our own, compared once it is there
    put(near, p, "simulation", [0])
    near.metrics(p, "simulation").write_text(json.dumps({"force_command_correlation": 0.7}))
    text, data, _ = report.grasp(p, [*every, near])
    assert "- simulation, force > torque_near: so for one seed each (0.800, 0.700)." in text
    assert [o["second"] for o in data["orderings"]["simulation"]] == ["force", "torque", "torque_near"]


def test_a_correlation_is_stronger_beyond_what_seeds_do():
    """By hand: variances 0.0002, 0.0002, 0.0098 over 3 degrees of freedom, t = 3.1824, two seeds a row."""
    spread = report._between_seeds([[0.95, 0.93], [0.92, 0.94], [0.18, 0.32]])
    half = 3.1824 * (0.0102 / 3) ** 0.5
    far = report._stronger([0.92, 0.94], [0.18, 0.32], spread)
    assert far["here"].startswith("holds (+0.680") and far["here"].endswith("above in every pair of seeds)")
    assert far["interval"] == pytest.approx([0.68 - half, 0.68 + half], rel=1e-3)
    assert report._stronger([0.95, 0.93], [0.92, 0.94], spread)["here"].startswith("undecided (+0.010")
    assert report._stronger([0.18, 0.32], [0.92, 0.94], spread)["here"].startswith("reversed")


class Children:
    """Stands for subprocess: trainings write the checkpoint they were asked for, or what they reach before their
    limit."""

    def __init__(self, monkeypatch):
        self.commands: list[list[str]] = []
        self.reach: int | None = None  # iterations after which the limit comes; None: it does not
        monkeypatch.setattr(subprocess, "Popen", self.popen)
        monkeypatch.setattr(subprocess, "run", self.play)

    def popen(self, command, **kw):
        said = dict(c.split("=", 1) for c in command[2:])
        self.commands.append(command)
        train_file(Path(said["out"]) / "last.pt", self.reach or int(said["iterations"]))
        return self

    def play(self, command, **kw):
        command = command[command.index(sys.executable):]
        said = dict(c.split("=", 1) for c in command[2:])
        self.commands.append(command)
        (Path(said["out"]) / "metrics.json").write_text(
            json.dumps({"of": said["checkpoint"], "episodes": int(said["episodes"])})
        )
        return subprocess.CompletedProcess(command, 0)

    def wait(self, timeout=None):
        if self.reach is not None and self.commands[-1][1] == "train.py" and timeout != 60:
            time.sleep(timeout)
            raise subprocess.TimeoutExpired("train.py", timeout)
        return 0

    def terminate(self):
        pass


def silent(text: str) -> None:
    pass


def test_what_is_done_is_not_done_again(tmp_path, monkeypatch):
    """An unfinished training is resumed from its last checkpoint, a finished one is not repeated, judged metrics
    stay."""
    p, job, children = plan(tmp_path), jobs.Job(rows.ROTATION[0], 1), Children(monkeypatch)
    put(job, p, "simulation", [1])
    last = jobs.train(job, p, None, silent)
    assert (
        f"resume={job.folder(p) / 'train_0' / 'last.pt'}" in children.commands[0]
        and last == job.folder(p) / "train_1" / "last.pt"
    )
    assert jobs.train(job, p, None, silent) == last and len(children.commands) == 1
    jobs.judge(job, p, last, "simulation", None, silent)  # it had been judged after two iterations
    assert len(children.commands) == 2 and jobs.read(job, p, "simulation")["trained_steps"] == 400
    jobs.judge(job, p, last, "simulation", None, silent)
    assert len(children.commands) == 2
    jobs.judge(job, replace(p, cap=30.0), last, "simulation", None, silent)  # otherwise than before
    assert len(children.commands) == 3 and "task.evaluation.cap_s=30.0" in children.commands[-1]


def test_a_larger_budget_goes_on_from_the_smaller(tmp_path, monkeypatch):
    """budget=1 and then 3: the same row learns twice as much again and is judged anew; so does one that `minutes` had
    ended."""
    p, job, children = plan(tmp_path), jobs.Job(rows.ROTATION[0], 1), Children(monkeypatch)
    jobs.run([job], p, [None], 1)
    assert [c[1] for c in children.commands] == [
        "train.py",
        "play.py",
        "play.py",
    ] and "iterations=4" in children.commands[0]
    jobs.run([job], replace(p, steps=1200.0), [None], 1)
    more = children.commands[3:]
    assert [c[1] for c in more] == ["train.py", "play.py", "play.py"] and "iterations=12" in more[0]
    assert f"resume={job.folder(p) / 'train_0' / 'last.pt'}" in more[0]
    assert jobs.read(job, p, "reality")["trained_iterations"] == 12

    other, limited = jobs.Job(rows.ROTATION[1], 1), replace(p, minutes=0.002)
    children.reach = 3
    del children.commands[:]
    jobs.run([other], limited, [None], 1)
    assert jobs.read(other, limited, "simulation")["trained_steps"] == 300  # judged as it is
    jobs.run([other], limited, [None], 1)
    assert len(children.commands) == 3  # the same minutes again: nothing more
    children.reach = None
    jobs.run([other], replace(limited, steps=1200.0), [None], 1)
    assert "iterations=12" in children.commands[3] and jobs.read(other, limited, "simulation")["trained_steps"] == 1200


def test_a_sitting_ends_and_the_next_goes_on(tmp_path, monkeypatch):
    """When the sitting is over, what runs is saved and not judged, what waits is not begun; the next sitting does
    both."""
    p, children = plan(tmp_path, sitting=1e-9), Children(monkeypatch)
    pair = [jobs.Job(rows.ROTATION[0], s) for s in (1, 2)]
    children.reach = 2
    assert jobs.train(pair[0], p, None, silent, until=0.0) is None and jobs.done(pair[0].folder(p)).iteration == 2
    jobs.run(pair, p, [None], 1)
    assert len(children.commands) == 1 and jobs.read(pair[0], p, "simulation") is None
    children.reach = None
    jobs.run(pair, replace(p, sitting=None), [None], 1)
    assert [c[1] for c in children.commands].count("train.py") == 3 and all(
        jobs.read(j, p, w) for j in pair for w in jobs.WORLDS
    )


def lanes_at_work(schedule: Schedule, lanes: int, until: float = math.inf) -> list[tuple[float, int, float]]:
    """(time of its end, training, steps) of each piece, on `lanes` lanes of one step a second."""
    ends, out, now = [], [], 0.0
    while True:
        while len(ends) < lanes and (taken := schedule.take()) is not None:
            ends.append((now + taken[1] - schedule.steps[taken[0]], *taken))
        if not ends or min(ends)[0] > until:
            return out
        ends.sort()
        now, k, steps = ends.pop(0)
        out.append((now, k, steps))
        schedule.give_back(k, steps)


def test_every_row_reaches_a_stage_before_any_goes_on():
    schedule = Schedule([20.0] * 11 + [11.0] * 3, [50.0, 90.0], 3)
    ends = lanes_at_work(schedule, 3)
    assert schedule.steps == [90.0] * 14
    begins_last = min(t - 40 for t, _, steps in ends if steps == 90.0)
    assert begins_last >= max(t for t, _, steps in ends if steps == 50.0) - 40  # lanes do not wait idle for one another


def test_cut_trainings_end_together():
    """14 trainings on 3 lanes: in one go two lanes work at the end while the third idles; with 5 of them in pieces none
    does."""
    idle = {}
    for cut in (False, True):
        ends = lanes_at_work(Schedule([50.0] * 14, [50.0, 90.0], 3, cut=cut), 3)
        idle[cut] = 3 * max(ends)[0] - 14 * 40
        assert sum(steps == 90.0 for _, _, steps in ends) == 14
    assert idle[False] == 40.0 and idle[True] <= 10.0
    assert sorted(t for t, _, steps in ends if steps == 90.0)[4] < 80  # the ones in pieces come first


def test_the_budget_that_fits_a_sitting():
    schedule = Schedule([0.0] * 4, [50.0, 1000.0], 2, cut=True)
    reached = [50.0, 50.0, 30.0, 40.0]
    assert schedule.settle(reached, rate=2.0, seconds=100.0, per=10) == 90.0  # (170 + 200) / 4 = 92.5
    assert Schedule([0.0], [50.0, 60.0], 1).settle([50.0], 1.0, 100.0, 10) == 60.0  # not more than was asked
    assert Schedule([0.0], [50.0, 60.0], 1).settle([20.0], 1.0, 1.0, 10) == 50.0  # nor less than the stage before
    schedule = Schedule([0.0], [1.0], 1)
    assert schedule.take() == (0, 1.0) and schedule.take() is None
    schedule.give_back(0, 0.5, failed=True)
    assert schedule.take() is None and not schedule.busy


def test_stages_are_judged_and_told_apart(tmp_path, monkeypatch):
    """Two rows, a stage at half: trained and judged there, then at the end; the stage has a table of its own and is
    packed."""
    p, children = plan(tmp_path / "a", stages=(200.0,)), Children(monkeypatch)
    pair = [jobs.Job(r, 1) for r in rows.ROTATION[:2]]
    ended = jobs.run(pair, p, [None], 1)
    trained = [
        next(c for c in command if c.startswith("iterations="))
        for command in children.commands
        if command[1] == "train.py"
    ]
    assert trained == ["iterations=2", "iterations=2", "iterations=4", "iterations=4"] and ended.steps == 400.0
    for stage, steps in zip(ended.each(), (200, 400), strict=True):
        assert all(jobs.read(j, stage, w)["trained_steps"] == steps for j in pair for w in jobs.WORLDS)
    before = len(children.commands)
    jobs.run(pair, p, [None], 1)
    assert len(children.commands) == before
    pack.main([f"out={p.out}", f"into={tmp_path / 'state'}"])
    pack.main([f"unpack={tmp_path / 'state'}", f"out={tmp_path / 'b'}"])
    elsewhere = replace(p, out=tmp_path / "b")
    assert all(jobs.read(j, s, w) for j in pair for s in elsewhere.each() for w in jobs.WORLDS)
    jobs.run(pair, elsewhere, [None], 1)
    assert len(children.commands) == before
    jobs.run(pair, replace(elsewhere, steps=600.0), [None], 1)  # beside train_1, the only one that was packed
    assert [p.name for p in sorted(pair[0].folder(elsewhere).glob("train_*"))] == ["train_1", "train_2"]


def test_a_training_that_fails_is_tried_once_more(tmp_path, monkeypatch):
    p, children = plan(tmp_path), Children(monkeypatch)
    began = []
    monkeypatch.setattr(subprocess, "Popen", lambda command, **kw: began.append(command) or children)  # writes nothing
    jobs.run([jobs.Job(rows.ROTATION[0], 1)], p, [None], 1)
    assert len(began) == 2


def test_the_end_of_a_running_training_is_seen(tmp_path):
    """The last whole line of progress.csv counts, also of a long file, also while a line is being written."""
    assert jobs.progress(tmp_path) is None
    lines = [f"{i},{100 * i},{'x' * 300},{0.7},{0.1}" for i in range(1, 60)]
    (tmp_path / "progress.csv").write_text("iteration,steps,what,collect_s,learn_s\n" + "\n".join(lines) + "\n60,60")
    assert jobs.progress(tmp_path) == (59, 5900.0, pytest.approx(0.8))


def test_pack_takes_along_what_the_next_sitting_needs(tmp_path):
    """Packed, unpacked elsewhere: the same progress and judging, without the optimizer's moments; a whole job in a
    part."""
    p, q = plan(tmp_path / "a"), plan(tmp_path / "b")
    pair = [jobs.Job(rows.ROTATION[0], s) for s in (1, 2)]
    for job in pair:
        put(job, p, "reality", [1, 2], iteration=3)
    parts = pack.pack(p.out, tmp_path / "state", 1.0)
    assert [x.name for x in parts] == ["state_0.tgz", "state_1.tgz"]
    pack.main([f"unpack={tmp_path / 'state'}", f"out={q.out}"])
    for job in pair:
        assert jobs.done(job.folder(q)).steps == 300
        assert jobs.read(job, q, "reality") == jobs.read(job, p, "reality") is not None
        assert checkpoint.load(jobs.done(job.folder(q)).last)["optimizer"] == {"state": {}, "param_groups": []}
        outputs.claim(job.folder(q) / "reality", "out=", ["metrics.json"])  # play may judge it again
    with pytest.raises(UserError, match="holds no training"):
        pack.main([f"out={tmp_path / 'none'}", f"into={tmp_path / 'x'}"])


TRAIN = """
import json, signal, sys, time
from pathlib import Path
said = dict(a.split("=", 1) for a in sys.argv[1:])
out, stop = Path(said["out"]), []
out.mkdir(parents=True)
signal.signal(signal.SIGTERM, lambda *_: stop.append(1))
done = json.loads(Path(said["resume"]).read_text())["iteration"] if "resume" in said else 0
time.sleep(0.2)
with open(out / "progress.csv", "w") as file:
    file.write("iteration,steps,collect_s,learn_s\\n")
    while done < int(said["iterations"]) and not stop:
        time.sleep(0.02)
        done += 1
        file.write(f"{done},{100 * done},0.012,0.008\\n")
        file.flush()
(out / "last.pt").write_text(json.dumps({"iteration": done, "steps": 100 * done}))
"""
PLAY = """
import json, sys
from pathlib import Path
said = dict(a.split("=", 1) for a in sys.argv[1:])
(Path(said["out"]) / "metrics.json").write_text(json.dumps({"episodes": 2}))
"""


@pytest.mark.slow
def test_a_sitting_is_shared_by_all_rows(tmp_path, monkeypatch):
    """Seven trainings on three lanes for 12 s: all judged at the stage, all settled on one budget within the sitting,
    none beyond it."""
    for name, text in (("train.py", TRAIN), ("play.py", PLAY)):
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(jobs.tools, "ROOT", tmp_path)
    monkeypatch.setattr(jobs, "checkpoint", SimpleNamespace(load=lambda path: json.loads(Path(path).read_text())))
    every = [jobs.Job(r, 1) for r in rows.ROTATION]
    p = plan(tmp_path / "out", steps=1e6, stages=(2000.0,), sitting=0.2, fit=True, overlap=True)
    began = time.monotonic()
    ended = jobs.run(every, p, ["0", "1", "2"], 2)
    steps = [jobs.done(j.folder(p)).steps for j in every]
    assert 2000 < ended.steps < 1e6 and max(steps) <= ended.steps and min(steps) > 2000
    # all of them on a machine that is as fast at the end as at the beginning
    assert sum(s == ended.steps for s in steps) >= 4
    assert all(jobs.read(j, ended.each()[0], w)["trained_steps"] == 2000 for j in every for w in jobs.WORLDS)
    assert time.monotonic() - began < 40


@pytest.mark.slow
def test_a_row_end_to_end(tmp_path, monkeypatch, capsys):
    """Train, judge in both worlds, write the table, on the CPU with a tiny budget: first in forks, then as a shell
    would."""
    argv = [
        sys.executable,
        "-m",
        "benchmarks.reproduce",
        "table=rotation",
        "rows=full,fixed",
        "seeds=1",
        "budget=1e-7",
        "episodes=4",
        "cap=2",
        f"out={tmp_path}",
        "worlds=4",
        "device=cpu",
        "agent.num_steps_per_env=8",
        "agent.algorithm.num_mini_batches=2",
    ]

    def begun(command, env, cwd, **kw):
        return forked.Forked(forked.script, *command[command.index(sys.executable) + 1:], cwd=cwd, env=env)

    with monkeypatch.context() as patch:
        patch.setattr(subprocess, "Popen", begun)
        patch.setattr(subprocess, "run", lambda *a, **kw: SimpleNamespace(returncode=begun(*a, **kw).wait(600)))
        assert command.main(argv[3:]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["missing"] == 0
    table, ours = (json.loads((tmp_path / name).read_text())["rows"] for name in ("rotation.json", "rotation_own.json"))
    assert table["full"]["simulation"]["steps"] == [32]  # one iteration of 8 steps in 4 worlds
    pack.main([f"out={tmp_path}", f"into={tmp_path / 'state'}"])
    elsewhere = tmp_path / "elsewhere"
    pack.main([f"unpack={tmp_path / 'state'}", f"out={elsewhere}"])
    again = [a for a in argv if not a.startswith(("budget=", "out=", "rows="))] + [
        "budget=3e-7",
        "rows=full",
        f"out={elsewhere}",
    ]
    done = subprocess.run(again, capture_output=True, text=True, cwd=ROOT, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads((elsewhere / "rotation.json").read_text())["rows"]["full"]["simulation"]["steps"] == [64]
    assert (
        set(table) == {"full"}
        and set(ours) == {"fixed"}
        and set(table["full"]) == set(ours["fixed"]) == {"simulation", "reality"}
    )
    assert (tmp_path / "rotation.md").exists() and (tmp_path / "rotation.png").stat().st_size > 1000
