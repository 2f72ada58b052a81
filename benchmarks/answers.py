"""Asks `diagnose` about the cases of a benchmark, as a user would, and keeps what is done."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any

from benchmarks.options import options
from dexsim.console import jobs
from dexsim.errors import UserError

ROOT = Path(__file__).resolve().parents[1]
LEFT = re.compile(r"([0-9.]+) % done, about ([0-9.]+) s left")
SURE = 0.8  # a name is confident from here, when it stands alone
OVER = 1.5
"""x its limit, after which a diagnosis that has not ended itself is ended."""
PROGRAM = (sys.executable, "-c", "import sys; from benchmarks.answers import answer; from dexsim.console.ending import"
           " guard; sys.exit(guard(answer, sys.argv[1:]))")  # fmt: skip
Row = dict[str, Any]
Key = tuple[str, int]  # set and number of a case


def seed_of_sources(folder: Path = ROOT / "dexsim") -> int:
    """Return a number of five digits that every change of a source or a setting changes."""
    digest = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.suffix in (".py", ".yaml")):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return 10_000 + int(digest.hexdigest()[:8], 16) % 90_000


def seed_of(text: str) -> int:
    """Return the seed that a setting states: a whole number, or `source`: read off the sources of dexsim, so that no
    change can have been made with its cases in view. Raises UserError for another text."""
    if text != "source" and not text.isdigit():
        raise UserError(f"seed={text}: must be a whole number or source")
    return seed_of_sources() if text == "source" else int(text)


def settings(
    argv: Sequence[str], defaults: dict[str, Any], **choices: Sequence[str]
) -> tuple[dict[str, Any], jobs.Engine]:
    """Return the settings of a benchmark, its seed as a number, and where its jobs run: `jobs` of them at a time, on=
    and slurm.NAME= as everywhere."""
    engine, rest = jobs.taken(argv)
    s = options(rest, defaults, **choices)
    engine.at_once = engine.at_once or max(s["jobs"], 1)
    if isinstance(s.get("seed"), str):
        s["seed"] = seed_of(s["seed"])
    return s, engine


def turns(counts: dict[str, int]) -> list[Key]:
    """Return the cases of several sets in turn, so that what is done where a run ends early is a fair sample."""
    every = chain.from_iterable(zip_longest(*([(which, k) for k in range(n)] for which, n in counts.items())))
    return [key for key in every if key is not None]


def each(work: Callable[[Any], Row | None], cases: dict[Key, Any], log: Path, engine: jobs.Engine) -> list[Row]:
    """Return the rows of the log, and those of work(case) of the cases that are not in it, which are added to the log.
    A row states its `set` and `number`; None: there was no time for it."""
    log.parent.mkdir(parents=True, exist_ok=True)
    rows = [json.loads(x) for x in log.read_text(encoding="utf-8").splitlines()] if log.is_file() else []
    done = {(r["set"], r["number"]) for r in rows}
    with log.open("a", encoding="utf-8") as file:
        for row in at_once(work, {f"{k[0]}_{k[1]}": x for k, x in cases.items() if k not in done}, log.parent, engine):
            rows.append(row)
            file.write(json.dumps(row) + "\n")
    return rows


def at_once(work: Callable[[Any], Any], given: dict[str, Any], out: Path, engine: jobs.Engine) -> Iterator[Any]:
    """Yield what work(x) returned for each x of `given`, which are named; None is left out. Each is a job of its own,
    with its folder in out/work. Where the run is ended early, those that were done still come. Raises UserError for
    one that failed, when all have ended."""
    module = sys.modules[work.__module__]
    name = f"{module.__spec__.name if module.__spec__ else module.__name__}:{work.__name__}"
    todo, place = [], out.resolve() / "work"
    (place / "jobs").mkdir(parents=True, exist_ok=True)
    for key, x in given.items():
        question, answer = place / "jobs" / f"{key}.pickle", place / key / "answer.json"
        question.write_bytes(pickle.dumps(x))
        answer.unlink(missing_ok=True)
        todo.append(jobs.Job(((name, str(question), str(answer)),), place / key, PROGRAM))
        todo[-1].note.unlink(missing_ok=True)  # where it was asked before, it is asked again
    try:
        status = jobs.run(todo, engine) if todo else []
    finally:
        answers = [job.folder / "answer.json" for job in todo]
        found = [json.loads(path.read_text(encoding="utf-8")) for path in answers if path.is_file()]
        yield from (x for x in found if x is not None)
    for job, ended in zip(todo, status, strict=True):
        if ended:
            raise UserError(f"{job.folder.name} ended with status {ended}: see {job.note.with_suffix('.txt')}")


def answer(argv: Sequence[str]) -> int:
    """Run one job of `at_once`: function, file of what it is given, file for what it returns."""
    module, _, name = argv[0].partition(":")
    said = getattr(import_module(module), name)(pickle.loads(Path(argv[1]).read_bytes()))
    Path(argv[2]).write_text(json.dumps(said, default=float), encoding="utf-8")
    return 0


def ask(
    words: Sequence[str], out: Path, limit: float, room: float = 1e9, code: Path = ROOT, threads: int = 1
) -> tuple[int | None, float, list[tuple[float, str]]]:
    """Run `diagnose.py` of a folder of code with these settings and out=; its output goes to out/log.txt. Return (its
    exit status, seconds, lines as (s, text)); the status is None where it was ended for `room` [s]. It is told `limit`
    [s], and ended after half as much again."""
    argv = [sys.executable, str(code / "diagnose.py"), *words, f"out={out}", "next=false", f"limit={limit:g}"]
    env = os.environ | {"OMP_NUM_THREADS": str(threads), "OPENBLAS_NUM_THREADS": str(threads)}
    env["PYTHONPATH"] = f"{code}:{os.environ.get('PYTHONPATH', '')}"
    out.mkdir(parents=True, exist_ok=True)
    begun, lines = time.perf_counter(), []
    with (
        (out / "log.txt").open("w", encoding="utf-8") as log,
        subprocess.Popen(
            argv, cwd=code, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        ) as process,
    ):
        clock = threading.Timer(max(min(OVER * limit, room), 1.0), process.kill)
        clock.start()
        for line in process.stdout or ():
            lines.append((time.perf_counter() - begun, line.rstrip()))
            print(f"{lines[-1][0]:7.1f} {lines[-1][1]}", file=log, flush=True)
        clock.cancel()
    took = time.perf_counter() - begun
    return (None if process.returncode and room < OVER * limit and took >= room else process.returncode), took, lines


def diagnosed(code: Path, words: Sequence[str], out: Path, limit: float, ends: float) -> Row | None:
    """Return what one version says of a case: verdict, findings as (effect, joints, confidence, set), seconds, and
    times (see `times_of`); None where the whole run ended first, at `ends` [s since the epoch]."""
    status, took, lines = ask(words, out, limit, ends - time.time(), code)
    path = out / "diagnosis.json"
    if status is None:
        return None
    if not path.is_file():  # counted, not dropped: no answer is a wrong one
        return {"verdict": "failed", "findings": [], "seconds": took, "times": []}
    said = json.loads(path.read_text(encoding="utf-8"))
    named = [
        (f["effect"], f["where"]["joints"], round(f["confidence"], 3), f.get("indistinguishable") or [])
        for f in said["findings"]
    ]
    return {"verdict": said["verdict"], "findings": named, "seconds": took, "times": times_of(lines)}


def sure_and_wrong(said: Row, hidden: Sequence[str]) -> bool:
    """Return whether an answer names an effect that is not hidden, alone and confidently."""
    return any(f[2] >= SURE and len(f[3]) < 2 and f[0] not in hidden for f in said["findings"])


def times_of(lines: Sequence[tuple[float, str]]) -> list[tuple[float, float, float, float]]:
    """Return of each line that tells the time left of replays (s since the start, share done, s left as said, s that
    were left); none of what did not end. lines: (s since the start, text)."""
    out, said = [], list[tuple[float, float, float]]()
    for t, line in lines:
        if m := LEFT.search(line):
            said.append((t, 0.01 * float(m[1]), float(m[2])))
        elif line.strip().startswith(("searched ", "replayed ")):
            out += [(*x, t - x[0]) for x in said]
            said = []
    return out
