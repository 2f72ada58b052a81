"""SAGE's SO-101 follower arm (github.com/isaac-sim2real/sage, Apache-2.0): six servos, thirty motions at 50 Hz."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from benchmarks.real import sage_clock
from benchmarks.real.common import Converted, rig, save
from dexsim.errors import UserError

JOINTS = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")
# The arm stands on a table that its model does not have. In motions for the fit (dual_joint_elbow_wrist,
# hold_under_gravity,
# oscillation_med_freq) the wrist stalls tens of mrad short of its target, whatever its angle, wherever a fingertip
# would be lower than
# this and nowhere else: there it presses on the table, and a joint is judged while nothing is touched. Metres above the
# arm's base.
TABLE = -0.03
# m in the bodies' frames, read off the arm's drawings
TIPS = {"gripper": (-0.0079, -0.0002, -0.0981), "jaw": (-0.01, -0.075, 0.0192)}
# From the servo's datasheet at 12 V (30 kg.cm, 45 rpm): a motor on its firmware's duty, whose back-EMF (2.94 N.m at 4.7
# rad/s) is
# the 0.6 N.m.s/rad of damping that others use for this arm. Dry friction and armature are theirs too; none was measured
# on this
# one. What duty the firmware makes of an error or of a speed is not stated: believed only within a factor of ten or
# more.
ARMATURE = 0.028  # kg.m2
SERVO = {
    "drive": "voltage",
    "joints": {
        "*": {
            "kp": {"value": 4.0, "low": 0.4, "high": 40.0},
            "kd": {"value": 0.05, "low": 0.0005, "high": 1.0},
            "torque_limit": 2.94,
            "no_load_speed": 4.7,
            "coulomb_friction": 0.052,
        }
    },
}


def convert(data: Path, out: Path, held: int = 10) -> Converted:
    """Convert the npz files of the motions; every third, up to `held`, is kept out. Commands that the current shows to
    be logged a period late (`sage_clock`) are put where they acted, in what is kept out as in the rest."""
    files = sorted(data.glob("*.npz"))
    if not files or not (data / "so101.xml").is_file():
        raise UserError(f"{data}: needs the motions (*.npz) and so101.xml")
    spec = mujoco.MjSpec.from_file(str(data / "so101.xml"))
    for joint in spec.joints:
        joint.armature = ARMATURE
    spec.worldbody.add_geom(
        name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, pos=[0, 0, TABLE], size=[1, 1, 0.1], contype=1, conaffinity=2
    )
    for body, tip in TIPS.items():
        spec.body(body).add_geom(
            name=f"{body}_tip",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            pos=tip,
            size=[0.001, 0, 0],
            mass=0.0,
            contype=2,
            conaffinity=1,
        )
    spec.compile()
    model, servo = rig(out, "so101", spec.to_xml(), SERVO)
    made = []
    late = sorted(name for name, evidence in sage_clock.late(data).items() if evidence > sage_clock.SURE)
    for path in files:
        raw = np.load(path)
        sent = raw["t_cmd"] - (np.median(np.diff(raw["t_cmd"])) if path.stem in late else 0.0)
        scale = np.r_[np.ones(5), sage_clock.JAW]
        made.append(
            save(
                out / f"{path.stem}.mcap",
                JOINTS,
                sent,
                raw["cmd"] * scale,
                raw["t"],
                raw["pos"] * scale,
                robot="so101",
                gravity="0 0 -9.81",
            )
        )
    chosen = made[2::3][:held]
    return Converted([p for p in made if p not in chosen], model, servo, chosen, late=late)
