"""Plain-text tables, and numbers as people read them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def table(title: str, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return a table of aligned columns; numbers to the right, text to the left, the last column unpadded."""
    cells = [[cell(v) for v in row] for row in rows]
    number = [all(isinstance(row[i], (int, float)) for row in rows) and bool(rows) for i in range(len(header))]
    widths = [
        max(len(str(h)), *(len(row[i]) for row in cells), 0) if cells else len(str(h)) for i, h in enumerate(header)
    ]

    def line(values: Sequence[str]) -> str:
        return (
            "  "
            + "  ".join(f"{v:>{w}}" if right else f"{v:<{w}}" for v, w, right in zip(values, widths, number)).rstrip()
        )

    return "\n".join([title, line([str(h) for h in header]), *(line(row) for row in cells)])


def cell(value: Any) -> str:
    """Return one value for reading: four significant digits, ranges as "low .. high"."""
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "-"}[value]
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, (list, tuple)):
        if len(value) == 2 and all(isinstance(v, (int, float)) for v in value):
            return f"{cell(value[0])} .. {cell(value[1])}"
        return ", ".join(cell(v) for v in value)
    return str(value)


def duration(seconds: float) -> str:
    """Return  "42 s", "3:07" (minutes) or "1:02:07" (hours)."""
    whole = int(round(seconds))
    if whole < 60:
        return f"{whole} s"
    minutes, rest = divmod(whole, 60)
    return f"{minutes}:{rest:02d}" if minutes < 60 else f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"


def count(value: float) -> str:
    """Return a large count in three digits: 950, 12.3k, 4.56M, 1.2G."""
    for scale, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= scale:
            return f"{value / scale:.3g}{letter}"
    return f"{value:.0f}"


def number(v: float, digits: int = 3) -> str:
    """Return v with so many digits, without an exponent where a person would not write one."""
    v = float(v)
    if v != 0 and not 1e-4 <= abs(v) < 1e6:
        return f"{v:.{digits}g}"
    if abs(v) >= 10 ** (digits - 1):
        return f"{round(v):,}"
    return f"{v:.{digits}g}"
