"""The state of a fingertip's taxels from recordings in which it is pressed all over: threshold, dead and swapped ones, gains.

Readings of one pad are [T, 120]; taxel k = column * 12 + row, neighbours are those beside it in column or row.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dexsim.assets import xhand

COLUMNS, ROWS = xhand.COLUMNS, xhand.ROWS
AT_ONCE = 6  # taxels that answer together where something presses; noise wakes fewer


def neighbours(columns: int = COLUMNS, rows: int = ROWS) -> list[list[int]]:
    """Taxels beside each taxel of the lattice."""
    out = []
    for k in range(columns * rows):
        c, r = divmod(k, rows)
        out.append([a * rows + b for a, b in ((c - 1, r), (c + 1, r), (c, r - 1), (c, r + 1)) if 0 <= a < columns and 0 <= b < rows])
    return out


@dataclass
class Pad:
    """What was found of one pad. threshold: a reading at or under it may be noise (readings' unit); bias [120]; dead, swapped;
    unseen: taxels that nothing pressed, of which nothing is known; gain [120] or None without a load; held_out: error of the
    load by these gains on presses that were not fitted, over the mean load (and with equal gains); hysteresis: of force
    against load. notes: in words."""

    threshold: float
    bias: np.ndarray
    dead: list[int] = field(default_factory=list)
    swapped: list[tuple[int, int]] = field(default_factory=list)
    unseen: list[int] = field(default_factory=list)
    gain: np.ndarray | None = None
    scale: float | None = None
    held_out: float = float("nan")
    held_out_equal: float = float("nan")
    hysteresis: float = float("nan")
    notes: list[str] = field(default_factory=list)


def inspect(readings: np.ndarray, load: np.ndarray | None = None) -> Pad:
    """One pad's readings [T, 120] and, where known, the normal load on it [T] N."""
    r = np.asarray(readings, float)
    total = r.sum(1)
    rest = load < 0.02 * load.max() if load is not None and load.max() > 0 else total <= np.percentile(total, 10) + 1e-9
    bias = r[rest].mean(0) if rest.sum() >= 3 else np.zeros(r.shape[1])
    noise = r[rest] - bias if rest.sum() >= 3 else np.zeros((1, r.shape[1]))
    threshold = float(np.percentile(np.abs(noise), 99.9))
    clean = r - bias
    touched = ~rest
    if load is None:
        touched = (clean > max(threshold, 1e-9)).sum(1) >= AT_ONCE
        if touched.sum() < 5:  # never pressed: every frame tells of the noise, not the quietest alone
            threshold = float(np.percentile(np.abs(clean), 99.9))
    out = Pad(threshold, bias)
    if touched.sum() < 5:
        out.notes.append("nothing pressed it: only its threshold is known")
        out.unseen = list(range(r.shape[1]))
        return out
    near = neighbours()
    silent = set(np.flatnonzero(clean.max(0) <= 2 * threshold).tolist())
    out.swapped = _swapped(clean, near, silent)
    order = np.arange(r.shape[1])
    for a, b in out.swapped:
        order[[a, b]] = order[[b, a]]
    clean = clean[:, order]
    out.dead, out.unseen = _dead(clean, threshold, near)
    if load is not None:
        _gains(out, clean, np.asarray(load, float))
    return out


def _dead(clean: np.ndarray, threshold: float, near: list[list[int]]) -> tuple[list[int], list[int]]:
    """(dead, unseen): taxels that stay under a tenth of their neighbours' mean whenever that is well over the threshold,
    and taxels whose neighbourhood was never pressed that hard."""
    strong = max(4 * threshold, 0.1 * np.percentile(clean.max(0), 90))
    dead: list[int] = []
    unseen: list[int] = []
    for _ in range(2):  # twice, so that a dead neighbour does not lower the mean
        gone, dead, unseen = set(dead), [], []
        for k in range(clean.shape[1]):
            beside = [n for n in near[k] if n not in gone] or near[k]
            around = clean[:, beside].mean(1)
            pressed = around > strong
            if pressed.sum() < 5:
                if clean[:, k].max() <= 2 * threshold:
                    unseen.append(k)
            elif clean[pressed, k].mean() < 0.1 * around[pressed].mean():
                dead.append(k)
    return dead, unseen


def _swapped(clean: np.ndarray, near: list[list[int]], skip: set[int], least: float = 0.15) -> list[tuple[int, int]]:
    """Pairs that each fit the other's neighbours clearly better than their own: wires exchanged."""
    live = [k for k in range(clean.shape[1]) if k not in skip]
    std = clean.std(0)
    z = (clean - clean.mean(0)) / np.where(std > 0, std, 1.0)
    around = np.zeros_like(clean)
    for k in live:
        beside = [n for n in near[k] if n not in skip]
        if beside:
            around[:, k] = clean[:, beside].mean(1)
    s = around.std(0)
    around = (around - around.mean(0)) / np.where(s > 0, s, 1.0)
    fit = z.T @ around / len(z)  # [taxel, place]
    own = np.diag(fit)
    out, used = [], set()
    gains = [(min(fit[a, b] - own[a], fit[b, a] - own[b]), a, b) for i, a in enumerate(live) for b in live[i + 1:]]
    for gain, a, b in sorted(gains, reverse=True):
        if gain < least:
            break
        if a not in used and b not in used:
            out.append((int(a), int(b)))
            used |= {a, b}
    return out


def _gains(out: Pad, clean: np.ndarray, load: np.ndarray) -> None:
    """One common scale from the load; each taxel's gain from its neighbours, kept only if it tells the load of presses that
    were not fitted better than equal gains do."""
    live = np.array([k for k in range(clean.shape[1]) if k not in out.dead and k not in out.unseen])
    pressed = load > 0.05 * load.max()
    x, y = clean[pressed], load[pressed]
    test = np.isin(np.arange(len(y)) * 10 // max(1, len(y)), (2, 5, 8))
    floor = max(3 * out.threshold, 1e-9)

    def scale(gain: np.ndarray, rows: np.ndarray) -> float:
        total = x[rows][:, live] @ gain[live]
        return float(total @ y[rows] / (total @ total))

    def error(gain: np.ndarray) -> float:
        rest = scale(gain, ~test) * (x[test][:, live] @ gain[live]) - y[test]
        return float(np.sqrt(np.mean(rest**2)) / y[test].mean())

    def both(rows: np.ndarray) -> np.ndarray:
        """Neighbours tell what differs from taxel to taxel, the load what changes over the whole pad: a surface of degree 3."""
        local = smooth_gains(x[rows], set(live.tolist()), floor)
        basis = _surface()[live]
        seen = (x[rows][:, live] * local[live]) @ basis
        c = np.linalg.lstsq(seen, y[rows], rcond=1e-4)[0]
        broad = np.ones(len(local))
        broad[live] = basis @ c
        return local * np.maximum(broad, 0.0)

    equal, gain = np.ones(clean.shape[1]), both(~test)
    out.held_out_equal, out.held_out = error(equal), error(gain)
    if out.held_out < out.held_out_equal:
        gain = both(np.ones(len(y), bool))
    else:
        out.notes.append(f"gains by taxel would not tell the load better ({100 * out.held_out:.1f} % on held-out presses): equal ones are kept")
        gain, out.held_out = equal, out.held_out_equal
    gain = gain / gain[live].mean()
    out.scale = scale(gain, np.ones(len(y), bool))
    out.gain = gain.copy()
    out.gain[out.dead] = 0.0
    out.hysteresis = _loop(clean[:, live] @ gain[live], load)


def _surface(degree: int = 3) -> np.ndarray:
    """Polynomials over the lattice [120, B], products of Legendre's in column and row up to a total degree."""
    c, r = np.divmod(np.arange(COLUMNS * ROWS), ROWS)
    leg = np.polynomial.legendre.legvander
    a, b = leg(2 * c / (COLUMNS - 1) - 1, degree), leg(2 * r / (ROWS - 1) - 1, degree)
    return np.stack([a[:, i] * b[:, j] for i in range(degree + 1) for j in range(degree + 1 - i)], 1)


def smooth_gains(readings: np.ndarray, live: set[int], floor: float, prior: float = 0.2, columns: int = COLUMNS, rows: int = ROWS) -> np.ndarray:
    """Gains [120] (times a reading: its force) from readings [T, 120] of presses all over, because pressure is smooth.

    The logarithm of a round press falls off as a parabola, so a taxel's logarithm lies above the mean of the two taxels beside
    it, in column or row, by the same on average wherever it is; what a taxel differs by beyond that is its gain and
    theirs: log r_k - (log r_a + log r_b) / 2 = c - log g_k + (log g_a + log g_b) / 2. Solved by least squares over all
    triples with readings over `floor`, with gains believed to lie within `prior` (standard deviation of the logarithm).
    The load is not used: it sees sums over neighbours only, which cannot tell them apart.
    """
    n = columns * rows
    lines, values, weights, kinds = [], [], [], []
    with np.errstate(divide="ignore"):
        log = np.log(np.maximum(readings, 1e-12))
    for k in sorted(live):
        c, r = divmod(k, rows)
        for kind, (da, db) in enumerate((((-1, 0), (1, 0)), ((0, -1), (0, 1)))):
            a, b = (((c + d[0]) * rows + r + d[1]) if 0 <= c + d[0] < columns and 0 <= r + d[1] < rows else -1 for d in (da, db))
            if a not in live or b not in live:
                continue
            good = (readings[:, [a, k, b]] > floor).all(1)
            if good.sum() < 8:
                continue
            d = log[good, k] - 0.5 * (log[good, a] + log[good, b])
            row = np.zeros(n + 2)
            row[k], row[a], row[b], row[n + kind] = -1.0, 0.5, 0.5, 1.0
            lines.append(row)
            values.append(d.mean())
            # frames of one press are alike: they count as fewer
            weights.append(1.0 / np.sqrt(d.var() / max(1.0, good.sum() / 10) + 1e-4))
            kinds.append(kind)
    if not lines:
        return np.ones(n)
    w = np.array(weights)[:, None]
    m = np.concatenate([np.array(lines) * w, np.eye(n, n + 2) / prior])
    u = np.linalg.lstsq(m, np.concatenate([np.array(values) * w[:, 0], np.zeros(n)]), rcond=None)[0]
    return np.exp(u[:n])


def _loop(force: np.ndarray, load: np.ndarray) -> float:
    """Mean gap between falling and rising load at equal load, over the largest force."""
    change = np.gradient(load)
    top = load.max()
    at = np.linspace(0.15, 0.85, 15) * top
    means = []
    for way in (change > 1e-3 * top, change < -1e-3 * top):
        if way.sum() < 20:
            return float("nan")
        means.append([force[way & (np.abs(load - a) < 0.05 * top)].mean() if (way & (np.abs(load - a) < 0.05 * top)).any() else np.nan for a in at])
    gap = np.abs(np.subtract(*means))
    return float(np.nanmean(gap) / force.max()) if np.isfinite(gap).any() else float("nan")
