"""Judge one policy in one or more worlds: python -m benchmarks.touch_matters.judge checkpoint=PATH row=R seed=S
out=FOLDER worlds=training,wide [episodes=512] [cap=60] [threads=1] [states=true]. Writes FOLDER/<world>.json, and with
`states` FOLDER/<world>_states.npz (joints and cube of a few trials, for a film)."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np

from benchmarks import tools
from benchmarks.touch_matters import rows
from dexsim.cli import build
from dexsim.cli import start as start_up
from dexsim.learning import checkpoint
from dexsim.learning.ppo import load_policy
from dexsim.paths import CONFIGS

OWN = {"checkpoint": "", "row": "", "seed": "0", "out": "", "worlds": "training", "episodes": "512", "cap": "60",
       "threads": "1", "states": "false"}  # fmt: skip
TRIALS_SEED = 1000


def judge(own: dict[str, str], world: str, extra: list[str]) -> dict:
    """Metrics of the policy in a world, and what it was."""
    cpu = world in rows.ON_CPU
    begun = start_up.for_play(
        [
            f"checkpoint={own['checkpoint']}", f"episodes={own['episodes']}", f"seed={TRIALS_SEED}", "video=false",
            f"task.evaluation.cap_s={own['cap']}", *rows.WORLDS[world],
            *(["device=cpu", f"sim.threads={own['threads']}"] if cpu else []), *extra,
        ],
        CONFIGS,
    )  # fmt: skip
    env = build.build_env(begun.cfg, None, {"world": world})
    checkpoint.check_layout(begun.data, checkpoint.layout_of(env), own["checkpoint"])
    policy = load_policy(begun.data, env, own["checkpoint"])
    found = env.evaluate(policy, int(own["episodes"]), TRIALS_SEED)
    if own["states"] == "true":
        frames = found["frames"]
        np.savez_compressed(
            Path(own["out"]) / f"{world}_states.npz",
            **{f"qpos_{i}": q.astype(np.float32) for i, q in enumerate(frames["qpos"])},
            **{f"force_{i}": o["force"].astype(np.float32) for i, o in enumerate(frames["overlay"])},
            half=np.array([m.geom_size[m.geom("object_box").id] for m in frames["model"]]),
            label=np.array(frames["label"]), dt=frames["dt"], names=np.array(frames["names"]),
        )  # fmt: skip
    build.close(env)
    return {
        "row": own["row"],
        "seed": int(own["seed"]),
        "world": world,
        "steps": int(begun.data["steps"]),
        "iteration": int(begun.data["iteration"]),
        "metrics": found["metrics"],
    }


def main(argv: list[str]) -> None:
    own, extra = tools.split(argv, OWN)
    Path(own["out"]).mkdir(parents=True, exist_ok=True)
    for world in own["worlds"].split(","):
        data = judge(own, world, extra)
        target = Path(own["out"]) / f"{world}.json"
        part = target.with_suffix(".part")
        part.write_text(json.dumps(data))
        os.replace(part, target)
        average = data["metrics"]["consecutive_successes"]["average"]
        print(f"{own['row']} {own['seed']} {world}: {average:.2f}", flush=True)


if __name__ == "__main__":
    tools.command(main, __doc__)
