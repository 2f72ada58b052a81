"""Cost of a control step beside bare physics of the same scene, in one run.

    python -m benchmarks.step [worlds=8192] [steps=40] [rounds=3] [any other setting of train.py]

All worlds are driven into a grasp of moderate force. From that state, the same number of control steps is timed as
  bare    physics steps only, driven by the torques, damping and friction that the servo wrote in the same steps of a
          run with the servo (recorded, and copied back by one small kernel before each physics step);
  servo   physics steps with the servo kernel before each;
  touch   the same with the touch kernel (the hand's taxels) after the last;
  full    the environment's step: also actions, terminations, rewards, masked reset, randomization, observations;
  feel    the touch kernel alone, in the grasp.
`rounds` times in turns; medians. Prints milliseconds a control step and `overhead`, full over bare minus one.
"""

from __future__ import annotations

import statistics
import time
from typing import Any

import torch

from benchmarks import tools
from benchmarks.options import options
from benchmarks.tape import Tape
from dexsim.tasks import make_env


def measure(env: Any, steps: int, rounds: int) -> dict[str, list[float]]:
    """Return the seconds a control step, of each round, by name (see above), from the state the worlds are in."""
    device, worlds = env.device, env.num_envs
    action = torch.zeros(worlds, env.num_actions, device=device)
    e, k = env.engine, env.decimation
    grasp, tape = tools.Snapshot(env), Tape(e, env.servo, (steps + 2) * k)

    def back() -> None:
        grasp.restore(env)
        tape.rewind()

    back()
    for _ in range(steps + 2):
        e.step(k, tape.record)
    calls = {
        "bare": lambda: e.step(k, tape.play),
        "servo": lambda: e.step(k, env.servo.before_each),
        "touch": lambda: e.step(k, env.servo.before_each, env.touch.launch),
        "full": lambda: env.step(action),
        "feel": env.touch.launch,
    }
    for call in calls.values():  # compiled and recorded before anything is timed
        back()
        for _ in range(3):
            call()
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            back()
            if name == "feel":  # whoever is put somewhere is pressed by nothing, until a step says by what
                e.step(k, env.servo.before_each)
            times[name].append(tools.seconds(device, call, steps))
    return times


def main(argv: list[str]) -> dict:
    rest: list[str] = []
    own = options(argv, {"steps": 0, "rounds": 3}, rest)
    cfg = tools.config(rest)
    device, worlds = cfg["device"], cfg["worlds"]
    steps = own["steps"] or (40 if device.startswith("cuda") else 20)
    begin = time.perf_counter()
    env = make_env(cfg, worlds, device, 0, cfg["sim"]["engine"])
    action = torch.zeros(worlds, env.num_actions, device=device)
    env.step(action)
    env.step(action)
    ready = time.perf_counter() - begin
    tools.close_hand(env)
    times = measure(env, steps, own["rounds"])
    bare, driven, touched, full, feel = (1e3 * statistics.median(t) for t in times.values())
    e, k = env.engine, env.decimation
    peaks = e.peaks()
    return tools.report({
        "benchmark": "step", **tools.about(device), "engine": e.kind, "worlds": worlds, "physics_steps": k,
        "ready_s": ready,
        "bare_ms": bare, "servo_ms": driven - bare, "touch_ms": touched - driven, "rest_ms": full - touched,
        "full_ms": full, "feel_ms": feel, "taxels": int(env.touch.layout.count.sum()),
        "overhead": full / bare - 1, "overhead_over_driven": full / driven - 1, "env_steps_per_s": 1e3 * worlds / full,
        "physics_steps_per_s": 1e3 * worlds * k / bare, "contacts": peaks["contacts"], "rows": peaks["rows"],
        "rounds_ms": {name: [round(1e3 * t, 3) for t in ts] for name, ts in times.items()},
    })  # fmt: skip


if __name__ == "__main__":
    tools.command(main, __doc__)
