"""Touch and contact: what the taxels show that simulation leaves out, pad by pad, judged on recordings kept out.

Without the geometry of what is touched, the taxels alone still show the dead, the stuck and the exchanged ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from dexsim.gap.inquiry import Steps
from dexsim.gap.judge import confidence
from dexsim.gap.judge.errors import rms_interval
from dexsim.gap.result import Diagnosis
from dexsim.gap.rules import TOUCH
from dexsim.gap.touch import constant_taxels, locate, report
from dexsim.gap.touch.handed_on import handed
from dexsim.gap.touch.judge import PadAnswer
from dexsim.gap.touch.read import PadRun, TouchData, collect, stretches
from dexsim.gap.touch.result import PadFacts, TouchResult
from dexsim.gap.touch.search import PadOutcome, PadSearch
from dexsim.recording.mechanism import Mechanism
from dexsim.recording.schema import Recording


@dataclass
class Pad:
    """One pad under way: what each step found out of it, for the next ones."""

    number: int
    runs: list[PadRun]
    notes: list[str] = field(default_factory=list)
    kept: set[str] = field(default_factory=set)  # recordings kept out of its fit
    search: PadSearch | None = None  # None: touched too shortly
    outcome: PadOutcome | None = None
    answer: PadAnswer | None = None

    @property
    def name(self) -> str:
        return self.runs[0].name


class Touch(Steps):
    """The touch of all recordings. held: names of those kept out of the fit; allowed: effects that are considered, None
    for all."""

    def __init__(
        self,
        recordings: list[Recording],
        m: Mechanism,
        held: set[str],
        seed: int = 0,
        allowed: set[str] | None = None,
        progress: Callable[[int, int, str], None] | None = None,
    ):
        self.m, self.held, self.seed, self.allowed, self.progress = m, held, seed, allowed, progress
        self.recordings = [r for r in recordings if r.tactile is not None]
        self.sensors = m.sensors
        contact = {r.path.name: s for r in recordings if (s := stretches(r))}
        self.result = TouchResult(names=self.sensors.names, contact=contact)
        self.data = TouchData()
        self.constant: list[dict] = []
        self.pads: list[Pad] = []

    def read(self) -> None:
        """Every pad that is pressed with the geometry of its contact; taxels that are constant."""
        self.result.tactile = bool(self.recordings)
        if self.recordings:
            self.data = collect(self.recordings, self.m, self.sensors)
            self.constant = constant_taxels.found(self.recordings, self.sensors)
            self.result.notes += self.data.notes
        self.pads = [Pad(k, [r for r in self.data.runs if r.pad == k]) for k in self.data.pads()]

    def model(self) -> None:
        """The plant of each pad beside its readings, and what of them is kept out."""
        for pad in self.pads:
            runs = pad.runs
            seconds = sum(float(np.sum(r.z.sum(1) > 0.1) * np.median(np.diff(r.t))) for r in runs)
            if seconds < TOUCH.short:
                pad.notes.append(
                    f"the {pad.name}'s pad is touched for {seconds:.1f} s only: its forces are not judged (at least "
                    f"{TOUCH.short:g} s)"
                )
                continue
            names = {r.recording for r in runs}
            pad.kept = self.held & names if self.held & names and names - self.held else set()
            if not pad.kept and len(names) >= 3:
                pad.kept = {runs[-1].recording}
            data = self.data
            pad.search = PadSearch(
                runs, pad.kept, data.scale_known, data.thermometer, self.seed + pad.number, self.allowed
            )

    def search(self) -> None:
        """Which effects each pad has."""
        for i, pad in enumerate(self.pads):
            if self.progress:
                self.progress(i, len(self.pads), f"touch of the {pad.name}")
            if pad.search is not None:
                pad.outcome = pad.search.run()
        if self.progress and self.pads:
            self.progress(len(self.pads), len(self.pads), "")

    def locate(self) -> None:
        """Where the believed simulator is off: taxel by taxel."""
        error = np.zeros(self.sensors.shape)
        for pad in self.pads:
            if pad.search is not None and pad.outcome is not None:
                off = locate.by_taxel(pad.search, pad.outcome.none)
                error[pad.number, : len(off)] = off
                self.result.error = error

    def judge(self) -> None:
        """Findings, errors and facts of each pad on what was kept out of the fit, and of all of them."""
        out, judged = self.result, []
        for pad in self.pads:
            if pad.search is not None and pad.outcome is not None:
                pad.answer = PadAnswer(pad.search, pad.outcome, pad.kept)
                if pad.answer.felt:
                    judged.append(pad.answer)
                    self._take(pad.answer)
                pad.notes += pad.answer.notes
            out.notes += pad.notes
        searched = {pad.number for pad in self.pads if pad.search is not None}
        for f in self.constant:
            number = int(f["where"]["taxels"][0].split(":")[0])
            if number not in searched:
                out.findings.append(f)
                readings = constant_taxels.readings_of(self.recordings, f["where"]["taxels"])
                out.facts[out.names[number]] = PadFacts(readings, judged=False)
        if judged:
            times = [a.times for a in judged]
            out.before = rms_interval([a.before for a in judged], times, self.seed)
            out.after = rms_interval([a.after for a in judged], times, self.seed)
            out.floor = float(np.sqrt(np.mean(np.square([a.floor for a in judged]))))
            out.notes += confidence.of_touch(out.findings, out.before[0], out.floor)
        out.notes += handed(out.findings, out.facts, out.names).doubts

    def _take(self, answer: PadAnswer) -> None:
        """What one pad answers, into the result."""
        out, name = self.result, answer.name
        out.pads[name] = answer.numbers
        out.findings += answer.findings()
        out.facts[name] = answer.facts()
        out.nuisance |= answer.nuisance()
        out.recordings = sorted({*out.recordings, *answer.recordings()})
        if answer.structured():
            out.structured = True
            out.depends_on += locate.depends_on(answer.search, answer.best, name)
        out.curves.append(locate.curve(answer.search, name, answer.none, answer.best, bool(answer.kept)))

    def report(self, d: Diagnosis) -> None:
        """Touch beside the joints, or by itself where none of them is judged."""
        report.add(d, self.result)


def diagnose(
    recordings: list[Recording],
    m: Mechanism,
    held: set[str],
    seed: int = 0,
    allowed: set[str] | None = None,
    progress: Callable[[int, int, str], None] | None = None,
) -> TouchResult:
    """Touch of all recordings, whatever the joints do. held: names of those kept out of the fit."""
    touch = Touch(recordings, m, held, seed, allowed, progress)
    touch.run()
    return touch.result
