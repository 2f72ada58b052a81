"""What to record next: the safe motion on which the leading hypotheses, as fitted, disagree most, or the presses with
what was missing, and the file of commands ready to send.

Candidates are the motions of `dexsim.recording.excitation` at the size that is safe. Both hypotheses are simulated over
each; what the refitted figures could make up for is taken out; what is left counts in units of the joint's noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dexsim import outputs
from dexsim.errors import UserError
from dexsim.gap.effects import Effect
from dexsim.gap.effects.catalogue import EFFECTS, entry, modelled, separating
from dexsim.gap.finding import Finding
from dexsim.gap.inquiry import Diagnosis, Settings
from dexsim.gap.judge.conclude import place
from dexsim.gap.plant.case import Case, build
from dexsim.gap.plant.columns import expand
from dexsim.gap.read import Run
from dexsim.gap.rules import JUDGE
from dexsim.gap.search.search import JointSearch, Outcome, SearchedJoint, Trial
from dexsim.recording import excitation
from dexsim.recording.excitation import Plan
from dexsim.recording.mechanism import Mechanism

KINDS = ("steps", "chirp", "triangles", "ladder", "holds")
RATE = 100.0  # Hz


def plan_next(
    d: Diagnosis, s: Settings, m: Mechanism, searched: Sequence[SearchedJoint] = (), recordings: Sequence[Any] = ()
) -> None:
    """What to record next, written ready to send where a safe plan exists."""
    data = d.data
    named = [f for f in d.findings if modelled(f)]
    unsure = [f for f in named if f.indistinguishable or f.confidence < JUDGE.sure]
    kinds, joints, why = None, None, ""
    if unsure and not unsure[0].joints:
        _next_touch(d, s, m, unsure[0], recordings)
        return
    if unsure:
        f = unsure[0]
        rivals = list(dict.fromkeys(f.indistinguishable or [f.effect, *(a["effect"] for a in f.alternatives[:1])]))
        joints = f.joints
        kinds = sorted({k for e in rivals for k in EFFECTS.get(e, Effect).motions})
        head = (
            f"to tell {' from '.join(rivals)} on {joints[0]}"
            if len(rivals) > 1
            else f"to make sure of {rivals[0]} on {joints[0]}"
        )
        experiment = separating(rivals) if all(r in EFFECTS for r in rivals) else EFFECTS[f.effect].experiment
        why = f"{head}: {experiment}"
        choice = _choice(d, s, m, searched, f, rivals)
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
        with outputs.staged(s.out) as stage:
            excitation.next_recording(stage / "next_recording.mcap", m, joints, kinds, seed=s.seed)
        data["next_recording"]["commands"] = "next_recording.mcap"
    except UserError as error:
        d.notes.append(f"no commands for the next recording: {error}")


def _choice(
    d: Diagnosis, s: Settings, m: Mechanism, searched: Sequence[SearchedJoint], f: Finding, rivals: list[str]
) -> Choice | None:
    """Return the motions on which the finding's hypotheses disagree most; None where they cannot be simulated or
    planned."""
    for x in searched:
        search, outcome = x.search, x.outcome
        if x.case.joint not in f.joints or not outcome.best.members:
            continue
        other = rival_of(search, outcome, f.effect, rivals[1] if len(rivals) > 1 else None)
        if other is None:
            return None
        try:
            choice = choose(m, search, outcome.best, other, s.seed)
        except UserError as error:
            d.notes.append(f"no motion could be planned: {error}")
            return None
        return choice if choice.scores else None
    return None


def _next_touch(d: Diagnosis, s: Settings, m: Mechanism, f: Finding, recordings: Sequence[Any]) -> None:
    """The presses again, as they were sent, with what was missing: nothing else is known to be safe against the
    object."""
    names = " from ".join(dict.fromkeys(f.indistinguishable or [f.effect]))
    effect = entry(f)
    assert effect is not None  # `modelled` says so
    why = (
        f"to tell {names} on {place(f, m)}: {effect.experiment}; the same commands, with /external_force of a load "
        "cell recorded beside /tactile"
    )
    d.data["next_recording"] = {"why": why, "commands": None}
    pads = {w["recording"] for w in f.when}
    sent = [r for r in recordings if r.path.name in pads and len(r.commands)]
    if not sent:
        return
    from dexsim.recording.writer import Writer

    best = max(sent, key=lambda r: sum(w["end"] - w["start"] for w in f.when if w["recording"] == r.path.name))
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


@dataclass
class Choice:
    """Kinds of motion, the best first, and by how many times the noise the hypotheses differ on each; chosen: what to
    record."""

    scores: dict[str, float]
    chosen: list[str]

    @property
    def text(self) -> str:
        """The choice in words."""
        ranked = sorted(self.scores.items(), key=lambda s: -s[1])
        if not self.settles:
            return (
                f"none settles it: the two differ by {ranked[0][1]:.1f} times the noise on {ranked[0][0]}, and by "
                "less on the others"
            )
        first = f"on {ranked[0][0]} the two differ by {ranked[0][1]:.1f} times the noise"
        return first + (f" ({', '.join(f'{k} {v:.1f}' for k, v in ranked[1:])})" if len(ranked) > 1 else "")

    @property
    def settles(self) -> bool:
        """Whether the best motion shows more than the noise."""
        return max(self.scores.values()) >= 1.0


def rival_of(search: JointSearch, outcome: Outcome, effect: str, rival: str | None) -> Trial | None:
    """Return the fitted hypothesis with `rival` in the place of `effect`; None for "without it" where no rival was
    fitted."""
    rest = {m.id for m in outcome.best.members} - {effect}
    if rival is not None:
        return search.fitted.get(frozenset({rival, *rest}))
    return search.fitted.get(frozenset(rest)) if rest else outcome.none


def choose(
    m: Mechanism, search: JointSearch, a: Trial, b: Trial, seed: int = 0, kinds: Sequence[str] = KINDS, most: int = 2
) -> Choice:
    """Return the motions of one joint that tell hypothesis a from b. Raises UserError where nothing safe can be
    planned."""
    case = search.case
    made = excitation.plan(m, [case.joint], list(kinds), seed, repeats=0)
    scores = disagreement(m, case, search, a, b, made)
    ranked = sorted(scores, key=lambda k: -scores[k])
    chosen = ranked[:1]
    # a second kind where the first alone may not settle it, or says nearly as much
    chosen += [k for k in ranked[1:most] if scores[ranked[0]] < JUDGE.settled or scores[k] > 0.7 * scores[ranked[0]]]
    return Choice(scores, chosen)


def disagreement(m: Mechanism, case: Case, search: JointSearch, a: Trial, b: Trial, p: Plan) -> dict[str, float]:
    """Return rms difference of the positions that two hypotheses predict on each kind of motion of a plan, over the
    joint's noise, with what the refitted figures of `a` could make up for taken out."""
    every = max(1, round(1 / RATE / float(p.run.t[1] - p.run.t[0])))
    t = p.run.t[::every]
    column = m.joints.index(case.joint)
    gravity = np.asarray(m.spec.option.gravity, float)
    joints = tuple(m.joints)
    run = Run("plan", joints, p.t, p.value, t, p.run.position[::every].copy(), m.table, gravity, counted=joints)
    run.smooth()
    there = build(m.spec.compile(), [run])[column]
    plant, windows = there.plant, there.plant.windows(None)
    guesses = [expand(plant, h.fit.params, h.fit.x[None], h.fixed)[0] for h in (a, b)]
    moves = []
    for i, q in enumerate(a.fit.params):
        if q.nuisance:
            x = a.fit.x.copy()
            x[i] = np.clip(x[i] + 0.05 * q.span * (1 if x[i] + 0.05 * q.span <= q.high else -1), q.low, q.high)
            guesses.append(expand(plant, a.fit.params, x[None], a.fixed)[0])
            moves.append(q)
    seen, _ = plant.simulate(np.stack(guesses), windows)
    difference = (seen[1] - seen[0]) / case.sigma
    J = ((seen[2:] - seen[0]) / case.sigma).T
    stamp = t[windows.sample_row]
    out: dict[str, float] = {}
    for kind in {s.kind for s in p.segments}:
        on = np.zeros(len(stamp), bool)
        for s in p.segments:
            if s.kind == kind:
                on |= (stamp >= s.start) & (stamp <= s.end)
        if on.sum() < 20:
            continue
        d = difference[on]
        if J.shape[1]:
            j = J[on]
            d = d - j @ np.linalg.solve(j.T @ j + 400.0 / 12 * np.eye(j.shape[1]), j.T @ d)
        out[kind] = float(np.sqrt(np.mean(np.minimum(np.abs(d), 1e4) ** 2)))
    return out
