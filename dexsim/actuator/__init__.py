"""The servo: targets in, imperfect joint torques out. One table params[world, joint, column], one kernel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dexsim.actuator.columns import COLUMNS, Column, describe
from dexsim.actuator.table import ServoTable, Value

if TYPE_CHECKING:
    from dexsim.actuator.servo import FIELDS, Servo

__all__ = ["COLUMNS", "FIELDS", "Column", "Servo", "ServoTable", "Value", "describe"]


def __getattr__(name: str) -> Any:
    """Import what needs torch and Warp when it is asked for: recordings and tables are read without."""
    if name in ("FIELDS", "Servo"):
        from dexsim.actuator import servo

        return getattr(servo, name)
    raise AttributeError(f"module {__name__} has no {name}")
