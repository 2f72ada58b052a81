"""Actuator models of BAM (Better Actuator Models, arXiv 2410.08650), read from its parameter files and written to them:
python -m dexsim.actuator.bam in=m2.json out=servo.yaml kp=1.15 supply_voltage=5

BAM: torque = kt U / R - kt^2 / R dq, U = supply * duty, duty = kp (goal - q), friction at most friction_base +
friction_stribeck exp(-|dq / dtheta_stribeck|^alpha) + friction_viscous |dq|, and in m5 and m6 |load_friction_external *
external torque - load_friction_motor * motor torque| more. Here: drive: voltage with torque_limit = kt supply / R,
no_load_speed = supply / kt, and columns of the same laws: m1, m2, and what m5 and m6 say of the motor's torque
(load_friction_motor: `load_friction`, the same driving and driven back). What the torque from outside adds, known apart
from friction, has no column, nor have friction by load that fades with speed and its square: m3's and m4's load terms
and the others of m5 and m6 are refused by name unless they are 0.

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
    "friction_base": "coulomb_friction",
    "friction_viscous": "viscous_friction",
    "friction_stribeck": "stribeck_peak",
    "dtheta_stribeck": "stribeck_speed",
    "alpha": "stribeck_exponent",
    "q_offset": "position_offset",
    "command_delay": "delay",
}
"""Parameters that are a column as they stand."""
FIX = "BAM writes such a file with its fit"
LOADED = ("load_friction", "load_friction_backdriven")
"""Columns of friction by the motor's torque, while it drives and while it is driven; BAM has one figure for both."""
STRIBECK = ("m2", "m4", "m5", "m6")
MOTOR_LOAD = ("m5", "m6")  # models with friction by the motor's torque alone
UNKNOWN = {
    "m3": ("load_friction_base",),
    "m4": ("load_friction_base", "load_friction_stribeck"),
    "m5": ("load_friction_external", "load_friction_motor_stribeck", "load_friction_external_stribeck"),
    "m6": (
        "load_friction_external", "load_friction_motor_stribeck", "load_friction_external_stribeck",
        "load_friction_motor_quad", "load_friction_external_quad",
    ),
}  # fmt: skip
"""Parameters of each model that have no column: friction by the torque from outside, friction by load that is there
near standstill only, and the square of a load."""


class Bam(msgspec.Struct):
    """A parameter file. kt N m/A, R ohm, armature kg m2, friction N m and N m s/rad, speeds rad/s, shares of a load 1
    and 1/(N m); None where the file says nothing."""

    model: Literal["m1", "m2", "m3", "m4", "m5", "m6"]
    actuator: str
    kt: typed.Positive
    R: typed.Positive
    armature: Zero
    friction_base: Zero
    friction_viscous: Zero
    friction_stribeck: Zero = 0.0
    dtheta_stribeck: typed.Positive = 1.0
    alpha: typed.Positive = 2.0
    q_offset: typed.Real = 0.0
    command_delay: Zero = 0.0
    load_friction_base: Zero | None = None
    load_friction_stribeck: Zero | None = None
    load_friction_motor: Zero | None = None
    load_friction_external: Zero | None = None
    load_friction_motor_stribeck: Zero | None = None
    load_friction_external_stribeck: Zero | None = None
    load_friction_motor_quad: Zero | None = None
    load_friction_external_quad: Zero | None = None


def read(path: str | Path) -> Bam:
    """A BAM parameter file. Raises UserError: not JSON, a parameter missing or impossible, or a load term without a
    column that is not 0."""
    path = Path(path).expanduser()
    text = files.text(path, files.MAX_YAML, "BAM file")
    try:
        raw = json.loads(text)
    except ValueError as error:
        raise UserError(f"BAM file {path}: not JSON ({error})") from None
    bam = typed.convert(raw, Bam, f"BAM file {path}", FIX)
    for name in ("load_friction_motor",) * (bam.model in MOTOR_LOAD) + UNKNOWN.get(bam.model, ()):
        value = getattr(bam, name)
        if value is None:
            raise UserError(
                f"BAM file {path}: {name}: missing in a file of model {bam.model}; must be said (0: none of it), for"
                f" BAM itself takes a figure of its own there: {FIX}"
            )
        if value and name in UNKNOWN[bam.model]:
            raise UserError(
                f"BAM file {path}: {name} ({value:g}): model {bam.model}'s term by this name is no law of"
                " the servo table; must be 0: fit m1 or m2 with BAM (python -m bam.fit --model m2)"
            )
    return bam


def to_servo(bam: Bam, kp: float, supply_voltage: float, joint: str = "*") -> dict[str, Any]:
    """The content of a servo table: kp duty per rad, supply_voltage V. The rotor's inertia is the model's or
    hand.yaml's (`armature`). BAM's duty is cut at 1, as here."""
    columns = {
        "kp": float(kp),
        "torque_limit": bam.kt * supply_voltage / bam.R,
        "no_load_speed": supply_voltage / bam.kt,
    }
    for theirs, ours in SAME.items():
        value = getattr(bam, theirs)
        if bam.model in STRIBECK or theirs not in ("friction_stribeck", "dtheta_stribeck", "alpha"):
            columns[ours] = float(value)
    if bam.model in MOTOR_LOAD:
        columns |= dict.fromkeys(LOADED, float(bam.load_friction_motor or 0.0))
    table = {
        "drive": "voltage",
        "joints": {joint: columns},
        "current_per_torque": 1.0 / bam.kt,
        "supply_voltage": float(supply_voltage),
    }
    ServoTable.from_dict(table, "servo table of a BAM file")
    return table


def to_bam(table: ServoTable, joint: str, armature: float, actuator: str = "xl330") -> dict[str, Any]:
    """The content of a BAM file of one joint. m5 where friction grows with the motor's torque, else m2 or m1. Raises
    UserError where the table has what BAM has not, or lacks what it needs."""
    where = f"{table.source}: joints.{joint}"
    if table.drive != "voltage" or table.supply_voltage is None:
        raise UserError(f"{where}: BAM's motors are driven by voltage; state drive: voltage and supply_voltage")
    said = {c.name: table.value(joint, c.name).value for c in COLUMNS}
    known = {"kp", "torque_limit", "no_load_speed", *SAME.values(), *LOADED}
    for c in COLUMNS:
        if said[c.name] is None or (c.name not in known and said[c.name] != c.neutral):
            raise UserError(f"{where}.{c.name} ({said[c.name]}): BAM has no such parameter; must be {c.neutral:g}")
    stall, no_load, supply = said["torque_limit"], said["no_load_speed"], table.supply_voltage
    if not 0 < stall < float("inf") or not no_load < float("inf"):
        raise UserError(f"{where}: torque_limit ({stall:g}), no_load_speed ({no_load:g}): BAM needs both, finite")
    load, back = (said[name] for name in LOADED)
    if load != back:
        raise UserError(
            f"{where}: load_friction ({load:g}), load_friction_backdriven ({back:g}): BAM has one figure for both; must"
            " be equal"
        )
    kt = supply / no_load
    out = {"kt": kt, "R": kt * supply / stall, "armature": float(armature)}
    peaked = said["stribeck_peak"] > 0
    for theirs, ours in SAME.items():
        if peaked or theirs not in ("friction_stribeck", "dtheta_stribeck", "alpha"):
            out[theirs] = said[ours]
    if load > 0:
        # every parameter of m5 is said: BAM starts one that is not from a figure of its own, which is not 0
        none = {name: 0.0 for name in ("friction_stribeck", *UNKNOWN["m5"])}
        shape = {name: said[SAME[name]] for name in ("dtheta_stribeck", "alpha")}
        return none | shape | out | {"load_friction_motor": load, "model": "m5", "actuator": actuator}
    return out | {"model": "m2" if peaked else "m1", "actuator": actuator}


def main(argv: list[str]) -> int:
    """Returns the exit status. Raises UserError."""
    own = {"in": None, "out": None, "joint": "*", "kp": None, "supply_voltage": None, "armature": None,
           "actuator": "xl330"}  # fmt: skip
    for text in argv:
        key, equals, value = text.partition("=")
        if not equals or key not in own:
            raise UserError(f"'{text}': expected key=value with one of the keys {', '.join(own)}")
        own[key] = value
    for key in ("in", "out"):
        if own[key] is None:
            raise UserError(f"say {key}=FILE (python -m dexsim.actuator.bam --help)")

    def number(key: str, low: float) -> float:
        try:
            value = float(own[key])
        except (TypeError, ValueError):
            raise UserError(f"{key}={own[key]}: must be a number") from None
        if not low <= value < 1e6:
            raise UserError(f"{key}={own[key]}: must lie in [{low:g}, 1e6)")
        return value

    out = Path(own["out"]).expanduser()
    if own["in"].endswith(".json"):
        bam = read(own["in"])
        table = to_servo(bam, number("kp", 0.0), number("supply_voltage", 1e-3), own["joint"])
        content = yaml.safe_dump(table, sort_keys=False, width=120)
        note = f"armature {bam.armature:.4g} kg m2 goes into the model or hand.yaml"
    else:
        table = ServoTable.load(Path(own["in"]).expanduser())
        data = to_bam(table, own["joint"], number("armature", 0.0), own["actuator"])
        content, note = json.dumps(data, indent=2) + "\n", f"kp {table.value(own['joint'], 'kp').value:g} duty per rad"
    part = out.with_name(f".{out.name}.part")
    try:
        part.write_text(content, encoding="utf-8")
        part.replace(out)
    except OSError as error:
        raise UserError(f"out={out}: cannot be written: {error.strerror}") from None
    print(f"written  {out}; {note}")
    return 0


if __name__ == "__main__":
    from dexsim.console.ending import guard

    sys.exit(guard(main, sys.argv[1:], __doc__))
