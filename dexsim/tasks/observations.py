"""What simulation and real-time loop compute alike of the grasp's observation, and where rows lie in any."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

Numbers = TypeVar("Numbers")


def height_speed(z: Numbers, before: Numbers, period: float) -> Numbers:
    """Return finite difference [N] m/s of the measured height over one control period [s]."""
    return (z - before) / period  # type: ignore[operator]  # arrays of either library


def slices(table: Sequence[tuple[Any, ...]]) -> dict[str, slice]:
    """Return where each row of a table (name, width, ...) lies."""
    out, at = {}, 0
    for name, width, *_ in table:
        out[name] = slice(at, at + width)
        at += width
    return out
