"""Training and judging the rows: one training a GPU at a time, judging on the CPU beside it, all as plain subprocesses.

Whatever is there already is not done again: the same command goes on where it was interrupted, and a larger budget goes on from
what a smaller one reached; a policy that has learned more since, or is to be judged otherwise, is judged again.
"""

from __future__ import annotations

import json
import math
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from benchmarks import tools
from benchmarks.reproduce.rows import Row
from dexsim.cli.report import duration
from dexsim.errors import UserError
from dexsim.learning import checkpoint

WORLDS = ("simulation", "reality")
"""Where a policy is judged: the training's physics, and the other world."""


@dataclass(frozen=True)
class Plan:
    """What is asked. out: folder; task: rotate or grasp; steps: environment steps of each training; per: steps an iteration;
    minutes: limit of each training (it is then saved and judged as it is), None for none; episodes by world; cap: seconds of a
    trial, rotation; threads of a judging; extra: further settings of train.py; judge: device of the judging in simulation;
    sitting: minutes after which nothing more is trained (what runs is saved for the next sitting), None for no end."""

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
        return self.folder(plan) / world / "metrics.json"


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


def train(job: Job, plan: Plan, gpu: str | None, say: Callable[[str], None], until: float = math.inf) -> Path | None:
    """Train, or go on training, until the plan's steps or minutes are over, or time.monotonic() reaches `until`.

    Returns the checkpoint to judge; None if there is none, or less was learned than the plan asks.
    """
    folder = job.folder(plan)
    folder.mkdir(parents=True, exist_ok=True)
    so_far = done(folder)
    if so_far.last is not None and (so_far.steps >= plan.steps or _ended_by_limit(folder, plan)):
        return so_far.last
    out = folder / f"train_{len(list(folder.glob('train_*')))}"
    start = [f"task={plan.task}", f"seed={job.seed}", *plan.extra, *job.row.settings] if so_far.last is None else [f"resume={so_far.last}", *plan.extra]
    iterations = so_far.iteration + math.ceil((plan.steps - so_far.steps) / plan.per)
    command = [sys.executable, "train.py", *start, f"iterations={iterations}", "final_episodes=0", f"out={out}"]
    env = os.environ | {"OMP_NUM_THREADS": "1"} | ({} if gpu is None else {"CUDA_VISIBLE_DEVICES": gpu})
    began = time.monotonic()
    limit = min(math.inf if plan.minutes is None else 60 * plan.minutes, until - began)
    by_limit = plan.minutes is not None and limit == 60 * plan.minutes
    ended = False
    with open(folder / "train.log", "a") as log:
        child = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=env, cwd=tools.ROOT)
        try:
            child.wait(None if limit == math.inf else max(limit, 0.0))
        except subprocess.TimeoutExpired:
            ended = True
            child.terminate()  # it saves and ends
            try:
                child.wait(60)
            except subprocess.TimeoutExpired:
                child.kill()
    now = done(folder)
    if ended and by_limit and now.last is not None:
        (folder / "stopped_by_limit.json").write_text(json.dumps({"steps": plan.steps, "minutes": plan.minutes}))
    enough = now.last is not None and (now.steps >= plan.steps or ended and by_limit)
    why = "" if enough else "; the next sitting goes on" if ended and now.last is not None else f"; FAILED, see {folder / 'train.log'}"
    say(f"{job.name}: trained {now.steps / 1e6:.3g} of {plan.steps / 1e6:.3g} M steps, {duration(time.monotonic() - began)} now{why}")
    return now.last if enough else None


def judge(job: Job, plan: Plan, policy: Path, world: str, gpu: str | None, say: Callable[[str], None]) -> None:
    """Play the policy in one world, unless it has been judged there in the same way already."""
    target = job.metrics(plan, world)
    data = checkpoint.load(policy)
    wanted = {"iteration": int(data["iteration"]), "steps": int(data["steps"]), "episodes": plan.episodes[world],
              "cap_s": plan.cap if plan.task == "rotate" else None, "reality": plan.reality if world == "reality" else None}  # fmt: skip
    mark = target.parent / "judged.json"
    if target.exists() and mark.exists() and json.loads(mark.read_text()) == wanted:
        return
    mark.unlink(missing_ok=True)
    target.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "play.py", f"checkpoint={policy}", f"episodes={plan.episodes[world]}", "video=false", "seed=1000",
               f"out={target.parent}"]
    if plan.task == "rotate":
        command.append(f"task.evaluation.cap_s={plan.cap}")
    if world == "reality":
        command.append(f"reality={plan.reality}")
    cpu = world == "reality" or plan.judge == "cpu"
    command += ["device=cpu", f"worlds={plan.episodes[world]}", "sim.engine=mujoco", f"sim.threads={plan.threads}"] if cpu else []
    env = os.environ | {"OMP_NUM_THREADS": "1"} | ({"CUDA_VISIBLE_DEVICES": ""} if cpu else {} if gpu is None else {"CUDA_VISIBLE_DEVICES": gpu})
    began = time.monotonic()
    with open(target.parent / "play.log", "w") as log:
        status = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, env=env, cwd=tools.ROOT).returncode
    if status == 0:
        mark.write_text(json.dumps(wanted))
    say(f"{job.name}: judged in {world} in {duration(time.monotonic() - began)}" + (f"; FAILED, see {target.parent / 'play.log'}" if status else ""))


def run(jobs: list[Job], plan: Plan, gpus: list[str | None], judges: int) -> None:
    """All jobs: a thread a GPU takes the next one; judging on the CPU goes on beside the next training."""
    waiting: queue.Queue[Job] = queue.Queue()
    for job in jobs:
        waiting.put(job)
    began, lock, finished = time.monotonic(), threading.Lock(), [0]
    until = math.inf if plan.sitting is None else began + 60 * plan.sitting
    total = len(jobs) * (1 + len(WORLDS))

    def say(text: str) -> None:
        with lock:
            finished[0] += 1
            spent = time.monotonic() - began
            left = spent / finished[0] * (total - finished[0])
            print(f"[{duration(spent)}, about {duration(left)} left, {finished[0]}/{total}] {text}", flush=True)

    later: list[Future] = []
    with ThreadPoolExecutor(judges) as pool:

        def worker(gpu: str | None) -> None:
            while True:
                try:
                    job = waiting.get_nowait()
                except queue.Empty:
                    return
                try:
                    policy = None if time.monotonic() >= until and done(job.folder(plan)).steps < plan.steps else train(job, plan, gpu, say, until)
                except UserError as error:  # a damaged checkpoint: the other rows go on
                    say(f"{job.name}: FAILED, {error}")
                    continue
                if policy is None:
                    continue
                for world in WORLDS:
                    if world == "simulation" and plan.judge != "cpu":
                        judge(job, plan, policy, world, gpu, say)
                    else:
                        later.append(pool.submit(judge, job, plan, policy, world, gpu, say))

        threads = [threading.Thread(target=worker, args=(gpu,), daemon=True) for gpu in gpus]
        for t in threads:
            t.start()
        for t in threads:
            t.join()
    for future in later:
        future.result()


def read(job: Job, plan: Plan, world: str) -> dict | None:
    """The metrics of a judged policy, with the iterations and steps it was trained for; None where it was not judged."""
    path = job.metrics(plan, world)
    mark = path.parent / "judged.json"
    if not path.exists() or not mark.exists():
        return None
    judged = json.loads(mark.read_text())
    return json.loads(path.read_text()) | {"trained_steps": judged["steps"], "trained_iterations": judged["iteration"]}
