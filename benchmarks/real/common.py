"""Helpers of the converters: a recording from arrays; and what the checks by NumPy do: a fit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dexsim.recording import Recording, Series, States, write
from dexsim.recording.schema import COMMANDS, DEFAULTS, DUTY, ENABLED, STATES, SUPPLY, TEMPERATURES

CANDIDATES = 8  # for each parameter


def save(
    path: Path,
    joints: tuple[str, ...],
    t_cmd: np.ndarray,
    cmd: np.ndarray,
    t: np.ndarray,
    q: np.ndarray,
    *,
    v=None,
    effort=None,
    duty=None,
    temperature=None,
    enabled=None,
    supply=None,
    **meta: Any,
) -> Path:
    """Writes arrays (commands [K, J], samples [S, J], times in s) as a recording of a real machine."""
    stated = DEFAULTS | {
        "schema": "1",
        "source": "real",
        "joint_names": ",".join(joints),
        "effort_is": "none" if effort is None else "torque_Nm",
    }

    def series(x, topic, at=t):
        return None if x is None else Series(np.asarray(at, float), np.asarray(x, float), topic)

    recording = Recording(
        path=path,
        meta=stated | {k: str(value) for k, value in meta.items()},
        joints=joints,
        commands=series(cmd, COMMANDS, t_cmd),
        states=States(series(q, STATES), series(v, STATES), series(effort, STATES)),
        temperature=series(temperature, TEMPERATURES),
        duty=series(duty, DUTY),
        enabled=series(enabled, ENABLED),
        supply_voltage=series(supply, SUPPLY),
        start_ns=1_000_000_000,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write(path, recording)
    return path


def dump(path: Path, content: dict) -> Path:
    """Return a YAML file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return path
