"""How long a diagnosis takes, and on what: python -m benchmarks.diagnose [joints=12] [seconds=60] [device=cpu]
[hidden=true] [replay=mujoco].

Recordings of the xHand are made in simulation (C MuJoCo, sampled as the hardware samples) with one hidden effect, read
back and diagnosed with the whole catalogue. Kernels are compiled before the clock starts. One JSON line at the end.
"""

from __future__ import annotations

import json
import os
import platform
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.options import options
from dexsim.console.ending import guard

DEFAULTS = {"joints": 12, "seconds": 60, "device": "cpu", "hidden": True, "recordings": 4, "seed": 0, "next": False,
            "replay": "mujoco", "out": ""}  # fmt: skip


def make(folder: Path, count: int, seconds: float, recordings: int, hidden: bool, seed: int) -> tuple[list[Path], str]:
    """Return `recordings` recordings of `count` joints, `seconds` in all; returns their paths and the joint that hides
    something."""
    from dexsim.recording import write
    from dexsim.recording.mechanism import drive, mechanism, recorded
    from dexsim.recording.realistic import realistic
    from dexsim.recording.schema import COMMANDS, Series
    from tools.assets import xhand

    rng = np.random.default_rng(seed)
    joints = list(xhand.JOINTS) if count == 12 else ["mid_joint1", "mid_joint2", "ring_joint1", *xhand.JOINTS][:count]
    m = mechanism()
    where = "mid_joint1"
    if hidden:
        m.table.set(where, "coulomb_friction", 3.5 * float(m.column("coulomb_friction")[m.joints.index(where)]))
    limits = m.limits
    paths = []
    for k in range(recordings):
        t = np.arange(0.0, seconds / recordings, 0.01)
        value = np.empty((len(t), count))
        start = np.full(12, np.nan)
        for j, joint in enumerate(joints):
            low, high = limits[m.joints.index(joint)]
            middle, half = 0.5 * (low + high), 0.22 * (high - low)
            if joint.startswith("thumb") or joint == "index_bend_joint":  # clear of the fingers
                middle, half = low + (0.2 if joint.startswith("thumb") else 0.5) * (high - low), 0.12 * (high - low)
            f = rng.uniform(0.15, 0.9, 3)
            value[:, j] = middle + half * (sum(np.sin(2 * np.pi * x * t + rng.uniform(0, 6)) for x in f) / 2.2)
            start[m.joints.index(joint)] = value[0, j]
        series = Series(t, value, COMMANDS, t.copy())
        run = drive(m, series, joints, float(t[-1]), start, timestep=0.002)
        r = realistic(recorded(run, m, series, joints), seed=seed * 100 + k)
        r.meta["servo"] = ""  # what is hidden is not told
        pick = [r.joints.index(j) for j in joints]
        for s in (r.commands, r.states.position, r.states.effort):
            s.value = s.value[:, pick]
        r.joints = tuple(joints)
        r.meta["joint_names"] = ",".join(joints)
        path = folder / f"motion_{k + 1}.mcap"
        write(path, r)
        paths.append(path)
    return paths, where


def main(argv: list[str]) -> int:
    """Makes the recordings, warms the kernels up, diagnoses, prints."""
    s = options(argv, DEFAULTS)
    from dexsim.gap import demo
    from dexsim.gap.command import available
    from dexsim.gap.diagnosis import Settings, diagnose, save
    from dexsim.sim.quiet import quiet_warp

    quiet_warp("cpu" if s["device"] == "cpu" else "cuda")
    device = available(s["device"])
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(s["out"] or scratch)
        folder.mkdir(parents=True, exist_ok=True)
        start = time.perf_counter()
        paths, where = make(folder, s["joints"], s["seconds"], s["recordings"], s["hidden"], s["seed"])
        print(f"recordings made in {time.perf_counter() - start:.1f} s", flush=True)
        small, model, servo, _ = demo.make(folder / "warm", seconds=2.0)
        same = {"device": device, "replay": s["replay"]}
        start = time.perf_counter()
        warm = Settings(small[:2], folder / "warm", None, str(model), str(servo), next_recording=False,
                        allowed={"lag"}, **same)  # fmt: skip
        diagnose(warm, say=lambda _: None)
        print(f"{device}: kernels ready in {time.perf_counter() - start:.1f} s", flush=True)
        start = time.perf_counter()
        d = diagnose(Settings(paths, folder / "out", None, next_recording=s["next"], **same),
                     say=lambda text: print(text, flush=True))  # fmt: skip
        save(d, folder / "out")
        took = time.perf_counter() - start
    total = sum(d.shares.values())
    for stage, seconds in sorted(d.shares.items(), key=lambda x: -x[1]):
        print(f"{stage:<28}{seconds:8.2f} s {100 * seconds / total:6.1f} %")
    print(json.dumps({
        "benchmark": "diagnose", "joints": s["joints"], "recorded_s": float(s["seconds"]), "device": device,
        "seconds": round(took, 2), "shares": {k: round(v / total, 4) for k, v in d.shares.items()},
        "verdict": d.data["verdict"],
        "found": [(f["effect"], f["where"]["joints"], f["confidence"]) for f in d.data["findings"]],
        "hidden": ["coulomb_friction", where] if s["hidden"] else None,
        "cpu": platform.processor() or platform.machine(), "cores": len(os.sched_getaffinity(0)),
    }), flush=True)  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:], __doc__))
