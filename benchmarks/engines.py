"""Both physics engines on this CPU, in one run: physics steps and full environment steps a second, and their ratios.

    python -m benchmarks.engines [worlds=64,128] [seconds=30] [any other setting of train.py]

Same scene, same worlds, same actions: each engine is driven into a closed grasp, then timed in turns, a block of bare
physics (torques frozen) and a block of full control steps (servo, touch, rewards, resets, observations) at a time, so
that what else runs on the machine meets both alike; medians over blocks, of two clocks: the wall's, and the processor
time of this process (all its threads), which other programs hardly touch. C MuJoCo steps on all cores, MuJoCo-Warp's
CPU backend and torch on one: on an idle machine its physics gains by the wall clock as many times more as there are
cores.
Aim: C MuJoCo at least 8 times as fast in physics and 5 times in the full step.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import torch

from benchmarks import tools
from dexsim.tasks import make_env

ENGINES = ("mujoco", "warp")
BLOCKS = 5
PARTS = ("physics", "env")


def _ready(cfg: dict, engine: str) -> tuple[object, float]:
    """(environment in a closed grasp, seconds until its first two steps were done)."""
    begin = time.perf_counter()
    env = make_env(cfg, cfg["worlds"], "cpu", 0, engine)
    still = torch.zeros(cfg["worlds"], env.num_actions)
    env.step(still)
    env.step(still)
    seconds = time.perf_counter() - begin
    tools.close_hand(env, 60)
    return env, seconds


def _block(call: Callable[[], object], seconds: float) -> tuple[float, float]:
    """(wall, processor) seconds a call, of as many calls as fit."""
    wall, cpu, count = time.perf_counter(), time.process_time(), 0
    while count < 2 or time.perf_counter() - wall < seconds:
        call()
        count += 1
    return (time.perf_counter() - wall) / count, (time.process_time() - cpu) / count


def measure(cfg: dict, seconds: float) -> dict:
    """Rates and ratios at cfg["worlds"] worlds."""
    worlds = cfg["worlds"]
    ready = {name: _ready(cfg, name) for name in ENGINES}
    still = torch.zeros(worlds, 12)
    k = ready["warp"][0].decimation
    found: dict[tuple[str, str], list[tuple[float, float]]] = {(n, p): [] for n in ENGINES for p in PARTS}
    share = seconds / (len(found) * BLOCKS)
    for _ in range(BLOCKS):
        for name in ENGINES:
            env = ready[name][0]
            found[name, "env"].append(_block(lambda env=env: env.step(still), share))
            found[name, "physics"].append(_block(lambda env=env: env.engine.step(k), share))
    out: dict = {"worlds": worlds, "physics_steps": k}
    for part, steps in (("physics", worlds * k), ("env", worlds)):
        for i, clock in enumerate(("wall", "cpu")):
            times = {name: statistics.median(b[i] for b in found[name, part]) for name in ENGINES}
            out |= {f"{name}_{part}_per_{clock}_s": steps / times[name] for name in ENGINES}
            out[f"{part}_{clock}_ratio"] = times["warp"] / times["mujoco"]
    for name in ENGINES:
        out[f"{name}_contacts"], out[f"{name}_ready_s"] = ready[name][0].engine.peaks()["contacts"], ready[name][1]
    return out


def main(argv: list[str]) -> dict:
    own, rest = tools.split(argv, {"worlds": "64,128", "seconds": "30"})
    counts, seconds = tools.numbers(own["worlds"], "worlds"), float(tools.numbers(own["seconds"], "seconds")[0])
    cfg = tools.config([*rest, "device=cpu"])
    out: dict = {"benchmark": "engines", **tools.about("cpu"), "load": tools.load()}
    rows = [measure({**cfg, "worlds": n}, seconds) for n in counts]
    print(f"  {'worlds':>6s} {'':8s} {'C MuJoCo':>12s} {'Warp':>10s} {'ratio':>7s}   {'by processor time':>24s}"
          f" {'ratio':>7s}")
    for row in rows:
        for part, what in (("physics", "physics"), ("env", "full")):
            w, c = (tuple(row[f"{n}_{part}_per_{clock}_s"] for n in ENGINES) for clock in ("wall", "cpu"))
            print(f"  {row['worlds']:6d} {what:8s} {w[0]:10.0f}/s {w[1]:8.0f}/s {row[f'{part}_wall_ratio']:7.2f}   "
                  f"{c[0]:10.0f}/s {c[1]:10.0f}/s {row[f'{part}_cpu_ratio']:7.2f}")
    last = rows[-1]
    out |= {"physics_ratio": last["physics_wall_ratio"], "env_ratio": last["env_wall_ratio"], "rows": rows}
    return tools.report(out)


if __name__ == "__main__":
    tools.command(main, __doc__)
