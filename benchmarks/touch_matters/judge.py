"""Judge the policies of a row in one or more worlds, all its seeds at once: python -m benchmarks.touch_matters.judge
out=FOLDER row=R seeds=1,2,.. at=ITERATION worlds=training,wide [episodes=512] [cap=120] [threads=1] [states=true]
[mute=contact_force,contact_centre].

Writes FOLDER/R/seed<k>/<world>.json, and with `states` FOLDER/R/<world>_states.npz (joints and cube of a few trials of
the first seed, for a film). Every policy plays `episodes` worlds of its own. `mute` gives a policy, in place of rows of
its observation, what they were in training on average (<world>_without_<rows>.json): what this policy leans on, which
is not what another would do that has learned without.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import torch

from benchmarks import tools
from benchmarks.touch_matters import rows
from dexsim.cli import build
from dexsim.cli import start as start_up
from dexsim.errors import UserError
from dexsim.learning import checkpoint
from dexsim.learning.ppo import load_policy
from dexsim.paths import CONFIGS
from dexsim.tasks.rotate_eval import summary

OWN = {"out": "", "row": "", "seeds": "1", "at": "0", "worlds": "training", "episodes": "512", "cap": "120",
       "threads": "1", "states": "false", "mute": ""}  # fmt: skip
TRIALS_SEED = 1000


def checkpoints(folder: Path) -> dict[int, Path]:
    """Iteration -> checkpoint, of those kept while a row was trained from a seed in `folder`."""
    return {int(p.stem.removeprefix("model_")): p for p in folder.glob("train_*/model_*.pt")}


def metrics_of(trials: list, cap: float, resamples: int) -> dict:
    """Metrics of one policy from its trials (`FingertipEnv.of_trials`)."""
    successes, time, end = (np.array([t[k] for t in trials]) for k in range(3))
    other = np.array([t[7] for t in trials])
    return summary(successes, time, end == "capped", cap, resamples, TRIALS_SEED) | {
        "ends": {e: int((end == e).sum()) for e in ("dropped", "leaned", "nan", "capped")},
        "touched_by_others": float(other.sum() / max(time.sum(), 1e-9)),
        "trials": trials,
    }


def columns(layout: list, names: list[str]) -> list[int]:
    """Columns of the named rows of an observation. layout: [name, width] of each row. Raises UserError for no such
    row."""
    found, at = [], 0
    for name, width in layout:
        found += range(at, at + width) if name in names else ()
        at += width
    wrong = [n for n in names if n not in [row[0] for row in layout]]
    if wrong:
        raise UserError(f"mute={wrong[0]}: the actor has {', '.join(row[0] for row in layout)}")
    return found


def judge(own: dict[str, str], world: str) -> None:
    """Play all seeds of a row in a world."""
    seeds, each = tools.numbers(own["seeds"], "seeds"), int(own["episodes"])
    folder = Path(own["out"]) / own["row"]
    paths = [checkpoints(folder / f"seed{s}")[int(own["at"])] for s in seeds]
    total = each * len(seeds)
    argv = [
        f"checkpoint={paths[0]}", f"episodes={total}", f"worlds={total}", f"seed={TRIALS_SEED}", "video=false",
        f"task.evaluation.cap_s={own['cap']}", *rows.WORLDS[world],
    ]  # fmt: skip
    begun = start_up.for_play(
        [*argv, *(["device=cpu", f"sim.threads={own['threads']}"] if world in rows.ON_CPU else [])], CONFIGS
    )
    env = build.build_env(begun.cfg, None, {"world": world})
    loaded = [checkpoint.load(str(p)) for p in paths]
    for data, path in zip(loaded, paths, strict=True):
        checkpoint.check_layout(data, checkpoint.layout_of(env), str(path))
    policies = [load_policy(data, env, str(path)) for data, path in zip(loaded, paths, strict=True)]

    muted = columns(loaded[0]["layout"]["observations"]["actor"], own["mute"].split(",")) if own["mute"] else []

    def act(obs):
        out = []
        for i, (policy, data) in enumerate(zip(policies, loaded, strict=True)):
            part = obs[i * each : (i + 1) * each]
            if muted:
                part = part.clone()
                part["actor"][:, muted] = data["actor"]["obs_normalizer._mean"][:, muted].to(part["actor"])
            out.append(policy(part))
        return torch.cat(out)

    name = world + ("_without_" + own["mute"].replace(",", "_") if own["mute"] else "")

    found = env.evaluate(act, total, TRIALS_SEED)
    trials, evaluation = found["metrics"]["trials"], begun.cfg["task"]["evaluation"]
    for i, (seed, data) in enumerate(zip(seeds, loaded, strict=True)):
        metrics = metrics_of(trials[i * each : (i + 1) * each], evaluation["cap_s"], evaluation["resamples"])
        target = folder / f"seed{seed}" / f"{name}.json"
        part = target.with_suffix(".part")
        part.write_text(json.dumps({
            "row": own["row"], "seed": seed, "world": name, "steps": int(data["steps"]),
            "iteration": int(data["iteration"]), "metrics": metrics,
        }))  # fmt: skip
        os.replace(part, target)
        print(f"{own['row']} {seed} {name}: {metrics['consecutive_successes']['average']:.2f}", flush=True)
    if own["states"] == "true":
        keep_states(found["frames"], folder / f"{name}_states.npz")
    build.close(env)


def keep_states(frames: dict, path: Path) -> None:
    """A file of the trials that an evaluation filmed; see `benchmarks.touch_matters.film`."""
    np.savez_compressed(
        path,
        **{f"qpos_{i}": q.astype(np.float32) for i, q in enumerate(frames["qpos"])},
        **{f"force_{i}": o["force"].astype(np.float32) for i, o in enumerate(frames["overlay"])},
        half=np.array([m.geom_size[m.geom("object_box").id] for m in frames["model"]]),
        label=np.array(frames["label"]), dt=frames["dt"], names=np.array(frames["names"]),
    )  # fmt: skip


def main(argv: list[str]) -> None:
    own, rest = tools.split(argv, OWN)
    if rest:
        raise UserError(f"{rest[0]!r}: the settings are {', '.join(OWN)}")
    for world in own["worlds"].split(","):
        judge(own, world)


if __name__ == "__main__":
    tools.command(main, __doc__)
