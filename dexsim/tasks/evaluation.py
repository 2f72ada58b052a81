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
    from dexsim.tasks.task import Task

Policy = Callable[..., torch.Tensor]
Progress = Callable[..., object]
SHOWN, SHOWN_S = 4, 20.0
"""Worlds in the video, and how much of them, s."""


class Film:
    """The first worlds of a play, for its video: `add` a frame each control step, at most `seconds` of them."""

    def __init__(self, env: Task, seconds: float = SHOWN_S):
        self.env, self.most = env, round(seconds / env.dt)
        self.worlds = list(range(min(SHOWN, env.num_envs))) if self.most else []
        self.models = [env.drawn_model(w) for w in self.worlds]  # before an episode ends and its object is replaced
        self.qpos: list[np.ndarray] = []
        self.rows: dict[str, list[Any]] = {}

    def add(self, **more: torch.Tensor) -> None:
        """Keep the state, taxels and the task's first figures where there are any, and what else is shown of it,
        [N, ...] each."""
        if not self.worlds or len(self.qpos) >= self.most:
            return
        self.qpos.append(self.env.engine.t.qpos[self.worlds].double().cpu().numpy())
        raw = self.env.touch.raw
        for name, value in (more if raw is None else more | {"taxels": raw}).items():
            self.rows.setdefault(name, []).append(value[self.worlds].cpu().numpy())
        now = [(name, self.env.figures[name].tolist()) for name in [*self.env.last][:2] if name in self.env.figures]
        if now:
            texts = [", ".join(f"{name} {value[w]:.3g}" for name, value in now) for w in self.worlds]
            self.rows.setdefault("text", []).append(texts)

    def frames(self, steps: np.ndarray | None = None, **about: Any) -> dict[str, Any] | None:
        """Return what a film is made of (`dexsim.view.video.clips_of`), None without a world. steps [N]: of each
        world's episode, whose last frame is the next one's."""
        if not self.worlds:
            return None
        most = len(self.qpos)
        stop = [most if steps is None else max(1, min(most, int(steps[w]) - 1)) for w in self.worlds]
        cut = {k: [np.stack([x[i] for x in rows[:s]]) for i, s in enumerate(stop)]
               for k, rows in ({"qpos": self.qpos} | self.rows).items()}  # fmt: skip
        layout = {"layout": self.env.touch.layout}
        return {
            "model": self.models, "dt": self.env.dt, "names": self.env.hand.finger_names, "qpos": cut.pop("qpos"),
            "overlay": [layout | {k: v[i] for k, v in cut.items()} for i in range(len(stop))],
            "camera": self.env.camera,
        } | about  # fmt: skip


def batches(play: Callable[[int], tuple[dict[str, np.ndarray], Any]], worlds: int, episodes: int) -> tuple[dict, Any]:
    """Return arrays [E] of so many episodes by name, and the first frames, of `play` (by how many were played before),
    which plays one in every world."""
    parts = [play(done) for done in range(0, episodes, worlds)]
    return {k: np.concatenate([p[k] for p, _ in parts])[:episodes] for k in parts[0][0]}, parts[0][1]


@torch.inference_mode()
def play_all(
    env: Task, policy: Policy, episodes: int, seed: int, cap: float, progress: Progress | None = None,
    recorded: bool = False,
) -> tuple[dict, dict | None, dict | None]:  # fmt: skip
    """Play `episodes` episodes of at most `cap` s, half as many again with objects kept out of training. recorded: a
    step recorded in training may be used, which begins with its objects. Returns arrays by name, those with kept-out
    objects where there are such, frames."""
    env.rng.manual_seed(seed)
    torch.manual_seed(seed)
    length, env.max_episode_length = env.max_episode_length, max(1, round(cap / env.dt))
    graphs, width = env.graphs, env.sampler.width.clone()
    env.learning, env.graphs = False, graphs and recorded
    env.sampler.width.fill_(1.0)  # all of what a curriculum widens
    held_out = None
    try:
        found, frames = batches(lambda k: _play(env, policy, not k, progress, k, episodes), env.num_envs, episodes)
        if env.scene.object is not None and env.task["objects"]["held_out"]:
            env.graphs, half = False, max(episodes // 2, 1)
            env.judge_kept_out(True)
            try:
                held_out, _ = batches(lambda k: _play(env, policy, False, progress, k, half), env.num_envs, half)
            finally:
                env.judge_kept_out(False)
    finally:
        env.max_episode_length, env.learning, env.graphs = length, True, graphs
        env.sampler.width.copy_(width)
    return found, held_out, frames


def evaluate(env: Task, policy: Policy, episodes: int, seed: int, progress: Progress | None = None) -> dict:
    """Play `episodes` episodes; returns {"metrics", "tables", "frames"}."""
    settings = env.task.get("evaluation") or {}
    cap = settings.get("cap_s") or env.task["episode_s"]
    resamples = max(int(settings.get("resamples", 2000)), 1)
    found, held_out, frames = play_all(env, policy, episodes, seed, cap, progress)
    metrics = _summary(env, found, resamples, seed)
    rows = [("", *row) for row in _rows(env, metrics)]
    if held_out is not None:
        metrics["kept_out"] = _summary(env, held_out, resamples, seed)
        rows += [("kept out", *row) for row in _rows(env, metrics["kept_out"])]
    tables = [
        ("95 % intervals (bootstrap over episodes)", ("objects", "figure", "mean", "interval", "unit"), rows),
        ends_table("episodes", metrics),
    ]
    return {"metrics": metrics, "tables": tables, "frames": frames}


def ends_table(what: str, metrics: dict, more: str = "") -> tuple[str, tuple, list]:
    """Return the table of how episodes ended."""
    rows = [(name, count, f"{100 * count / metrics['episodes']:.1f}") for name, count in metrics["ends"].items()]
    return f"How {metrics['episodes']} {what} ended{more}", ("end", what, "%"), rows


def _play(
    env: Task, policy: Policy, film: bool, progress: Progress | None, before: int, episodes: int
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
    facts = {k: v.clone() for k, v in env.trial_facts().items()}  # the next episode writes over them
    counts: dict[str, torch.Tensor] = {}
    shot = Film(env, SHOWN_S if film else 0.0)
    for k in range(env.max_episode_length):
        obs, reward, done, _ = env.step(policy(obs))
        total += reward * alive
        steps += alive
        for name, seen in env.trial_counts().items():
            now = seen & alive
            counts[name] = counts.get(name, torch.zeros_like(steps)) + now
            counts[f"last_{name}"] = torch.where(now, steps, counts.get(f"last_{name}", 0))
        over = done.bool() & alive
        for name, value in figures.items():
            value.copy_(torch.where(over, env.last[name], value))
        end = torch.where(over, env.ended_by(), end)
        alive = alive & ~over
        shot.add(force=env.touch.force_clean[:, : env.fingers])
        if k % 20 == 19:
            if progress is not None:
                at = before + min(n, episodes - before) * (k + 1) // env.max_episode_length
                progress(at, episodes, f"{(k + 1) * env.dt:.0f} s, {int(alive.sum())} left")
            if not bool(alive.any()):
                break
    own = {"return": total, "length_s": steps, "end": end, **figures, **facts, **counts}
    out = {name: value.cpu().numpy() for name, value in own.items()}
    frames = shot.frames(out["length_s"], full=5.0, colours=True)
    return out | {"length_s": out["length_s"] * env.dt}, frames


def _summary(env: Task, found: dict[str, np.ndarray], resamples: int, seed: int) -> dict[str, Any]:
    out: dict[str, Any] = {"episodes": len(found["return"])}
    for name, values in found.items():
        if name not in ("return", "length_s", *env.last):
            continue
        draws = intervals.draws((values.astype(float),), _mean, seed, resamples)[0]
        low, high = np.percentile(draws, [2.5, 97.5])
        out[f"mean_{name}" if name in ("return", "length_s") else name] = float(values.mean())
        out[f"{name}_interval"] = [float(low), float(high)]
    out["ends"] = {name: int((found["end"] == k).sum()) for k, name in enumerate(env.end_names)}
    return out


def _mean(values: np.ndarray, axis: int = -1) -> np.ndarray:
    return values.mean(axis)[None]


def _rows(env: Task, metrics: dict[str, Any]) -> list[tuple]:
    units = env.figure_units() | {"mean_return": "", "mean_length_s": "s"}
    rows = []
    for name, unit in units.items():
        low, high = metrics[f"{name.removeprefix('mean_')}_interval"]
        rows.append((name, f"{metrics[name]:.3g}", f"{low:.3g} .. {high:.3g}", unit))
    return rows
