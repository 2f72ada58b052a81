"""Draws beside rendered frames: a title above, and bars of measured force with the commanded one below."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

WHITE, GREY, DARK = (245, 245, 245), (190, 195, 200), (38, 44, 52)
BAR, TARGET = (74, 158, 255), (255, 176, 46)
WORDS = {"mid": "middle", "pinky": "little"}  # names of fingers in hands' files, as people say them


@functools.cache
def font(size: int) -> ImageFont.FreeTypeFont:
    """Return Matplotlib's own DejaVu Sans, which every installation has."""
    import matplotlib

    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size)


def room(height: int, text: bool, bars: bool) -> tuple[int, int]:
    """Return the pixels of a tile of this height that the title above and the bars below take."""
    small = _small(height)
    return (2 * small if text else 0), (8 * small if bars else 0)


def annotate(
    frame: np.ndarray, text: str = "", force: Sequence[float] | None = None,
    command: float | Sequence[float] | None = None, names: Sequence[str] = (), full: float = 10.0,
    height: int | None = None, pads: Sequence[np.ndarray] | None = None,
) -> np.ndarray:  # fmt: skip
    """Return a frame [H, W, 3] uint8 with a title above it and one bar for each finger below it; nothing is covered.

    Args:
        force: measured force of each finger (N), [F].
        command: commanded force (N), one for all or one each; drawn as a line across its bar.
        names: name of each finger.
        full: force of a full bar (N).
        height: of the whole tile in pixels, which sets the size of letters; default: the frame's.
        pads: a picture [h, w, 3] uint8 of the taxels of each finger, beside its bar.
    """
    bars = force is not None and len(force) > 0
    small = _small(height or frame.shape[0])
    above, below = room(height or frame.shape[0], bool(text), bars)
    width = frame.shape[1]
    whole = np.full((above + frame.shape[0] + below, width, 3), DARK, np.uint8)
    whole[above : above + frame.shape[0]] = frame
    image = Image.fromarray(whole)
    draw = ImageDraw.Draw(image, "RGBA")
    if text:
        draw.text((small * 0.6, small * 0.35), text, font=font(small), fill=WHITE)
    if bars:
        _bars(draw, np.asarray(force, float), command, names, full, (0, whole.shape[0] - below, width, below), small,
              0.1 if pads is None else 0.66)  # fmt: skip
        if pads is not None:
            _pads(image, pads, (0, whole.shape[0] - below, width, below), small)
    return np.asarray(image)


def _bars(
    draw: ImageDraw.ImageDraw, force: np.ndarray, command: float | Sequence[float] | None, names: Sequence[str],
    full: float, box: tuple[int, int, int, int], small: int, begin: float = 0.1,
) -> None:  # fmt: skip
    """Draw bars into box (left, top, width, height), in pixels; each begins at this share of its column."""
    x, top, width, height = box
    targets = None if command is None else np.broadcast_to(np.asarray(command, float), force.shape)
    letters = font(max(8, int(0.8 * small)))
    key = "force on each fingertip" if targets is None else "force on each fingertip;"
    draw.text((x + 0.6 * small, top + 0.35 * small), key, font=letters, fill=GREY)
    if targets is not None:
        end = x + 0.6 * small + draw.textlength(key + " ", font=letters)
        draw.text((end, top + 0.35 * small), "line: commanded", font=letters, fill=TARGET)
    column = (width - small) / len(force)
    base, tall = top + height - int(1.7 * small), height - int(3.4 * small)
    for k, value in enumerate(force):
        x0, x1 = int(x + 0.5 * small + (k + begin) * column), int(x + 0.5 * small + (k + 0.9) * column)
        draw.rectangle((x0, base - tall, x1, base), fill=(255, 255, 255, 30))
        draw.rectangle((x0, base - _length(value, full, tall), x1, base), fill=BAR)
        if targets is not None and np.isfinite(targets[k]):
            y = base - _length(targets[k], full, tall)
            draw.line((x0 - small // 4, y, x1 + small // 4, y), fill=TARGET, width=max(2, small // 5))
        word = WORDS.get(names[k], names[k]).replace("_", " ") if k < len(names) else ""
        text = f"{word} {np.nan_to_num(value):.0f} N" if word else ""
        if draw.textlength(text, font=letters) > column:
            text = word
        middle = x + 0.5 * small + (k + 0.5) * column
        draw.text((middle, base + 0.3 * small), text, font=letters, fill=WHITE, anchor="ma")


def _pads(image: Image.Image, pads: Sequence[np.ndarray], box: tuple[int, int, int, int], small: int) -> None:
    """Paste the pads' pictures beside their bars."""
    x, top, width, height = box
    column = (width - small) / len(pads)
    base, tall = top + height - int(1.7 * small), height - int(3.4 * small)
    side = min(tall, int(0.54 * column))
    for k, pad in enumerate(pads):
        picture = Image.fromarray(pad).resize((side, side), Image.Resampling.NEAREST)
        image.paste(picture, (int(x + 0.5 * small + (k + 0.08) * column), base - side))


def _small(height: int) -> int:
    """Return the size of letters in pixels in a tile of this height."""
    return max(9, height // 28)


def _length(value: float, full: float, tall: int) -> int:
    """Return a bar's length in pixels; not-a-number and negative are none, more than full is full."""
    return int(round(tall * min(max(np.nan_to_num(value), 0.0) / full, 1.0)))
