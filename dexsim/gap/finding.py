"""What a diagnosis names: `Finding`, made once and never changed, and its entry in `diagnosis.json`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

WRONG_SIGNAL = "bad_channel"  # the effect's id of a signal that is not what it says


@dataclass(frozen=True)
class Finding:
    """One effect, signal or push, named with a confidence.

    joints, taxels ("pad:k"), topics: where it is; when: its stretches of time [s] by recording; parameters: value with
    90 % interval and unit by key; held_out: error without and with it on what no fit has seen, None where nothing was
    fitted; hint: it never makes a verdict.
    """

    effect: str
    confidence: float
    regime: str
    joints: Sequence[str] = ()
    taxels: Sequence[str] = ()
    topics: Sequence[str] = ()
    alternatives: Sequence[dict[str, Any]] = ()
    indistinguishable: Sequence[str] = ()
    separating_experiment: str | None = None
    when: Sequence[dict[str, Any]] = ()
    parameters: dict[str, Any] = field(default_factory=dict)
    held_out: dict[str, Any] | None = None
    hint: bool = False

    @property
    def wrong_signal(self) -> bool:
        """Whether it says that a signal is not what it says."""
        return self.effect == WRONG_SIGNAL

    def at_most(self, confidence: float) -> Self:
        """Return the finding with no more than this confidence."""
        return replace(self, confidence=min(self.confidence, confidence))

    def to_json(self) -> dict[str, Any]:
        """Return the entry of `findings`."""
        return {
            "effect": self.effect,
            "confidence": self.confidence,
            "alternatives": list(self.alternatives),
            "indistinguishable": list(self.indistinguishable),
            "separating_experiment": self.separating_experiment,
            "where": {"joints": list(self.joints), "taxels": list(self.taxels), "topics": list(self.topics)},
            "regime": self.regime,
            "when": list(self.when),
            "parameters": self.parameters,
            "held_out": self.held_out,
        } | ({"hint": True} if self.hint else {})


@dataclass(frozen=True)
class Verdict:
    """The one word of a diagnosis, the findings behind it (hints last), the error that it goes by (`held_out`; None: of
    nothing), the share of the gap that is left, and what the rest depends on."""

    word: str
    findings: tuple[Finding, ...]
    error: dict[str, Any] | None = None
    fraction: float | None = None
    depends_on: tuple[str, ...] = ()

    def into(self, data: dict[str, Any]) -> None:
        """Write it into what diagnosis.json holds; regimes that are not judged stay there."""
        data["verdict"], data["findings"] = self.word, [f.to_json() for f in self.findings]
        data["unexplained"]["depends_on"] = list(self.depends_on)
        if self.error is not None:
            beside = {k: v for k, v in data["held_out"].items() if k == "not_judged"}
            data["held_out"], data["unexplained"]["fraction_of_gap"] = self.error | beside, self.fraction


def chances(rivals: Sequence[tuple[str, float]]) -> tuple[dict[str, Any], ...]:
    """Return the first three rivals (effect, share) as `alternatives`."""
    return tuple({"effect": e, "confidence": round(c, 3)} for e, c in rivals[:3])


def removed(before: float, after: float, share: tuple[float, float]) -> dict[str, Any]:
    """Return `held_out` of a fitted effect: errors without and with it, 90 % interval of the share that it removes."""
    low, high = (round(x, 4) for x in share)
    return {"before": before, "after": after, "removed_low": low, "removed_high": high}


def gathered(findings: Sequence[Finding]) -> list[Finding]:
    """Return findings, those of one kind of fault in several signals as one at the place of the first."""
    groups: dict[Any, list[Finding]] = {}
    for f in findings:
        groups.setdefault((f.regime.partition(":")[0], f.hint) if f.wrong_signal else id(f), []).append(f)
    return [_as_one(alike) if len(alike) > 1 else alike[0] for alike in groups.values()]


def _as_one(alike: Sequence[Finding]) -> Finding:
    first, when = alike[0], [w for f in alike for w in f.when]
    joints = list(dict.fromkeys(j for f in alike for j in f.joints))
    topics = list(dict.fromkeys(t for f in alike for t in f.topics))
    places = joints or topics
    more = f" and {len(places) - 3} more" if len(places) > 3 else ""
    said = f"{first.regime} (the same in {len(alike)} signals, of {', '.join(places[:3])}{more})"
    sure = max(f.confidence for f in alike)
    return replace(first, confidence=sure, regime=said, joints=joints, topics=topics, when=when)
