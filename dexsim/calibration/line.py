"""A line through presses: slope with its interval, whether a line it is, and if not, why."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy import stats

from dexsim import intervals

BOOTSTRAP = 1000
R2_LEAST, HYSTERESIS_MOST, OFFSET_MOST, BEND_MOST = 0.97, 0.10, 0.10, 0.05
"""A fit is called linear if R2 is at least the first, loading and unloading differ by at most the second share of the
largest force, the line meets zero force within the third share of the effort's range, and a parabola through the same
points leaves the line by at most the fourth share (or is not significant at 1 %)."""


@dataclass
class Levels:
    """Steady presses of one joint: effort [n] (A or N.m, positive while closing), force [n] N, level [n]: number of the
    commanded level (loading and unloading of one level share it), up [n]: loading. position [n] rad; full [n]: a taxel
    stood at its largest count; rows with no contact are left out (`free` counts them)."""

    effort: np.ndarray
    force: np.ndarray
    level: np.ndarray
    up: np.ndarray
    position: np.ndarray
    full: np.ndarray
    free: int = 0

    def __len__(self) -> int:
        return len(self.effort)


@dataclass
class LineFit:
    """force = ratio * effort (the paper's), and force = slope * effort + offset (N). *_low, *_high: 95 % intervals, by
    a bootstrap over levels. hysteresis: mean gap between unloading and loading at equal effort over the largest force.
    held_out: RMS error [N] of lines fitted without the level they predict; bend: largest distance of a parabola
    from the line over the range of force. why: what keeps it from being a line; empty: linear."""

    ratio: float
    ratio_low: float
    ratio_high: float
    slope: float
    slope_low: float
    slope_high: float
    offset: float
    r2: float
    r2_ratio: float
    held_out: float
    hysteresis: float
    bend: float
    effort_max: float
    force_max: float
    count: int
    why: list[str] = field(default_factory=list)

    @property
    def linear(self) -> bool:
        return not self.why

    def table(self) -> dict[str, object]:
        """Return the plain numbers, rounded to 6 digits."""
        x = {k: float(f"{v:.6g}") for k, v in vars(self).items() if isinstance(v, float)}
        out: dict[str, object] = {
            k: {"value": x[k], "low": x[f"{k}_low"], "high": x[f"{k}_high"]} for k in ("ratio", "slope")
        }
        named = {"offset_N": "offset", "r2": "r2", "r2_through_zero": "r2_ratio", "held_out_N": "held_out",
                 "hysteresis": "hysteresis", "bend": "bend", "effort_max": "effort_max", "force_max_N": "force_max"}
        return out | {k: x[v] for k, v in named.items()} | {
            "presses": self.count, "linear": self.linear, "why": list(self.why)}  # fmt: skip


def fit(levels: Levels, unit: str = "", seed: int = 0) -> LineFit | None:
    """Return the line of one joint's presses; None where there are fewer than 3 with contact. unit: of the effort, for
    texts."""
    x, y, n = levels.effort, levels.force, len(levels)
    if n < 3 or np.ptp(x) == 0:
        return None
    slope, offset = _line(x, y)
    ratio = float(x @ y / (x @ x))
    names = np.unique(levels.level)
    rows = [np.flatnonzero(levels.level == k) for k in names]
    sums = np.array([(len(k), x[k].sum(), y[k].sum(), x[k] @ x[k], x[k] @ y[k]) for k in rows]).T
    low, high = intervals.bootstrap(tuple(sums), _ratio_and_slope, seed, BOOTSTRAP)
    total = ((y - y.mean()) ** 2).sum()
    r2 = 1 - ((y - slope * x - offset) ** 2).sum() / total
    r2_ratio = 1 - ((y - ratio * x) ** 2).sum() / total
    errors = []
    for k, row in zip(names, rows, strict=True):
        rest = levels.level != k
        if rest.sum() >= 3 and np.ptp(x[rest]) > 0:
            a, b = _line(x[rest], y[rest])
            errors.append(y[row] - a * x[row] - b)
    held = float(np.sqrt(np.mean(np.concatenate(errors) ** 2))) if errors else float("nan")
    bend, significant = _bend(x, y)
    out = LineFit(
        ratio, low[0], high[0], slope, low[1], high[1], offset, float(r2), float(r2_ratio), held, _hysteresis(levels),
        bend,
        float(np.abs(x).max()), float(y.max()), n)  # fmt: skip
    out.why = reasons(levels, out, significant, unit)
    return out


def reasons(levels: Levels, f: LineFit, bends: bool, unit: str) -> list[str]:
    """Return the why force over effort is no line, in words with figures; [] if it is one."""
    out = []
    x, y = levels.effort, levels.force
    if len(np.unique(levels.level)) < 4:
        out.append(f"only {len(np.unique(levels.level))} levels with contact: press at more forces (6 or more)")
    if f.slope <= 0:
        out.append("force falls while effort grows: the effort's sign is wrong, or another joint carries the force")
    if levels.full.any():
        out.append(
            f"{int(levels.full.sum())} presses have a taxel at its largest count: press less hard or over a larger area"
        )
    top = np.argsort(x)[-max(3, len(x) // 4) :]
    if len(x) >= 8 and np.ptp(x[top]) > 0.05 * np.ptp(x) and np.ptp(y[top]) < 0.2 * f.slope * np.ptp(x[top]):
        out.append(
            f"over {x[top].min():.3g} {unit} more effort gives no more force: something else stops the joint, or the"
            " sensor is full"
        )
    if f.r2 < R2_LEAST:
        out.append(f"R2 {f.r2:.3f} is under {R2_LEAST}: presses scatter about the line")
    if bends and f.bend > BEND_MOST and not levels.full.any():
        out.append(
            f"the points bend by {100 * f.bend:.0f} % of their range: the lever arm or the contact changes with force"
        )
    if f.hysteresis > HYSTERESIS_MOST:
        out.append(
            f"loading and unloading differ by {100 * f.hysteresis:.0f} % of the largest force: dry friction in the"
            " gears"
        )
    zero = -f.offset / f.slope if f.slope > 0 else 0.0
    if abs(zero) > OFFSET_MOST * np.abs(x).max():
        out.append(
            f"force begins at {zero:.3g} {unit}: friction, gravity or a zero that is off; through zero the slope is"
            f" {f.ratio:.3g}"
        )
    moved = float(np.ptp(levels.position)) if len(levels) else 0.0
    if moved > 0.2:
        out.append(
            f"the joint turned by {moved:.2f} rad while pressing, so its lever arm changed: fix the object better"
        )
    return out


def _ratio_and_slope(*sums: np.ndarray, axis: int = -1) -> np.ndarray:
    """Return (ratio, slope) of levels together, stacked, from the sums of each along an axis: n, x, y, x^2, xy; NaN
    where x does not vary."""
    n, x, y, xx, xy = (s.sum(axis) for s in sums)
    spread = xx - x**2 / n
    varies = spread > 1e-9 * xx
    slope = (xy - x * y / n) / np.where(varies, spread, 1.0)
    return np.where(varies, np.stack([xy / np.maximum(xx, 1e-300), slope]), np.nan)


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Return slope and offset by least squares."""
    mx, my = x.mean(), y.mean()
    slope = ((x - mx) @ (y - my)) / ((x - mx) @ (x - mx))
    return float(slope), float(my - slope * mx)


def _bend(x: np.ndarray, y: np.ndarray) -> tuple[float, bool]:
    """Return (largest distance of the best parabola from the best line over the range of y, significant at 1 % by an F
    test)."""
    if len(x) < 5 or np.ptp(y) == 0:
        return 0.0, False
    u = (x - x.mean()) / np.ptp(x)
    a, b = np.vander(u, 2), np.vander(u, 3)
    line, parabola = (m @ np.linalg.lstsq(m, y, rcond=None)[0] for m in (a, b))
    rss1, rss2 = ((y - line) ** 2).sum(), ((y - parabola) ** 2).sum()
    rss2 = max(rss2, 1e-12 * ((y - y.mean()) ** 2).sum())
    p = stats.f.sf((rss1 - rss2) / (rss2 / (len(x) - 3)), 1, len(x) - 3)
    return float(np.abs(parabola - line).max() / np.ptp(y)), bool(p < 0.01)


def _hysteresis(levels: Levels) -> float:
    """Mean of (unloading minus loading) force at equal effort, over the largest force; NaN without both branches."""
    branches = []
    for way in (True, False):
        m = levels.up == way
        if m.sum() < 2:
            return float("nan")
        order = np.argsort(levels.effort[m])
        branches.append((levels.effort[m][order], levels.force[m][order]))
    low, high = max(b[0][0] for b in branches), min(b[0][-1] for b in branches)
    if low >= high:
        return float("nan")
    at = np.linspace(low, high, 30)
    up, down = (np.interp(at, *b) for b in branches)
    return float(np.mean(np.abs(down - up)) / max(levels.force.max(), 1e-12))
