"""What a finger of ergoCub needs beside Coulomb and viscous friction: a free run of one body by NumPy that shares only
the reading of the data with the tool: python -m benchmarks.real.finger_spring DATA_DIR

    q'' = A duty(t - d) - B q' - F sign q' - k q - s        q >= 0, a stop

in units of the inertia. A, B, F alone (`plain`), then with the spring (k, s) and the age d of the readings, are fitted
by differential evolution to three of four clips of each run, from their first reading on, and judged on every fourth.
One line a run, then one JSON line.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.real.common import fitted
from benchmarks.real.convert_ergocub import FINGERS, KEPT, cycles
from dexsim.console.ending import guard
from dexsim.errors import UserError
from dexsim.gap.read import channels

STEP = 2e-3  # s
PERIOD = 0.05  # s from one reading of the position to the next
OLDEST = 0.2  # s
GENERATIONS = 60
BOUNDS = {  # exponents of ten, but for the age
    "drive": (0.7, 3.4),  # A, rad/s2 at full duty
    "damping": (0.0, 2.9),  # B, 1/s
    "friction": (-1.0, 2.8),  # F, rad/s2
    "stiffness": (-1.0, 3.4),  # k, 1/s2
    "preload": (-2.0, 2.8),  # s, rad/s2
    "age": (0.0, 0.16),  # d, s
}
PLAIN = ("drive", "damping", "friction")


@dataclass
class Clips:
    """Clips on one grid of `STEP` s: duty [R, n] from `OLDEST` before their first readings, first position and speed
    [R], and their readings [m]: clip, step, position."""

    duty: np.ndarray
    q0: np.ndarray
    v0: np.ndarray
    clip: np.ndarray
    step: np.ndarray
    q: np.ndarray


def load(folder: Path, name: str, kept: bool) -> Clips:
    """Clips of a run: every fourth (kept), or the others. UserError where the run is absent."""
    path = folder / f"{name}.npz"
    if not path.is_file():
        raise UserError(f"{path} does not exist; give the folder of the fingers' runs as npz")
    t, duty, q, clips = cycles(path)
    rows = []
    for a, b in [c for k, c in enumerate(clips) if (k % KEPT == KEPT - 1) == kept]:
        new = a + np.flatnonzero(~channels.between_readings(t[a:b], q[a:b], PERIOD))
        grid = np.arange(t[new[0]] - OLDEST, t[b - 1], STEP)
        held = duty[np.clip(np.searchsorted(t, grid, side="right") - 1, 0, len(t) - 1)]
        steps = np.round((t[new] - t[new[0]]) / STEP).astype(int)
        speed = (q[new[1]] - q[new[0]]) / (t[new[1]] - t[new[0]])
        rows.append((held, float(q[new[0]]), float(speed), steps, q[new]))
    n = max(len(r[0]) for r in rows)
    return Clips(
        np.stack([np.pad(r[0], (0, n - len(r[0])), mode="edge") for r in rows]),
        np.array([r[1] for r in rows]),
        np.array([r[2] for r in rows]),
        np.concatenate([np.full(len(r[3]), k) for k, r in enumerate(rows)]),
        np.concatenate([r[3] for r in rows]),
        np.concatenate([r[4] for r in rows]),
    )


def errors(x: np.ndarray, c: Clips) -> np.ndarray:
    """[C] rad rms of free runs with the candidates x [C, 6], in the order of `BOUNDS` (-inf: none)."""
    drive, damping, friction, stiff, preload = (10.0 ** v[:, None] for v in x.T[:5])
    late = np.round(x[:, 5] / STEP).astype(int)
    before = round(OLDEST / STEP)
    n = c.duty.shape[1] - before
    q, v = np.repeat(c.q0[None], len(x), 0), np.repeat(c.v0[None], len(x), 0)
    path = np.empty((n, *q.shape))
    for k in range(n):
        path[k] = q
        ahead = v + STEP * (drive * c.duty[:, k + before - late].T - preload - stiff * q)
        v = np.where(np.abs(ahead) <= STEP * friction, 0.0,
                     (ahead - np.sign(ahead) * STEP * friction) / (1 + STEP * damping))  # fmt: skip
        q = q + STEP * v
        v, q = np.where((q < 0) & (v < 0), 0.0, np.clip(v, -99, 99)), np.maximum(q, 0.0)
    return np.sqrt(((path[np.minimum(c.step, n - 1), :, c.clip] - c.q[:, None]) ** 2).mean(0))


def parameters(c: Clips, names: tuple[str, ...], seed: int = 0) -> np.ndarray:
    """[6] the parameters of these names fitted, the others absent."""
    bounds = [BOUNDS[n] if n in names else (0.0, 0.0) if n == "age" else (-9.0, -9.0) for n in BOUNDS]
    return fitted(lambda x: errors(x, c), bounds, GENERATIONS, seed)


def main(argv: list[str]) -> int:
    """Every run whose encoder lives and that has clips to keep out; returns the exit status."""
    if len(argv) != 1 or argv[0] in ("-h", "--help"):
        print(__doc__)
        return 0 if argv[:1] in (["-h"], ["--help"]) else 2
    folder, rows = Path(argv[0]).expanduser(), {}
    for name in (n for which in ("middle", "ring_little") for n in FINGERS[which] if n != "output"):
        fit, kept = load(folder, name, False), load(folder, name, True)
        rows[name] = {}
        for label, names in (("plain", PLAIN), ("spring", tuple(BOUNDS))):
            x = parameters(fit, names)
            rows[name][label] = {
                "fitted_mrad": round(1e3 * float(errors(x[None], fit)[0]), 1),
                "kept_out_mrad": round(1e3 * float(errors(x[None], kept)[0]), 1),
                "parameters": {n: float(f"{v if n == 'age' else 10**v:.3g}")
                               for n, v in zip(BOUNDS, x, strict=True) if n in names},
            }  # fmt: skip
        print(name, json.dumps(rows[name]), flush=True)
    print(json.dumps({"benchmark": "finger_spring", "runs": rows}))
    return 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:]))
