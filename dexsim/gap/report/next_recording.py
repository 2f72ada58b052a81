"""What to record next: which motions of which joints, or which presses, and the file of commands ready to send."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dexsim import outputs
from dexsim.errors import UserError
from dexsim.gap.effects.catalogue import EFFECTS, entry, modelled, separating
from dexsim.gap.effects.effect import Effect
from dexsim.gap.plant.case import Case
from dexsim.gap.report import next_experiment
from dexsim.gap.report.sentence import place
from dexsim.gap.result import Diagnosis, Settings
from dexsim.gap.rules import JUDGE
from dexsim.gap.search.search import JointSearch, Outcome
from dexsim.recording.mechanism import Mechanism


def plan_next(
    d: Diagnosis,
    s: Settings,
    m: Mechanism,
    outcomes: Sequence[tuple[Case, JointSearch, Outcome]] = (),
    recordings: Sequence[Any] = (),
) -> None:
    """What to record next, written ready to send where a safe plan exists."""
    data = d.data
    named = [f for f in data["findings"] if modelled(f)]
    unsure = [f for f in named if f["indistinguishable"] or f["confidence"] < JUDGE.sure]
    kinds, joints, why = None, None, ""
    if unsure and not unsure[0]["where"]["joints"]:
        _next_touch(d, s, m, unsure[0], recordings)
        return
    if unsure:
        f = unsure[0]
        rivals = list(
            dict.fromkeys(f["indistinguishable"] or [f["effect"], *(a["effect"] for a in f["alternatives"][:1])])
        )
        joints = f["where"]["joints"]
        kinds = sorted({k for e in rivals for k in EFFECTS.get(e, Effect).motions})
        head = (
            f"to tell {' from '.join(rivals)} on {joints[0]}"
            if len(rivals) > 1
            else f"to make sure of {rivals[0]} on {joints[0]}"
        )
        experiment = separating(rivals) if all(r in EFFECTS for r in rivals) else EFFECTS[f["effect"]].experiment
        why = f"{head}: {experiment}"
        choice = _choice(d, s, m, outcomes, f, rivals)
        if choice is not None:
            kinds = choice.chosen
            why = (
                f"{head}: {' and '.join(kinds)}, because {choice.text}"
                if choice.settles
                else f"{why}. Of the motions that can be planned here, {choice.text}"
            )
    elif data["verdict"] in ("unknown", "partly_explained"):
        worst = max(d.joints, key=lambda j: d.joints[j]["after"]) if d.joints else None
        joints, kinds = ([worst] if worst else None), ["triangles", "ladder", "chirp", "steps", "holds"]
        why = f"what is left on {worst} is not explained: every kind of motion, with repeats"
    if not why:
        return
    data["next_recording"] = {"why": why, "commands": None}
    try:
        from dexsim.recording.excitation import next_recording

        with outputs.staged(s.out) as stage:
            next_recording(stage / "next_recording.mcap", m, joints, kinds, seed=s.seed)
        data["next_recording"]["commands"] = "next_recording.mcap"
    except UserError as error:
        d.notes.append(f"no commands for the next recording: {error}")


def _choice(d: Diagnosis, s: Settings, m: Mechanism, outcomes, f: dict, rivals: list[str]):
    """The motions on which the finding's hypotheses disagree most; None where they cannot be simulated or planned."""
    for case, search, outcome in outcomes:
        if case.joint not in f["where"]["joints"] or not outcome.best.members:
            continue
        other = next_experiment.rival_of(search, outcome, f["effect"], rivals[1] if len(rivals) > 1 else None)
        if other is None:
            return None
        try:
            choice = next_experiment.choose(m, search, outcome.best, other, s.seed)
        except UserError as error:
            d.notes.append(f"no motion could be planned: {error}")
            return None
        return choice if choice.scores else None
    return None


def _next_touch(d: Diagnosis, s: Settings, m: Mechanism, f: dict, recordings: Sequence[Any]) -> None:
    """The presses again, as they were sent, with what was missing: nothing else is known to be safe against the
    object."""
    names = " from ".join(dict.fromkeys(f["indistinguishable"] or [f["effect"]]))
    why = (
        f"to tell {names} on {place(f)}: {entry(f).experiment}; the same commands, with /external_force of a load "
        "cell recorded beside /tactile"
    )
    d.data["next_recording"] = {"why": why, "commands": None}
    pads = {w["recording"] for w in f["when"]}
    sent = [r for r in recordings if r.path.name in pads and len(r.commands)]
    if not sent:
        return
    from dexsim.recording.writer import Writer

    best = max(sent, key=lambda r: sum(w["end"] - w["start"] for w in f["when"] if w["recording"] == r.path.name))
    meta = {k: v for k, v in best.meta.items() if k in ("robot", "gravity")} | {
        "source": "sim",
        "effort_is": "none",
        "effort_sign": "+1",
        "notes": f"commands to send, not a measurement: those of {best.path.name}",
    }
    with outputs.staged(s.out) as stage:
        with Writer(stage / "next_recording.mcap", best.joints, meta, start_ns=1_000_000_000) as w:
            for t, row in zip(best.commands.t, best.commands.value, strict=True):
                w.add_command(float(t), row)
    d.data["next_recording"]["commands"] = "next_recording.mcap"
