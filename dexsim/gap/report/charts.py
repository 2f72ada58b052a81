"""Small charts as inline SVG text (curves, bars, intervals, time strips), and a picture of the mechanism."""

from __future__ import annotations

import html
from collections.abc import Sequence, Set
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from dexsim.console.tables import number
from dexsim.gap.plant.mechanics import chain
from dexsim.tactile.sensors import Sensors

GRID, INK, SOFT = "#e6e9ee", "#333", "#8a94a3"
BEFORE, AFTER, COMMAND, FLOOR = "#d1495b", "#1768ac", "#b8c0ca", "#9aa5b1"


def _ticks(low: float, high: float, count: int = 5) -> np.ndarray:
    span = max(high - low, 1e-12)
    step = 10 ** np.floor(np.log10(span / count))
    for k in (1, 2, 5, 10):
        if span / (k * step) <= count:
            step *= k
            break
    return np.arange(np.ceil(low / step) * step, high + 1e-9 * span, step)


def _tag(name: str, inside: str | None = None, /, **attributes: Any) -> str:
    """Return an element of SVG; numbers with one decimal, `_` of a name as `-`."""
    given = (f'{k.replace("_", "-")}="{f"{v:.1f}" if isinstance(v, float) else v}"' for k, v in attributes.items())
    head = f"<{name} {' '.join(given)}"
    return f"{head}/>" if inside is None else f"{head}>{inside}</{name}>"


def _picture(width: float, height: float, label: str, parts: Sequence[str], /, **more: Any) -> str:
    return _tag("svg", "".join(parts), **more, viewBox=f"0 0 {width:g} {height:g}", role="img", aria_label=label)


def _line(x: np.ndarray, y: np.ndarray, colour: str, width: float = 1.4) -> str:
    ok = np.isfinite(y)
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x[ok], y[ok], strict=True))
    return _tag("polyline", fill="none", stroke=colour, stroke_width=width, stroke_linejoin="round", points=points)


def _rule(x1: float, x2: float, y1: float, y2: float, colour: str, width: float = 1.0, **more: Any) -> str:
    return _tag("line", x1=x1, x2=x2, y1=y1, y2=y2, stroke=colour, stroke_width=width, **more)


def _box(x: float, y: float, width: float, height: float, fill: str, **more: Any) -> str:
    return _tag("rect", x=x, y=y, width=width, height=height, fill=fill, **more)


def text(
    x: float, y: float, words: str, anchor: str = "start", size: float = 11, colour: str = SOFT, weight: int = 400
) -> str:
    """Return a line of text at x, y."""
    font = {"font_size": f"{size:g}", "font_weight": weight}
    return _tag("text", html.escape(words), x=float(x), y=float(y), fill=colour, text_anchor=anchor, **font)


def curves(
    t: np.ndarray,
    measured: np.ndarray,
    before: np.ndarray,
    after: np.ndarray | None,
    command: np.ndarray | None,
    unit: str = "rad",
    spans: Sequence[tuple[float, float]] = (),
) -> str:
    """Return the quantity above, simulated minus measured below in thousandths, against time [s]; spans: stretches that
    are shaded."""
    width, top, bottom, left, right = 980, 200, 96, 56, 12
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
    simulated = [(before, BEFORE), *([] if after is None else [(after, AFTER)])]
    size = max(float(np.percentile(np.abs(1e3 * (before - measured)), 99.5)), 1e-3)
    base = top + 28
    z = lambda v: base + (1 - np.clip(v / (1.1 * size), -1, 1)) * bottom / 2  # noqa: E731
    inside = ((max(a, t0), min(b, t1)) for a, b in spans)
    out = [_box(float(at(a)), 8, max(float(at(b) - at(a)), 0.8), height - 34, "#f3e9d2") for a, b in inside if b > a]
    for v, place, label in (
        *((v, y, number(v if abs(v) > 1e-12 else 0.0)) for v in _ticks(low, high)),
        *((v, z, number(v, 2)) for v in (-size, 0.0, size)),
    ):
        level = float(place(v))
        out += [_rule(left, width - right, level, level, GRID), text(left - 6, level + 4, label, "end")]
    out += [] if command is None else [_line(x, y(command), COMMAND, 1.2)]
    out += [_line(x, y(measured), INK, 2.0), *(_line(x, y(s), colour, 1.5) for s, colour in simulated)]
    out += [_line(x, z(1e3 * (s - measured)), colour, 1.5) for s, colour in simulated]
    out += [text(float(at(v)), height - 6, f"{v:.3g} s", "middle") for v in _ticks(t0, t1, 8)]
    of = f"m{unit}" if unit in ("rad", "m", "N", "A", "N.m") else "thousandths"
    out += [text(left + 4, 12, unit), text(left + 4, base - 5, f"error, {of}")]
    return _picture(width, height, f"measured and simulated {unit}", out)


def bars(rows: Sequence[tuple[str, float, float | None, float | None, str]], unit: str) -> str:
    """Return horizontal bars: (name, value, low, high, colour); values share one scale."""
    width, left, right, step = 560, 156, 118, 38
    top = max([*(max(r[1], r[3] or 0.0) for r in rows), 1e-12])
    x = lambda v: left + v / top * (width - left - right)  # noqa: E731
    out: list[str] = []
    for k, (name, value, low, high, colour) in enumerate(rows):
        y, end = k * step + 4, x(value)
        out.append(text(left - 10, y + 20, name, "end", 13, INK))
        out.append(_box(left, y + 4, max(end - left, 1.5), step - 14, colour, rx=3))
        if low is not None and high is not None:
            ends = ((x(low), x(high), y + 16, y + 16), *((x(v), x(v), y + 12, y + 20) for v in (low, high)))
            out += [_rule(*ends_, INK, 1.4) for ends_ in ends]
            end = max(end, x(high))
        out.append(text(end + 8, y + 21, f"{number(value)} {unit}", "start", 14, INK, 600))
    return _picture(width, step * len(rows) + 6, "errors on held-out data", out)


def interval(value: float, low: float, high: float) -> str:
    """Return a value with its interval on a short axis that begins at 0 where that is near."""
    width, lo, hi = 190, min(low, value), max(high, value)
    span = max(hi - lo, 1e-12 + 0.02 * abs(value))
    a, b = lo - 0.6 * span, hi + 0.6 * span
    zero = a < 0 < b or (a > 0 and a < 0.35 * b) or (b < 0 and b > 0.35 * a)
    a, b = (min(a, 0.0), max(b, 0.0)) if zero else (a, b)
    x = lambda v: 6 + (v - a) / (b - a) * (width - 12)  # noqa: E731
    out = [_rule(6, width - 6, 10, 10, GRID, 2)]
    out += [_rule(x(0), x(0), 4, 16, SOFT), text(x(0), 25, "0", "middle", 9)] if zero else []
    out.append(_rule(x(lo), x(hi), 10, 10, AFTER, 5, stroke_linecap="round", opacity="0.45"))
    out.append(_tag("circle", cx=x(value), cy=10, r="4.5", fill=AFTER))
    label = f"{value:.4g}, {low:.4g} to {high:.4g}"
    return _picture(width, 26, label, out, **{"class": "iv", "width": width, "height": 26})


def strips(rows: Sequence[tuple[str, float, list[tuple[float, float]]]]) -> str:
    """Return one strip a recording: (name, its end [s], stretches [s] that are dark)."""
    end = max(max(e, 1e-9) for _, e, _ in rows)
    width, left, right, step = 560, 118, 12, 22
    height = step * len(rows) + 18
    scale = (width - left - right) / end
    out: list[str] = []
    for k, (name, stop, spans) in enumerate(rows):
        y = k * step + 3
        out.append(text(left - 8, y + 12, name if len(name) < 20 else "..." + name[-17:], "end", 11, INK))
        out.append(_box(left, y, stop * scale, step - 8, "#eef1f4", rx=2))
        out += [_box(left + a * scale, y, max((b - a) * scale, 0.8), step - 8, "#d99a2b") for a, b in spans]
    out += [text(left + v * scale, height - 3, f"{v:.3g} s", "middle") for v in _ticks(0, end, 6)]
    return _picture(width, height, "when it acts", out)


def ratios(rows: Sequence[tuple[str, float, float, float]], width: int = 980, left: int = 400) -> str:
    """Return bars with intervals, 1 marked."""
    right, step = 50, 26
    height = step * len(rows) + 22
    top = max([2.0, *(min(r[3], 8.0) for r in rows)])
    x = lambda v: left + min(max(v, 0.0), top) / top * (width - left - right)  # noqa: E731
    out: list[str] = []
    for k, (name, value, low, high) in enumerate(rows):
        y = k * step + 3
        out += [
            text(left - 8, y + 14, name if len(name) < 64 else name[:61] + "...", "end", 12, INK),
            _box(left, y, max(x(value) - left, 0), step - 8, BEFORE, opacity="0.75"),
            _rule(x(low), x(high), y + 9, y + 9, INK, 1.6),
            text(x(min(high, top)) + 6, y + 13, f"{value:.2g}", colour=INK),
        ]
    out.append(_rule(x(1), x(1), 0, height - 18, SOFT, stroke_dasharray="3 3"))
    out.append(text(x(1), height - 4, "as elsewhere (1)", "middle"))
    return _picture(width, height, "error by regime", out)


# -- a picture of the mechanism ---------------------------------------------------------------------------------------
# A picture of the mechanism as inline SVG: outlines of its links, joints coloured by error, taxels where they sit.

PALE, HOT = (247, 243, 236), (196, 38, 46)
UNKNOWN = 12  # taxels drawn in a column where no lattice is known


def pad(error: np.ndarray, marked: set[int], lattice: tuple[int, int] | None) -> str:
    """Return one pad's taxels [K] N as its lattice of (columns, rows), rows from the joint (below) to the tip, coloured
    by error; the marked ringed. Without a lattice in rows of twelve, by number."""
    size, (columns, rows) = 15, lattice or (-(-len(error) // UNKNOWN), UNKNOWN)
    error = error[: columns * rows]  # a smaller pad's end before the largest's
    most = max(float(error.max()), 1e-9)
    width, height, out = columns * size + 2, rows * size + 2, []
    for k, e in enumerate(error):
        c, r = divmod(k, rows)
        ring = {"stroke": INK, "stroke_width": 2} if k in marked else {"stroke": "#fff", "stroke_width": 1}
        place = {"x": 2 + c * size, "y": 2 + (rows - 1 - r) * size, "width": size - 2, "height": size - 2, "rx": 2}
        said = f"<title>taxel {k}: {1e3 * e:.0f} mN</title>"
        out.append(_tag("rect", said, **place, fill=heat(e / most), **ring))
    return _picture(width, height, "error of each taxel", out, width=width, height=height)


def heat(share: float) -> str:
    """Colour of an error, as a share of the largest."""
    share = float(np.clip(share, 0.0, 1.0)) ** 0.7
    return "#" + "".join(f"{int(a + share * (b - a)):02x}" for a, b in zip(PALE, HOT, strict=True))


def scale(most: float, unit: str) -> str:
    """Return the colours' scale: from none to the largest error `most`, in thousandths of the position's unit."""
    left, right, steps = 60, 264, 24
    part = (right - left) / steps
    out = [_box(left + k * part, 4, part + 0.5, 11, heat((k + 0.5) / steps)) for k in range(steps)]
    out += [text(left - 8, 14, "0", "end"), text(right + 8, 14, f"{number(1e3 * most)} {unit}")]
    return _picture(360, 20, "colours of the error", out)


def _corners(model: mujoco.MjModel, data: mujoco.MjData, g: int) -> np.ndarray:
    """Points [n, 3] whose hull is the geom, world frame."""
    kind, size = int(model.geom_type[g]), model.geom_size[g]
    if kind == int(mujoco.mjtGeom.mjGEOM_MESH):
        m = model.geom_dataid[g]
        p = model.mesh_vert[model.mesh_vertadr[m] : model.mesh_vertadr[m] + model.mesh_vertnum[m]].astype(float)
    elif kind == int(mujoco.mjtGeom.mjGEOM_PLANE):
        return np.zeros((0, 3))
    else:
        u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 13)[:-1], np.linspace(0, np.pi, 7))
        ball = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], -1).reshape(-1, 3)
        if kind == int(mujoco.mjtGeom.mjGEOM_SPHERE):
            p = ball * size[0]
        elif kind == int(mujoco.mjtGeom.mjGEOM_CAPSULE):
            p = np.concatenate([ball * size[0] + [0, 0, size[1]], ball * size[0] - [0, 0, size[1]]])
        elif kind == int(mujoco.mjtGeom.mjGEOM_CYLINDER):
            ring = np.stack([np.cos(u[0]), np.sin(u[0]), 0 * u[0]], -1) * size[0]
            p = np.concatenate([ring + [0, 0, size[1]], ring - [0, 0, size[1]]])
        elif kind == int(mujoco.mjtGeom.mjGEOM_ELLIPSOID):
            p = ball * size
        else:
            p = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) * size
    return p @ data.geom_xmat[g].reshape(3, 3).T + data.geom_xpos[g]


def _view(cloud: np.ndarray, facing: np.ndarray | None) -> np.ndarray:
    """Return rows right, up, towards the viewer: along the cloud's thinnest direction; up stays up, else the longest
    side stands."""
    centred = cloud - cloud.mean(0)
    _, _, axes = np.linalg.svd(centred[:: max(1, len(centred) // 4000)], full_matrices=False)
    front = axes[2]
    if facing is not None and abs(front @ facing) > 0.2:
        front = front * np.sign(front @ facing)
    up = np.array([0.0, 0.0, 1.0]) - front * front[2]
    if np.linalg.norm(up) < 0.6:  # seen from above or below
        up = axes[0] * (1 if axes[0][int(np.argmax(np.abs(axes[0])))] > 0 else -1)
    up = up / np.linalg.norm(up)
    return np.stack([np.cross(up, front), up, front])


@dataclass
class _Drawing:
    """A model at its own pose as seen from one side: where a point [.., 3] m lies on a picture of width x height, its
    links' `shapes` (number of the geom, corners [n, 3]) and the `pads` (number of the finger, taxels [K, 3]) that it
    carries."""

    model: mujoco.MjModel
    data: mujoco.MjData
    shapes: list[tuple[int, np.ndarray]]
    pads: list[tuple[int, np.ndarray]]
    axes: np.ndarray
    scale: float  # of the picture per m
    middle: np.ndarray
    width: int
    height: int

    def at(self, p: np.ndarray) -> np.ndarray:
        """Return [n, 2] of the picture."""
        u = (np.atleast_2d(p) @ self.axes.T)[:, :2]
        x, y = (u[:, k] - self.middle[k] for k in (0, 1))
        return np.stack([self.width / 2 + x * self.scale, self.height / 2 - y * self.scale], 1)


def _drawing(
    model: mujoco.MjModel, sensors: Sensors, joints: list[int], touch_alone: bool, width: int, height: int
) -> _Drawing | None:
    """Return the model seen from where its motion shows best, filling the picture; None where there is nothing to
    see."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    groups = [g for g in range(model.ngeom) if int(model.geom_group[g]) <= 2] or list(range(model.ngeom))
    shapes = [(g, _corners(model, data, g)) for g in groups]
    shapes = [(g, p) for g, p in shapes if len(p) >= 4]
    if touch_alone and shapes:  # what is small beside the rest is no part of the picture
        most = max(float(np.ptp(p, axis=0).max()) for _, p in shapes)
        shapes = [(g, p) for g, p in shapes if float(np.ptp(p, axis=0).max()) > 0.15 * most]
    cloud = np.concatenate([*[p for _, p in shapes], data.xanchor[joints].reshape(-1, 3)])
    if len(cloud) < 3:
        return None
    pads = []
    facing = None
    bodies = [model.body(i).name for i in range(model.nbody)]
    layout = sensors.layout
    for f, body in enumerate(() if layout is None else layout.bodies):
        if layout is not None and body in bodies:
            b, n = data.body(body), layout.count[f]
            R = b.xmat.reshape(3, 3)
            pads.append((f, layout.point[f, :n] @ R.T + b.xpos))
            facing = (0 if facing is None else facing) + (layout.normal[f, :n] @ R.T).mean(0)
    axes = _view(cloud, facing)
    flat = cloud @ axes.T
    low, high = flat[:, :2].min(0), flat[:, :2].max(0)
    scale = min((width - 60) / max(high[0] - low[0], 1e-6), (height - 60) / max(high[1] - low[1], 1e-6))
    return _Drawing(model, data, shapes, pads, axes, scale, 0.5 * (low + high), width, height)


def mechanism(
    model: mujoco.MjModel,
    sensors: Sensors,
    error: dict[str, float],
    found: set[str],
    taxels: np.ndarray | None = None,
    marked: Set[str] = frozenset(),
    unit: str = "mrad",
    height: int = 400,
) -> str:
    """Return the links' outlines; a disc at each joint that has an error [by name], coloured by it, ringed and named
    where found. taxels [F, K]: error of each taxel (`marked`: "f:k" ringed), drawn where the model carries the pads of
    `sensors`."""
    width, names = 360, [model.joint(i).name for i in range(model.njnt)]
    joints = [i for i, n in enumerate(names) if n in error]
    drawing = _drawing(model, sensors, joints, not error, width, height)
    if drawing is None:
        return ""
    hot = {int(model.jnt_bodyid[i]) for i in joints if names[i] in found}
    out = [*_outlines(drawing, hot), *_links(drawing, joints)]
    if taxels is not None:
        out += _taxels(drawing, taxels, marked)
    most = max([*error.values(), 1e-12])
    out += _discs(drawing, {i: (names[i], error[names[i]]) for i in joints}, most, found, unit)
    return _picture(width, height, "the mechanism, coloured by error", out)


def _outlines(d: _Drawing, hot: set[int]) -> list[str]:
    """Return the links from the farthest to the nearest, those of `hot` bodies in another colour."""
    from scipy.spatial import ConvexHull, QhullError

    out = []
    for g, p in sorted(d.shapes, key=lambda s: float((s[1] @ d.axes[2]).mean())):
        xy = d.at(p)
        try:
            xy = xy[ConvexHull(xy).vertices]
        except QhullError:
            continue
        fill = "#f4d9c0" if int(d.model.geom_bodyid[g]) in hot else "#e3e8ee"
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in xy)
        edge = {"stroke": "#aeb8c4", "stroke_width": "0.8", "stroke_linejoin": "round"}
        out.append(_tag("polygon", points=points, fill=fill, **edge))
    return out


def _links(d: _Drawing, joints: list[int]) -> list[str]:
    """Return lines from joint to joint, so that a mechanism without shapes still shows."""
    out = []
    for i in joints:
        for parent in chain(d.model, d.model.jnt_bodyid[i])[1:]:
            inside = [k for k in joints if int(d.model.jnt_bodyid[k]) == parent]
            if inside:
                a, b = d.at(d.data.xanchor[inside[-1]])[0], d.at(d.data.xanchor[i])[0]
                out.append(_rule(a[0], b[0], a[1], b[1], "#8f9baa", 2))
                break
    return out


def _taxels(d: _Drawing, taxels: np.ndarray, marked: Set[str]) -> list[str]:
    """Return the taxels of the pads, coloured by their error [F, K] N; ringed where `marked`."""
    out = []
    most, size = max(float(taxels.max()), 1e-9), 2.2 if d.scale < 4000 else 5.0
    for f, p in d.pads:
        for k, (x, y) in enumerate(d.at(p)):
            ring = {"stroke": INK, "stroke_width": 1} if f"{f}:{k}" in marked else {}
            said = f"<title>taxel {f}:{k}: {1e3 * taxels[f, k]:.0f} mN</title>"
            out.append(_tag("circle", said, cx=x, cy=y, r=size, fill=heat(taxels[f, k] / most), **ring))
    return out


def _discs(d: _Drawing, joints: dict[int, tuple[str, float]], most: float, found: set[str], unit: str) -> list[str]:
    """Return a disc at each joint (number -> name, error), coloured by its error of `most`, ringed and named where
    found."""
    out, labels = [], []
    for i, (name, small) in joints.items():
        (x, y) = d.at(d.data.xanchor[i])[0]
        said = f"<title>{html.escape(name)}: {1e3 * small:.3g} {unit}</title>"
        if name in found:
            out.append(_tag("circle", cx=x, cy=y, r=13, fill="none", stroke=INK, stroke_width=2))
            side, dx = ("end", -17) if x > 0.62 * d.width else ("start", 17)
            label = text(x + dx, y + 4, name, side, 12, INK, 600)
            labels.append(_tag("g", label, stroke="#fff", stroke_width=3, paint_order="stroke"))
        out.append(_tag("circle", said, cx=x, cy=y, r=8, fill=heat(small / most), stroke=SOFT))
    return out + labels
