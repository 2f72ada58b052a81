"""Evaluates any task: an episode in every world, how it went and ended, its figures with intervals, a film.

A world's first episode counts, as many worlds as are asked for; intervals are bootstraps over episodes, 95 %. Objects
kept out of training are played too, half as many episodes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from dexsim import intervals

if TYPE_CHECKING:
    from dexsim.tasks.env import HandEnv

Policy = Callable[..., torch.Tensor]
Progress = Callable[..., object]
SHOWN, SHOWN_S = 4, 20.0
"""Worlds in the video, and how much of them, s."""


@torch.inference_mode()
def evaluate(env: HandEnv, policy: Policy, episodes: int, seed: int, progress: Progress | None = None) -> dict:
    """Play `episodes` episodes; returns {"metrics", "tables", "frames"}."""
    env.rng.manual_seed(seed)
    torch.manual_seed(seed)
    settings = env.task.get("evaluation") or {}
    cap = settings.get("cap_s") or env.task["episode_s"]
    resamples = max(int(settings.get("resamples", 2000)), 1)
    length, env.max_episode_length = env.max_episode_length, max(1, round(cap / env.dt))
    graphs, env.graphs = env.graphs, False  # a recorded step begins with objects of the training, and as training does
    env.learning, width = False, env.sampler.width.clone()
    env.sampler.width.fill_(1.0)  # all of what a curriculum widens
    try:
        found, frames = _episodes(env, policy, episodes, True, progress)
        held_out = None
        if env.scene.object is not None and env.task["objects"]["held_out"]:
            env.judge_kept_out(True)
            try:
                held_out = _episodes(env, policy, max(episodes // 2, 1), False, progress)[0]
            finally:
                env.judge_kept_out(False)
    finally:
        env.max_episode_length, env.learning, env.graphs = length, True, graphs
        env.sampler.width.copy_(width)
    metrics = _summary(env, found, resamples, seed)
    rows = [("", *row) for row in _rows(env, metrics)]
    if held_out is not None:
        metrics["kept_out"] = _summary(env, held_out, resamples, seed)
        rows += [("kept out", *row) for row in _rows(env, metrics["kept_out"])]
    ends = [(name, count, f"{100 * count / metrics['episodes']:.1f}") for name, count in metrics["ends"].items()]
    tables = [
        ("95 % intervals (bootstrap over episodes)", ("objects", "figure", "mean", "interval", "unit"), rows),
        (f"How {metrics['episodes']} episodes ended", ("end", "episodes", "%"), ends),
    ]
    return {"metrics": metrics, "tables": tables, "frames": frames}


def _episodes(
    env: HandEnv, policy: Policy, episodes: int, film: bool, progress: Progress | None
) -> tuple[dict[str, np.ndarray], dict | None]:
    parts: list[dict] = []
    frames = None
    while len(parts) * env.num_envs < episodes:
        part, shot = _play(env, policy, film and not parts, progress, len(parts) * env.num_envs, episodes)
        parts.append(part)
        frames = frames or shot
    return {k: np.concatenate([p[k] for p in parts])[:episodes] for k in parts[0]}, frames


def _play(
    env: HandEnv, policy: Policy, film: bool, progress: Progress | None, before: int, episodes: int
) -> tuple[dict[str, np.ndarray], dict | None]:
    """Return an episode in every world."""
    n, dev = env.num_envs, env.device
    env.reset_all()
    getattr(policy, "reset", lambda *_: None)()
    obs = env.get_observations()
    alive = torch.ones(n, dtype=torch.bool, device=dev)
    total, steps = torch.zeros(n, device=dev), torch.zeros(n, dtype=torch.long, device=dev)
    end = torch.full((n,), -1, dtype=torch.long, device=dev)
    figures = {name: torch.zeros(n, device=dev) for name in env.last}
    films = list(range(min(SHOWN, n))) if film else []
    models, qpos, forces, texts = [env.drawn_model(w) for w in films], [], [], []
    for k in range(env.max_episode_length):
        obs, reward, done, extras = env.step(policy(obs))
        total += reward * alive
        steps += alive
        over = done.bool() & alive
        for name, value in figures.items():
            value.copy_(torch.where(over, env.last[name], value))
        end = torch.where(over, env.ended_by(), end)
        alive = alive & ~over
        if films and k * env.dt < SHOWN_S:
            qpos.append(env.engine.t.qpos[films].double().cpu().numpy())
            forces.append(env.touch.force_clean[films][:, : env.fingers].cpu().numpy())
            now = [(name, env.figures[name].tolist()) for name in list(figures)[:2] if name in env.figures]
            texts.append([", ".join(f"{name} {value[w]:.3g}" for name, value in now) for w in films])
        if k % 20 == 19:
            if progress is not None:
                at = before + min(n, episodes - before) * (k + 1) // env.max_episode_length
                progress(at, episodes, f"{(k + 1) * env.dt:.0f} s, {int(alive.sum())} left")
            if not bool(alive.any()):
                break
    out = {
        "return": total.cpu().numpy(), "length_s": steps.cpu().numpy() * env.dt, "end": end.cpu().numpy(),
        **{name: value.cpu().numpy() for name, value in figures.items()},
    }  # fmt: skip
    if not films:
        return out, None
    stop = [max(1, min(len(qpos), int(steps[w]) - 1)) for w in films]  # the end's own frame is the next episode's
    return out, {
        "model": models, "dt": env.dt, "names": env.hand.finger_names, "full": 5.0,
        "qpos": [np.stack([q[i] for q in qpos[:s]]) for i, s in enumerate(stop)],
        "overlay": [{"force": np.stack([f[i] for f in forces[:s]]), "text": [t[i] for t in texts[:s]]}
                    for i, s in enumerate(stop)],
        "camera": env.camera, "colours": True,
    }  # fmt: skip


def _summary(env: HandEnv, found: dict[str, np.ndarray], resamples: int, seed: int) -> dict[str, Any]:
    out: dict[str, Any] = {"episodes": len(found["return"])}
    for name, values in found.items():
        if name == "end":
            continue
        draws = intervals.draws((values.astype(float),), _mean, seed, resamples)[0]
        low, high = np.percentile(draws, [2.5, 97.5])
        out[f"mean_{name}" if name in ("return", "length_s") else name] = float(values.mean())
        out[f"{name}_interval"] = [float(low), float(high)]
    out["ends"] = {name: int((found["end"] == k).sum()) for k, name in enumerate(env.end_names)}
    return out


def _mean(values: np.ndarray, axis: int = -1) -> np.ndarray:
    return values.mean(axis)[None]


def _rows(env: HandEnv, metrics: dict[str, Any]) -> list[tuple]:
    units = env.figure_units() | {"mean_return": "", "mean_length_s": "s"}
    rows = []
    for name, unit in units.items():
        low, high = metrics[f"{name.removeprefix('mean_')}_interval"]
        rows.append((name, f"{metrics[name]:.3g}", f"{low:.3g} .. {high:.3g}", unit))
    return rows
