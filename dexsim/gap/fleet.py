"""Diagnose many machines of one type, each from the recordings in its own folder, and compare them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from dexsim import files, outputs
from dexsim.console import jobs
from dexsim.errors import UserError
from dexsim.gap.report.files import ENVIRONMENT, VERDICTS, plain

RECORDINGS = (".mcap", ".csv", ".tsv", ".npz", ".h5", ".hdf5")
OWN = (("model", ("model.xml", "model.urdf")), ("servo", ("servo.yaml",)))
"""Files that a machine's folder may hold in the place of the command's model= and servo=."""
RESULT = "diagnosis.json"
Value = tuple[float, float, float]
"""A size, and the ends of its interval."""


@dataclass(frozen=True)
class Cell:
    """What was found of one effect at one place of one machine. size: its first number, None where it has none; unit of
    it; hint: below the confidence at which it is named. apart: the size's interval lies beyond those of the others'
    middle. moved: it lies beyond that of the earlier diagnosis, or is new since."""

    confidence: float
    hint: bool
    size: Value | None
    unit: str
    apart: bool = False
    moved: bool = False


@dataclass(frozen=True)
class Row:
    """One effect at one place over the fleet: cells by machine, and in words which have it."""

    effect: str
    place: str
    cells: dict[str, Cell]
    words: str
    kind: str


def run(argv: list[str], given: Mapping[str, Any]) -> int:
    """Diagnose every folder that `fleet=` names, write the page; returns 0, or 1 where one could not be diagnosed.
    argv: of `dexsim diagnose`. Raises UserError."""
    engine, rest = jobs.taken(argv)
    out = files.place(given.get("out", "out/fleet"))
    before = files.place(given["before"]) if "before" in given else None
    if before is not None and not before.is_dir():
        raise UserError(f"before={before}: must be the folder of an earlier diagnosis of this fleet")
    units = machines(str(given["fleet"]))
    outputs.claim(out, "out=", ("report.html", "fleet.json", "jobs", *units), [p for ps in units.values() for p in ps])
    rest = [a for a in rest if a.partition("=")[0] not in ("fleet", "before", "out", "recordings")]
    work = []
    for name, recordings in units.items():
        settings = [a for a in rest if a.partition("=")[0] not in (own := _own(recordings[0].parent))]
        listed = "[" + ",".join(str(p.resolve()) for p in recordings) + "]"
        command = ("diagnose", f"recordings={listed}", f"out={out.resolve() / name}", *settings)
        work.append(jobs.Job(((*command, *(f"{k}={v}" for k, v in own.items())),), out.resolve() / name))
        work[-1].note.unlink(missing_ok=True)  # of an earlier run
    print(f"{len(work)} machines: {', '.join(units)}", flush=True)
    status = dict(zip(units, jobs.run(work, engine)))
    found = {name: read(out / name) for name in units if status[name] == 0}
    failed = {job.folder.name: _last(job) for job in work if status[job.folder.name]}
    rows = compare(found, {n: read(before / n) for n in found if (before / n / RESULT).is_file()} if before else {})
    data = {
        "machines": {n: d["verdict"] for n, d in found.items()}, "failed": failed,
        "rows": [{"effect": r.effect, "place": r.place, "words": r.words,
                  "machines": {n: vars(c) for n, c in r.cells.items()}} for r in rows],
    }  # fmt: skip
    with files.beside(out / "fleet.json") as part:
        part.write_text(json.dumps(plain(data), indent=1), "utf-8")
    with files.beside(out / "report.html") as part:
        part.write_text(page(found, failed, rows), "utf-8")
    print()
    for row in rows:
        print(f"  {row.effect.replace('_', ' ')} @ {row.place}: {row.words}")
    for name, d in found.items():
        if d["verdict"] == "unusable":
            print(f"  {name}: cannot be judged, its page says why")
    for name, why in failed.items():
        print(f"  {name}: not diagnosed: {why}")
    print(f"\n{out / 'report.html'}\n{out / 'fleet.json'}")
    return 1 if failed else 0


def machines(pattern: str) -> dict[str, list[Path]]:
    """Return recordings by machine: of every folder that a pattern names, those of its most frequent format. Raises
    UserError where there is none."""
    root = files.place(pattern)
    folders = sorted(p for p in Path(root.anchor or ".").glob(str(root.relative_to(root.anchor))) if p.is_dir())
    found = {}
    for folder in folders:
        by_format = [sorted(p for p in folder.iterdir() if p.suffix.lower() == s) for s in RECORDINGS]
        by_format.append(sorted(p.parent for p in folder.glob("*/metadata.yaml")))  # bags of ROS 2
        if best := max(by_format, key=len):
            if folder.name in found:
                raise UserError(f"fleet={pattern}: two folders are named {folder.name}; give each machine its own name")
            found[folder.name] = best
    if not found:
        raise UserError(f"fleet={pattern}: no folder with recordings ({', '.join(RECORDINGS)} or ROS 2 bags) in it")
    return found


def _own(folder: Path) -> dict[str, Path]:
    return {key: (folder / n).resolve() for key, names in OWN for n in names if (folder / n).is_file()}


def _last(job: jobs.Job) -> str:
    """Return the line that says why a job failed."""
    text = job.note.with_suffix(".txt")
    lines = text.read_text("utf-8", "replace").strip().splitlines() if text.is_file() else []
    return next((line for line in reversed(lines) if line.startswith("error:")), lines[-1] if lines else "lost")


def read(folder: Path) -> dict[str, Any]:
    """Return a machine's diagnosis.json. Raises UserError for a damaged one."""
    try:
        data = files.mapping(folder / RESULT, "diagnosis", 64 << 20)
        cells_of(data)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{folder / RESULT}: damaged ({type(error).__name__}: {error}); diagnose it again") from None
    return data


def cells_of(data: Mapping[str, Any]) -> dict[tuple[str, str], Cell]:
    """Return what a diagnosis found, by effect and place."""
    found = {}
    for f in data["findings"]:
        where = f["where"]
        place = ", ".join(where["joints"] or where["taxels"] or where["topics"]) or "everywhere"
        numbers = [p for p in f.get("parameters", {}).values() if isinstance(p["value"], (int, float))]
        size, unit = None, ""
        if numbers:
            p = numbers[0]
            size, unit = (float(p["value"]), float(p["low"]), float(p["high"])), "" if p["unit"] == "1" else p["unit"]
        found[f["effect"], place] = Cell(float(f["confidence"]), bool(f.get("hint", False)), size, unit)
    return found


def compare(found: Mapping[str, Mapping[str, Any]], before: Mapping[str, Mapping[str, Any]]) -> list[Row]:
    """Return rows of the fleet, those first in which machines differ. found, before: diagnosis.json by machine."""
    cells = {name: cells_of(data) for name, data in found.items() if data["verdict"] != "unusable"}
    earlier = {name: cells_of(data) for name, data in before.items()}
    rows = []
    for effect, place in dict.fromkeys(key for own in cells.values() for key in own):
        have = {name: own[effect, place] for name, own in cells.items() if (effect, place) in own}
        sizes = {name: c.size for name, c in have.items() if c.size is not None}
        marked = {
            name: Cell(c.confidence, c.hint, c.size, c.unit, _apart(name, sizes),
                       name in earlier and _moved(c, earlier[name].get((effect, place))))
            for name, c in have.items()
        }  # fmt: skip
        rows.append(_row(effect, place, marked, list(cells)))
    return sorted(rows, key=lambda r: (("moved", "some", "apart", "all").index(r.kind), r.place, r.effect))


def _apart(name: str, sizes: Mapping[str, Value]) -> bool:
    """Return whether a machine's interval lies beyond the middle one of the others, which are two or more."""
    others = [v for n, v in sizes.items() if n != name]
    if name not in sizes or len(others) < 2:
        return False
    low, high = (median(v[k] for v in others) for k in (1, 2))
    return sizes[name][1] > high or sizes[name][2] < low


def _moved(now: Cell, then: Cell | None) -> bool:
    if then is None:
        return not now.hint
    return now.size is not None and then.size is not None and (now.size[1] > then.size[2] or now.size[2] < then.size[1])


def _row(effect: str, place: str, cells: dict[str, Cell], everyone: list[str]) -> Row:
    """Return a row with its words: of the type, of some machines, of one, another size, moved since."""
    apart, moved = ([n for n, c in cells.items() if getattr(c, what)] for what in ("apart", "moved"))
    if len(cells) == len(everyone) > 1:
        words, kind = f"all {len(everyone)} machines: what is believed of the type is wrong", "all"
    elif len(cells) == 1 < len(everyone):
        words, kind = f"only {next(iter(cells))}", "some"
    elif len(everyone) == 1:
        words, kind = next(iter(cells)), "all"
    else:
        words, kind = f"{len(cells)} of {len(everyone)} machines: {', '.join(cells)}", "some"
    if apart:
        words += f"; another size in {', '.join(apart)}"
        kind = "apart" if kind == "all" else kind
    if moved:
        words, kind = f"{words}; drifted since: {', '.join(moved)}", "moved"
    return Row(effect, place, cells, words, kind)


def page(found: Mapping[str, Mapping[str, Any]], failed: Mapping[str, str], rows: list[Row]) -> str:
    """Return the page that compares them."""
    units = [{"name": n} | dict(zip(("word", "tone"), VERDICTS[d["verdict"]])) for n, d in found.items()]
    return ENVIRONMENT.get_template("fleet.html").render(units=units, failed=failed, rows=rows)
