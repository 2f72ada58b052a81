"""Small charts as inline SVG text."""

from __future__ import annotations

import html
from collections.abc import Sequence

import mujoco
import numpy as np

GRID, INK, SOFT = "#e6e9ee", "#333", "#8a94a3"
BEFORE, AFTER, COMMAND = "#d1495b", "#1f77b4", "#b8c0ca"


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


def _text(x: float, y: float, text: str, anchor: str = "start", size: int = 11, colour: str = SOFT) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" fill="{colour}" text-anchor="{anchor}" font-family="sans-serif">{html.escape(text)}</text>'


def curves(t: np.ndarray, measured: np.ndarray, before: np.ndarray, after: np.ndarray | None, command: np.ndarray, width: int = 980) -> str:
    """Positions above, errors below, against time [s]."""
    top, bottom, left, right = 210, 110, 52, 10
    height = top + bottom + 46
    t0, t1 = float(t[0]), float(t[-1]) if t[-1] > t[0] else float(t[0]) + 1
    x = left + (t - t0) / (t1 - t0) * (width - left - right)
    show = [measured, command, np.clip(before, measured.min() - np.ptp(measured), measured.max() + np.ptp(measured))]
    low, high = min(float(s.min()) for s in show), max(float(s.max()) for s in show)
    pad = 0.06 * max(high - low, 1e-6)
    low, high = low - pad, high + pad
    y = lambda v: 8 + (high - np.clip(v, low, high)) / (high - low) * top  # noqa: E731
    out = [f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="measured and simulated position">']
    for v in _ticks(low, high):
        out.append(f'<line x1="{left}" x2="{width - right}" y1="{y(v):.1f}" y2="{y(v):.1f}" stroke="{GRID}"/>')
        out.append(_text(left - 6, float(y(v)) + 4, f"{v:.3g}", "end"))
    out.append(_line(x, y(command), COMMAND, 1.2))
    out.append(_line(x, y(measured), INK, 1.8))
    out.append(_line(x, y(before), BEFORE))
    if after is not None:
        out.append(_line(x, y(after), AFTER))
    e0 = 1e3 * (before - measured)
    e1 = 1e3 * (after - measured) if after is not None else None
    size = max(float(np.percentile(np.abs(e0), 99.5)), 1e-3) * 1.1
    base = top + 30
    z = lambda v: base + (1 - np.clip(v / size, -1, 1)) * bottom / 2  # noqa: E731
    for v in (-size / 1.1, 0.0, size / 1.1):
        out.append(f'<line x1="{left}" x2="{width - right}" y1="{z(v):.1f}" y2="{z(v):.1f}" stroke="{GRID}"/>')
        out.append(_text(left - 6, float(z(v)) + 4, f"{v:.2g}", "end"))
    out.append(_line(x, z(e0), BEFORE))
    if e1 is not None:
        out.append(_line(x, z(e1), AFTER))
    for v in _ticks(t0, t1, 8):
        at = left + (v - t0) / (t1 - t0) * (width - left - right)
        out.append(_text(at, height - 4, f"{v:.3g} s", "middle"))
    out.append(_text(left + 4, 20, "position, rad (or m)", colour=SOFT))
    out.append(_text(left + 4, base + 10, "error, 10^-3", colour=SOFT))
    return "".join(out) + "</svg>"


def strips(rows: Sequence[tuple[str, list[tuple[float, float]]]], width: int = 980) -> str:
    """One strip a row: stretches of time that are dark."""
    end = max(max((b for _, b in spans), default=1.0) for _, spans in rows)
    left, right, step = 330, 12, 26
    height = step * len(rows) + 24
    scale = (width - left - right) / max(end, 1e-9)
    out = [f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="when the effects act">']
    for k, (name, spans) in enumerate(rows):
        y = k * step + 4
        out.append(_text(left - 8, y + 13, name if len(name) < 58 else name[:55] + "...", "end", 11, INK))
        out.append(f'<rect x="{left}" y="{y}" width="{width - left - right}" height="{step - 8}" fill="#eef1f4"/>')
        for a, b in spans:
            out.append(f'<rect x="{left + a * scale:.1f}" y="{y}" width="{max((b - a) * scale, 0.6):.1f}" height="{step - 8}" fill="{BEFORE}"/>')
    for v in _ticks(0, end, 8):
        out.append(_text(left + v * scale, height - 4, f"{v:.3g} s", "middle"))
    return "".join(out) + "</svg>"


def ratios(rows: Sequence[tuple[str, float, float, float]], width: int = 980) -> str:
    """Bars with intervals, 1 marked."""
    left, right, step = 400, 50, 26
    height = step * len(rows) + 22
    top = max([2.0, *(min(r[3], 8.0) for r in rows)])
    x = lambda v: left + min(max(v, 0.0), top) / top * (width - left - right)  # noqa: E731
    out = [f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="error by regime">']
    for k, (name, value, low, high) in enumerate(rows):
        y = k * step + 3
        out.append(_text(left - 8, y + 14, name if len(name) < 64 else name[:61] + "...", "end", 12, INK))
        out.append(f'<rect x="{left}" y="{y}" width="{max(x(value) - left, 0):.1f}" height="{step - 8}" fill="{BEFORE}" opacity="0.75"/>')
        out.append(f'<line x1="{x(low):.1f}" x2="{x(high):.1f}" y1="{y + 9}" y2="{y + 9}" stroke="{INK}" stroke-width="1.6"/>')
        out.append(_text(x(min(high, top)) + 6, y + 13, f"{value:.2g}", colour=INK))
    out.append(f'<line x1="{x(1):.1f}" x2="{x(1):.1f}" y1="0" y2="{height - 18}" stroke="{SOFT}" stroke-dasharray="3 3"/>')
    out.append(_text(x(1), height - 4, "as elsewhere (1)", "middle"))
    return "".join(out) + "</svg>"


def mechanism(model: mujoco.MjModel, error: dict[str, float], found: set[str], size: int = 290) -> str:
    """The mechanism's links as lines, seen along its thinnest direction; joints coloured by error."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    names = [model.joint(i).name for i in range(model.njnt)]
    joints = [i for i, n in enumerate(names) if n in error]
    points = {("j", i): data.xanchor[i].copy() for i in joints}
    lines = []
    for i in range(model.njnt):
        if names[i] not in error:
            continue
        body = int(model.jnt_bodyid[i])
        parent, up = int(model.body_parentid[body]), None
        while parent:
            inside = [k for k in joints if int(model.jnt_bodyid[k]) == parent]
            if inside:
                up = inside[-1]
                break
            parent = int(model.body_parentid[parent])
        start = data.xanchor[up] if up is not None else data.xpos[0] if np.linalg.norm(data.xanchor[i] - data.xpos[0]) > 1e-6 else data.xanchor[i]
        lines.append((start.copy(), data.xanchor[i].copy()))
        child = [b for b in range(model.nbody) if int(model.body_parentid[b]) == body and any(int(model.jnt_bodyid[k]) == b for k in joints)]
        if not child:  # the last link: out to its geoms
            geoms = [g for g in range(model.ngeom) if int(model.geom_bodyid[g]) == body]
            far = max((data.geom_xpos[g] for g in geoms), key=lambda p: np.linalg.norm(p - data.xanchor[i]), default=data.xipos[body])
            lines.append((data.xanchor[i].copy(), np.array(far)))
    cloud = np.array([p for line in lines for p in line] + list(points.values()))
    if not len(cloud):
        return ""
    centre = cloud.mean(0)
    _, _, vt = np.linalg.svd(cloud - centre, full_matrices=False)
    flat = np.zeros((2, 3))
    flat[: min(2, len(vt))] = vt[:2]
    if abs(flat[0, 2]) > abs(flat[1, 2]):  # up stays up
        flat = flat[::-1].copy()
    if flat[1, 2] < 0:
        flat[1] *= -1
    xy = (cloud - centre) @ flat.T
    span = max(float(np.ptp(xy, 0).max()), 1e-6)
    mid = 0.5 * (xy.min(0) + xy.max(0))

    def at(p):
        u = ((p - centre) @ flat.T - mid) / span * (size - 70)
        return size / 2 + u[0], size / 2 - u[1]

    top = max([*error.values(), 1e-12])
    out = [f'<svg viewBox="0 0 {size} {size}" role="img" aria-label="the mechanism, coloured by error">']
    for a, b in lines:
        (x1, y1), (x2, y2) = at(a), at(b)
        out.append(f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="#aeb7c2" stroke-width="7" stroke-linecap="round"/>')
    for (_, i), p in points.items():
        x, y = at(p)
        share = error[names[i]] / top
        red = tuple(int(255 + share * (c - 255)) for c in (200, 40, 50))
        ring = f'<circle cx="{x:.1f}" cy="{y:.1f}" r="13" fill="none" stroke="#1c2430" stroke-width="2"/>' if names[i] in found else ""
        out.append(f'{ring}<circle cx="{x:.1f}" cy="{y:.1f}" r="8" fill="rgb{red}" stroke="#6b7684"><title>{html.escape(names[i])}: {error[names[i]]:.4g}</title></circle>')
        if names[i] in found:
            out.append(_text(x, y - 18, names[i], "middle", 11, INK))
    return "".join(out) + "</svg>"
