"""Does a small servo's torque grow less than in proportion to its current? A free run of BAM's pendulum that shares no
code with the tool, by NumPy, one gain left out in turn: python -m benchmarks.real.bam_saturation DATA_DIR [plain]

    (m l^2 + J) q'' = tau - m g l sin q - friction
    tau = x / (1 + r |x|),  x = A (V / 7.4) duty - A / w0 q'        r = 0 (`plain`): a DC motor
    friction = Fc + b q' + (driving or back-driven fraction) |tau|

fitted by differential evolution on the other three gains (mean absolute error), from each recording's first sample. One
line a gain, then one JSON line.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.real.common import fitted
from benchmarks.real.convert_bam import DUTY_PER_RAD
from dexsim.console.ending import guard
from dexsim.errors import UserError

MASS, LENGTH, GRAVITY, VOLTS = 0.49, 0.1, 9.81, 7.4
STEP = 2e-3  # s
BOUNDS = {
    "stall_torque": (0.35, 1.5),  # N.m, at 7.4 V
    "no_load_speed": (8.0, 60.0),  # rad/s
    "rotor": (2e-4, 4e-3),  # kg.m2
    "coulomb": (0.0, 0.06),  # N.m
    "viscous": (0.0, 0.04),  # N.m.s/rad
    "load": (0.0, 0.8),
    "backdriven": (0.0, 3.0),
    "saturation": (0.0, 3.0),  # 1/N.m
}
GENERATIONS = 45


@dataclass
class Recorded:
    """Recordings on one grid of `STEP` s: goal, volts over 7.4, drive on, position [R, n] (NaN after the end), duty per
    rad [R], first position and speed [R]."""

    goal: np.ndarray
    volts: np.ndarray
    on: np.ndarray
    q: np.ndarray
    gain: np.ndarray
    register: np.ndarray
    q0: np.ndarray
    v0: np.ndarray

    def part(self, keep: np.ndarray) -> Recorded:
        """Some of the recordings."""
        return Recorded(**{k: x[keep] for k, x in vars(self).items()})


def load(folder: Path) -> Recorded:
    """All recordings of BAM's raw/; UserError where there is none."""
    folder = folder / "raw" if (folder / "raw").is_dir() else folder
    rows = []
    for path in sorted(folder.glob("*.json")):
        raw = json.loads(path.read_text(encoding="utf-8"))
        x = {
            k: np.array([e[k] for e in raw["entries"]], float)
            for k in ("timestamp", "goal_position", "input_volts", "torque_enable", "position")
        }
        t = x.pop("timestamp")
        keep = np.r_[True, np.diff(t) > 1e-5]
        t, x = t[keep], {k: v[keep] for k, v in x.items()}
        grid = np.arange(t[0], t[-1], STEP)
        held = np.clip(np.searchsorted(t, grid, side="right") - 1, 0, len(t) - 1)
        volts = np.convolve(np.pad(x["input_volts"][held], 25, mode="edge"), np.ones(51) / 51, "valid") / VOLTS
        speed = float(np.polyfit(t[:6] - t[0], x["position"][:6], 1)[0])
        rows.append((x["goal_position"][held], volts, x["torque_enable"][held], np.interp(grid, t, x["position"]),
                     raw["kp"], float(x["position"][0]), speed))  # fmt: skip
    if not rows:
        raise UserError(f"{folder}: no BAM recordings (*.json); give the folder that holds bam/data.bak/raw")
    n = max(len(r[0]) for r in rows)

    def wide(k, fill):
        return np.stack([np.pad(r[k], (0, n - len(r[k])), constant_values=fill) for r in rows])

    register = np.array([r[4] for r in rows])
    return Recorded(wide(0, 0.0), wide(1, 1.0), wide(2, 0.0), wide(3, np.nan), register * DUTY_PER_RAD, register,
                    np.array([r[5] for r in rows]), np.array([r[6] for r in rows]))  # fmt: skip


def errors(x: np.ndarray, r: Recorded) -> np.ndarray:
    """Mean absolute error [C, R] rad of free runs with the candidates x [C, 8], in the order of `BOUNDS`."""
    stall, free, rotor, coulomb, viscous, load_, back, soft = (c[:, None] for c in x.T)
    inertia, line = MASS * LENGTH**2 + rotor, stall / free
    q, v = np.repeat(r.q0[None], len(x), 0), np.repeat(r.v0[None], len(x), 0)
    total = np.zeros_like(q)
    for k in range(r.q.shape[1]):
        known = np.isfinite(r.q[:, k])
        total += np.where(known, np.abs(q - np.where(known, r.q[:, k], 0.0)), 0.0)
        drive = stall * r.volts[:, k] * np.clip(r.gain * (r.goal[:, k] - q), -1.0, 1.0)
        give = 1.0 / (1.0 + soft * np.abs(drive - line * v)) * (r.on[:, k] > 0.5)
        torque = give * (drive - line * v)
        level = coulomb + np.where(torque * v < 0, back, load_) * np.abs(torque)
        ahead = v + STEP / inertia * (give * drive - MASS * GRAVITY * LENGTH * np.sin(q))
        held = STEP / inertia * level
        damped = 1.0 + STEP / inertia * (viscous + give * line)
        v = np.where(np.abs(ahead) <= held, 0.0, (ahead - np.sign(ahead) * held) / damped)
        v = np.clip(v, -200.0, 200.0)
        q = q + STEP * v
    return total / np.isfinite(r.q).sum(1)


def fold(r: Recorded, register: int, plain: bool, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """(parameters [8] fitted on the other gains, errors [4] rad on the one that is left out)."""
    rest = r.part(r.register != register)
    bounds = [(0.0, 0.0) if plain and n == "saturation" else b for n, b in BOUNDS.items()]
    x = fitted(lambda c: errors(c, rest).mean(1), bounds, GENERATIONS, seed)
    return x, errors(x[None], r.part(r.register == register))[0]


def main(argv: list[str]) -> int:
    """Runs the four folds; returns the exit status."""
    if not argv or argv[0] in ("-h", "--help") or set(argv[1:]) - {"plain"}:
        print(__doc__)
        return 0 if argv[:1] in (["-h"], ["--help"]) else 2
    r, plain = load(Path(argv[0]).expanduser()), "plain" in argv
    every, rows = [], {}
    for register in np.unique(r.register).tolist():
        x, left = fold(r, register, plain)
        every += left.tolist()
        rows[register] = {"mae_mrad": round(1e3 * float(left.mean()), 1),
                          "parameters": dict(zip(BOUNDS, x.round(4).tolist(), strict=True))}  # fmt: skip
        print(f"gain {register} left out: {rows[register]}", flush=True)
    print(json.dumps({"benchmark": "bam_saturation", "plain": plain, "folds": rows,
                      "mae_mrad": round(1e3 * float(np.mean(every)), 1)}))  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:]))
