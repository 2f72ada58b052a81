"""Whether PPO learns the same with its update recorded in a CUDA graph: reward curves with and without.

    python -m benchmarks.graphed_curves [iterations=40] [worlds=4096] [seeds=0,1] [out=out/graphed_curves.json]
                                        [any other setting of train.py]

For each seed two trainings from the same weights, worlds and random state: `recorded` (graphed_update=true) and `plain`
(rsl-rl's own update). On a GPU sums are added in no fixed order, so that two runs of the same program part as well;
what to watch is whether the two kinds differ by more than two seeds do. On a CPU nothing is recorded: there the
recorded one runs the same program unrecorded. Prints the mean reward a step, and seconds an update.
"""

from __future__ import annotations

import gc
import json
import statistics
from pathlib import Path
from typing import Any

import torch

from benchmarks import tools
from dexsim.cli import machine
from dexsim.learning import graphed
from dexsim.learning.ranks import seed_all
from dexsim.learning.runner import Runner
from dexsim.tasks import make_env

KINDS = {"recorded": True, "plain": False}
ROW = {"reward": "step_reward", "std": "Policy/mean_std", "rate": "Loss/learning_rate", "update_s": "learn_s"}


def learn(cfg: dict[str, Any], seed: int, recorded: bool, iterations: int) -> dict[str, list[float]]:
    """One training, by iteration: mean reward a step, mean standard deviation of the actions, learning rate, seconds of
    the update."""
    device = cfg["device"]
    seed_all(seed)
    env = make_env(cfg, cfg["worlds"], device, seed, cfg["sim"]["engine"])
    runner = Runner(env, {**cfg, "graphed_update": recorded, "seed": seed}, machine.versions())
    if recorded and not device.startswith("cuda"):
        runner._updater = graphed.GraphedUpdate(runner.alg)
    rows: dict[str, list[float]] = {name: [] for name in ROW}

    def note(row: dict[str, float]) -> None:
        for name, key in ROW.items():
            rows[name].append(float(row[key]))

    runner.learn(iterations, note)
    env.close()
    return {name: [float(f"{x:.6g}") for x in values] for name, values in rows.items()}


def apart(a: list[float], b: list[float]) -> float:
    """Root mean square distance of two curves."""
    return statistics.fmean((x - y) ** 2 for x, y in zip(a, b, strict=True)) ** 0.5


def main(argv: list[str]) -> dict[str, Any]:
    own, rest = tools.split(argv, {"iterations": "40", "seeds": "0,1", "out": "out/graphed_curves.json"})
    iterations = tools.numbers(own["iterations"], "iterations")[0]
    seeds = [int(s) for s in own["seeds"].split(",")]
    cfg = tools.config(["task=grasp", "worlds=4096", *rest])
    path = Path(own["out"])
    path.parent.mkdir(parents=True, exist_ok=True)
    out: dict[str, Any] = {"benchmark": "graphed_curves", **tools.about(cfg["device"]), "worlds": cfg["worlds"]}
    curves: dict[str, dict[str, list[float]]] = {}
    for seed in seeds:
        for kind, recorded in KINDS.items():
            curves[f"{kind} {seed}"] = found = learn(cfg, seed, recorded, iterations)
            out["curves"] = curves
            path.write_text(json.dumps(out, indent=1) + "\n")
            first, last = found["reward"][0], statistics.fmean(found["reward"][-5:])
            print(
                f"  {kind:9s} seed {seed}: reward a step {first:.4f} at first, {last:.4f} in the last five, update"
                f" {statistics.median(found['update_s']):.4f} s",
                flush=True,
            )
            gc.collect()
            if cfg["device"].startswith("cuda"):
                torch.cuda.empty_cache()
    reward = {name: found["reward"] for name, found in curves.items()}
    out["kinds_apart"] = [apart(reward[f"recorded {s}"], reward[f"plain {s}"]) for s in seeds]
    pairs = [(kind, a, b) for kind in KINDS for a, b in zip(seeds, seeds[1:], strict=False)]
    out["seeds_apart"] = [apart(reward[f"{kind} {a}"], reward[f"{kind} {b}"]) for kind, a, b in pairs]
    out["last_five"] = {name: statistics.fmean(x[-5:]) for name, x in reward.items()}
    path.write_text(json.dumps(out, indent=1) + "\n")
    print(json.dumps({k: v for k, v in out.items() if k != "curves"}), flush=True)
    return out


if __name__ == "__main__":
    tools.command(main, __doc__)
