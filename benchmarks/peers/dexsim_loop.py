"""dexsim's full environment step on the hand and box: python -m benchmarks.peers.dexsim_loop SCENE_FOLDER WORLDS
DEVICE."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import torch

from benchmarks.peers.scene import SETTINGS
from dexsim.cli import machine
from dexsim.cli import start as start_up
from dexsim.paths import CONFIGS
from dexsim.tasks import make_env


def main(folder: str, worlds: int, device: str) -> dict:
    """Milliseconds of one environment step of all worlds in the grasp."""
    about = json.loads((Path(folder) / "scene.json").read_text())
    engine = "warp" if device.startswith("cuda") else "auto"
    cfg = start_up.for_train([*SETTINGS, f"device={device}", f"worlds={worlds}", f"sim.engine={engine}"], CONFIGS).cfg
    machine.set_threads(cfg["device"])
    env = make_env(cfg, worlds, cfg["device"], 0, engine)

    def action(key: str) -> torch.Tensor:  # task.action.mode=absolute: [-1, 1] spans the joint's range
        target = torch.tensor(about[key], dtype=torch.float32, device=env.device)
        return ((target - env.q_mid) / env.q_half).repeat(worlds, 1)

    start_action, closed = action("start"), action("closed")
    for k in range(about["closing"]):
        env.step(start_action if k < 17 else closed)
    sync = torch.cuda.synchronize if env.device.startswith("cuda") else (lambda: None)
    sync()
    start = time.perf_counter()
    for _ in range(about["timed"]):
        env.step(closed)
    sync()
    seconds = (time.perf_counter() - start) / about["timed"]
    height = env.object_pose[:, 2]
    return {"peer": "dexsim", "worlds": worlds, "ms": 1e3 * seconds, "height": float(height.median()),
            "in_hand": float((height > 0.03).float().mean()), "contacts": env.engine.peaks()["contacts"]}


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1], int(sys.argv[2]), sys.argv[3])))
