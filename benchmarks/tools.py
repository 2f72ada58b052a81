"""Helpers of the benchmarks: their arguments, the environment in a closed grasp, clocks, and the printout."""

from __future__ import annotations

import json
import os
import platform
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from dexsim.actuator.kernel import QUEUE
from dexsim.cli import machine
from dexsim.cli import start as start_up
from dexsim.console import jobs
from dexsim.console.ending import guard
from dexsim.errors import UserError
from dexsim.paths import CONFIGS
from dexsim.sim.scene import OBJECT_FIELDS

ROOT = Path(__file__).parents[1]


def command(main: Callable[[list[str]], object], about: str | None = None) -> None:
    """Run `main` on the command line's arguments (or print `about` for --help) and end the process as every command of
    dexsim ends (`dexsim.console.ending`)."""

    def run(argv: list[str]) -> int:
        main(argv)
        return 0

    sys.exit(guard(run, sys.argv[1:], about))


def numbers(text: str, name: str) -> list[int]:
    """Return the whole numbers from "8192,16384"; raises UserError naming the setting."""
    try:
        found = [int(x) for x in str(text).strip("[]").split(",")]
    except ValueError:
        found = []
    if not found or min(found) < 1:
        raise UserError(f"{name}={text}: must be whole numbers above 0 with commas between, e.g. {name}=64,128")
    return found


def run(work: Sequence[jobs.Job], engine: jobs.Engine) -> None:
    """Run the jobs that have not ended well before. Raises UserError for one that fails now, when all have ended."""
    notes = {job: json.loads(job.note.read_text("utf-8")) for job in work if job.note.is_file()}
    waiting = [job for job in work if job not in notes or notes[job]["done"] < len(job.commands)]
    for job, status in zip(waiting, jobs.run(waiting, engine) if waiting else (), strict=True):
        if status:
            raise UserError(f"{job.folder.name} ended with status {status}: see {job.note.with_suffix('.txt')}")


def config(argv: Sequence[str]) -> dict[str, Any]:
    """Return the resolved settings of `dexsim train ARGV`; torch's threads set as there."""
    cfg = start_up.for_train(list(argv), CONFIGS).cfg
    machine.set_threads(cfg["device"])
    return cfg


def about(device: str) -> dict[str, Any]:
    """Return the hardware and versions, for the JSON line."""
    cuda = device.startswith("cuda")
    name = (
        torch.cuda.get_device_name(device)
        if cuda
        else f"{platform.machine()} CPU, {len(os.sched_getaffinity(0))} cores"
    )
    return {"device": name, "versions": machine.versions()}


def wait(device: str) -> None:
    """Wait until the device has done all that was asked of it."""
    if device.startswith("cuda"):
        torch.cuda.synchronize(device)


def seconds(device: str, call: Callable[[], object], repeats: int, warm: int = 2) -> float:
    """Return the seconds a call, of `repeats` calls in a row."""
    for _ in range(warm):
        call()
    wait(device)
    start = time.perf_counter()
    for _ in range(repeats):
        call()
    wait(device)
    return (time.perf_counter() - start) / repeats


def close_hand(env: Any, steps: int = 120) -> None:
    """Drive all worlds of a grasp environment into a grasp of moderate force: the contacts of training."""
    still = torch.zeros(env.num_envs, env.num_actions, device=env.device)
    close = still.clone()
    close[:, 4:] = 0.5
    close[:, :3] = 0.4
    for k in range(steps):  # the object falls first; a joint closes until it meets its torque
        env.step(torch.where((env.torque / env.effort).abs() > 0.4, still, close) if k > 16 else still)


class Snapshot:
    """The worlds of a hand environment at one moment: states, targets, drives, and whatever varies by world."""

    FIELDS = (*OBJECT_FIELDS, "dof_armature", "body_subtreemass", "body_invweight0", "dof_invweight0")

    def __init__(self, env: Any):
        e = env.engine
        self.qpos, self.qvel, self.target = e.t.qpos.clone(), e.t.qvel.clone(), env.target.clone()
        self.fields = {name: e.field(name).clone() for name in self.FIELDS}
        self.params, self.state = env.servo.params.clone(), env.servo.get_state()
        self.everyone = torch.ones(e.n, dtype=torch.bool, device=e.device)

    def restore(self, env: Any, fields: bool = False) -> None:
        """Put an environment of the same worlds there. The clock begins at 0, and the targets hold since ever. fields:
        also what varies by world (for another environment than the one it was taken from)."""
        if fields:
            for name, value in self.fields.items():
                env.engine.field(name).copy_(value)
            env.servo.params.copy_(self.params)
        env.engine.set_state(self.everyone, self.qpos, self.qvel)
        env.servo.reset(self.everyone, self.target)
        env.servo.set_state(torch.cat([self.state[..., :QUEUE], env.servo.get_state()[..., QUEUE:]], -1))
        env.target.copy_(self.target)
        env.episode_length_buf = torch.zeros_like(env.episode_length_buf)


def report(out: dict[str, Any]) -> dict[str, Any]:
    """Print a table of the plain values, then the JSON line."""
    for k, v in out.items():
        if isinstance(v, float):
            print(f"  {k:28s} {v:.4g}")
        elif isinstance(v, str | int):
            print(f"  {k:28s} {v}")
    print(json.dumps({k: float(f"{v:.6g}") if isinstance(v, float) else v for k, v in out.items()}), flush=True)
    return out
