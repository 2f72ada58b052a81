"""Concealed benchmark: generate cases, publish the hashes of their truth, diagnose, score.

    python -m benchmarks.concealed [mix=effect:14,none:4,...] [seed=1] [out=out/concealed] [jobs=1] [limit=900]

mix: number of cases by group (see `generate.plan`); limit: seconds a diagnosis may take. Resumable: a case that is
finished is not run again. Prints a table and one JSON line. Rigs have one joint: lines of the judging table that need
several joints, touch or several effects at once are not scored, nor is the overlap of regimes.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

from benchmarks.concealed import generate, score

ROOT = Path(__file__).parents[2]
SETTINGS = {"mix": dict(generate.MIX), "seed": 1, "out": "out/concealed", "jobs": 1, "limit": 900}


def parse(argv: list[str]) -> dict:
    """key=value settings; exits with status 2 for one that does not exist or is no number."""
    given = dict(SETTINGS)
    for argument in argv:
        key, equals, text = argument.partition("=")
        if not equals or key not in SETTINGS:
            raise SystemExit(f"'{argument}' is not a setting; valid: {', '.join(SETTINGS)} (key=value)")
        if key == "mix":
            pairs = [part.partition(":")[::2] for part in text.split(",")]
            if not all(group in generate.MIX and number.isdigit() for group, number in pairs):
                raise SystemExit(f"mix={text}: must read like effect:14,none:4 with groups of {', '.join(generate.MIX)}")
            given[key] = {group: int(number) for group, number in pairs}
        elif key == "out":
            given[key] = text
        elif text.isdigit():
            given[key] = int(text)
        else:
            raise SystemExit(f"{key}={text}: must be a whole number")
    return given


class Progress:
    """A line now and then: done of all, seconds left."""

    def __init__(self, what: str, total: int):
        self.what, self.total, self.done, self.start, self.last = what, total, 0, time.perf_counter(), 0.0

    def __call__(self) -> None:
        """One more is done."""
        self.done += 1
        spent = time.perf_counter() - self.start
        if spent - self.last > 5 or self.done == self.total:
            self.last = spent
            print(f"  {self.what} {self.done}/{self.total}, about {spent / self.done * (self.total - self.done):.0f} s left", flush=True)


def _diagnose(name: str, s: dict, root: Path) -> float:
    """Runs `diagnose.py` on a case as a user would; returns its seconds (0: it was done before)."""
    case, out = root / "cases" / name, root / "diagnoses" / name
    if (out / "seconds").is_file():
        return 0.0
    out.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    argv = [sys.executable, str(ROOT / "diagnose.py"), f"recordings=[{case / 'a.mcap'},{case / 'b.mcap'}]", f"held_out=[{case / 'c.mcap'}]",
            f"model={case / 'rig.xml'}", f"servo={case / 'servo.yaml'}", f"out={out}", "next=false"]  # fmt: skip
    env = os.environ | {"OMP_NUM_THREADS": "1"}
    with open(out / "log.txt", "w", encoding="utf-8") as log:
        try:
            status = subprocess.run(argv, cwd=ROOT, env=env, stdout=log, stderr=subprocess.STDOUT, timeout=s["limit"]).returncode
        except subprocess.TimeoutExpired:
            status = "out of time"
    spent = time.perf_counter() - start
    if status != 0 or not (out / "diagnosis.json").is_file():
        # counted, not dropped: no answer is a wrong one
        failed = {"verdict": "failed", "findings": [], "held_out": None, "status": status}
        (out / "diagnosis.json").write_text(json.dumps(failed), encoding="utf-8")
    (out / "seconds").write_text(f"{spent:.1f}", encoding="utf-8")
    return spent


def main(argv: list[str]) -> dict:
    """Runs the benchmark; returns what the JSON line says."""
    s = parse(argv)
    root = Path(s["out"]).expanduser().resolve() / f"seed_{s['seed']}"
    jobs = [(entry, n, s["seed"], root) for n, entry in enumerate(generate.plan(s["mix"], s["seed"]))]
    made, tick = [], Progress("made", len(jobs))
    with ProcessPoolExecutor(max(s["jobs"], 1), mp_context=get_context("spawn")) as pool:
        for m in pool.map(generate.once, jobs):
            made.append(m)
            tick()
    (root / "hashes.txt").write_text("".join(f"{m['digest']}  {m['name']}\n" for m in made), encoding="utf-8")
    print(f"{len(made)} cases; SHA-256 of each truth with its salt, before any diagnosis: {root / 'hashes.txt'}", flush=True)
    tick = Progress("diagnosed", len(made))
    with ThreadPoolExecutor(max(s["jobs"], 1)) as pool:
        for done in as_completed([pool.submit(_diagnose, m["name"], s, root) for m in made]):
            done.result()
            tick()
    results = []
    for m in made:
        truth = generate.reveal(root / "truth" / f"{m['name']}.json", m["digest"])
        diagnosis = json.loads((root / "diagnoses" / m["name"] / "diagnosis.json").read_text(encoding="utf-8"))
        results.append(score.one(truth, diagnosis))
    lines = score.table(results)
    (root / "results.json").write_text(json.dumps({"results": results, "lines": lines}), encoding="utf-8")
    print("\n" + score.show(lines, results))
    seconds = [float((root / "diagnoses" / m["name"] / "seconds").read_text()) for m in made]
    line = {"benchmark": "concealed", "seed": s["seed"], "cases": len(made), "failed": sum(r["verdict"] == "failed" for r in results),
            "seconds_median": sorted(seconds)[len(seconds) // 2] if seconds else None, "lines": lines}  # fmt: skip
    print(json.dumps(line))
    return line


if __name__ == "__main__":
    main(sys.argv[1:])
