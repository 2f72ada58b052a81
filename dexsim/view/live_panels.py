"""Panels of the live view beside the scene: taxel maps as an image, forces, rewards and facts as HTML. No server in
here."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:  # it would bring torch and Warp, three seconds of a film's process
    from dexsim.tactile.layout import TaxelLayout

PAD_WIDTH, PAD_HEIGHT, GAP = 72, 72, 6  # pixels of one fingertip's map
BACKGROUND = np.array([246, 247, 249], np.uint8)
BAR, COMMAND, PLUS, MINUS = "#1f5fa8", "#e08a00", "#2e8b57", "#c0392b"


def colours(values: np.ndarray, full: float) -> np.ndarray:
    """Return RGB [..., 3] uint8 of forces (N): pale where nothing presses, through red to black-red at `full`; the
    square root, so that a light touch shows."""
    x = np.sqrt(np.clip(values / max(full, 1e-9), 0.0, 1.0))[..., None]
    stops = np.array([[214, 222, 232], [255, 214, 102], [240, 80, 40], [90, 0, 20]], float)
    position = x * (len(stops) - 1)
    low = np.clip(position.astype(int), 0, len(stops) - 2)
    part = position - low
    return np.rint(stops[low[..., 0]] * (1 - part) + stops[low[..., 0] + 1] * part).astype(np.uint8)


class TaxelMap:
    """Fingertips side by side, seen onto their pads: each pixel takes the colour of its nearest taxel.

    A pad wraps around its finger, so it is unrolled: across is the angle of a taxel's normal about the finger's axis
    times the pad's radius, along is the height plus, at the rounded end, the same for the angle towards the axis. The
    end of the finger is up.
    """

    def __init__(self, layout: TaxelLayout) -> None:
        self.pads = layout.pads
        self._nearest, self._inside = [], []
        for f in range(layout.pads):
            k = int(layout.count[f])
            if k < 2:  # the one that stands for a finger without a pad
                self._nearest.append(np.zeros((PAD_HEIGHT, PAD_WIDTH), int))
                self._inside.append(np.zeros((PAD_HEIGHT, PAD_WIDTH), bool))
                continue
            points, normal = layout.point[f, :k], layout.normal[f, :k].mean(0)
            up = layout.ty[f, :k].mean(0)
            normal /= np.linalg.norm(normal)
            up = up - normal * (up @ normal)
            up /= np.linalg.norm(up)
            if up @ (points.mean(0)) < 0:  # away from the joint: the body's origin
                up = -up
            right = np.cross(up, normal)
            n = layout.normal[f, :k]
            across, along = np.arctan2(n @ right, n @ normal), np.arcsin(np.clip(n @ up, -1, 1))
            radius = np.ptp(points @ right) / 2
            flat = np.stack([across * radius, points @ up + 0.4 * along * radius], 1)
            flat -= (flat.min(0) + flat.max(0)) / 2
            scale = max(np.ptp(flat[:, 0]) / (PAD_WIDTH - 8), np.ptp(flat[:, 1]) / (PAD_HEIGHT - 8))
            x = (np.arange(PAD_WIDTH) - (PAD_WIDTH - 1) / 2) * scale
            y = ((PAD_HEIGHT - 1) / 2 - np.arange(PAD_HEIGHT)) * scale
            grid = np.stack(np.meshgrid(x, y), -1)
            distance = np.linalg.norm(grid[:, :, None] - flat, axis=-1)
            spacing = np.sort(np.linalg.norm(flat[:, None] - flat, axis=-1), axis=1)[:, 1]
            self._nearest.append(distance.argmin(-1))
            self._inside.append(distance.min(-1) < 0.9 * np.median(spacing) + scale)

    def image(self, force: np.ndarray, full: float) -> np.ndarray:
        """Return an RGB image [H, W, 3] uint8 of forces [F, T] (N); `full` has the darkest colour."""
        gap = np.broadcast_to(BACKGROUND, (PAD_HEIGHT, GAP, 3))
        tiles = [part for tile in self.pictures(force, full) for part in (tile, gap)]
        return np.ascontiguousarray(np.concatenate(tiles[:-1], 1))

    def pictures(self, force: np.ndarray, full: float, background: np.ndarray = BACKGROUND) -> list[np.ndarray]:
        """Return the same as one picture [H, W, 3] uint8 of each pad."""
        tiles = []
        for f in range(self.pads):
            tile = colours(force[f][self._nearest[f]], full)
            tile[~self._inside[f]] = background
            tiles.append(tile)
        return tiles


def force_bars(names: Sequence[str], force: np.ndarray, command: np.ndarray | None, full: float) -> str:
    """Return one bar a finger: measured force (N), with a line at the commanded one. command [F] (NaN: none for this
    finger)."""
    rows = []
    for k, name in enumerate(names):
        want = None if command is None or not np.isfinite(command[k]) else float(command[k])
        line = (
            ""
            if want is None
            else (
                f'<div style="position:absolute;top:-2px;bottom:-2px;width:3px;background:{COMMAND};'
                f'left:calc({100 * min(want / full, 1.0):.1f}% - 1px)"></div>'
            )
        )
        value = f"{force[k]:.1f}" + ("" if want is None else f" / {want:.1f}")
        rows.append(
            _row(
                name,
                f'<div style="height:100%;width:{100 * min(max(force[k], 0) / full, 1):.1f}%;'
            f'background:{BAR}"></div>{line}',
                value,
            )
        )
    key = "" if command is None else f' <span style="color:{COMMAND}">| command</span>'
    return _block("force-bars", f'<span style="color:{BAR}">■ measured</span>{key}, N (full bar {full:.0f})', rows)


def reward_bars(terms: Mapping[str, float], totals: Mapping[str, float], full: float) -> str:
    """Return one bar a term: the reward of this step to the right (green) or left (red) of the middle; behind it the
    episode's sum."""
    rows = []
    for name, value in terms.items():
        width = 50 * min(abs(value) / full, 1.0)
        side = f"left:50%;background:{PLUS}" if value >= 0 else f"right:50%;background:{MINUS}"
        bar = (
            f'<div style="position:absolute;top:0;bottom:0;width:{width:.1f}%;{side}"></div>'
            '<div style="position:absolute;left:50%;top:0;bottom:0;width:1px;background:#888"></div>'
        )
        rows.append(_row(name, bar, f"{_signed(value, 3)}  ({_signed(totals.get(name, 0.0), 1)})"))
    step, total = sum(terms.values()), sum(totals.values())
    return _block(
        "rewards", f"this step {_signed(step, 3)}, this episode {_signed(total, 1)}; by term: step (episode)", rows
    )


def training(rows: Mapping[str, Sequence[float]]) -> str:
    """Return how a run learns: facts of its last iteration, then by term the mean reward of a control step over all
    worlds, as a line over the iterations. rows: columns of progress.csv by name."""
    if not rows or not rows.get("iteration"):
        return facts({"": "no iteration yet"})
    known = {k: [x for x in v if np.isfinite(x)] for k, v in rows.items()}  # no episode ends in some iterations
    last = {k: v[-1] for k, v in known.items() if v}
    said = {"iteration": f"{last['iteration']:.0f}", "steps": f"{last['steps']:.3g}"}
    said |= {k: f"{last[k]:.4g}" for k in ("reward", "length") if k in last}
    said |= {k.removeprefix("task/").replace("_", " "): f"{v:.4g}" for k, v in last.items() if k.startswith("task/")}
    terms = {k.removeprefix("reward/"): v for k, v in known.items() if k.startswith("reward/") and v}
    lines = [_row(name, _line(values), _signed(values[-1], 4)) for name, values in terms.items()]
    return facts(said) + _block("training", "reward of a step by term, over the iterations", lines)


def _line(values: Sequence[float]) -> str:
    """Return a curve as SVG, its whole range high."""
    y = np.nan_to_num(np.asarray(values, float))
    y = y[:: max(1, len(y) // 120)]
    low, high = float(y.min()), float(y.max())
    points = " ".join(
        f"{100 * k / max(len(y) - 1, 1):.1f},{10 - 9 * (v - low) / max(high - low, 1e-12):.2f}" for k, v in enumerate(y)
    )
    return (
        '<svg viewBox="0 0 100 11" preserveAspectRatio="none" style="position:absolute;width:100%;height:100%">'
        f'<polyline points="{points}" fill="none" stroke="{BAR}" stroke-width="1" vector-effect="non-scaling-stroke"/>'
        "</svg>"
    )


def facts(rows: Mapping[str, object]) -> str:
    """Names and values, two columns."""
    cells = "".join(
        f'<div style="color:#667">{html.escape(str(k))}</div><div'
        f' data-fact="{html.escape(str(k))}">{html.escape(str(v))}</div>'
        for k, v in rows.items()
    )
    return (
        f'<div style="display:grid;grid-template-columns:7.5em 1fr;gap:1px 8px;'
        f'font-size:12px;padding:2px 12px">{cells}</div>'
    )


def pad_labels(names: Sequence[str]) -> str:
    """Names over the columns of :meth:`TaxelMap.image`."""
    cells = "".join(f'<div style="text-align:center">{html.escape(n)}</div>' for n in names)
    return (
        f'<div style="display:grid;grid-template-columns:repeat({len(names)},1fr);'
        f'font-size:11px;color:#445;padding:4px 12px 0">{cells}</div>'
    )


def _signed(value: float, digits: int) -> str:
    """Return a number with its sign, but no "-0.000"."""
    return f"{round(value, digits) + 0.0:+.{digits}f}" if round(value, digits) else f"{0:.{digits}f}"


def _row(name: str, bar: str, value: str) -> str:
    return (
        f'<div style="width:6.2em;overflow:hidden">{html.escape(name)}</div>'
        f'<div style="position:relative;height:11px;background:#e3e7ec;align-self:center">{bar}</div>'
        f'<div style="text-align:right;white-space:pre;font-variant-numeric:tabular-nums">{value}</div>'
    )


def _block(name: str, title: str, rows: Sequence[str]) -> str:
    return (
        f'<div data-panel="{name}" style="font-size:11px;padding:2px 12px"><div'
        f' style="color:#445;margin-bottom:2px">{title}</div>'
        f'<div style="display:grid;grid-template-columns:auto 1fr auto;gap:2px 8px">{"".join(rows)}</div></div>'
    )
