"""How long a diagnosis takes, and on what: python -m benchmarks.diagnose [joints=12] [seconds=60] [device=cpu]
[hidden=true] [replay=mujoco].

Recordings of the xHand are made in simulation (C MuJoCo, sampled as the hardware samples) with one hidden effect, read
back and diagnosed with the whole catalogue. Kernels are compiled before the clock starts. One JSON line at the end.
With several devices (device=cuda,cuda,cpu) the same recordings are diagnosed on one after the other, a JSON line each,
and one that says whether the answers agree: the same effects on the same joints, and the size of each inside the
other's interval.
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

DEFAULTS = {
    "joints": "12",
    "seconds": "60",
    "device": "cpu",
    "hidden": "true",
    "recordings": "4",
    "seed": "0",
    "next": "false",
    "replay": "mujoco",
    "out": "",
}


def make(folder: Path, count: int, seconds: float, recordings: int, hidden: bool, seed: int) -> tuple[list[Path], str]:
    """Return `recordings` recordings of `count` joints, `seconds` in all; returns their paths and the joint that hides
    something."""
    from dexsim.assets import xhand
    from dexsim.recording import write
    from dexsim.recording.mechanism import drive, mechanism, recorded
    from dexsim.recording.realistic import realistic
    from dexsim.recording.schema import COMMANDS, Series

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


def cores() -> int:
    """Return CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def disagreements(a: dict, b: dict) -> list[str]:
    """In what two answers (as diagnosis.json holds them) differ; empty where they agree."""
    out = [] if a["verdict"] == b["verdict"] else [f"verdict {a['verdict']}, {b['verdict']}"]
    mine, other = ({(f["effect"], *f["where"]["joints"]): f for f in d["findings"]} for d in (a, b))
    out += [f"{' '.join(name)}: found by one only" for name in mine.keys() ^ other.keys()]
    for name in mine.keys() & other.keys():
        for key, p in mine[name]["parameters"].items():
            q = other[name]["parameters"].get(key)
            if q is None or isinstance(p["value"], str) or p["value"] is None:
                if q is None or q["value"] != p["value"]:
                    out.append(f"{' '.join(name)} {key}: {p['value']}, {q and q['value']}")
                continue
            inside = [
                np.all(
                    (np.asarray(x["low"]) <= np.asarray(y["value"])) & (np.asarray(y["value"]) <= np.asarray(x["high"]))
                )
                for x, y in ((p, q), (q, p))
            ]
            if not all(inside):
                out.append(f"{' '.join(name)} {key}: {p['value']}, {q['value']}")
    h, g = a["held_out"], b["held_out"]
    if h["after"] and abs(h["after"] / g["after"] - 1) > 0.05:
        out.append(f"error after {h['after']:.3g}, {g['after']:.3g}")
    return out


def main(argv: list[str]) -> int:
    """Makes the recordings, warms the kernels up, diagnoses, prints."""
    if argv and argv[0] in ("-h", "--help"):
        print(__doc__)
        return 0
    s = options(argv, DEFAULTS)
    from dexsim.gap import demo
    from dexsim.gap.command import available
    from dexsim.gap.diagnosis import Settings, diagnose, save
    from dexsim.sim.quiet import quiet_warp

    asked = s["device"].split(",")
    quiet_warp("cpu" if asked == ["cpu"] else "cuda")
    devices = [available(d) for d in asked]
    answers: list[dict] = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(s["out"] or scratch)
        folder.mkdir(parents=True, exist_ok=True)
        start = time.perf_counter()
        paths, where = make(
            folder, int(s["joints"]), float(s["seconds"]), int(s["recordings"]), s["hidden"] == "true", int(s["seed"])
        )
        print(f"recordings made in {time.perf_counter() - start:.1f} s", flush=True)
        small, model, servo, _ = demo.make(folder / "warm", seconds=2.0)
        for device in dict.fromkeys(devices):  # compiles what is compiled once
            start = time.perf_counter()
            diagnose(
                Settings(
                    small[:2],
                    folder / "warm",
                    None,
                    str(model),
                    str(servo),
                    device=device,
                    next_recording=False,
                    allowed={"lag"},
                    replay=s["replay"],
                ),
                say=lambda _: None,
            )
            print(f"{device}: kernels ready in {time.perf_counter() - start:.1f} s", flush=True)
        for k, device in enumerate(devices):
            start = time.perf_counter()
            d = diagnose(
                Settings(
                    paths,
                    folder / f"out{k}",
                    None,
                    device=device,
                    next_recording=s["next"] == "true",
                    replay=s["replay"],
                ),
                say=lambda text: print(text, flush=True),
            )
            save(d, folder / f"out{k}")
            took = time.perf_counter() - start
            total = sum(d.shares.values())
            for stage, seconds in sorted(d.shares.items(), key=lambda x: -x[1]):
                print(f"{stage:<28}{seconds:8.2f} s {100 * seconds / total:6.1f} %")
            found = [(f["effect"], f["where"]["joints"], f["confidence"]) for f in d.data["findings"]]
            print(json.dumps({
                "benchmark": "diagnose", "joints": int(s["joints"]), "recorded_s": float(s["seconds"]),
                "device": device, "seconds": round(took, 2),
                "shares": {k: round(v / total, 4) for k, v in d.shares.items()}, "verdict": d.data["verdict"],
                "found": found,
                "hidden": ["coulomb_friction", where] if s["hidden"] == "true" else None,
                "cpu": platform.processor() or platform.machine(), "cores": cores(),
            }), flush=True)  # fmt: skip
            answers.append({"device": device, "seconds": took, "data": d.data})
    if len(answers) > 1:
        print(json.dumps({"benchmark": "diagnose", "compared": [a["device"] for a in answers],
                          "seconds": [round(a["seconds"], 2) for a in answers],
                          "of_the_last": [round(a["seconds"] / answers[-1]["seconds"], 3) for a in answers],
                          "agree": [disagreements(a["data"],
                                                  answers[-1]["data"]) or True for a in answers[:-1]]}))  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:]))
