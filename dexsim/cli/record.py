"""`dexsim record ros2=TOPIC`: what a hand says over ROS 2, as a recording."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from dexsim import typed
from dexsim.errors import UserError

USAGE = """usage: dexsim record ros2=STATE_TOPIC[,COMMAND_TOPIC] out=FILE.mcap [key=value ...]

Record joints of any robot over ROS 2 (sensor_msgs/JointState) as MCAP that dexsim audit and diagnose read: by rclpy
where your shell has it, else by DDS alone (pip install cyclonedds). Ctrl-C ends it.

settings (key=default):
  ros2=               topic of states, and after a comma that of commands (/joint_states,/joint_commands)
  out=                FILE.mcap, a new one
  seconds=            how long (default: until Ctrl-C)
  effort=torque_Nm    what effort means: torque_Nm, current_A or none
  robot=              its name
  gravity=            in the base's frame, e.g. gravity="0 0 -9.81"

example:
  dexsim record ros2=/joint_states,/joint_commands out=a.mcap seconds=60
"""
KEYS = typed.defaults(USAGE)


def main(argv: Sequence[str]) -> int:
    """Record until the time is over; returns the exit status. Raises UserError."""
    given = KEYS | typed.settings(argv, KEYS)
    for key in ("ros2", "out"):
        if not given.get(key):
            raise UserError(f"say {key}= (dexsim record --help)")
    typed.one_of("effort", given["effort"], ("torque_Nm", "current_A", "none"))
    seconds = typed.real(given["seconds"] or "inf")
    if not seconds > 0:
        raise UserError(f"seconds={given['seconds']}: must be a number above 0")
    from dexsim import outputs
    from dexsim.deploy.recorder import Recorder
    from dexsim.deploy.ros2 import transport

    path = outputs.recording(given["out"], "out=")
    state, _, command = given["ros2"].partition(",")
    by = transport()
    recorder: Recorder | None = None
    joints: list[str] = []
    counts = {"states": 0, "commands": 0}

    def array(x: Any, names: Sequence[str]) -> np.ndarray | None:
        """Return values in the order of the first message's joints; None where a field is empty or a joint is
        missing."""
        if x is None or len(x) != len(names) or any(j not in names for j in joints):
            return None
        return np.asarray(x, float)[[list(names).index(j) for j in joints]]

    def heard(names: Sequence[str], position: Any, velocity: Any, effort: Any) -> None:
        nonlocal recorder
        now = time.monotonic()
        if recorder is None:
            if not len(names) or len(position) != len(names):
                return
            joints[:] = names
            meta = {"source": "real", "effort_is": given["effort"], "effort_sign": "1"}
            meta |= {k: given[k] for k in ("robot", "gravity") if given[k]}
            recorder = Recorder(path, joints, meta, None, now)
        q = array(position, names)
        if q is not None:
            push = array(effort, names)
            recorder.put("state", now, q, array(velocity, names), np.zeros(len(joints)) if push is None else push, now)
            counts["states"] += 1

    def sent(names: Sequence[str], position: Any, velocity: Any, effort: Any) -> None:
        q = array(position, names) if recorder is not None else None
        if q is not None:
            assert recorder is not None
            recorder.put("command", time.monotonic(), q.astype(np.float32))
            counts["commands"] += 1

    by.subscribe(state, heard)
    if command:
        by.subscribe(command, sent)
    print(f"listening on {given['ros2']} by {by.name}; Ctrl-C ends", flush=True)
    begun = time.monotonic()
    try:
        while time.monotonic() < begun + seconds:
            time.sleep(0.1)
            if sys.stdout.isatty():
                print(f"\r{time.monotonic() - begun:7.1f} s, {counts['states']} states, {counts['commands']} commands",
                      end="", flush=True)  # fmt: skip
            if recorder is None and time.monotonic() > begun + 10:
                raise UserError(f"ros2={state}: nothing came within 10 s by {by.name}; does ros2 topic echo show it?")
    except KeyboardInterrupt:
        pass
    finally:
        by.close()
        if recorder is not None:
            recorder.close()
    if recorder is None:
        raise UserError(f"ros2={state}: nothing came by {by.name}; does ros2 topic echo show it?")
    lost = f"; {recorder.error}" if recorder.error else ""
    print(f"\n{path}: {counts['states']} states, {counts['commands']} commands of {len(joints)} joints{lost}")
    return int(bool(recorder.error))
