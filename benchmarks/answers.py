"""Asks `diagnose` about the cases of a benchmark, as a user would, and keeps what is done."""

from __future__ import annotations

import hashlib
import json
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import chain, zip_longest
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from tqdm import tqdm

from dexsim.errors import UserError

ROOT = Path(__file__).resolve().parents[1]
LEFT = re.compile(r"([0-9.]+) % done, about ([0-9.]+) s left")
OVER = 1.5
"""x its limit, after which a diagnosis that has not ended itself is ended."""
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


def turns(counts: dict[str, int]) -> list[Key]:
    """Return the cases of several sets in turn, so that what is done where a run ends early is a fair sample."""
    every = chain.from_iterable(zip_longest(*([(which, k) for k in range(n)] for which, n in counts.items())))
    return [key for key in every if key is not None]


def each(work: Callable[[Any], Row | None], jobs: dict[Key, Any], log: Path, workers: int) -> list[Row]:
    """Return the rows of the log, and those of work(job) of the cases that are not in it, as they come: each is added
    to the log at once. A row states its `set` and `number`; None: there was no time for it."""
    log.parent.mkdir(parents=True, exist_ok=True)
    rows = [json.loads(x) for x in log.read_text(encoding="utf-8").splitlines()] if log.is_file() else []
    done = {(r["set"], r["number"]) for r in rows}
    with ProcessPoolExecutor(max(workers, 1), mp_context=get_context("spawn")) as pool:
        waiting = [pool.submit(work, job) for key, job in jobs.items() if key not in done]
        for finished in tqdm(as_completed(waiting), "cases", len(waiting)):
            row = finished.result()
            if row is not None:
                rows.append(row)
                with log.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")
    return rows


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


def times_of(lines: Sequence[tuple[float, str]]) -> list[tuple[float, float, float]]:
    """Return of each line that tells the time left of a search (s since the start, share done, s left as said), then
    when the search ended (share 1); empty where none was told. lines: (s since the start, text)."""
    found = [(t, LEFT.search(line)) for t, line in lines]
    ended = next((t for t, line in lines if line.strip().startswith("searched ")), None)
    said = [(t, 0.01 * float(m[1]), float(m[2])) for t, m in found if m]
    return [] if ended is None else [*said, (ended, 1.0, 0.0)]
