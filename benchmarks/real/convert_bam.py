"""BAM's XL330 pendulum (github.com/Rhoban/bam, Apache-2.0): one small servo, a 0.49 kg mass at 0.1 m, four gains times
four motions."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import yaml

from benchmarks.real.common import Converted, rig, save
from dexsim.errors import UserError

MODEL = """<mujoco model="bam_pendulum">
  <compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <joint name="joint" type="hinge" axis="0 1 0" armature="0.001"/>
      <geom name="mass" type="sphere" size="0.005" pos="0 0 -0.1" mass="0.49" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>
"""
# From the datasheet at 5 V (0.52 N.m, 104 rpm), carried to 7.4 V; this servo is not one that was measured, and the
# datasheet
# does not cover 7.4 V. Nothing is known of its friction.
SERVO = {
    "drive": "voltage",
    "joints": {
        "*": {
            "kp": 0.29,
            "torque_limit": {"value": 0.77, "low": 0.35, "high": 1.5},
            "no_load_speed": {"value": 16.1, "low": 8.0, "high": 60.0},
            "coulomb_friction": "unknown",
            "viscous_friction": "unknown",
        }
    },
    "supply_voltage": 7.4,
}
DUTY_PER_RAD = (4096 / (2 * np.pi)) / (256 * 885)  # the firmware's law: duty = kp_register * error * this


def convert(data: Path, out: Path) -> Converted:
    """Convert the folder of BAM's raw JSON files (its `raw/` or the folder that holds it); groups: by gain register."""
    folder = data / "raw" if (data / "raw").is_dir() else data
    files = sorted(folder.glob("*.json"))
    if not files:
        raise UserError(
            f"{data}: no BAM recordings (*.json); give the folder that holds bam/data.bak/raw of github.com/Rhoban/bam"
        )
    model, servo = rig(out, "rig", MODEL, SERVO)
    made, gains = [], {}
    for path in files:
        raw = json.loads(path.read_text(encoding="utf-8"))
        column = lambda key, entries=raw["entries"]: np.array([e[key] for e in entries], float)  # noqa: E731
        t = column("timestamp")
        keep = np.r_[True, np.diff(t) > 1e-5]
        load = column("load")
        duty = np.where(load > 32767, load - 65536, load) / 885.0
        pick = lambda x, keep=keep: x[keep][:, None]  # noqa: E731
        kp = raw["kp"] * DUTY_PER_RAD
        made.append(
            save(
                out / f"{path.stem}.mcap",
                ("joint",),
                t[keep],
                pick(column("goal_position")),
                t[keep],
                pick(column("position")),
                v=pick(column("speed")),
                duty=pick(duty),
                temperature=pick(column("temp")),
                enabled=pick(column("torque_enable")),
                supply=column("input_volts")[keep],
                robot="bam_xl330",
                gravity="0 0 -9.81",
                servo=yaml.safe_dump({"joints": {"joint": {"kp": float(kp)}}}),
                notes=f"{raw['trajectory']}, gain register {raw['kp']}",
            )
        )
        gains.setdefault(int(raw["kp"]), []).append(made[-1])
    return Converted(made, model, servo, groups=gains)
