"""Writes the results page from the measured figures in `docs/results/data/`.

    python -m tools.results         # write docs/results/index.md and docs/results/schema.json
    python -m tools.results check   # fail where they differ from the data

One JSON file holds one topic. `docs/results/schema.json` describes the format; `record` adds a measurement from a
benchmark. Nobody types a figure into the page.
"""

from __future__ import annotations

import datetime
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
LONGEST = 400  # lines of the page

INTRODUCTION = """\
# Results

Today's figures, one command each. This page is written by `python -m tools.results` from the files in
`docs/results/data/`, which the benchmarks fill. Older figures, earlier seeds and what was tried are in the
folder `lab/` of the repository.

- All figures are of simulation, but for those under "Real recordings".
- *Range* is the smallest and the largest value over the seeds. *95 %* and *90 %* are intervals, by bootstrap or by
  Wilson's formula.
- *Aim* was set before the measurement, unless the line says "compared with".
- *Kept out* means: no training, fit or choice has seen these shapes, seeds or recordings.
- The version is the commit that was measured; "up to" names the first commit that shows the figure, where the measured
  one was not recorded.
"""

Line = Annotated[str, Meta(min_length=1, pattern="^[^\\n|]*$")]


class Figure(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """One line of a table: a value, or one value per seed."""

    name: Annotated[Line, Meta(description="What was measured, in the words of the field.")]
    value: Annotated[
        float | int | str | None,
        Meta(description='The result: a number, or short text such as "19 of 20". Absent with by_seed.'),
    ] = None
    unit: Annotated[str, Meta(description="%, N, mrad, s, ...; empty for a count or a ratio.")] = ""
    low: Annotated[float | int | None, Meta(description="Lower end of the interval, in the same unit.")] = None
    high: Annotated[float | int | None, Meta(description="Upper end of the interval, in the same unit.")] = None
    interval: Annotated[str, Meta(description='What low and high are, such as "95 %". Needed with them.')] = ""
    by_seed: Annotated[
        dict[str, float | int] | None,
        Meta(description="One value per seed. The page shows the mean, the range and the number of seeds."),
    ] = None
    aim: Annotated[str, Meta(description='Aim set beforehand ("95"), or "compared with ..." and another figure.')] = ""

    def __post_init__(self) -> None:
        if (self.value is None) == (self.by_seed is None):
            raise ValueError(f"{self.name}: give either value or by_seed")
        if (self.low is None) != (self.high is None) or (self.low is None) != (not self.interval):
            raise ValueError(f"{self.name}: low, high and interval belong together")
        if self.by_seed is not None and (len(self.by_seed) < 2 or self.low is not None):
            raise ValueError(f"{self.name}: by_seed needs two seeds or more, and no low and high")
        if isinstance(self.value, float | int) and self.low is not None and self.high is not None:
            if not self.low <= self.value <= self.high:
                raise ValueError(f"{self.name}: {self.value} is outside {self.low} to {self.high}")


class Measurement(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """The figures of one command on one machine on one day."""

    what: Annotated[Line, Meta(description="Heading of the table. A new measurement of the same name replaces it.")]
    command: Annotated[str, Meta(min_length=1, description="The command that anyone can run, on one line.")]
    date: Annotated[datetime.date, Meta(description="Day of the measurement, YYYY-MM-DD.")]
    hardware: Annotated[Line, Meta(description='Such as "one NVIDIA H200", and what else the machine did.')]
    version: Annotated[Line, Meta(description="Commit that was measured, as `git log` abbreviates it.")]
    figures: Annotated[list[Figure], Meta(min_length=1, description="Lines of the table.")]
    note: Annotated[str, Meta(description="One to three short sentences that a reader needs to judge the figures.")] = (
        ""
    )


class Topic(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """One file of `docs/results/data/`: one section of the page."""

    title: Annotated[Line, Meta(description="Heading of the section.")]
    order: Annotated[int, Meta(description="Sections are sorted by it, smallest first; leave gaps of 10.")]
    about: Annotated[str, Meta(min_length=1, description="What this is about, in one to three short sentences.")]
    measurements: Annotated[list[Measurement], Meta(description="Tables of the section, in this order.")]


def read(path: Path) -> Topic:
    """Return the topic in a data file. Raises ValueError naming file, field and fault."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=Topic)
    except (msgspec.DecodeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None


def topics(folder: Path = RESULTS / "data") -> dict[str, Topic]:
    """Return all topics by file name without extension, in the order of the page."""
    found = {path.stem: read(path) for path in folder.glob("*.json")}
    return dict(sorted(found.items(), key=lambda item: (item[1].order, item[0])))


def record(topic: str, measurement: Measurement, folder: Path = RESULTS / "data") -> Path:
    """Add a measurement to a topic, in the place of the one of the same name; return the file."""
    path = folder / f"{topic}.json"
    whole = read(path)
    names = [m.what for m in whole.measurements]
    if measurement.what in names:
        whole.measurements[names.index(measurement.what)] = measurement
    else:
        whole.measurements.append(measurement)
    path.write_bytes(msgspec.json.format(msgspec.json.encode(whole), indent=1) + b"\n")
    return path


def number(value: float | int | str) -> str:
    """Return a value as the page shows it: thousands with commas, no digit added or lost."""
    if isinstance(value, str):
        return value
    return f"{value:,}" if isinstance(value, int) or abs(value) >= 1e-4 or value == 0 else f"{value:g}"


def cells(figure: Figure) -> tuple[str, str, str, str]:
    """Return a figure's line: name, result, interval or range, aim."""
    unit = f" {figure.unit}" if figure.unit else ""
    if figure.by_seed is not None:
        values = list(figure.by_seed.values())
        digits = max(len(str(v).partition(".")[2]) for v in values)
        mean = f"{statistics.fmean(values):,.{digits}f}"
        spread = f"{number(min(values))} to {number(max(values))}, range of {len(values)} seeds"
        return figure.name, mean + unit, spread, figure.aim
    spread = f"{number(figure.low)} to {number(figure.high)} ({figure.interval})" if figure.interval else ""
    assert figure.value is not None
    return figure.name, number(figure.value) + unit, spread, figure.aim


def section(topic: Topic) -> list[str]:
    """Return the lines of a topic's section: one table for all its measurements, then how each was made."""
    lines = [f"## {topic.title}", "", topic.about, "", "| | result | range or interval | aim |", "|---|---|---|---|"]
    for m in topic.measurements:
        lines += [f"| **{m.what}** | | | |", *(f"| {' | '.join(cells(f))} |" for f in m.figures)]
    lines.append("")
    for m in topic.measurements:
        made = f"`{m.command}`, {m.date.day} {m.date:%B %Y}, {m.hardware}, version {m.version}."
        lines.append(f"- **{m.what}**: {made} {m.note}".rstrip())
    return [*lines, ""]


def page(found: Sequence[Topic]) -> str:
    """Return the results page."""
    return "\n".join([INTRODUCTION, *(line for topic in found for line in section(topic))]).rstrip() + "\n"


def schema() -> str:
    """Return the JSON schema of a data file."""
    return msgspec.json.format(msgspec.json.encode(msgspec.json.schema(Topic)), indent=1).decode() + "\n"


def outputs() -> dict[Path, str]:
    """Return what the files made from the data must hold. Raises ValueError for faulty data or a page too long."""
    text = page(list(topics().values()))
    if text.count("\n") > LONGEST:
        raise ValueError(f"the results page has {text.count(chr(10))} lines; at most {LONGEST}: move figures to lab/")
    return {RESULTS / "index.md": text, RESULTS / "schema.json": schema()}


def main(argv: Sequence[str]) -> int:
    """Write the page, or check it; return the exit status."""
    if argv not in ([], ["check"]):
        print(__doc__)
        return 2
    try:
        made: dict[Path, Any] = outputs()
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    stale = [path for path, text in made.items() if not path.is_file() or path.read_text("utf-8") != text]
    if argv and stale:
        print(f"error: {stale[0]} differs from the data; run python -m tools.results", file=sys.stderr)
        return 1
    for path in stale:
        path.write_text(made[path], encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
