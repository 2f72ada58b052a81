"""The servo: targets in, imperfect joint torques out. One table params[world, joint, column], one kernel."""

from __future__ import annotations

from dexsim.actuator.columns import COLUMNS, Column, describe
from dexsim.actuator.servo import FIELDS, Servo
from dexsim.actuator.table import ServoTable, Value

__all__ = ["COLUMNS", "FIELDS", "Column", "Servo", "ServoTable", "Value", "describe"]
