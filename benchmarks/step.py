"""What a control step costs beside bare physics of the same scene, in one run.

    python -m benchmarks.step [worlds=8192] [steps=100] [any other setting of train.py]

Bare physics: the same number of physics steps of the same worlds in the same states, nothing else. Full step: servo,
touch with 600 taxels, rewards, terminations, reset, randomization, observations.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import torch

from dexsim.cli import machine
from dexsim.cli import start as start_up
from dexsim.tasks import make_env


def _time(device: str, fn, repeats: int) -> float:
    """Seconds a call, of `repeats` calls in a row."""
    sync = torch.cuda.synchronize if device.startswith("cuda") else (lambda: None)
    fn()
    fn()
    sync()
    start = time.perf_counter()
    for _ in range(repeats):
        fn()
    sync()
    return (time.perf_counter() - start) / repeats


def main(argv: list[str]) -> dict:
    steps_given = [a.split("=", 1)[1] for a in argv if a.startswith("steps=")]
    cfg = start_up.for_train([a for a in argv if not a.startswith("steps=")], Path(__file__).parents[1] / "configs").cfg
    device, worlds = cfg["device"], cfg["worlds"]
    steps = int(steps_given[-1]) if steps_given else (100 if device.startswith("cuda") else 20)
    machine.set_threads(device)
    start = time.perf_counter()
    env = make_env(cfg, worlds, device, 0, cfg["sim"]["engine"])
    action = torch.zeros(worlds, env.num_actions, device=device)
    close = torch.zeros_like(action)
    close[:, 4:] = 0.5
    close[:, :3] = 0.4
    env.step(action)
    env.step(action)
    ready = time.perf_counter() - start
    for k in range(120):  # into a grasp of moderate force: the contacts of training
        env.step(torch.where((env.torque / env.effort).abs() > 0.4, action, close) if k > 16 else action)
    e = env.engine
    ones = torch.ones(worlds, dtype=torch.bool, device=device)
    qpos, qvel = e.t.qpos.clone(), e.t.qvel.clone()

    def timed(fn) -> float:
        """Seconds of fn, all worlds put back into the same grasp first."""
        e.set_state(ones, qpos, qvel)
        return _time(device, fn, steps)

    # Bare physics: joint friction and damping stay as the servo left them; its last torques go on acting.
    forces = e.t.qfrc_applied.clone()
    e.set_state(ones, qpos, qvel)
    e.t.qfrc_applied.copy_(forces)
    bare = _time(device, lambda: e.step(env.decimation), 8)
    driven = timed(lambda: e.step(env.decimation, env.servo.before_each))
    touched = timed(lambda: e.step(env.decimation, env.servo.before_each, env.touch.launch))
    full = timed(lambda: env.step(action))
    peaks = e.peaks()
    out = {
        "benchmark": "step", "device": torch.cuda.get_device_name(device) if device.startswith("cuda") else "cpu", "engine": e.kind,
        "worlds": worlds, "physics_steps": env.decimation, "ready_s": round(ready, 1), "bare_ms": 1e3 * bare, "servo_ms": 1e3 * (driven - bare),
        "touch_ms": 1e3 * (touched - driven), "rest_ms": 1e3 * (full - touched), "full_ms": 1e3 * full,
        "env_steps_per_s": worlds / full, "physics_steps_per_s": worlds * env.decimation / bare, "overhead": full / bare - 1,
        "contacts": peaks["contacts"], "rows": peaks["rows"],
    }  # fmt: skip
    for k, v in out.items():
        print(f"  {k:20s} {v:.4g}" if isinstance(v, float) else f"  {k:20s} {v}")
    print(json.dumps(out))
    return out


if __name__ == "__main__":
    main(sys.argv[1:])
