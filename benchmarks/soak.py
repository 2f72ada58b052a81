"""Training for an hour on the CPU engine: does memory, the number of open files or the time of an iteration creep?

    python -m benchmarks.soak [minutes=60] [out=FOLDER] [any other setting of train.py]

The run is train.py's own (PPO, log, checkpoints), 32 worlds and one thread unless told otherwise. After each iteration
it notes resident memory, its anonymous part (heap: a leak shows there, pages of files come and go), open files,
threads, wall time and the process's CPU time; CPU time is the measure of an iteration on a machine that does other work
as well. It is split: the PPO update is the same work in every iteration; collecting is not, because a better policy
touches more (the number of touching fingers is noted beside it). Written: soak.csv, soak.json, soak.png. The first
sixth is left out (start-up, caches, random policy). A slope is the least-squares line through the means of 30 blocks of
the rest, its 95 % interval by Student's t: blocks, because neighbouring iterations are alike. Linux only (/proc).
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import shutil
import sys
import time
from pathlib import Path

import numpy as np
from scipy import stats

from dexsim.cli import build, folder, machine
from dexsim.cli import start as start_up
from dexsim.cli import train as training
from dexsim.console.ending import guard
from dexsim.console.stop import Stop
from dexsim.errors import UserError
from dexsim.learning.runner import Runner
from dexsim.paths import CONFIGS

COLUMNS = ("iteration", "wall_s", "cpu_s", "update_cpu_s", "rss_mib", "heap_mib", "files", "threads", "touching")
BLOCKS = 30
WARM_UP = 1 / 6  # of the run, left out of the slopes
PANELS = (
    ("heap_mib", "anonymous resident memory (MiB)"),
    ("files", "open files"),
    ("touching", "touching fingers a world"),
    ("update_ms", "CPU time of a PPO update (ms)"),
    ("collect_ms", "CPU time of collecting (ms)"),
    ("wall_ms", "wall time of an iteration (ms)"),
)


class TimedRunner(Runner):
    """The runner of train.py; `update_cpu_s` sums the process CPU time of its updates."""

    update_cpu_s = 0.0

    def _update(self) -> dict[str, float]:
        before = time.process_time()
        losses = super()._update()
        self.update_cpu_s += time.process_time() - before
        return losses


def sample(runner: TimedRunner, began: float) -> tuple[float, ...]:
    """One row of COLUMNS, for this process; began: of the run, by `time.perf_counter`."""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    rss, heap = (float(status[k].split()[0]) / 1024 for k in ("VmRSS", "RssAnon"))  # kB
    return (runner.iteration, time.perf_counter() - began, time.process_time(), runner.update_cpu_s,
            rss, heap, len(os.listdir("/proc/self/fd")) - 1,  # without the one that lists them
            len(os.listdir("/proc/self/task")), float((runner.env.finger_force > 0.05).sum(1).float().mean()))


def slope(hours: np.ndarray, values: np.ndarray, blocks: int = BLOCKS) -> dict[str, float]:
    """Mean, slope an hour and its 95 % interval (low, high) of values [n] sampled at hours [n]."""
    parts = np.array_split(np.arange(len(hours)), min(blocks, len(hours)))
    x = np.array([hours[p].mean() for p in parts])
    y = np.array([values[p].mean() for p in parts])
    fit = stats.linregress(x, y)
    half = float(stats.t.ppf(0.975, len(x) - 2) * fit.stderr) if np.ptp(y) else 0.0
    return {
        "mean": float(values.mean()),
        "per_hour": float(fit.slope),
        "low": float(fit.slope - half),
        "high": float(fit.slope + half),
    }


def summary(rows: np.ndarray) -> dict[str, dict[str, float]]:
    """Slopes of what was sampled (rows [n, len(COLUMNS)]), the warm-up left out. Raises UserError for too short a
    run."""
    columns = per_iteration(rows)
    kept = columns["hours"] >= WARM_UP * columns["hours"][-1]
    if kept.sum() < 2 * BLOCKS:
        raise UserError(
            f"minutes: only {int(kept.sum())} iterations after the warm-up, {2 * BLOCKS} are needed; run it longer"
        )
    return {name: slope(columns["hours"][kept], values[kept]) for name, values in columns.items() if name != "hours"}


def per_iteration(rows: np.ndarray) -> dict[str, np.ndarray]:
    """Columns by name from the second sample on; times as milliseconds of one iteration."""
    table = dict(zip(COLUMNS, rows.T, strict=True))
    cpu, update, wall = (1e3 * np.diff(table[name]) for name in ("cpu_s", "update_cpu_s", "wall_s"))
    return {
        "hours": table["wall_s"][1:] / 3600,
        "cpu_ms": cpu,
        "update_ms": update,
        "collect_ms": cpu - update,
        "wall_ms": wall,
    } | {name: table[name][1:] for name in ("rss_mib", "heap_mib", "files", "threads", "touching")}


def draw(rows: np.ndarray, found: dict[str, dict[str, float]], path: Path) -> Path:
    """Six panels over minutes: light, each iteration; dark, block means; the line, from where the slope is taken."""
    from matplotlib.figure import Figure

    from dexsim.view.plots import BLUE, LIGHT

    columns = per_iteration(rows)
    minutes = 60 * columns["hours"]
    figure = Figure(figsize=(12, 6), layout="constrained")
    for axes, (name, title) in zip(figure.subplots(2, 3).flat, PANELS, strict=True):
        values = columns[name]
        axes.plot(minutes, values, color=LIGHT, linewidth=0.5)
        parts = np.array_split(np.arange(len(minutes)), min(2 * BLOCKS, len(minutes)))
        axes.plot([minutes[p].mean() for p in parts], [values[p].mean() for p in parts], color=BLUE, linewidth=1.5)
        f = found[name]
        axes.set_title(f"{title}\n{f['per_hour']:+.3g} an hour (95 %: {f['low']:+.3g} to {f['high']:+.3g})", fontsize=9)
        axes.axvspan(0, WARM_UP * minutes[-1], color="0.93")
        top = np.quantile(values, 0.995)
        axes.set_ylim(0, 1.25 * max(top, 1e-9))
        axes.set_xlabel("minutes", fontsize=8)
        axes.grid(alpha=0.25)
    figure.savefig(path, dpi=110)
    return path


def main(argv: list[str]) -> int:
    """Train for `minutes`, sample, judge, draw."""
    own = {k: [a.split("=", 1)[1] for a in argv if a.startswith(f"{k}=")] for k in ("minutes", "out")}
    minutes = float(own["minutes"][-1]) if own["minutes"] else 60.0
    out = folder.make(Path(own["out"][-1] if own["out"] else "out/soak"), "out=")
    rest = [a for a in argv if a.split("=", 1)[0] not in own]
    defaults = ["task=grasp", "device=cpu", "worlds=32", "sim.threads=1", "save_interval=100"]
    run = out / "run"
    shutil.rmtree(run, ignore_errors=True)
    start = start_up.for_train([*defaults, *rest, "iterations=1000000000", f"out={run}"], CONFIGS)
    cfg = start.cfg
    where = folder.for_run(cfg)
    env = build.build_env(cfg, None, {"run": where})
    env.dump_folder = where
    runner = TimedRunner(env, cfg, machine.versions())
    log = training.Log(runner, where, start)
    rows: list[tuple[float, ...]] = []
    began = time.perf_counter()
    with Stop() as stop, open(out / "soak.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        stop.gently = True

        def each(row: dict[str, float]) -> None:
            with contextlib.redirect_stdout(io.StringIO()):  # its time left is that of endless iterations
                log.iteration(row)
            for old in where.glob("model_*.pt"):  # only their writing matters here
                old.unlink()
            rows.append(sample(runner, began))
            writer.writerow([f"{v:.6g}" if isinstance(v, float) else v for v in rows[-1]])
            file.flush()
            if runner.iteration % 200 == 0:
                print(
                    f"  {rows[-1][1] / 60:.1f} of {minutes:g} minutes, iteration {runner.iteration}, "
                    f"{rows[-1][5]:.1f} MiB,"
                    f" {rows[-1][6]} files",
                    flush=True,
                )

        runner.learn(cfg["iterations"], each, lambda: stop.asked() or time.perf_counter() - began > 60 * minutes)
    log.finish()
    return report(
        np.array(rows),
        out,
        {"worlds": cfg["worlds"], "engine": env.engine.kind, "minutes": minutes, "versions": machine.versions()},
    )


def report(rows: np.ndarray, out: Path, about: dict) -> int:
    """Print and keep the slopes; draw."""
    found = summary(rows)
    result = {"benchmark": "soak", **about, "iterations": int(rows[-1, 0]), "slopes": found}
    (out / "soak.json").write_text(json.dumps(result, indent=1))
    for name, f in found.items():
        print(
            f"  {name:8s} mean {f['mean']:.5g}   {f['per_hour']:+.3g} an hour (95 %: {f['low']:+.3g} to "
            f"{f['high']:+.3g})"
        )
    print(f"  figure   {draw(rows, found, out / 'soak.png')}")
    print(json.dumps(result))
    return 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:], __doc__))
