"""Small charts as inline SVG text: curves, bars, intervals, time strips. The mechanism's picture is in `picture.py`."""

from __future__ import annotations

import html
from collections.abc import Sequence

import numpy as np

GRID, INK, SOFT = "#e6e9ee", "#333", "#8a94a3"
BEFORE, AFTER, COMMAND, FLOOR = "#d1495b", "#1768ac", "#b8c0ca", "#9aa5b1"


def number(v: float, digits: int = 3) -> str:
    """v with so many digits, without an exponent where a person would not write one."""
    v = float(v)
    if v != 0 and not 1e-4 <= abs(v) < 1e6:
        return f"{v:.{digits}g}"
    if abs(v) >= 10 ** (digits - 1):
        return f"{round(v):,}"
    return f"{v:.{digits}g}"


def _ticks(low: float, high: float, count: int = 5) -> np.ndarray:
    span = max(high - low, 1e-12)
    step = 10 ** np.floor(np.log10(span / count))
    for k in (1, 2, 5, 10):
        if span / (k * step) <= count:
            step *= k
            break
    return np.arange(np.ceil(low / step) * step, high + 1e-9 * span, step)


def _line(x: np.ndarray, y: np.ndarray, colour: str, width: float = 1.4) -> str:
    ok = np.isfinite(y)
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x[ok], y[ok], strict=True))
    return f'<polyline fill="none" stroke="{colour}" stroke-width="{width}" stroke-linejoin="round" points="{points}"/>'


def text(
    x: float, y: float, words: str, anchor: str = "start", size: float = 11, colour: str = SOFT, weight: int = 400
) -> str:
    """A line of text at x, y."""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" fill="{colour}" text-anchor="{anchor}" '
        f'font-weight="{weight}">{html.escape(words)}</text>'
    )


def curves(
    t: np.ndarray,
    measured: np.ndarray,
    before: np.ndarray,
    after: np.ndarray | None,
    command: np.ndarray | None,
    unit: str = "rad",
    spans: Sequence[tuple[float, float]] = (),
    width: int = 980,
) -> str:
    """The quantity above, simulated minus measured below in thousandths, against time [s]; spans: stretches that are
    shaded."""
    top, bottom, left, right = 200, 96, 56, 12
    height = top + bottom + 50
    t0, t1 = float(t[0]), float(t[-1]) if t[-1] > t[0] else float(t[0]) + 1
    at = lambda v: left + (np.asarray(v) - t0) / (t1 - t0) * (width - left - right)  # noqa: E731
    x = at(t)
    show = [measured, np.clip(before, measured.min() - np.ptp(measured), measured.max() + np.ptp(measured))] + (
        [] if command is None else [command]
    )
    low, high = min(float(s.min()) for s in show), max(float(s.max()) for s in show)
    pad = 0.06 * max(high - low, 1e-6)
    low, high = low - pad, high + pad
    y = lambda v: 16 + (high - np.clip(v, low, high)) / (high - low) * (top - 8)  # noqa: E731
    out = [f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="measured and simulated {unit}">']
    for a, b in spans:
        a, b = max(a, t0), min(b, t1)
        if b > a:
            out.append(
                f'<rect x="{float(at(a)):.1f}" y="8" width="{max(float(at(b) - at(a)), 0.8):.1f}" '
                f'height="{height - 34}" fill="#f3e9d2"/>'
            )
    for v in _ticks(low, high):
        out.append(f'<line x1="{left}" x2="{width - right}" y1="{y(v):.1f}" y2="{y(v):.1f}" stroke="{GRID}"/>')
        out.append(text(left - 6, float(y(v)) + 4, number(v if abs(v) > 1e-12 else 0.0), "end"))
    if command is not None:
        out.append(_line(x, y(command), COMMAND, 1.2))
    out.append(_line(x, y(measured), INK, 2.0))
    out.append(_line(x, y(before), BEFORE, 1.5))
    if after is not None:
        out.append(_line(x, y(after), AFTER, 1.5))
    e0 = 1e3 * (before - measured)
    e1 = 1e3 * (after - measured) if after is not None else None
    size = max(float(np.percentile(np.abs(e0), 99.5)), 1e-3) * 1.1
    base = top + 28
    z = lambda v: base + (1 - np.clip(v / size, -1, 1)) * bottom / 2  # noqa: E731
    for v in (-size / 1.1, 0.0, size / 1.1):
        out.append(f'<line x1="{left}" x2="{width - right}" y1="{z(v):.1f}" y2="{z(v):.1f}" stroke="{GRID}"/>')
        out.append(text(left - 6, float(z(v)) + 4, number(v, 2), "end"))
    out.append(_line(x, z(e0), BEFORE, 1.5))
    if e1 is not None:
        out.append(_line(x, z(e1), AFTER, 1.5))
    for v in _ticks(t0, t1, 8):
        out.append(text(float(at(v)), height - 6, f"{v:.3g} s", "middle"))
    out.append(text(left + 4, 12, unit))
    out.append(
        text(left + 4, base - 5, f"error, m{unit}" if unit in ("rad", "m", "N", "A", "N.m") else "error, thousandths")
    )
    return "".join(out) + "</svg>"


def bars(rows: Sequence[tuple[str, float, float | None, float | None, str]], unit: str, width: int = 560) -> str:
    """Horizontal bars: (name, value, low, high, colour); values share one scale."""
    left, right, step = 118, 118, 38
    height = step * len(rows) + 6
    top = max([*(max(r[1], r[3] or 0.0) for r in rows), 1e-12])
    x = lambda v: left + v / top * (width - left - right)  # noqa: E731
    out = [f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="errors on held-out data">']
    for k, (name, value, low, high, colour) in enumerate(rows):
        y = k * step + 4
        out.append(text(left - 10, y + 20, name, "end", 13, INK))
        out.append(
            f'<rect x="{left}" y="{y + 4}" width="{max(x(value) - left, 1.5):.1f}" height="{step - 14}" rx="3" '
            f'fill="{colour}"/>'
        )
        end = x(value)
        if low is not None and high is not None:
            out.append(
                f'<line x1="{x(low):.1f}" x2="{x(high):.1f}" y1="{y + 16}" y2="{y + 16}" stroke="{INK}" '
                'stroke-width="1.4"/>'
            )
            out += [
                f'<line x1="{x(v):.1f}" x2="{x(v):.1f}" y1="{y + 12}" y2="{y + 20}" stroke="{INK}" stroke-width="1.4"/>'
                for v in (low, high)
            ]
            end = max(end, x(high))
        out.append(text(end + 8, y + 21, f"{number(value)} {unit}", "start", 14, INK, 600))
    return "".join(out) + "</svg>"


def interval(value: float, low: float, high: float, width: int = 190) -> str:
    """A value with its interval on a short axis that begins at 0 where that is near."""
    lo, hi = min(low, value), max(high, value)
    span = max(hi - lo, 1e-12 + 0.02 * abs(value))
    a, b = lo - 0.6 * span, hi + 0.6 * span
    zero = a < 0 < b or (a > 0 and a < 0.35 * b) or (b < 0 and b > 0.35 * a)
    a, b = (min(a, 0.0), max(b, 0.0)) if zero else (a, b)
    x = lambda v: 6 + (v - a) / (b - a) * (width - 12)  # noqa: E731
    out = [
        f'<svg class="iv" width="{width}" height="26" viewBox="0 0 {width} 26" role="img" aria-label="{value:.4g}, '
        f'{low:.4g} to {high:.4g}">',
        f'<line x1="6" x2="{width - 6}" y1="10" y2="10" stroke="{GRID}" stroke-width="2"/>',
    ]
    if zero:
        out.append(
            f'<line x1="{x(0):.1f}" x2="{x(0):.1f}" y1="4" y2="16" stroke="{SOFT}"/>' + text(x(0), 25, "0", "middle", 9)
        )
    out.append(
        f'<line x1="{x(lo):.1f}" x2="{x(hi):.1f}" y1="10" y2="10" stroke="{AFTER}" stroke-width="5" '
        'stroke-linecap="round" opacity="0.45"/>'
    )
    out.append(f'<circle cx="{x(value):.1f}" cy="10" r="4.5" fill="{AFTER}"/>')
    return "".join(out) + "</svg>"


def strips(rows: Sequence[tuple[str, float, list[tuple[float, float]]]], width: int = 560) -> str:
    """One strip a recording: (name, its end [s], stretches [s] that are dark)."""
    end = max(max(e, 1e-9) for _, e, _ in rows)
    left, right, step = 118, 12, 22
    height = step * len(rows) + 18
    scale = (width - left - right) / end
    out = [f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="when it acts">']
    for k, (name, stop, spans) in enumerate(rows):
        y = k * step + 3
        out.append(text(left - 8, y + 12, name if len(name) < 20 else "..." + name[-17:], "end", 11, INK))
        out.append(f'<rect x="{left}" y="{y}" width="{stop * scale:.1f}" height="{step - 8}" rx="2" fill="#eef1f4"/>')
        for a, b in spans:
            out.append(
                f'<rect x="{left + a * scale:.1f}" y="{y}" width="{max((b - a) * scale, 0.8):.1f}" '
                f'height="{step - 8}" fill="#d99a2b"/>'
            )
    for v in _ticks(0, end, 6):
        out.append(text(left + v * scale, height - 3, f"{v:.3g} s", "middle"))
    return "".join(out) + "</svg>"


def ratios(rows: Sequence[tuple[str, float, float, float]], width: int = 980, left: int = 400) -> str:
    """Bars with intervals, 1 marked."""
    right, step = 50, 26
    height = step * len(rows) + 22
    top = max([2.0, *(min(r[3], 8.0) for r in rows)])
    x = lambda v: left + min(max(v, 0.0), top) / top * (width - left - right)  # noqa: E731
    out = [f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="error by regime">']
    for k, (name, value, low, high) in enumerate(rows):
        y = k * step + 3
        out.append(text(left - 8, y + 14, name if len(name) < 64 else name[:61] + "...", "end", 12, INK))
        out.append(
            f'<rect x="{left}" y="{y}" width="{max(x(value) - left, 0):.1f}" height="{step - 8}" fill="{BEFORE}" '
            'opacity="0.75"/>'
        )
        out.append(
            f'<line x1="{x(low):.1f}" x2="{x(high):.1f}" y1="{y + 9}" y2="{y + 9}" stroke="{INK}" stroke-width="1.6"/>'
        )
        out.append(text(x(min(high, top)) + 6, y + 13, f"{value:.2g}", colour=INK))
    out.append(
        f'<line x1="{x(1):.1f}" x2="{x(1):.1f}" y1="0" y2="{height - 18}" stroke="{SOFT}" stroke-dasharray="3 3"/>'
    )
    out.append(text(x(1), height - 4, "as elsewhere (1)", "middle"))
    return "".join(out) + "</svg>"
