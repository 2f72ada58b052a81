"""The parts of each data set that are diagnosed, each by itself: what is fitted, and what is held out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from benchmarks.real.common import Converted


def igris(data: Path, out: Path, name: str) -> list[Converted]:
    """Return eight joints with either split of the segments, or two of them."""
    from benchmarks.real.convert_igris import JOINTS, PAIR, SPLITS, convert

    made = convert(data / "igris", out / f"recordings_{name}")
    held = SPLITS[name == "igris_other"]
    judging = [made.recordings[k] for k in held]
    rest = [p for p in made.recordings if p not in judging]
    judged = PAIR if name == "igris_pair" else JOINTS
    return [replace(made, name=name, recordings=rest, held_out=judging, judged=judged)]


def sage(data: Path, out: Path, name: str) -> list[Converted]:
    """Return six joints of an arm, each alone; ten of thirty motions held out."""
    from benchmarks.real.convert_sage import JOINTS, convert

    made = convert(data, out / f"recordings_{name}")
    return [replace(made, name=f"sage_{j}", judged=(j,)) for j in JOINTS]


def ergocub(data: Path, out: Path, name: str) -> list[Converted]:
    """Return the runs of each finger together, every third held out; with `runs` also each alone, every fourth clip
    of it held out."""
    from benchmarks.real.convert_ergocub import FINGERS, KEPT, convert, held_out

    made, parts = convert(data, out / f"recordings_{name}"), []
    if name == "runs":
        for run in (r for runs in FINGERS.values() for r in runs):
            held = made.groups[run][KEPT - 1 :: KEPT]
            rest = [p for p in made.groups[run] if p not in held]
            parts.append(replace(made, name=run, recordings=rest, held_out=held))
    for which, runs in FINGERS.items():
        judging = held_out(which)
        if judging:
            clips, held = ([p for r in runs if (r in judging) is x for p in made.groups[r]] for x in (False, True))
            parts.append(replace(made, name=f"ergocub_{which}", recordings=clips, held_out=held))
    return parts


def bam(data: Path, out: Path, name: str) -> list[Converted]:
    """Return one of four gains held out, each."""
    from benchmarks.real.convert_bam import convert

    made = convert(data, out / f"recordings_{name}")
    rest = {gain: [p for p in made.recordings if p not in made.groups[gain]] for gain in sorted(made.groups)}
    return [replace(made, name=f"bam_{g}", recordings=r, held_out=made.groups[g]) for g, r in rest.items()]


def panda(data: Path, out: Path, name: str) -> list[Converted]:
    """Return one trajectory, its last quarter held out."""
    from benchmarks.real.convert_panda import convert

    return [replace(convert(data, out / f"recordings_{name}"), name="panda")]


MAKE: dict[str, Callable[[Path, Path, str], list[Converted]]] = {
    "igris": igris, "igris_other": igris, "igris_pair": igris, "sage": sage, "ergocub": ergocub, "bam": bam,
    "panda": panda,
}  # fmt: skip
