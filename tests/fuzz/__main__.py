"""`python -m tests.fuzz [minutes=60] [cases=N] [kind=recording,servo,...] [from=SEED] [start=0] [processes=1]
[out=FOLDER]`: damaged files without end.

Each case has a limit of 20 s of processor time and 2 GiB, what its readers take included; one that is taken must be
taken as it stands, or something said of it (`silence.py`). What breaks is kept in out= (out/fuzz) with its
seed; `python -m tests.fuzz kind=servo from=123 cases=1` makes it again. Ends with status 1 where anything broke.
kind=ci: every third a recording, as continuous integration runs it. from=source: a seed that is read off the code of
dexsim and of these tests, new after each change and nobody's choice; start=N begins N seeds later.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path

from . import corpus, mutate, targets

OTHERS = [k for k in targets.TARGETS if k != "recording"]
OUTCOMES = ("fine", "refused", "traceback", "message", "silent", "over 20 s", "over 2 GB", "crash")
SECONDS, BYTES = 20.0, 2 << 30
KIB = 1024 if sys.platform == "linux" else 1
"""Bytes that `ru_maxrss` counts in."""
BATCH = 200
MADE = ("model", "robot")  # of a schema, not of files
CI = [k for a, b in zip(OTHERS[::2], OTHERS[1::2], strict=True) for k in ("recording", a, b)]
"""Kinds in turn."""


class TooLong(BaseException):
    """A case beyond its time."""


def one(kind: str, seed: int, files: dict[str, list[Path]], folder: Path) -> tuple[str, str, Path]:
    """Return (fine, refused, traceback, over 20 s, over 2 GB, message, silent; what, the file) of a case."""
    mutate.clean(folder)
    path = mutate.case(kind, seed, files, folder)

    def stop(*_):
        raise TooLong

    signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, 10 * SECONDS)  # of a machine that others use, too
    begun = sum(os.times()[:4])
    try:
        answer = targets.verdict(kind, path)
        if sum(os.times()[:4]) - begun > SECONDS:  # processor time, of the readers, too
            raise TooLong
        if KIB * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss > BYTES:  # the largest reader yet
            raise MemoryError
        if answer in ("fine", "refused"):
            return answer, "", path
        return "silent" if answer.startswith("silent: ") else "message", answer, path
    except TooLong:
        return "over 20 s", "", path
    except MemoryError:
        return "over 2 GB", "", path
    except Exception:
        return "traceback", traceback.format_exc(limit=-4), path
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


def work(kinds: list[str], first: int, count: int, files: dict[str, list[Path]], out: Path, send) -> None:
    """Run a batch in a process of its own: a crash ends this one alone."""
    warnings.simplefilter("ignore")
    used = (
        int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        if Path("/proc/self/statm").exists()
        else 0
    )
    resource.setrlimit(resource.RLIMIT_AS, (used + BYTES, used + BYTES))
    with tempfile.TemporaryDirectory() as folder:
        cases = Path(folder)
        for seed in range(first, first + count):
            kind = kinds[seed % len(kinds)]
            send.send((seed, kind, "began", ""))
            what, text, path = one(kind, seed, files, cases)
            if what not in ("fine", "refused"):
                out.mkdir(parents=True, exist_ok=True)
                remaining = next((p for p in cases.iterdir()), path)
                if remaining.is_file():
                    shutil.copyfile(remaining, out / f"{kind}_{seed}{path.suffix}")
            send.send((seed, kind, what, text))
    send.close()


@dataclass
class Batch:
    """Cases of which a process works off one after the other. last: the seed after its last."""

    worker: multiprocessing.process.BaseProcess
    last: int
    begun: tuple[int, str] | None = None  # the case under way: seed, kind


class Run:
    """Batches in some processes at a time, and what came of their cases."""

    def __init__(self, kinds: list[str], seed: int, most: int, out: Path, files: dict[str, list[Path]]):
        self.kinds, self.next, self.end, self.out, self.files = kinds, seed, seed + most, out, files
        self.counts: Counter[str] = Counter()
        self.broken: dict[str, list[str]] = {}
        self._batches: dict[Connection, Batch] = {}
        self._begun = self._said = time.monotonic()

    def go(self, processes: int, until: float) -> None:
        """Go on until the seeds or the time (of `time.monotonic`) are over; batches under way are finished."""
        while True:
            while len(self._batches) < processes and self.next < self.end and time.monotonic() < until:
                last = min(self.next + BATCH, self.end)
                self._start(self.next, last)
                self.next = last
            if not self._batches:
                return
            for receive in wait(list(self._batches)):
                self._hear(receive)
            if time.monotonic() > self._said + 20:
                self._said = time.monotonic()
                done = sum(self.counts.values())
                rate = done / (self._said - self._begun)
                print(f"{json.dumps(self.said())}  {rate:.1f} cases/s", flush=True)

    def said(self) -> dict[str, int]:
        """Return cases by outcome, and the seed that is next."""
        return {"cases": sum(self.counts.values()), **{k: self.counts[k] for k in OUTCOMES}, "next": self.next}

    def _start(self, first: int, last: int) -> None:
        receive, send = multiprocessing.Pipe(False)
        worker = multiprocessing.get_context("fork").Process(
            target=work, args=(self.kinds, first, last - first, self.files, self.out, send)
        )
        worker.start()
        send.close()
        self._batches[receive] = Batch(worker, last)

    def _hear(self, receive: Connection) -> None:
        """Hear one message of a batch, or its end."""
        batch = self._batches[receive]
        try:
            seed, kind, what, text = receive.recv()
        except EOFError:
            del self._batches[receive]
            batch.worker.join()
            if batch.begun is not None:  # it died in a case; the others of its batch follow
                seed, kind = batch.begun
                ended = batch.worker.exitcode
                self._break("crash", kind, seed, f"ended its process with {ended}", f"crash {ended}")
                if seed + 1 < batch.last:
                    self._start(seed + 1, batch.last)
            return
        batch.begun = (seed, kind) if what == "began" else None
        if text or what.startswith("over"):
            self._break(what, kind, seed, f"{what}\n{text}", (text.strip().splitlines() or [what])[-1])
        elif what != "began":
            self.counts[what] += 1

    def _break(self, what: str, kind: str, seed: int, said: str, line: str) -> None:
        self.counts[what] += 1
        if line not in self.broken:
            print(f"{kind} from={seed}: {said}", flush=True)
        self.broken.setdefault(line, []).append(f"{kind} {seed}")


def source_seed() -> int:
    """Return a seed below 10^9 from the text of every module of dexsim and of these tests."""
    read = hashlib.sha256()
    for folder in ("dexsim", "tests/fuzz"):
        for path in sorted((corpus.ROOT / folder).rglob("*.py")):
            read.update(path.read_bytes())
    return int(read.hexdigest(), 16) % 10**9


def main(argv: list[str]) -> int:
    given = dict(a.split("=", 1) for a in argv if "=" in a)
    known = {"minutes", "cases", "kind", "from", "start", "processes", "out"}
    if set(given) - known or any("=" not in a for a in argv):
        print(__doc__)
        return 2
    until = time.monotonic() + 60 * float(given.get("minutes", 60))
    with tempfile.TemporaryDirectory() as folder:
        files = corpus.build(Path(folder))  # once, and with it what reading them needs is loaded before the forks
        kinds = given["kind"].split(",") if "kind" in given else [k for k in targets.TARGETS if k in {*files, *MADE}]
        kinds = CI if kinds == ["ci"] else kinds
        first = source_seed() if given.get("from") == "source" else int(given.get("from", 0))
        first += int(given.get("start", 0))
        print(f"from={first}", flush=True)
        run = Run(kinds, first, int(given.get("cases", 10**12)), Path(given.get("out", "out/fuzz")), files)
        run.go(int(given.get("processes", 1)), until)
    print(json.dumps(run.said()))
    return int(bool(run.broken))


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.exit(main(sys.argv[1:]))
