"""How far each joint of SAGE's SO-101 lags at constant speed, read off the recordings with no model: python -m
benchmarks.real.sage_speed DATA_DIR

error = lag * speed + friction * sign(speed) + sag, by least squares over all motions, where the target moves steadily.
A position loop of stiffness kp lags by damping / kp: what kp and damping others state can be held against it. Commands
that were logged a period late (`sage_clock`) are put where they acted. One JSON line.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Collection
from pathlib import Path

import numpy as np

from benchmarks.real import sage_clock
from benchmarks.real.convert_sage import JOINTS
from benchmarks.real.sage_clock import JAW
from dexsim.console.ending import guard
from dexsim.errors import UserError

SLOWEST, FASTEST = 0.1, 1.0  # rad/s
STEADY = 1.0  # rad/s2: no more acceleration of the target than this
# SO-ARM100's own model files
PUBLISHED = {"kp 998.22, kv 2.731, damping 0.60": (2.731 + 0.60) / 998.22, "kp 17.8, damping 0.60": 0.60 / 17.8}


def lags(data: Path, late: Collection[str] = ()) -> dict[str, dict[str, float]]:
    """By joint: lag [s], friction and sag [rad of error], samples used. late: motions whose commands were logged a
    period late."""
    files = sorted(data.glob("*.npz"))
    if not files:
        raise UserError(f"{data}: no motions (*.npz); see benchmarks/real/convert_sage.py for where from")
    out = {}
    for j, name in enumerate(JOINTS):
        speeds, errors = [], []
        for path in files:
            raw = np.load(path)
            t, scale = raw["t"], JAW if name == "Jaw" else 1.0
            target = np.interp(
                t,
                raw["t_cmd"] - (np.median(np.diff(raw["t_cmd"])) if path.stem in late else 0.0),
                raw["cmd"][:, j] * scale,
            )
            v = np.gradient(np.convolve(np.pad(target, 4, mode="edge"), np.ones(9) / 9, "valid"), t)
            on = (np.abs(np.gradient(v, t)) < STEADY) & (np.abs(v) > SLOWEST) & (np.abs(v) < FASTEST)
            speeds.append(v[on])
            errors.append((target - raw["pos"][:, j] * scale)[on])
        v, e = np.concatenate(speeds), np.concatenate(errors)
        lag, friction, sag = np.linalg.lstsq(np.stack([v, np.sign(v), np.ones_like(v)], 1), e, rcond=None)[0]
        out[name] = {
            "lag_s": round(float(lag), 4),
            "friction_rad": round(float(friction), 4),
            "sag_rad": round(float(sag), 4),
            "samples": len(v),
        }
    return out


def main(argv: list[str]) -> int:
    """Prints the figures of each joint; returns the exit status."""
    if len(argv) != 1 or argv[0] in ("-h", "--help"):
        print(__doc__)
        return 0 if argv else 2
    data = Path(argv[0]).expanduser()
    late = [name for name, evidence in sage_clock.late(data).items() if evidence > sage_clock.SURE]
    print(
        json.dumps(
            {
                "joints": lags(data, late),
                "commands_logged_late": late,
                "lag_s_of_published": {k: round(v, 4) for k, v in PUBLISHED.items()},
            }
        )
    )
    return 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:], __doc__))
