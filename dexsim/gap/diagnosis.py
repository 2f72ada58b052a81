"""The whole diagnosis: recordings in, verdict, findings, fitted servo and model, report out."""

from __future__ import annotations

from collections.abc import Callable

from dexsim.gap.drives import Drives, cannot_be_seen
from dexsim.gap.inquiry import Inquiry, NothingToJudge, read_files, to_runs
from dexsim.gap.judge import not_considered
from dexsim.gap.report.files import save
from dexsim.gap.report.next_recording import plan_next
from dexsim.gap.result import Diagnosis, Settings, empty
from dexsim.gap.search.time_limit import TimeLimit
from dexsim.gap.touch.diagnosis import Touch


def diagnose(
    s: Settings,
    say: Callable[[str], None] = print,
    progress: Callable[[float, int, str], None] | None = None,
) -> Diagnosis:
    """Diagnoses recordings; UserError only for what the command line got wrong, a verdict for everything else."""
    w = Inquiry(s, say, progress, s.time_limit or TimeLimit(s.limit))
    read_files(w)
    to_runs(w)
    touch = Touch(w.readable, w.m, w.held_names, s.seed, s.allowed, progress)
    touch.run()
    w.notes += touch.result.notes
    w.clock.lap("touch")
    drives = Drives(w, touch.result)
    try:
        drives.run()
    except NothingToJudge as reason:
        return _without_drives(w, touch, str(reason))
    d = Diagnosis(empty(), "", w.notes, mechanism=w.m, lengths=w.lengths)
    drives.report(d)
    touch.report(d)
    w.clock.lap("judging on held-out data")
    if d.data["verdict"] in ("unknown", "partly_explained"):
        drives.stand_in(d)
        w.clock.lap("stand-in")
    drives.confirm(d)
    w.clock.lap("replay in the engine that trains")
    if s.next_recording:
        plan_next(d, s, w.m, drives.outcomes, w.readable)
        w.clock.lap("next recording")
    d.shares = w.clock.shares
    return d


def _without_drives(w: Inquiry, touch: Touch, reason: str) -> Diagnosis:
    """What is left when no joint can be judged: touch, or the reason why nothing can be said."""
    felt = touch.result
    d = Diagnosis(empty(), f"{reason.rstrip('.')}.", w.notes, mechanism=w.m)
    d.data["findings"] = w.channel
    if felt.before is None and not felt.findings:
        d.data["reason"] = reason
        return d
    w.notes.append(f"no joint is judged: {reason}")
    left_out = not_considered.reasons((), felt, w.settings.allowed)
    w.notes += cannot_be_seen(w.settings.allowed, left_out)
    touch.report(d)
    d.data["unexplained"]["not_considered"] = left_out
    d.lengths = w.lengths
    if w.settings.next_recording:
        plan_next(d, w.settings, w.m, (), w.readable)
    d.shares = w.clock.shares
    return d


__all__ = ["Diagnosis", "Settings", "diagnose", "save"]
