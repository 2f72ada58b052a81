"""The posterior beside today's answer: what each names, how surely, and how often that is right.

    python -m benchmarks.shadow [concealed=60] [spatial=60] [planted=30] [foreign=FOLDER] [seed=source] [jobs=1]
                                [limit=300] [until=0] [out=out/shadow]

concealed, spatial, planted: number of cases of our own plant (`benchmarks.concealed`), of its arms and hands whose
geometry is a little off, and of our simulator; foreign: a folder that the other plant's `generate.py` wrote (empty:
none). seed: of the cases, a number or `source` (read off the sources). limit: seconds that a diagnosis may take; until:
seconds after which nothing more is begun or waited for (0: no limit). Each case is written to out=/seed_N/cases.jsonl
as it comes; what stands there is not run again. Temperature and prior odds (`dexsim.gap.posterior`) are fitted to every
second case of each set; the table is of the others.
"""

from __future__ import annotations

import itertools
import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import answers, same_names
from benchmarks.concealed import score
from dexsim.console.ending import guard
from dexsim.console.tables import table
from dexsim.gap import posterior
from dexsim.gap.effects.catalogue import confusable
from dexsim.gap.posterior import Hypothesis

SETTINGS = {"concealed": 60, "spatial": 60, "planted": 30, "foreign": "", "seed": "source", "jobs": 1, "limit": 300,
            "until": 0, "out": "out/shadow"}  # fmt: skip
SETS = ("spatial", "concealed", "planted", "foreign")
TEMPERATURES = (1.0, 3.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 640.0)
ODDS = (0.0, 1.0, 2.0, 3.0, 4.0, 6.0)
NAMED, SURE, LIKE = 0.5, 0.8, 0.05  # probabilities from which an effect is named, is sure, belongs to a set
LEAST = 0.005  # and that nothing is less probable than, in the log score
NEEDS = 4.0  # x the white noise: a larger drift of the best hypothesis is something unknown


def case(job: tuple[str, int, dict[str, Any], Path, float]) -> dict[str, Any] | None:
    """Return a case with today's answer and the hypotheses behind it; None where there was no time for it."""
    which, number, s, out, ends = job
    if time.time() > ends:
        return None
    made = same_names.made(which, number, s, out)
    folder = out / "answers" / f"{which}_{number}"
    said = answers.diagnosed(answers.ROOT, made["words"], folder, s["limit"], ends)
    if said is None:
        return None
    details = folder / "details.json"
    tried = json.loads(details.read_text(encoding="utf-8"))["hypotheses"] if details.is_file() else {}
    hypotheses = {j: [{k: v for k, v in h.items() if k != "mass"} for h in x["tried"]] for j, x in tried.items()}
    return {"set": which, "number": number, "kind": made["kind"], "hidden": made["hidden"], "today": said,
            "hypotheses": hypotheses}  # fmt: skip


# -- two answers to a case --------------------------------------------------------------------------------------------
# An answer: probability by effect, the first name with what cannot be told from it (None: no name), whether it says
# unknown.

Answer = tuple[dict[str, float], dict[str, Any] | None, bool]


def anywhere(given: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the probability of each effect on any of the joints."""
    ids = dict.fromkeys(e for x in given for e in x)
    return {e: 1 - math.prod(1 - x.get(e, 0.0) for x in given) for e in ids}


def today(row: dict[str, Any]) -> Answer:
    """Return the answer as it is written."""
    found = [f for f in row["today"]["findings"] if f[0] != "bad_channel"]
    first = next(({"effect": f[0], "indistinguishable": f[3]} for f in found if f[2] >= NAMED), None)
    return anywhere([{f[0]: f[2]} for f in found]), first, row["today"]["verdict"] == "unknown"


def shadow(row: dict[str, Any], temperature: float, odds: float) -> Answer:
    """Return the answer of the posterior."""
    each, unknown = [], False
    for tried in row["hypotheses"].values():
        given = [Hypothesis(tuple(h["effects"]), h["label"], h["size"], tuple(h["score"]), h["drift"]) for h in tried]
        if not given:
            continue
        mass = posterior.masses(given, temperature, odds)
        each.append({e: p for e, p in posterior.marginals(given, mass).items() if e != "none"})
        unknown |= given[int(np.argmax(mass))].drift > NEEDS
    by = anywhere(each)
    best = max(by, key=lambda e: by[e]) if by else ""
    alike = [best, *(e for e in by if e != best and by[e] >= LIKE and confusable(best, e))] if best else []
    if sum(by[e] for e in alike) < NAMED:
        return by, None, unknown
    return by, {"effect": best, "indistinguishable": alike if by[best] < SURE and len(alike) > 1 else []}, unknown


def log_score(rows: Sequence[dict[str, Any]], of: Callable[[dict[str, Any]], Answer]) -> float:
    """Return the mean over cases of the log probability [nats] of what is there and what is not, over the effects that
    either is hidden or was given a probability."""
    total = 0.0
    for row in rows:
        by = of(row)[0]
        for e in dict.fromkeys([*by, *row["hidden"]]):
            p = min(max(by.get(e, 0.0), LEAST), 1 - LEAST)
            total += math.log(p if e in row["hidden"] else 1 - p)
    return total / max(len(rows), 1)


def fitted(rows: Sequence[dict[str, Any]]) -> tuple[float, float]:
    """Return the temperature and prior odds under which the posterior scores best."""
    pairs = itertools.product(TEMPERATURES, ODDS)
    return max(pairs, key=lambda x: log_score(rows, lambda r: shadow(r, *x)))


def right(row: dict[str, Any], answer: Answer) -> bool:
    """Return whether the first name, or its set, holds what is hidden; where nothing is, whether nothing is named."""
    return answer[1] is None if not row["hidden"] else any(score.named_right(answer[1], e) for e in row["hidden"])


def lines_of(rows: Sequence[dict[str, Any]], of: Callable[[dict[str, Any]], Answer]) -> list[str]:
    """Return the figures of one answer: hidden effects named first, alarms and unknown where nothing is hidden, log
    score, and how many names of two ranges of confidence are true."""
    rows = [r for r in rows if r["kind"] not in ("outside", "decoy", "touch")]
    hidden, empty = ([r for r in rows if bool(r["hidden"]) is x] for x in (True, False))
    said = {id(r): of(r) for r in rows}
    share = lambda test, these: f"{sum(map(test, these))} of {len(these)}"  # noqa: E731
    true = lambda low, high: [e in r["hidden"] for r in rows for e, p in said[id(r)][0].items() if low <= p < high]  # noqa: E731
    return [
        share(lambda r: right(r, said[id(r)]), hidden), share(lambda r: not right(r, said[id(r)]), empty),
        share(lambda r: said[id(r)][2], empty), f"{log_score(rows, of):.3f}",
        share(bool, true(NAMED, SURE)), share(bool, true(SURE, 1.01)),
    ]  # fmt: skip


def text_of(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table: of each set, and of all, the half that nothing was fitted to."""
    learned, judged = ([r for r in rows if r["number"] % 2 == k] for k in (0, 1))
    temperature, odds = fitted([r for r in learned if r["kind"] not in ("outside", "decoy", "touch")])
    head = ("set", "answer", "cases", "right first", "alarms", "empty: unknown", "log score", "0.5 to 0.8: true",
            "0.8 and more: true")  # fmt: skip
    lines = []
    for which in (*SETS, "all"):
        these = [r for r in judged if which in ("all", r["set"])]
        if these:
            lines.append((which, "today", len(these), *lines_of(these, today)))
            lines.append((which, "posterior", len(these), *lines_of(these, lambda r: shadow(r, temperature, odds))))
    said = f"temperature {temperature:g} nats, {odds:g} nats an effect: fitted to {len(learned)} other cases"
    return f"{table('today and the posterior', head, lines)}\n{said}"


def main(argv: Sequence[str]) -> int:
    """Diagnose the cases, and print the table; return the exit status."""
    print("\n" + text_of(same_names.run(case, *answers.settings(argv, SETTINGS), SETS, "cases")))
    return 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:], __doc__))
