"""The start-up printout: versions, and what an environment holds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dexsim.cli import machine
from dexsim.console.tables import table


def versions_line() -> str:
    """Return one line: dexsim 0.1.0 | python 3.11.2 | torch ... ."""
    return " | ".join(f"{name} {number}" for name, number in machine.versions().items())


def describe_env(tables: dict[str, Any]) -> str:
    """Return the tables of ``env.describe()``: observations by group, action, rewards, terminations, randomization;
    then its notes."""
    parts = []
    for group, rows in tables.get("observations", {}).items():
        total = sum(int(row[1]) for row in rows)
        parts.append(table(f"observations of the {group} ({total})", ("name", "size", "unit"), _fit(rows, 3)))
    for key, title, header in (
        ("action", "action", ("name", "low", "high", "unit")),
        ("rewards", "rewards", ("term", "weight", "what")),
        ("terminations", "terminations", ("name", "what")),
        ("randomization", "randomization", ("name", "range", "unit")),
    ):
        if rows := tables.get(key):
            rows = [row if isinstance(row, (list, tuple)) else (row,) for row in rows]
            parts.append(table(f"{title} ({len(rows)})", header, _fit(rows, len(header))))
    if notes := tables.get("notes"):
        parts.append("\n".join(notes))
    return "\n\n".join(parts)


def _fit(rows: Sequence[Sequence[Any]], width: int) -> list[list[Any]]:
    """Return rows cut or filled up with empty cells to ``width``."""
    return [[*row, *[""] * width][:width] for row in rows]
