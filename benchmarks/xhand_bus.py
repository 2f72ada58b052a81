"""Cost of the bus to a policy: included bundles on the simulated hand by itself, and behind the xHand's own driver on
the strict fake of the vendor's package (cycles of 9.6 ms with their tail, 0.5 % CRC errors with their pauses, encoders
that jitter, one dead taxel board), with the same seeds and objects.

    python -m benchmarks.xhand_bus checkpoint=checkpoints/grasp.pt episodes=20 seconds=6 seed=5000 out=FILE.json

way: direct, bus (virtual time), process (in real time, the driver's child process with it), child (that process alone:
its cycles, and how soon it lets go when it is asked to, and when the loop falls silent). noise: of the actions, over
that of training. camera: s that what is seen of the object is older than in training; ahead: s that the loop carries it
on for that (`dexsim deploy ahead=`).
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch

from benchmarks.options import options
from dexsim import export, intervals
from dexsim.console.ending import guard
from dexsim.deploy import bundle
from dexsim.deploy.driver import PASSIVE, Clock, HandCommand, VirtualClock
from dexsim.deploy.fake_xhand import FakeXHand, Faults
from dexsim.deploy.loop import Loop, LoopSettings
from dexsim.deploy.simulated_hand import SimulatedXHand, faked
from dexsim.deploy.vendor import VendorXHand

FAULTS = "crc=0.005,board=2"
DEFAULTS = {"checkpoint": "checkpoints/grasp.pt", "episodes": "20", "seconds": "6", "seed": "5000", "out": "",
            "ways": "direct,bus", "faults": FAULTS, "noise": "0", "camera": "0", "ahead": "0"}  # fmt: skip


class Later:
    """What sees the object, `delay` s later than the hand's own eye."""

    def __init__(self, eye: object, delay: float):
        self.eye, self.delay, self.past = eye, delay, []

    def __getattr__(self, name: str) -> Callable:
        look = getattr(self.eye, name)

        def seen(now: float) -> tuple | None:
            if (new := look(now)) is not None and (not self.past or new[1] > self.past[-1][1][1]):
                self.past.append((now + self.delay, new))
            there = [x for at, x in self.past if at <= now + 1e-9]
            self.past = self.past[max(len(there) - 1, 0) :]
            return there[-1] if there else self.past[0][1] if self.past else None

        return seen


def episode(
    b: bundle.Bundle, way: str, seed: int, seconds: float, faults: str, noise: float, camera: float, ahead: float
) -> dict:
    """Return one run of a policy: whether it ran to its end, whether the object is still in the hand, goals reached."""
    c, objects, grip = b.calibration, b.config["task"]["objects"], b.manifest.get("grip")
    shapes = [*objects["train"], *objects["held_out"]]
    shape = None if grip else shapes[seed % len(shapes)]
    clock = Clock() if way == "process" else VirtualClock()
    slack = {"late": 1.0, "overruns": 1000, "hang": 1.0, "stale": 0.5} if way == "process" else {}
    how = {"seed": seed, "shape": shape, "grip": grip}
    if way == "direct":
        hand = SimulatedXHand(b.config, c, clock, **how)
    else:
        at = None if way == "process" else clock
        hand = faked(b.config, c, f"{faults},seed={seed}", 1.0, clock=at, **how)
    settings = LoopSettings(seconds=seconds, home_speed=2.0, seen=0.5 + camera, noise=noise, ahead=ahead, **slack)
    loop = Loop(b, hand, Later(hand, camera) if camera else hand, c, settings, clock)
    try:
        report = loop.run()
        place = hand.place(clock.now())[0]
    finally:
        hand.close()
    rule = b.config["task"]["termination"]
    begun = np.array(grip["object_pose"][:3]) if grip else np.array([0.055, 0.0, 0.04])
    held = place[2] > rule["below"] and np.linalg.norm(place - begun) < rule["distance"]
    return {"ended": report.ended, "held": bool(held) and report.ended == "done",
            "goals": int(report.counts["goals_reached"]), "counts": dict(report.counts)}  # fmt: skip


def child(seconds: float) -> dict[str, np.ndarray]:
    """Times [ms] of the process that holds the bus, in real time, on joints that lag: of its cycles, from `relax` until
    that is on the wire, and from the loop's last word until the process lets go by itself."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log"
        faults = Faults(outlier=0.0, log=str(log))
        d = VendorXHand("auto", Clock(), partial(FakeXHand, faults=faults), side="right")
        d.open()
        out: dict[str, list[float]] = {"relax": [], "silent": []}

        def drive(until: float) -> float:
            while (last := time.monotonic()) < until:
                time.sleep(0.01)
                d.read()
                d.send(HandCommand(np.full(12, 0.3), np.full(12, 300)))
            return last

        def let_go(since: float) -> float:
            rows = [line.split() for line in log.read_text().splitlines()]
            return 1e3 * (min(float(t) for t, mode, _ in rows if float(t) > since and int(mode) == PASSIVE) - since)

        begun = time.monotonic()
        drive(begun + seconds)
        rows = np.array([float(line.split()[0]) for line in log.read_text().splitlines()])
        cycles = 1e3 * np.diff(rows[rows > begun])
        for k in range(20):
            at = drive(time.monotonic() + 0.2 + 0.003 * k)
            if k % 2:
                at = time.monotonic()
                d.relax()
            time.sleep(0.4)
            out["relax" if k % 2 else "silent"].append(let_go(at))
            d.relax()
        d.close()
    return {"cycle": cycles} | {k: np.array(v) for k, v in out.items()}


def main(argv: list[str]) -> int:
    """Prints a line a way, and writes all episodes."""
    given = options(argv, DEFAULTS)
    torch.set_num_threads(1)
    if given["ways"] == "child":
        for name, ms in child(float(given["seconds"])).items():
            print(f"{name:<8} {len(ms)} times: median {np.median(ms):.2f} ms, 99 % within {np.percentile(ms, 99):.2f},"
                  f" largest {ms.max():.2f}", flush=True)  # fmt: skip
        return 0
    n, first = int(given["episodes"]), int(given["seed"])
    with tempfile.TemporaryDirectory() as folder:
        b = bundle.load(export.export(given["checkpoint"], Path(folder) / "bundle", steps=2))
        rows: dict[str, list[dict]] = {}
        for way in given["ways"].split(","):
            began = time.perf_counter()
            rows[way] = []
            for k in range(n):
                more = (float(given[x]) for x in ("noise", "camera", "ahead"))
                rows[way].append(episode(b, way, first + k, float(given["seconds"]), given["faults"], *more))
            held = sum(r["held"] for r in rows[way])
            low, high = intervals.share(held, n)
            goals = np.array([r["goals"] for r in rows[way]])
            ended = {r["ended"] for r in rows[way]} - {"done"}
            print(f"{way:<8} held {held} of {n} (95 % {low:.2f} to {high:.2f}), goals {goals.mean():.2f} +- "
                  f"{goals.std() / max(n - 1, 1) ** 0.5:.2f}, {time.perf_counter() - began:.0f} s; ended otherwise:"
                  f" {'; '.join(sorted(ended)) or 'none'}", flush=True)  # fmt: skip
    if given["out"]:
        Path(given["out"]).write_text(json.dumps({"settings": given, "rows": rows}, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:], __doc__))
