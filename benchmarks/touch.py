"""Time of the touch kernel: `python -m benchmarks.touch`.

The xHand half closed on an object (random joint angles and poses), 5 x 120 taxels, other fingers felt too; the launches
are captured in a graph and replayed, as in training. Prints a table, then one JSON line.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import mujoco
import numpy as np
import torch
import warp as wp
import yaml

from dexsim.assets import xhand
from dexsim.assets.objects import library
from dexsim.tactile import ShapeSet, Tactile, tip_points, xhand_layout
from dexsim.tactile.posed import PosedEngine

SHAPES = {
    "box": ("box", (0.03, 0.024, 0.02)),
    "sphere": ("sphere", (0.03, 0.0, 0.0)),
    "grid": ("rock", (1.0, 0.0, 0.0)),
}
TARGET_MS = {4096: 0.1, 16384: 0.4}  # one H200, raw taxels written
UNIQUE = 64


def grasp_poses(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Position [U, 6, 3] and rotation [U, 6, 3, 3] of the five distal links and an object between them."""
    model = mujoco.MjModel.from_xml_path(str(xhand.xml_path()))
    data = mujoco.MjData(model)
    low, high = xhand.joint_limits().T
    tips = [model.body(b).id for b in xhand.TIP_BODIES]
    sites = [model.site(s).id for s in xhand.TIP_SITES]
    pos, rot = np.zeros((UNIQUE, 6, 3)), np.zeros((UNIQUE, 6, 3, 3))
    for u in range(UNIQUE):
        data.qpos[: len(low)] = low + (high - low) * rng.uniform(0.45, 0.65, len(low))
        mujoco.mj_kinematics(model, data)
        pos[u, :5], rot[u, :5] = data.xpos[tips], data.xmat[tips].reshape(5, 3, 3)
        pos[u, 5] = data.site_xpos[sites].mean(0) + rng.uniform(-5e-3, 5e-3, 3)
        q, r = np.linalg.qr(rng.normal(size=(3, 3)))
        rot[u, 5] = q * np.sign(np.linalg.det(q))
    return pos, rot


def build(worlds: int, shape: str, cfg: dict, device: str) -> Tactile:
    layout = xhand_layout()
    tips = tip_points(mujoco.MjModel.from_xml_path(str(xhand.xml_path())), xhand.TIP_GEOMS)
    name, size = SHAPES[shape]
    shapes = ShapeSet(list(library().values()), device)
    engine = PosedEngine(worlds, [*layout.bodies, "object"], layout.names, device)
    pos, rot = grasp_poses(np.random.default_rng(0))
    pick = torch.arange(worlds) % UNIQUE
    engine.t.xpos[:] = torch.as_tensor(pos, dtype=torch.float32)[pick].to(device)
    engine.t.xmat[:] = torch.as_tensor(rot, dtype=torch.float32)[pick].to(device)
    touch = Tactile(engine, layout, shapes, "object", cfg, pairs=layout.names, tips=tips)
    touch.shape_id[:] = shapes.index(name)
    touch.shape_size[:] = torch.tensor(size)
    # the solver has a contact wherever the springs would
    spring = Tactile(engine, layout, shapes, "object", {**cfg, "sum": "spring"}, tips=tips)
    spring.shape_id[:], spring.shape_size[:] = touch.shape_id, touch.shape_size
    spring.launch()
    engine.t.pair_normal[:] = spring.force_clean
    return touch


def time_us(touch: Tactile, repeats: int) -> float:
    """Median time of one launch sequence [us], replayed from a graph."""
    device = touch.device
    touch.launch()  # compile outside the capture
    with wp.ScopedDevice(device):
        with wp.ScopedCapture() as capture:
            touch.launch()
        times = []
        for _ in range(7):
            wp.synchronize_device()
            with wp.ScopedTimer("touch", print=False, synchronize=True) as timer:
                for _ in range(repeats):
                    wp.capture_launch(capture.graph)
            times.append(timer.elapsed / repeats * 1e3)
    return float(np.median(times))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--device", default="cuda:0" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--worlds", type=int, nargs="+")
    parser.add_argument("--sums", nargs="+", default=["solver", "spring"])
    args = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    cpu = args.device == "cpu"
    worlds = args.worlds or ([16, 128] if cpu else [1024, 4096, 8192, 16384])
    folder = Path(__file__).parents[1] / "configs" / "tactile"
    default = yaml.safe_load((folder / "default.yaml").read_text())
    full = {**default, **yaml.safe_load((folder / "full.yaml").read_text())}
    del full["defaults"]
    rows = []
    print(" worlds   shape     sum   raw imperfect        us   taxels/s  bytes out   lit")
    for n in worlds:
        cases = [(s, m, raw, False) for s in SHAPES for m in args.sums for raw in (False, True)]
        for shape, mode, raw, imperfect in [*cases, ("grid", args.sums[0], True, True)]:
            touch = build(n, shape, {**(full if imperfect else default), "sum": mode, "raw": raw}, args.device)
            us = time_us(touch, 3 if cpu else 50)
            taxels = int(touch.layout.count.sum())
            lit = float((touch.raw_clean > 0).float().mean()) if touch.raw_clean is not None else None
            size = n * touch.layout.pads * (4 + 12 + 4) + (4 * n * taxels if raw else 0)
            rate = n * taxels / us * 1e6
            rows.append({"worlds": n, "shape": shape, "sum": mode, "raw": raw, "imperfect": imperfect,
                         "us": round(us, 2), "taxels_per_s": round(rate), "bytes_out": size, "lit": lit})  # fmt: skip
            print(f"{n:7d} {shape:>7} {mode:>7} {raw!s:>5} {imperfect!s:>9} {us:9.1f} {rate:10.3g} {size:10d}"
                  f" {'' if lit is None else f'{lit:5.2f}'}", flush=True)  # fmt: skip
    judged = [r for r in rows if r["raw"] and not r["imperfect"]]
    worst = {n: max(r["us"] for r in judged if r["worlds"] == n) / 1e3 for n in worlds}
    ratio = {n: round(worst[n] / TARGET_MS[n], 3) for n in worlds if n in TARGET_MS}
    name = torch.cuda.get_device_name(args.device) if not cpu else "cpu"
    out = {"benchmark": "touch", "device": name, "rows": rows, "worst_ms_raw": worst, "ratio_to_target": ratio}
    print(json.dumps(out))


if __name__ == "__main__":
    main()
