"""Actuator models of BAM (Better Actuator Models, arXiv 2410.08650), read from its parameter files and written to them:
python -m dexsim.actuator.bam in=m2.json out=servo.yaml kp=1.15 supply_voltage=5

BAM: torque = kt U / R - kt^2 / R dq, U = supply * duty, duty = kp (goal - q), friction at most friction_base +
friction_viscous |dq| + the load's + S (friction_stribeck + the load's), S = exp(-|dq / dtheta_stribeck|^alpha). The
load's is load_friction |external torque - motor torque| in m3 and m4, |load_friction_external * external torque -
load_friction_motor * motor torque| in m5 and m6; in m6 there is also the smaller torque's square where the two oppose
each other, under S. Here: drive: voltage with torque_limit = kt supply / R, no_load_speed = supply / kt, and columns of
the same laws.

The duty is cut at 1 on both sides; of a motor that BAM cuts lower (max_pwm of mx64 and mx106: 0.9625) give
supply_voltage times that and kp over it. Motors that BAM drives by current or torque (erob, unitree) are refused.

settings (key=default):
  in=               a BAM file (.json) or a servo table (.yaml)
  out=              a servo table (.yaml) or a BAM file (.json): the other of the two
  joint=*           of the servo table
  kp=               BAM to servo: duty per rad (xl330: firmware gain * 4096 / (2 pi) / 256 / 885, 0.00288 a unit)
  supply_voltage=   BAM to servo: V
  armature=         servo to BAM: kg m2 of the rotor at the joint, which a servo table does not hold
  actuator=xl330    servo to BAM: the name that BAM knows the motor by
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import yaml

from dexsim import files, typed
from dexsim.actuator.columns import COLUMNS
from dexsim.actuator.table import ServoTable
from dexsim.errors import UserError

Zero = Annotated[float, msgspec.Meta(ge=0, le=1e6)]
SAME = {
    "friction_base": "coulomb_friction", "friction_viscous": "viscous_friction", "friction_stribeck": "stribeck_peak",
    "dtheta_stribeck": "stribeck_speed", "alpha": "stribeck_exponent", "q_offset": "position_offset",
    "command_delay": "delay",
}  # fmt: skip
"""Parameters that are a column as they stand."""
FIX = "BAM writes such a file with its fit"
STRIBECK = ("m2", "m4", "m5", "m6")
FALL = ("friction_stribeck", "dtheta_stribeck", "alpha")
"""What a model without Stribeck's curve has not."""
LOADS: dict[str, dict[str, tuple[str, ...]]] = {
    "m3": {"load_friction_base": ("load_friction", "load_friction_backdriven", "load_friction_external")},
    "m5": {
        "load_friction_motor": ("load_friction", "load_friction_backdriven"),
        "load_friction_external": ("load_friction_external",),
        "load_friction_motor_stribeck": ("load_stribeck",),
        "load_friction_external_stribeck": ("load_stribeck_external",),
    },
}
"""The columns that each parameter of friction by load is, by model."""
LOADS["m4"] = LOADS["m3"] | {"load_friction_stribeck": ("load_stribeck", "load_stribeck_external")}
LOADS["m6"] = LOADS["m5"] | {
    "load_friction_motor_quad": ("load_quadratic",),
    "load_friction_external_quad": ("load_quadratic_external",),
}
LOADED = tuple(dict.fromkeys(column for columns in LOADS["m6"].values() for column in columns))
NOT_BY_VOLTAGE = ("erob", "unitree")
"""How the names of motors begin that BAM drives by current or torque."""


class Bam(msgspec.Struct, forbid_unknown_fields=True):
    """A parameter file, of every model. kt N m/A, R ohm, armature kg m2, friction N m and N m s/rad, speeds rad/s,
    shares of a load 1 and 1/(N m); None where the file says nothing."""

    model: Literal["m1", "m2", "m3", "m4", "m5", "m6"]
    actuator: str
    kt: typed.Positive
    R: typed.Positive
    armature: Zero
    friction_base: Zero
    friction_viscous: Zero
    friction_stribeck: Zero | None = None
    dtheta_stribeck: typed.Positive | None = None
    alpha: typed.Positive | None = None
    q_offset: typed.Real = 0.0
    command_delay: Zero = 0.0
    error_gain_ratio: typed.Positive = 1.0  # of the gain that the firmware has over the one that was assumed
    load_friction_base: Zero | None = None
    load_friction_stribeck: Zero | None = None
    load_friction_motor: Zero | None = None
    load_friction_external: Zero | None = None
    load_friction_motor_stribeck: Zero | None = None
    load_friction_external_stribeck: Zero | None = None
    load_friction_motor_quad: Zero | None = None
    load_friction_external_quad: Zero | None = None


def read(path: str | Path) -> Bam:
    """Return a BAM parameter file. Raises UserError: not JSON, a parameter unknown, missing or impossible, a motor
    that is not driven by voltage."""
    path = Path(path).expanduser()
    raw = files.mapping(path, "BAM file")
    motor = raw.get("actuator")
    if isinstance(motor, str) and motor.startswith(NOT_BY_VOLTAGE):
        raise UserError(
            f"BAM file {path}: actuator ('{motor}'): BAM drives it by current or torque; must be a motor driven by"
            " voltage: a Dynamixel, Feetech or Waveshare one"
        )
    bam = typed.convert(raw, Bam, f"BAM file {path}", FIX)
    for name in (*(FALL if bam.model in STRIBECK else ()), *LOADS.get(bam.model, {})):
        if getattr(bam, name) is None:
            raise UserError(
                f"BAM file {path}: {name}: missing in a file of model {bam.model}; must be said (0: none of it), for"
                f" BAM itself takes a figure of its own there: {FIX}"
            )
    return bam


def to_servo(bam: Bam, kp: float, supply_voltage: float, joint: str = "*") -> dict[str, Any]:
    """Return the content of a servo table: kp duty per rad, supply_voltage V. The rotor's inertia is the model's or
    hand.yaml's (`armature`). BAM's duty is cut at 1, as here. Raises UserError for a figure that no column takes."""
    columns = {
        "kp": float(kp) * bam.error_gain_ratio,
        "torque_limit": bam.kt * supply_voltage / bam.R,
        "no_load_speed": supply_voltage / bam.kt,
    }
    for theirs, ours in SAME.items():
        if bam.model in STRIBECK or theirs not in FALL:
            columns[ours] = float(getattr(bam, theirs))
    for theirs, loaded in LOADS.get(bam.model, {}).items():
        if value := getattr(bam, theirs):
            columns |= dict.fromkeys(loaded, float(value))
    table = {
        "drive": "voltage",
        "joints": {joint: columns},
        "current_per_torque": 1.0 / bam.kt,
        "supply_voltage": float(supply_voltage),
    }
    ServoTable.from_dict(table, "servo table of a BAM file")
    return table


def to_bam(table: ServoTable, joint: str, armature: float, actuator: str = "xl330") -> dict[str, Any]:
    """Return the content of a BAM file of one joint, of the first model of m1 to m6 that can say it. Raises
    UserError where the table has what BAM has not, or lacks what it needs."""
    where = f"{table.source}: joints.{joint}"
    if table.drive != "voltage" or table.supply_voltage is None:
        raise UserError(f"{where}: BAM's motors are driven by voltage; state drive: voltage and supply_voltage")
    if actuator.startswith(NOT_BY_VOLTAGE):
        raise UserError(f"actuator={actuator}: BAM drives it by current or torque; must be a motor driven by voltage")
    said: dict[str, float] = {}
    known = {"kp", "torque_limit", "no_load_speed", *SAME.values(), *LOADED}
    for c in COLUMNS:
        value = table.value(joint, c.name).value
        if value is None or (c.name not in known and value != c.neutral):
            raise UserError(f"{where}.{c.name} ({value}): BAM has no such parameter; must be {c.neutral:g}")
        said[c.name] = value
    stall, no_load, supply = said["torque_limit"], said["no_load_speed"], table.supply_voltage
    if not 0 < stall < float("inf") or not no_load < float("inf"):
        raise UserError(f"{where}: torque_limit ({stall:g}), no_load_speed ({no_load:g}): BAM needs both, finite")
    load, back = said["load_friction"], said["load_friction_backdriven"]
    if load != back:
        raise UserError(
            f"{where}: load_friction ({load:g}), load_friction_backdriven ({back:g}): BAM has one figure for both; must"
            " be equal"
        )
    kt = supply / no_load
    out = {"kt": kt, "R": kt * supply / stall, "armature": float(armature)}
    model = _model(said)
    for theirs, ours in SAME.items():
        if model in STRIBECK or theirs not in FALL:
            out[theirs] = said[ours]
    # every load of the model is said: BAM starts one that is not from a figure of its own, which is not 0
    out |= {theirs: said[columns[0]] for theirs, columns in LOADS.get(model, {}).items()}
    return out | {"model": model, "actuator": actuator}


def _model(said: Mapping[str, float]) -> str:
    """Return the first model that has all of a table's columns."""
    falls = said["stribeck_peak"] > 0
    if not any(said[name] for name in LOADED):
        return "m2" if falls else "m1"
    if said["load_quadratic"] or said["load_quadratic_external"]:
        return "m6"
    if any(len({said[name] for name in columns}) > 1 for columns in LOADS["m4"].values()):
        return "m5"
    return "m4" if falls or said["load_stribeck"] else "m3"


def main(argv: list[str]) -> int:
    """Returns the exit status. Raises UserError."""
    keys = ("in", "out", "joint", "kp", "supply_voltage", "armature", "actuator")
    own = {"joint": "*", "actuator": "xl330"} | typed.settings(argv, keys)
    for key in ("in", "out"):
        if key not in own:
            raise UserError(f"say {key}=FILE (python -m dexsim.actuator.bam --help)")

    def number(key: str, low: float) -> float:
        return typed.number(key, own.get(key, ""), low, 1e6)

    out = Path(own["out"]).expanduser()
    if own["in"].endswith(".json"):
        bam = read(own["in"])
        made = to_servo(bam, number("kp", 0.0), number("supply_voltage", 1e-3), own["joint"])
        content = yaml.safe_dump(made, sort_keys=False, width=120)
        note = f"armature {bam.armature:.4g} kg m2 goes into the model or hand.yaml"
    else:
        table = ServoTable.load(Path(own["in"]).expanduser())
        data = to_bam(table, own["joint"], number("armature", 0.0), own["actuator"])
        content, note = json.dumps(data, indent=2) + "\n", f"kp {table.value(own['joint'], 'kp').value:g} duty per rad"
    files.write(out, content, "out=")
    print(f"written  {out}; {note}")
    return 0


if __name__ == "__main__":
    from dexsim.console.ending import guard

    sys.exit(guard(main, sys.argv[1:], __doc__))
