"""Train every row of sensors with paired seeds on the task by fingertips, and judge each policy in three worlds.

    python -m benchmarks.touch_matters [out=out/touch_matters] [rows=paper|taxels|full,no_touch/bits,..]
        [seeds=11,12,13,14,15] [gpus=0,1,..] [each=1] [iterations=600] [seconds=S] [episodes=512] [bench_episodes=32]
        [cap=120] [save=25] [judged=training,wide,bench|none] [at=ITERATION]
        [any other setting of train.py]
    python -m benchmarks.touch_matters.analysis out=out/touch_matters

`each` trainings share a GPU; rows after a `/` wait for those before it. `seconds` after the start trainings are ended
and saved. All are judged at the last iteration (a multiple of `save`) that every one has reached, when all have ended;
with `at` at that one, each as soon as it has ended, and those that did not come so far are left out. The same command
again goes on where it stopped. Writes out/<row>/seed<k>/<world>.json, one for each row, seed and world, of which
`analysis` makes the page's table and figure.
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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks import tools
from benchmarks.reproduce.jobs import done
from benchmarks.touch_matters import rows
from benchmarks.touch_matters.judge import checkpoints
from dexsim.errors import UserError

OWN = {"out": "out/touch_matters", "rows": "paper", "seeds": "11,12,13,14,15", "gpus": "null", "each": "1",
       "iterations": "600", "seconds": "null", "episodes": "512", "bench_episodes": "32", "cap": "120", "save": "25",
       "judged": "training,wide,bench", "states": "false", "at": "null"}  # fmt: skip


@dataclass(frozen=True)
class Job:
    """A row trained from a seed, in a folder of its own."""

    row: rows.Row
    seed: int
    folder: Path


def chosen(text: str) -> list[list[rows.Row]]:
    """Rows by name or by set, in turns. Raises UserError."""
    sets = {"paper": rows.PAPER, "taxels": rows.TAXELS, "every": rows.EVERY} | {r.key: (r,) for r in rows.EVERY}
    wrong = [k for k in text.replace("/", ",").split(",") if k not in sets]
    if wrong:
        raise UserError(f"rows={text}: no row '{wrong[0]}'; rows: {', '.join(sets)}")
    return [[r for k in turn.split(",") for r in sets[k]] for turn in text.split("/")]


def following(folder: Path) -> int:
    """The number after the highest of train_0, train_1, .. in `folder`, of which some may not have been taken along."""
    return max((int(p.name.removeprefix("train_")) for p in folder.glob("train_*")), default=-1) + 1


def train(job: Job, gpu: str | None, iterations: int, until: float, save: int, extra: Sequence[str]) -> None:
    """Train to `iterations`, going on from what is there, or until time.monotonic() reaches `until`."""
    job.folder.mkdir(parents=True, exist_ok=True)
    before = done(job.folder)
    if before.iteration >= iterations or time.monotonic() >= until:
        return
    out = job.folder / f"train_{following(job.folder)}"
    settings = ["task=rotate_fingertips", f"seed={job.seed}", *job.row.settings] if before.last is None else [
        f"resume={before.last}"]  # fmt: skip
    command = [sys.executable, "train.py", *settings, *extra, f"iterations={iterations}", "final_episodes=0",
               f"save_interval={save}", f"out={out}"]  # fmt: skip
    env = os.environ | {"OMP_NUM_THREADS": "1"} | ({} if gpu is None else {"CUDA_VISIBLE_DEVICES": gpu})
    with open(job.folder / "train.log", "a") as log:
        child = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=env, cwd=tools.ROOT)
        try:
            child.wait(None if math.isinf(until) else max(until - time.monotonic(), 0.0))
        except subprocess.TimeoutExpired:
            child.terminate()  # it saves and ends
            try:
                child.wait(60)
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()


def common(jobs: Sequence[Job]) -> int | None:
    """The last iteration of which every training kept a checkpoint; None where there is none."""
    kept = [set(checkpoints(j.folder)) for j in jobs]
    return max(set.intersection(*kept), default=None) if kept else None


def judge(out: Path, row: rows.Row, seeds: Sequence[int], world: str, at: int, gpu: str | None, own: dict[str, str],
          threads: int) -> None:  # fmt: skip
    """Judge the policies of iteration `at` of a row's seeds in a world, those that have not been."""

    def judged(seed: int) -> bool:
        path = out / row.key / f"seed{seed}" / f"{world}.json"
        return path.exists() and json.loads(path.read_text())["iteration"] == at

    seeds = [s for s in seeds if not judged(s)]
    if not seeds:
        return
    cpu = world in rows.ON_CPU
    command = [sys.executable, "-m", "benchmarks.touch_matters.judge", f"out={out}", f"row={row.key}",
               f"seeds={','.join(map(str, seeds))}", f"worlds={world}", f"at={at}", f"cap={own['cap']}",
               f"episodes={own['bench_episodes' if cpu else 'episodes']}", f"threads={threads}",
               f"states={own['states']}"]  # fmt: skip
    env = os.environ | {"OMP_NUM_THREADS": "1"}
    env |= {"CUDA_VISIBLE_DEVICES": ""} if cpu else {} if gpu is None else {"CUDA_VISIBLE_DEVICES": gpu}
    name = f"{world}_{'_'.join(map(str, seeds))}"
    with open(out / row.key / f"judge_{name}.log", "w") as log:
        status = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, env=env, cwd=tools.ROOT).returncode
    if status:
        print(f"{row.key} in {world}: judging FAILED, see {log.name}", flush=True)


def lanes(work: Sequence[Callable[[str | None], None]], where: Sequence[str | None]) -> list[threading.Thread]:
    """Threads that do all of `work`, each in a place of `where`; started."""
    waiting: queue.SimpleQueue = queue.SimpleQueue()
    for item in work:
        waiting.put(item)

    def lane(place: str | None) -> None:
        while True:
            try:
                item = waiting.get_nowait()
            except queue.Empty:
                return
            item(place)

    threads = [threading.Thread(target=lane, args=(p,), daemon=True) for p in where]
    for t in threads:
        t.start()
    return threads


def main(argv: list[str]) -> None:
    began = time.monotonic()
    own, extra = tools.split(argv, OWN)
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    gpus: list[str | None] = [str(i) for i in range(count)] or [None]
    if own["gpus"] != "null":
        gpus = [v.strip() for v in own["gpus"].split(",")]
    out = Path(own["out"]).expanduser().absolute()
    seeds = tools.numbers(own["seeds"], "seeds")
    turns = chosen(own["rows"])
    every = [r for turn in turns for r in turn]
    for row in every:  # refuse a slip before an hour of training
        tools.config(["task=rotate_fingertips", *row.settings, *extra])
    jobs = [Job(r, s, out / r.key / f"seed{s}") for turn in turns for s in seeds for r in turn]
    iterations, each, save = (tools.numbers(own[k], k)[0] for k in ("iterations", "each", "save"))
    until = math.inf if own["seconds"] == "null" else began + float(own["seconds"])

    def say(text: str) -> None:
        print(f"[{time.monotonic() - began:.0f} s] {text}", flush=True)

    say(f"{len(jobs)} trainings of {iterations} iterations, {each} at a time on each of {len(gpus)} devices: {out}")

    at = None if own["at"] == "null" else tools.numbers(own["at"], "at")[0]
    asked = [] if own["judged"] == "none" else own["judged"].split(",")
    if not set(asked) <= set(rows.WORLDS):
        raise UserError(f"judged={own['judged']}: must be none, or of {', '.join(rows.WORLDS)}")
    cores = len(os.sched_getaffinity(0))
    spare = max(1, cores - 2 * len(gpus))
    threads = max(1, min(4, spare // max(len(jobs), 1)))
    free = threading.Semaphore(max(1, spare // threads))  # of judgings on the CPU
    beside: list[threading.Thread] = []

    def on_cpu(job: Job, world: str, at: int) -> None:
        with free:
            judge(out, job.row, [job.seed], world, at, None, own, threads)

    def start_on_cpu(job: Job, at: int) -> None:
        for world in asked:
            if world in rows.ON_CPU:
                beside.append(threading.Thread(target=on_cpu, args=(job, world, at), daemon=True))
                beside[-1].start()

    def training(job: Job) -> Callable[[str | None], None]:
        def run(gpu: str | None) -> None:
            train(job, gpu, iterations, until, save, extra)
            say(f"{job.row.key} seed {job.seed}: {done(job.folder).steps / 1e6:.1f} M steps")
            if at is None:
                return
            if at not in checkpoints(job.folder):
                say(f"{job.row.key} seed {job.seed}: did not come to iteration {at}, not judged")
                return
            start_on_cpu(job, at)
            for world in asked:
                if world not in rows.ON_CPU:
                    judge(out, job.row, [job.seed], world, at, gpu, own, threads)
            say(f"{job.row.key} seed {job.seed}: judged at iteration {at}")

        return run

    for t in lanes([training(j) for j in jobs], [g for _ in range(each) for g in gpus]):
        t.join()
    if at is None and asked:
        at = common(jobs)
        if at is None:
            raise UserError(f"out={out}: not every training kept iteration {save}; see its train.log")
        say(f"judging all at iteration {at}")
        for job in jobs:
            start_on_cpu(job, at)
        on_gpu = [  # all seeds of a row at once: an evaluation takes as long for many worlds as for few
            lambda gpu, r=r, w=w: judge(out, r, [j.seed for j in jobs if j.row == r], w, at, gpu, own, threads)
            for w in asked if w not in rows.ON_CPU for r in every
        ]  # fmt: skip
        for t in lanes(on_gpu, gpus if None in gpus else [g for _ in range(3) for g in gpus]):
            t.join()
    for t in beside:
        t.join()
    say("done: python -m benchmarks.touch_matters.analysis out=" + str(out))


if __name__ == "__main__":
    tools.command(main, __doc__)
