"""`python -m tests.soak [training=48h] [deploy=24h] [envs=1000] [diagnoses=200] [plays=30] [worlds=256] [device=cpu]
[processes=deploy:1,envs:1] [minutes=M] [out=FOLDER]`: long runs in little time, each in a process of its own; do memory
and handles stay flat?

training: `train.py` for so many hours of simulated time (that of all `worlds` together); deploy: hours of the loop on a
clock that waits for nobody; envs: environments made, stepped and closed; diagnoses: in one process, with their reports;
plays: of the included policy, with plots and a recording each. Hours and environments are shared out among so many
processes. 0 leaves a part out. minutes: what still runs then is ended, and judged as far as it came; the same where
this program is ended (Ctrl-C, SIGTERM, SIGHUP).

Every half second memory, open files and threads of each process (and the first GPU's memory, for a training there), how
much of its work is done, and what a part's process kept of memory when it last was between two pieces of it (two
environments, diagnoses, plays), are written to NAME.csv as they come; every ten seconds soak.json is written anew with
growth, and slopes per hour of wall time and per unit of work, of each part until then. NAME.log: what a part said.

The first quarter of the time is left out: caches, and pools that fill. What grows over the rest by more than 16 MiB and
3 %, or by two files or threads, beyond what chance may do (95 %), grows: of 1,000 environments a leak of 21 kB each, of
200 diagnoses one of 0.1 MiB each. Ends with status 1 where something grew or failed.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from .watch import Watch, grows, judge

ROOT = Path(__file__).parents[2]
SETTINGS = {"training": "48h", "deploy": "24h", "envs": "1000", "diagnoses": "200", "plays": "30", "worlds": "256",
            "device": "cpu", "processes": "deploy:1,envs:1", "minutes": "0", "out": "out/soak"}  # fmt: skip
PERIOD, STEPS = 0.021, 24
"""s between actions, and actions of a world between two updates, as `train.py` has them."""
UNITS = {"training": "h", "deploy": "h", "envs": "environments", "diagnoses": "diagnoses", "plays": "plays"}
EVERY, PATIENCE = 10.0, 30.0
"""s between two states of soak.json, and that a part that was asked to end is waited for."""


def hours_of(worlds: int, iterations: int) -> float:
    """Return the simulated hours of a training, all its worlds together."""
    return PERIOD * STEPS * worlds * iterations / 3600


def commands(s: dict[str, str], out: Path) -> dict[str, list[str]]:
    """Command lines by name."""
    found = {}
    hours = float(s["training"].rstrip("h"))
    if hours:
        iterations = math.ceil(3600 * hours / (PERIOD * STEPS * int(s["worlds"])))
        found["training"] = ["train.py", "task=grasp", f"device={s['device']}", f"worlds={s['worlds']}",
                             f"iterations={iterations}", "final_episodes=0", f"out={out / 'run'}"]  # fmt: skip
    shares = dict(part.split(":") for part in s["processes"].split(","))
    for part in ("deploy", "envs", "diagnoses", "plays"):
        amount, n = float(s[part].rstrip("h")), int(shares.get(part, 1))
        for k in range(n if amount else 0):
            name = f"{part}{k}" if n > 1 else part
            found[name] = ["-m", "tests.soak.parts", part, repr(amount / n), str(out / name)]
    return found


def amounts(s: dict[str, str], name: str) -> tuple[float, str]:
    """Return (what a part of this name has to do, its unit)."""
    part, shares = name.rstrip("0123456789"), dict(x.split(":") for x in s["processes"].split(","))
    n = int(shares.get(part, 1)) if part != "training" else 1
    return float(s[part].rstrip("h")) / n, UNITS[part]


def done(s: dict[str, str], out: Path, name: str) -> tuple[float, float] | None:
    """Return (how much of its work a part has done, in its unit, MiB that it keeps between two pieces of it, NaN
    where it has none); None before its first turn."""
    try:
        if name != "training":
            worked, saved, *_ = [*map(float, (out / name / "done").read_text().split()), math.nan]
            return worked, saved
        with open(out / "run" / "progress.csv", "rb") as file:
            header = file.readline().decode().strip().split(",")
            file.seek(max(file.tell(), os.fstat(file.fileno()).st_size - 4096))
            whole = [x for x in file.read().decode().splitlines() if x.count(",") == len(header) - 1]
        iterations = int(whole[-1].split(",")[header.index("iteration")]) if whole else 0
        return (hours_of(int(s["worlds"]), iterations), math.nan) if iterations else None
    except (OSError, ValueError):
        return None


def state(s: dict[str, str], out: Path, name: str, child: subprocess.Popen, watch: Watch, cut: bool) -> dict[str, Any]:
    """Return a part as it is now."""
    amount, unit = amounts(s, name)
    found = judge(watch.rows)
    said = (out / f"{name}.log").read_text(errors="replace").strip().splitlines() or [""]
    seconds = watch.rows[-1][0] if watch.rows else 0.0
    worked, _ = done(s, out, name) or (0.0, math.nan)
    return {"status": child.poll(), "ended early": cut, "done": worked, "of": amount, "unit": unit, "seconds": seconds,
            "said": said[-1], "grows": grows(found), **found}  # fmt: skip


class Stopped(BaseException):
    """A signal that ends the program, by its number."""


@contextlib.contextmanager
def stopping() -> Iterator[None]:
    """Let Ctrl-C, SIGTERM and SIGHUP raise Stopped, once; those that the caller of this program ignores (nohup) do
    not."""
    theirs = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    caught = [n for n, handler in theirs.items() if handler != signal.SIG_IGN]

    def stopped(number: int, _) -> None:
        for n in caught:
            signal.signal(n, signal.SIG_IGN)  # what has begun to end ends
        raise Stopped(number)

    for n in caught:
        signal.signal(n, stopped)
    try:
        yield
    finally:
        for n in caught:
            if signal.getsignal(n) is stopped:
                signal.signal(n, theirs[n])


def stop(children: list[subprocess.Popen]) -> None:
    """Asks processes to end, each the leader of a session of its own, and ends what is left of them and of theirs."""
    for child in children:
        child.send_signal(signal.SIGTERM)  # not Ctrl-C, which what a script starts in the background ignores
    until = time.monotonic() + PATIENCE
    while time.monotonic() < until and any(child.poll() is None for child in children):
        time.sleep(0.1)
    for child in children:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)
        child.wait()


def main(argv: list[str]) -> int:
    given = dict(a.split("=", 1) for a in argv if "=" in a)
    if set(given) - set(SETTINGS) or any("=" not in a for a in argv):
        print(__doc__)
        return 2
    s = SETTINGS | given
    out = Path(s["out"])
    out.mkdir(parents=True, exist_ok=True)
    for old in ("run", *(p.parent.name for p in out.glob("*/done"))):
        shutil.rmtree(out / old, ignore_errors=True)
    env = os.environ | {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "1")}
    running: dict[str, tuple[subprocess.Popen, Watch]] = {}
    end, cut, stopped = time.monotonic() + (60 * float(s["minutes"]) or math.inf), set(), 0

    def write() -> dict[str, dict[str, Any]]:
        parts = {name: state(s, out, name, child, watch, name in cut) for name, (child, watch) in running.items()}
        text = json.dumps({"settings": s, "parts": parts}, indent=1)
        part = out / "soak.json.tmp"
        part.write_text(text)
        part.replace(out / "soak.json")
        return parts

    try:
        with stopping():
            for name, args in commands(s, out).items():
                log = open(out / f"{name}.log", "w")
                child = subprocess.Popen([sys.executable, *args], cwd=ROOT, env=env, stdout=log,
                                         stderr=subprocess.STDOUT, start_new_session=True)  # fmt: skip
                log.close()
                running[name] = child, Watch(child, name == "training" and s["device"] != "cpu",
                                             done=partial(done, s, out, name), path=out / f"{name}.csv")  # fmt: skip
            written = time.monotonic()
            while time.monotonic() < end and any(child.poll() is None for child, _ in running.values()):
                time.sleep(0.2)
                if time.monotonic() > written + EVERY:
                    write()
                    written = time.monotonic()
    except Stopped as signalled:
        stopped = int(str(signalled))
    finally:
        cut |= {name for name, (child, _) in running.items() if child.poll() is None}
        stop([running[name][0] for name in cut])
    for _, watch in running.values():
        watch.join()
    bad = []
    for name, part in write().items():
        failed = part["status"] != 0 and name not in cut
        found = {k: v for k, v in part.items() if isinstance(v, dict)}
        worse = f"GROWS ({', '.join(part['grows'])})" if part["grows"] else "flat" if found else "too short to judge"
        bad += [name] * bool(part["grows"] or failed)
        came = f"{part['done']:.4g} of {part['of']:.4g} {part['unit']} in {part['seconds']:.0f} s"
        print(f"{name:10s} {'FAILED' if failed else worse}; {came}{', ended early' * (name in cut)}; {part['said']}")
        for column, f in found.items():
            unit = " MiB" if column.endswith("_mib") else ""
            slope = f"{f['per_hour']:+.3g} an hour (95 %: {f['per_hour_low']:+.3g} to {f['per_hour_high']:+.3g})"
            grew = f"grew {f['growth']:+.3g}{unit} (95 %: {f['low']:+.3g} to {f['high']:+.3g}), {slope}"
            each = f", {f['per_unit']:+.3g} each of its {part['unit']}" if "per_unit" in f else ""
            print(f"  {column:9s} mean {f['mean']:.6g}, most {f['most']:.6g}, {grew}{each}")
    return 128 + stopped if stopped else int(bool(bad))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
