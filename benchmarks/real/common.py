"""Helpers of the converters: what each returns, a recording from arrays, a model and its servo."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dexsim.recording import Recording, Series, States, schema, write


@dataclass
class Converted:
    """Converted files of a data set, or a part of it. groups: its recordings by gain or by run, where there are such.
    late: motions whose commands were logged a period late, and are put right. name, judged: of a part, and its joints
    that are judged (None: all that are driven)."""

    recordings: list[Path]
    model: Path
    servo: Path
    held_out: list[Path] = field(default_factory=list)
    groups: dict[Any, list[Path]] = field(default_factory=dict)
    late: list[str] = field(default_factory=list)
    name: str = ""
    judged: tuple[str, ...] | None = None


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
    tactile=None,
    cell=None,
    start=1.0,
    **meta: Any,
) -> Path:
    """Write arrays (commands [K, J], samples [S, J], times in s) as a recording of a real machine. tactile [S, F, K, 3]
    counts, cell [S, 6] N, N.m on the indenter: of a press rig, whose messages state their times too."""
    stated = schema.DEFAULTS | {
        "schema": "1",
        "source": "real",
        "joint_names": ",".join(joints),
        "effort_is": "none" if effort is None else "torque_Nm",
    }

    def series(x, topic, at=t, frame="", stamped=tactile is not None):
        at = np.asarray(at, float)
        return None if x is None else Series(at, np.asarray(x, float), topic, at.copy() if stamped else None, frame)

    recording = Recording(
        path=path,
        meta=stated | {k: str(value) for k, value in meta.items()},
        joints=joints,
        commands=series(cmd, schema.COMMANDS, t_cmd),
        states=States(series(q, schema.STATES), series(v, schema.STATES), series(effort, schema.STATES)),
        temperature=series(temperature, schema.TEMPERATURES),
        duty=series(duty, schema.DUTY),
        enabled=series(enabled, schema.ENABLED),
        supply_voltage=series(supply, schema.SUPPLY),
        tactile=series(tactile, schema.TACTILE, stamped=False),
        external_force=series(cell, schema.EXTERNAL_FORCE, frame="indenter"),
        start_ns=int(1e9 * start),
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write(path, recording)
    return path


def rig(out: Path, name: str, model: str, servo: dict) -> tuple[Path, Path]:
    """Return a model and its servo, written to out/NAME.xml and out/NAME.yaml."""
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{name}.xml").write_text(model, encoding="utf-8")
    (out / f"{name}.yaml").write_text(yaml.safe_dump(servo, sort_keys=False), encoding="utf-8")
    return out / f"{name}.xml", out / f"{name}.yaml"
