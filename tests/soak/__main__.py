"""`python -m tests.soak [training=48h] [deploy=24h] [envs=1000] [diagnoses=200] [worlds=256] [device=cpu]
[processes=deploy:1,envs:1] [minutes=M] [out=FOLDER]`: long runs in little time, each in a process of its own; do memory
and handles stay flat?

training: `train.py` for so many hours of simulated time (that of all `worlds` together); deploy: hours of the loop on a
clock that waits for nobody; envs: environments made, stepped and closed; diagnoses: in one process, with their reports.
Hours and environments are shared out among so many processes. 0 leaves a part out. minutes: what still runs then is
ended, and judged as far as it came. Every half second memory, open files and threads of each process are noted (and the
first GPU's memory, for a training there). Ends with status 1 where something grew or failed. Writes soak.json,
NAME.csv and NAME.log.
"""

from __future__ import annotations

import csv
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

from .watch import COLUMNS, Watch, grows, judge

ROOT = Path(__file__).parents[2]
SETTINGS = {"training": "48h", "deploy": "24h", "envs": "1000", "diagnoses": "200", "worlds": "256", "device": "cpu",
            "processes": "deploy:1,envs:1", "minutes": "0", "out": "out/soak"}  # fmt: skip
PERIOD, STEPS = 0.021, 24
"""s between actions, and actions of a world between two updates, as `train.py` has them."""


def commands(s: dict[str, str], out: Path) -> dict[str, list[str]]:
    """Command lines by name."""
    found = {}
    hours = float(s["training"].rstrip("h"))
    if hours:
        iterations = math.ceil(3600 * hours / (PERIOD * STEPS * int(s["worlds"])))
        found["training"] = ["train.py", "task=grasp", f"device={s['device']}", f"worlds={s['worlds']}",
                             f"iterations={iterations}", "final_episodes=0", f"out={out / 'run'}"]  # fmt: skip
    shares = dict(part.split(":") for part in s["processes"].split(","))
    for part in ("deploy", "envs", "diagnoses"):
        amount, n = float(s[part].rstrip("h")), int(shares.get(part, 1))
        for k in range(n if amount else 0):
            name = f"{part}{k}" if n > 1 else part
            found[name] = ["-m", "tests.soak.parts", part, repr(amount / n), str(out / name)]
    return found


def begun(out: Path, name: str) -> Path:
    """What is there once a part has done its first turn."""
    return out / "run" / "progress.csv" if name == "training" else out / name / "ready"


def main(argv: list[str]) -> int:
    given = dict(a.split("=", 1) for a in argv if "=" in a)
    if set(given) - set(SETTINGS) or any("=" not in a for a in argv):
        print(__doc__)
        return 2
    s = SETTINGS | given
    out = Path(s["out"])
    out.mkdir(parents=True, exist_ok=True)
    for old in ("run", *(p.parent.name for p in out.glob("*/ready"))):
        shutil.rmtree(out / old, ignore_errors=True)
    env = os.environ | {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "1")}
    running: dict[str, tuple[subprocess.Popen, Watch]] = {}
    for name, args in commands(s, out).items():
        log = open(out / f"{name}.log", "w")
        child = subprocess.Popen([sys.executable, *args], cwd=ROOT, env=env, stdout=log, stderr=subprocess.STDOUT)
        log.close()
        running[name] = child, Watch(child, name == "training" and s["device"] != "cpu", ready=begun(out, name))
    end = time.monotonic() + (60 * float(s["minutes"]) or math.inf)
    cut = set()
    while any(child.poll() is None for child, _ in running.values()):
        time.sleep(0.2)
        if time.monotonic() > end:
            cut = {name for name, (child, _) in running.items() if child.poll() is None}
            for name in cut:
                running[name][0].send_signal(signal.SIGINT)
            end = math.inf
    result, bad = {}, []
    for name, (child, watch) in running.items():
        watch.join()
        with open(out / f"{name}.csv", "w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(COLUMNS)
            writer.writerows([f"{x:.6g}" for x in row] for row in watch.rows)
        found = judge(watch.rows)
        worse = grows(found)
        said = (out / f"{name}.log").read_text(errors="replace").strip().splitlines() or [""]
        failed = child.returncode != 0 and name not in cut
        bad += [name] * bool(worse or failed)
        result[name] = {
            "status": child.returncode,
            "ended early": name in cut,
            "said": said[-1],
            "grows": worse,
            **found,
        }
        what = (
            "FAILED"
            if failed
            else f"GROWS ({', '.join(worse)})"
            if worse
            else "flat"
            if found
            else "too short to judge"
        )
        print(f"{name:10s} {what}{', ended early' * (name in cut)}; {said[-1]}")
        for column, f in found.items():
            unit = " MiB" if column.endswith("_mib") else ""
            interval = f"(95 %: {f['low']:+.3g} to {f['high']:+.3g})"
            print(f"  {column:9s} mean {f['mean']:.6g}, most {f['most']:.6g}, grew {f['growth']:+.3g}{unit} {interval}")
    (out / "soak.json").write_text(json.dumps({"settings": s, "parts": result}, indent=1))
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
