"""What a task reaches in some minutes: trained for so many seconds, judged, and beside it the included policy.

    python -m benchmarks.minutes [task=rotate] [seconds=205] [against=checkpoints/rotate.pt] [episodes=512] [judged=77]
                                 [judge=task.evaluation.cap_s=30,...] [out=out/minutes] [any setting of train.py]

`dexsim train` runs in a process of its own and is stopped, as by Ctrl-C, `seconds` after that process began: Python's
start, the compiling of kernels and the saving count. Then `dexsim play` judges what it saved; the clock stops there
(`trained and judged`). Only then the included policy is judged, by the same command: the same episodes from the same
seed (`judged`), under the settings of `judge` (with commas between them). Prints the steps learned, steps a second, and
the metrics of both with their intervals where they have one. `seed=` is the training's, as for train.py.
"""

from __future__ import annotations

import csv
import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks import tools
from dexsim.errors import UserError

SHOWN = {
    "rotate": ("consecutive_successes", "seconds_per_success", "seconds_to_fall", "capped"),
    "grasp": ("hold_rate", "hold_rate_pushed", "hold_rate_kept_out_shapes", "force_command_correlation",
              *(f"force_command_correlation_{f}" for f in ("index", "mid", "ring", "pinky")), "force_error_N"),
}  # fmt: skip


def train(settings: list[str], seconds: float, run: Path) -> dict[str, float]:
    """Train for `seconds` of wall time; {"steps", "steps_per_second", "seconds"} of it."""
    command = [sys.executable, str(tools.ROOT / "train.py"), *settings, "final_episodes=0", f"out={run}"]
    begin = time.perf_counter()
    with open(run.with_suffix(".log"), "w") as log:
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, cwd=tools.ROOT)
        try:
            process.wait(seconds)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
            process.wait(120)
        except BaseException:
            process.terminate()
            raise
    if not (run / "policy.pt").exists():
        raise UserError(f"nothing was saved in {seconds:g} s: {run.with_suffix('.log')} says why; give seconds= more")
    with open(run / "progress.csv", newline="") as f:
        last = list(csv.DictReader(f))[-1]
    return {
        "steps": float(last["steps"]),
        "steps_per_second": float(last["rate"]),
        "seconds": time.perf_counter() - begin,
    }


def judge(policy: Path, settings: list[str], out: Path) -> dict[str, Any]:
    """The metrics that `dexsim play` gives the policy."""
    command = [
        sys.executable,
        str(tools.ROOT / "play.py"),
        f"checkpoint={policy}",
        *settings,
        "video=false",
        f"out={out}",
    ]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tools.ROOT)
    if done.returncode:
        raise UserError(f"play.py ended with status {done.returncode}: {(done.stderr or done.stdout)[-800:].strip()}")
    return json.loads((out / "metrics.json").read_text())


def shown(name: str, metrics: dict[str, Any]) -> str:
    """A metric with its 95 % interval, if it has one."""
    value, interval = metrics.get(name), metrics.get(f"{name}_interval")
    if isinstance(value, dict):
        value, interval = value["average"], value["average_interval"]
    if value is None:
        return "none"
    if interval is None or None in interval:  # of few trials
        return f"{value:.4g}"
    return f"{value:.4g} ({interval[0]:.4g} to {interval[1]:.4g})"


def main(argv: list[str]) -> dict[str, Any]:
    own, rest = tools.split(
        argv,
        {
            "task": "rotate",
            "seconds": "205",
            "against": "",
            "episodes": "512",
            "judged": "77",
            "judge": "",
            "out": "out/minutes",
        },
    )
    task = own["task"]
    if task not in SHOWN:
        raise UserError(f"task={task}: must be {' or '.join(SHOWN)}")
    cfg = tools.config([f"task={task}", *rest])
    seconds, episodes, seed = (tools.numbers(own[k], k)[0] for k in ("seconds", "episodes", "judged"))
    against = Path(own["against"] or tools.ROOT / "checkpoints" / f"{task}.pt").resolve()
    out = Path(own["out"]).resolve()
    out.mkdir(parents=True, exist_ok=True)
    run = out / "run"
    if run.exists():
        shutil.rmtree(run)
    how = [f"episodes={episodes}", f"seed={seed}", f"device={cfg['device']}", *filter(None, own["judge"].split(","))]

    begin = time.perf_counter()
    found: dict[str, Any] = {"benchmark": "minutes", **tools.about(cfg["device"]), "task": task, "settings": rest,
                             "training": train([f"task={task}", *rest], seconds, run)}  # fmt: skip
    new = judge(run / "policy.pt", how, out / "new")
    found["trained_and_judged_s"] = time.perf_counter() - begin
    t = found["training"]
    print(
        f"task={task}: {t['steps'] / 1e6:.1f} M steps in {t['seconds']:.0f} s ({t['steps_per_second']:,.0f} a second at"
        f" last), trained and judged in {found['trained_and_judged_s']:.0f} s",
        flush=True,
    )
    included = judge(against, how, out / "included")
    print(f"{episodes} episodes, seed {seed}: {'':23s}{'new':28s}{against.name}")
    for name in SHOWN[task]:
        print(f"  {name:40s}{shown(name, new):28s}{shown(name, included)}")
        found[name] = {"new": new.get(name), "included": included.get(name)}
        found[name] |= {
            f"{who}_interval": m.get(f"{name}_interval") for who, m in (("new", new), ("included", included))
        }
    for value in found.values():  # no need for every trial
        for side in value.values() if isinstance(value, dict) else ():
            if isinstance(side, dict):
                side.pop("all", None)
    (out / "minutes.json").write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found), flush=True)
    return found


if __name__ == "__main__":
    tools.command(main, __doc__)
