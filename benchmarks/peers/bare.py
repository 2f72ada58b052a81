"""Bare MuJoCo-Warp on the written scene: physics steps in a recorded graph and nothing else. Needs no dexsim:

    python bare.py SCENE_FOLDER WORLDS DEVICE        (with whichever mujoco and mujoco_warp this interpreter has)
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp


def main(folder: str, worlds: int, device: str) -> dict:
    """Milliseconds of one control period (`decimation` physics steps) of all worlds in the grasp."""
    about = json.loads((Path(folder) / "scene.json").read_text())
    model = mujoco.MjModel.from_xml_path(str(Path(folder) / "scene.xml"))
    data = mujoco.MjData(model)
    data.qpos[:12] = about["start"]
    mujoco.mj_forward(model, data)
    wp.init()
    with wp.ScopedDevice(device):
        m = mjw.put_model(model)
        d = mjw.put_data(model, data, nworld=worlds, nconmax=about["sim"]["nconmax"], njmax=about["sim"]["njmax"])
        if hasattr(m.opt, "warn_overflow"):
            m.opt.warn_overflow = False
        rng, qpos = np.random.default_rng(0), d.qpos.numpy()
        qpos[:, :12] += about["spread"]["joint"] * rng.uniform(-1, 1, (worlds, 12))
        qpos[:, 12:15] += np.array([about["spread"][k] for k in ("xy", "xy", "z")]) * rng.uniform(-1, 1, (worlds, 3))
        wp.copy(d.qpos, wp.array(qpos.astype(np.float32), dtype=float))

        def step() -> None:
            for _ in range(about["decimation"]):
                mjw.step(m, d)

        def send(target: list[float]) -> None:
            wp.copy(d.ctrl, wp.array(np.tile(np.asarray(target, np.float32), (worlds, 1)), dtype=float))

        send(about["start"])
        step()  # compiles
        with wp.ScopedCapture() as capture:
            step()
        graph = capture.graph
        for k in range(2, about["closing"]):
            if k == 17:
                send(about["closed"])
            wp.capture_launch(graph)
        wp.synchronize_device(device)
        start = time.perf_counter()
        for _ in range(about["timed"]):
            wp.capture_launch(graph)
        wp.synchronize_device(device)
        seconds = (time.perf_counter() - start) / about["timed"]
        qpos, contacts = d.qpos.numpy(), int(d.nacon.numpy()[0])
    return {"peer": f"mujoco-warp {mjw.__version__ if hasattr(mjw, '__version__') else mujoco.__version__}",
            "worlds": worlds, "ms": 1e3 * seconds,
            "height": float(np.median(qpos[:, 14])), "in_hand": float((qpos[:, 14] > 0.03).mean()),
            "contacts": contacts / worlds}


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1], int(sys.argv[2]), sys.argv[3])))
