"""A diagnosis under way: what is asked (`Settings`) and answered (`Diagnosis`), the `Inquiry` that every part of a
machine begins from (mechanism, recordings, their runs, what is wrong with signals) and the `Steps` that each is taken
through, its drives (`gap.diagnosis`) and its touch (`gap.touch.diagnosis`) alike."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.actuator.table import ServoTable
from dexsim.errors import UserError
from dexsim.gap import locate
from dexsim.gap.compute import TimeLimit
from dexsim.gap.effects import PadFacts
from dexsim.gap.effects.catalogue import CATALOGUE
from dexsim.gap.finding import Finding
from dexsim.gap.judge import confidence, full_model
from dexsim.gap.read import Run, agreement, channels, inputs
from dexsim.gap.search.search import Outcome
from dexsim.recording.mechanism import Mechanism
from dexsim.recording.schema import Recording

# -- what touch finds out ---------------------------------------------------------------------------------------------


@dataclass
class PadCurve:
    """A held-out stretch of one pad: sums over its taxels [N] against t [s]; load: of the cell, or None."""

    pad: str
    recording: str
    t: np.ndarray
    measured: np.ndarray
    before: np.ndarray
    after: np.ndarray
    load: np.ndarray | None


@dataclass
class TouchResult:
    """before, after: [N] held-out rms of the taxels' readings (of all judged
    pads) with 90 % intervals (value, low, high), None where no force could be predicted; floor [N]; error [F, K] N rms
    of each taxel before; structured: whether something is left that no effect explains; pads: by name (before, after,
    noise); names: of all pads [F]."""

    findings: list[Finding] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    before: tuple[float, float, float] | None = None
    after: tuple[float, float, float] | None = None
    floor: float | None = None
    error: np.ndarray | None = None
    structured: bool = False
    names: tuple[str, ...] = ()
    pads: dict[str, dict[str, float]] = field(default_factory=dict)
    curves: list[PadCurve] = field(default_factory=list)
    nuisance: dict[str, float] = field(default_factory=dict)
    recordings: list[str] = field(default_factory=list)
    depends_on: list[str] = field(default_factory=list)
    contact: dict[str, list[tuple[float, float]]] = field(default_factory=dict)  # by recording: stretches in touch, s
    tactile: bool = False  # whether taxels were recorded at all
    facts: dict[str, PadFacts] = field(
        default_factory=dict
    )  # by name of pad: what `handed_on` needs beside the findings


# -- what is asked and answered ---------------------------------------------------------------------------------------


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
    replay: str = "mujoco"  # see `full_model.REPLAY`
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
class Judged:
    """What the verdict on joints goes by, as entries of `held_out`: errors of their motion, of the reading of their
    effort alone, and of their torque from the motion (what the recorded torque names); None where there is none.
    structured: whether what is left without any effect has structure; quiet: whether every joint is followed to its
    own floor without any; loud: recordings that are surely missed by more than their own repeats differ by; shown:
    the error of their motion away from what no fitted recording visits, and whether each joint is followed to its
    floor there (None: all of it was fitted somewhere, or most of it nowhere); step: that of the encoders [rad or m],
    root mean square over joints; 0 where a joint is missed by `JUDGE.far` x its own floor."""

    position: dict[str, Any]
    effort: dict[str, Any] | None = None
    torque: dict[str, Any] | None = None
    structured: bool = True
    quiet: bool = False
    loud: tuple[str, ...] = ()
    shown: tuple[dict[str, Any], bool] | None = None
    step: float = 0.0


@dataclass
class Diagnosis:
    """Everything the page shows; `data` is what diagnosis.json holds (its findings from `conclude.decide` on)."""

    data: dict[str, Any]
    sentence: str
    notes: list[str]
    findings: list[Finding] = field(default_factory=list)
    curves: list[Curve] = field(default_factory=list)
    spots: list[locate.Spot] = field(default_factory=list)
    # by joint: before, after, sigma
    joints: dict[str, dict[str, float]] = field(default_factory=dict)
    outcomes: list[Outcome] = field(default_factory=list)
    servo: ServoTable | None = None
    model_spec: Any = None
    mechanism: Mechanism | None = None
    stages: list[str] = field(default_factory=list)
    shares: dict[str, float] = field(default_factory=dict)
    touch: TouchResult | None = None
    lengths: dict[str, float] = field(default_factory=dict)  # of each recording [s]
    # (joint, recording): mean |error| before, after
    mae: dict[tuple[str, str], tuple[float, float]] = field(default_factory=dict)
    untrained: list[str] = field(default_factory=list)
    written: full_model.Written | None = None  # of each joint; None where none is judged
    evidence: list[confidence.Evidence] = field(default_factory=list)  # behind each finding of a joint
    # joints that ring by themselves, as what was found of them does in what was held out
    ringing: frozenset[str] = frozenset()
    judged: Judged | None = None  # None where no joint is


def empty(verdict: str = "unusable") -> dict[str, Any]:
    """Return diagnosis.json with nothing in it."""
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


@dataclass
class Inquiry:
    """A diagnosis under way: what is asked, and what the recordings hold.

    recordings: as they are, None for one that cannot be read; runs: of those that can be used; held: numbers of the
    runs that are held out of the fit; channel: findings about signals; lengths: s, by recording; notes: what the page
    says beside the findings."""

    settings: Settings
    say: Callable[[str], None]
    progress: Callable[..., None] | None
    limit: TimeLimit
    clock: Clock = field(default_factory=Clock)
    notes: list[str] = field(default_factory=list)
    m: Mechanism = None  # type: ignore[assignment]  # the first that `read_files` finds out
    names: dict[Path, str] = field(default_factory=dict)
    recordings: list[Recording | None] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    lengths: dict[str, float] = field(default_factory=dict)
    runs: list[Run] = field(default_factory=list)
    held: list[int] = field(default_factory=list)
    channel: list[Finding] = field(default_factory=list)

    @property
    def readable(self) -> list[Recording]:
        """The recordings that could be read."""
        return [r for r in self.recordings if r is not None]

    @property
    def by_name(self) -> dict[str, Recording]:
        """The recordings that could be read, by their runs' name."""
        return {r.path.name: r for r in self.readable}

    def nothing_left(self) -> bool:
        """Return whether no run is left, or none that is fitted."""
        return not self.runs or bool(self.settings.held_out and len(self.held) == len(self.runs))


READING = 0.25  # of a limit of time: for reading; what is not read by then is left out


class NothingToJudge(Exception):
    """A part of which nothing can be said, and why."""


class Steps:
    """One part of a machine under diagnosis: what of the recordings tells of it (`read`), its plant along them and what
    is held out (`plant`), which effects it has (`search`), where its belief is off (`locate`), findings and errors on
    what was held out (`judge`); `report` adds the answer to a diagnosis. Each step keeps what it found out for the next
    ones; any may raise NothingToJudge."""

    def run(self) -> None:
        """All steps up to the judgement, in order."""
        for step in ("read", "plant", "search", "locate", "judge"):
            getattr(self, step)()


def read_files(w: Inquiry) -> None:
    """The mechanism and the recordings, as far as they can be read."""
    from dexsim.recording import read
    from dexsim.recording.mechanism import mechanism, stated_hand

    s = w.settings
    try:
        w.m = mechanism(s.model, s.servo, hand=stated_hand(s.hand, s.hand_mirror))
    except UserError as error:
        raise UserError(f"{error}{_still(w.settings)}") from None
    overlap = {p.resolve() for p in w.settings.recordings} & {p.resolve() for p in w.settings.held_out or []}
    if overlap:
        raise UserError(
            f"held_out: {', '.join(sorted(p.name for p in overlap))} is also in recordings; "
            "what is held out must not be fitted"
        )
    paths = [*w.settings.recordings, *(w.settings.held_out or [])]
    w.names = _unique_names(paths)
    w.recordings, unread = [None] * len(paths), []
    for turn, i in enumerate(_in_turn(len(w.settings.recordings), len(paths))):
        path = paths[i]
        if turn > 1 and w.limit.spent(READING):
            unread.append(w.names[path])
            continue
        try:
            r = read(path, w.settings.remap, w.settings.meta, joints=w.m.joints, hand=w.m.hand, limits=w.m.ranges)
            r.path = Path(w.names[path])
            w.recordings[i] = r
        except UserError as error:
            w.failures.append(str(error))
    if unread:
        w.limit.leave_out(f"{len(unread)} of {len(paths)} recordings are not read: {', '.join(sorted(unread))}")
    w.clock.lap("reading and audit")
    w.lengths = {r.path.name: r.duration for r in w.recordings if r is not None}
    _copies(w.recordings[: len(w.settings.recordings)], w.recordings[len(w.settings.recordings) :])


def to_runs(w: Inquiry) -> None:
    """The recordings as runs, without what tells nothing of the joints, and findings about signals."""
    for i, r in enumerate(w.recordings):
        if r is None:
            continue
        try:
            run = inputs.to_run(r, w.m, w.notes)
        except inputs.Unusable as error:
            w.failures.append(str(error))
            continue
        if i >= len(w.settings.recordings):
            w.held.append(len(w.runs))
        w.runs.append(run)
    readable = w.readable
    sensors = {e.id: e.experiment for e in CATALOGUE if e.effort_only}
    openly = channels.driven_openly(w.runs)
    w.channel = inputs.channel_findings(readable, w.m.joints, sensors, openly)
    w.notes += [
        f"{r.path.name}: {f.text}"
        for r in readable
        for f in r.findings
        if f.kind in ("joint_names", "gap") and "left out" in f.text
    ]
    guesses: dict[str, list[str]] = {}
    for r in readable:
        for f in r.findings:
            if f.kind == "unit" and f.severity == "warning" and not f.topic:  # `Units.guess`, not the audit's
                guesses.setdefault(f.text, []).append(r.path.name)
    w.notes[:0] = [f"{', '.join(names)}: {text}" for text, names in guesses.items()]
    w.notes[:0] = [
        f"{r.path.name}: {f.text}; left out"
        for r in readable
        for f in r.findings
        if f.kind == "nan" and f.joint in ("", *w.m.joints)
    ]
    absent = [j for j in w.m.joints if w.runs and not any(j in r.joints for r in w.runs)]
    if absent:
        w.notes.append(
            f"in the model but in no recording: {', '.join(absent)}; nothing can be said of "
            f"{'it' if len(absent) == 1 else 'them'}, taken to stand at rest"
        )
    model = w.m.spec.compile()
    for joint in w.m.joints if len(w.runs) > 1 else ():
        w.notes += [f"{name}: {text}" for name, _, text in agreement.contradictions(w.runs, joint)]
    wrong, out, blind = channels.inspect(w.runs, model, channels.spoiled(readable, openly))
    w.channel = channels.secondary(w.channel + wrong)
    before = {id(r): k for k, r in enumerate(w.runs)}
    w.runs = channels.drop(w.runs, out, w.notes, model, w.held)
    w.held = [k for k, r in enumerate(w.runs) if before[id(r)] in w.held]
    if blind:
        w.runs, w.held = inputs.free_air(
            w.runs,
            w.held,
            inputs.merged_spans(blind),
            w.notes,
            "part of it tells nothing (old readings, a pause, or a clock that was set)",
            "that does",
            (0.0, 0.0),
            inputs.SHORTEST,
        )
    w.notes += w.failures
    w.failures += [f"{name}: {joint}: {why}" for (name, joint), why in out.items()] if not w.runs else []
    if w.failures and w.runs and len(w.held) < len(w.runs):
        w.say(f"  left out: {'; '.join(w.failures)}")


def _in_turn(fitted: int, count: int) -> list[int]:
    """Numbers of the recordings, the first `fitted` of them and those held out in turn, each evenly: wherever one
    stops, there is of both."""
    share = [(i + 0.5) / fitted for i in range(fitted)]
    share += [(i + 0.5) / (count - fitted) for i in range(count - fitted)]
    return sorted(range(count), key=lambda i: (share[i], i))


def _unique_names(paths: Sequence[Path]) -> dict[Path, str]:
    names = [p.name for p in paths]
    return {p: p.name if names.count(p.name) == 1 else f"{p.parent.name}/{p.name}" for p in paths}


def _copies(train: Sequence[Any], held: Sequence[Any]) -> None:
    """UserError where a held-out recording is one of the others under another name. A reading that never changes is
    no copy: every recording of a dead encoder looks like that."""
    for h in held:
        for r in train:
            a, b = (None if x is None else x.states.position for x in (h, r))
            if (
                a is not None
                and b is not None
                and len(a) > 20
                and a.value.shape == b.value.shape
                and np.array_equal(a.value, b.value, equal_nan=True)
                and (a.value != a.value[0]).any()
            ):
                raise UserError(
                    f"held_out: {h.path.name} holds the same readings as {r.path.name}; what is held out must not be "
                    "fitted"
                )


def _still(s: Settings) -> str:
    """Return what can be said although the model or the servo cannot be used: of the recordings alone, in one line."""
    from dexsim.recording import read

    said = []
    for path in [*s.recordings, *(s.held_out or [])][:6]:
        try:
            r = read(path, s.remap, s.meta)
        except UserError as error:
            said.append(str(error))
            continue
        bad = [f.text for f in r.findings if f.severity == "error"]
        said.append(
            f"{path.name}: {r.duration:.1f} s of {len(r.joints)} joint{'s' * (len(r.joints) != 1)}, "
            f"{'; '.join(bad[:2]) if bad else 'no fault'}"
        )
    return f" (of the recordings themselves: {' | '.join(said)})" if said else ""
