"""Current against torque, joint by joint: what a real milliampere presses, what a simulated newton-metre presses, and
the current that is worth a torque because both press equally hard.

Paper, "Current-Torque Calibration": F_real = alpha I, F_sim = beta tau; I / I_max and tau / tau_max stand for F /
F_max. The two halves press the same place in the same posture, so that the lever arm cancels: I = (beta / alpha) tau.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.calibration.line import Levels, LineFit, fit
from dexsim.calibration.presses import levels_of
from dexsim.errors import UserError
from dexsim.hand import Hand
from dexsim.recording.reader import read

UNIT = {"current_A": "A", "torque_Nm": "N.m"}


@dataclass
class Half:
    """The presses of one side: by joint its levels, its line and the file. unit of the effort; joints: the hand's;
    left_out: joint -> why."""

    unit: str
    joints: tuple[str, ...]
    levels: dict[str, Levels] = field(default_factory=dict)
    fits: dict[str, LineFit] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    lsb: float | None = None  # N a count that the forces were read with


def files_of(where: str | Sequence[str], key: str) -> list[Path]:
    """Return the recordings named by a folder (its *.mcap, else *.csv and *.npz), a file, or several separated by
    commas. Raises UserError."""
    parts = where.split(",") if isinstance(where, str) else list(where)
    out: list[Path] = []
    for part in parts:
        path = Path(part.strip()).expanduser()
        found = (
            [path]
            if path.is_file()
            else sorted(path.glob("*.mcap")) or sorted([*path.glob("*.csv"), *path.glob("*.npz")])
        )
        if not found:
            raise UserError(
                f"{key}={part.strip()}: no recording there (a .mcap, .csv or .npz file, or a folder of them)"
            )
        out += found
    return out


def half(
    paths: Sequence[Path], effort_is: str, hand: Hand, reading: dict[str, dict[str, str]] | None = None, seed: int = 0
) -> Half:
    """Read presses and fit each joint: from the recording that was made for it (notes say `press: joint=NAME`), else
    from the one in which it works hardest. Raises UserError if none shows a press."""
    out = Half(UNIT[effort_is], hand.joints)
    score: dict[str, tuple[bool, float]] = {}
    for path in paths:
        r = read(path, (reading or {}).get("remap"), (reading or {}).get("meta"), hand=hand)
        if r.effort_is != effort_is:
            raise UserError(
                f"{path}: its effort is {r.effort_is}, expected {effort_is}; correct it with meta.effort_is=...,"
                f" or give it as {'sim' if r.effort_is == 'torque_Nm' else 'real'}="
            )
        for f in r.findings:
            if f.severity == "error" or f.kind in ("lost_sign", "sign_mismatch", "saturation", "wrap"):
                out.notes.append(f"{path.name}: {f.severity}: {f.kind} {f.topic} {f.joint} {f.text}".replace("  ", " "))
        if r.meta["tactile_unit"] == "count":
            out.lsb = r.tactile_lsb
        made_for = re.search(r"press: joint=([^;\s]+)", r.meta.get("notes", ""))
        for joint, levels in levels_of(r, hand).items():
            rank = (made_for is not None and made_for[1] == joint, float(np.ptp(levels.effort)))
            if joint not in score or rank > score[joint]:
                score[joint] = rank
                out.levels[joint], out.files[joint] = levels, path.name
    if not out.levels:
        raise UserError(
            f"{', '.join(str(p) for p in paths[:3])}: no press found: commands (or the force) must hold still for 0.2 "
            "s at several levels while a fingertip presses with more than 0.3 N"
        )
    for joint in hand.joints:
        if joint not in out.levels:
            out.left_out[joint] = "no press of it in the recordings"
            continue
        line = fit(out.levels[joint], out.unit, seed)
        if line is None:
            out.left_out[joint] = f"only {len(out.levels[joint])} levels with contact"
        else:
            out.fits[joint] = line
    return out


def combine(real: Half | None, sim: Half | None) -> dict[str, dict[str, Any]]:
    """Return by joint what `calibration.yaml` states: alpha (N per A), beta (N per N.m), current_per_torque (A per
    N.m) with intervals, normalizations and reasons."""
    out: dict[str, dict[str, Any]] = {}
    one = real or sim
    for joint in one.joints if one else ():
        entry: dict[str, Any] = {}
        for name, symbol, side in (("real", "alpha", real), ("sim", "beta", sim)):
            if side is None:
                continue
            line = side.fits.get(joint)
            if line is None:
                entry[name] = {"linear": False, "why": [side.left_out.get(joint, "not fitted")]}
                continue
            entry[symbol] = line.table()["ratio"]
            entry[name] = line.table() | {"file": side.files[joint]}
        a, b = (None if s is None else s.fits.get(joint) for s in (real, sim))
        if a is not None:
            entry["current_max"] = float(f"{a.effort_max:.6g}")
            entry["force_max_real"] = float(f"{a.force_max:.6g}")
        if b is not None:
            entry["torque_seen"] = float(f"{b.effort_max:.6g}")
            entry["force_max_sim"] = float(f"{b.force_max:.6g}")
        if a is not None and b is not None and a.slope > 0 and b.slope > 0:
            # lines may miss zero by friction and gravity, which differ between the two: slopes compare what presses
            value = b.slope / a.slope
            wide = np.hypot(_relative(a), _relative(b))
            entry["current_per_torque"] = {"value": float(f"{value:.6g}"), "low": float(f"{value / (1 + wide):.6g}"),
                                           "high": float(f"{value * (1 + wide):.6g}")}  # fmt: skip
        if entry:
            out[joint] = entry
    return out


def _relative(f: LineFit) -> float:
    """Return half the width of the slope's interval over the slope."""
    return max(f.slope_high - f.slope, f.slope - f.slope_low) / f.slope
