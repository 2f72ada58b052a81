"""The loop closed, as one command: train naive, lose in a concealed reality, record there, diagnose, fine-tune, run
again.

    python -m benchmarks.loop [tasks=grasp,rotate] [realities=late,stiff] [seeds=3] [naive=60] [tune=150] [gpus=0,1,...]
                              [on=slurm|dask] [at_once=N] [episodes=grasp:256,rotate:64] [diagnose_s=600] [cap_s=60]
                              [variants=wide,fitted,truth] [out=out/loop] [report=false] [any setting of train.py]

For each task and seed the included policy goes on for `naive` iterations in the believed simulator without
randomization of the drives. A reality is one hand: the naive policies' own runs in it are recorded, then the empty hand
under safe excitation that is as fast as they were, then presses on its five fingertips; all that is diagnosed once.
Then three fine-tunes of each naive checkpoint of `tune` iterations: with the servo table and the touch that `diagnose`
fitted (the intervals are the randomization), with wide randomization of the believed drives alone, and with the true
drives and touch (the ceiling). Every policy is judged in the reality on the same episodes. All steps are commands of
the product. gpus: as many trainings at a time as there are names (0,0: two share one); none: one, on the CPU, where
fine-tuning a policy that has converged changes next to nothing, so that is for trying the command. at_once: of what
runs on cores, recordings, diagnoses and judgements. Goes on where it was interrupted. Writes loop.json and table.md.
"""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import yaml
from scipy.stats import t as student

from benchmarks import tools
from benchmarks.loop import presses
from benchmarks.loop.steps import EXCITED, FAST, KEPT
from benchmarks.options import options
from dexsim import intervals
from dexsim.console import jobs
from dexsim.errors import UserError
from dexsim.paths import CONFIGS
from dexsim.typed import whole

ROOT = Path(__file__).parents[2]
SETTINGS = {"tasks": "grasp,rotate", "realities": "late,stiff", "seeds": "3", "naive": "60", "tune": "150", "gpus": "",
            "episodes": "grasp:256,rotate:64", "out": "out/loop", "report": "false", "cap_s": "60", "diagnose_s": "600",
            "variants": "wide,fitted,truth"}  # fmt: skip
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
FINGERS = ("thumb", "index", "mid", "ring", "pinky")
VARIANTS = ("naive", "wide", "fitted", "truth")
STEPS, PRESSES = "benchmarks.loop.steps", "benchmarks.loop.presses"


class Loop:
    """The jobs, each a command or several of the product, and where their results are. s: settings; extra: those of
    training; device: of trainings and judgements."""

    def __init__(self, s: dict[str, str], extra: Sequence[str] = (), device: str = "cpu") -> None:
        self.s, self.out = s, Path(s["out"]).expanduser().resolve()
        self.tasks, self.worlds, self.variants = (s[k].split(",") for k in ("tasks", "realities", "variants"))
        if wrong := set(self.variants) - set(VARIANTS[1:]):
            raise UserError(f"variants={wrong.pop()}: must be of {', '.join(VARIANTS[1:])}")
        self.each = [(task, seed) for task in self.tasks for seed in range(1, whole("seeds", s["seeds"], 1, 99) + 1)]
        self.episodes = dict(part.split(":") for part in s["episodes"].split(","))
        self.extra, self.device = list(extra), device

    def place(self, step: str, *names: object) -> Path:
        """Return the folder of a step: STEP/NAME_NAME."""
        return self.out / step / "_".join(map(str, names))

    def job(self, folder: Path, *commands: Sequence[object], resumes: bool = False) -> jobs.Job:
        """Return a job of modules with their arguments."""
        return jobs.Job(tuple(tuple(map(str, c)) for c in commands), folder, (sys.executable, "-m"), resumes)

    def train(self, resume: Path, iterations: int, out: Path, *settings: object) -> jobs.Job:
        """Return a training that goes on."""
        given = [f"worlds={128 if self.device == 'cpu' else 8192}", *settings, *self.extra]
        given = list({word.partition("=")[0]: word for word in given}.values())  # the last of a name counts
        return self.job(out, ("dexsim", "train", f"resume={resume}", f"iterations={iterations}", f"out={out / 'run'}",
                              f"device={self.device}", "final_episodes=0", *given),
                        resumes=True)  # fmt: skip

    def policy(self, task: str, seed: int, variant: str, world: str) -> Path:
        """Return the policy of a variant that is judged in a reality."""
        return self.place("trained", task, seed, variant, *[world] * (variant in ("fitted", "truth"))) / "run/policy.pt"

    def play(self, policy: Path, task: str, world: str, out: Path, cap_s: object, *settings: object) -> tuple:
        """Return the command that plays a policy in a reality."""
        cap = [f"task.evaluation.cap_s={cap_s}"] if task == "rotate" else []
        return ("dexsim", "play", f"checkpoint={policy}", f"reality={world}", "device=cpu", "video=false", f"out={out}",
                *cap, *settings)  # fmt: skip

    def start(self) -> Iterator[jobs.Job]:
        """Yield what makes of each included policy one that may be trained on, another for each seed."""
        for task, seed in self.each:
            out, policy = self.place("start", task, seed), ROOT / "checkpoints" / f"{task}.pt"
            fixed = [f"randomize.servo.{k}={v}" for k, v in self._ranges(task, FIXED).items()]
            yield self.job(out, (STEPS, "start", f"checkpoint={policy}", f"out={out / 'last.pt'}",
                                 f"device={self.device}", f"seed={seed}", *fixed))  # fmt: skip

    def naive(self) -> Iterator[jobs.Job]:
        """Yield the naive trainings."""
        for task, seed in self.each:
            begin = self.place("start", task, seed) / "last.pt"
            yield self.train(begin, int(self.s["naive"]), self.place("trained", task, seed, "naive"))

    def found(self) -> Iterator[jobs.Job]:
        """Yield what is recorded in each reality, and diagnosed: the empty hand, as fast as the first naive policies
        move there; and each fingertip. One reality is one hand: it is diagnosed once, from what was excited. The
        policies' own runs say how fast that has to be, and are not fitted: a joint is judged while nothing is touched,
        and most of what they touch carries no taxels. What they command, played again on the empty hand, throws the
        joints against the ends of their motion (lab/results/loop.md)."""
        diagnose = ("dexsim", "diagnose", "next=false", f"limit={self.s['diagnose_s']}", "replay=none")
        for w in self.worlds:
            out, touch, own = self.place("drives", w), self.place("touch", w), []
            commands: list[tuple] = []
            for task in self.tasks:
                policy = self.policy(task, 1, "naive", w)
                own.append(out / f"{task}.mcap")
                commands.append(self.play(policy, task, w, out / task, OWN_S, "episodes=4", "seed=101",
                                          f"record={own[-1]}", "record_worlds=1", "realistic=true"))  # fmt: skip
            excited = [out / f"excite_{k}.mcap" for k in range(len(EXCITED))]
            fit, held = [*excited[:-KEPT], out / FAST[0]], [*excited[-KEPT:], out / FAST[1]]
            yield self.job(
                out, *commands,
                (STEPS, "record", f"world={w}", f"own={','.join(map(str, own))}", f"out={out}", "seed=1"),
                (*diagnose, _listed("recordings", fit), _listed("held_out", held), f"out={out / 'diagnosis'}"),
            )  # fmt: skip
            for finger in FINGERS:
                tip = self.place("presses", w, finger)
                yield self.job(
                    tip, (PRESSES, "record", f"world={w}", f"finger={finger}", f"out={tip}"),
                    (*diagnose, f"recordings={tip / 'press_*.mcap'}", f"model={tip / 'rig.xml'}",
                     f"servo={tip / 'rig.yaml'}", f"out={tip / 'found'}"),
                )  # fmt: skip
            yield self.job(touch, (PRESSES, "pinch", f"world={w}", f"out={touch / 'pinch.mcap'}"))

    def summed(self) -> Iterator[jobs.Job]:
        """Yield what makes of five fingertips the touch of each reality, as training takes it."""
        for w in self.worlds:
            tips = ",".join(str(self.place("presses", w, f)) for f in FINGERS)
            out = self.place("tactile", w)
            yield self.job(out, (PRESSES, "sum", f"found={tips}", f"out={out / 'tactile.yaml'}"))

    def tuned(self) -> Iterator[jobs.Job]:
        """Yield the fine-tunes: fitted and true physics of each reality first, wide randomization last."""
        last = int(self.s["naive"]) + int(self.s["tune"])
        for variant in (v for v in ("fitted", "truth", "wide") if v in self.variants):
            for w in self.worlds[:1] if variant == "wide" else self.worlds:
                for task, seed in self.each:
                    out = self.policy(task, seed, variant, w).parents[1]
                    begin = self.policy(task, seed, "naive", w).with_name("last.pt")
                    yield self.train(begin, last, out, *getattr(self, f"_{variant}")(task, w))

    def judged(self) -> Iterator[jobs.Job]:
        """Yield what judges every policy in the realities, on the same episodes."""
        for task, seed in self.each:
            for variant in ("naive", *self.variants):
                for w in self.worlds:
                    out, policy = self.place("judged", task, seed, variant, w), self.policy(task, seed, variant, w)
                    yield self.job(out, self.play(policy, task, w, out, self.s["cap_s"], "seed=77",
                                                  f"episodes={self.episodes[task]}"))  # fmt: skip

    def _ranges(self, task: str, values: dict) -> dict:
        """Return those that the task's randomization has."""
        file = CONFIGS / "randomize" / ("rotate.yaml" if task == "rotate" else "default.yaml")
        own = yaml.safe_load(file.read_text(encoding="utf-8"))["servo"]
        return {k: v for k, v in values.items() if k in own}

    def _wide(self, task: str, world: str) -> list[str]:
        return [f"randomize.servo.{k}={v}" for k, v in self._ranges(task, WIDE).items()]

    def _truth(self, task: str, world: str) -> list[str]:
        true = yaml.safe_load((CONFIGS / "reality" / f"{world}.yaml").read_text(encoding="utf-8"))
        path = self.out / f"true_{world}.yaml"
        path.write_text(yaml.safe_dump(true["servo"], sort_keys=False), encoding="utf-8")
        said = {k: str(v).lower() if isinstance(v, bool) else v for k, v in true["tactile"].items()}
        return [f"servo_file={path}", *(f"tactile.{k}={v}" for k, v in said.items())]

    def _fitted(self, task: str, world: str) -> list[str]:
        given = [f"servo_file={self.fitted(world)}", f"tactile_file={self.place('tactile', world) / 'tactile.yaml'}"]
        others = presses.feels_others(self.place("touch", world) / "pinch.mcap")
        return given + ["tactile.feel_others=true"] * others

    def fitted(self, world: str) -> Path:
        """Return the servo.yaml that `diagnose` wrote, its ranges cut to DRAWN of what was found: each interval is
        that of one figure with all others free (a longer delay goes with a shorter lag), and drawn at once their
        corners are drives that no recording allows. A range that `diagnose` let reach the belief, being unsure, is
        cut like the others."""
        from dexsim.actuator.table import ServoTable

        belief = ServoTable.load(CONFIGS / "servo" / "xhand.yaml")
        table = ServoTable.load(self.place("drives", world) / "diagnosis" / "servo.yaml")
        for joint, columns in table.entries.items():
            for name, v in columns.items():
                if not v.unknown and v.low < v.high:
                    half = DRAWN * max(abs(v.value - belief.value(joint, name).value), 0.2 * abs(v.value))
                    table.set(joint, name, v.value, max(v.low, v.value - half), min(v.high, v.value + half))
        path = self.out / f"fitted_{world}.yaml"
        table.save(path)
        return path

    def report(self) -> dict:
        """Return the table: by task, world and measure, the mean of each variant over seeds, and the share of the loss
        recovered."""
        lines = []
        for task in self.tasks:
            for world in self.worlds:
                for key, larger, label, unit in METRICS[task]:
                    values: dict[str, list[float]] = {v: [] for v in VARIANTS}
                    for seed in (s for t, s in self.each if t == task):
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
            path = self.place("drives", world) / "diagnosis" / "diagnosis.json"
            if path.is_file():
                d = json.loads(path.read_text(encoding="utf-8"))
                found[world] = {"verdict": d["verdict"], "before": d["held_out"]["before"],
                                "after": d["held_out"]["after"],
                                "findings": [[f["effect"], f["where"]["joints"],
                                              round(f["confidence"], 2)] for f in d["findings"]]}  # fmt: skip
        return {"benchmark": "loop", "settings": self.s, "lines": lines, "diagnoses": found}

    def _metric(self, task: str, seed: int, world: str, variant: str, key: str) -> float | None:
        path = self.place("judged", task, seed, variant, world) / "metrics.json"
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
    """Write a share with its interval; of one seed there is none."""
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


def _listed(name: str, paths: Sequence[Path]) -> str:
    return f"{name}=[{','.join(map(str, paths))}]"


def main(argv: list[str]) -> None:
    """Run what is not done yet, a step after the other, and report. Raises UserError for a setting that is none, or a
    job that failed."""
    rest: list[str] = []
    s = options(argv, SETTINGS, rest)
    gpus = [g for g in s["gpus"].split(",") if g not in ("", "none")]
    engine, extra = jobs.taken(rest, gpus)
    loop = Loop(s, extra, "cuda" if gpus or engine.on != "local" else "cpu")
    loop.out.mkdir(parents=True, exist_ok=True)
    os.environ["OMP_NUM_THREADS"] = os.environ.get("OMP_NUM_THREADS", "1")
    os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    cores = jobs.Engine(engine.on, engine.at_once, slurm=engine.slurm)
    for step in (loop.start, loop.naive, loop.found, loop.summed, loop.tuned, loop.judged):
        if s["report"] != "true":
            print(f"{step.__name__}:", flush=True)
            tools.run(list(step()), engine if step in (loop.start, loop.naive, loop.tuned) else cores)
    data = loop.report()
    (loop.out / "loop.json").write_text(json.dumps(data, indent=1), encoding="utf-8")
    (loop.out / "table.md").write_text(markdown(data), encoding="utf-8")
    print("\n" + markdown(data))
    lines = [{k: v for k, v in x.items() if k != "values"} for x in data["lines"]]
    print(json.dumps({"benchmark": "loop", "lines": lines}))


if __name__ == "__main__":
    tools.command(main, __doc__)
