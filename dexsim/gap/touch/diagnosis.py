"""Touch and contact: what the taxels show that simulation leaves out, pad by pad, judged on recordings held out; beside
the joints' findings and in the files.

Without the geometry of what is touched, the taxels alone still show the dead, the stuck and the exchanged ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dexsim.gap.compute import TimeLimit
from dexsim.gap.effects import Fit, PadFacts, PadSettings, ranged, times
from dexsim.gap.effects.catalogue import TOUCH_EFFECTS
from dexsim.gap.finding import Finding
from dexsim.gap.inquiry import Diagnosis, Steps, TouchResult
from dexsim.gap.judge import confidence
from dexsim.gap.judge.held_out import rms_interval
from dexsim.gap.rules import JUDGE, TOUCH
from dexsim.gap.touch import judge
from dexsim.gap.touch.judge import PadAnswer
from dexsim.gap.touch.read import PadRun, TouchData, collect, stretches
from dexsim.gap.touch.search import PadOutcome, PadSearch
from dexsim.recording.mechanism import Mechanism
from dexsim.recording.schema import Recording
from dexsim.tactile.config import COLUMNS
from dexsim.tactile.file import RANGES
from dexsim.tactile.pads import PAD_COLUMNS


@dataclass
class Pad:
    """One pad under way: what each step found out of it, for the next ones."""

    number: int
    runs: list[PadRun]
    notes: list[str] = field(default_factory=list)
    kept: set[str] = field(default_factory=set)  # recordings held out of its fit
    search: PadSearch | None = None  # None: touched too shortly
    outcome: PadOutcome | None = None
    answer: PadAnswer | None = None

    @property
    def name(self) -> str:
        return self.runs[0].name


SEARCHING = 0.5  # of a limit of time: no pad's search begins later


class Touch(Steps):
    """The touch of all recordings. held: names of those held out of the fit; allowed: effects that are considered, None
    for all; limit: of time."""

    def __init__(
        self,
        recordings: list[Recording],
        m: Mechanism,
        held: set[str],
        seed: int = 0,
        allowed: set[str] | None = None,
        progress: Callable[[int, int, str], None] | None = None,
        limit: TimeLimit | None = None,
    ):
        self.m, self.held, self.seed, self.allowed, self.progress = m, held, seed, allowed, progress
        self.limit = limit or TimeLimit(None)
        self.recordings = [r for r in recordings if r.tactile is not None]
        self.sensors = m.sensors
        contact = {r.path.name: s for r in recordings if (s := stretches(r))}
        self.result = TouchResult(names=self.sensors.names, contact=contact)
        self.data = TouchData()
        self.constant: list[Finding] = []
        self.pads: list[Pad] = []

    def read(self) -> None:
        """Every pad that is pressed with the geometry of its contact; taxels that are constant."""
        self.result.tactile = bool(self.recordings)
        if self.recordings:
            self.data = collect(self.recordings, self.m, self.sensors)
            self.constant = judge.constant_taxels(self.recordings, self.sensors)
            self.result.notes += self.data.notes
        self.pads = [Pad(k, [r for r in self.data.runs if r.pad == k]) for k in self.data.pads()]

    def plant(self) -> None:
        """The plant of each pad beside its readings, and what of them is held out."""
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
            if pad.search is not None and self.limit.spent(SEARCHING):
                pad.search = None
                self.limit.leave_out(f"the {pad.name}'s pad is not searched")
                continue
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
                off = judge.by_taxel(pad.search, pad.outcome.none)
                error[pad.number, : len(off)] = off
                self.result.error = error

    def judge(self) -> None:
        """Findings, errors and facts of each pad on what was held out of the fit, and of all of them."""
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
            number = int(f.taxels[0].split(":")[0])
            if number not in searched:
                out.findings.append(f)
                readings = judge.readings_of(self.recordings, f.taxels)
                out.facts[out.names[number]] = PadFacts(readings, judged=False)
        if judged:
            times = [a.times for a in judged]
            out.before = rms_interval([a.before for a in judged], times, self.seed)
            out.after = rms_interval([a.after for a in judged], times, self.seed)
            out.floor = float(np.sqrt(np.mean(np.square([a.floor for a in judged]))))
            out.findings, said = confidence.of_touch(out.findings, out.before[0], out.floor)
            out.notes += said
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
            out.depends_on += judge.depends_on(answer.search, answer.best, name)
        out.curves.append(judge.curve(answer.search, name, answer.none, answer.best, bool(answer.kept)))

    def report(self, d: Diagnosis) -> None:
        """Touch beside the joints, or by itself where none of them is judged."""
        into_diagnosis(d, self.result)


# -- touch beside the joints ------------------------------------------------------------------------------------------
# Touch beside the joints: one list of findings; the verdict on both is `conclude.decide`'s.


def into_diagnosis(d: Diagnosis, felt: TouchResult) -> None:
    """Touch into a diagnosis: beside the joints, or by itself where none of them is judged."""
    d.touch, data = felt, d.data
    if d.judged is None:
        data["noise_floor"] = {"position_rad": None, "how": "quantum", "tactile_N": felt.floor}
    elif felt.floor is not None:
        data["noise_floor"]["tactile_N"] = felt.floor
    d.findings = [*sorted(d.findings, key=lambda f: not f.wrong_signal)]
    data["nuisance"] |= felt.nuisance


# -- what is handed on to training ------------------------------------------------------------------------------------
# What a diagnosis finds of touch and contact, as training takes it: `tactile.yaml` (`dexsim.tactile.file`).
#
# Which setting an effect writes stands in its class (`dexsim.gap.effects`).
#
# A world has one friction and one stiffness for all fingertips: their ranges hold what was found on every fingertip,
# and what was believed where a fingertip was judged and nothing was found. The range of what is not sure holds what was
# believed as well.

SHARED = ("object.friction", "contact.stiffness")  # a world has one for all fingertips

HEAD = """\
# What diagnose.py found of touch and contact: python train.py tactile_file=FILE (play.py too) lays it over
# the tactile group and the task's ranges. value is the best guess; low to high is drawn anew in each world at each
# episode.
"""


@dataclass
class Handed:
    """tactile, randomize: as the file holds them. said: a line for each finding; doubts: for the notes."""

    tactile: dict[str, Any] = field(default_factory=dict)
    randomize: dict[str, Any] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)


def doubted(finding: Finding) -> bool:
    return finding.confidence < JUDGE.sure or bool(finding.indistinguishable)


def handed(findings: list[Finding], facts: dict[str, PadFacts], names: Sequence[str]) -> Handed:
    """Return the settings that findings of touch ask for. facts: by name of pad; names: of the hand's pads [F]."""
    out = Handed()
    pads: dict[str, PadSettings] = {}
    drifts: dict[str, Any] = {}
    for f in findings:
        if not f.taxels:
            continue
        name, effect = names[int(f.taxels[0].split(":")[0])], TOUCH_EFFECTS[f.effect]
        pad = pads.setdefault(name, PadSettings(facts.get(name) or PadFacts(judged=False)))
        doubt, drift = doubted(f), effect.drift(f, pad.fact)
        if drift is not None:
            drifts[name] = drift
        lost = effect.hand_on(f, pad, doubt)
        either = " or ".join(f.indistinguishable or [f.effect])
        unsure = ", not sure: its range holds what was believed" if doubt else ""
        out.said.append(f"{name}: {either}, confidence {f.confidence:.2f}{unsure}")
        if doubt:
            out.doubts.append(
                f"{f.effect} on the {name}'s pad is not sure: in tactile.yaml its range holds what was "
                f"believed as well{lost}"
            )
    for name, drift in drifts.items():
        values = pads[name].values
        values["gain"] = times(values.get("gain"), drift)
        if "taxels" in values:
            values["taxels"] = {k: times(g, drift) for k, g in values["taxels"].items()}
    for name, pad in pads.items():
        values = pad.values
        if values:
            for key in [k for k in values if k in PAD_COLUMNS]:
                values[key] = ranged(values[key], *PAD_COLUMNS[key][1:3])
            if "taxels" in values:
                values["taxels"] = {k: ranged(g, *PAD_COLUMNS["gain"][1:3]) for k, g in values["taxels"].items()}
            out.tactile.setdefault("pads", {})[name] = values
    shared = {key: {name: pad.shared[key] for name, pad in pads.items() if key in pad.shared} for key in SHARED}
    for key, by_pad in shared.items():
        if by_pad:
            out.randomize[key] = ranged(_hull(key, by_pad, facts), *RANGES[key][1:])
    if "object.friction" in out.randomize:
        out.tactile["friction"] = ranged(
            _hull("object.friction", shared["object.friction"], facts), *COLUMNS["friction"][1:3]
        )
    return out


def _hull(name: str, by_pad: dict[str, Fit], facts: dict[str, PadFacts]) -> Fit:
    """Return one range for all fingertips: every fit, and what was believed of a fingertip that was judged and follows
    it."""
    others = [x.believed(name) for pad, x in facts.items() if pad not in by_pad]
    believed = [x for x in others if x is not None]
    value, low, high = (np.array(x) for x in zip(*by_pad.values(), strict=True))
    return float(value.mean()), float(min([*low, *believed])), float(max([*high, *believed]))


def save_tactile(h: Handed, path: Path) -> bool:
    """Writes the file. Returns False where there is nothing to hand on."""
    content = {k: v for k, v in (("tactile", h.tactile), ("randomize", h.randomize)) if v}
    if not content:
        return False
    text = (
        HEAD
        + "".join(f"# {line}\n" for line in h.said)
        + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=130)
    )
    path.write_text(text, encoding="utf-8")
    return True
