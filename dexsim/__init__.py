"""dexsim: train dexterous hands in simulation, feel like the real hand, and find what the simulator left out.

    import dexsim

    found = dexsim.diagnose(["a.mcap", "b.mcap", "c.mcap"])         # what the simulator leaves out of them
    run = dexsim.train("grasp", settings=["servo_file=out/diagnosis/servo.yaml"])
    metrics = dexsim.play(run / "policy.pt", episodes=64)

==================  ====================================================================================================
diagnose            find the physics that a simulator leaves out of recordings
read_recording      a recording out of an MCAP file or a ROS 2 bag, with what is wrong with it
write_recording     write one
replay_recording    what the simulator makes of a recording's commands
demo_recordings     recordings of a simulated joint that hides an effect, to try things on
settings            every setting of a training, as a dict
make_env            many simulated hands at one task
train               train a policy
load_policy         a trained policy as a function of observations
play                play episodes, return the metrics
PPO                 what learns, for train(agent=PPO(gamma=0.99))
Distillation        the same: a student of a teacher that sees more
ServoTable          the drives of a mechanism as servo.yaml states them: load, value, set, save
Recording           what read_recording returns
Diagnosis           what diagnose returns
UserError           the one exception that a user's mistake raises
==================  ====================================================================================================

Importing dexsim loads nothing else: a name is loaded when it is first used.
"""

from __future__ import annotations

import ctypes.util
import importlib
import os
import sys
from typing import TYPE_CHECKING, Any

from dexsim.version import VERSION as __version__

if TYPE_CHECKING:
    from dexsim.actuator.table import ServoTable
    from dexsim.agents import PPO, Distillation
    from dexsim.api import (
        demo_recordings,
        diagnose,
        load_policy,
        make_env,
        play,
        read_recording,
        replay_recording,
        settings,
        train,
        write_recording,
    )
    from dexsim.errors import UserError
    from dexsim.gap.inquiry import Diagnosis
    from dexsim.recording.schema import Recording

__all__ = [
    "Diagnosis", "Distillation", "PPO", "Recording", "ServoTable", "UserError", "__version__", "demo_recordings",
    "diagnose", "load_policy", "make_env", "play", "read_recording", "replay_recording", "settings", "train",
    "write_recording",
]  # fmt: skip

_ELSEWHERE = {
    "Diagnosis": "dexsim.gap.inquiry", "Distillation": "dexsim.agents", "PPO": "dexsim.agents",
    "Recording": "dexsim.recording.schema", "ServoTable": "dexsim.actuator.table", "UserError": "dexsim.errors",
}  # fmt: skip
"""Modules of the names that are not in `dexsim.api`."""


def _without_absent_gl() -> None:
    """Turns MUJOCO_GL off where it names an OpenGL that is not here: MuJoCo loads it when it is imported, and commands
    that draw nothing would die of it. What draws tries each backend in a process of its own (`dexsim.view.video`)."""
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    libraries = {"osmesa": "OSMesa", "egl": "EGL"} if sys.platform == "linux" else {}
    known = ("", "off", "disable", "disabled", "false", "0", "on", "enable", "enabled", "true", "1", "glfw", "glx",
             "cgl", "wgl", *libraries)  # fmt: skip
    if wanted not in known or (wanted in libraries and not ctypes.util.find_library(libraries[wanted])):
        os.environ["MUJOCO_GL"] = "off"


_without_absent_gl()


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'dexsim' has no attribute {name!r}; it has {', '.join(__all__)}")
    value = getattr(importlib.import_module(_ELSEWHERE.get(name, "dexsim.api")), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
