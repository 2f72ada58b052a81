"""Concealed benchmark: generate cases, publish the hashes of their truth, diagnose, score.

    python -m benchmarks.concealed [mix=effect:14,none:4,...] [seed=1] [laws=two] [out=out/concealed] [jobs=1]
    [limit=900] [budget=0] [until=0] [first=0] [hand=xhand] [mirror=false] [braking=unsaid]
    python -m benchmarks.concealed ci=true                    # six cases of one to three joints

mix: number of cases by group (see `generate.plan`); seed: a number, or `source`: read off the sources of dexsim, so
that no change of the tool can have been made with its cases in view; hand, mirror: whose cases those of the groups hand
and large are (a folder, or a hand that comes with dexsim; its mirror image); laws: `two` draws which law an effect
follows where it has two (`laws.py`), `one` takes the first; limit: seconds a diagnosis may take, handed to it as
`limit=` (half as much again ends it); budget: seconds after which no further diagnosis is begun, until: after which
those under way are stopped and left out too (0: none); first: only so many cases of the drawn order, by which a part of
a set is a fair sample of it (0: all); braking: `said` states in each rig's servo.yaml how its drives brake
(`braking_slope: 1`), which a tool that knew no other law took for granted; `unsaid` leaves it open. Resumable: what is
finished is not run again. Writes hashes.txt before any diagnosis, results.json and table.txt to out=/seed_N (seed_N_one
with laws=one, seed_N_NAME of another hand, seed_N_said with braking=said); prints the table and one JSON line.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import yaml

from benchmarks import answers
from benchmarks.concealed import generate, laws, score
from dexsim.console.ending import guard
from dexsim.console.jobs import Engine
from dexsim.errors import UserError
from dexsim.hand import load_hand

SETTINGS = {"mix": "", "seed": "1", "laws": "two", "out": "out/concealed", "jobs": 1, "limit": 900,
            "budget": 0, "until": 0, "first": 0, "ci": False, "one_joint": False,
            "hand": "xhand", "mirror": False, "braking": "unsaid"}
CI = {"effect": 2, "none": 1, "pair": 1, "outside": 1, "decoy": 1}


def parse(argv: list[str]) -> tuple[dict, Engine]:
    """Return settings and engine; raises UserError for a setting that does not exist or has a value that is not
    allowed."""
    given, engine = answers.settings(argv, SETTINGS, laws=laws.LAWS, braking=("said", "unsaid"))
    pairs = [part.partition(":")[::2] for part in given["mix"].split(",") if part]
    if not all(group in generate.MIX and number.isdigit() for group, number in pairs):
        raise UserError(f"mix={given['mix']}: must read like effect:14,none:4, groups of {', '.join(generate.MIX)}")
    given["mix"] = {group: int(number) for group, number in pairs} or dict(generate.MIX)
    if given["ci"]:
        given["mix"] = dict(CI)
    return given, engine


def diagnose(job: tuple[str, dict, Path, float]) -> None:
    """Run `diagnose.py` on a case as a user would, unless the budget is spent. job: the case's name, settings, folder,
    begin of the run [s since the epoch]."""
    name, s, root, begun = job
    case, out = root / "cases" / name, root / "diagnoses" / name
    if s["budget"] and time.time() - begun > s["budget"]:
        return
    room = max(s["until"] - (time.time() - begun), 1.0) if s["until"] else 1e9
    out.mkdir(parents=True, exist_ok=True)
    servo = _with_braking(case, out) if s["braking"] == "said" else None
    status, spent, _ = answers.ask(generate.words(case, servo), out, s["limit"], room)
    if status is None:  # the run ends, not its time: left out
        return
    if status != 0 or not (out / "diagnosis.json").is_file():
        # counted, not dropped: no answer is a wrong one
        failed = {"verdict": "failed", "findings": [], "held_out": None, "status": status}
        (out / "diagnosis.json").write_text(json.dumps(failed), encoding="utf-8")
    (out / "seconds").write_text(f"{spent:.1f}", encoding="utf-8")


def _with_braking(case: Path, out: Path) -> Path:
    """Return a case's servo.yaml that says how its drives brake, beside its answer; the case's own where there is
    none."""
    path = case / "servo.yaml"
    if not path.is_file():
        return path
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    if content["drive"] == "torque":
        for columns in content["joints"].values():
            columns["braking_slope"] = 1.0
    (out / "servo_said.yaml").write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return out / "servo_said.yaml"


def main(argv: list[str]) -> dict:
    """Runs the benchmark; returns what the JSON line says."""
    s, engine = parse(argv)
    begun = time.time()
    whose = None if s["hand"] == "xhand" and not s["mirror"] else load_hand(s["hand"], s["mirror"])
    name = f"seed_{s['seed']}{'_one' if s['laws'] == 'one' else ''}{'_' + whose.robot if whose else ''}"
    name += "_said" if s["braking"] == "said" else ""
    root = Path(s["out"]).expanduser().resolve() / name
    plan = generate.plan(s["mix"], s["seed"], s["one_joint"])
    plan = plan[: s["first"] or len(plan)]
    for entry in plan:
        if whose is not None and entry["shape"] == "hand":
            entry["hand"] = whose.identity
    jobs = [(entry, n, s["seed"], root, s["laws"]) for n, entry in enumerate(plan)]
    # the hand's first: they take longest, and the run's end would cut them off. Else in the order of the plan, which is
    # drawn: where the budget ends the run, what was done is a fair sample of each
    jobs.sort(key=lambda job: -len(job[0]["kinds"]) - 1 if job[0]["shape"] == "hand" else 0)
    new = {str(job[1]): job for job in jobs if not generate.stub(root, job[1]).is_file()}
    list(answers.at_once(generate.once, new, root / "making", engine))
    made = [generate.once(job) for job in jobs]
    (root / "hashes.txt").write_text("".join(f"{m['digest']}  {m['name']}\n" for m in sorted(made,
                                                                                             key=lambda m: m["name"])),
                                                                                             encoding="utf-8")
    print(f"{len(made)} cases; SHA-256 of each truth with its salt, before any diagnosis: {root / 'hashes.txt'}",
          flush=True)
    names = [m["name"] for m in made if not (root / "diagnoses" / m["name"] / "seconds").is_file()]
    list(answers.at_once(diagnose, {name: (name, s, root, begun) for name in names}, root, engine))
    results, seconds = [], []
    for m in made:
        folder = root / "diagnoses" / m["name"]
        if not (folder / "seconds").is_file():
            continue
        truth = generate.reveal(root / "truth" / f"{m['name']}.json", m["digest"])
        results.append(score.one(truth, json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))))
        seconds.append(float((folder / "seconds").read_text()))
    lines = score.table(results)
    (root / "results.json").write_text(
        json.dumps({"seed": s["seed"], "results": results, "lines": lines}), encoding="utf-8"
    )
    text = score.show(lines, results)
    (root / "table.txt").write_text(text + "\n", encoding="utf-8")
    print("\n" + text)
    line = {"benchmark": "concealed", "seed": s["seed"], "cases": len(made), "left_out": len(made) - len(results),
            "failed": sum(r["verdict"] == "failed" for r in results),
            "seconds_median": sorted(seconds)[len(seconds) // 2] if seconds else None,
            "wall_s": round(time.time() - begun), "lines": lines}  # fmt: skip
    print(json.dumps(line))
    return line


if __name__ == "__main__":
    sys.exit(guard(lambda argv: 0 if main(argv) else 1, sys.argv[1:], __doc__))
