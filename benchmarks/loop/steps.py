"""The steps of the loop that no entry script does: a start that may be trained on, and recordings of the hand in its reality.

    python -m benchmarks.loop.steps start checkpoint=FILE out=last.pt device=cuda [any setting of train.py]
    python -m benchmarks.loop.steps record world=soft out=DIR seed=1 [count=3] [seconds=19]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import yaml

ROOT = Path(__file__).parents[2]


def start(given: dict[str, str]) -> None:
    """A checkpoint to resume from, out of one that holds a policy only: its actor, a fresh critic and optimizer, nothing counted."""
    import torch

    from dexsim.cli import build, machine
    from dexsim.cli import start as settings
    from dexsim.learning import checkpoint
    from dexsim.learning.runner import Runner

    own = {k: given.pop(k) for k in ("checkpoint", "out", "device")}
    ready = settings.for_train([f"resume={own['checkpoint']}", "device=cpu", "worlds=16", "iterations=1000000", *(f"{k}={v}" for k, v in given.items())],
                               ROOT / "configs")  # fmt: skip
    env = build.build_env(ready.cfg, None, {"start": own["checkpoint"]})
    runner = Runner(env, ready.cfg, machine.versions())
    checkpoint.check_layout(ready.data, checkpoint.layout_of(env), own["checkpoint"])
    payload = runner.payload()
    payload["actor"] = ready.data["actor"]
    if own["device"].startswith("cuda"):  # a random state belongs to its kind of device
        payload["env"]["rng"] = torch.Generator("cuda").manual_seed(int(ready.cfg["seed"])).get_state()
    Path(own["out"]).parent.mkdir(parents=True, exist_ok=True)
    checkpoint.save(own["out"], payload)


def record(given: dict[str, str]) -> None:
    """Recordings of the hand in a concealed reality under safe excitation: read as its bus reads, targets late and lost as there."""
    from dexsim.cli.build import quiet_warp
    from dexsim.recording import write
    from dexsim.recording.excitation import plan
    from dexsim.recording.mechanism import drive, mechanism, recorded
    from dexsim.recording.realistic import realistic
    from dexsim.recording.schema import COMMANDS, Series

    quiet_warp("cpu")
    world = yaml.safe_load((ROOT / "configs" / "reality" / f"{given['world']}.yaml").read_text(encoding="utf-8"))
    believed, true = mechanism(), mechanism(servo=world["servo"])
    out, seed = Path(given["out"]), int(given.get("seed", 0))
    out.mkdir(parents=True, exist_ok=True)
    kinds = [["random"], ["chirp"]]  # all joints at once: most is seen in little time; chirps tell a delay from damping
    for k in range(int(given.get("count", 3))):
        rng = np.random.default_rng([seed, k])
        p = plan(believed, kinds=kinds[k % len(kinds)], seed=seed + k, repeats=0)
        if kinds[k % len(kinds)] == ["random"]:
            p.t, p.value = (x[p.t < float(given.get("seconds", 19.0))] for x in (p.t, p.value))
        arrives = rng.random(len(p.t)) >= world["timing"]["lost"]
        late = p.t + world["timing"]["late"] * rng.random(len(p.t))
        order = np.argsort(late[arrives], kind="stable")
        sent = Series(late[arrives][order], p.value[arrives][order], COMMANDS)
        run = drive(true, sent, believed.joints, float(p.t[-1]), initial=p.home, timestep=0.001)
        dense = recorded(run, believed, Series(p.t, p.value, COMMANDS), believed.joints, rate=500.0)
        seen = realistic(dense, seed=int(rng.integers(1 << 30)))
        seen.meta["source"] = "real"
        write(out / f"excite_{k}.mcap", seen)
        print(f"{out / f'excite_{k}.mcap'}: {p.t[-1]:.0f} s", flush=True)


if __name__ == "__main__":
    what, *rest = sys.argv[1:]
    {"start": start, "record": record}[what](dict(item.split("=", 1) for item in rest))
