"""Where and in which regime simulation and recording part: the residual's size in bins of every regime variable, with
block-bootstrap intervals and one false-discovery control over all bins of all joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import erfc, sqrt

import numpy as np
from scipy.stats import false_discovery_control

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
    """Return bins of one joint. residual [n] of the quantity `of` (in any unit), block [n] which stretch of time,
    regimes name -> [n]."""
    _, block = np.unique(block, return_inverse=True)
    count = int(block.max()) + 1
    if count < 6:
        return []
    square = residual**2
    total_s, total_n = np.bincount(block, square, count), np.bincount(block, minlength=count).astype(float)
    weight = intervals.weights(count, rng, DRAWS)
    all_s, all_n = weight @ total_s, weight @ total_n
    out: list[Spot] = []
    parts = [np.zeros((2, 0, count))]
    for name, x in regimes.items():
        if name.startswith("_") or np.ptp(x) < 1e-12:
            continue
        edges = _edges(name, x)
        bins, shares, sums = _binned(x, edges, block, square, count)
        parts.append(sums)
        for k, share in zip(bins, shares, strict=True):
            high = float(edges[k + 1]) if np.isfinite(edges[k + 1]) else float(np.max(x))
            out.append(Spot(joint, name, float(edges[k]), high, 0.0, 0.0, 0.0, 0.0, float(share), 1.0, of=of))
    s, n = np.concatenate(parts, 1)
    bs, bn = (np.matmul(weight, y[..., None])[..., 0] for y in (s, n))  # of each bin a product of its own
    ok = (bn > 0) & (all_n > bn)
    often = np.flatnonzero(ok.mean(1) >= 0.9)
    whole, kept = ok.all(1), np.zeros(len(out), bool)
    kept[often] = True
    inner = s.sum(1) / np.maximum(n.sum(1), 1)
    outer = (total_s.sum() - s.sum(1)) / np.maximum(total_n.sum() - n.sum(1), 1)
    # together, as far as the draws are the same: one at a time they are most of what this takes
    for rows in [np.flatnonzero(kept & whole), *np.flatnonzero(kept & ~whole)[:, None]]:
        if not len(rows):
            continue
        on = ok[rows[0]]
        (mine_s, mine_n), rest_s, rest_n = (y[rows].compress(on, 1) for y in (bs, bn)), all_s[on], all_n[on]
        ratio = np.sqrt((mine_s / mine_n) / np.maximum((rest_s - mine_s) / (rest_n - mine_n), 1e-300))
        spread = np.log(np.maximum(ratio, 1e-9)).std(1)
        for k, deviation, low, high in zip(rows, spread, *np.quantile(ratio, (0.05, 0.95), axis=1), strict=True):
            spot, size = out[k], float(np.sqrt(inner[k] / max(outer[k], 1e-300)))
            spot.ratio, spot.ratio_low, spot.ratio_high = size, float(low), float(high)
            spot.rms = float(np.sqrt(inner[k]))
            spot.p = erfc(abs(np.log(max(size, 1e-9)) / max(deviation, 1e-6)) / sqrt(2))
    return [out[k] for k in often]


def _binned(
    x: np.ndarray, edges: Sequence[float] | np.ndarray, block: np.ndarray, square: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(numbers [K] of the bins of a regime variable x [n] that are neither nearly empty nor nearly all, the share of
    the samples in each [K], and [2, K, count] by block [n] the sum of the squares [n] in each and their number).
    edges: of the bins; the last bin has its upper one too."""
    B = len(edges) - 1
    of = np.searchsorted(edges, x, side="right") - 1
    of[x == edges[-1]] = B - 1
    of[(of < 0) | (x > edges[-1])] = B  # in none of them
    share = np.bincount(of, minlength=B + 1)[:B] / len(x)
    kept = np.flatnonzero((share > 0.02) & (share < 0.98))
    at = of * count + block
    sums = [np.bincount(at, y, (B + 1) * count).reshape(B + 1, count)[kept] for y in (square, None)]
    return kept, share[kept], np.stack(sums).astype(float)


def _edges(name: str, x: np.ndarray) -> Sequence[float] | np.ndarray:
    """Return edges of the bins of a regime variable x [n]: where its meaning changes, or by equal numbers of
    samples."""
    if name == "time since reversal":
        return [0.0, 0.04, 0.12, 0.4, np.inf]
    if name in ("direction", "driven against its load"):
        return [-1.5, -0.5, 0.5, 1.5]
    if name == "saturation":
        return [0.0, 0.5, 0.9, 1.0 - 1e-6, np.inf]
    return np.unique(np.quantile(x, np.linspace(0, 1, BINS + 1)))


def control(found: list[Spot]) -> list[Spot]:
    """Return Benjamini-Hochberg over all bins: those that stand at `JUDGE.level`, the largest first, positions before
    efforts."""
    if not found:
        return []
    for s, value in zip(found, false_discovery_control([s.p for s in found]), strict=True):
        s.q = float(value)
    return sorted(
        [s for s in found if s.q <= JUDGE.level and s.ratio > JUDGE.within],
        key=lambda s: (s.of != "position", -s.rms * np.sqrt(s.share)),
    )
