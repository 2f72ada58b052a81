"""From the search's answers to the diagnosis: findings with their doubts, the verdict and its words, the fitted servo
and model, what was not considered."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import mujoco
import numpy as np

from dexsim.actuator.table import ServoTable
from dexsim.console.tables import number
from dexsim.gap import locate
from dexsim.gap.effects import Effect
from dexsim.gap.effects.body import add_armature
from dexsim.gap.effects.catalogue import EFFECTS, TOUCH_EFFECTS, entry, modelled
from dexsim.gap.finding import Finding, Verdict
from dexsim.gap.inquiry import Diagnosis, Judged, Settings, TouchResult
from dexsim.gap.judge import confidence, held_out
from dexsim.gap.judge.full_model import BELIEVED, WHOLE, Candidate, Written, files
from dexsim.gap.judge.handed_on import earned, missing_of, model_changes, servo_changes, values_of, widen
from dexsim.gap.judge.held_out import rms
from dexsim.gap.judge.joint_answer import JointAnswer, nuisances
from dexsim.gap.read.inputs import SIGN
from dexsim.gap.rules import JUDGE, SEARCH
from dexsim.gap.search import baseline, logged_torque, ringing
from dexsim.gap.search.fit import intervals
from dexsim.gap.search.hypotheses import unknown
from dexsim.gap.search.search import Trial, widened
from dexsim.recording.mechanism import Mechanism


@dataclass(frozen=True)
class Noise:
    """The noise floor of the position error: over all joints [rad or m], where it comes from (repeats, split or
    quantum), of each joint, and by run and joint where that motion was repeated; lowered: the joints whose floor is
    what repeats differ by beyond what was found."""

    floor: float
    how: str
    joints: dict[str, float]
    motions: dict[int, dict[str, float]] = field(default_factory=dict)
    lowered: tuple[str, ...] = ()

    def of(self, runs: Sequence[int]) -> dict[str, float]:
        """Return the floor of each joint over these runs [rad or m]: of each its own repeats', where it has some."""
        each = [self.motions.get(i, self.joints) for i in runs] or [self.joints]
        return {j: rms(np.square([x[j] for x in each])) for j in self.joints}

    def at_most(self, left: dict[str, float]) -> Noise:
        """Return the floor, where repeats differ by what was found (a drive that is warmer in one of them): what they
        differ by beyond it [rad or m, by joint] is then less, and is the floor."""
        lower = {j: x for j, x in left.items() if JUDGE.within * x < self.joints[j]}
        if not lower:
            return self
        joints = self.joints | lower
        floor = float(np.sqrt(np.mean(np.square(list(joints.values())))))
        return Noise(min(floor, self.floor), self.how, joints, self.motions, tuple(lower))


def into_diagnosis(
    d: Diagnosis,
    s: Settings,
    answers: Sequence[JointAnswer],
    kept: held_out.Split,
    noise: Noise,
    channel: list[Finding],
    plains: Sequence[baseline.Baseline],
    written: Written,
    refused: dict[str, str],
) -> None:
    """The joints into a diagnosis that is empty but for its notes and its mechanism.

    answers: of each joint, judged and located; channel: findings about signals, of all joints; plains: the plain model
    of each joint; written: what is written of each; refused: of `candidates`. (One long list of steps: each needs what
    those before it found.)
    """
    data, notes, m = d.data, d.notes, d.mechanism
    assert m is not None  # that of the answers
    findings: list[Finding] = []
    for a in answers:
        joint = a.case.joint
        findings += a.found
        d.evidence += a.evidence
        d.joints[joint] = a.numbers
        d.mae |= {(joint, name): v for name, v in a.mae().items()}
        d.outcomes.append(a.outcome)
        data["nuisance"] |= a.nuisance
        data["unexplained"]["depends_on"] += a.depends_on
        if (curve := a.curve()) is not None:
            d.curves.append(curve)
    d.spots = locate.control([x for a in answers for x in a.spots])
    rings = {a.case.joint: x for a in answers if (x := _rings(a)) > SEARCH.least}
    d.ringing = frozenset(rings)
    refuted = _take_back(d, answers, findings, rings)
    if noise.how == "repeats":
        found = [a for a in answers if a.found and a.case.joint not in refuted]
        noise = noise.at_most({a.case.joint: a.floor_beyond() for a in found})
    if noise.lowered:
        notes.append(
            f"noise floor of {', '.join(noise.lowered)}: what recordings of the same commands differ by beyond what "
            "was found"
        )
    data["noise_floor"] = {
        "position_rad": float(noise.floor),
        "how": noise.how,
        "joints": {k: float(v) for k, v in noise.joints.items()},
        "recordings": {kept.runs[i].name: {k: float(v) for k, v in x.items()} for i, x in noise.motions.items()},
    }
    findings = [f for f in findings if EFFECTS[f.effect].effort_only or not set(f.joints) & refuted]
    for joint in _shown_there_alone(d.joints, findings) if s.held_out else ():
        v = d.joints[joint]
        notes.append(
            f"{joint}: the recordings held out are missed by {1e3 * v['before']:.3g} mrad, those that were fitted by "
            f"{1e3 * v['fitted']:.3g}: "
            "something shows there alone, and what is held out is not fitted. Give them as recordings= too, with "
            "others held out"
        )
    d.written = written
    refused = refused | {
        a.case.joint: written.reason(a.case)
        for a in answers
        if written.beaten(a.case.joint, max(a.case.sigma, noise.floor))
    }
    _judged_by_ringing(d, rings)
    _not_better(d, refused)
    findings.sort(key=lambda f: -_weight(f, rings))
    findings = _doubts(d, findings, [f for f in channel if not _elsewhere(f, kept)])
    _hand_on(d, m, answers, findings)
    data["baseline"] = baseline.overall(plains, [j for j, name in written.chosen.items() if name == "plain"])
    notes += baseline.stopped(data["baseline"])
    findings = _linkages(findings, answers)
    quiet = {a.case.joint for a in answers if rms(a.before) <= JUDGE.within * noise.joints[a.case.joint]}
    # that says nothing of what is wrong with the reading of the effort alone
    findings = [f if EFFECTS[f.effect].effort_only else held_out.unneeded(f, quiet) for f in findings]
    d.findings = sorted(channel, key=lambda f: -f.confidence) + findings
    d.judged = _judged(answers, kept, refuted, s.seed, len(quiet) == len(answers), noise)
    notes += d.judged.loud


def _judged_by_ringing(d: Diagnosis, rings: dict[str, float]) -> None:
    """What was found on joints that ring by themselves, of which it takes away a share of what is missed of that
    (`rings`): as sure as its share of the bootstraps and what stays make it, and doubted, since no free run keeps step
    with it."""
    for e in d.evidence:
        if e.joint in rings and EFFECTS[e.effect].rings:
            e.left = 1.0 - rings[e.joint]
            e.reasons = ["the joint rings by itself as it does in what was held out, but no free run keeps step"]
            e.confidence = min(e.share * confidence.kept_of(e.left), JUDGE.doubted)


def _not_better(d: Diagnosis, worse: dict[str, str]) -> None:
    """Doubts what was found on joints that a plain model follows better, or of which a recorded motion says that it
    cannot be."""
    for joint, reason in worse.items():
        d.notes.append(f"{joint}: {reason}; what was fitted is not handed on")
        for e in d.evidence:
            if e.joint == joint and not EFFECTS[e.effect].effort_only:
                e.reasons.append(reason)
                e.confidence = min(e.confidence, JUDGE.hinted)


def candidates(
    answers: Sequence[JointAnswer],
    plains: Sequence[baseline.Baseline],
    told: Mapping[str, logged_torque.Told],
    joints: Sequence[str],
) -> tuple[dict[str, list[Candidate]], dict[str, str]]:
    """Return (of each joint the ways in which it may be written, joints of which what was found is none of them, with
    the reason). told: friction that the recorded torque tells, which goes over each; joints: of the mechanism.

    Not what a recorded motion forbids. No free run keeps step with a joint that rings by itself: of it what was found
    is written, unless the error of what was held out surely rises by it. That explains an error that does not fall, not
    one that does nothing but rise."""
    out: dict[str, list[Candidate]] = {}
    refused: dict[str, str] = {}
    by = {b.joint: b for b in plains}
    for a in answers:
        case, plain = a.case, by.get(a.case.joint)
        rings = _rings(a) > SEARCH.least
        trials = {"refitted": (a.none, a.before)} | ({"found": (a.best, a.after)} if a.best.members else {})
        given = [Candidate(BELIEVED, rms(a.before) if plain is None else plain.error_before, lambda table, spec: [])]
        for name, (trial, squares) in trials.items():
            sizes = values_of(trial)
            reasons = [x.effect.impossible(sizes[x.id], case) for x in trial.members]
            reason = next(filter(None, reasons), "") or baseline.forbidden(case, trial, a.kept.train)
            if rings and name == "found" and held_out.gain_interval(a.before, a.after, a.t)[1] < 0:
                k, unit = 1e3, "mm" if case.scales.slide else "mrad"
                reason = (
                    f"what was held out is missed by {k * rms(a.before):.3g} {unit} without what was found and, "
                    f"whichever stretches had been recorded, by more with it ({k * rms(a.after):.3g} {unit}), though "
                    "it rings as the joint does"
                )
            if reason:
                refused |= {case.joint: reason} if trial is a.best or not a.best.members else {}
            elif rings and name == "found":
                given = []
            for whole in () if reason else ("", WHOLE):
                write = _write(a, trial, joints, bool(whole))
                given.append(Candidate(name + whole, rms(squares), write, missing_of(case, trial)))
        if plain is not None and not (rings and given[-1].found):
            given.append(Candidate("plain", plain.error, partial(baseline.write, plain)))
        if case.joint in told:
            given = [replace(c, write=told[case.joint].over(c.write)) for c in given]
        out[case.joint] = given
    return out, refused


def _write(
    a: JointAnswer, trial: Trial, joints: Sequence[str], whole: bool
) -> Callable[[ServoTable, mujoco.MjSpec], list[str]]:
    """Return what writes a fitted hypothesis of a joint, with intervals, into the files' content; whole: all of it that
    they have a place for."""
    found = trial is a.best
    told = intervals(trial.fit, a.search.blocks, huber=a.search.r.huber)
    bounds = a.bounds if found else widened(a.search, trial, told)

    def write(table: ServoTable, spec: mujoco.MjSpec) -> list[str]:
        servo_changes(table, a.case, trial, bounds, joints, whole)
        said = list(model_changes(spec, a.case, trial, values_of(trial)))
        factor = next((x for p, x in zip(trial.fit.params, trial.fit.x, strict=True) if p.key == "inertia"), 1.0)
        if whole and factor != 1.0:
            said.append(add_armature(spec, a.case.joint, float(factor - 1) * a.case.scales.inertia))
        return said

    return write


def _rings(a: JointAnswer) -> float:
    """Share of what is missed of how a joint rings by itself in what was held out that what was found takes away; 0
    where the error there is lower with it anyway."""
    if _less(rms(a.after), rms(a.before)):
        return 0.0
    return ringing.shown(a.search, a.outcome, a.kept.test, a.kept.span_test)


def _take_back(
    d: Diagnosis, answers: Sequence[JointAnswer], findings: list[Finding], rings: dict[str, float]
) -> set[str]:
    """Return joints whose findings did not help on what was held out: they keep none of them, and are left as they were
    believed. rings: of `_rings`, by joint: no free run keeps step with those."""
    refuted = set()
    for a in answers:
        joint = a.case.joint
        mine = [f for f in findings if joint in f.joints and not EFFECTS[f.effect].effort_only]
        v = d.joints[joint]
        if not mine or joint in rings or _less(v["after"], v["before"]):
            continue
        refuted.add(joint)
        d.notes += [
            f"{f.effect} on {joint} earned its place on the training conditions but not on what was held out; not "
            "claimed"
            for f in mine
        ]
        d.data["nuisance"] = {
            key: x for key, x in d.data["nuisance"].items() if not key.endswith(f"@{joint}")
        } | nuisances(joint, a.none)
        v["after"] = v["before"]
    return refuted


def _less(a: float, b: float) -> bool:
    """Return whether an error (rms) is less than another, the squares of which do not tie."""
    return a**2 < (1 - SEARCH.tie) * b**2


def _hand_on(d: Diagnosis, m: Mechanism, answers: Sequence[JointAnswer], findings: list[Finding]) -> None:
    """The fitted servo and model; what is not sure reaches towards what was believed."""
    assert d.written is not None  # as into_diagnosis has it
    choice = {a.case.joint: d.written.candidate(a.case.joint) for a in answers}
    d.servo, d.model_spec, changed = files(m, [a.case for a in answers], choice)
    d.notes += changed
    if not changed:
        d.model_spec = None
    d.untrained = sorted(x for c in choice.values() for x in c.missing)
    members = {
        (a.case.joint, mm.id): (a.case, mm)
        for a in answers
        for mm in a.outcome.best.members
        if choice[a.case.joint].found
    }
    for f in findings:
        joint, effect = f.joints[0], f.effect
        if (
            f.confidence < JUDGE.sure
            and (joint, effect) in members
            and widen(d.servo, *members[joint, effect], f.confidence, earned(f))
        ):
            d.notes.append(
                f"{effect} on {joint} is not sure: in servo.yaml its range reaches towards what was believed"
            )


def _judged(
    answers: Sequence[JointAnswer], kept: held_out.Split, refuted: set[str], seed: int, quiet: bool, noise: Noise
) -> Judged:
    """Return errors over all joints on what was held out."""
    slide, how = all(x.case.constants.slide for x in answers), kept.how
    names = [kept.runs[i].name for i in kept.test]

    def position(on: Sequence[np.ndarray], how: str) -> dict[str, Any]:
        times = [x.t[k] for x, k in zip(answers, on, strict=True)]
        before = [x.before[k] for x, k in zip(answers, on, strict=True)]
        after = [(x.before if x.case.joint in refuted else x.after)[k] for x, k in zip(answers, on, strict=True)]
        was, left = (held_out.rms_interval(squares, times, seed) for squares in (before, after))
        return _error("position_rmse_m" if slide else "position_rmse_rad", was, left, names, how)

    all_of_it, on = [np.ones(len(x.t), bool) for x in answers], [x.shown for x in answers]
    shown = None
    if len(answers) and 0.5 < np.mean(np.concatenate(on)) < 1.0:  # most of it, but not all
        floors = [JUDGE.within * noise.joints[x.case.joint] for x in answers]
        still = all(rms(x.before[k]) <= f for x, k, f in zip(answers, on, floors, strict=True))
        shown = position(on, f"{how}; without the regimes that are not judged"), still
    both, effort = ((x.effort_before, x.effort_after) for x in answers), None
    if sensed := [(b, a) for b, a in both if b is not None and a is not None]:
        eb, ea = (rms(np.concatenate(xs)) for xs in zip(*sensed, strict=True))
        effort = _error("effort_rmse_Nm", (eb, eb, eb), (ea, ea, ea), names, how)
    structured = any(
        x.outcome.none.fit.loss > JUDGE.within**2 and (len(x.outcome.scanned) > 0 or x.case.moved) for x in answers
    )
    loud = _loud(answers, kept, noise, refuted)
    far = any(rms(x.before) > JUDGE.far * noise.joints[x.case.joint] for x in answers)
    step = 0.0 if far else rms(np.square([x.case.quantum for x in answers]))
    return Judged(position(all_of_it, how), effort, None, structured, quiet, loud, shown, step)


def _loud(answers: Sequence[JointAnswer], kept: held_out.Split, noise: Noise, refuted: set[str]) -> tuple[str, ...]:
    """Return the recordings held out, joint by joint, that are surely missed by more than their own repeats differ
    by, with what was found of the joint where it keeps that, in words."""
    said = []
    for a in answers:
        squares = a.after if a.found and a.case.joint not in refuted else a.before
        for i in kept.test:
            on = a.case.plant.run_of[a.rows] == i
            own = noise.motions.get(i, {}).get(a.case.joint, math.inf)
            left, low, _ = held_out.rms_interval([squares[on]], [a.t[on]])
            if low > JUDGE.within * own:
                said.append(
                    f"{kept.runs[i].name}: {a.case.joint} is missed by {1e3 * left:.3g} mrad, by {1e3 * own:.2g} do "
                    "repeats of it differ"
                )
    return tuple(said)


def _error(
    name: str, before: Sequence[float | None], after: Sequence[float | None], recordings: Sequence[str], how: str
) -> dict[str, Any]:
    """Return an entry of `held_out`. before, after: value, low and high."""
    errors = {"before": before[0], "after": after[0], "before_low": before[1], "before_high": before[2]}
    return {"recordings": list(recordings), "error": name} | errors | {
        "after_low": after[1], "after_high": after[2], "how": how}  # fmt: skip


def _shown_there_alone(joints: dict[str, dict[str, float]], findings: list[Finding]) -> list[str]:
    """Return joints without a finding of which what was held out is missed by far more than the noise, and what was
    fitted is not: what is missing (a limit, a sag) shows there alone, and what is held out must not be fitted."""
    found = {j for f in findings for j in f.joints}
    return [j for j, v in joints.items() if j not in found and v["before"] > JUDGE.far * v["sigma"] >= v["fitted"]]


def _doubts(d: Diagnosis, findings: list[Finding], channel: list[Finding]) -> list[Finding]:
    """Return the joints' findings (the weightiest first), as sure as what they and the signals say of each other
    leaves them."""
    by = {(e.joint, e.effect): e for e in d.evidence}
    mine = [by[f.joints[0], f.effect] for f in findings]
    shakes = [e for e in mine if e.joint in d.ringing and EFFECTS[e.effect].rings]  # no window keeps step with it
    confidence.share_odds([e for e in mine if e not in shakes], sum(len(x.scanned) for x in d.outcomes))
    coupled = {f.joints[0]: f.parameters["from_joint"]["value"] for f in findings if EFFECTS[f.effect].couples}
    signs = {j for f in channel if f.regime.startswith(SIGN) for j in f.joints}
    others = {j for f in channel if not f.regime.startswith(SIGN) for j in f.joints}
    confidence.of_the_whole(mine, coupled, signs | others, signs - others)
    d.notes += [f"{e.effect} on {e.joint} is not sure: {reason}" for e in mine for reason in e.reasons]
    d.evidence = mine
    return [replace(f, confidence=round(e.confidence, 3)) for f, e in zip(findings, mine, strict=True)]


def _elsewhere(channel: Finding, kept: held_out.Split) -> bool:
    """Return whether a signal is wrong only where its joint is not judged, as one of those left out of a recording or
    with all of it: that casts no doubt on what the other recordings tell of it."""
    never = frozenset.intersection(*(run.left_out for run in kept.runs))  # told of by none
    left_out = {(run.name, joint) for run in kept.runs for joint in run.left_out - never}
    judged = {run.name for run in kept.runs}
    return bool(channel.when) and all(
        w["recording"] not in judged or (w["recording"], j) in left_out for w in channel.when for j in channel.joints
    )


def _linkages(findings: list[Finding], answers: Sequence[JointAnswer]) -> list[Finding]:
    """Return the findings with every linkage once: two joints of which each is dragged by the other are its two ends.
    Kept is the end that is dragged, where one of them feels only the pull; the name is as sure as its surer end."""
    pulled = {
        a.case.joint
        for a in answers
        for mm in a.outcome.best.members
        if mm.effect.couples and mm.variant.params[0].columns == ("reaction",)
    }
    ends = {(f.joints[0], f.parameters["from_joint"]["value"]): f for f in findings if EFFECTS[f.effect].couples}
    out = list(findings)
    for (joint, other), f in ends.items():
        second = ends.get((other, joint))
        if second is None or f not in out or second not in out:
            continue
        first, second = (second, f) if joint in pulled and other not in pulled else (f, second)
        place = min(out.index(first), out.index(second))
        out = [x for x in out if x is not first and x is not second]
        sure = max(first.confidence, second.confidence)
        out.insert(place, replace(first, joints=[*first.joints, *second.joints], confidence=sure))
    return out


def _weight(f: Finding, rings: dict[str, float]) -> float:
    """Return how much of the error on what was held out a finding removes; of a joint that rings (`_rings`), of how it
    rings."""
    h, share = f.held_out, rings.get(f.joints[0]) if f.joints else None
    return (h["before"] - h["after"] if share is None else share * h["before"]) if h else 0.0


def add_behind(d: Diagnosis, findings: list[Finding], by_torque: Sequence[logged_torque.IdentifiedJoint]) -> None:
    """What the recorded motor torque names beyond what it was believed to be, into the diagnosis; judged by the torque
    that is left on the recording held out, where the loop's own error shows nothing."""
    taken = {(f.effect, *f.joints) for f in d.findings}
    findings = [f for f in findings if (f.effect, *f.joints) not in taken]
    d.findings += findings
    sure = [f for f in findings if f.confidence >= JUDGE.firm]
    judged = [x for x in by_torque if any(x.case.joint in f.joints for f in sure)]
    if not judged:
        return
    # not what the catalogue has no name for
    last = [next(n for n in reversed(x.inverse.named) if n.effect) for x in judged]
    b, a = (
        float(np.sqrt(sum(y**2 for y in ys)))
        for ys in ([x.inverse.named[0].before for x in judged], [n.after for n in last])
    )
    assert d.judged is not None  # the joints come first
    d.judged.torque = _error(
        (sure[0].held_out or {})["error"],
        (b, None, None),
        (a, None, None),
        judged[0].judges,
        "the motor torque recorded there, from the motion, with what was fitted elsewhere",
    )


def _followed(d: Diagnosis, joint: str) -> bool:
    """Return whether findings of at least a half follow a joint to its noise, where it was fitted and where it was kept
    out."""
    named = any(f.confidence >= JUDGE.firm and joint in f.joints and f.held_out
                for f in d.findings)  # fmt: skip
    fitted = any(x.joint == joint and x.best.fit.loss <= JUDGE.within**2 for x in d.outcomes)
    return named and fitted and d.joints[joint]["after"] <= JUDGE.within * d.joints[joint]["sigma"]


def claim_push(d: Diagnosis, pushes: Sequence[logged_torque.Push]) -> None:
    """Puts the findings into the diagnosis, and takes from it what was claimed of these joints beside signals: their
    motion had another cause. Not of a joint that is followed to the noise, in what was fitted and in what was held out,
    by what was found of it, nor of one that rings by itself as that does: nothing is left that could push."""
    followed = {p.joint for p in pushes if not p.cut and (p.joint in d.ringing or _followed(d, p.joint))}
    d.notes += [
        f"{joint}: its torque fits no inertia, gravity or friction, but what was found does: nothing from outside "
        "pushes it"
        for joint in sorted(followed)
    ]
    pushes = [p for p in pushes if p.joint not in followed]
    if not pushes:
        return
    joints = {p.joint for p in pushes if not p.cut}
    kept = [
        f for f in d.findings if f.effect not in EFFECTS or EFFECTS[f.effect].effort_only or not joints & set(f.joints)
    ]
    d.notes += [
        f"{f.effect} on {', '.join(f.joints)} is not claimed: something outside moved the joint, or "
        "its recorded torque is not its own"
        for f in d.findings
        if f not in kept
    ]
    d.findings = [p.finding() for p in pushes] + kept


# -- the verdict ------------------------------------------------------------------------------------------------------


def decide(d: Diagnosis) -> None:
    """The verdict and its sentence: the last step, after everything was found of signals, joints, pushes and touch."""
    verdict = _decided(d)
    verdict.into(d.data)
    d.findings = list(verdict.findings)
    if d.touch is not None:  # in their own order
        settled = {(f.effect, *f.taxels): f for f in d.findings}
        d.touch.findings = [settled[f.effect, *f.taxels] for f in d.touch.findings]
    tell(d)


def tell(d: Diagnosis) -> None:
    """Write the verdict's sentence, again where the files were replayed since: what they leave is its number then."""
    if d.data["verdict"] != "unusable":
        d.sentence = sentence(d.data, d, _floor(d)) + _unjudged(d.data, d.judged)


def _decided(d: Diagnosis) -> Verdict:
    """Return which findings are hints, the verdict with the error that it goes by, and how much of the gap is left.
    Nothing else decides any of these."""
    felt = d.touch
    mine, of_touch = held_out.settle(d.findings), [] if felt is None else held_out.settle(felt.findings)
    joints, error = ("unusable", None) if d.judged is None else _of_joints(mine, d.judged, _floor(d))
    if joints == "none":
        mine = [held_out.whispered(f) if f.held_out and not f.hint and not _by_torque(f) else f for f in mine]
    depends = [] if joints in ("none", "explained") else list(d.data["unexplained"]["depends_on"])
    word, touch = joints, None if felt is None else _of_touch(felt, of_touch)
    if touch == "none" and felt is not None and felt.before is not None:
        of_touch = [f if f.hint else held_out.whispered(f) for f in of_touch]
    if felt is not None and touch is not None:
        word = _of_both(joints, touch)
        depends += felt.depends_on if word not in ("none", "explained") else []
        named = [f for f in mine if not f.wrong_signal and not f.hint]
        felt_alone = not named and (joints == "none" or any(not f.hint for f in of_touch)) and touch != "none"
        if joints == "unusable" or (felt_alone and felt.before is not None):
            error = _error_of_touch(felt)
    of_touch = sorted(of_touch, key=lambda f: -f.confidence)
    # hints come last, the surest first: what they remove decides nothing
    findings = tuple(sorted([*mine, *of_touch], key=lambda f: (f.hint, -f.confidence * f.hint)))
    left = None if error is None else _left_of_gap(d, error)
    return Verdict(word, findings, error, left, tuple(depends))


def _unjudged(data: dict[str, Any], by: Judged | None) -> str:
    """Return which regimes only what was held out visits, where they are left out of the verdict or may be why it is
    unknown."""
    regimes = data["held_out"].get("not_judged")
    left_out = by is not None and by.shown is not None and data["held_out"]["how"] == by.shown[0]["how"]
    if not regimes or not (left_out or data["verdict"] == "unknown"):
        return ""
    return f" Not judged: {', '.join(regimes)}; what was held out visits it and no recording that is fitted does."


def _floor(d: Diagnosis) -> float:
    """Read the joints' position error [rad or m]; 0 where none is judged."""
    return d.data["noise_floor"]["position_rad"] or 0.0


def _of_joints(findings: Sequence[Finding], by: Judged, floor: float) -> tuple[str, dict[str, Any]]:
    """Return the word for the joints, and the error that it goes by: that of the torque where nothing but that names
    anything, that of the effort where nothing but its reading is wrong, of the motion otherwise."""
    behind = [f for f in held_out.firm(findings) if by.torque is not None and _by_torque(f)]
    named = [f for f in held_out.firm(findings) if not _by_torque(f)]
    if behind and not named and by.torque is not None:
        b, a = by.torque["before"], by.torque["after"]
        part = any(map(held_out.lowers, behind)) and a < (1 - JUDGE.removed) * b
        return ("partly_explained" if part else "unknown"), by.torque
    if named and by.effort is not None and all(EFFECTS[f.effect].effort_only for f in named):
        if any(map(held_out.lowers, named)):
            return "explained", by.effort
    p, of_motion = by.position, [f for f in findings if not _by_torque(f)]
    word_of = lambda e, quiet: held_out.verdict(  # noqa: E731
        of_motion, floor, e["before"], e["before_low"], e["after"], by.structured, quiet, bool(by.loud), by.step
    )
    word = word_of(p, by.quiet)
    if word == "unknown" and by.shown is not None:  # what no fitted recording shows cannot be known: it is not judged
        told = word_of(*by.shown)
        if told != "unknown":
            word, p = told, by.shown[0]
    return word, p


def _by_torque(f: Finding) -> bool:
    """Return whether a finding was judged by its torque alone (`add_behind`)."""
    return bool(f.held_out) and (f.held_out or {}).get("error", "").startswith("effort")


def _of_touch(felt: TouchResult, findings: Sequence[Finding]) -> str | None:
    """Return the word for touch alone; None where it was not judged."""
    named = [f for f in findings if not f.hint]
    if felt.before is None:
        return "explained" if named else None
    assert felt.floor is not None and felt.after is not None  # with a force predicted
    seen = {"before": 1.0, "after": 0.0}  # what is constant was seen, not fitted
    given = [replace(f, confidence=1.0, held_out=f.held_out or seen) for f in named]
    word = held_out.verdict(given, felt.floor, felt.before[0], felt.before[1], felt.after[0], felt.structured)
    return "partly_explained" if word == "explained" and felt.structured else word


def _of_both(joints: str, touch: str) -> str:
    """Return the word for joints and touch."""
    if joints in ("unusable", "none"):
        return touch
    return joints if touch in ("none", joints) else "partly_explained"


def _error_of_touch(felt: TouchResult) -> dict[str, Any]:
    if felt.before is None or felt.after is None:
        return _error("tactile_rmse_N", (None,) * 3, (None,) * 3, [], "")
    return _error("tactile_rmse_N", felt.before, felt.after, felt.recordings, "presses held out of the fit")


def _left_of_gap(d: Diagnosis, error: dict[str, Any]) -> float | None:
    """Share of the gap between the error before and the floor that is left."""
    assert d.judged is not None or d.touch is not None  # one of them was judged
    if d.judged is not None and error is d.judged.torque:
        return round((error["after"] / error["before"]) ** 2, 4)
    if error["error"].startswith("tactile"):
        floor = d.touch.floor if d.touch is not None else None
    else:  # of the effort's reading no gap is known: the motion's
        floor, error = _floor(d), d.judged.position if d.judged is not None else error
    b, a = error["before"], error["after"]
    if b is None or floor is None:
        return None
    gap = b**2 - floor**2
    return round(float(np.clip((a**2 - floor**2) / gap, 0.0, 1.0)), 4) if gap > 0 and b > JUDGE.within * floor else 0.0


# -- what is not considered -------------------------------------------------------------------------------------------
# Effects that are not considered, each with the reason: what the mechanism has not, or the recordings do not carry.


def not_considered(cases: Sequence, felt: TouchResult, allowed: Collection[str] | None) -> dict[str, str]:
    """Return effect id (and kind of it, where others of it are considered) -> why it was not considered on any joint or
    pad (or on which), in the catalogue's order.

    cases: `plant.case.Case`."""
    out: dict[str, str] = {}
    moved = [c for c in cases if c.moved]
    for e, x in EFFECTS.items():
        if allowed is not None and e not in allowed:
            out[e] = "not asked for (effects=)"
            continue
        if not moved:
            out[e] = "no joint is judged" if not cases else "no joint moves"
            continue
        if said := _by_joint({c.joint: x.unseen(c.scales) for c in moved}):
            out[e] = said
        kinds = {c.joint: x.without(c.scales) for c in moved}
        for kind in dict.fromkeys(k for given in kinds.values() for k in given):
            out[f"{e} {kind}"] = _by_joint({j: given.get(kind, "") for j, given in kinds.items()})
    touch = (
        "no /tactile is recorded"
        if not felt.tactile
        else "nothing is touched"
        if not felt.contact
        else "no force could be predicted"
        if felt.before is None
        else ""
    )
    for e in TOUCH_EFFECTS:
        if e in EFFECTS:
            continue
        if allowed is not None and e not in allowed:
            out[e] = "not asked for (effects=)"
        elif touch and not any(f.effect == e for f in felt.findings):
            out[e] = touch
    return out


def _by_joint(given: dict[str, str]) -> str:
    """Return reasons by joint, said once where they are one; joints without one are left out."""
    lacking = {j: r for j, r in given.items() if r}
    if len(lacking) == len(given) and len(set(lacking.values())) == 1:
        return next(iter(lacking.values()))
    on = "" if len(lacking) == len(given) else "on "
    return "; ".join(f"{on}{j}: {r}" for j, r in lacking.items())


def not_fitted(cases: Sequence) -> list[str]:
    """Return columns that the servo's file says are unknown and that are not refitted, by joints: what is done
    instead."""
    by: dict[str, list[str]] = {}
    for c in cases:
        for name in c.unknown:
            if unknown(name, c.scales) is None:
                by.setdefault(name, []).append(c.joint)
    return [
        f"{name} is unknown on {', '.join(joints)} and cannot be fitted to these recordings by itself: it is taken as "
        "absent"
        for name, joints in by.items()
    ]


# -- the verdict in words ----------------------------------------------------------------------------------------------


def sentence(data: dict, d: Diagnosis, floor: float | None) -> str:
    """Return the verdict in one or two sentences."""
    h = data["held_out"]
    metric = h["error"]
    effort, unit = metric.startswith("effort"), unit_of(metric)
    if unit == "mN" and not effort:
        floor = data["noise_floor"].get("tactile_N")
    written = h.get("replayed") if metric.startswith("position") else None
    before, after = 1e3 * (h["before"] or 0), 1e3 * (written["error"] if written else h["after"] or 0)
    engine = "replayed in the engine that trains"
    replayed = f" The files as written, {engine}, leave {number(after)} {unit}." if written else ""
    limit = f"the floor is {1e3 * floor:.2g}" if floor is not None and not effort else ""
    if limit and d.judged is not None and d.judged.step and data["verdict"] == "none":
        limit += f", a step of the encoders {1e3 * d.judged.step:.2g}"
    if limit and d.judged is not None and d.judged.loud and after < 1e3 * (floor or 0.0):  # that of all motions
        limit = "repeats of the same motion differ by less"
    named = [f for f in d.findings if modelled(f) and not f.hint]
    bad = [f for f in d.findings if f.wrong_signal and not f.hint]
    prefix = _first_of_all([f for f in d.findings if not f.hint], bad, d)
    if data["verdict"] == "none":
        return (
            prefix + "Nothing in the catalogue is missing: the simulator follows "
            f"{_where_judged(h)} to {before:.2g} {unit}; {limit}.{replayed}"
        )
    if data["verdict"] == "explained" and not named and bad:
        return (
            prefix
            + f"Beside that nothing is missing: the simulator follows {_where_judged(h)} to {before:.2g} {unit}; "
              f"{limit}.{replayed}"
        )
    if not named:
        depends = (
            "; it depends on " + ", ".join(data["unexplained"]["depends_on"][:2])
            if data["unexplained"]["depends_on"]
            else ""
        )
        plain = baseline.left_by_what_is_handed_on(data["baseline"]) if metric.startswith("position") else None
        if written:
            of = "the files as written" if plain is None else "the plain model, as written"
            left = f"{number(after)} {unit} are left by {of}, {engine},"
        elif plain is not None:
            left = f"{number(1e3 * plain)} {unit} are left by the plain model, which is handed on,"
        else:
            left = f"{number(after)} {unit} are left"
        return prefix + f"Something is missing that no effect of the catalogue explains: {left} where {limit}{depends}."
    of = ""
    alone = {j for f in named for j in f.joints}
    # not thinned by joints that are well
    if len(alone) == 1 and len(d.joints) > 1 and metric.startswith("position") and alone <= set(d.joints):
        (joint,) = alone
        of, mine = " of that joint", d.joints[joint]
        before, after = 1e3 * mine["before"], 1e3 * (written["joints"] if written else {}).get(joint, mine["after"])
    said = prefix + _names(named, d)
    if h["before"] is None:
        return said
    it = "it" if len(named) == 1 else "them"
    found = f"the files as written, {engine}, leave" if written else f"with {it}, by"
    said += f" Without {it} simulation{of} is wrong by {number(before)} {unit}; {found} {number(after)} on "
    return said + _where_judged(h) + (f"; {limit}." if limit else ".")


def _where_judged(h: dict) -> str:
    """Return which recordings an error is of."""
    if str(h.get("how", "")).startswith(held_out.NOTHING):
        return "the recordings that were fitted (nothing that moves could be held out)"
    return "recordings not used for the fit"


def unit_of(metric: str) -> str:
    """Return the thousandth in which an error is told, of `held_out.error`."""
    ends = {"_N": "mN", "_Nm": "mN.m", "_m": "mm"}
    return next((unit for end, unit in ends.items() if metric.endswith(end)), "mrad")


def _first_of_all(findings: list[Finding], bad: list[Finding], d: Diagnosis) -> str:
    """Return what comes before the verdict: signals that are not what they say (`bad`), and pushes from outside."""
    said = (
        f"{len(bad)} signal{'s are' * (len(bad) > 1) or ' is'} not what {'they say' if len(bad) > 1 else 'it says'} "
        f"({bad[0].regime}). "
        if bad
        else ""
    )
    for f in findings:
        if entry(f) is not None and not modelled(f):
            where = spoken(f, d.mechanism)
            said += f"{where[:1].upper() + where[1:]} {words_of(f, d.mechanism)}{_size(f)}. "
    return said


def _names(named: list[Finding], d: Diagnosis) -> str:
    """Return the two largest effects, where they sit, and how many more there are."""
    parts = []
    for f in named[:2]:
        words = words_of(f, d.mechanism)
        others = " or ".join(x.replace("_", " ") for x in f.indistinguishable if x != f.effect)
        doubt = f", or it is {others}: these recordings cannot tell" if others else ""
        parts.append(f"{spoken(f, d.mechanism)} {words}{_size(f)}{doubt}")
    first = named[0].joints
    if not first or first[0] in spoken(named[0], d.mechanism)[1:]:
        parts[0] = parts[0][:1].upper() + parts[0][1:]
    left_out = len(named) - len(parts)
    more = f" ({left_out} more, below)" if left_out else ""
    return "; ".join(parts) + more + "."


ORDER = ("first", "second", "third", *(f"{n}th" for n in range(4, 40)))
FINGERS = {"thumb": "the thumb", "mid": "the middle finger", "pinky": "the little finger"}


def spoken(f: Finding, m: Mechanism | None) -> str:
    """Return where a finding sits as a person says it: a hand's joints by finger, another mechanism's by name."""
    if len(f.joints) != 1:
        return place(f, m)
    joint = f.joints[0]
    hand = None if m is None else m.whose
    owner = hand.finger_of_joint[hand.joints.index(joint)] if hand is not None and joint in hand.joints else -1
    if hand is None or owner < 0:
        return joint if "joint" in joint.lower() else f"joint {joint}"
    finger, number_ = hand.fingers[owner], hand.joints.index(joint)
    bends = number_ in finger.flexion
    alike = finger.flexion if bends else tuple(j for j in finger.joints if j not in finger.flexion)
    order = ORDER[alike.index(number_)] if bends or len(alike) > 1 else ""
    kind = " ".join(w for w in (order, "" if bends else "sideways", "joint") if w)
    return f"{FINGERS.get(finger.name, f'the {finger.name} finger')}'s {kind} ({joint})"


def words_of(f: Finding, m: Mechanism | None) -> str:
    """Return what an effect does, in words, with its direction where its size tells that."""
    joint, effect = next(iter(f.joints), None), entry(f)
    assert effect is not None  # what has words is of the catalogue
    if joint is None or not isinstance(effect, Effect):
        return effect.words
    believed = {}
    if m is not None and joint in m.joints:
        row = m.joints.index(joint)
        friction = float(np.ravel(m.spec.joint(joint).frictionloss)[0])
        believed = {"coulomb_friction": float(m.column("coulomb_friction")[row]) + friction}
        believed["torque_limit"] = float(m.column("torque_limit")[row])
    return effect.said(f, believed)


def place(f: Finding, m: Mechanism | None) -> str:
    """Return where a finding sits, in words."""
    if f.joints:
        return ", ".join(f.joints)
    if f.taxels and m is not None:
        pads = sorted({int(t.split(":")[0]) for t in f.taxels})
        count = len(f.taxels)
        fingers = " and ".join(m.sensors.names[p] for p in pads)
        return (
            f"the {fingers}'s pad"
            if count > 12 or "taxels" not in f.parameters
            else f"the {fingers}'s pad (taxel{'s' * (count > 1)} {', '.join(t.split(':')[1] for t in f.taxels)})"
        )
    return ", ".join(f.topics)


def _size(f: Finding) -> str:
    """Return the first parameter of a finding in words: degrees and millimetres where a person thinks in them."""
    name, p = next(iter(f.parameters.items()), (None, None))
    if name is None or p is None or p["value"] is None or isinstance(p["value"], str):
        return ""
    number = np.atleast_1d(p["value"])  # com and tilt are vectors, gains one a taxel
    if len(number) > 4:
        return f" ({name} {number.min():.2g} to {number.max():.2g})"
    if p["unit"] == "rad" and len(number) == 1:
        return f" ({name} {np.degrees(number[0]):.3g} degrees)"
    if p["unit"] == "s" and len(number) == 1:
        return f" ({name.replace('_', ' ')} {1e3 * number[0]:.3g} ms)"
    return (
        f" ({name.replace('_', ' ')} "
        f"{' '.join(f'{v:.3g}' for v in number)}{' ' + p['unit'] if p['unit'] not in ('1', '') else ''})"
    )
