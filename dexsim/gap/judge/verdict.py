"""The one word of a diagnosis, and which names count for it: by the error on what was kept out, never by a name alone.

One place decides: the sentence, the page and `diagnosis.json` all follow what stands in the findings after `settle`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dexsim import intervals
from dexsim.gap.read.runs import BLOCK
from dexsim.gap.rules import JUDGE

DRAWS, STRETCH = 400, 4  # bootstraps, of stretches of so many neighbouring blocks


def settle(findings: Sequence[dict[str, Any]], quiet: set[str]) -> None:
    """Marks the findings of joints that are hints: names below `JUDGE.firm`, and those on joints that are followed to
    their floor without any effect (`quiet`), whose confidence goes below it."""
    for f in findings:
        joints = f["where"]["joints"]
        if joints and set(joints) <= quiet and f["held_out"]:
            f["confidence"] = min(f["confidence"], JUDGE.hinted)
        if f["held_out"] and f["confidence"] < JUDGE.firm:
            f["hint"] = True


def firm(findings: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The findings of physics that are more than hints."""
    return [f for f in findings if f["held_out"] and not f.get("hint")]


def wrong_signals(findings: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The findings that a signal is not what it says, where they are more than hints."""
    return [f for f in findings if f["effect"] == "bad_channel" and f["confidence"] >= JUDGE.firm]


def verdict(
    findings: Sequence[dict[str, Any]],
    floor: float,
    before: float,
    before_low: float,
    after: float,
    structured: bool,
    quiet: bool = False,
) -> str:
    """The one word. findings: after `settle`; floor, before, after: of the error on what was kept out; before_low: of
    its 90 % interval; structured: whether what is left without any effect has structure; quiet: whether every joint is
    followed to its own floor. Where the rest is followed to the floor a wrong signal is the answer: something was
    amiss, and it has a name."""
    named = firm(findings)
    if not named:
        if (
            quiet
            or before <= JUDGE.within * floor
            or (before <= JUDGE.far * floor and (before_low <= JUDGE.within * floor or not structured))
        ):
            return "explained" if wrong_signals(findings) else "none"
        return "unknown"
    # where every name is doubtful and none stands for a set, an error that is gone is not yet explained
    if after <= JUDGE.within * floor:
        sure = any(f.get("confidence", 1.0) >= JUDGE.sure_of_one or f.get("indistinguishable") for f in named)
        return "explained" if sure else "partly_explained"
    return "partly_explained" if (before - after) / max(before - floor, 1e-12) >= JUDGE.removed else "unknown"


def gain_interval(
    without: np.ndarray, with_it: np.ndarray, times: np.ndarray, seed: int = 0, block: float = BLOCK
) -> tuple[float, float]:
    """90 % interval of the share of the squared error `without` [n] that an effect removes (`with_it` [n]), both at
    times [n] s on what was kept out: a bootstrap over half-second blocks in stretches of two seconds, paired, of the
    whole error: draws without the few moments in which a limit acts show nothing, not a loss. (0, 0) without
    samples."""
    if not len(without):
        return 0.0, 0.0
    b = ((times - times.min()) / block).astype(int)
    _, b = np.unique(b, return_inverse=True)
    a, c = np.bincount(b, without), np.bincount(b, with_it)
    index = intervals.stretches(len(a), STRETCH, seed, DRAWS)
    share = (a - c)[index].sum(1) / max(float(a.sum()), 1e-300)
    return float(np.quantile(share, 0.05)), float(np.quantile(share, 0.95))
