"""Where a physics step's time goes on a GPU: microseconds of each stage of MuJoCo-Warp, in the closed grasp of
benchmarks.step.

    python -m benchmarks.trace device=cuda:0 [worlds=8192] [steps=30] [setting="ccd_tolerance 1e-5"] [any setting of
    train.py]

Stages are MuJoCo-Warp's own marks, timed by events inside the recorded graph; with them the distributions that decide
the
cost: contacts, constraint rows and Newton iterations of a world. setting: one of those of benchmarks.physics.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import torch
import warp as wp
from mujoco_warp._src.warp_util import EventTracer

from benchmarks import tools
from benchmarks.physics import SETTINGS, edited
from dexsim.errors import UserError
from dexsim.tasks import make_env


def _flat(trace: dict, path: str = "") -> dict[str, float]:
    """Stage path -> microseconds of the last replay, all its calls together."""
    out: dict[str, float] = {}
    for name, (ms, inner) in trace.items():
        out[path + name] = 1e3 * float(np.sum(ms))
        out |= _flat(inner, f"{path}{name}/")
    return out


def _spread(values: Any) -> list[float]:
    v = np.asarray(values, float)
    return [round(float(v.mean()), 2), float(np.percentile(v, 99)), float(v.max())]


def stages(e: Any, steps: int) -> dict[str, float]:
    """Microseconds of each stage of a physics step, its path as name: medians of `steps` replays of a recorded one."""
    found: dict[str, list[float]] = {}
    with wp.ScopedDevice(e.device), EventTracer() as tracer:
        with wp.ScopedCapture() as capture:
            e.physics_step()
        for _ in range(steps):
            wp.capture_launch(capture.graph)
            wp.synchronize_device()
            for name, us in _flat(tracer.trace()).items():
                found.setdefault(name, []).append(us)
    return {name: round(float(np.median(us)), 1) for name, us in found.items()}


def main(argv: list[str]) -> dict:
    own, rest = tools.split(argv, {"steps": "30", "setting": "chosen"})
    cfg = tools.config(rest)
    device = cfg["device"]
    if not device.startswith("cuda"):
        raise UserError("benchmarks.trace: needs a CUDA device (the marks are CUDA events); on a CPU use"
                        " benchmarks.step")
    if own["setting"] not in SETTINGS:
        raise UserError(f"benchmarks.trace: setting={own['setting']}: there are: {', '.join(SETTINGS)}")
    chosen = SETTINGS[own["setting"]]
    with edited(chosen.edit):
        env = make_env({**cfg, "sim": {**cfg["sim"], **chosen.sim}}, cfg["worlds"], device, 0, "warp")
    tools.close_hand(env)
    e = env.engine
    median = stages(e, tools.numbers(own["steps"], "steps")[0])
    torch.cuda.synchronize()
    d = e.d
    nacon = int(d.nacon.numpy()[0])
    types = e.mjm.geom_type[d.contact.geom.numpy()[:nacon]]
    pairs, counts = np.unique(np.sort(types, axis=1), axis=0, return_counts=True)
    for name, us in median.items():
        print(f"  {'    ' * name.count('/')}{name.rpartition('/')[2]:32s}{us:10.1f} us")
    out = {
        "benchmark": "trace", **tools.about(device), "setting": own["setting"], "worlds": e.n, "stages_us": median,
        "contacts": nacon / e.n,
        "rows_mean_p99_max": _spread(d.nefc.numpy()), "newton_mean_p99_max": _spread(d.solver_niter.numpy()),
        "contacts_by_geom_types": {f"{a}-{b}": round(int(c) / e.n, 3) for (a, b), c in zip(pairs, counts, strict=True)},
        "collisions_tested": int(d.ncollision.numpy()[0]) / e.n if hasattr(d, "ncollision") else None,
    }  # fmt: skip
    print(json.dumps(out), flush=True)
    return out


if __name__ == "__main__":
    tools.command(main, __doc__)
