"""Time of the touch kernel over worlds, shapes, grid sizes and outputs, beside bytes, operations and other ways to do
it.

    python -m benchmarks.touch [device=cuda:0] [worlds=1024,4096,8192,16384] [alternatives=true] [variants=false]

The xHand half closed on an object (random joint angles and poses), 5 x 120 taxels, dexsim/configs/tactile/default.yaml;
launches are captured in a graph and replayed, as in training; median microseconds. Rows: shape; `solver` (the contact
force spread over the taxels, the default) or `spring` (the sum of springs); `raw` if every taxel's force is written;
`grid 32` and the
like: the rock baked with so many samples along its longest axis. `others=false`: fingers do not feel each other.
Behind the times of the largest number of worlds: megabytes and millions of operations that the layout asks for (see
`touch_cost.py`), and what share of the device's peak that is, where the device is an H200.
The alternatives find the same taxels' depths of the same object in the same poses (`touch_alternatives.py`); `agree` is
their summed force over ours. variants=true times the kernel's launch choices (threads a block, registers a thread)
instead.
"""

from __future__ import annotations

import json

import mujoco
import numpy as np
import torch
import warp as wp
import yaml

from benchmarks import tools
from benchmarks.touch_alternatives import alternatives
from benchmarks.touch_cost import Cost, cost_of
from dexsim.assets import xhand
from dexsim.assets.objects import library
from dexsim.errors import UserError
from dexsim.hand import load_hand
from dexsim.paths import CONFIGS
from dexsim.tactile import ShapeSet, Tactile, hand_layout
from dexsim.tactile.posed import PosedEngine
from dexsim.tactile.shapes import TouchShape, bake_convex

GRIDS = (32, 64, 128, 256)
"""Samples along the longest axis; the library's own grids have 64."""
SHAPES = {
    "box": ("box", (0.03, 0.024, 0.02)),
    "sphere": ("sphere", (0.03, 0.0, 0.0)),
    "grid": ("rock", (1.0, 0.0, 0.0)),
    **{f"grid {n}": (f"rock{n}", (1.0, 0.0, 0.0)) for n in GRIDS},
}
TARGET_US = {4096: 100.0, 16384: 400.0}  # one H200, raw taxels written
UNIQUE = 64
VARIANTS = [(128, 0), (32, 0), (64, 0), (256, 0), (128, 80), (128, 64), (128, 48), (256, 64)]


class Scene:
    """Worlds whose hands hold one shape; the solver has a contact wherever the springs would."""

    def __init__(self, worlds: int, shape: str, cfg: dict, device: str, shapes: ShapeSet, poses: tuple):
        self.layout, self.shapes = hand_layout(load_hand()), shapes
        self.tips = [xhand.tip_skin_mesh(f)[0] for f in xhand.FINGERS]
        name, size = SHAPES[shape]
        self.shape, self.size = shapes.index(name), torch.tensor(size)
        self.engine = PosedEngine(worlds, [*self.layout.bodies, "object"], self.layout.names, device)
        pick = torch.arange(worlds) % UNIQUE
        self.engine.t.xpos[:] = torch.as_tensor(poses[0], dtype=torch.float32)[pick].to(device)
        self.engine.t.xmat[:] = torch.as_tensor(poses[1], dtype=torch.float32)[pick].to(device)
        spring = self.touch({**cfg, "sum": "spring", "raw": True})
        spring.launch()
        self.engine.t.pair_normal[:] = spring.force_clean
        self.lit = float((spring.raw_clean > 0).float().mean())

    def touch(self, cfg: dict, **kw: object) -> Tactile:
        touch = Tactile(
            self.engine, self.layout, self.shapes, "object", cfg, pairs=self.layout.names, tips=self.tips, **kw
        )
        touch.shape_id[:], touch.shape_size[:] = self.shape, self.size
        return touch


def grasp_poses(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position [U, 6, 3] and rotation [U, 6, 3, 3] of the five distal links and an object between them, and the hand's
    and the object's qpos [U, 19]."""
    model = mujoco.MjModel.from_xml_path(str(xhand.xml_path()))
    data = mujoco.MjData(model)
    low, high = xhand.joint_limits().T
    tips = [model.body(b).id for b in xhand.TIP_BODIES]
    sites = [model.site(s).id for s in xhand.TIP_SITES]
    pos, rot, qpos = np.zeros((UNIQUE, 6, 3)), np.zeros((UNIQUE, 6, 3, 3)), np.zeros((UNIQUE, len(low) + 7))
    for u in range(UNIQUE):
        data.qpos[: len(low)] = low + (high - low) * rng.uniform(0.45, 0.65, len(low))
        mujoco.mj_kinematics(model, data)
        pos[u, :5], rot[u, :5] = data.xpos[tips], data.xmat[tips].reshape(5, 3, 3)
        pos[u, 5] = data.site_xpos[sites].mean(0) + rng.uniform(-5e-3, 5e-3, 3)
        q, r = np.linalg.qr(rng.normal(size=(3, 3)))
        rot[u, 5] = q * np.sign(np.linalg.det(q))
        qpos[u, : len(low)], qpos[u, len(low) : -4] = data.qpos[: len(low)], pos[u, 5]
        mujoco.mju_mat2Quat(qpos[u, -4:], rot[u, 5].ravel())
    return pos, rot, qpos


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


def shape_set(device: str) -> ShapeSet:
    """The library, and the rock once more for each size of grid."""
    corners = library()["rock"].hulls[0]
    length = np.ptp(corners, axis=0).max()
    rocks = [TouchShape(f"rock{n}", "grid", bake_convex(corners, spacing=(length + 4e-3) / (n - 1))) for n in GRIDS]
    return ShapeSet([*library().values(), *rocks], device)


def cases(default: dict, full: dict, variants: bool) -> dict[str, tuple[str, dict, dict]]:
    """Rows: name -> shape, settings, choices of the launch."""
    rows = {}
    if variants:
        for shape, mode in (("grid", "solver"), ("box", "solver"), ("grid", "spring")):
            for block, registers in VARIANTS:
                name = f"{shape} {mode} raw, block {block}, registers {registers or 'free'}"
                rows[name] = shape, {**default, "sum": mode, "raw": True}, {"block_dim": block, "registers": registers}
        return rows
    for shape in ("box", "sphere", "grid"):
        for mode in ("solver", "spring"):
            rows[f"{shape} {mode}"] = shape, {**default, "sum": mode}, {}
            rows[f"{shape} {mode} raw"] = shape, {**default, "sum": mode, "raw": True}, {}
    for n in GRIDS:
        rows[f"grid {n} solver raw"] = f"grid {n}", {**default, "sum": "solver", "raw": True}, {}
    for shape in ("box", "sphere", "grid"):
        rows[f"{shape} spring raw others=false"] = shape, {**default, "sum": "spring", "raw": True, "others": False}, {}
    rows["grid solver raw others=false"] = "grid", {**default, "sum": "solver", "raw": True, "others": False}, {}
    rows["grid solver raw imperfect"] = "grid", {**full, "raw": True}, {}
    return rows


def others_ways(scene: Scene, shape: str, default: dict, poses: tuple, repeats: int) -> dict[str, tuple[float, float]]:
    """Alternative -> (microseconds, its summed force over ours)."""
    touch = scene.touch({**default, "sum": "spring", "raw": True, "others": False})
    touch.launch()
    ours = float(touch.raw_clean.sum())
    name, size = SHAPES[shape]
    found = {}
    for what, make in alternatives(scene, touch, name, np.asarray(size), poses[2]).items():
        way = make()
        us = time_us(way, repeats)
        found[f"{shape}: {what} ({way.note})"] = us, float(way.forces().sum()) / ours
        del way
    return found


def arguments(argv: list[str]) -> dict[str, str]:
    own, rest = tools.split(
        argv,
        {
            "device": "cuda:0" if torch.cuda.is_available() else "cpu",
            "worlds": "",
            "alternatives": "true",
            "variants": "false",
        },
    )
    if rest:
        raise UserError(f"benchmarks.touch: '{rest[0]}' is not one of {', '.join(k + '=' for k in own)}")
    return own


def main(argv: list[str]) -> dict:
    args = arguments(argv)
    wp.config.log_level = wp.LOG_WARNING
    device = args["device"]
    cpu, variants = device == "cpu", args["variants"] == "true"
    if cpu and variants:
        raise UserError("benchmarks.touch: variants=true needs a CUDA device; the CPU has one kernel")
    worlds = args["worlds"] or ("16,128" if cpu else "4096,16384" if variants else "1024,4096,8192,16384")
    worlds = tools.numbers(worlds, "worlds")
    folder = CONFIGS / "tactile"
    default = yaml.safe_load((folder / "default.yaml").read_text())
    full = {**default, **yaml.safe_load((folder / "full.yaml").read_text())}
    del full["defaults"]
    rows = cases(default, full, variants)
    shapes, poses = shape_set(device), grasp_poses(np.random.default_rng(0))
    us: dict[str, list[float]] = {name: [] for name in rows}
    costs: dict[str, Cost] = {}
    lit, agree = {}, {}
    for n in worlds:
        for shape in SHAPES:
            mine = {name: row for name, row in rows.items() if row[0] == shape}
            if not mine:
                continue
            scene = Scene(n, shape, default, device, shapes, poses)
            lit[shape] = round(scene.lit, 2)
            for name, (_, cfg, choices) in mine.items():
                touch = scene.touch(cfg, **choices)
                us[name].append(round(time_us(touch, 3 if cpu else 50), 1))
                costs[name] = cost_of(touch, SHAPES[shape][0], n)
            if args["alternatives"] == "true" and not variants and shape in ("box", "sphere", "grid"):
                for name, (t, ratio) in others_ways(scene, shape, default, poses, 3 if cpu else 20).items():
                    us.setdefault(name, []).append(round(t, 1))
                    agree[name] = round(ratio, 3)
    h200 = not cpu and "H200" in torch.cuda.get_device_name(device)
    print(
        f"{'touch [us], worlds:':52s}"
        + "".join(f"{n:>9d}" for n in worlds)
        + "      MB   MFLOP"
        + ("  of peak" if h200 else "")
    )
    for name, times in us.items():
        line = f"{name:52s}" + "".join(f"{t:9.1f}" for t in times)
        if name in costs:
            c = costs[name]
            line += f"{c.bytes / 1e6:8.1f}{c.flops / 1e6:8.1f}" + (
                f"{100 * c.floor_us() / times[-1]:7.0f} %" if h200 else ""
            )
        print(line + (f"   agree {agree[name]:.3f}" if name in agree else ""))
    judged = [
        t for name, t in us.items() if "raw" in name and "imperfect" not in name and not name.startswith("grid 2")
    ]
    if variants:
        best = min((name for name in us if name.startswith("grid solver")), key=lambda name: us[name][-1])
        out = {"best": best, "us": us[best]}
    else:
        worst = {n: max(t[i] for t in judged) for i, n in enumerate(worlds)}
        out = {"lit": lit, "worst_us_raw": worst,
               "taxels_per_s": {n: round(600 * n / t * 1e6) for n, t in worst.items()},
               "ratio_to_target": {n: round(t / TARGET_US[n], 3) for n, t in worst.items() if n in TARGET_US},
               "us": us, "agree": agree, "bytes": {k: c.bytes for k, c in costs.items()},
               "flops": {k: c.flops for k, c in costs.items()}}  # fmt: skip
    out = {"benchmark": "touch", **tools.about(device), "worlds": worlds, **out}
    print(json.dumps(out))
    return out


if __name__ == "__main__":
    tools.command(main, __doc__)
