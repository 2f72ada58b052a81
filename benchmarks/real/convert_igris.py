"""IGRIS-C's legs (github.com/thenameisCha/pace-sim2real-igris, Apache-2.0): fourteen joints, one chirp of a minute at
300 Hz, cut into six segments of 10 s; loose beliefs, twins left and right."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from benchmarks.real.common import Converted, save
from dexsim.errors import UserError

SPLITS = ((2, 5), (0, 3))  # segments that are held out
PAIR = ("Joint_Hip_Yaw_Left", "Joint_Knee_Pitch_Left")
JOINTS = tuple(
    f"Joint_{name}_{side}" for side in ("Left", "Right") for name in ("Hip_Pitch", "Hip_Roll", "Hip_Yaw", "Knee_Pitch")
)


def convert(data: Path, out: Path) -> Converted:
    """Cut the chirp at its segments and write each as a recording of all fourteen joints."""
    if not (data / "chirp.npz").is_file() or not (data / "rig.xml").is_file():
        raise UserError(f"{data}: needs chirp.npz, rig.xml and servo.yaml")
    out.mkdir(parents=True, exist_ok=True)
    raw = np.load(data / "chirp.npz")
    joints, made = tuple(str(x) for x in raw["joints"]), []
    for k in range(6):
        on = raw["segment"] == k
        t = raw["time_s"][on] - raw["time_s"][on][0]
        made.append(
            save(
                out / f"s{k}.mcap",
                joints,
                t,
                raw["command_rad"][on],
                t,
                raw["position_rad"][on],
                robot="igris_c",
                gravity="0 0 -9.81",
            )
        )
    for name in ("rig.xml", "servo.yaml"):
        shutil.copyfile(data / name, out / name)
    return Converted(made, out / "rig.xml", out / "servo.yaml")
