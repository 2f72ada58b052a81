"""Episodes with a policy: metrics table, metrics.json, plots and video. The end of train.py and all of play.py."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import torch

from dexsim import outputs
from dexsim.console.tables import table
from dexsim.console.ticker import Ticker
from dexsim.learning.ppo import Policy

METRICS, VIDEO = "metrics.json", "video.mp4"

def replay(
    env: Any, policy: Policy, out: Path, episodes: int, seed: int, video: bool, about: dict[str, Any]
) -> dict[str, Any]:
    """Play and write ``metrics.json``, PNG plots and ``video.mp4`` into ``out``, each whole or not at all; returns the
    metrics. Raises UserError where one of them would go over a file that is not ours.

    Args:
        about: what was played (checkpoint, versions, ...), kept in metrics.json under "about".
    """
    with torch.no_grad():
        result = env.evaluate(policy, episodes=episodes, seed=seed, progress=Ticker("episodes"))
    env.check()  # figures of worlds that lost contacts are worth nothing
    metrics = result["metrics"]
    with outputs.staged(out) as stage:
        text = json.dumps(_plain(metrics | {"about": about | {"seed": seed}}), indent=2) + "\n"
        (stage / METRICS).write_text(text, encoding="utf-8")
    rows = [(name, value) for name, value in metrics.items() if not isinstance(value, (list, dict))]
    print("\n" + table("metrics", ("name", "value"), rows))
    for title, header, lines in result.get("tables") or []:
        print("\n" + table(title, header, lines))
    print(f"\nmetrics  {out / METRICS}")
    if result.get("plots"):
        from dexsim.view.plots import draw

        with outputs.staged(out) as stage:
            drawn = draw(result["plots"], stage)
        for path in drawn:
            print(f"plot     {out / path.name}")
    if video and result.get("frames"):
        with outputs.staged(out) as stage:
            made = _video(env, result["frames"], stage / VIDEO)
        if made:
            print(f"video    {out / VIDEO}")
    return metrics


def _video(env: Any, frames: dict[str, Any], path: Path) -> bool:
    """Return whether it could be made."""
    from dexsim.view.video import clips_of, drawn, render

    return drawn(lambda: render(
        clips_of(frames), path, float(frames.get("dt", env.dt)), frames.get("names", ()),
        float(frames.get("full", 10.0)), camera=frames.get("camera"), progress=Ticker("frames")))  # fmt: skip


def _plain(value: Any) -> Any:
    """Convert to JSON's own types: NaN and infinities become null, NumPy and torch numbers plain ones."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
