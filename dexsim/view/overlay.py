"""Drawing on rendered frames: a label and bars of measured force against the command."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

WHITE, GREY, DARK = (245, 245, 245), (150, 150, 150), (16, 20, 26)
BAR, TARGET = (74, 158, 255), (255, 176, 46)


@functools.cache
def font(size: int) -> ImageFont.FreeTypeFont:
    """Matplotlib's own DejaVu Sans: there on every machine."""
    import matplotlib

    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size)


def annotate(
    frame: np.ndarray,
    text: str = "",
    force: Sequence[float] | None = None,
    command: float | Sequence[float] | None = None,
    names: Sequence[str] = (),
    full: float = 10.0,
) -> np.ndarray:
    """A copy of ``frame`` [H, W, 3] uint8 with ``text`` above and one bar for each finger below left.

    Args:
        force: measured force of each finger (N), [F].
        command: commanded force (N), one for all or one each; drawn as a line across its bar.
        names: one short name for each finger.
        full: force of a full bar (N).
    """
    image = Image.fromarray(frame)
    draw = ImageDraw.Draw(image, "RGBA")
    height, width = frame.shape[:2]
    small = max(9, height // 30)
    if text:
        draw.rectangle((0, 0, width, int(1.9 * small)), fill=(*DARK, 150))
        draw.text((small * 0.6, small * 0.3), text, font=font(small), fill=WHITE)
    if force is not None and len(force):
        _bars(draw, np.asarray(force, float), command, names, full, height, small)
    return np.asarray(image)


def _bars(draw: ImageDraw.ImageDraw, force: np.ndarray, command: float | Sequence[float] | None,
          names: Sequence[str], full: float, height: int, small: int) -> None:
    targets = None if command is None else np.broadcast_to(np.asarray(command, float), force.shape)
    bar, gap, tall = int(1.6 * small), int(0.9 * small), height // 5
    left, base = int(1.2 * small), height - int(2.2 * small)
    right = left + len(force) * (bar + gap)
    draw.rectangle((left - gap, base - tall - int(2.0 * small), right, height), fill=(*DARK, 150))
    draw.text((left, base - tall - int(1.8 * small)), f"force (N), of {full:.0f}", font=font(small), fill=WHITE)
    for k, value in enumerate(force):
        x = left + k * (bar + gap)
        draw.rectangle((x, base - tall, x + bar, base), fill=(255, 255, 255, 40))
        draw.rectangle((x, base - _length(value, full, tall), x + bar, base), fill=BAR)
        if targets is not None:
            y = base - _length(targets[k], full, tall)
            draw.line((x - gap // 3, y, x + bar + gap // 3, y), fill=TARGET, width=max(2, small // 6))
        if k < len(names):
            draw.text((x + bar / 2, base + small * 0.3), names[k][:2], font=font(small), fill=GREY, anchor="ma")


def _length(value: float, full: float, tall: int) -> int:
    """Bar length in pixels; not-a-number and negative are none, more than full is full."""
    return int(round(tall * min(max(np.nan_to_num(value), 0.0) / full, 1.0)))
