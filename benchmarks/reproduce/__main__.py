"""Train and judge every row of the paper's ablation tables, and write them beside its numbers.

    python -m benchmarks.reproduce table=rotation|grasp [budget=1] [seeds=2] [gpus=0,1,..] [out=out/reproduce_<table>]
    [sitting=M]
                                   [stages=0.3] [fit=true] [overlap=true] [rows=full,quaternion] [minutes=M]
                                   [episodes=128] [cap=120] [any other setting of train.py]

budget=1 is STEPS environment steps a row and seed; every row gets the same. gpus: one training on each at a time; null
= all there are, or the CPU. Each policy is judged twice: with the physics and ranges it was trained in (episodes
trials) and in `reality=bench` (half as many, or other_episodes); rotation trials end after `cap` seconds. minutes ends
a training early (it is judged as it is); sitting ends all training after so many minutes, saved. The same command again
goes on where it stopped, and with a larger budget from where the smaller one ended; `python -m
benchmarks.reproduce.pack` makes what that needs small enough to take to another machine. report=true only writes the
tables from what is there. stages (shares of the budget, ascending): every row reaches one before any goes on, and is
judged there too, so that an early end leaves a table of equals. fit: with `sitting`, the budget is lowered to what
every row can reach in it, at the rate seen until the last stage. overlap: on a GPU with memory for two, a training
starts while the last one ends (it saves some 15 s each). Writes <table>.md, <table>.json, <table>.png into `out`
(<table>_at_<steps>M of a stage). rotation has rows of our own besides the paper's, in a table of their own,
rotation_own.md, .json, .png: without randomization (fixed: what the other world costs), with the paper's critic
(paper_critic), its bare reward (paper_reward), a curriculum of the randomization (curriculum), each against the row
`full` judged in `out` at the same steps:
    python -m benchmarks.reproduce table=rotation rows=fixed,paper_reward,curriculum,paper_critic budget=0.3
"""

from __future__ import annotations

import json
import math
import os
import sys
from pathlib import Path

import torch

from benchmarks import tools
from benchmarks.reproduce import jobs, report, rows
from dexsim.console.ending import guard
from dexsim.errors import UserError

STEPS = 150e6
OWN = {"table": "", "budget": "1", "seeds": "2", "gpus": "null", "out": "null", "rows": "null", "minutes": "null",
       "episodes": "128",
       "other_episodes": "null", "sitting": "null", "cap": "120", "reality": "bench", "judge": "auto",
       "report": "false", "stages": "null", "fit": "false", "overlap": "false"}  # fmt: skip


def number(own: dict[str, str], key: str, low: float, high: float, whole: bool = False) -> float:
    """A setting's number; UserError with its range otherwise."""
    try:
        value = float(own[key])
    except ValueError:
        value = math.nan
    if not low <= value <= high or (whole and value != int(value)):
        raise UserError(f"{key}={own[key]}: must be a {'whole ' if whole else ''}number from {low:g} to {high:g}")
    return value


def shares(own: dict[str, str], steps: float) -> tuple[float, ...]:
    """`stages` in environment steps; UserError unless they ascend between 0 and 1."""
    try:
        values = [] if own["stages"] == "null" else [float(v) for v in own["stages"].split(",")]
    except ValueError:
        values = [math.nan]
    if not all(0 < v < 1 for v in values) or values != sorted(set(values)):
        raise UserError(
            f"stages={own['stages']}: must be shares of the budget between 0 and 1, ascending, with commas between"
        )
    return tuple(v * steps for v in values)


def main(argv: list[str]) -> int:
    if any(a in ("-h", "--help", "help") for a in argv):
        print(__doc__)
        return 0
    own, extra = tools.split(argv, OWN)
    table = own["table"]
    if table not in rows.TABLES:
        raise UserError(f"table={table or 'null'}: must be {' or '.join(rows.TABLES)}")
    every = [*rows.TABLES[table], *(rows.OURS if table == "rotation" else (rows.TORQUE_NEAR,))]
    chosen = every if own["rows"] == "null" else [r for k in own["rows"].split(",") for r in every if r.key == k]
    if not chosen or (own["rows"] != "null" and len(chosen) != len(own["rows"].split(","))):
        raise UserError(f"rows={own['rows']}: must be of {', '.join(r.key for r in every)}, with commas between")
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    gpus: list[str | None] = [str(i) for i in range(count)] or [None]
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible and count:
        gpus = [v.strip() for v in visible.split(",")][:count]
    if own["gpus"] != "null":
        gpus = [v.strip() for v in own["gpus"].split(",")]
    task = rows.TASK[table]
    for row in chosen:  # refuse a slip before hours of training
        cfg = tools.config([f"task={task}", *row.settings, *extra])
    per = cfg["worlds"] * cfg["agent"]["num_steps_per_env"]
    cores = len(os.sched_getaffinity(0))
    judge = own["judge"] if own["judge"] != "auto" else ("cpu" if cores >= 32 or not count else "cuda")
    if judge not in ("cpu", "cuda"):
        raise UserError(f"judge={judge}: must be auto, cpu or cuda")
    for key in ("report", "fit", "overlap"):
        if own[key] not in ("true", "false"):
            raise UserError(f"{key}={own[key]}: must be true or false")
    if own["fit"] == "true" and own["sitting"] == "null":
        raise UserError("fit=true: say how long with sitting=MINUTES")
    episodes = int(number(own, "episodes", 2, 1e6, whole=True))
    other = (
        max(2, episodes // 2)
        if own["other_episodes"] == "null"
        else int(number(own, "other_episodes", 2, 1e6, whole=True))
    )
    minutes, sitting = (None if own[k] == "null" else number(own, k, 0.01, 1e5) for k in ("minutes", "sitting"))
    spare = max(1, cores - math.ceil(1.5 * len(gpus)))  # what the trainings leave
    threads = max(1, min(4, spare // (2 * len(gpus))))  # few: a judging of twice the threads is not twice as fast
    steps = number(own, "budget", 1e-9, 1e4) * STEPS
    plan = jobs.Plan(
        Path(own["out"] if own["out"] != "null" else f"out/reproduce_{table}").expanduser().absolute(),
        task,
        steps,
        per,
        minutes,
        {"simulation": episodes, "reality": other},
        number(own, "cap", 1, 1e4),
        own["reality"],
        threads,
        tuple(extra),
        judge,
        sitting,
        shares(own, steps),
        own["fit"] == "true",
        own["overlap"] == "true",
    )
    plan.out.mkdir(parents=True, exist_ok=True)
    seeds = range(1, 1 + int(number(own, "seeds", 1, 100, whole=True)))
    all_jobs = [jobs.Job(row, seed) for seed in seeds for row in chosen]
    print(
        f"{len(chosen)} rows, {len(all_jobs)} trainings of {plan.steps / 1e6:.1f} M steps ({per:,} an iteration), "
        f"on {', '.join('CPU' if g is None else f'GPU {g}' for g in gpus)}; judged on {judge}: {plan.out}",
        flush=True,
    )
    about = tools.about("cuda:0" if count else "cpu") | {
        "command": "python -m benchmarks.reproduce " + " ".join(argv),
        "gpus": len([g for g in gpus if g]),
    }
    if own["report"] == "false":
        plan = jobs.run(all_jobs, plan, gpus, spare // threads)
    for stage in plan.each()[:-1]:
        if any(jobs.read(j, stage, w) for j in all_jobs for w in jobs.WORLDS):
            report.write(table, stage, all_jobs, about)
    written = report.write(table, plan, all_jobs, about)
    print("\n".join(path.read_text() for path in written))
    missing = [f"{j.name} in {w}" for j in all_jobs for w in jobs.WORLDS if jobs.read(j, plan, w) is None]
    if missing:
        print(f"not judged: {'; '.join(missing)}", file=sys.stderr)
    print(
        json.dumps(
            {"benchmark": "reproduce", "table": table, "markdown": [str(p) for p in written], "missing": len(missing)}
        )
    )
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:]))
