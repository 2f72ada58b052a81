"""Repeats the control step at which a world stopped being finite, out of a file that `NanDump` wrote."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from dexsim import typed
from dexsim.errors import UserError
from dexsim.sim.quiet import quiet_warp
from dexsim.tasks import make_env
from dexsim.tasks.nan_dump import load

if TYPE_CHECKING:
    from dexsim.tasks.env import HandEnv

USAGE = """usage: dexsim nan-dump FILE.npz [engine=mujoco|warp] [device=cpu]

Repeat the control step at which a world stopped being finite (nan_<k>.npz in the run folder), in one world of the same
configuration, and print what becomes of it. The solver starts cold in the replay: what hung on its warm start may not
come back.
"""


def replay(path: Path, device: str = "cpu", engine: str = "auto") -> HandEnv:
    """Return the environment (one world) after the step that failed. Raises UserError."""
    data = load(path)
    env = make_env(json.loads(str(data["config"])), 1, device, 0, engine)
    e = env.engine

    def put(own: torch.Tensor, name: str) -> None:
        if own.shape[1:] != data[name].shape:
            raise UserError(
                f"{path}: {name} is {data[name].shape} there and {tuple(own.shape[1:])} in this scene: another version"
                " of dexsim"
            )
        own.copy_(torch.as_tensor(data[name], device=own.device)[None])

    for name in [k for k in data if k.startswith("field.")]:
        put(e.field(name[len("field.") :]), name)
    e.set_state(
        torch.ones(1, dtype=torch.bool, device=device),
        torch.as_tensor(data["qpos"], device=device)[None],
        torch.as_tensor(data["qvel"], device=device)[None],
    )
    for own, name in (
        (e.t.time, "time"),
        (e.t.xfrc_applied, "xfrc_applied"),
        (env.servo.params, "servo_params"),
        (env.servo.state, "servo_state"),
    ):
        put(own, name)
    e.step(env.decimation, env.servo.before_each)
    env.read_state()
    return env


def main(argv: list[str]) -> int:
    """Prints the state before and after; returns 0."""
    files = [a for a in argv if "=" not in a]
    given = typed.settings([a for a in argv if "=" in a], ("engine", "device"))
    if len(files) != 1:
        raise UserError("say which dump: dexsim nan-dump FILE.npz [engine=mujoco|warp] [device=cpu]")
    device = given.get("device", "cpu")
    quiet_warp(device)
    data = load(Path(files[0]))
    env = replay(Path(files[0]), device, given.get("engine", "auto"))
    print(
        f"{files[0]}: world {int(data['world'])}, control step {int(data['episode_step'])} of its episode, action"
        f" {np.round(data['action'], 3).tolist()}"
    )
    for name in ("qpos", "qvel"):
        before, after = data[name], getattr(env.engine.t, name)[0].cpu().numpy()
        print(
            f"{name} before: {int((~np.isfinite(before)).sum())} of {before.size} not finite, largest"
            f" {_largest(before)}; "
            f"after: {int((~np.isfinite(after)).sum())} not finite, largest {_largest(after)}"
        )
    print("it fails again here" if bool(env.nan[0]) else f"it stays finite here (engine {env.engine.kind})")
    return 0


def _largest(x: np.ndarray) -> str:
    x = np.abs(x[np.isfinite(x)])
    return f"{x.max():.4g}" if x.size else "-"
