"""Episodes with a policy: metrics table, metrics.json, plots and video. The end of train.py and all of play.py."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import torch

from dexsim.console.tables import table
from dexsim.console.ticker import Ticker
from dexsim.learning.ppo import Policy


def replay(
    env: Any, policy: Policy, out: Path, episodes: int, seed: int, video: bool, about: dict[str, Any]
) -> dict[str, Any]:
    """Play and write ``metrics.json``, PNG plots and ``video.mp4`` into ``out``; returns the metrics.

    Args:
        about: what was played (checkpoint, versions, ...), kept in metrics.json under "about".
    """
    with torch.no_grad():
        result = env.evaluate(policy, episodes=episodes, seed=seed, progress=Ticker("episodes"))
    env.check()  # figures of worlds that lost contacts are worth nothing
    metrics = result["metrics"]
    (out / "metrics.json").write_text(json.dumps(_plain(metrics | {"about": about | {"seed": seed}}), indent=2) + "\n")
    rows = [(name, value) for name, value in metrics.items() if not isinstance(value, (list, dict))]
    print("\n" + table("metrics", ("name", "value"), rows))
    for title, header, lines in result.get("tables") or []:
        print("\n" + table(title, header, lines))
    print(f"\nmetrics  {out / 'metrics.json'}")
    if result.get("plots"):
        from dexsim.view.plots import draw

        for path in draw(result["plots"], out):
            print(f"plot     {path}")
    if video and result.get("frames"):
        _video(env, result["frames"], out / "video.mp4")
    return metrics


def _video(env: Any, frames: dict[str, Any], path: Path) -> None:
    from dexsim.view.video import NoRenderer, clips_of, render

    try:
        render(
            clips_of(frames),
            path,
            float(frames.get("dt", env.dt)),
            frames.get("names", ()),
            float(frames.get("full", 10.0)),
            camera=frames.get("camera"),
            progress=Ticker("frames"),
        )
        print(f"video    {path}")
    except NoRenderer as error:  # the metrics stand without it
        print(error)


def _plain(value: Any) -> Any:
    """JSON's own types: NaN and infinities become null, NumPy and torch numbers plain ones."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
