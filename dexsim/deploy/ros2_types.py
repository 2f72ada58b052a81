"""`sensor_msgs/JointState` as ROS 2 sends it over DDS: names of types and fields decide whether two programs match."""

from __future__ import annotations

import types
from dataclasses import dataclass, field
from typing import Any

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, sequence, uint32


def _message(package: str, name: str, /, **fields: tuple[Any, Any]) -> Any:
    """Return a message of ROS 2: its fields, each with its type and what makes its default."""
    body = {k: field(default_factory=make) for k, (_, make) in fields.items()}
    body |= {"__annotations__": {k: kind for k, (kind, _) in fields.items()}, "__module__": __name__}
    made = types.new_class(name, (IdlStruct,), {"typename": f"{package}.msg.dds_.{name}_"}, lambda ns: ns.update(body))
    return dataclass(made)


Time = _message("builtin_interfaces", "Time", sec=(int32, int), nanosec=(uint32, int))
Header = _message("std_msgs", "Header", stamp=(Time, Time), frame_id=(str, str))
JointState = _message(
    "sensor_msgs", "JointState", header=(Header, Header), name=(sequence[str], list),
    **{k: (sequence[float64], list) for k in ("position", "velocity", "effort")},
)  # fmt: skip
