"""Training on 1, 2, 4 and 8 GPUs of one machine: weak scaling, and the time to the same share of held episodes.

    python -m benchmarks.multi_gpu [gpus=1,2,4,8] [learn_s=120] [until=0.97] [seconds=600] [fixed=false]
    [parallel=false] [out=FOLDER]
                                   [any setting of train.py]

Every count is one run of train.py under torchrun, with `worlds` for each GPU (8,192 unless told otherwise), for
`learn_s` seconds of learning or until the share of held episodes has reached `until`. The share is of episodes that
ended in the last ten iterations: those that lasted to the time limit. Rates are medians over iterations, the first five
left out; efficiency is the rate of a GPU over that of the smallest count. `fixed=true` adds the largest count with the
same number of worlds in all as one GPU has. `parallel=true` runs counts side by side where the GPUs suffice. On a CPU
(`device=cpu`) counts are processes: a rehearsal. Written: multi_gpu.json (after each run), multi_gpu.png, and each
run's progress.csv; the last line printed is the JSON without the curves.
"""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from dexsim.console.ending import guard
from dexsim.errors import UserError
from dexsim.paths import CONFIGS

ROOT = Path(__file__).parents[1]
DEFAULTS = {"gpus": "1,2,4,8", "learn_s": "120", "until": "0.97", "seconds": "600", "fixed": "false",
            "parallel": "false", "out": "out/multi_gpu"}
LEVELS = (0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.925, 0.95, 0.96, 0.97)
WINDOW = 10  # iterations that the share of held episodes is taken over
SKIPPED = 5  # iterations left out of the rates: kernels load, graphs are recorded


class Job:
    """One training run on some of the GPUs, in processes of its own."""

    def __init__(self, name: str, devices: list[str], settings: list[str], out: Path) -> None:
        self.name, self.count, self.folder = name, len(devices), out / name
        shutil.rmtree(self.folder, ignore_errors=True)
        command = [sys.executable, "-m", "torch.distributed.run", "--standalone",
                   f"--nproc_per_node={self.count}"] if self.count > 1 else [sys.executable]
        settings = [*settings, "iterations=1000000", "save_interval=1000000", "final_episodes=0", f"out={self.folder}"]
        env = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
        if not any(s == "device=cpu" for s in settings):
            env["CUDA_VISIBLE_DEVICES"] = ",".join(devices)
        self._log = open(out / f"{name}.log", "w")
        self.began = time.perf_counter()
        self.process = subprocess.Popen([*command, str(ROOT / "train.py"), *settings], env=env, stdout=self._log,
                                        stderr=subprocess.STDOUT)
        self.first_row_s: float | None = None
        self.stopped = False

    def rows(self) -> list[dict[str, str]]:
        """What progress.csv has so far."""
        try:
            with open(self.folder / "progress.csv", newline="") as file:
                rows = list(csv.DictReader(file))
        except OSError:
            return []
        if rows and self.first_row_s is None:
            self.first_row_s = time.perf_counter() - self.began
        return [r for r in rows if r.get("rate")]

    def watch(self, learn_s: float, until: float, end: float) -> None:
        """Ask the run to stop when it has learned long enough or reached its aim, with iterations enough for a rate, or
        when the time is up."""
        rows = self.rows()
        found = series(rows)
        done = len(rows) > SKIPPED and (found["time_s"][-1] >= learn_s or found["share"][-1] >= until)
        if (done or time.perf_counter() > end) and not self.stopped:
            self.process.send_signal(signal.SIGINT)
            self.stopped = True

    def result(self) -> dict:
        """Rates and times of a run that has ended."""
        self._log.close()
        rows = self.rows()
        found = {"name": self.name, "gpus": self.count, "iterations": len(rows), "status": self.process.returncode,
                 "start_s": self.first_row_s}
        if len(rows) <= SKIPPED:
            return found | {"error": "too few iterations: see its log"}
        times = series(rows)
        late = rows[SKIPPED:-1] if len(rows) > SKIPPED + 5 else rows[SKIPPED:]  # the last may have met the signal
        reached = {}
        for level in LEVELS:
            hit = np.flatnonzero(times["share"] >= level)
            if len(hit):
                reached[str(level)] = {"learn_s": float(times["time_s"][hit[0]]),
                                       "steps": float(times["steps"][hit[0]]), "iterations": int(hit[0]) + 1}
        keep = np.unique(np.linspace(0, len(rows) - 1, min(len(rows), 300)).astype(int))
        return found | {
            "steps_per_s": float(np.median([float(r["rate"]) for r in late])),
            "collect_s": float(np.median([float(r["collect_s"]) for r in late])),
            "learn_s": float(np.median([float(r["learn_s"]) for r in late])),
            "reached": reached, "curve": {k: [round(float(x), 4) for x in v[keep]] for k, v in times.items()},
        }


def series(rows: list[dict[str, str]]) -> dict[str, np.ndarray]:
    """By iteration: seconds of learning, steps, share of held episodes among those that ended in the last WINDOW
    iterations."""
    def column(name: str) -> np.ndarray:
        return np.array([float(r.get(name) or 0.0) for r in rows])

    kept, ended = column("end/time_out"), sum((column(k) for k in (rows[0] if rows else ()) if k.startswith("end/")),
                                              np.zeros(len(rows)))
    window = np.ones(WINDOW)
    kept, ended = (np.convolve(x, window)[: len(rows)] if len(rows) else x for x in (kept, ended))
    share = np.where((ended > 0) & (np.arange(len(rows)) >= WINDOW - 1), kept / np.maximum(ended, 1e-12), 0.0)
    # the first episodes begin at random ages (init_at_random_ep_len) and end early by the time limit: leave one length
    # out
    lengths = column("length")
    young = np.cumsum(np.ones(len(rows)) * 24) < (lengths.max() if len(rows) else 0)
    return {"time_s": np.cumsum(column("collect_s") + column("learn_s")), "steps": column("steps"),
            "share": np.where(young, 0.0, share)}


def efficiency(results: list[dict]) -> dict[str, float]:
    """Rate of a GPU over that of the smallest count that ran, by run name (weak scaling: fixed totals are left out)."""
    good = [r for r in results if "steps_per_s" in r and not r["name"].startswith("fixed")]
    if not good:
        return {}
    base = min(good, key=lambda r: r["gpus"])
    return {r["name"]: (r["steps_per_s"] / r["gpus"]) / (base["steps_per_s"] / base["gpus"]) for r in good}


def pack(counts: list[int], available: int, parallel: bool) -> list[list[int]]:
    """Counts in batches, largest first; side by side where `available` GPUs suffice."""
    batches: list[list[int]] = []
    for count in sorted(counts, reverse=True):
        fits = [b for b in batches if sum(b) + count <= available] if parallel else []
        fits[0].append(count) if fits else batches.append([count])
    return batches


def draw(results: list[dict], path: Path) -> Path:
    """Share of held episodes over seconds of learning; steps a second over GPUs beside the straight line."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    good = sorted((r for r in results if "curve" in r), key=lambda r: (r["gpus"], r["name"]))
    for r in good:
        left.plot(r["curve"]["time_s"], r["curve"]["share"], label=r["name"],
                  linestyle="--" if r["name"].startswith("fixed") else "-")
    left.set(xlabel="seconds of learning", ylabel="share of episodes held to the end", ylim=(0.5, 1))
    if good:
        left.legend(fontsize=8)
    weak = [r for r in good if not r["name"].startswith("fixed")]
    if weak:
        x = [r["gpus"] for r in weak]
        right.plot(x, [r["steps_per_s"] / 1e6 for r in weak], "o-")
        right.plot(x, [weak[0]["steps_per_s"] / weak[0]["gpus"] * n / 1e6 for n in x], "k:", linewidth=1)
    right.set(xlabel="GPUs", ylabel="million environment steps a second, PPO included", xlim=(0, None), ylim=(0, None))
    for axes in (left, right):
        axes.grid(alpha=0.25)
    figure.savefig(path, dpi=110)
    return path


def main(argv: list[str]) -> int:
    """Run the batches, collect, report."""
    from dexsim.cli import folder, machine
    from dexsim.cli import start as start_up

    own = DEFAULTS | {a.partition("=")[0]: a.partition("=")[2] for a in argv if a.partition("=")[0] in DEFAULTS}
    rest = [a for a in argv if a.partition("=")[0] not in DEFAULTS]
    cfg = start_up.for_train(rest, CONFIGS).cfg
    if not any(a.startswith("task=") for a in rest):
        rest = ["task=grasp", *rest]
    try:
        counts = [int(x) for x in own["gpus"].split(",")]
    except ValueError:
        raise UserError(f"gpus={own['gpus']}: must be whole numbers, e.g. gpus=1,2,4,8") from None
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    devices = [str(k) for k in range(max(counts))] if cfg["device"] == "cpu" else (
        visible.split(",") if visible else [str(k) for k in range(machine.cuda_devices())])
    if max(counts) > len(devices):
        raise UserError(f"gpus={own['gpus']}: this machine has {len(devices)}")
    out = folder.make(Path(own["out"]), "out=")
    end = time.perf_counter() + float(own["seconds"])
    settings = [a for a in rest if not a.startswith("device=") or a == "device=cpu"]
    batches = [[(f"{n}_gpu", n, settings) for n in batch] for batch in pack(counts, len(devices),
                                                                            own["parallel"] == "true")]
    if own["fixed"] == "true":
        most = max(counts)
        each = [*[a for a in settings if not a.startswith("worlds=")], f"worlds={max(cfg['worlds'] // most, 1)}"]
        batches.append([(f"fixed_{most}_gpu", most, each)])
    results: list[dict] = []
    about = {"benchmark": "multi_gpu", "device": machine.describe(cfg["device"]), "worlds_per_gpu": cfg["worlds"],
             "versions": machine.versions(),
             "parallel": own["parallel"] == "true"}
    for batch in batches:
        if end - time.perf_counter() < 45 and results:
            break
        free, jobs = list(devices), []
        for name, count, given in batch:
            jobs.append(Job(name, free[:count], given, out))
            free = free[count:]
        print(f"  running {', '.join(j.name for j in jobs)}", flush=True)
        while any(j.process.poll() is None for j in jobs):
            time.sleep(1.0)
            for job in jobs:
                if job.process.poll() is None:
                    job.watch(float(own["learn_s"]), float(own["until"]), end - 20)
                    if time.perf_counter() > end:
                        job.process.kill()
        for job in jobs:
            results.append(job.result())
            shutil.copy(job.folder / "progress.csv",
                        out / f"{job.name}.csv") if (job.folder / "progress.csv").exists() else None
        (out / "multi_gpu.json").write_text(json.dumps(about | {"efficiency": efficiency(results), "runs": results},
                                                       indent=1))
    ratio = efficiency(results)
    for r in sorted(results, key=lambda r: r["gpus"]):
        if "error" in r:
            print(f"  {r['name']:12s} {r['error']} (status {r['status']})")
            continue
        levels = "  ".join(f"{k}: {v['learn_s']:.0f} s" for k, v in r["reached"].items() if float(k) >= 0.8)
        print(f"  {r['name']:12s} {r['steps_per_s']:>10,.0f} steps/s  efficiency"
              f" {ratio.get(r['name'], float('nan')):.3f}  collect {r['collect_s']:.3f} s"
              f"  learn {r['learn_s']:.3f} s  ready {r['start_s']:.0f} s  held {levels}")
    print(f"  figure   {draw(results, out / 'multi_gpu.png')}\n  data     {out / 'multi_gpu.json'}")
    print(json.dumps(about | {"efficiency": ratio,
                              "runs": [{k: v for k, v in r.items() if k != "curve"} for r in results]}), flush=True)
    return 0 if all("error" not in r for r in results) else 1


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:], __doc__))
