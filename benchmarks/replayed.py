"""Whether the included policies play as before under dexsim's kernels: every metric, beside MuJoCo-Warp's kernels.

    python -m benchmarks.replayed [tasks=grasp,rotate] [settings=hand,mujoco] [seeds=101,102,103,104,105]
                                  [episodes=1024] [out=out/replayed] [any setting of play.py]

Each seed is one evaluation of `episodes` episodes: seeds give other objects, commands and pushes, the same under both
settings. Of each metric, over the seeds: its mean with each setting's kernels and their difference, with 95 % intervals
by Student's t; beside it what checkpoints/TASK.metrics.json says, with the interval that so many episodes give one
value (the spread over the seeds, scaled by the number of episodes). Of the 30-odd metrics one or two leave a 95 %
interval by chance.
What a file in `out` already holds is not played again, so that settings may run in processes of their own.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import stats

from benchmarks import tools
from benchmarks.collision import SETTINGS
from dexsim.cli import start as start_up
from dexsim.console import folders
from dexsim.learning.ppo import load_policy
from dexsim.paths import CONFIGS
from dexsim.tasks import make_env

GIVEN = ("episodes", "episodes_kept_out", "cap_s", "force_max_N", "by_command", "hold_rate_by_object",
         "by_fingertip_share", "all")  # fmt: skip
"""Not judged: what was asked for, and tables whose rows hold few episodes each."""


def numbers(metrics: dict[str, Any], episodes: int) -> dict[str, float]:
    """Metrics flat, {"consecutive_successes average": 48.4, ...}; counts as shares of the episodes."""
    out: dict[str, float] = {}
    for key, value in metrics.items():
        if key in GIVEN or key.endswith("_interval") or value is None:
            continue
        if isinstance(value, dict):
            out |= {f"{key} {k}": v for k, v in numbers(value, episodes).items()}
        elif isinstance(value, list) and len(value) == 2 and all(isinstance(v, float) for v in value):
            out |= {f"{key} low": value[0], f"{key} high": value[1]}
        elif isinstance(value, (int, float)):
            out[key] = value / episodes if isinstance(value, int) else value
    return out


def play(task: str, setting: str, seeds: list[int], episodes: int, rest: list[str], path: Path) -> None:
    """Play the seeds that `path` does not hold; it is written after each."""
    found = json.loads(path.read_text()) if path.exists() else {}
    missing = [s for s in seeds if str(s) not in found]
    if not missing:
        return
    begun = start_up.for_play(
        [f"checkpoint={tools.ROOT / 'checkpoints' / task}.pt", f"episodes={episodes}", f"worlds={episodes}",
         "sim.engine=warp", *rest], CONFIGS)  # fmt: skip
    cfg = {**begun.cfg, "sim": {**begun.cfg["sim"], **SETTINGS[setting]}}
    env = make_env(cfg, cfg["worlds"], cfg["device"], cfg["seed"], "warp")
    policy = load_policy(begun.data, env, str(begun.source), begun.typed)
    for seed in missing:
        with torch.no_grad():
            metrics = env.evaluate(policy, episodes=episodes, seed=seed)["metrics"]
        env.check()
        found[str(seed)] = numbers(metrics, episodes)
        path.write_text(json.dumps(found, indent=1) + "\n")
        print(f"  {task} {setting} seed {seed}: {json.dumps(found[str(seed)])[:150]}", flush=True)
    env.close()


def spread(values: list[float]) -> tuple[float, float, float]:
    """Mean of k values, half the width of its 95 % interval (Student's t), and their standard deviation."""
    x = np.asarray(values)
    if len(x) < 2:
        return float(x.mean()), math.nan, math.nan
    sd = float(x.std(ddof=1))
    return float(x.mean()), float(stats.t.ppf(0.975, len(x) - 1)) * sd / math.sqrt(len(x)), sd


def compare(hand: dict[str, dict], mujoco: dict[str, dict], before: dict[str, float], scale: float) -> dict[str, dict]:
    """Of each metric: `hand`, `mujoco` and `difference` as [mean, half interval], `before` as [value, half interval].

    hand, mujoco: metrics by seed. scale: episodes a seed over those of `before`. `same`: the difference's interval
    holds zero. `as_before`: hand's mean and the value of before differ by no more than the interval of their
    difference."""
    seeds, rows = sorted(set(hand) & set(mujoco)), {}
    names = [n for n in hand[seeds[0]] if all(n in hand[s] and n in mujoco[s] for s in seeds)]
    for name in names:
        a, b = ([by[s][name] for s in seeds] for by in (hand, mujoco))
        own, theirs = spread(a), spread(b)
        off = spread([x - y for x, y in zip(a, b, strict=True)])
        row: dict[str, Any] = {"hand": own[:2], "mujoco": theirs[:2], "difference": off[:2],
                               "same": bool(abs(off[0]) <= off[1])}  # fmt: skip
        if name in before:
            # what one value of so many episodes may be off: the spread of the seeds, both settings' together
            sd, t = math.hypot(own[2], theirs[2]) / math.sqrt(2), float(stats.t.ppf(0.975, 2 * len(seeds) - 2))
            row["before"] = [before[name], t * sd * math.sqrt(scale)]
            row["as_before"] = bool(abs(own[0] - before[name]) <= t * sd * math.sqrt(scale + 1 / len(seeds)))
        rows[name] = row
    return rows


def table(rows: dict[str, dict]) -> str:
    """The rows in text."""
    def said(row: dict, key: str) -> str:
        return f"{row[key][0]:.4g} +-{row[key][1]:.2g}" if key in row else "-"

    lines = [f"  {'metric':38s}{'before':>20s}{'mujoco':>20s}{'hand':>20s}{'hand - mujoco':>22s}"]
    for name, row in rows.items():
        word = ("" if row["same"] else " differs") + ("" if row.get("as_before", True) else " not as before")
        lines.append(f"  {name:38s}{said(row, 'before'):>20s}{said(row, 'mujoco'):>20s}{said(row, 'hand'):>20s}"
                     f"{said(row, 'difference'):>22s}{word}")
    return "\n".join(lines)


def main(argv: list[str]) -> dict:
    own, rest = tools.split(argv, {"tasks": "grasp,rotate", "settings": "hand,mujoco", "seeds": "101,102,103,104,105",
                                   "episodes": "1024", "out": "out/replayed"})  # fmt: skip
    episodes, seeds = tools.numbers(own["episodes"], "episodes")[0], tools.numbers(own["seeds"], "seeds")
    out = folders.make(Path(own["out"]).resolve(), "out=")
    result: dict[str, Any] = {"benchmark": "replayed", "episodes": episodes, "seeds": seeds}
    for task in own["tasks"].split(","):
        kept = json.loads((tools.ROOT / "checkpoints" / f"{task}.metrics.json").read_text())
        cap = [f"task.evaluation.cap_s={kept['cap_s']:g}"] if "cap_s" in kept else []  # trials as long as before
        given = any(r.startswith("task.evaluation.cap_s=") for r in rest)
        for setting in own["settings"].split(","):
            play(task, setting, seeds, episodes, rest if given else [*rest, *cap], out / f"{task}_{setting}.json")
        files = [out / f"{task}_{setting}.json" for setting in ("hand", "mujoco")]
        if not all(f.exists() for f in files):
            continue
        scale = episodes / kept["episodes"]
        rows = compare(*(json.loads(f.read_text()) for f in files), numbers(kept, kept["episodes"]), scale)
        result[task] = rows
        print(f"{task}: {episodes} episodes a seed, {len(seeds)} seeds; before: {kept['episodes']} episodes")
        print(table(rows), flush=True)
        result[f"{task}_differ"] = [name for name, row in rows.items() if not row["same"]]
        result[f"{task}_not_as_before"] = [name for name, row in rows.items() if not row.get("as_before", True)]
    (out / "replayed.json").write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps({k: v for k, v in result.items() if not isinstance(v, dict)}), flush=True)
    return result


if __name__ == "__main__":
    tools.command(main, __doc__)
