"""The answers of two versions of `diagnose` to the same cases, side by side.

    python -m benchmarks.same_names before=CHECKOUT [after=.] [concealed=32] [planted=30] [foreign=FOLDER] [seed=source]
                                    [jobs=1] [limit=300] [until=0] [out=out/same_names]

before, after: folders of the code of each version (`git worktree add FOLDER COMMIT`); each diagnoses every case by its
own `diagnose.py`, with one thread. concealed, planted: number of cases of our own plant (`benchmarks.concealed`) and of
our simulator (`benchmarks.planted`), made here; foreign: a folder that the other plant's `generate.py` wrote (empty:
none). seed: of the cases, a number or `source` (read off the sources). limit: seconds that a diagnosis may take; until:
seconds after which nothing more is begun or waited for (0: no limit). Each pair is written to out=/seed_N/pairs.jsonl
as it comes; what stands there is not run again. Prints a table by set and every case with another answer.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import chain, zip_longest
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from tqdm import tqdm

from benchmarks.concealed import score
from benchmarks.foreign import seed_of_sources
from benchmarks.options import options
from dexsim.console.ending import guard
from dexsim.console.tables import table
from dexsim.errors import UserError

SETTINGS = {"before": "", "after": ".", "concealed": 32, "planted": 30, "foreign": "", "seed": "source", "jobs": 1,
            "limit": 300, "until": 0, "out": "out/same_names"}  # fmt: skip
MIX = {"effect": 60, "none": 20, "noise": 4, "pair": 8, "outside": 6, "decoy": 6, "touch": 6}
LEFT = re.compile(r"([0-9.]+) % done, about ([0-9.]+) s left")
THIRD = 1 / 3  # within which a time left is right
NAMED = 0.5  # confidence from which an effect counts as named
SETS = ("concealed", "planted", "foreign")


def concealed(number: int, seed: int, folder: Path, mix: dict[str, int] = MIX) -> dict[str, Any]:
    """Make one case of our own plant, of these groups. Return its recordings, those held out, its files and what is
    hidden."""
    from benchmarks.concealed import generate

    entry = generate.plan(mix, seed)[number]
    made = generate.once((entry, number, seed, folder, "two"))
    truth = generate.reveal(folder / "truth" / f"{made['name']}.json", made["digest"])
    case = folder / "cases" / made["name"]
    files = [str(case / f"{x}.mcap") for x in generate.RECORDINGS]
    return {
        "recordings": files[: -generate.HELD], "held_out": files[-generate.HELD :], "case": str(case),
        "hidden": [e["effect"] for e in truth["effects"]], "kind": entry["group"],
    }  # fmt: skip


def planted(number: int, seed: int, folder: Path) -> dict[str, Any]:
    """Make one case of our simulator; see `concealed`."""
    from benchmarks import planted as cases
    from dexsim.sim.quiet import quiet_warp

    quiet_warp("cpu")
    case = folder / str(number)
    truth = cases.make(cases.plan(seed, set())[number], number, seed, case)
    return {
        "recordings": [str(case / f"{x}.mcap") for x in "abc"], "held_out": [str(case / "d.mcap")], "case": str(case),
        "hidden": [] if truth["effect"] == "none" else [truth["effect"]], "kind": truth["tier"],
    }  # fmt: skip


def foreign(number: int, root: Path) -> dict[str, Any]:
    """Return one case of the other plant, without the recordings that its scorer keeps; see `concealed`."""
    truth = json.loads(sorted((root / "truth").glob("*.json"))[number].read_text(encoding="utf-8"))
    case = root / "cases" / truth["id"]
    files = sorted(map(str, chain(case.glob("train/*.mcap"), case.glob("repeat/*.mcap"))))
    return {
        "recordings": files, "held_out": [], "case": str(case), "kind": truth["tier"],
        "hidden": [e["effect"] for e in truth["effects"]],
    }  # fmt: skip


def answer(code: Path, made: dict[str, Any], out: Path, limit: float, ends: float) -> dict[str, Any] | None:
    """Return what one version says of a case; None where the whole run ended before it did."""
    own = [
        f"{key}={Path(made['case'], name)}"
        for key, name in (("model", "rig.xml"), ("servo", "servo.yaml"))
        if Path(made["case"], name).is_file()
    ]
    held = [f"held_out=[{','.join(made['held_out'])}]"] if made["held_out"] else []
    argv = [sys.executable, str(code / "diagnose.py"), f"recordings=[{','.join(made['recordings'])}]", *held, *own,
            f"out={out}", "next=false", f"limit={limit:g}"]  # fmt: skip
    env = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    env["PYTHONPATH"] = f"{code}:{os.environ.get('PYTHONPATH', '')}"
    room, begun = min(1.5 * limit, ends - time.time()), time.time()
    out.mkdir(parents=True, exist_ok=True)
    lines: list[tuple[float, str]] = []
    with (
        (out / "log.txt").open("w", encoding="utf-8") as log,
        subprocess.Popen(
            argv, cwd=code, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        ) as process,
    ):
        clock = threading.Timer(max(room, 1.0), process.kill)
        clock.start()
        for line in process.stdout or ():
            lines.append((time.time() - begun, line.rstrip()))
            print(f"{lines[-1][0]:7.1f} {lines[-1][1]}", file=log)
        clock.cancel()
    took, path = time.time() - begun, out / "diagnosis.json"
    if not path.is_file():
        late = took >= room and room < 1.5 * limit
        return None if late else {"verdict": "failed", "findings": [], "seconds": took, "times": []}
    said = json.loads(path.read_text(encoding="utf-8"))
    named = [
        (f["effect"], f["where"]["joints"], round(f["confidence"], 3), f.get("indistinguishable") or [])
        for f in said["findings"]
    ]
    return {"verdict": said["verdict"], "findings": named, "seconds": took, "times": times_of(lines)}


def times_of(lines: Sequence[tuple[float, str]]) -> list[tuple[float, float, float]]:
    """Return of each line that tells the time left of a search (s since the start, share done, s left as said), then
    when the search ended (share 1); empty where none was told. lines: (s since the start, text)."""
    found = [(t, LEFT.search(line)) for t, line in lines]
    ended = next((t for t, line in lines if line.strip().startswith("searched ")), None)
    said = [(t, 0.01 * float(m[1]), float(m[2])) for t, m in found if m]
    return [] if ended is None else [*said, (ended, 1.0, 0.0)]


def pair(job: tuple[str, int, dict[str, Any], Path, float]) -> dict[str, Any] | None:
    """Return a case's answers by both versions, or None where there was no time for them."""
    which, number, s, out, ends = job
    if time.time() > ends:
        return None
    if which == "foreign":
        made = foreign(number, Path(s["foreign"]))
    else:
        made = {"concealed": concealed, "planted": planted}[which](number, s["seed"], out / which)
    row = {"set": which, "number": number, "kind": made["kind"], "hidden": made["hidden"]}
    for version in ("after", "before"):
        folder = out / "answers" / f"{which}_{number}_{version}"
        said = answer(Path(s[version]).resolve(), made, folder, s["limit"], ends)
        if said is None:
            return None
        row[version] = said
    return row


def first(said: dict[str, Any], least: float = NAMED) -> tuple[str, tuple[str, ...]]:
    """Return effect and joints of the first finding of at least that confidence; ("none", ()) without one."""
    found = next((f for f in said["findings"] if f[2] >= least), None)
    return ("none", ()) if found is None else (found[0], tuple(found[1]))


def right(row: dict[str, Any], version: str) -> bool:
    """Return whether the first name is a hidden effect or a set that holds one; where nothing is hidden, whether
    nothing is named; where what is hidden has no name in the catalogue, whether none is named confidently."""
    if row["kind"] == "outside":
        return not sure_and_wrong(row, version)
    found = next((f for f in row[version]["findings"] if f[2] >= NAMED), None)
    if not row["hidden"]:
        return found is None
    finding = None if found is None else {"effect": found[0], "indistinguishable": found[3]}
    return any(score.named_right(finding, effect) for effect in row["hidden"])


def sure_and_wrong(row: dict[str, Any], version: str) -> bool:
    """Return whether an effect that is not hidden is named alone and confidently."""
    return any(
        f[2] >= score.SURE and len(f[3]) < 2 and f[0] not in row["hidden"] for f in row[version]["findings"]
    )


def told_right(rows: Sequence[dict[str, Any]], version: str) -> str:
    """Return how many of the times left that searches told were right within a third, in words."""
    right = [
        abs(remaining - (end - t)) <= THIRD * (end - t)
        for r in rows
        if (times := r[version].get("times"))
        for end in (times[-1][0],)
        for t, _, remaining in times[:-1]
    ]
    return f"{sum(right)} of {len(right)}"


def text_of(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table by set, then every case with another first name."""
    lines = []
    for which in SETS:
        these = [r for r in rows if r["set"] == which]
        if not these:
            continue
        n = len(these)
        same = sum(first(r["before"]) == first(r["after"]) for r in these)
        of = lambda test: [f"{sum(test(r, v) for r in these)} of {n}" for v in ("before", "after")]  # noqa: B023, E731
        took = [f"{sorted(r[v]['seconds'] for r in these)[n // 2]:.0f}" for v in ("before", "after")]
        said = [told_right(these, v) for v in ("before", "after")]
        lines.append((which, n, same, *of(right), *of(sure_and_wrong), *took, *said))
    head = ("set", "cases", "same first name", "right before", "after", "sure and wrong before", "after",
            "median s before", "after", "time left within a third before", "after")  # fmt: skip
    other = [r for r in rows if first(r["before"]) != first(r["after"])]
    say = lambda a: ", ".join(f"{f[0]}@{'/'.join(f[1])} {f[2]:.2f}" for f in a["findings"][:3]) or "-"  # noqa: E731
    return "\n".join(
        [
            table("the same cases, two versions", head, lines),
            *(
                f"{r['set']} {r['number']} ({r['kind']}; hidden: {', '.join(r['hidden']) or 'nothing'}): "
                f"{r['before']['verdict']}: {say(r['before'])} -> {r['after']['verdict']}: {say(r['after'])}"
                for r in other
            ),
        ]
    )


def main(argv: Sequence[str]) -> int:
    """Runs both versions; returns the exit status."""
    s = options(argv, SETTINGS)
    if not (Path(s["before"]) / "diagnose.py").is_file():
        raise UserError(f"before={s['before']}: must be a folder of code (git worktree add FOLDER COMMIT)")
    if s["foreign"] and not (Path(s["foreign"]) / "truth").is_dir():
        raise UserError(f"foreign={s['foreign']}: must be a folder with cases/ and truth/")
    s["seed"] = seed_of_sources() if s["seed"] == "source" else int(s["seed"])
    ends = time.time() + (s["until"] or 1e9)
    out = Path(s["out"]).expanduser().resolve() / f"seed_{s['seed']}"
    out.mkdir(parents=True, exist_ok=True)
    there = len(list(Path(s["foreign"]).glob("truth/*.json"))) if s["foreign"] else 0
    counts = {"concealed": s["concealed"], "planted": s["planted"], "foreign": there}
    log = out / "pairs.jsonl"
    rows = [json.loads(x) for x in log.read_text(encoding="utf-8").splitlines()] if log.is_file() else []
    done = {(r["set"], r["number"]) for r in rows}
    turns = chain.from_iterable(zip_longest(*([(w, k) for k in range(counts[w])] for w in SETS)))
    jobs = [(*t, s, out, ends) for t in turns if t is not None and t not in done]
    with ProcessPoolExecutor(max(s["jobs"], 1), mp_context=get_context("spawn")) as pool:
        waiting = [pool.submit(pair, job) for job in jobs]
        for finished in tqdm(as_completed(waiting), "pairs", len(waiting)):
            row = finished.result()
            if row is not None:
                rows.append(row)
                with log.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")
    print("\n" + text_of(rows))
    return 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:], __doc__))
