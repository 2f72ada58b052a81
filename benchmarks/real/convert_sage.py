"""SAGE's SO-101 follower arm (github.com/isaac-sim2real/sage, Apache-2.0): six servos, thirty motions at 50 Hz."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.real.common import dump, save
from dexsim.errors import UserError

JOINTS = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")
JAW = 2.34  # rad per unit of the jaw's 0..1
# Figures that others use for this arm; none was measured on it. kp is disputed: believed only within a wide range.
SERVO = {
    "drive": "torque",
    "joints": {"*": {
        "kp": {"value": 17.8, "low": 5.0, "high": 200.0}, "torque_limit": {"value": 2.94, "low": 1.5, "high": 4.0},
        "kd": {"value": 0.6, "low": 0.05, "high": 20.0}, "coulomb_friction": 0.052,
    }},
}  # fmt: skip


@dataclass
class Sage:
    """Converted files."""

    recordings: list[Path]
    held_out: list[Path]
    model: Path
    servo: Path


def convert(data: Path, out: Path, held: int = 10) -> Sage:
    """Converts the npz files of the motions; every third, up to `held`, is kept out."""
    files = sorted(data.glob("*.npz"))
    model = data / "so101.xml"
    if not files or not model.is_file():
        raise UserError(f"{data}: needs the motions (*.npz) and so101.xml")
    servo = dump(out / "so101.yaml", SERVO)
    made = []
    for path in files:
        raw = np.load(path)
        scale = np.r_[np.ones(5), JAW]
        made.append(save(out / f"{path.stem}.mcap", JOINTS, raw["t_cmd"], raw["cmd"] * scale, raw["t"], raw["pos"] * scale, robot="so101",
                         gravity="0 0 -9.81"))  # fmt: skip
    kept = made[2::3][:held]
    return Sage([p for p in made if p not in kept], kept, model, servo)
