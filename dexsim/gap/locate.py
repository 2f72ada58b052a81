"""Where and in which regime simulation and recording part: the residual's size in bins of every regime variable, with
block-bootstrap intervals and one false-discovery control over all bins of all joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dexsim import intervals
from dexsim.gap.rules import JUDGE

BINS = 4  # of a regime variable, of equal numbers of samples
DRAWS = 300  # of the bootstrap


@dataclass
class Spot:
    """One bin. ratio: rms of the residual inside over outside, with its 90 % interval; p: of no difference; q: the
    false-discovery rate at which it stands; rms inside; share of the samples."""

    joint: str
    regime: str
    low: float
    high: float
    ratio: float
    ratio_low: float
    ratio_high: float
    rms: float
    share: float
    p: float
    q: float = 1.0
    of: str = "position"  # or "effort": whose residual

    @property
    def text(self) -> str:
        return self.where if self.of == "position" else f"{self.of}, {self.where}"

    @property
    def where(self) -> str:
        """The bin in words."""
        if self.regime == "time since reversal":
            return (
                f"within {1e3 * self.high:.0f} ms after a reversal"
                if self.low == 0
                else f"from {1e3 * self.low:.0f} ms after a reversal on"
            )
        if self.regime == "direction":
            return "moving positive" if self.high > 0.5 else "moving negative" if self.low < -0.5 else "at rest"
        if self.regime == "driven against its load":  # the sign of speed times torque
            return (
                "while the motor drives"
                if self.high > 1.0
                else "while the motor brakes"
                if self.low < -1.0
                else "at rest or without torque"
            )
        return f"{self.regime} {self.low:.3g} to {self.high:.3g}"


def spots(
    joint: str,
    residual: np.ndarray,
    block: np.ndarray,
    regimes: dict[str, np.ndarray],
    rng: np.random.Generator,
    of: str = "position",
) -> list[Spot]:
    """Bins of one joint. residual [n] of the quantity `of` (in any unit), block [n] which stretch of time, regimes name
    -> [n]."""
    out: list[Spot] = []
    drawn: list[np.ndarray] = []
    _, block = np.unique(block, return_inverse=True)
    count = int(block.max()) + 1
    if count < 6:
        return out
    square = residual**2
    total_s, total_n = np.bincount(block, square, count), np.bincount(block, minlength=count).astype(float)
    weight = intervals.weights(count, rng, DRAWS)
    all_s, all_n = weight @ total_s, weight @ total_n
    for name, x in regimes.items():
        if name.startswith("_") or np.ptp(x) < 1e-12:
            continue
        edges = _edges(name, x)
        for low, high in zip(edges[:-1], edges[1:], strict=True):
            inside = (x >= low) & ((x < high) if high != edges[-1] else (x <= high))
            if not 0.02 < inside.mean() < 0.98:
                continue
            s, n = (
                np.bincount(block[inside], square[inside], count),
                np.bincount(block[inside], minlength=count).astype(float),
            )
            bs, bn = weight @ s, weight @ n
            ok = (bn > 0) & (all_n > bn)
            if ok.mean() < 0.9:
                continue
            ratio = np.sqrt((bs[ok] / bn[ok]) / np.maximum((all_s[ok] - bs[ok]) / (all_n[ok] - bn[ok]), 1e-300))
            inner, outer = s.sum() / n.sum(), (total_s.sum() - s.sum()) / (total_n.sum() - n.sum())
            log = np.log(np.maximum(ratio, 1e-9))
            z = np.log(max(np.sqrt(inner / max(outer, 1e-300)), 1e-9)) / max(log.std(), 1e-6)
            p = 2 * _tail(abs(z))
            top = float(np.max(x)) if not np.isfinite(high) else float(high)
            rms, size = float(np.sqrt(inner)), float(np.sqrt(inner / max(outer, 1e-300)))
            out.append(Spot(joint, name, float(low), top, size, 0.0, 0.0, rms, float(inside.mean()), p, of=of))
            drawn.append(ratio)
    for count in {len(r) for r in drawn}:  # together: one at a time they are most of what this takes
        mine = [k for k, r in enumerate(drawn) if len(r) == count]
        bounds = np.quantile(np.stack([drawn[k] for k in mine]), (0.05, 0.95), axis=1)
        for k, low, high in zip(mine, *bounds, strict=True):
            out[k].ratio_low, out[k].ratio_high = float(low), float(high)
    return out


def _edges(name: str, x: np.ndarray) -> Sequence[float] | np.ndarray:
    """Edges of the bins of a regime variable x [n]: where its meaning changes, or by equal numbers of samples."""
    if name == "time since reversal":
        return [0.0, 0.04, 0.12, 0.4, np.inf]
    if name in ("direction", "driven against its load"):
        return [-1.5, -0.5, 0.5, 1.5]
    if name == "saturation":
        return [0.0, 0.5, 0.9, 1.0 - 1e-6, np.inf]
    return np.unique(np.quantile(x, np.linspace(0, 1, BINS + 1)))


def control(found: list[Spot]) -> list[Spot]:
    """Benjamini-Hochberg over all bins: those that stand at `JUDGE.level`, the largest first, positions before
    efforts."""
    if not found:
        return []
    order = np.argsort([s.p for s in found])
    m = len(found)
    q, last = np.empty(m), 1.0
    for k in range(m - 1, -1, -1):
        last = min(last, found[order[k]].p * m / (k + 1))
        q[order[k]] = last
    for s, value in zip(found, q, strict=True):
        s.q = float(value)
    return sorted(
        [s for s in found if s.q <= JUDGE.level and s.ratio > JUDGE.within],
        key=lambda s: (s.of != "position", -s.rms * np.sqrt(s.share)),
    )


def _tail(z: float) -> float:
    from math import erfc, sqrt

    return 0.5 * erfc(z / sqrt(2))
