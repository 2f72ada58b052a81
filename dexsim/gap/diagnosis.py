"""The whole diagnosis: recordings in, verdict, findings, fitted servo and model, report out. Its drives are taken
through their steps here, joint by joint, judged on recordings held out; its touch in `gap.touch.diagnosis`."""

from __future__ import annotations

import copy
import json
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import mujoco
import numpy as np

from dexsim.errors import UserError
from dexsim.gap import compute
from dexsim.gap.compute import LONGER, TimeLimit, map_joints, workers
from dexsim.gap.effects.catalogue import EFFECTS, TOUCH_EFFECTS
from dexsim.gap.inquiry import (
    Diagnosis,
    Inquiry,
    NothingToJudge,
    Settings,
    Steps,
    TouchResult,
    empty,
    read_files,
    to_runs,
)
from dexsim.gap.judge import conclude, full_model, held_out
from dexsim.gap.judge.conclude import Noise, add_behind, into_diagnosis
from dexsim.gap.judge.joint_answer import JointAnswer
from dexsim.gap.plant.case import Case, coupled, dragged_by, refine_motion_by_fits, refined_cases
from dexsim.gap.plant.columns import DRAGGERS
from dexsim.gap.plant.mechanics import chain
from dexsim.gap.read import Run, channels, conditions, inputs, stage_tests
from dexsim.gap.report.files import plain, save
from dexsim.gap.report.next_recording import plan_next
from dexsim.gap.rules import JUDGE, SEARCH
from dexsim.gap.search import baseline, logged_torque, ringing
from dexsim.gap.search.scan import cv_loss, drags_of
from dexsim.gap.search.search import (
    JointSearch,
    Outcome,
    SearchedJoint,
    Trial,
    late_commands,
    plain_of,
    search_joint,
    settle_found,
    without_search,
)
from dexsim.gap.touch.diagnosis import Touch
from dexsim.recording.schema import COMMANDS, STATES


def diagnose(s: Settings, say: Callable[[str], None] = print, progress: Callable[..., None] | None = None) -> Diagnosis:
    """Diagnoses recordings; UserError only for what the command line got wrong, a verdict for everything else."""
    w = Inquiry(s, say, progress, s.time_limit or TimeLimit(s.limit))
    with warnings.catch_warnings():  # a guess far off overflows, and loses: nobody need know
        warnings.filterwarnings("ignore", category=RuntimeWarning, module=r"dexsim\.gap|numpy")
        return _diagnosed(w)


def _diagnosed(w: Inquiry) -> Diagnosis:
    """Take an inquiry through its steps."""
    s, progress = w.settings, w.progress
    read_files(w)
    to_runs(w)
    touch = Touch(w.readable, w.m, {w.names[p] for p in s.held_out or []}, s.seed, s.allowed, progress, w.limit)
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
    conclude.decide(d)
    w.clock.lap("judging on held-out data")
    drives.replay(d)
    w.clock.lap("replay of what is written")
    _next(d, w, drives.searched)
    d.notes[:0] = w.limit.left_out
    d.shares = w.clock.shares
    return d


def _first_few(reasons: Sequence[str], most: int = 3) -> str:
    """Return the first reasons in words, and how many more there are."""
    more = len(reasons) - most
    return "; ".join(reasons[:most]) + (f"; and {more} more like these" if more > 0 else "")


def _next(d: Diagnosis, w: Inquiry, searched: Sequence[SearchedJoint]) -> None:
    """What to record next, where that was asked for and there is time for it."""
    if not w.settings.next_recording:
        return
    if w.limit.rest() < PLAN:
        w.limit.leave_out("no next recording is planned")
        return
    plan_next(d, w.settings, w.m, searched, w.readable)
    w.clock.lap("next recording")


def _without_drives(w: Inquiry, touch: Touch, reason: str) -> Diagnosis:
    """Return what is left when no joint can be judged: touch, or the reason why nothing can be said."""
    felt = touch.result
    d = Diagnosis(empty(), f"{reason.rstrip('.')}.", w.notes, mechanism=w.m)
    d.findings = w.channel
    if felt.before is None and not felt.findings:
        d.data["reason"] = reason
        conclude.decide(d)
        d.notes[:0] = w.limit.left_out
        return d
    w.notes.append(f"no joint is judged: {reason}")
    left_out = conclude.not_considered((), felt, w.settings.allowed)
    w.notes += cannot_be_seen(w.settings.allowed, left_out)
    touch.report(d)
    conclude.decide(d)
    d.data["unexplained"]["not_considered"] = left_out
    d.lengths = w.lengths
    _next(d, w, ())
    d.notes[:0] = w.limit.left_out
    d.shares = w.clock.shares
    return d


__all__ = ["Diagnosis", "Settings", "diagnose", "save"]


# -- the drives -------------------------------------------------------------------------------------------------------

Answers = list[tuple[JointSearch, Outcome | None]]
# shares of a limit of time: that the model along the motion may take; that must be left for plans of a replay or a
# recording
MODELLING, PLANNING = 0.2, 0.07
PLAN = 60.0  # s that must be left for a plan of the next recording: one call, of 37 s on a busy machine
MUCH = 20.0  # s of all joints' recordings for each second of a limit: the model along less is not worth a look


@dataclass(frozen=True)
class JudgedAhead:
    """Of a joint what was judged while others were still searched: its answer, and what a plain model of it leaves."""

    answer: JointAnswer
    plain: baseline.Baseline | None


class Drives(Steps):
    """The drives of a mechanism. w: what is asked and has been read; felt: touch, which is judged before: a joint is
    judged where nothing is touched."""

    modelling = 0.0  # s that the model along the motion took
    engine = "none"  # in which what is written was chosen, and is replayed

    def __init__(self, w: Inquiry, felt: TouchResult):
        self.w, self.felt = w, felt
        self.pushes: Sequence[logged_torque.Push] = ()  # from outside
        self.ranges: list[str] = []  # of joints that the recordings show to be others, in words
        # plant: a case a joint, what is held out of the fit, the noise
        self.cases: list[Case] = []
        self.left_out: dict[str, str] = {}  # effects that are not considered, with reasons
        # search: what recorded torque, duty and current say; joints whose closed loop says nothing of them; an answer a
        # joint
        self.stages: Sequence[stage_tests.Stage] = ()
        self.by_torque: Sequence[logged_torque.IdentifiedJoint] = ()
        self.unknown_controllers: set[str] = set()
        self.late: dict[str, float] = {}  # s by which commands are stamped late in all recordings, by joint
        self.searched: list[SearchedJoint] = []
        self.answers: list[JointAnswer] = []
        # what of the judgement needs no other joint, by the search that it is of (`_judged_ahead`)
        self.ahead: dict[int, JudgedAhead] = {}
        # judge
        self.plains: list[baseline.Baseline] = []

    # -- read
    # ------------------------------------------------------------------------------------------------------------------
    def read(self) -> None:
        """The stretches in which every joint moves by its own drive alone."""
        w = self.w
        if w.nothing_left():
            raise NothingToJudge("No recording can be used: " + _first_few(w.failures))
        touched = inputs.merged_spans(self.felt.contact, inputs.self_touch(w.runs, w.m.spec.compile()))
        w.clock.lap("contacts along the motion")
        if touched:
            w.runs, w.held = inputs.free_air(w.runs, w.held, touched, w.notes)
            if w.nothing_left():
                raise NothingToJudge("every joint moves only while something is touched")
        try:
            w.runs = inputs.common_joints(w.runs, w.notes)
        except inputs.Unusable as error:
            raise NothingToJudge(str(error)) from error
        if w.settings.held_out and not w.held:
            w.notes.append("none of the held_out recordings can be used; part of the others is held out instead")
        self.mj_model = w.m.spec.compile()
        self._within_the_stops()
        self._without_pushes()
        for run in w.runs:
            run.smooth()
        if _at_rest(w.runs):
            raise NothingToJudge(
                "Nothing moves in these recordings: no command changes and no joint moves, so no drive can be judged"
            )

    def _within_the_stops(self) -> None:
        """The runs without what only those held out press: ends of a motion that no recording for the fit has shown."""
        w, model = self.w, self.mj_model
        fitted = [r for i, r in enumerate(w.runs) if i not in w.held]
        w.notes += _limits(model, w.runs) + inputs.used_end_stops(model, fitted)
        spec, self.ranges = inputs.with_ranges(w.m.spec, model)
        w.m = replace(w.m, spec=spec)
        pressed = inputs.unforeseen_end_stops(model, [w.runs[i] for i in w.held])
        if pressed:
            why = "presses against an end of its motion that no recording for the fit has shown"
            w.runs, w.held = inputs.free_air(w.runs, w.held, inputs.merged_spans(pressed), w.notes, why)
            if w.settings.held_out and not w.held:
                raise NothingToJudge("the recordings held out do nothing but press against an end of a joint's motion")

    def _without_pushes(self) -> None:
        """The runs without the stretches in which something outside pushes."""
        w = self.w
        fitted = [i for i in range(len(w.runs)) if i not in w.held]
        self.pushes = logged_torque.find_pushes(self.mj_model, w.runs, fitted, w.settings.seed, self._judged())
        w.runs, w.held = logged_torque.without_pushes(self.pushes, w.runs, w.held, w.notes)
        w.clock.lap("forces from outside")

    # -- plant
    # -----------------------------------------------------------------------------------------------------------------
    def plant(self) -> None:
        """A case a joint: its plant along the motion, what is held out of the fit, the noise floor."""
        w, s = self.w, self.w.settings
        count = len(w.runs[0].joints)
        w.say(f"{len(w.runs)} recordings, {sum(r.duration for r in w.runs):.0f} s, {count} joint{'s' * (count > 1)}")
        self._within_the_limit()
        begun = time.monotonic()
        judged = self._judged()
        self.cases = refined_cases(self.mj_model, w.runs, s.device, _step(w.runs), judged)
        self.left_out = conclude.not_considered(self.cases, self.felt, s.allowed)
        w.notes += cannot_be_seen(s.allowed, self.left_out) + conclude.not_fitted(self.cases)
        self.cases = [c for c in self.cases if c.joint in judged]
        if not self.cases:
            raise UserError(
                f"joints: none of {', '.join(sorted(s.joints or judged))} is in the recordings "
                f"({', '.join(w.runs[0].joints)})"
            )
        self.modelling = time.monotonic() - begun
        w.clock.lap("model along the motion")
        group = conditions(w.runs)
        drives = [json.dumps(plain(r.servo.to_dict()), sort_keys=True) for r in w.runs]
        self.fold_groups = [sorted(set(drives)).index(x) for x in drives] if len(set(drives)) > 2 else group
        self.parts = held_out.split(w.runs, w.held, group, self.cases)
        w.say(f"held out of the fit: {self.parts.how}")
        self.noise = Noise(*held_out.floor(w.runs, self.cases), held_out.by_motion(w.runs, self.cases))
        w.say(f"noise floor {1e3 * self.noise.floor:.2f} mrad ({self.noise.how})")

    def _judged(self) -> set[str]:
        """Return the joints that are judged: those that were asked for, of which some recording tells."""
        w = self.w
        some = {j for run in w.runs for j in run.joints if j not in run.left_out}
        return some if w.settings.joints is None else some & w.settings.joints

    def _within_the_limit(self) -> None:
        """Leaves out recordings, evenly, whose model along the motion would take more than its share of the limit of
        time: by how long one of them takes."""
        w, s = self.w, self.w.settings
        seconds = sum(r.duration for r in w.runs)
        if w.limit.seconds is None or len(w.runs) < 3 or seconds * len(w.runs[0].joints) < MUCH * w.limit.seconds:
            return
        ranked, tried = sorted(w.runs, key=lambda r: r.duration), time.monotonic()
        for run in (ranked[0], ranked[len(ranked) // 2]):  # kernels are compiled, or read, with the first
            begun = time.monotonic()
            refined_cases(self.mj_model, [copy.copy(run)], s.device, _step(w.runs), s.joints)
            took = time.monotonic() - begun
        whole = took * seconds / run.duration
        room = min(w.limit.left(), MODELLING * w.limit.seconds - (time.monotonic() - tried))
        share = room / max(whole, 1e-9)
        kept = _evenly(w.runs, set(w.held), share)
        if len(kept) == len(w.runs):
            return
        w.limit.leave_out(
            f"{len(w.runs) - len(kept)} of {len(w.runs)} recordings are left out: the model along all of them would "
            f"take {whole:.0f} s"
        )
        w.held = [i for i, k in enumerate(kept) if k in w.held]
        w.runs = [w.runs[k] for k in kept]

    # -- search
    # ----------------------------------------------------------------------------------------------------------------
    def search(self) -> None:
        """Which effects each joint has; again where what was found in one moves the others otherwise than was
        thought."""
        w = self.w
        self._left: float = len(self.cases)  # joints that are still to be searched: they share the time
        linked = len(self.cases) > 1 and w.settings.joints is None and coupled(self.cases)
        if linked and 2 * self.modelling > w.limit.left():
            w.limit.leave_out("the joints' motion is not refined by what the others were fitted to")
            linked = False
        if linked:
            first = map_joints([c.joint for c in self.cases], self._start, w.settings.device)
            begun = [t for t in first if t is not None]
            if len(begun) == len(first):
                self._coupled_by(begun)
            w.clock.lap("model along the motion")
        self._test_stages()
        answers = map_joints([c.joint for c in self.cases], self._search_of, w.settings.device, w.progress)
        self._search_longer(answers)
        if linked:
            self._search_again(answers)
        self._dragged_from_afar(answers)
        for search, found in answers:
            case = search.case
            if not case.moved:
                w.notes.append(f"{case.joint} does not move: nothing can be said of it")
            if self.late.get(case.joint):
                self._told_late(case.joint)
            elif found is None:
                w.notes.append(f"{case.joint}: no stretch long enough to simulate")
            else:
                self.searched.append(SearchedJoint(case, search, found))
        if w.limit.cut:
            why = "it was interrupted" if w.limit.stopped else f"the limit of {w.limit.seconds:g} s"
            joints = ", ".join(sorted(w.limit.cut))
            w.notes.insert(
                0,
                f"the search of {joints} ended early ({why}): this is the best answer by then, further effects were "
                "not looked for",
            )
        w.clock.lap("search")
        if any(self.late.values()) and not self.searched:
            raise NothingToJudge("; ".join(f.regime for f in w.channel if f.regime.startswith("clock_skew")))
        self._take_back()

    def _told_late(self, joint: str) -> None:
        """Says that a joint's commands are stamped late in all recordings, in the place of what some of them show."""
        w, ms = self.w, 1e3 * self.late[joint]
        text = f"{joint} acts on its targets {ms:.0f} ms before these are stamped, in all recordings"
        told = channels.finding("clock_skew", text, joint, [COMMANDS, STATES], [])
        skewed = lambda f: f.regime.startswith("clock_skew") and (not f.joints or joint in f.joints)  # noqa: E731
        w.channel = [*(f for f in w.channel if not skewed(f)), told]
        w.notes.append(f"{joint} is left out ({told.regime}): stamp both by one clock, or set the commands' back")

    def _take_back(self) -> None:
        """What was held out against what was found: an effect that it refutes is taken back. Nothing is searched any
        more: what follows goes on from what stands."""
        self.answers = compute.each(
            len(self.searched), lambda k: self._answer(self.searched[k].search, self.searched[k].outcome)
        )
        self.searched = [replace(x, outcome=a.outcome) for x, a in zip(self.searched, self.answers, strict=True)]

    def _begun(self, k: int, tell: Callable[[str], None]) -> JointSearch:
        """Return the search of one joint, not yet run."""
        w, case = self.w, self.cases[k]
        deadline = w.limit.share(case.joint, min(1.0, workers(w.settings.device, len(self.cases)) / max(self._left, 1)))
        return JointSearch(
            case,
            self.parts.train,
            self.parts.span_train,
            self.fold_groups,
            seed=w.settings.seed + k,
            allowed=w.settings.allowed,
            tell=tell,
            deadline=deadline,
        )

    def _start(self, k: int, tell: Callable[[str], None]) -> Trial | None:
        """Return the joint as believed, its uncertain figures refitted; None where nothing is long enough to be
        simulated."""
        search = self._begun(k, tell)
        return search.start() if len(search.long.window) else None

    def _search_of(self, k: int, tell: Callable[[str], None]) -> tuple[JointSearch, Outcome | None]:
        """Return the search of one joint and its answer; None where nothing is long enough to be simulated."""
        begun = time.monotonic()
        search, case = self._begun(k, tell), self.cases[k]
        if len(search.long.window) == 0:
            return search, None
        if self.w.limit.seconds is not None and case.moved:
            plain_of(search)  # what all else is held against has its time before anything else
        if case.moved and case.joint not in self.unknown_controllers:
            found = ringing.answered(search, search_joint(search))
        else:
            found = without_search(search)
        self.late[case.joint] = late_commands(search, found.best)
        if not self.late[case.joint]:
            settle_found(search, found)
        search.took = time.monotonic() - begun
        self._left -= 1
        if self.late[case.joint]:
            return search, None
        self._judged_ahead(search, found)
        return search, found

    def _judged_ahead(self, search: JointSearch, found: Outcome) -> None:
        """What `locate` and `judge` need of a joint that is not searched again, while others still are: the one with
        something hidden takes longest, and leaves cores free. Not where time is limited: searches have it first."""
        limit = self.w.limit
        if limit.seconds is None and not limit.stopped and not _unsettled(found):
            self.ahead[id(search)] = JudgedAhead(self._answer(search, found), self._plain(search))

    def _answer(self, search: JointSearch, found: Outcome) -> JointAnswer:
        """Return a joint on what was held out."""
        known = self.ahead.get(id(search))
        return known.answer if known else JointAnswer.of(search.case, search, found, self.parts)

    def _plain(self, search: JointSearch) -> baseline.Baseline | None:
        """Return what a plain model of a joint leaves of what was held out."""
        case, p, known = search.case, self.parts, self.ahead.get(id(search))
        if known or not case.moved:
            return known.plain if known else None
        return baseline.judged(case, plain_of(search), p.test, p.span_test, search.whole)

    def _search_longer(self, answers: Answers) -> None:
        """Joints whose share of the limit was too short, searched once more in what the others did not need of theirs:
        a joint with something hidden takes longest. `answers` is changed. Two thirds of what is left at most: what
        follows needs time too."""
        w = self.w
        cut = [k for k, (search, _) in enumerate(answers) if search.case.joint in w.limit.cut]
        if not cut or w.limit.stopped:
            return
        share = 2 / 3 * min(1.0, workers(w.settings.device, len(cut)) / len(cut))
        if share * w.limit.left() < LONGER * max(answers[k][0].deadline.seconds for k in cut):
            return  # a search begins anew, and would end where it did
        w.limit.cut -= {answers[k][0].case.joint for k in cut}
        self._left = workers(w.settings.device, len(self.cases)) / share
        joints = [self.cases[k].joint for k in cut]
        renewed = map_joints(joints, lambda i, tell: self._search_of(cut[i], tell), w.settings.device, w.progress)
        for k, answer in zip(cut, renewed, strict=True):
            answers[k] = answer

    def _time_for(self, searches: Iterable[JointSearch], first: float = 0.0) -> bool:
        """Return whether what is left of the limit is as much as these searches took, and `first` s before: they would
        begin anew, and in less time end before where they did."""
        took = [x.took for x in searches]
        lanes = min(1.0, workers(self.w.settings.device, len(took)) / len(took))
        return lanes * (self.w.limit.left() - first) >= max(took)

    def _coupled_by(self, trials: Sequence[Trial]) -> None:
        """The cases once more, with the others' motion as these trials have it."""
        w = self.w
        self.cases = refine_motion_by_fits(self.mj_model, w.runs, self.cases, trials, w.settings.device, _step(w.runs))

    def _search_again(self, answers: Answers) -> None:
        """Joints that what was found in the others moves otherwise, searched once more; `answers` is changed."""
        w = self.w
        unsettled = [
            k
            for k, (search, found) in enumerate(answers)
            if found is not None and search.case.joint not in self.unknown_controllers and _unsettled(found)
        ]
        found = [x for _, x in answers if x is not None]
        if len(unsettled) < 2 or len(found) < len(answers) or not self._time_for(
            (answers[k][0] for k in unsettled), self.modelling
        ):
            return
        self._coupled_by(_moved_by(self.mj_model, [search.case.joint for search, _ in answers], found))
        unsettled = [k for k in unsettled if not w.limit.stopped and _other(self._begun(k, lambda _: None), found[k])]
        self._left = len(unsettled)
        joints = [self.cases[k].joint for k in unsettled]
        renewed = map_joints(joints, lambda i, tell: self._search_of(unsettled[i], tell), w.settings.device, w.progress)
        for k, answer in zip(unsettled, renewed, strict=True):
            if not _follows_better(found[k], *answer):  # it had less time, and ended before where the first did
                answers[k] = answer

    def _dragged_from_afar(self, answers: Answers) -> None:
        """Joints of which much is left, searched once more with one that drags them from further off in the mechanism
        than those that their plants know (`_draggers`); `answers` is changed where that explains it."""
        w, asked = self.w, {e.id for e in EFFECTS.values() if e.couples}
        if w.settings.allowed is not None:
            asked &= w.settings.allowed
        if not asked or len(self.cases) < DRAGGERS + 2:
            return
        left = {
            k: (search, found)
            for k, (search, found) in enumerate(answers)
            if found is not None
            and search.case.moved
            and search.case.joint not in self.unknown_controllers
            and found.best.fit.loss > SEARCH.unsettled
            and not any(m.effect.couples for m in found.best.members)
        }
        several = list(left.values())
        by = compute.each(len(left), lambda i: None if w.limit.left() <= 0 else self._dragger(*several[i]))
        pulled = {k: case for k, case in zip(left, by, strict=True) if case is not None}
        self._search_draggers(answers, self._search_with(answers, pulled))

    def _search_draggers(self, answers: Answers, dragged: Sequence[int]) -> None:
        """The joints that drag those of `dragged`, numbers of `answers`, searched once more with what hangs on them: a
        linkage pulls at both its ends, and what is not asked for at the second looks like a friction or a weight of its
        own."""
        number = {search.case.joint: k for k, (search, _) in enumerate(answers)}
        draggers: dict[int, Case] = {}
        for k in dragged:
            search, found = answers[k]
            assert found is not None  # of `_search_with`
            for other in (m.variant.note["from_joint"] for m in found.best.members if m.effect.couples):
                i = number.get(other)
                if i is None or i in draggers or (mine := answers[i][1]) is None or not mine.best.members:
                    continue
                if search.case.joint not in answers[i][0].case.scales.others:
                    draggers[i] = dragged_by(self.cases[i], [self.cases[k]])
        self._search_with(answers, draggers)

    def _search_with(self, answers: Answers, cases: dict[int, Case]) -> list[int]:
        """Return the joints `cases`, by their number in `answers`, searched once more as these cases have them;
        `answers` is changed where a coupling explains more. Returns the numbers of those."""
        before = {k: (self.cases[k], *answers[k]) for k in cases}
        if not cases or not self._time_for(search for _, search, _ in before.values()):
            return []
        for k, case in cases.items():
            self.cases[k] = case
        self._left, several = len(cases), list(cases)
        again = lambda i, tell: self._search_of(several[i], tell)  # noqa: E731
        renewed = map_joints([c.joint for c in cases.values()], again, self.w.settings.device, self.w.progress)
        explained = []
        for k, (search, found) in zip(several, renewed, strict=True):
            near, old_search, old = before[k]
            if (
                found is not None
                and old is not None
                and any(m.effect.couples for m in found.best.members)
                and cv_loss(search, found.best).sum() < (1 - SEARCH.least) * cv_loss(old_search, old.best).sum()
            ):
                answers[k] = search, found
                explained.append(k)
            else:
                self.cases[k] = near
        return explained

    def _dragger(self, search: JointSearch, found: Outcome) -> Case | None:
        """Return the joint's case with the one further off, if any, that by the scan drags it, in the place of the last
        of those that its plant knows."""
        case = search.case
        far = [c for c in self.cases if c.joint not in {case.joint, *case.scales.others} and c.moved]
        groups = [far[i : i + DRAGGERS] for i in range(0, len(far), DRAGGERS)]
        best, which = SEARCH.least, None
        for group in groups:
            told = drags_of(search, found.best, dragged_by(case, group))
            for other in group:
                gain, price = told.get(other.joint, (0.0, 1.0))
                if gain > best and price * len(groups) <= SEARCH.price:
                    best, which = gain, other
        return None if which is None else dragged_by(case, [which])

    def _test_stages(self) -> None:
        """What recorded torque, duty and current say before any search; what they tell of friction is believed."""
        w, p, cases = self.w, self.parts, self.cases
        self.stages = stage_tests.tests(cases, w.runs, p.train, w.settings.seed)
        for x in self.stages[:4]:
            w.say(f"  {x.text}")
        self.by_torque = logged_torque.identify_joints(
            cases, w.runs, p.train, p.test, self.mj_model, w.settings.seed, p.span_train, p.span_test
        )
        self.behind = logged_torque.torque_texts(self.by_torque)
        self.nothing_believed = [x.case.joint for x in self.by_torque if "coulomb_friction" in x.case.unknown]
        w.notes += logged_torque.believe(self.by_torque)
        self.unknown_controllers = logged_torque.unknown_controllers(self.by_torque, self.stages, w.notes)
        for text in self.behind[:4]:
            w.say(f"  {text}")
        w.clock.lap("stage tests")

    # -- locate, judge, report
    # -------------------------------------------------------------------------------------------------
    def locate(self) -> None:
        """Where each joint's residual lives: speed, load, time since reversal, ..."""
        seed = self.w.settings.seed
        rng = np.random.default_rng(seed)
        for a in self.answers:
            a.locate(rng, seed)

    def judge(self) -> None:
        """The answers on what was held out, and what a plain model of each joint leaves of it."""
        for a in self.answers:
            a.judge(self.w.m)
        self.plains = [b for b in compute.each(len(self.searched), lambda k: self._plain(self.searched[k].search)) if b]
        self.w.clock.lap("plain model")
        self.write()

    def write(self) -> None:
        """What is written of each joint: the candidate that follows what was held out best, in the engine that
        trains."""
        w, s, p, cases = self.w, self.w.settings, self.parts, [x.case for x in self.searched]
        told = logged_torque.told(self.by_torque, self.searched, p.test, p.span_test, self.stages)
        self.told = list(told.values())
        given, self.refused = conclude.candidates(self.answers, self.plains, told, w.m.joints)
        what = w.m, w.runs, w.by_name, cases, given, self.noise.of(p.test), p.test, p.span_test
        best = partial(full_model.write_best, *what)
        engine = s.replay
        if engine != "none" and w.limit.spent(1 - PLANNING):
            w.limit.leave_out("not replayed in the engine that trains")
            engine = "none"
        if cases and engine != "none":
            w.say("  what may be written is replayed, and the best chosen")
        try:
            self.written = best(s.device, engine, lambda: w.limit.until(1 - PLANNING), w.progress)
        except UserError as error:
            w.notes.append(f"not replayed in the engine that trains: {error}")
            engine = "none"
            self.written = best(engine=engine)
        else:
            if cases and engine != "none" and not self.written.by_replay:
                w.limit.leave_out("what is written is chosen in the search's own plant")
            if cases and self.written.share < 1:
                which = "chosen and replayed" if self.written.by_replay else "replayed"
                part = f"the first {100 * self.written.share:.0f} % of each part held out"
                w.limit.leave_out(f"what is written is {which} over {part}")
        w.clock.lap("choice in the engine that trains")

    def report(self, d: Diagnosis) -> None:
        """The joints into a diagnosis: findings, verdict, what is handed on."""
        w, p = self.w, self.parts
        into_diagnosis(d, w.settings, self.answers, p, self.noise, w.channel, self.plains, self.written, self.refused)
        if self.ranges:
            d.model_spec = w.m.spec if d.model_spec is None else d.model_spec
            w.notes += self.ranges
        w.notes += [x.note(d.data["nuisance"]) for x in self.told]
        d.data["held_out"]["not_judged"] = p.not_judged
        if p.not_judged:
            w.notes.append(
                f"not judged: {', '.join(p.not_judged)}; what was held out visits it and no recording that is fitted "
                "does"
            )
        d.stages = [x.text for x in self.stages] + self.behind
        add_behind(d, logged_torque.findings(self.by_torque, self.nothing_believed, w.runs, p.train), self.by_torque)
        conclude.claim_push(d, self.pushes)
        d.data["unexplained"]["not_considered"] = self.left_out

    def replay(self, d: Diagnosis) -> None:
        """The files as they are, over all that was held out, by the function of `play replay=`: the number of the
        report."""
        if self.written.kept is None or d.servo is None:
            return
        spec = self.w.m.spec if d.model_spec is None else d.model_spec
        found = full_model.replay_files(self.written.kept, d.servo, spec, self.written.share)
        self.written.replayed = found
        d.data["held_out"]["replayed"] = found.entry()
        conclude.tell(d)
        d.notes += self.written.differences(d.joints)


def cannot_be_seen(asked: set[str] | None, left_out: dict[str, str]) -> list[str]:
    """Return of the effects that were asked for: those that this mechanism, or these recordings, cannot show."""
    every: dict[str, Any] = TOUCH_EFFECTS | EFFECTS
    return [
        f"{e} cannot be seen here: {left_out[e]}; to see it: {every[e].experiment}"
        for e in sorted(asked or ())
        if e in left_out
    ]


def _evenly(runs: Sequence[Run], held: set[int], share: float) -> list[int]:
    """Return which runs to keep, evenly of those held out and of the others, that share (0..1) of their time; one of
    each at least."""
    if share >= 1:
        return list(range(len(runs)))
    kept: list[int] = []
    for group in ([k for k in range(len(runs)) if k not in held], sorted(held)):
        room = share * sum(runs[k].duration for k in group)
        count = len(group)
        while count > 1 and sum(runs[k].duration for k in _spread(group, count)) > room:
            count -= 1
        kept += _spread(group, count)
    return sorted(kept)


def _spread(group: Sequence[int], count: int) -> list[int]:
    """`count` of a group, evenly."""
    return [group[i] for i in np.unique(np.linspace(0, len(group) - 1, count).astype(int))] if group else []


def _at_rest(runs: Sequence[Run]) -> bool:
    """Return whether no joint moves in any run and no target changes."""
    joints = range(len(runs[0].joints))
    return not any(max(float(np.ptp(x[:, j])) for r in runs for x in (r.q, r.cmd)) > JUDGE.moved for j in joints)


def _moved_by(model: mujoco.MjModel, joints: Sequence[str], found: Sequence[Outcome]) -> list[Trial]:
    """Return what was fitted to each joint, as the others are moved by it. Where an encoder misreads, joints along the
    same chain seem to misread as well (gravity is turned for all of them): of one chain only the clearest is
    believed."""
    chains = [{*chain(model, model.jnt_bodyid[model.joint(x).id])} for x in joints]
    removed = [x.none.fit.loss - x.best.fit.loss for x in found]
    misreads = [k for k, x in enumerate(found) if any(m.effect.misreads for m in x.best.members)]
    clearer = lambda a, b: removed[a] > removed[b] and (chains[a] <= chains[b] or chains[b] <= chains[a])  # noqa: E731
    return [
        x.none if k in misreads and any(clearer(other, k) for other in misreads) else x.best
        for k, x in enumerate(found)
    ]


def _follows_better(old: Outcome | None, search: JointSearch, found: Outcome | None) -> bool:
    """Return whether what was found before follows the recordings of `search` better, as it is, than what it found."""
    if old is None or found is None or not old.best.members:
        return False
    fit = search.fitter.given(old.best.members).fit(old.best.fit.params, x0=old.best.fit.x, iterations=0)
    before = search.objective(Trial(old.best.members, fit))
    return bool(before < (1 - SEARCH.least) * search.objective(found.best))


def _unsettled(found: Outcome) -> bool:
    """Return whether a joint's search is looked at again with what was found in the others."""
    return bool(found.best.members) or found.best.fit.loss > SEARCH.unsettled


def _other(search: JointSearch, found: Outcome) -> bool:
    """Return whether what was fitted to a joint follows it otherwise, now that the others are known to move otherwise
    than was thought."""
    for trial in (found.none, found.best):
        fitter = search.fitter.given(trial.members)
        loss = float(fitter.loss(fitter.evaluate(trial.fit.params, trial.fit.x)[None])[0])
        if abs(loss - trial.fit.loss) > SEARCH.least * trial.fit.loss:
            return True
    return False


def _step(runs: list[Run]) -> float:
    """Return integration step [s]: 1 ms, and no coarser than half a sampling period."""
    period = min(r.period for r in runs)
    return float(min(1e-3, period / 2)) if period > 4e-4 else float(period)


def _limits(model: mujoco.MjModel, runs: list[Run]) -> list[str]:
    """Return measured positions outside the model's range: the limit is taken away, and said."""
    notes = []
    for j, name in enumerate(runs[0].joints):
        joint = model.joint(name).id
        if not model.jnt_limited[joint]:
            continue
        low, high = model.jnt_range[joint]
        mn, mx = min(r.q[:, j].min() for r in runs), max(r.q[:, j].max() for r in runs)
        margin = 0.02 * (high - low) + 0.01
        if mn < low - margin or mx > high + margin:
            notes.append(
                f"{name} moved {mn:.3g} to {mx:.3g}, beyond the model's range {low:.3g} to {high:.3g} (degrees for "
                "radians in the"
                " model, another zero, or another joint?); the range is not used"
            )
            model.jnt_limited[joint] = 0
    return notes
