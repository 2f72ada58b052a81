"""Plots as PNG files: learning curves of a run folder, and whatever an evaluation offers to draw.

    python -m dexsim.view.plots runs/grasp/<run>      draws its curves.png again
"""

from __future__ import annotations

import csv
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib.axes import Axes  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402  (pyplot would keep every figure alive)

from dexsim import files  # noqa: E402
from dexsim.errors import UserError  # noqa: E402

BLUE, LIGHT = "#1f5fa8", "#9dbfe3"
FIRST = ("reward", "length", "step_reward")
HIDDEN = ("iteration", "steps", "collect_s", "learn_s", "episodes", "time_s")
TITLES = {"reward": "reward of an episode", "length": "length of an episode (steps)", "step_reward": "reward of a step"}


def read_progress(path: Path) -> dict[str, list[float]]:
    """Return the columns of a run's ``progress.csv``; an empty cell is NaN. Raises UserError where there is none."""
    if not path.is_file():
        raise UserError(f"{path}: no such file; train.py writes it into the run folder")
    with open(path, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    names = list(rows[0]) if rows else []
    return {n: [float(r[n]) if r[n] else math.nan for r in rows] for n in names}


def curves(columns: dict[str, list[float]], path: Path, title: str = "") -> Path:
    """Return the learning curves against environment steps: reward, episode length, then every logged term; saved to
    ``path``.

    Thin line: each iteration; thick line: mean over a twentieth of the run.
    """
    names = [n for n in FIRST if n in columns]
    names += sorted((n for n in columns if n not in FIRST and n not in HIDDEN), key=_order)
    names = [n for n in names if any(math.isfinite(v) for v in columns[n])]
    across, margins = 4, (0.65, 0.5, 0.15, 0.65 if title else 0.35)
    figure, panels = grid(len(names), across, (3.6, 2.5), margins, title, 0.12, wspace=0.25, hspace=0.38)
    steps = columns.get("steps", [])
    for axes, name in zip(panels, names, strict=True):
        points = [(x, y) for x, y in zip(steps, columns[name]) if math.isfinite(y)]
        x, y = [p[0] for p in points], [p[1] for p in points]
        axes.plot(x, y, color=LIGHT, linewidth=0.8, marker="." if len(x) < 3 else None)
        axes.plot(x, smooth(y, max(1, len(y) // 20)), color=BLUE, linewidth=1.6)
        axes.set_title(TITLES.get(name, name), fontsize=9)
        axes.tick_params(labelsize=7)
        axes.locator_params(nbins=5)
        for axis in (axes.xaxis, axes.yaxis):
            axis.offsetText.set_fontsize(7)
        axes.grid(alpha=0.25)
    for axes in panels[-across:]:
        axes.set_xlabel("environment steps", fontsize=8)
    files.picture(figure, path, dpi=110)
    return path


def grid(
    count: int, across: int, size: tuple[float, float], margins: tuple[float, float, float, float], title: str,
    above: float, more: float = 0.0, **space: float,
) -> tuple[Figure, list[Axes]]:  # fmt: skip
    """Return a figure and its `count` panels, at most `across` in a row, each of size (width, height) in inches.

    margins: left, bottom, right, top in inches, by hand: a layout engine takes seconds for some thirty axes; more: of
    the height; above: the title, which may be ''."""
    across = min(across, max(1, count))
    down = max(1, math.ceil(count / across))
    (width, height), (x, y, right, top) = (size[0] * across, size[1] * down + more), margins
    figure = Figure(figsize=(width, height))
    figure.subplots_adjust(x / width, y / height, 1 - right / width, 1 - top / height, **space)
    axes = list(figure.subplots(down, across, squeeze=False).flat)
    for ax in axes[count:]:
        ax.set_axis_off()
    if title:
        figure.suptitle(title, fontsize=10, y=1 - above / height, va="top")
    return figure, axes[:count]


def _order(name: str) -> tuple[int, str]:
    """Return the task terms first, then losses and the rest."""
    return (1 if name.startswith(("Loss/", "Policy/", "Perf/")) else 0, name)


def smooth(values: Sequence[float], width: int) -> list[float]:
    """Mean of each value and up to ``width - 1`` before it."""
    total, ends = np.cumsum([0.0, *values]), np.arange(1, len(values) + 1)
    begins = np.maximum(ends - width, 0)
    return list((total[ends] - total[begins]) / (ends - begins))


def draw(functions: Sequence[Any], folder: Path) -> list[Path]:
    """Return each plot, a function of one axes or a pair (file name, function), saved as ``<name>.png``."""
    paths = []
    for item in functions:
        name, function = item if isinstance(item, tuple) else (item.__name__, item)
        figure = Figure(figsize=(7.0, 4.6), layout="constrained")
        function(figure.subplots())
        path = folder / f"{name}.png"
        files.picture(figure, path, dpi=120)
        paths.append(path)
    return paths


if __name__ == "__main__":
    try:
        for argument in sys.argv[1:]:
            run = Path(argument)
            print(curves(read_progress(run / "progress.csv"), run / "curves.png", str(run)))
    except UserError as problem:
        sys.exit(f"error: {problem}")
