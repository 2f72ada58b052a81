"""What a diagnosis is asked, what it says, and where its time goes."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.actuator.table import ServoTable
from dexsim.gap import locate
from dexsim.gap.judge import confidence, full_model, residual_fit
from dexsim.gap.search.search import Outcome
from dexsim.gap.search.time_limit import TimeLimit
from dexsim.gap.touch.result import TouchResult
from dexsim.recording.mechanism import Mechanism


@dataclass
class Settings:
    """What was asked. recordings, held_out: paths; model, servo: files, None for
    the hand's; hand, hand_mirror: as `load_hand` takes them, None for the xHand; allowed: effect ids to
    consider, joints: those to judge (the others' motion is only prescribed); None for all."""

    recordings: list[Path]
    out: Path
    held_out: list[Path] | None = None
    model: str | None = None
    servo: str | None = None
    seed: int = 0
    device: str = "cpu"
    next_recording: bool = True
    allowed: set[str] | None = None
    joints: set[str] | None = None
    meta: dict[str, str] = field(default_factory=dict)
    remap: dict[str, str] = field(default_factory=dict)
    limit: float | None = None  # s of wall time for all; the best answer by then
    # made from `limit` where it is not given; its `stop()` ends the search with the best so far
    time_limit: TimeLimit | None = None
    replay: str = "mujoco"  # see `confirm.REPLAY`
    hand: str | None = None
    hand_mirror: bool = False


@dataclass
class Curve:
    """Held-out stretch of one joint for the page: measured and simulated before and after."""

    joint: str
    recording: str
    t: np.ndarray
    measured: np.ndarray
    before: np.ndarray
    after: np.ndarray
    command: np.ndarray


@dataclass
class Diagnosis:
    """Everything the page shows; `data` is what diagnosis.json holds."""

    data: dict[str, Any]
    sentence: str
    notes: list[str]
    curves: list[Curve] = field(default_factory=list)
    spots: list[locate.Spot] = field(default_factory=list)
    # by joint: before, after, sigma; as_fitted: after, where it was taken back
    joints: dict[str, dict[str, float]] = field(default_factory=dict)
    outcomes: list[Outcome] = field(default_factory=list)
    servo: ServoTable | None = None
    model_spec: Any = None
    mechanism: Mechanism | None = None
    stages: list[str] = field(default_factory=list)
    shares: dict[str, float] = field(default_factory=dict)
    spans: dict[str, float] = field(default_factory=dict)
    touch: TouchResult | None = None
    lengths: dict[str, float] = field(default_factory=dict)  # of each recording [s]
    standins: list[residual_fit.StandIn] = field(default_factory=list)
    # (joint, recording): mean |error| before, after
    mae: dict[tuple[str, str], tuple[float, float]] = field(default_factory=dict)
    untrained: list[str] = field(default_factory=list)
    confirmation: full_model.Confirmation | None = None
    evidence: list[confidence.Evidence] = field(default_factory=list)  # behind each finding of a joint


def empty(verdict: str = "unusable") -> dict[str, Any]:
    """diagnosis.json with nothing in it."""
    zero: dict[str, Any] = {"recordings": [], "error": "position_rmse_rad"}
    zero |= {k: None for k in ("before", "after", "before_low", "before_high", "after_low", "after_high")}
    return {
        "schema": 1,
        "verdict": verdict,
        "noise_floor": {"position_rad": None, "how": "quantum"},
        "nuisance": {},
        "baseline": {},
        "held_out": zero,
        "findings": [],
        "unexplained": {"fraction_of_gap": None, "depends_on": [], "not_considered": {}},
        "next_recording": None,
    }


class Clock:
    """Where the time goes, by stage."""

    def __init__(self) -> None:
        self.shares: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.shares[stage] = self.shares.get(stage, 0.0) + now - self._last
        self._last = now
