"""The state of a fingertip's taxels from recordings in which it is pressed all over: threshold, dead and swapped ones,
gains.

Readings of one pad are [T, K]; taxel k = column * rows + row, neighbours are those beside it in column or row.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from dexsim import intervals
from dexsim.tactile.layout import neighbours

AT_ONCE = 6  # taxels that answer together where something presses; noise wakes fewer


@dataclass
class Pad:
    """Results for one pad. threshold: a reading at or under it may be noise (readings' unit); bias [K]; rows: of
    the lattice; dead, swapped; unseen: taxels that nothing pressed, of which nothing is known; gain [K] or None without
    a load; held_out: error of the load by these gains on presses that were not fitted, over the mean load (and with
    equal gains); hysteresis: of force against load. notes: in words."""

    threshold: float
    bias: np.ndarray
    rows: int
    dead: list[int] = field(default_factory=list)
    swapped: list[tuple[int, int]] = field(default_factory=list)
    unseen: list[int] = field(default_factory=list)
    gain: np.ndarray | None = None
    scale: float | None = None
    held_out: float = float("nan")
    held_out_equal: float = float("nan")
    hysteresis: float = float("nan")
    notes: list[str] = field(default_factory=list)


def inspect(readings: np.ndarray, load: np.ndarray | None = None, *, rows: int) -> Pad:
    """Return one pad's readings [T, K] and, where known, the normal load on it [T] N; rows of its lattice."""
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
    out = Pad(threshold, bias, rows)
    if touched.sum() < 5:
        out.notes.append("nothing pressed it: only its threshold is known")
        out.unseen = list(range(r.shape[1]))
        return out
    near = neighbours(r.shape[1] // rows, rows)
    silent = set(np.flatnonzero(clean.max(0) <= 2 * threshold).tolist())
    out.swapped = _swapped(clean, near, silent)
    order = np.arange(r.shape[1])
    for a, b in out.swapped:
        order[[a, b]] = order[[b, a]]
    clean = clean[:, order]
    out.dead, out.unseen = _dead(clean, threshold, near, rows)
    if load is not None:
        _gains(out, clean, np.asarray(load, float))
    return out


def _dead(
    clean: np.ndarray, threshold: float, near: list[list[int]], rows: int
) -> tuple[list[int], list[int]]:
    """Return (dead, unseen): taxels that stay silent where they must feel something, and silent ones of which the
    presses do not tell.

    One pressed side is not enough: a contact has an edge, and beyond it a healthy taxel feels nothing. A taxel must
    feel something between two pressed ones, on opposite sides of it; and in most of the presses whose strongest taxel
    lies beside it, as the pad's other taxels do: it is dead where such silence had a chance under 1e-4.
    """
    strong = max(4 * threshold, 0.1 * np.percentile(clean.max(0), 90))
    silent = clean.max(0) <= 2 * threshold
    surprise = _surprise(clean, strong, 2 * threshold, silent, near)
    dead: list[int] = []
    unseen: list[int] = []
    for _ in range(2):  # twice, so that dead neighbours are looked past
        gone, dead, unseen = set(dead), [], []
        for k in range(clean.shape[1]):
            between = np.zeros(len(clean))  # the weaker of two opposite sides, in the best of the four directions
            for step in ((1, 0), (0, 1), (1, 1), (1, -1)):
                a, b = (_beside(k, step, way, gone, clean.shape[1] // rows, rows) for way in (1, -1))
                if a is not None and b is not None:
                    between = np.maximum(between, clean[:, [a, b]].min(1))
            pressed = between > strong
            if (
                pressed.sum() >= 5
                and clean[pressed, k].mean() < 0.1 * between[pressed].mean()
                or silent[k]
                and surprise[k] < 1e-4
            ):
                dead.append(k)
            elif silent[k]:
                unseen.append(k)
    return dead, unseen


def _surprise(clean: np.ndarray, strong: float, floor: float, silent: np.ndarray, near: list[list[int]]) -> np.ndarray:
    """Return [K]: the chance that a healthy taxel is silent in every press whose strongest taxel lies beside it. A
    press is what lies between two rests, at most 200 frames."""
    on = clean.max(1) > strong
    press = np.cumsum(np.diff(on, prepend=False) & on) * 1000 + np.arange(len(on)) // 200
    top = clean.argmax(1)
    visits: dict[tuple[int, int], np.ndarray] = {}  # (press, its strongest taxel) -> largest reading of each taxel then
    for key in np.unique(np.stack([press[on], top[on]], 1), axis=0):
        rows = on & (press == key[0]) & (top == key[1])
        visits[int(key[0]), int(key[1])] = clean[rows].max(0)
    heard, expected = np.zeros(2), np.zeros(2)  # beside it in column, in row: pitches differ
    trials = np.zeros((clean.shape[1], 2))
    for (_, at), reading in visits.items():
        for k in near[at]:
            way = int(abs(k - at) == 1)
            trials[k, way] += 1
            if not silent[k]:
                expected[way] += 1
                heard[way] += reading[k] > floor
    rate = np.clip(heard / np.maximum(expected, 1), 0.0, 0.99)
    return np.prod((1 - rate) ** trials, axis=1)


def _beside(
    k: int, step: tuple[int, int], way: int, gone: set[int], columns: int, rows: int, far: int = 3
) -> int | None:
    """Return the nearest taxel that is not `gone`, at most `far` steps from k; None at the pad's edge."""
    c, r = divmod(k, rows)
    for n in range(1, far + 1):
        a, b = c + way * n * step[0], r + way * n * step[1]
        if not (0 <= a < columns and 0 <= b < rows):
            return None
        if a * rows + b not in gone:
            return a * rows + b
    return None


def _swapped(
    clean: np.ndarray, near: list[list[int]], skip: set[int], least: float = 0.15, sure: float = 2.5,
    beside: float = 5.0,
) -> list[tuple[int, int]]:  # fmt: skip
    """Return the pairs that each fit the other's neighbours better than their own by `least` (correlation), and by
    `sure` standard
    deviations of that figure over blocks of the recording: wires exchanged. Where few presses met a place, it varies
    much. Taxels side by side feel nearly the same, and a contact's edge between them looks like an exchange: `beside`
    deviations."""
    fit, own_std = _fits(clean, near, skip)
    live = [k for k in range(clean.shape[1]) if k not in skip]
    own = np.diag(fit)
    better = np.minimum(fit - own[:, None], (fit - own[:, None]).T)  # [a, b]: the less convinced of the two
    gains = [(better[a, b], a, b) for i, a in enumerate(live) for b in live[i + 1:]
             if better[a, b] >= max(least, (beside if b in near[a] else sure) * own_std[a, b])]  # fmt: skip
    out, used = [], set()
    for _, a, b in sorted(gains, reverse=True):
        if a not in used and b not in used:
            out.append((int(a), int(b)))
            used |= {a, b}
    return out


def _fits(
    clean: np.ndarray, near: list[list[int]], skip: set[int], blocks: int = 20, draws: int = 40
) -> tuple[np.ndarray, np.ndarray]:
    """Return (correlation [taxel, place] of each taxel with the mean of the neighbours of each place; standard
    deviation [a, b] of what a swap of a and b would better, by bootstrap over blocks of the recording)."""
    around = np.zeros_like(clean)
    for k in range(clean.shape[1]):
        beside = [n for n in near[k] if n not in skip]
        if beside and k not in skip:
            around[:, k] = clean[:, beside].mean(1)
    parts = [p for p in zip(np.array_split(clean, blocks), np.array_split(around, blocks), strict=True) if len(p[0])]
    # sums from which any choice of blocks gives its correlations
    sums = [(len(x), x.sum(0), y.sum(0), (x**2).sum(0), (y**2).sum(0), x.T @ y) for x, y in parts]

    def correlation(weight: np.ndarray) -> np.ndarray:
        n, sx, sy, xx, yy, xy = (sum(w * s[i] for w, s in zip(weight, sums, strict=True)) for i in range(6))
        spread = np.sqrt(np.outer(np.maximum(xx - sx**2 / n, 0), np.maximum(yy - sy**2 / n, 0)))
        return np.where(spread > 1e-12, (xy - np.outer(sx, sy) / n) / np.maximum(spread, 1e-12), 0.0)

    tried = []
    for weight in intervals.weights(len(sums), 0, draws):
        c = correlation(weight)
        d = c - np.diag(c)[:, None]
        tried.append(np.minimum(d, d.T))
    return correlation(np.ones(len(sums))), np.std(tried, axis=0)


def _gains(out: Pad, clean: np.ndarray, load: np.ndarray) -> None:
    """Fit one common scale from the load; each taxel's gain from its neighbours, or else from the load alone with gains
    believed to lie near one: only if it tells the load of presses that were not fitted (five folds of the recording)
    better than equal gains do."""
    live = np.array([k for k in range(clean.shape[1]) if k not in out.dead and k not in out.unseen])
    columns = clean.shape[1] // out.rows
    pressed = load > 0.05 * load.max()
    x, y = clean[pressed], load[pressed]
    fold = np.arange(len(y)) * 20 // max(1, len(y)) % 5
    floor = max(3 * out.threshold, 1e-9)

    def scale(gain: np.ndarray, rows: np.ndarray) -> float:
        total = x[rows][:, live] @ gain[live]
        return float(total @ y[rows] / (total @ total))

    def error(way: Callable[[np.ndarray], np.ndarray]) -> float:
        """Return the error of the load on presses that were not fitted, over the mean load."""
        rest = []
        for k in range(5):
            gain = way(fold != k)
            rest.append(scale(gain, fold != k) * (x[fold == k][:, live] @ gain[live]) - y[fold == k])
        return float(np.sqrt(np.mean(np.concatenate(rest) ** 2)) / y.mean())

    def neighbours_and_load(rows: np.ndarray) -> np.ndarray:
        """Return the neighbours tell what differs from taxel to taxel, the load what changes over the whole pad: a
        surface of degree 3."""
        local = smooth_gains(x[rows], set(live.tolist()), floor, columns, out.rows)
        basis = _surface(columns, out.rows)[live]
        seen = (x[rows][:, live] * local[live]) @ basis
        c = np.linalg.lstsq(seen, y[rows], rcond=1e-4)[0]
        broad = np.ones(len(local))
        broad[live] = basis @ c
        return local * np.maximum(broad, 0.0)

    def from_load(rows: np.ndarray, prior: float) -> np.ndarray:
        """Solve y = s x (1 + d), d believed to be N(0, prior^2)."""
        gain = np.ones(clean.shape[1])
        a = scale(gain, rows) * x[rows][:, live]
        rest = y[rows] - a.sum(1)
        noise = max(float(rest @ rest) / len(rest), 1e-12)
        d = np.linalg.solve(a.T @ a + noise / prior**2 * np.eye(len(live)), a.T @ rest)
        gain[live] = np.maximum(1 + d, 0.0)
        return gain

    ways = {"equal": lambda rows: np.ones(clean.shape[1]), "neighbours": neighbours_and_load} | {
        f"load {p:g}": (lambda rows, p=p: from_load(rows, p)) for p in (0.05, 0.1, 0.2, 0.4)
    }
    tried = {name: error(way) for name, way in ways.items()}
    best = min(tried, key=tried.__getitem__)
    if tried["neighbours"] < tried["equal"]:
        best = "neighbours"  # wide contacts: sums over many taxels hardly tell one from the next
    out.held_out_equal, out.held_out = tried["equal"], tried[best]
    if best == "equal":
        others = min(v for k, v in tried.items() if k != "equal")
        out.notes.append(
            f"gains by taxel would not tell the load better ({100 * others:.1f} % on held-out presses): equal ones are"
            " kept"
        )
    gain = ways[best](np.ones(len(y), bool))
    gain = gain / gain[live].mean()
    out.scale = scale(gain, np.ones(len(y), bool))
    out.gain = gain.copy()
    out.gain[out.dead] = 0.0
    out.hysteresis = _loop(clean[:, live] @ gain[live], load)


def _surface(columns: int, rows: int, degree: int = 3) -> np.ndarray:
    """Return the polynomials over the lattice [K, B], products of Legendre's in column and row up to a total degree."""
    c, r = np.divmod(np.arange(columns * rows), rows)
    leg = np.polynomial.legendre.legvander
    a, b = leg(2 * c / max(columns - 1, 1) - 1, degree), leg(2 * r / max(rows - 1, 1) - 1, degree)
    return np.stack([a[:, i] * b[:, j] for i in range(degree + 1) for j in range(degree + 1 - i)], 1)


def smooth_gains(
    readings: np.ndarray, live: set[int], floor: float, columns: int, rows: int, prior: float = 0.2
) -> np.ndarray:
    """Return the gains [K] (times a reading: its force) from readings [T, K] of presses all over, because pressure is
    smooth.

    The logarithm of a round press falls off as a parabola, so a taxel's logarithm lies above the mean of the two taxels
    beside it, in column or row, by the same on average wherever it is; what a taxel differs by beyond that is its gain
    and
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
            a, b = (
                ((c + d[0]) * rows + r + d[1]) if 0 <= c + d[0] < columns and 0 <= r + d[1] < rows else -1
                for d in (da, db)
            )
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
        means.append(
            [
                force[way & (np.abs(load - a) < 0.05 * top)].mean()
                if (way & (np.abs(load - a) < 0.05 * top)).any()
                else np.nan
                for a in at
            ]
        )
    gap = np.abs(np.subtract(means[0], means[1]))
    return float(np.nanmean(gap) / force.max()) if np.isfinite(gap).any() else float("nan")
