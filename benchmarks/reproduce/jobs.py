"""Training and judging the rows: one training a GPU at a time, judging on the CPU beside it, all as plain subprocesses.

Whatever is there already is not done again: the same command goes on where it was interrupted, and a larger budget goes
on from what a smaller one reached; a policy that has learned more since, or is to be judged otherwise, is judged again.
Where the budget has stages, every row reaches one before any goes on (`benchmarks.reproduce.schedule`), and is judged
there.
"""

from __future__ import annotations

import json
import math
import os
import queue
import shutil
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks import tools
from benchmarks.reproduce.rows import Row
from benchmarks.reproduce.schedule import PIECES, Schedule
from dexsim.console.tables import duration
from dexsim.errors import UserError
from dexsim.learning import checkpoint

WORLDS = ("simulation", "reality")
"""Where a policy is judged: the training's physics, and the other world."""
START_S = 15.0
"""From the start of a training on a GPU to its first iteration, until one has been seen."""
LONGEST_START_S = 40.0
"""A first start also compiles kernels; the next ones do not."""
NICE = ("nice", "-n", "5") if shutil.which("nice") else ()
"""Judging leaves the cores to the trainings where they are too few."""


@dataclass(frozen=True)
class Plan:
    """What is asked. out: folder; task: rotate or grasp; steps: environment steps of each training; per: steps an
    iteration;
    minutes: limit of each training (it is then saved and judged as it is), None for none; episodes by world; cap:
    seconds of a trial, rotation; threads of a judging; extra: further settings of train.py; judge: device of the
    judging in simulation;
    sitting: minutes after which nothing more is trained (what runs is saved for the next sitting), None for no end;
    stages: steps at which all wait for one another and are judged, before `steps`; fit: lower `steps` to what all can
    reach in the sitting;
    overlap: the next training starts while the last one on its GPU ends; level: which stage's judging is meant, None
    for the last."""

    out: Path
    task: str
    steps: float
    per: int
    minutes: float | None
    episodes: dict[str, int]
    cap: float
    reality: str
    threads: int
    extra: tuple[str, ...]
    judge: str
    sitting: float | None = None
    stages: tuple[float, ...] = ()
    fit: bool = False
    overlap: bool = False
    level: float | None = None

    def each(self) -> list[Plan]:
        """The plan of each stage's judging, and of the last one's: itself."""
        return [*(replace(self, level=level, steps=level) for level in self.stages), self]


@dataclass(frozen=True)
class Job:
    """One row, trained from one seed."""

    row: Row
    seed: int

    @property
    def name(self) -> str:
        return f"{self.row.key}, seed {self.seed}"

    def folder(self, plan: Plan) -> Path:
        return plan.out / self.row.key / f"seed{self.seed}"

    def metrics(self, plan: Plan, world: str) -> Path:
        stage = () if plan.level is None else (f"at_{plan.level / 1e6:.4g}M",)
        return self.folder(plan).joinpath(*stage, world, "metrics.json")


@dataclass(frozen=True)
class Done:
    """How far a job's training has come: iterations, environment steps, its checkpoint (None before the first)."""

    iteration: int = 0
    steps: int = 0
    last: Path | None = None


def done(folder: Path) -> Done:
    """The furthest checkpoint in a job's folder. Raises UserError for a damaged one."""
    found = [Done()]
    for last in sorted(folder.glob("train_*/last.pt")):
        data = checkpoint.load(last)
        found.append(Done(int(data["iteration"]), int(data["steps"]), last))
    return max(found, key=lambda d: (d.steps, d.last is not None))


def _ended_by_limit(folder: Path, plan: Plan) -> bool:
    """Whether this training was ended by `minutes` before, and no more steps or minutes are asked for now."""
    path = folder / "stopped_by_limit.json"
    if not path.exists() or plan.minutes is None:
        return False
    before = json.loads(path.read_text())
    return plan.steps <= before["steps"] and plan.minutes <= before["minutes"]


def progress(folder: Path) -> tuple[int, float, float] | None:
    """(iteration, steps, seconds an iteration lately) at the end of a running training's progress.csv; None before
    there is one."""
    try:
        with open(folder / "progress.csv", "rb") as file:
            names = file.readline().decode().strip().split(",")
            size = file.seek(0, os.SEEK_END)
            file.seek(max(size - 8192, 0))
            # whole lines: what is being written has no end yet
            lines = file.read().decode(errors="ignore").split("\n")[1:-1]
        rows = [
            dict(zip(names, line.split(","), strict=True))
            for line in lines
            if line.count(",") == len(names) - 1 and line[:1].isdigit()
        ]
        each = (
            statistics.mean(float(r["collect_s"]) + float(r["learn_s"]) for r in rows[-5:])
            if "learn_s" in names
            else math.nan
        )
        return int(rows[-1]["iteration"]), float(rows[-1]["steps"]), each
    except (OSError, ValueError, IndexError, KeyError, statistics.StatisticsError):
        return None


def train(
    job: Job,
    plan: Plan,
    gpu: str | None,
    say: Callable[[str], None],
    until: float = math.inf,
    to: float | None = None,
    nearly: Callable[[], None] = lambda: None,
    lead: list[float] | None = None,
) -> Path | None:
    """Train, or go on training, until `to` (the plan's steps) or the plan's minutes are over, or time.monotonic()
    reaches `until`.

    Calls `nearly` as many seconds before the end as a training takes to start (`lead[0]`, which it measures; `lead[1]`
    becomes the time of the first iteration of all). Returns the checkpoint to judge; None if there is none, or less was
    learned than asked.
    """
    folder = job.folder(plan)
    folder.mkdir(parents=True, exist_ok=True)
    so_far, to = done(folder), plan.steps if to is None else to
    if so_far.last is not None and (so_far.steps >= to or _ended_by_limit(folder, plan)):
        return so_far.last
    numbers = [int(n) for p in folder.glob("train_*") if (n := p.name.removeprefix("train_")).isdigit()]
    out = folder / f"train_{max(numbers, default=-1) + 1}"
    start = (
        [f"task={plan.task}", f"seed={job.seed}", *job.row.settings, *plan.extra]
        if so_far.last is None
        else [f"resume={so_far.last}", *plan.extra]
    )
    iterations = so_far.iteration + math.ceil((to - so_far.steps) / plan.per)
    command = [sys.executable, "train.py", *start, f"iterations={iterations}", "final_episodes=0", f"out={out}"]
    env = os.environ | {"OMP_NUM_THREADS": "1"} | ({} if gpu is None else {"CUDA_VISIBLE_DEVICES": gpu})
    began = time.monotonic()
    limit = min(math.inf if plan.minutes is None else 60 * plan.minutes, until - began)
    by_limit = plan.minutes is not None and limit == 60 * plan.minutes
    ended, lead = False, lead if lead is not None else [START_S]
    seen, told = False, False
    with open(folder / "train.log", "a") as log:
        child = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=env, cwd=tools.ROOT)
        while True:
            try:
                child.wait(min(1.0, max(began + limit - time.monotonic(), 0.0)))
                break
            except subprocess.TimeoutExpired:
                if time.monotonic() >= began + limit:
                    ended = True
                    child.terminate()  # it saves and ends
                    try:
                        child.wait(60)
                    except subprocess.TimeoutExpired:
                        child.kill()
                        child.wait()
                    break
                at = progress(out)
                if at is not None and at[0] > so_far.iteration:
                    if not seen:
                        seen, lead[0] = True, min(time.monotonic() - began, LONGEST_START_S)
                        lead[1:] = lead[1:] or [time.monotonic()]
                    if not told and (iterations - at[0]) * at[2] < lead[0]:
                        told = True
                        nearly()
    now = done(folder)
    if ended and by_limit and now.last is not None:
        (folder / "stopped_by_limit.json").write_text(json.dumps({"steps": plan.steps, "minutes": plan.minutes}))
    enough = now.last is not None and (now.steps >= to or ended and by_limit)
    why = (
        ""
        if enough
        else "; the next sitting goes on"
        if ended and now.last is not None
        else f"; FAILED, see {folder / 'train.log'}"
    )
    say(
        f"{job.name}: trained {now.steps / 1e6:.3g} of {to / 1e6:.3g} M steps, {duration(time.monotonic() - began)}"
        f" now{why}"
    )
    return now.last if enough else None


def judge(job: Job, plan: Plan, policy: Path, world: str, gpu: str | None, say: Callable[[str], None]) -> None:
    """Play the policy in one world, unless it has been judged there in the same way already."""
    target = job.metrics(plan, world)
    data = checkpoint.load(policy)
    cap, reality = _judging(plan, world)
    wanted = {
        "iteration": int(data["iteration"]),
        "steps": int(data["steps"]),
        "episodes": plan.episodes[world],
        "cap_s": cap,
        "reality": reality,
    }
    mark = target.parent / "judged.json"
    if target.exists() and mark.exists() and json.loads(mark.read_text()) == wanted:
        return
    mark.unlink(missing_ok=True)
    target.parent.mkdir(parents=True, exist_ok=True)
    command = [
        *NICE,
        sys.executable,
        "play.py",
        f"checkpoint={policy}",
        f"episodes={plan.episodes[world]}",
        "video=false",
        "seed=1000",
        f"out={target.parent}",
    ]
    if plan.task == "rotate":
        command.append(f"task.evaluation.cap_s={plan.cap}")
    if world == "reality":
        command.append(f"reality={plan.reality}")
    cpu = world == "reality" or plan.judge == "cpu"
    command += (
        ["device=cpu", f"worlds={plan.episodes[world]}", "sim.engine=mujoco", f"sim.threads={plan.threads}"]
        if cpu
        else []
    )
    env = (
        os.environ
        | {"OMP_NUM_THREADS": "1"}
        | ({"CUDA_VISIBLE_DEVICES": ""} if cpu else {} if gpu is None else {"CUDA_VISIBLE_DEVICES": gpu})
    )
    began = time.monotonic()
    with open(target.parent / "play.log", "w") as log:
        status = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, env=env, cwd=tools.ROOT).returncode
    if status == 0:
        mark.write_text(json.dumps(wanted))
    say(
        f"{job.name}: judged in {world} in"
        f" {duration(time.monotonic() - began)}" + (f"; FAILED, see {target.parent / 'play.log'}" if status else "")
    )


class Judges:
    """Threads that judge on the CPU beside the trainings: what was learned longest comes first.

    Args:
        count: judgings at a time.
        work: what judges (job, plan of its stage, policy, world).
    """

    def __init__(self, count: int, work: Callable[[Job, Plan, Path, str], None]) -> None:
        self._waiting: queue.PriorityQueue = queue.PriorityQueue()
        self._work, self._order, self.failed = work, 0, []
        self._threads = [threading.Thread(target=self._run, daemon=True) for _ in range(count)]
        for t in self._threads:
            t.start()

    def add(self, job: Job, plan: Plan, policy: Path, world: str) -> None:
        self._order += 1
        self._waiting.put((-plan.steps, self._order, (job, plan, policy, world)))

    def finish(self) -> None:
        """Wait for all that was added. Raises what a judging raised."""
        for _ in self._threads:
            self._waiting.put((math.inf, 0, None))
        for t in self._threads:
            t.join()
        if self.failed:
            raise self.failed[0]

    def _run(self) -> None:
        while (item := self._waiting.get()[2]) is not None:
            try:
                self._work(*item)
            except Exception as error:
                self.failed.append(error)


def _at(folder: Path, steps: float, per: int) -> Path | None:
    """The checkpoint of a training in `folder` that ended within an iteration of `steps`."""
    for last in sorted(folder.glob("train_*/last.pt")):
        if steps <= int(checkpoint.load(last)["steps"]) < steps + per:
            return last
    return None


def run(jobs: list[Job], plan: Plan, gpus: list[str | None], judges: int) -> Plan:
    """All jobs: each GPU takes the next one; judging on the CPU goes on beside the next training.

    Returns the plan, with the steps that `fit` has settled on."""
    began, lock, finished = time.monotonic(), threading.Lock(), [0]
    until = math.inf if plan.sitting is None else began + 60 * plan.sitting
    plans, total = plan.each(), len(jobs) * (1 + len(WORLDS)) * (1 + len(plan.stages))

    def say(text: str, counts: bool = True) -> None:
        with lock:
            finished[0] += counts
            spent = time.monotonic() - began
            left = spent / max(finished[0], 1) * (total - finished[0])
            print(f"[{duration(spent)}, about {duration(left)} left, {finished[0]}/{total}] {text}", flush=True)

    broken: dict[int, str] = {}
    first = []
    for k, job in enumerate(jobs):
        try:
            first.append(done(job.folder(plan)).steps)
        except UserError as error:  # a damaged checkpoint: the other rows go on
            first.append(0)
            broken[k] = str(error)
    schedule = Schedule(first, [*plan.stages, plan.steps], len(gpus), cut=plan.fit)
    changed, settled, lead = threading.Condition(), [not plan.fit], [START_S]
    pool = Judges(judges, lambda job, p, policy, world: judge(job, p, policy, world, None, say))

    def steps_now(k: int) -> float:
        return max(
            [
                float(schedule.steps[k]),
                *(p[1] for f in jobs[k].folder(plan).glob("train_*") if (p := progress(f)) is not None),
            ]
        )

    def settle() -> None:
        """Before the first piece of the last stage: how far all can come in what is left of the sitting."""
        now = [steps_now(k) for k in range(len(jobs))]
        spent, gained = time.monotonic() - (lead[1] if len(lead) > 1 else math.inf), sum(now) - sum(first)
        if gained <= 0 or spent <= 0:  # nothing learned in this sitting yet: as fast as in the one before
            each = [
                plan.per / p[2]
                for job in jobs
                for f in job.folder(plan).glob("train_*")
                if (p := progress(f)) is not None and p[2] > 0
            ]
            if not each:
                return
            gained, spent = statistics.median(each) * len(gpus), 1.0
        rate = gained / spent
        left = 0.97 * (until - time.monotonic())
        ahead = (sum(now) + rate * left) / len(jobs) - (plan.stages[-1] if plan.stages else 0.0)
        # GPUs end apart by a part of a piece
        left -= min(0.1 * left, 0.5 * max(ahead, 0.0) / PIECES * len(gpus) / rate)
        plans[-1] = replace(plan, steps=schedule.settle(now, rate, left, plan.per))
        settled[0] = True
        say(
            f"{rate / 1e3:.0f}k steps/s, {duration(left)} left for training: every row to {plans[-1].steps / 1e6:.4g} M"
            " steps",
            counts=False,
        )

    def passed(k: int, gpu: str | None) -> None:
        """Judge what job k has become at each stage that it has passed, unless it was."""
        job = jobs[k]
        for p in plans:
            if (k, p.level) in handed or (schedule.steps[k] < p.steps and not _ended_by_limit(job.folder(plan), plan)):
                continue
            policy = done(job.folder(plan)).last if p.level is None else _at(job.folder(plan), p.steps, plan.per)
            if policy is None:  # a stage passed in an earlier sitting
                continue
            handed.add((k, p.level))
            for world in WORLDS:
                if world == "simulation" and plan.judge != "cpu":
                    judge(job, p, policy, world, gpu, say)
                else:
                    pool.add(job, p, policy, world)

    handed: set[tuple[int, float | None]] = set()
    tries: dict[int, int] = {}

    def piece(k: int, to: float, gpu: str | None, free: threading.Event) -> None:
        job, reached, failed = jobs[k], schedule.steps[k], True
        try:
            if time.monotonic() < until or reached >= to:
                counts = to in [p.steps for p in plans]
                policy = train(
                    job,
                    plans[-1],
                    gpu,
                    lambda text: say(text, counts),
                    until,
                    to,
                    free.set if plan.overlap else lambda: None,
                    lead,
                )
                reached = done(job.folder(plan)).steps
                # by the sitting's end, by `minutes`, or in truth: that once more
                failed = policy is None or reached < to
                if failed and policy is None and time.monotonic() < until:
                    tries[k] = tries.get(k, 0) + 1
                    failed = tries[k] > 1
        except UserError as error:
            say(f"{job.name}: FAILED, {error}")
        with changed:
            schedule.give_back(k, reached, failed)
            changed.notify_all()
        try:
            passed(k, gpu)
        except UserError as error:
            say(f"{job.name}: FAILED, {error}")
        free.set()

    def lane(gpu: str | None) -> None:
        running: list[threading.Thread] = []
        while True:
            with changed:
                while True:
                    if not settled[0] and schedule.next_is_last():
                        settle()
                    taken = schedule.take()
                    if taken is not None or not schedule.busy:
                        break
                    changed.wait()
            if taken is None:
                break
            free = threading.Event()
            running.append(threading.Thread(target=piece, args=(*taken, gpu, free), daemon=True))
            running[-1].start()
            free.wait()
        for t in running:
            t.join()

    for k, error in broken.items():
        say(f"{jobs[k].name}: FAILED, {error}")
        schedule.give_back(k, 0, failed=True)
    for k in range(len(jobs)):
        if k not in broken:
            passed(k, gpus[0])
    lanes = [threading.Thread(target=lane, args=(gpu,), daemon=True) for gpu in gpus]
    for t in lanes:
        t.start()
    for t in lanes:
        t.join()
    pool.finish()
    return plans[-1]


def read(job: Job, plan: Plan, world: str) -> dict | None:
    """The metrics of a judged policy, with the iterations and steps it was trained for; None where it was not
    judged."""
    return _judged(job.metrics(plan, world))


def read_at(job: Job, plan: Plan, world: str, steps: float) -> dict | None:
    """As `read`, of the judging after `steps` environment steps (within an iteration), whichever stage or end of an
    earlier run it was, in trials of the plan's cap and other world; None where there is none."""
    folder = job.folder(plan)
    for path in (folder / world / "metrics.json", *sorted(folder.glob(f"at_*/{world}/metrics.json"))):
        found = _judged(path)
        if (
            found is not None
            and abs(found["trained_steps"] - steps) < plan.per
            and found["judged_as"] == _judging(plan, world)
        ):
            return found
    return None


def _judging(plan: Plan, world: str) -> tuple[float | None, str | None]:
    """What makes two judgings in one world comparable: the trials' cap, and which other world it is."""
    return plan.cap if plan.task == "rotate" else None, plan.reality if world == "reality" else None


def _judged(path: Path) -> dict | None:
    mark = path.parent / "judged.json"
    if not path.exists() or not mark.exists():
        return None
    judged = json.loads(mark.read_text())
    return json.loads(path.read_text()) | {
        "trained_steps": judged["steps"],
        "trained_iterations": judged["iteration"],
        "judged_as": (judged["cap_s"], judged["reality"]),
    }
