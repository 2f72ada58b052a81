"""`diagnose` on a plant that others wrote: generate its cases on a seed, diagnose each, score with its own scorer.

    python -m benchmarks.foreign [seed=source] [nulls=40] [cases=0,5,49] [jobs=1] [limit=300] [plant=../shared/foreign]
    [out=out/foreign]

seed: a number, or `source`: read off the sources of dexsim, so that no change can have been made with it in view.
nulls: cases with nothing missing beside the plant's own set, from the seeds that follow. cases: only these numbers of
the set. limit: seconds a diagnosis may take, handed to it as `limit=`; half as much again ends it. Resumable: what is
finished is not run again. Writes table.md, score.txt and results.json to out=/seed_N, prints the score and one JSON
line. Needs numba (pip install numba) and the plant; where either is absent it says so and skips.
"""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks import answers
from dexsim.console.ending import guard
from dexsim.errors import UserError

NULLS = range(49, 61)  # numbers of the plant's cases with nothing missing
SETTINGS = {
    "seed": "source", "nulls": 40, "cases": "", "jobs": 1, "limit": 300, "plant": "../shared/foreign",
    "out": "out/foreign", "threads": 1,
}  # fmt: skip


def generate(plant: Path, wanted: Sequence[tuple[int, Sequence[int]]], out: Path, jobs: int) -> None:
    """Write cases to out/cases and out/truth: of each seed all (an empty list) or these numbers."""
    with tempfile.TemporaryDirectory() as scratch:
        code = Path(scratch) / "plant"
        shutil.copytree(plant, code, ignore=shutil.ignore_patterns("cases", "truth", "results"))
        # one case alone compiles the plant: every other process, of every seed, reads that from the cache
        _generate(code, wanted[0][0], [NULLS[0]], Path(scratch) / "compiled", 1)
        for seed, only in wanted:
            folder = Path(scratch) / f"seed_{seed}"
            _generate(code, seed, only, folder, jobs)
            for part in ("cases", "truth"):
                (out / part).mkdir(parents=True, exist_ok=True)
                for item in (folder / part).iterdir():
                    if not (target := out / part / item.name).exists():
                        shutil.move(str(item), target)


def _generate(code: Path, seed: int, only: Sequence[int], out: Path, jobs: int) -> None:
    out.mkdir()
    # a plain loop over processes of its own: what it computes does not depend on how many there are
    argv = [sys.executable, "generate.py", "--seed", str(seed), "--jobs", str(jobs), "--out", str(out)]
    argv += ["--only", ",".join(map(str, only))] if only else []
    done = subprocess.run(
        argv, cwd=code, env=os.environ | {"NUMBA_CACHE_DIR": f"{code}/numba"}, capture_output=True, text=True
    )
    if done.returncode:
        last = done.stderr.strip().splitlines()[-1:]
        raise UserError(f"the plant's generator (seed {seed}) ended with {done.returncode}: {last}")


def diagnose(job: tuple[Path, Path, int, int]) -> None:
    """Diagnose one case as a user would run it: without the recordings that the scorer keeps, from files that tell
    nothing of the case. job: folders of the case and of the answer, limit [s], threads."""
    case, out, limit, threads = job
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        work = Path(scratch)
        for path in [*case.glob("train/*.mcap"), *case.glob("repeat/*.mcap"), case / "rig.xml", case / "servo.yaml"]:
            shutil.copy(path, work)
        names = sorted(p.name for p in work.glob("*.mcap"))
        words = [f"recordings=[{','.join(str(work / n) for n in names)}]", f"model={work / 'rig.xml'}",
                 f"servo={work / 'servo.yaml'}"]  # fmt: skip
        code, took, _ = answers.ask(words, work / "out", limit, threads=threads)
        shutil.copy(work / "out" / "log.txt", out)
        for name in ("diagnosis.json", "details.json"):
            if (work / "out" / name).is_file():
                shutil.copy(work / "out" / name, out)
        (out / "run.json").write_text(json.dumps({"seconds": took, "rc": code, "recordings": names}), encoding="utf-8")


def summary(truths: Sequence[dict], answers: dict[str, dict | None]) -> dict:
    """Return the rates of names by the confidence asked of them, false alarms, confident and wrong names, coverage and
    times."""
    out: dict[str, object] = {"cases": len(truths), "answered": sum(a is not None for a in answers.values())}
    for tier in ("easy", "medium"):
        singles = [t for t in truths if t["kind"] == "single" and t["tier"] == tier]
        for least in (0.0, 0.5, 0.8):
            out[f"{tier}_first_name_at_{least:g}"] = [
                sum(_first(answers[t["id"]], least) in _names(t) for t in singles),
                len(singles),
            ]
    nulls = [t for t in truths if t["kind"] == "null"]
    out["false_alarms"] = [sum(_alarm(answers[t["id"]]) for t in nulls), len(nulls)]
    sure = [
        (t, f)
        for t in truths
        for f in _physics(answers[t["id"]])
        if f["confidence"] >= 0.8 and not f["indistinguishable"]
    ]
    out["confident_and_wrong"] = [len({t["id"] for t, f in sure if f["effect"] not in _names(t)}), len(truths)]
    return out


def _names(truth: dict) -> set[str]:
    return {e["effect"] for e in truth["effects"]}


def _physics(answer: dict | None) -> list[dict]:
    return [] if answer is None else [f for f in answer["findings"] if f["where"]["joints"]]


def _first(answer: dict | None, least: float) -> str:
    found = [f for f in _physics(answer) if f["confidence"] >= least]
    return found[0]["effect"] if found else ""


def _alarm(answer: dict | None) -> bool:
    """Return where nothing is missing: a verdict that explains, a name of 0.5 and more, or no answer."""
    return (
        answer is None
        or answer["verdict"] in ("explained", "partly_explained")
        or any(f["confidence"] >= 0.5 for f in answer["findings"])
    )


def table(truths: Sequence[dict], answers: dict[str, dict | None], seconds: dict[str, float]) -> str:
    """Return one line a case: what was hidden, what was said, errors in mrad before / after / floor, seconds."""
    lines = [
        "| case | rig | tier | hidden | verdict | said | before / after / floor | s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for t in truths:
        hidden = " + ".join(f"{e['effect']}@{'/'.join(e['joints'])}" for e in t["effects"]) or "nothing"
        a = answers[t["id"]]
        if a is None:
            lines.append(
                f"| {t['index']} | {t['rig']} | {t['tier']} | {hidden} | - | no answer | | {seconds[t['id']]:.0f} |"
            )
            continue
        said = (
            ", ".join(f"{f['effect']}@{'/'.join(f['where']['joints'])} {f['confidence']:.2f}" for f in a["findings"])
            or "-"
        )
        h = a["held_out"]
        errors = " / ".join(
            "-" if x is None else f"{1e3 * x:.2f}" for x in (h["before"], h["after"], a["noise_floor"]["position_rad"])
        )
        lines.append(
            f"| {t['index']} | {t['rig']} | {t['tier']} | {hidden} | {a['verdict']} | {said} | {errors} | "
            f"{seconds[t['id']]:.0f} |"
        )
    return "\n".join(lines) + "\n"


def main(argv: Sequence[str]) -> dict | None:
    """Runs the benchmark; returns what the JSON line says, None where it is skipped."""
    s, engine = answers.settings(argv, SETTINGS)
    plant = Path(s["plant"]).expanduser().resolve()
    if not (plant / "generate.py").is_file():
        print(f"skipped: plant={plant} is not there (a plant by other hands, which is not part of dexsim)")
        return None
    if importlib.util.find_spec("numba") is None:
        print("skipped: the plant is compiled by numba, which is not installed (pip install numba)")
        return None
    seed = s["seed"]
    out = Path(s["out"]).expanduser().resolve() / f"seed_{seed}"
    only = [int(x) for x in s["cases"].strip("[]").split(",") if x]
    if not (out / "made").is_file():
        print(f"making the cases of seed {seed} ...", flush=True)
        wanted: list[tuple[int, Sequence[int]]] = [(seed, only)]
        for k in range(0, s["nulls"], len(NULLS)):
            wanted.append((seed + 1 + k // len(NULLS), list(NULLS)[: s["nulls"] - k]))
        generate(plant, wanted, out, s["jobs"])
        (out / "made").write_text("", encoding="utf-8")
    ids = sorted(p.name for p in (out / "cases").iterdir())
    np.random.default_rng(seed).shuffle(ids)  # where it is ended early, what was done is a fair sample
    todo = [i for i in ids if not (out / "diagnoses" / i / "run.json").is_file()]
    given = {i: (out / "cases" / i, out / "diagnoses" / i, s["limit"], s["threads"]) for i in todo}
    list(answers.at_once(diagnose, given, out, engine))
    return report(plant, out)


def report(plant: Path, out: Path) -> dict:
    """Scores what is in `out`, with the plant's own scorer and by confidence."""
    truths = sorted(
        (json.loads(p.read_text()) for p in (out / "truth").glob("*.json")), key=lambda t: (t["seed"], t["index"])
    )
    truths = [t for t in truths if (out / "diagnoses" / t["id"] / "run.json").is_file()]

    def read(i: str) -> dict | None:
        path = out / "diagnoses" / i / "diagnosis.json"
        return json.loads(path.read_text()) if path.is_file() else None

    answers = {t["id"]: read(t["id"]) for t in truths}
    seconds = {t["id"]: json.loads((out / "diagnoses" / t["id"] / "run.json").read_text())["seconds"] for t in truths}
    (out / "table.md").write_text(table(truths, answers, seconds), encoding="utf-8")
    argv = [sys.executable, str(plant / "score.py"), str(out / "truth"), str(out / "diagnoses"), "--cases",
            str(out / "cases"), "--json", str(out / "score.json"), "--ids", ",".join(t["id"] for t in truths)]
    score = subprocess.run(argv, capture_output=True, text=True)
    (out / "score.txt").write_text(score.stdout + score.stderr, encoding="utf-8")
    print(score.stdout)
    line = {"benchmark": "foreign", "seed": truths[0]["seed"] if truths else None, **summary(truths, answers),
            "seconds_median": float(np.median(list(seconds.values()))) if seconds else None}  # fmt: skip
    (out / "results.json").write_text(json.dumps(line, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(line))
    return line


if __name__ == "__main__":
    sys.exit(guard(lambda argv: 0 * bool(main(argv)), sys.argv[1:], __doc__))
