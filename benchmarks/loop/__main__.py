"""The loop closed, as one command: train naive, lose in a concealed reality, record there, diagnose, fine-tune, run
again.

    python -m benchmarks.loop [tasks=grasp,rotate] [worlds=late,stiff] [seeds=3] [naive=60] [tune=150] [gpus=0,1,... |
    gpus=none]
                              [cpus=N] [episodes=grasp:256,rotate:64] [diagnose_s=600] [out=out/loop] [stop_s=0]
                              [kill_s=0] [report=false] [train_cores=1] [judge_cores=2] [diagnose_cores=8]
                              [variants=wide,fitted,truth] [diagnose_gpus=2,3 diagnose_slots=3] [train="worlds=64 ..."]

For each task and seed the included policy goes on for `naive` iterations in the believed simulator without
randomization of the drives. A reality is one hand: the naive policies' own runs in it are recorded, then the empty hand
under safe excitation that is as fast as they were, then presses on its five fingertips; all that is diagnosed once.
Then three fine-tunes of each naive checkpoint of `tune`
iterations: with the servo table and the touch that `diagnose` fitted (the intervals are the randomization), with wide
randomization of the believed drives alone, and with the true drives and touch (the ceiling). Every policy is judged in
the reality on the same episodes. All steps are commands of the product. One GPU a training, as many at a time as `gpus`
lists (0,0: two share one); judging, recording and diagnosing use the CPUs meanwhile. gpus=none (the default): trainings
run on the CPU too, as many as cpus= cores allow; with the 128 worlds of a CPU, fine-tuning a policy that has converged
changes next to nothing, so that is for trying the command. diagnose_gpus: GPUs beside those of gpus= on which the
diagnoses are computed too (a reality each), and then so many trainings at a time. Resumable: a step that is done is not
repeated. stop_s: seconds after which no training is begun, and little later no judging; kill_s: after which what still
runs is ended. Writes loop.json and table.md.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml
from scipy.stats import t as student

from benchmarks.loop import presses
from benchmarks.loop.steps import FAST, KEPT
from benchmarks.options import options
from dexsim import intervals
from dexsim.console.ending import guard
from dexsim.paths import CONFIGS

ROOT = Path(__file__).parents[2]
SETTINGS = {"tasks": "grasp,rotate", "worlds": "late,stiff", "seeds": "3", "naive": "60", "tune": "150", "gpus": "",
            "cpus": str(os.cpu_count() or 1),
            "episodes": "grasp:256,rotate:64", "out": "out/loop", "stop_s": "0", "report": "false", "train": "",
            "cap_s": "60", "diagnose_s": "600", "kill_s": "0",
            "train_cores": "1", "judge_cores": "2", "diagnose_cores": "8", "variants": "wide,fitted,truth",
            "diagnose_gpus": "",
            "diagnose_slots": "3"}  # fmt: skip
# what is judged: file key, larger is better. The share that counts is that of a task's first measure; the others stand
# beside it
METRICS = {"grasp": [("hold_rate_all", True, "held %", 100.0), ("force_error_N", False, "force error N", 1.0)],
           "rotate": [("consecutive_successes.average", True, "successes in a row", 1.0)]}  # fmt: skip
FIXED = {"kp": 1.0, "kd": 1.0, "torque_limit": 1.0, "no_load_speed": 1.0, "efficiency": 1.0, "deadband": 0.0,
         "delay": 0.0, "coulomb_friction": 1.0,
         "torque_ripple": 0.0}  # fmt: skip
WIDE = {"kp": "[0.4,1.25]", "kd": "[0.4,1.6]", "torque_limit": "[0.6,1.05]", "no_load_speed": "[0.4,1.1]",
        "efficiency": "[0.7,1.0]", "deadband": "[0.0,0.015]",
        "delay": "[0.0,0.04]", "coulomb_friction": "[0.5,4.0]", "torque_ripple": "[0.0,0.02]"}  # fmt: skip
OWN_S = 20  # s of a rotation policy's own run that are recorded
DRAWN = 0.25  # share of what was found by which training draws about it, at most
JUDGING = 75.0  # s that judging may be begun after the last training
FINGERS = ("thumb", "index", "mid", "ring", "pinky")
VARIANTS = ("naive", "wide", "fitted", "truth")


@dataclass
class Job:
    """A step: done when its mark is there. run(slot) returns whether it worked; slot: the GPU's name, or "cpu". gpu:
    takes a GPU where there are any; cores: that it takes otherwise."""

    name: str
    mark: Path
    run: object
    gpu: bool
    after: list[str] = field(default_factory=list)
    rank: int = 0
    cores: int = 1
    behind: list[str] = field(default_factory=list)
    frees: list[str] = field(default_factory=list)


class Queue:
    """Runs jobs on GPUs and CPU cores as their predecessors finish, the lowest rank first: none of a higher one
    overtakes it."""

    def __init__(self, jobs: list[Job], gpus: list[str], cores: int, stop_s: float, kill_s: float, kill):
        self.jobs = {j.name: j for j in jobs}
        self.gpus, self.with_gpus, self.cores, self.free = list(gpus), bool(gpus), cores, cores
        self.stop_s, self.kill_s, self.kill = stop_s, kill_s, kill
        self.state = {j.name: "done" if j.mark.is_file() else "waits" for j in jobs}
        self.gpus += [g for j in jobs if self.state[j.name] == "done" for g in j.frees]
        self.lock, self.begun = threading.Condition(), time.perf_counter()

    def _takes(self, job: Job) -> int:
        """Return the cores of a job; a training on a GPU takes none."""
        return 0 if job.gpu and self.with_gpus else min(job.cores, self.cores)

    def go(self) -> None:
        """Until nothing can be begun any more."""
        threads: list[threading.Thread] = []
        with self.lock:
            while True:
                spent = time.perf_counter() - self.begun
                if self.kill_s and spent > self.kill_s:
                    self.kill()
                full = False
                for job in sorted(self.jobs.values(), key=lambda j: j.rank):
                    late = self.stop_s and spent > self.stop_s + (0.0 if job.gpu else JUDGING)
                    if self.state[job.name] != "waits" or late:
                        continue
                    before = [self.state[a] for a in job.after]
                    if "failed" in before:
                        self.state[job.name] = "failed"
                        print(f"  {job.name}: left out, what it needs failed", flush=True)
                        continue
                    if any(s != "done" for s in before) or any(self.state[b] == "waits" for b in job.behind):
                        continue
                    on_gpu = job.gpu and self.with_gpus
                    if on_gpu and not self.gpus or not on_gpu and (full or self.free < self._takes(job)):
                        full = full or not on_gpu
                        continue
                    slot = self.gpus.pop(0) if on_gpu else "cpu"
                    self.free -= self._takes(job)
                    self.state[job.name] = "runs"
                    threads.append(threading.Thread(target=self._one, args=(job, slot), daemon=True))
                    threads[-1].start()
                if not any(s == "runs" for s in self.state.values()):
                    break
                self.lock.wait(1.0)

    def _one(self, job: Job, slot: str) -> None:
        start = time.perf_counter()
        try:
            good = bool(job.run(slot))
        except Exception as error:  # the others go on
            print(f"  {job.name}: {type(error).__name__}: {error}", flush=True)
            good = False
        if good:
            job.mark.parent.mkdir(parents=True, exist_ok=True)
            job.mark.write_text(f"{time.perf_counter() - start:.1f}\n", encoding="utf-8")
        with self.lock:
            self.state[job.name] = "done" if good else "failed"
            self.gpus += job.frees + ([slot] if slot != "cpu" else [])
            self.free += self._takes(job)
            done = sum(s in ("done", "failed") for s in self.state.values())
            spent = time.perf_counter() - self.begun
            print(
                f"  {done}/{len(self.state)} {job.name} {'done' if good else 'FAILED'}"
                f" {time.perf_counter() - start:.0f} s; {spent:.0f} s spent",
                flush=True,
            )
            self.lock.notify_all()


class Loop:
    """The jobs and where their results are."""

    def __init__(self, s: dict[str, str]):
        self.s, self.out = s, Path(s["out"]).expanduser().resolve()
        self.tasks, self.worlds = s["tasks"].split(","), s["worlds"].split(",")
        self.variants = set(s["variants"].split(","))
        self.seeds = list(range(1, int(s["seeds"]) + 1))
        self.gpus = [g for g in s["gpus"].split(",") if g not in ("", "none")]
        self.episodes = {k: int(v) for k, v in (part.split(":") for part in s["episodes"].split(","))}
        self.running: set[subprocess.Popen] = set()
        self.extra = [x for x in s["train"].split(" ") if x]
        self.cores = int(s["cpus"])
        self.uses = {k: max(1, min(int(s[f"{k}_cores"]), self.cores)) for k in ("train", "judge", "diagnose")}

    def call(self, argv: list[str], log: Path, gpu: str = "", limit: float = 3600.0, threads: int = 1) -> int:
        """Return a command of the product, its output in a file. gpu: the one that it sees; threads:
        OMP_NUM_THREADS."""
        return 0 if self.first([(argv, log, gpu, threads)], limit) == 0 else 1

    def first(self, commands: list[tuple[list[str], Path, str, int]], limit: float) -> int | None:
        """Runs commands (argv, log, gpu, threads) side by side until one has ended well, and ends the others: its
        number, or None."""
        processes = []
        for argv, log, gpu, threads in commands:
            log.parent.mkdir(parents=True, exist_ok=True)
            env = os.environ | {
                "OMP_NUM_THREADS": str(threads),
                "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
            }
            env["CUDA_VISIBLE_DEVICES"] = "" if gpu in ("", "cpu") else gpu
            with open(log, "w", encoding="utf-8") as file:
                processes.append(
                    subprocess.Popen([sys.executable, *argv], cwd=ROOT, env=env, stdout=file, stderr=subprocess.STDOUT)
                )
            if len(commands) > 1 and not gpu:  # what has a GPU beside it leaves that one its cores
                os.setpriority(os.PRIO_PROCESS, processes[-1].pid, 10)
        self.running |= set(processes)
        end = time.perf_counter() + limit
        try:
            while time.perf_counter() < end:
                status = [p.poll() for p in processes]
                if 0 in status:
                    return status.index(0)
                if None not in status:
                    return None
                time.sleep(0.1)
            return None
        finally:
            for p in processes:
                if p.poll() is None:
                    p.kill()
                    p.wait()
            self.running -= set(processes)

    def kill(self) -> None:
        """Ends what this program began."""
        for process in list(self.running):
            process.kill()

    def folder(self, task: str, seed: int, world: str = "") -> Path:
        return self.out / f"{task}_{seed}" / world

    def device(self, slot: str) -> str:
        return "cpu" if slot == "cpu" else "cuda"

    def naive(self, task: str, seed: int):
        def run(slot: str) -> bool:
            where = self.folder(task, seed)
            shutil.rmtree(where / "naive", ignore_errors=True)
            device = self.device(slot)
            if not (where / "start.pt").is_file():
                fixed = [f"randomize.servo.{k}={v}" for k, v in self._ranges(task, FIXED).items()]
                status = self.call(["-m", "benchmarks.loop.steps", "start",
                                    f"checkpoint={ROOT / 'checkpoints' / f'{task}.pt'}", f"out={where / 'start.pt'}",
                                    f"device={device}", f"seed={seed}", *fixed], where / "start.log", slot)  # fmt: skip
                if status:
                    return False
            worlds = ["worlds=128", f"sim.threads={self.uses['train']}"] if device == "cpu" else ["worlds=8192"]
            self.call(["train.py", f"resume={where / 'start.pt'}", f"iterations={self.s['naive']}",
                       f"out={where / 'naive'}", f"device={device}",
                       "final_episodes=0", "save_interval=100000", *worlds, *self.extra], where / "naive.log",
                       slot)  # fmt: skip
            return (where / "naive" / "policy.pt").is_file()

        return run

    def _ranges(self, task: str, values: dict) -> dict:
        """Return those that the task's randomization has."""
        own = yaml.safe_load(
            (CONFIGS / "randomize" / ("rotate.yaml" if task == "rotate" else "default.yaml")).read_text(
                encoding="utf-8"
            )
        )["servo"]
        return {k: v for k, v in values.items() if k in own}

    def tune(self, task: str, seed: int, variant: str, world: str):
        def run(slot: str) -> bool:
            base = self.folder(task, seed)
            where = base / (f"tune_{variant}" if variant == "wide" else f"{world}/tune_{variant}")
            shutil.rmtree(where, ignore_errors=True)
            argv = ["train.py", f"resume={base / 'naive' / 'last.pt'}",
                    f"iterations={int(self.s['naive']) + int(self.s['tune'])}", f"out={where}",
                    f"device={self.device(slot)}", "final_episodes=0", "save_interval=100000",
                    *([f"sim.threads={self.uses['train']}"] if slot == "cpu" else []), *self.extra]  # fmt: skip
            if variant == "wide":
                argv += [f"randomize.servo.{k}={v}" for k, v in self._ranges(task, WIDE).items()]
            elif variant == "fitted":
                argv += [
                    f"servo_file={self.fitted(base, world)}",
                    f"tactile_file={self.out / f'touch_{world}' / 'tactile.yaml'}",
                ]
                if presses.feels_others(self.out / f"touch_{world}" / "pinch.mcap"):
                    argv.append("tactile.feel_others=true")
            else:
                true = yaml.safe_load((CONFIGS / "reality" / f"{world}.yaml").read_text(encoding="utf-8"))
                (base / world).mkdir(parents=True, exist_ok=True)
                (base / world / "true.yaml").write_text(
                    yaml.safe_dump(true["servo"], sort_keys=False), encoding="utf-8"
                )
                argv.append(f"servo_file={base / world / 'true.yaml'}")
                argv += [
                    f"tactile.{k}={str(v).lower() if isinstance(v, bool) else v}" for k, v in true["tactile"].items()
                ]
            self.call(argv, where.parent / f"{where.name}.log", slot)
            return (where / "policy.pt").is_file()

        return run

    def fitted(self, base: Path, world: str) -> Path:
        """Return the servo.yaml that `diagnose` wrote, its ranges cut to DRAWN of what was found: each interval is
        that of one figure with all others free (a longer delay goes with a shorter lag), and drawn at once their
        corners are drives that no recording allows. A range that `diagnose` let reach the belief, being unsure, is
        cut like the others."""
        from dexsim.actuator.table import ServoTable

        belief, table = (
            ServoTable.load(CONFIGS / "servo" / "xhand.yaml"),
            ServoTable.load(self.out / f"diagnosis_{world}" / "servo.yaml"),
        )
        for joint, columns in table.entries.items():
            for name, v in columns.items():
                if not v.unknown and v.low < v.high:
                    half = DRAWN * max(abs(v.value - belief.value(joint, name).value), 0.2 * abs(v.value))
                    table.set(joint, name, v.value, max(v.low, v.value - half), min(v.high, v.value + half))
        (base / world).mkdir(parents=True, exist_ok=True)
        table.save(base / world / "fitted.yaml")
        return base / world / "fitted.yaml"

    def policy(self, task: str, seed: int, variant: str, world: str) -> Path:
        base = self.folder(task, seed)
        return base / {"naive": "naive", "wide": "tune_wide"}.get(variant, f"{world}/tune_{variant}") / "policy.pt"

    def judge(self, task: str, seed: int, variant: str, world: str):
        def run(slot: str) -> bool:
            where = self.folder(task, seed, world) / f"judged_{variant}"
            cap = [f"task.evaluation.cap_s={self.s['cap_s']}"] if task == "rotate" else []
            status = self.call(["play.py", f"checkpoint={self.policy(task, seed, variant, world)}", f"reality={world}",
                                f"episodes={self.episodes[task]}",
                                "seed=77", "video=false", f"out={where}", f"sim.threads={self.uses['judge']}", *cap],
                                where / "log.txt", limit=900)  # fmt: skip
            return status == 0 and (where / "metrics.json").is_file()

        return run

    def own(self, task: str, world: str):
        """Return a naive policy's own run in the reality, recorded as its bus reads."""

        def run(slot: str) -> bool:
            where = self.out / f"own_{world}"
            cap = [f"task.evaluation.cap_s={OWN_S}"] if task == "rotate" else []
            argv = ["play.py", f"checkpoint={self.policy(task, self.seeds[0], 'naive', world)}", f"reality={world}",
                    "episodes=4", "seed=101", "video=false",
                    f"record={where / f'{task}.mcap'}", "record_worlds=1", "realistic=true", f"out={where / task}",
                    "sim.threads=1", *cap]  # fmt: skip
            return self.call(argv, where / f"{task}.log", limit=300) == 0 and (where / f"{task}.mcap").is_file()

        return run

    def excite(self, world: str):
        """As fast as the policies move there."""

        def run(slot: str) -> bool:
            where = self.out / f"excited_{world}"
            own = ",".join(str(self.out / f"own_{world}" / f"{task}.mcap") for task in self.tasks)
            return (
                self.call(
                    ["-m", "benchmarks.loop.steps", "record", f"world={world}", f"own={own}", f"out={where}", "seed=1"],
                    where / "log.txt",
                )
                == 0
            )

        return run

    def helper(self, world: str) -> str:
        """Return the GPU on which a reality's diagnosis is computed too; "" for none."""
        gpus = [g for g in self.s["diagnose_gpus"].split(",") if g]
        return gpus[self.worlds.index(world) % len(gpus)] if gpus else ""

    def diagnose(self, world: str):
        """Return one reality is one hand: it is diagnosed once, from what was excited. The policies' own runs say
        how fast
        that has to be, and are not fitted: a joint is judged while nothing is touched, and most of what they touch
        carries no taxels. What they command, played again on the empty hand, throws the joints against the ends of
        their motion (lab/results/loop.md)."""

        def run(slot: str) -> bool:
            where = self.out / f"diagnosis_{world}"
            excited, fast = (
                sorted((self.out / f"excited_{world}").glob("excite_*.mcap")),
                [self.out / f"excited_{world}" / name for name in FAST],
            )
            fit, held = [*excited[:-KEPT], fast[0]], [*excited[-KEPT:], fast[1]]
            argv = [
                "diagnose.py",
                f"recordings=[{','.join(map(str, fit))}]",
                f"held_out=[{','.join(map(str, held))}]",
                "next=false",
                "replay=none",
            ]
            tries = [([*argv, f"out={where}"], self.out / f"diagnosis_{world}.log", "", self.uses["diagnose"])]
            if helper := self.helper(world):  # beside the cores: whichever is done first
                other = self.out / f"diagnosis_{world}_gpu"
                tries.append(
                    ([*argv, f"out={other}", "device=cuda"], self.out / f"diagnosis_{world}_gpu.log", helper, 2)
                )
            won = self.first(tries, float(self.s["diagnose_s"]))
            if won == 1:
                shutil.rmtree(where, ignore_errors=True)
                other.rename(where)
            return won is not None and (where / "servo.yaml").is_file()

        return run

    def press(self, finger: str, world: str):
        """Return a fingertip pressed in the reality, and its diagnosis."""

        def run(slot: str) -> bool:
            where = self.out / f"touch_{world}" / finger
            if self.call(
                ["-m", "benchmarks.loop.presses", "record", f"world={world}", f"finger={finger}", f"out={where}"],
                where / "record.log",
                limit=300,
            ):
                return False
            argv = [
                "diagnose.py",
                f"recordings=[{','.join(map(str, sorted(where.glob('press_*.mcap'))))}]",
                f"model={where / 'rig.xml'}",
                f"servo={where / 'rig.yaml'}",
            ]
            return (
                self.call(
                    [*argv, "next=false", f"out={where / 'found'}"],
                    where / "found.log",
                    limit=float(self.s["diagnose_s"]),
                )
                == 0
            )

        return run

    def touch(self, world: str):
        """Return what was found on the five fingertips, as training takes it."""

        def run(slot: str) -> bool:
            where = self.out / f"touch_{world}"
            pinched = self.call(
                ["-m", "benchmarks.loop.presses", "pinch", f"world={world}", f"out={where / 'pinch.mcap'}"],
                where / "pinch.log",
                limit=300,
            )
            found = ",".join(str(where / f) for f in FINGERS)
            return (
                not pinched
                and self.call(
                    ["-m", "benchmarks.loop.presses", "sum", f"found={found}", f"out={where / 'tactile.yaml'}"],
                    where / "sum.log",
                )
                == 0
            )

        return run

    def jobs(self) -> list[Job]:
        """Return all steps; those that others wait for come first, wide randomization last. Nothing is trained or
        judged that would keep the diagnoses, or what is fitted, waiting for a GPU or for cores."""
        out = []
        for w in self.worlds:
            for task in self.tasks:
                out.append(
                    Job(
                        f"own {task} {w}",
                        self.out / f"own_{w}" / f"{task}.done",
                        self.own(task, w),
                        False,
                        [f"naive {task} {self.seeds[0]}"],
                        0,
                    )
                )
            out.append(
                Job(
                    f"excite {w}",
                    self.out / f"excited_{w}.done",
                    self.excite(w),
                    False,
                    [f"own {task} {w}" for task in self.tasks],
                    1,
                )
            )
            for finger in FINGERS:
                out.append(
                    Job(
                        f"press {finger} {w}",
                        self.out / f"touch_{w}" / f"{finger}.done",
                        self.press(finger, w),
                        False,
                        [],
                        1,
                    )
                )
            out.append(
                Job(
                    f"touch {w}",
                    self.out / f"touch_{w}.done",
                    self.touch(w),
                    False,
                    [f"press {finger} {w}" for finger in FINGERS],
                    1,
                )
            )
            sharing = [x for x in self.worlds if self.helper(x) == self.helper(w)]
            free = ([self.helper(w)] if self.helper(w) else []) * int(self.s["diagnose_slots"])
            out.append(Job(f"diagnose {w}", self.out / f"diagnosed_{w}.done", self.diagnose(w), False, [f"excite {w}"],
                           2, self.uses["diagnose"],
                           frees=free[sharing.index(w) :: len(sharing)]))  # fmt: skip
        diagnoses = [f"diagnose {w}" for w in self.worlds]
        tuned = [
            f"fitted {task} {seed} {w}"
            for task in self.tasks
            for seed in self.seeds
            for w in self.worlds
            if "fitted" in self.variants
        ]
        for task in self.tasks:
            for seed in self.seeds:
                base, name = self.folder(task, seed), f"{task} {seed}"
                out.append(
                    Job(f"naive {name}", base / "naive.done", self.naive(task, seed), True, [], 1, self.uses["train"])
                )
                out.append(
                    Job(
                        f"wide {name}",
                        base / "wide.done",
                        self.tune(task, seed, "wide", ""),
                        True,
                        [f"naive {name}"],
                        5,
                        self.uses["train"],
                        tuned,
                    )
                )
                for w in self.worlds:
                    here = self.folder(task, seed, w)

                    def add(what, run, gpu, after, rank, behind=(), here=here, name=name, w=w):
                        uses = self.uses["train" if gpu else "judge"]
                        done = here / f"{what.replace(' ', '_')}.done"
                        out.append(Job(f"{what} {name} {w}", done, run, gpu, after, rank, uses, list(behind)))

                    add("judge naive", self.judge(task, seed, "naive", w), False, [f"naive {name}"], 8, diagnoses)
                    add(
                        "fitted",
                        self.tune(task, seed, "fitted", w),
                        True,
                        [f"diagnose {w}", f"touch {w}", f"naive {name}"],
                        3,
                    )
                    add("truth", self.tune(task, seed, "truth", w), True, [f"naive {name}"], 4)
                    add(
                        "judge wide",
                        self.judge(task, seed, "wide", w),
                        False,
                        [f"wide {name}"],
                        9,
                        [f"judge {x}" for x in tuned],
                    )
                    add("judge fitted", self.judge(task, seed, "fitted", w), False, [f"fitted {name} {w}"], 6)
                    add("judge truth", self.judge(task, seed, "truth", w), False, [f"truth {name} {w}"], 7, diagnoses)
        left_out = {v for v in VARIANTS if v != "naive"} - self.variants
        return [j for j in out if not left_out & set(j.name.split()[:2])]

    def report(self) -> dict:
        """Return the table: by task, world and measure, the mean of each variant over seeds, and the share of the loss
        recovered."""
        lines = []
        for task in self.tasks:
            for world in self.worlds:
                for key, larger, label, unit in METRICS[task]:
                    values: dict[str, list[float]] = {v: [] for v in VARIANTS}
                    for seed in self.seeds:
                        row = {v: self._metric(task, seed, world, v, key) for v in VARIANTS}
                        for v in VARIANTS:
                            values[v].append(math.nan if row[v] is None else row[v] * unit)
                    x = {v: np.array(values[v]) for v in VARIANTS}
                    line = {
                        "task": task,
                        "world": world,
                        "measure": label,
                        "larger_is_better": larger,
                        "values": values,
                    }
                    both = np.isfinite(x["naive"]) & np.isfinite(x["truth"])
                    line["gap"] = _gap(x["naive"][both], x["truth"][both])
                    for other in ("fitted", "wide"):
                        both = np.isfinite(x["naive"]) & np.isfinite(x["truth"]) & np.isfinite(x[other])
                        if both.any() and line["gap"]["sure"]:
                            line[f"recovered_{other}"] = _ratio(x["naive"][both], x[other][both], x["truth"][both])
                    lines.append(line)
        found = {}
        for world in self.worlds:
            path = self.out / f"diagnosis_{world}" / "diagnosis.json"
            if path.is_file():
                d = json.loads(path.read_text(encoding="utf-8"))
                found[world] = {"verdict": d["verdict"], "before": d["held_out"]["before"],
                                "after": d["held_out"]["after"],
                                "findings": [[f["effect"], f["where"]["joints"],
                                              round(f["confidence"], 2)] for f in d["findings"]]}  # fmt: skip
        return {"benchmark": "loop", "settings": self.s, "lines": lines, "diagnoses": found}

    def _metric(self, task: str, seed: int, world: str, variant: str, key: str) -> float | None:
        path = self.folder(task, seed, world) / f"judged_{variant}" / "metrics.json"
        if not path.is_file():
            return None
        node = json.loads(path.read_text(encoding="utf-8"))
        for part in key.split("."):
            node = (node or {}).get(part)
        return None if node is None else float(node)


def _gap(naive: np.ndarray, truth: np.ndarray) -> dict:
    """Mean over seeds of truth - naive (a seed's fine-tune begins at its naive policy, and both play the same episodes)
    with its 95 % interval (Student's t), and whether it is surely not 0: what cannot be told from nothing has no share
    that could be recovered. One
    seed: taken as it is."""
    if not len(naive):
        return {"value": None, "low": None, "high": None, "sure": False}
    n, value = len(naive), float((truth - naive).mean())
    half = float(student.ppf(0.975, n - 1)) * float((truth - naive).std(ddof=1)) / math.sqrt(n) if n > 1 else 0.0
    return {"value": value, "low": value - half, "high": value + half, "sure": abs(value) > half}


def _ratio(naive: np.ndarray, other: np.ndarray, truth: np.ndarray) -> dict:
    """(mean other - mean naive) / (mean truth - mean naive), with a 95 % interval by resampling seeds."""

    def part(naive: np.ndarray, other: np.ndarray, truth: np.ndarray, axis: int = -1) -> np.ndarray:
        gap = truth.mean(axis) - naive.mean(axis)
        there = np.abs(gap) > 1e-9
        return np.where(there, (other.mean(axis) - naive.mean(axis)) / np.where(there, gap, 1.0), math.nan)

    value, draws = float(part(naive, other, truth)), intervals.draws((naive, other, truth), part, 0, 2000)
    finite = draws[np.isfinite(draws)]
    low, high = (float(v) for v in np.percentile(finite, (2.5, 97.5))) if len(finite) else (math.nan, math.nan)
    return {"value": value, "low": low, "high": high, "seeds": len(naive)}


def _share(r: dict) -> str:
    """With its interval; of one seed there is none."""
    return f"{r['value']:.2f} " + (f"({r['low']:.2f} to {r['high']:.2f})" if r["seeds"] > 1 else "(one seed)")


def markdown(data: dict) -> str:
    """Return the table as Markdown."""
    text = [
        "| task, reality | measure | naive | wide | fitted | true physics | recovered by fitted | by wide |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for line in data["lines"]:
        cells = []
        for v in VARIANTS:
            x = np.array([a for a in line["values"][v] if a == a])
            cells.append(
                "-"
                if not len(x)
                else f"{x.mean():.3g}" + (f" ± {x.std(ddof=1) / math.sqrt(len(x)):.2g}" if len(x) > 1 else "")
            )
        none = "-" if line["gap"]["sure"] or line["gap"]["value"] is None else "no sure gap"
        shares = [_share(r) if (r := line.get(f"recovered_{o}")) else none for o in ("fitted", "wide")]
        text.append(f"| {line['task']}, {line['world']} | {line['measure']} | " + " | ".join(cells + shares) + " |")
    return "\n".join(text) + "\n"


def main(argv: list[str]) -> int:
    """Runs what is not done yet and reports. Raises UserError for a setting that is none."""
    if any(a in ("-h", "--help", "help") for a in argv):
        print(__doc__)
        return 0
    s = options(argv, SETTINGS)
    loop = Loop(s)
    loop.out.mkdir(parents=True, exist_ok=True)
    if s["report"] != "true":
        Queue(loop.jobs(), loop.gpus, loop.cores, float(s["stop_s"]), float(s["kill_s"]), loop.kill).go()
    data = loop.report()
    (loop.out / "loop.json").write_text(json.dumps(data, indent=1), encoding="utf-8")
    (loop.out / "table.md").write_text(markdown(data), encoding="utf-8")
    print("\n" + markdown(data))
    print(
        json.dumps(
            {"benchmark": "loop", "lines": [{k: v for k, v in x.items() if k != "values"} for x in data["lines"]]}
        )
    )
    return 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:]))
