"""`python -m tests.fuzz [minutes=60] [cases=N] [kind=recording,servo,...] [from=SEED] [out=FOLDER]`: damaged files
without end.

Each case has a limit of 20 s of processor time and 2 GiB of memory. What breaks is kept in out= (out/fuzz) with its
seed; `python -m tests.fuzz kind=servo from=123 cases=1` makes it again. Ends with status 1 where anything broke.
kind=ci: every third a recording, as continuous integration runs it.
"""

from __future__ import annotations

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
from pathlib import Path

from . import corpus, mutate, targets

OTHERS = [k for k in targets.TARGETS if k != "recording"]
SECONDS, BYTES = 20.0, 2 << 30
BATCH = 200
CI = [k for a, b in zip(OTHERS[::2], OTHERS[1::2], strict=True) for k in ("recording", a, b)]
"""Kinds in turn."""


class TooLong(BaseException):
    """A case beyond its time."""


def one(kind: str, seed: int, files: dict[str, list[Path]], folder: Path) -> tuple[str, str, Path]:
    """(fine, refused, traceback, over 20 s, over 2 GB, message; what, the file) of a case."""
    mutate.clean(folder)
    path = mutate.case(kind, seed, files, folder)

    def stop(*_):
        raise TooLong

    signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, SECONDS)
    try:
        answer = targets.verdict(kind, path)
        return (answer, "", path) if answer in ("fine", "refused") else ("message", answer, path)
    except TooLong:
        return "over 20 s", "", path
    except MemoryError:
        return "over 2 GB", "", path
    except Exception:
        return "traceback", traceback.format_exc(limit=-4), path
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)


def work(kinds: list[str], first: int, count: int, out: Path, folder: Path, send) -> None:
    """A batch in a process of its own: a crash ends this one alone."""
    warnings.simplefilter("ignore")
    used = (
        int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        if Path("/proc/self/statm").exists()
        else 0
    )
    resource.setrlimit(resource.RLIMIT_AS, (used + BYTES, used + BYTES))
    files = corpus.build(folder / "corpus")
    cases = folder / "case"
    cases.mkdir(exist_ok=True)
    for seed in range(first, first + count):
        kind = kinds[seed % len(kinds)]
        send.send((seed, kind, "began", ""))
        what, text, path = one(kind, seed, files, cases)
        if what not in ("fine", "refused"):
            out.mkdir(parents=True, exist_ok=True)
            left = next((p for p in cases.iterdir()), path)
            if left.is_file():
                shutil.copyfile(left, out / f"{kind}_{seed}{path.suffix}")
        send.send((seed, kind, what, text))
    send.close()


def main(argv: list[str]) -> int:
    given = dict(a.split("=", 1) for a in argv if "=" in a)
    if set(given) - {"minutes", "cases", "kind", "from", "out"} or any("=" not in a for a in argv):
        print(__doc__)
        return 2
    kinds = given.get("kind", ",".join(targets.TARGETS)).split(",")
    kinds = CI if kinds == ["ci"] else kinds
    end = time.monotonic() + 60 * float(given.get("minutes", 60))
    most, seed = int(given.get("cases", 10**12)), int(given.get("from", 0))
    out = Path(given.get("out", "out/fuzz"))
    counts: Counter[str] = Counter()
    broken: dict[str, list[str]] = {}
    with tempfile.TemporaryDirectory() as folder:
        while time.monotonic() < end and sum(counts.values()) < most:
            receive, send = multiprocessing.Pipe(False)
            count = min(BATCH, most - sum(counts.values()))
            worker = multiprocessing.get_context("fork").Process(
                target=work, args=(kinds, seed, count, out, Path(folder), send)
            )
            worker.start()
            send.close()
            begun = None
            try:
                while True:
                    begun_seed, kind, what, text = receive.recv()
                    begun = (begun_seed, kind) if what == "began" else None
                    if what == "began":
                        continue
                    counts[what] += 1
                    if text or what.startswith("over"):
                        line = (text.strip().splitlines() or [what])[-1]
                        if line not in broken:
                            print(f"{kind} from={begun_seed}: {what}\n{text}", flush=True)
                        broken.setdefault(line, []).append(f"{kind} {begun_seed}")
                    seed = begun_seed + 1
            except EOFError:
                pass
            worker.join()
            if begun is not None:  # it died in a case
                counts["crash"] += 1
                print(f"{begun[1]} from={begun[0]}: ended its process with {worker.exitcode}", flush=True)
                broken.setdefault(f"crash {worker.exitcode}", []).append(f"{begun[1]} {begun[0]}")
                seed = begun[0] + 1
    print(
        json.dumps(
            {
                "cases": sum(counts.values()),
                **{
                    k: counts[k] for k in ("fine", "refused", "traceback", "message", "over 20 s", "over 2 GB", "crash")
                },
                "next": seed,
            }
        )
    )
    return int(bool(broken))


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.exit(main(sys.argv[1:]))
