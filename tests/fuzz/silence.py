"""Wrong in silence: what a damaged file was taken for, against what it says and what was in it before the damage.

A file of settings that is taken must be taken as it stands: each value of it is there again in what was loaded (nothing
left out, nothing set to another value), or it is refused. A recording that is used must be used as it was before the
damage, or something must be said of the signal that differs. A text file (CSV) carries no checksum, so that another
digit is another number: of those nothing is asked. Nor of what a recording's own metadata says (degrees, signs): that
is its word.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dexsim import typed
from dexsim.gap.read import Run
from dexsim.recording.schema import COMMANDS, STATES, Recording

from . import corpus

TOLERANCE = 0.03
"""rad, or 0.03 of a second's worth of motion: what sampling and interpolation may change."""
POSSIBLE = np.pi
"""rad, of the sound recordings' joints."""
SETTLED = 0.05
"""s at the start, in which the sound recordings' positions are those of their end (they were rolled)."""
START_NS = 1_700_000_000_000_000_000
FEW = 20
"""Samples of a topic from which on its clock is compared with another's (`recording.audit_time.between_topics`)."""
SHIFTS = (-3.0, 3.0, 600.0)
"""s by which `mutate.values` moves times."""
ABOUT_NUMBERS = ("position_unit", "time_unit")
"""Metadata by which numbers are read otherwise; the sound recordings have none."""


def signal(t: np.ndarray) -> np.ndarray:
    """Return the targets [T, 2] rad of the sound recordings at t [s]; their positions are 0.03 s behind."""
    return np.stack([0.3 * np.sin(3 * t), 0.2 * np.cos(2 * t)], 1)


def of_recording(path: Path, r: Recording, runs: list[Run], words: set[tuple[str, str]]) -> str:
    """Return what is wrong and was not said; "" where nothing is. words: (topic, kind) of all that was said."""
    if path.suffix == ".csv" or any(r.meta.get(k) for k in ABOUT_NUMBERS):
        return ""
    shift = 1e-9 * (r.start_ns - START_NS) if path.suffix == ".mcap" else 0.0
    for run in runs:
        columns = [corpus.JOINTS.index(j) for j in run.joints]
        for what, topic, t, x, behind in (
            ("position", STATES, run.t, run.q, 0.03), ("command", COMMANDS, run.cmd_t, run.cmd, 0.0)
        ):  # fmt: skip
            true = signal(t + shift - behind)[:, columns]
            off = np.abs(x - true) > TOLERANCE
            off[t + shift < SETTLED] = False
            off[:, [k for k, j in enumerate(run.joints) if j in run.left_out]] = False
            values = np.unique(x[off])
            if len(values) == 1 and abs(values[0]) < POSSIBLE and off.any(1).mean() > 0.1:
                continue
            if min(len(r.commands), len(r.states.position)) < FEW and _shifted(t + shift, x, behind, columns):
                continue  # all times of a topic later or earlier: so few samples of the other do not show it
            if off.any() and not any(about in (topic, "") or kind == "clock_skew" for about, kind in words):
                i, j = (int(v) for v in np.argwhere(off)[0])
                return (f"{what} of {run.joints[j]} is {x[i, j]:.4g} at {t[i]:.4g} s, and was {true[i, j]:.4g} when it"
                        f" was recorded ({int(off.sum())} such samples); nothing is said of it")  # fmt: skip
    return ""


def _shifted(t: np.ndarray, x: np.ndarray, behind: float, columns: list[int]) -> bool:
    """Return whether values [T, J] are those of another time, all by as much."""
    return any(
        (np.abs(x - signal(t - s - behind)[:, columns])[t - s > SETTLED] < TOLERANCE).all() for s in SHIFTS
    )


def of_settings(said: Any, taken: Any, path: str = "") -> str:
    """Return the first value of a file's tree that is not, or is another, in what was taken; "" where all are there."""
    if isinstance(said, str) and np.isfinite(typed.real(said)):  # 1e3, text to YAML, is a number, as documented
        said = typed.real(said)
    if isinstance(said, Mapping) and isinstance(taken, (list, tuple)):  # a range
        said = [said.get("low"), said.get("high")]
    if isinstance(said, Mapping) and set(said) == {"value"} and not isinstance(taken, Mapping):
        said = said["value"]
    if isinstance(taken, (list, tuple)) and len(taken) == 2 and taken[0] == taken[1] and isinstance(said, (int, float)):
        taken = taken[0]  # a range of one number
    if isinstance(taken, Mapping) and isinstance(said, (list, tuple)):
        taken = [taken.get("low"), taken.get("high")]
    if isinstance(said, (int, float)) and isinstance(taken, Mapping) and set(taken.values()) == {said}:
        return ""  # one number for all joints
    if isinstance(said, Mapping):
        if not isinstance(taken, Mapping):
            return "" if not said else f"{path}={said!r} was taken for {taken!r}"
        by_name = {str(k): v for k, v in taken.items()}
        for key, value in said.items():
            where = f"{path}.{key}" if path else str(key)
            if str(key) not in by_name:
                if value is None or value == {} or value == []:
                    continue  # nothing is said
                return f"{where}={value!r} was left out"
            found = of_settings(value, by_name[str(key)], where)
            if found:
                return found
        return ""
    if isinstance(said, (list, tuple)):
        if not isinstance(taken, (list, tuple)) or len(taken) != len(said):
            return f"{path}={said!r} was taken for {taken!r}"
        return next(filter(None, (of_settings(a, b, f"{path}[{k}]") for k, (a, b) in enumerate(
            zip(said, taken, strict=True)))), "")  # fmt: skip
    if said is None or said == taken or str(said) == str(taken):
        return ""
    with contextlib.suppress(TypeError, ValueError):
        if math.isclose(float(said), float(taken), rel_tol=1e-6):
            return ""
    return f"{path}={said!r} was taken for {taken!r}"
