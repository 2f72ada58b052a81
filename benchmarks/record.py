"""What recording a few worlds costs the others: milliseconds of a control step with and without `play.py record=FILE`.

    python -m benchmarks.record [worlds=8192] [record_worlds=1] [steps=64] [rounds=6] [device=cuda:0] [tactile=raw]

The grasp task under random actions. Rounds with and without recording take turns in one process, each on an environment
of its own, so that neither is always the first; the median round of each is compared. Recording ends by itself with its
episode: the figure is of the time while it lasts.
"""

from __future__ import annotations

import json
import time

import numpy as np
import torch

from benchmarks import tools
from dexsim.errors import UserError
from dexsim.paths import CONFIGS


def main(argv: list[str]) -> dict:
    """Prints a line a round and one line of JSON."""
    given = dict(a.split("=", 1) for a in argv if "=" in a)
    unknown = set(given) - {"worlds", "record_worlds", "steps", "rounds", "device", "tactile"}
    if unknown or len(given) != len(argv):
        raise UserError(f"{' '.join(argv)}: keys are worlds, record_worlds, steps, rounds, device, tactile")
    device = given.get("device", "cuda:0" if torch.cuda.is_available() else "cpu")
    defaults = {"worlds": "8192", "record_worlds": "1", "steps": "64", "rounds": "6"}
    worlds, chosen, steps, rounds = (tools.numbers(given.get(k, d), k)[0] for k, d in defaults.items())
    plain, recorded = (environment(worlds, device, given.get("tactile", "raw")) for _ in range(2))
    from dexsim.recording.tap import PlayRecorder

    tap = PlayRecorder(recorded[0], chosen, recorded[1], least=1e9)  # it goes on recording as long as it is asked
    times: dict[str, list[float]] = {"plain": [], "recorded": []}
    for k in range(rounds + 1):  # the first round warms up
        for name, (env, _) in (("plain", plain), ("recorded", recorded)) if k % 2 else (("recorded", recorded),
                                                                                        ("plain", plain)):
            took = run(env, steps, device, k)
            if k:
                times[name].append(took)
                print(f"round {k}: {name:<9} {took:8.2f} ms a control step", flush=True)
    a, b = (float(np.median(times[n])) for n in ("plain", "recorded"))
    kept = sum(len(t.episode.times) + len(t._now.times) for t in tap.tracks)
    found = {"benchmark": "record", "worlds": worlds, "record_worlds": chosen, "plain_ms": round(a, 3),
             "recorded_ms": round(b, 3), "slower": round(b / a - 1, 4)}
    found |= {"steps_kept": kept} | tools.about(device)
    print(json.dumps(found), flush=True)
    return found


def environment(worlds: int, device: str, tactile: str) -> tuple:
    """(environment, its config) of the grasp task, reset."""
    from dexsim.cli import start
    from dexsim.sim.quiet import quiet_warp
    from dexsim.tasks import make_env

    quiet_warp(device)
    kind = "cuda" if device.startswith("cuda") else "cpu"
    cfg = start.for_train(["task=grasp", "preset=none", f"worlds={worlds}", f"device={kind}", f"tactile={tactile}"],
                          CONFIGS).cfg
    env = make_env(cfg, worlds, device, 0)
    env.reset_all()
    return env, cfg


def run(env, steps: int, device: str, seed: int) -> float:
    """Milliseconds a control step under random actions."""
    generator = torch.Generator(device=device).manual_seed(seed)
    actions = 2 * torch.rand(8, env.num_envs, 12, generator=generator, device=device) - 1
    wait = torch.cuda.synchronize if device.startswith("cuda") else lambda: None
    wait()
    begin = time.perf_counter()
    for k in range(steps):
        env.step(actions[k % 8])
    wait()
    return 1e3 * (time.perf_counter() - begin) / steps


if __name__ == "__main__":
    tools.command(main, __doc__)
