"""Both physics engines on this CPU, in one run: physics steps and full environment steps a second, and their ratio.

    python -m benchmarks.engines [worlds=64] [seconds=20] [any other setting of train.py]

Same scene, same worlds, same actions: each engine is driven into a closed grasp, then timed in turns, a block of bare
physics and a block of full control steps (servo, touch, rewards, resets, observations) at a time, so that what else runs
on the machine meets both alike; medians over blocks. Aim: C MuJoCo at least 8 times as fast in physics and 5 times in full.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch

from dexsim.cli import machine
from dexsim.cli import start as start_up
from dexsim.tasks import make_env

ENGINES = ("mujoco", "warp")


def _ready(cfg: dict, engine: str) -> tuple[object, torch.Tensor, float]:
    """(environment in a closed grasp, the action that holds it, seconds until its first two steps were done)."""
    begin = time.perf_counter()
    env = make_env(cfg, cfg["worlds"], "cpu", 0, engine)
    still = torch.zeros(cfg["worlds"], env.num_actions)
    env.step(still)
    env.step(still)
    seconds = time.perf_counter() - begin
    close = still.clone()
    close[:, [1, 2, *range(4, 12)]] = 0.4
    for k in range(40):
        env.step(close if k > 12 else still)
    return env, close, seconds


def _block(call: Callable[[], None], seconds: float) -> float:
    """Seconds a call, of as many calls as fit."""
    begin, count = time.perf_counter(), 0
    while count < 2 or time.perf_counter() - begin < seconds:
        call()
        count += 1
    return (time.perf_counter() - begin) / count


def main(argv: list[str]) -> dict:
    own = {k: v for k, v in (a.split("=", 1) for a in argv if "=" in a) if k == "seconds"}
    seconds = float(own.get("seconds", 20))
    given = [a for a in argv if not a.startswith("seconds=")]
    if not any(a.startswith("worlds=") for a in given):
        given.append("worlds=64")
    cfg = start_up.for_train([*given, "device=cpu"], Path(__file__).parents[1] / "configs").cfg
    machine.set_threads("cpu")
    worlds = cfg["worlds"]
    ready = {name: _ready(cfg, name) for name in ENGINES}
    physics, full = {n: [] for n in ENGINES}, {n: [] for n in ENGINES}
    blocks = 5
    for _ in range(blocks):
        for name in ENGINES:
            env, action, _ = ready[name]
            share = seconds / (2 * len(ENGINES) * blocks)
            full[name].append(_block(lambda env=env, action=action: env.step(action), share))
            physics[name].append(_block(lambda env=env: env.engine.step(env.decimation), share))
    out: dict = {"benchmark": "engines", "cpus": os.cpu_count(), "worlds": worlds, "physics_steps": ready["warp"][0].decimation}
    for name in ENGINES:
        bare, step = statistics.median(physics[name]), statistics.median(full[name])
        out[f"{name}_physics_steps_per_s"] = worlds * out["physics_steps"] / bare
        out[f"{name}_env_steps_per_s"] = worlds / step
        out[f"{name}_ready_s"] = ready[name][2]
        out[f"{name}_contacts"] = ready[name][0].engine.peaks()["contacts"]
    out["physics_ratio"] = out["mujoco_physics_steps_per_s"] / out["warp_physics_steps_per_s"]
    out["env_ratio"] = out["mujoco_env_steps_per_s"] / out["warp_env_steps_per_s"]
    for k, v in out.items():
        print(f"  {k:30s} {v:.4g}" if isinstance(v, float) else f"  {k:30s} {v}")
    print(json.dumps(out))
    return out


if __name__ == "__main__":
    main(sys.argv[1:])
