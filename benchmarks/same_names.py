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
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks import answers
from benchmarks.concealed import score
from dexsim.console.ending import guard
from dexsim.console.jobs import Engine
from dexsim.console.tables import table
from dexsim.errors import UserError

SETTINGS = {"before": "", "after": ".", "concealed": 32, "planted": 30, "foreign": "", "seed": "source", "jobs": 1,
            "limit": 300, "until": 0, "out": "out/same_names"}  # fmt: skip
MIX = {"effect": 60, "none": 20, "noise": 4, "pair": 8, "outside": 6, "decoy": 6, "touch": 6}
THIRD = 1 / 3  # within which a time left is right
NAMED = 0.5  # confidence from which an effect counts as named
SETS = ("concealed", "planted", "foreign")


def concealed(number: int, seed: int, folder: Path, mix: dict[str, int] = MIX) -> dict[str, Any]:
    """Make one case of our own plant, of these groups. Return the settings of `diagnose`, what is hidden and its
    kind."""
    from benchmarks.concealed import generate

    entry = generate.plan(mix, seed)[number]
    made = generate.once((entry, number, seed, folder, "two"))
    truth = generate.reveal(folder / "truth" / f"{made['name']}.json", made["digest"])
    case = folder / "cases" / made["name"]
    return {"words": generate.words(case), "hidden": [e["effect"] for e in truth["effects"]], "kind": entry["group"]}


def planted(number: int, seed: int, folder: Path) -> dict[str, Any]:
    """Make one case of our simulator; see `concealed`."""
    from benchmarks import planted as cases
    from dexsim.sim.quiet import quiet_warp

    quiet_warp("cpu")
    case = folder / str(number)
    truth = cases.make(cases.plan(seed)[number], number, seed, case)
    return {"words": cases.words(case), "kind": truth["tier"],
            "hidden": [] if truth["effect"] == "none" else [truth["effect"]]}  # fmt: skip


def foreign(number: int, root: Path) -> dict[str, Any]:
    """Return one case of the other plant, without the recordings that its scorer keeps; see `concealed`."""
    truth = json.loads(sorted((root / "truth").glob("*.json"))[number].read_text(encoding="utf-8"))
    case = root / "cases" / truth["id"]
    files = sorted(map(str, (*case.glob("train/*.mcap"), *case.glob("repeat/*.mcap"))))
    words = [f"recordings=[{','.join(files)}]", f"model={case / 'rig.xml'}", f"servo={case / 'servo.yaml'}"]
    return {"words": words, "kind": truth["tier"], "hidden": [e["effect"] for e in truth["effects"]]}


def made(which: str, number: int, s: dict[str, Any], out: Path) -> dict[str, Any]:
    """Make a case of a set below out/, or read it; see `concealed`."""
    if which == "foreign":
        return foreign(number, Path(s["foreign"]))
    if which == "planted":
        return planted(number, s["seed"], out / which)
    return concealed(number, s["seed"], out / which, {"spatial": s["spatial"]} if which == "spatial" else MIX)


def pair(job: tuple[str, int, dict[str, Any], Path, float]) -> dict[str, Any] | None:
    """Return a case's answers by both versions, or None where there was no time for them."""
    which, number, s, out, ends = job
    if time.time() > ends:
        return None
    it = made(which, number, s, out)
    row = {"set": which, "number": number, "kind": it["kind"], "hidden": it["hidden"]}
    for version in ("after", "before"):
        folder = out / "answers" / f"{which}_{number}_{version}"
        said = answers.diagnosed(Path(s[version]).resolve(), it["words"], folder, s["limit"], ends)
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
        return not answers.sure_and_wrong(row[version], row["hidden"])
    found = next((f for f in row[version]["findings"] if f[2] >= NAMED), None)
    if not row["hidden"]:
        return found is None
    finding = None if found is None else {"effect": found[0], "indistinguishable": found[3]}
    return any(score.named_right(finding, effect) for effect in row["hidden"])


def told_right(rows: Sequence[dict[str, Any]], version: str) -> str:
    """Return how many numbers told for the time left were right within a third."""
    times = [x for r in rows for x in r[version].get("times", ())]
    return f"{sum(abs(said - was) <= THIRD * was for *_, said, was in times)} of {len(times)}"


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
        wrong = lambda r, v: answers.sure_and_wrong(r[v], r["hidden"])  # noqa: E731
        took = [f"{sorted(r[v]['seconds'] for r in these)[n // 2]:.0f}" for v in ("before", "after")]
        said = [told_right(these, v) for v in ("before", "after")]
        lines.append((which, n, same, *of(right), *of(wrong), *took, *said))
    head = ("set", "cases", "same first name", "right before", "after", "sure and wrong before", "after",
            "median s before", "after", "time left right before", "after")  # fmt: skip
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


def run(work: Callable, s: dict[str, Any], engine: Engine, sets: Sequence[str], log: str) -> list[dict[str, Any]]:
    """Return the rows of work((set, number, settings, folder, end)) of the cases of several sets; see `answers.each`.
    Raises UserError for a setting that is none."""
    if s["foreign"] and not (Path(s["foreign"]) / "truth").is_dir():
        raise UserError(f"foreign={s['foreign']}: must be a folder with cases/ and truth/")
    ends = time.time() + (s["until"] or 1e9)
    out = Path(s["out"]).expanduser().resolve() / f"seed_{s['seed']}"
    there = len(list(Path(s["foreign"]).glob("truth/*.json"))) if s["foreign"] else 0
    turns = answers.turns({k: there if k == "foreign" else s[k] for k in sets})
    return answers.each(work, {key: (*key, s, out, ends) for key in turns}, out / f"{log}.jsonl", engine)


def main(argv: Sequence[str]) -> int:
    """Run both versions; return the exit status."""
    s, engine = answers.settings(argv, SETTINGS)
    if not (Path(s["before"]) / "diagnose.py").is_file():
        raise UserError(f"before={s['before']}: must be a folder of code (git worktree add FOLDER COMMIT)")
    print("\n" + text_of(run(pair, s, engine, SETS, "pairs")))
    return 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:], __doc__))
