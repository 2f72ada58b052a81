"""How sure a name is: the share of the bootstraps that it wins, and every reason to doubt it.

A confidence is used as a probability, so whatever else could have made the same trace has to lower it: an effect whose
interval holds "nothing missing", a size that stopped at a physical bound, a second effect that explains little of what
the first one left, three effects where a machine has one, a temperature that follows the clock. Each reason is a line
that the page shows.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import asdict, dataclass, field

import numpy as np

from dexsim.gap.effects.catalogue import EFFECTS, TOUCH_EFFECTS
from dexsim.gap.finding import Finding
from dexsim.gap.plant.case import Case
from dexsim.gap.plant.columns import SHAPES, neutral_of
from dexsim.gap.rules import BELIEF, JUDGE

EXACT = ("position_scale", "readout_scale")  # columns that no belief is off in


@dataclass
class Evidence:
    """What speaks for and against one finding. share: of the bootstraps; earned: 1 where dropping it costs a tenth of
    the error held out; left, left_of_rest: squared error held out that stays, over that before anything was named, and
    over that without this effect alone; score: log of the odds [nats] by which conditions left out speak for it; odds:
    that it is not the best of all that was tried by accident; reasons: why it is doubted."""

    effect: str
    joint: str
    share: float
    earned: float
    left: float
    left_of_rest: float
    score: float
    members: int
    reasons: list[str] = field(default_factory=list)
    odds: float = 1.0
    confidence: float = 0.0

    def hint(self, reason: str) -> None:
        """Makes it a hint."""
        self.reasons.append(reason)
        self.confidence = min(self.confidence, JUDGE.hinted)

    def doubt(self, reason: str) -> None:
        """Makes it doubted."""
        self.reasons.append(reason)
        self.confidence = min(self.confidence, JUDGE.doubted)

    def plain(self) -> dict:
        """As it is written."""
        return asdict(self)


def holds_nothing(params: Sequence, spread: dict[str, tuple[float, float]], case: Case) -> bool:
    """Return whether the 90 % intervals of all of an effect's sizes hold the value at which nothing is missing, as far
    as it is believed."""
    sizes = [p for p in params if p.key not in SHAPES]
    for p in sizes:
        low, high = spread[p.key]
        zero = neutral_of(p, case)
        # a figure of the drive is believed to a few percent; an encoder's scale is what it is
        believed = p.mode in ("factor", "set") and p.columns[0] not in EXACT
        give = BELIEF.tolerance * abs(zero) if believed and abs(zero) < 1e8 else 0.0
        # where an effect begins at a bound, the bound is nothing
        begins = p.mode == "set" and (
            (zero <= p.low and low <= p.low * (1 + 1e-6) + 1e-12) or (zero >= p.high and high >= p.high * (1 - 1e-6))
        )
        if not begins and not low - give <= zero <= high + give:
            return False
    return bool(sizes)


def beyond(params: Sequence, spread: dict[str, tuple[float, float]], case: Case) -> str:
    """Return key of a size whose 90 % interval reaches, away from nothing, to the end of what is looked for: how large
    it is is not known; empty where none does."""
    for p in params:
        if p.key in SHAPES:
            continue
        zero, room = neutral_of(p, case), 1e-3 * p.span
        low, high = spread[p.key]
        if low <= p.low + room < zero or high >= p.high - room > zero:
            return p.key
    return ""


def not_repeated(params: Sequence, folds: np.ndarray, case: Case) -> str:
    """Say why an effect is not the same in every split of the recordings: of fits without one condition each, `folds`
    [F, P], one has a first size of the other sign, or far smaller than another; empty where they agree."""
    for k, p in enumerate(params):
        if p.key in SHAPES or len(folds) < 2:
            continue
        away = folds[:, k] - neutral_of(p, case)
        if away.min() * away.max() < 0 or np.abs(away).min() < JUDGE.repeated * np.abs(away).max():
            return (
                f"fits without one condition each do not agree on its {p.key.replace('_', ' ')}: "
                f"{folds[:, k].min():.3g} to {folds[:, k].max():.3g}"
            )
        break
    return ""


def earned(before: float, after: float) -> float:
    """Return 0 to 1: what an effect has earned by the error held out, without and with it: 1 where that falls by
    `JUDGE.earns` or more."""
    return float(np.clip((before - after) / (JUDGE.earns * before + 1e-12), 0.0, 1.0))


def left_over(after: float, before: float, noise: float) -> float:
    """Share of a squared error `before` that stays, above `JUDGE.within` x the noise."""
    base = (JUDGE.within * noise) ** 2
    return max(after**2 - base, 0.0) / max(before**2 - base, after**2, 1e-30)


def kept_of(left: float) -> float:
    """Share of its confidence that a name keeps when the share `left` of the squared error stays unexplained: it loses
    `JUDGE.left_costs` where that is `JUDGE.removed` or more, evenly less below. What follows only half of a gap may be
    another effect that looks like it."""
    return 1.0 - JUDGE.left_costs * min(left / JUDGE.removed, 1.0)


def too_small(before: float, without: float, after: float, noise: float, alone: bool) -> str:
    """Return why an effect is too small to be sure of: it leaves the error held out (rms, without and with it) where
    nothing is asked for, or is small beside what others removed of the error before; empty where it is not."""
    if without <= JUDGE.within * noise:
        return "without it the error held out is hardly above the noise"
    if not alone and without**2 - after**2 < JUDGE.least_share * max(before, without) ** 2:
        return "it is small beside what another effect explains, whose law need not be exact"
    return ""


def unresolved(without: float, after: float, quantum: float) -> str:
    """Return why an effect is below what the encoder resolves: what it does to the motion held out, rms, is less than
    half a count (`quantum`, rad or m), so that a reading seldom changes for it; empty where it is not. without, after:
    rms error without and with the effect."""
    moved = float(np.sqrt(max(without**2 - after**2, 0.0)))
    return (
        ""
        if moved >= JUDGE.resolved * quantum
        else f"what it does to the motion ({1e3 * moved:.2g} mrad or mm) is less than half a count of the encoder"
    )


def weigh(e: Evidence) -> float:
    """Return the confidence of one finding by itself: its share, what it earned, what stays unexplained, and its
    reasons."""
    c = e.share * e.earned * kept_of(e.left)
    if e.members > 1:  # of what the others leave it has to explain most
        c *= kept_of(e.left_of_rest)
    return float(min(c, JUDGE.surest, JUDGE.doubted if e.reasons else 1.0))


def share_odds(all_: list[Evidence], tried: int) -> None:
    """What the number of hypotheses says: each of all that were `tried`, over all joints, has the same share of the
    prior, so that what conditions left out say for one (`Evidence.score`) must outweigh their number: the best of many
    does better by accident than one."""
    for e in all_:
        e.odds = float(np.exp(-np.logaddexp(0.0, np.log(max(tried, 1)) - e.score)))
        e.confidence *= e.odds
        if e.odds < JUDGE.firm:
            e.reasons.append(f"of {tried} hypotheses that were tried one does as well by accident")


def of_touch(findings: list[Finding], before: float, noise: float) -> tuple[list[Finding], list[str]]:
    """(touch's findings, less sure where they are too small or the law of a contact's pressure may stand for them, why:
    a line each)."""
    out, said = [], []
    for f in findings:
        h = f.held_out
        reason = too_small(before, h["before"], h["after"], noise, len(findings) == 1) if h else ""
        reason = reason or TOUCH_EFFECTS[f.effect].doubt(f)
        if reason:
            said.append(f"{f.effect} is not sure: {reason}")
        out.append(f.at_most(JUDGE.doubted) if reason else f)
    return out, said


def of_the_whole(all_: list[Evidence], coupled: dict[str, str], bad: set[str], signs: Set[str] = frozenset()) -> None:
    """What other joints and the signals say. coupled: joint -> the joint that drags it; bad: joints with a signal that
    is not what it says; signs: those of them of which only the effort's sign is not, which is what a wrong sensor looks
    like."""
    misread = [e.joint for e in all_ if EFFECTS[e.effect].misreads]
    for e in all_:
        elsewhere = [j for j in misread if j != e.joint]
        if elsewhere and EFFECTS[e.effect].from_poses:
            e.doubt(f"the position of {elsewhere[0]} is not what it says, and with it what the other joints load")
        pulls = [j for j, k in coupled.items() if k == e.joint]
        if pulls and not EFFECTS[e.effect].couples:
            e.doubt(f"{e.joint} drags {pulls[0]}, whose pull on it is not modelled")
        if e.joint in bad and not (EFFECTS[e.effect].effort_only and e.joint in signs):
            e.doubt(f"a signal of {e.joint} is not what it says")
