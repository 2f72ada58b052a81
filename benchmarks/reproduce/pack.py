"""What a table's rows need to be continued elsewhere, small enough to take along: between sittings on machines that
keep nothing.

    python -m benchmarks.reproduce.pack out=out/reproduce_rotation into=out/state [part_mb=15]    # writes state_0.tgz,
    state_1.tgz, .. python -m benchmarks.reproduce.pack unpack=out/state out=out/reproduce_rotation

Of each training the furthest last.pt, without the optimizer's moments (two thirds of it; the learning rate stays, the
moments build up again within some updates), its progress.csv and config.yaml, and what the judging wrote, without
pictures.
"""

from __future__ import annotations

import io
import itertools
import json
import os
import sys
import tarfile
import tempfile
import zlib
from pathlib import Path

from benchmarks import tools
from benchmarks.reproduce.jobs import done
from dexsim import outputs
from dexsim.console.ending import guard
from dexsim.errors import UserError
from dexsim.learning import checkpoint

OWN = {"out": "null", "into": "null", "unpack": "null", "part_mb": "15"}
BESIDE = ("progress.csv", "config.yaml")
JUDGED = ("metrics.json", "judged.json")


def slim(path: Path) -> bytes:
    """A training's checkpoint without the optimizer's moments, as a file that `resume=` takes."""
    data = checkpoint.load(path)
    return checkpoint.encode(data | {"optimizer": data["optimizer"] | {"state": {}}})


def pack(out: Path, into: Path, part: float) -> list[Path]:
    """Write INTO_<k>.tgz of about `part` bytes each (one job is never split); returns them.

    Raises UserError where `out` has no training."""
    jobs = sorted(p for p in out.glob("*/seed*") if p.is_dir() and any(p.glob("train_*/last.pt")))
    if not jobs:
        raise UserError(f"out={out}: holds no training (ROW/seedN/train_*/last.pt)")
    outputs.claim(into.parent, "into=", [p.name for p in into.parent.glob(f"{into.name}_*.tgz")])
    with outputs.staged(into.parent, "into=") as stage:
        names = [p.name for p in _archives(jobs, out, stage / into.name, part)]
    for k in itertools.count(len(names)):  # parts of a longer one, written here before
        old = into.with_name(f"{into.name}_{k}.tgz")
        if not old.exists():
            break
        old.unlink()
    return [into.with_name(name) for name in names]


def _archives(jobs: list[Path], out: Path, into: Path, part: float) -> list[Path]:
    written: list[Path] = []
    archive, size = None, 0
    for folder in jobs:
        last = done(folder).last
        files = {last: slim(last)} | {p: p.read_bytes() for n in BESIDE if (p := last.parent / n).exists()}
        files |= {p: p.read_bytes() for n in JUDGED for g in (f"*/{n}", f"at_*/*/{n}") for p in sorted(folder.glob(g))}
        files |= {p: p.read_bytes() for p in folder.glob("stopped_by_limit.json")}
        more = sum(len(b) for b in files.values())
        if archive is None or size + more > part:
            if archive is not None:
                archive.close()
            written.append(into.with_name(f"{into.name}_{len(written)}.tgz"))
            archive, size = tarfile.open(written[-1], "w:gz", compresslevel=6), 0
        size += more
        for path, data in files.items():
            entry = tarfile.TarInfo(str(path.relative_to(out)))
            entry.size, entry.mode = len(data), 0o644
            archive.addfile(entry, io.BytesIO(data))
    archive.close()
    return written


def unpack(prefix: Path, out: Path) -> int:
    """Put the files of PREFIX_<k>.tgz into `out`, none over one that is there; returns how many. Raises UserError where
    there are none."""
    parts = sorted(prefix.parent.glob(f"{prefix.name}_*.tgz"))
    if not parts:
        raise UserError(f"unpack={prefix}: no file {prefix.name}_0.tgz")
    out.mkdir(parents=True, exist_ok=True)
    try:
        return sum(_unpacked(part, out) for part in parts)
    except (tarfile.TarError, EOFError, zlib.error, OSError) as error:
        raise UserError(f"unpack={prefix}: an archive is cut off or damaged ({error}); what was whole is in"
                        f" {out}") from None


def _unpacked(part: Path, out: Path) -> int:
    """Files of one archive that were put into `out`."""
    count = 0
    with tarfile.open(part) as archive:
        for entry in archive:
            if not entry.isfile() or (out / entry.name).exists():
                continue
            # a cut archive leaves no half of a file
            with tempfile.TemporaryDirectory(prefix=".unpack-", dir=out) as beside:
                archive.extract(entry, beside, filter="data")
                to = out / entry.name
                to.parent.mkdir(parents=True, exist_ok=True)
                if to.name in JUDGED:  # a result of ours: judged again further on, it may be written over
                    with outputs.staged(to.parent) as stage:
                        os.replace(Path(beside) / entry.name, stage / to.name)
                else:
                    os.replace(Path(beside) / entry.name, to)
            count += 1
    return count


def main(argv: list[str]) -> int:
    own, rest = tools.split(argv, OWN)
    if rest:
        raise UserError(f"{rest[0]}: not a setting; valid: {', '.join(OWN)} (key=value)")
    if own["out"] == "null" or (own["into"] == "null") == (own["unpack"] == "null"):
        raise UserError("say out=FOLDER of the table and either into=PREFIX or unpack=PREFIX of the archives")
    out = Path(own["out"]).expanduser().absolute()
    if own["unpack"] != "null":
        print(json.dumps({"unpacked": unpack(Path(own["unpack"]).expanduser().absolute(), out), "out": str(out)}))
        return 0
    try:
        part = float(own["part_mb"]) * 2**20
    except ValueError:
        part = 0.0
    if not part > 0:
        raise UserError(f"part_mb={own['part_mb']}: must be a number above 0 (MiB)")
    for path in pack(out, Path(own["into"]).expanduser().absolute(), part):
        print(f"{path}: {path.stat().st_size / 2**20:.1f} MiB")
    return 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:], __doc__))
