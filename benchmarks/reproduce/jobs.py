"""Training and judging the rows: one training a GPU at a time, judging on the CPU beside it, all as plain subprocesses.

Whatever is there already is not done again: an interrupted run goes on when the same command is given again.
"""

from __future__ import annotations

import json
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

WORLDS = ("simulation", "reality")
"""Where a policy is judged: the training's physics, and the other world."""


@dataclass(frozen=True)
class Plan:
    """What is asked. out: folder; task: rotate or grasp; iterations of each training; minutes: limit of each training (it is then
    saved and judged as it is), None for none; episodes by world; cap: seconds of a trial, rotation; threads of a judging; extra:
    further settings of train.py; judge: device of the judging in simulation."""

    out: Path
    task: str
    iterations: int
    minutes: float | None
    episodes: dict[str, int]
    cap: float
    reality: str
    threads: int
    extra: tuple[str, ...]
    judge: str


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


def done_iterations(folder: Path) -> tuple[int, Path | None]:
    """(iterations learned in the job's folder, the checkpoint to go on from)."""
    best, where = 0, None
    for last in sorted(folder.glob("train_*/last.pt")):
        with open(last.parent / "progress.csv") as file:
            rows = sum(1 for _ in file) - 1
        if rows > best or where is None:
            best, where = rows, last
    return best, where


def train(job: Job, plan: Plan, gpu: str | None, say: Callable[[str], None]) -> Path | None:
    """Train, or go on training, until the plan's iterations or minutes are over. Returns the policy, None if it failed."""
    folder = job.folder(plan)
    folder.mkdir(parents=True, exist_ok=True)
    done, last = done_iterations(folder)
    stopped = folder / "stopped_by_limit"
    if last is not None and (done >= plan.iterations or stopped.exists()):
        return last.parent / "policy.pt"
    out = folder / f"train_{len(list(folder.glob('train_*')))}"
    start = [f"resume={last}"] if last is not None else [f"task={plan.task}", f"seed={job.seed}", *plan.extra, *job.row.settings]
    command = [sys.executable, "train.py", *start, f"iterations={plan.iterations}", "final_episodes=0", f"out={out}"]
    env = os.environ | {"OMP_NUM_THREADS": "1"} | ({} if gpu is None else {"CUDA_VISIBLE_DEVICES": gpu})
    began = time.monotonic()
    with open(folder / "train.log", "a") as log:
        child = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=env, cwd=tools.ROOT)
        try:
            child.wait(None if plan.minutes is None else 60 * plan.minutes)
        except subprocess.TimeoutExpired:
            child.terminate()  # it saves and ends
            try:
                child.wait(60)
            except subprocess.TimeoutExpired:
                child.kill()
            stopped.write_text(f"{plan.minutes} minutes\n")
    done, last = done_iterations(folder)
    say(f"{job.name}: trained {done} of {plan.iterations} iterations in {duration(time.monotonic() - began)}"
        + ("" if last is not None else f"; FAILED, see {folder / 'train.log'}"))
    return None if last is None else last.parent / "policy.pt"


def judge(job: Job, plan: Plan, policy: Path, world: str, gpu: str | None, say: Callable[[str], None]) -> None:
    """Play the policy in one world, unless its metrics are there."""
    target = job.metrics(plan, world)
    if target.exists():
        return
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
    say(f"{job.name}: judged in {world} in {duration(time.monotonic() - began)}" + (f"; FAILED, see {target.parent / 'play.log'}" if status else ""))


def run(jobs: list[Job], plan: Plan, gpus: list[str | None], judges: int) -> None:
    """All jobs: a thread a GPU takes the next one; judging on the CPU goes on beside the next training."""
    waiting: queue.Queue[Job] = queue.Queue()
    for job in jobs:
        waiting.put(job)
    began, lock, finished = time.monotonic(), threading.Lock(), [0]
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
                policy = train(job, plan, gpu, say)
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
    """The metrics of a judged policy, with the steps it was trained for."""
    path = job.metrics(plan, world)
    if not path.exists():
        return None
    done, last = done_iterations(job.folder(plan))
    steps = None
    if last is not None:
        with open(last.parent / "progress.csv") as file:
            names, *rows = [line.rstrip("\n").split(",") for line in file]
        steps = int(float(rows[-1][names.index("steps")]))
    return json.loads(path.read_text()) | {"trained_steps": steps, "trained_iterations": done}
