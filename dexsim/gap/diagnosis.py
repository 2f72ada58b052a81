"""The whole diagnosis: recordings in, verdict, findings, fitted servo and model, report out."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.errors import UserError
from dexsim.gap.effects.catalogue import EFFECTS, modelled
from dexsim.gap.judge import confidence, errors, full_model, not_considered, residual_fit
from dexsim.gap.judge.conclude import add_behind, assemble
from dexsim.gap.judge.joint import Kept
from dexsim.gap.plant.case import Case, build
from dexsim.gap.plant.coupled_motion import again, coupled, sharpen
from dexsim.gap.read import channels, end_stops, inputs, keep_out, stage_tests
from dexsim.gap.read.runs import Run, conditions
from dexsim.gap.report.files import plain, save
from dexsim.gap.report.next_experiment import rival_of
from dexsim.gap.report.next_recording import plan_next
from dexsim.gap.result import Clock, Diagnosis, Settings, empty
from dexsim.gap.search import baseline, external_force, torque_told
from dexsim.gap.search.parallel import lanes, together
from dexsim.gap.search.search import JointSearch, Outcome, Trial
from dexsim.gap.search.time_limit import TimeLimit
from dexsim.gap.touch import handed_on as touch_handed
from dexsim.gap.touch import touch
from dexsim.gap.touch.merge import add_touch, touch_alone
from dexsim.recording.mechanism import Mechanism

OTHERWISE = (
    0.1  # of what is left of a joint: by as much it must change with what is known of the others to be searched again
)
# x the noise squared: what more than one joint of a mechanism leaves is looked at again with what was found in each
UNSETTLED = 1.7


@dataclass
class Inquiry:
    """A diagnosis under way: what each step found out, for the next ones."""

    settings: Settings
    say: Callable[[str], None]
    progress: Callable[[float, int, str], None] | None
    limit: TimeLimit
    clock: Clock = field(default_factory=Clock)
    notes: list[str] = field(default_factory=list)
    # read: recordings as they are (None: cannot be read), runs of those that can be used, numbers of runs that are kept
    # out
    m: Mechanism | None = None
    names: dict[Path, str] = field(default_factory=dict)
    recordings: list[Any] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    lengths: dict[str, float] = field(default_factory=dict)  # s, by recording
    runs: list[Run] = field(default_factory=list)
    held: list[int] = field(default_factory=list)
    channel: list[dict[str, Any]] = field(default_factory=list)  # findings about signals
    # touched, and free of touch: what the taxels say, and what pushes from outside
    felt: Any = None
    model: Any = None
    pushes: Sequence[Any] = ()
    # prepared: a case a joint, what is kept out of the fit, the noise floor [rad or m] and where it comes from, by
    # joint
    cases: list[Case] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)  # effects that are not considered, with reasons
    fold_groups: list[int] = field(default_factory=list)
    parts: Any = None
    floor: float = 0.0
    floor_how: str = ""
    floors: Any = None
    # searched
    stages: Sequence[Any] = ()
    by_torque: Sequence[tuple] = ()
    behind: list[str] = field(default_factory=list)  # what the recorded torque says, in words
    nothing_believed: list[str] = field(default_factory=list)  # joints of whose friction nothing was believed
    mute: set[str] = field(default_factory=set)  # joints whose closed loop says nothing of them
    outcomes: list[tuple[Case, JointSearch, Outcome]] = field(default_factory=list)


class _NoJoint(Exception):
    """No joint can be judged, and why."""


def diagnose(
    s: Settings,
    say: Callable[[str], None] = print,
    progress: Callable[[float, int, str], None] | None = None,
) -> Diagnosis:
    """Diagnoses recordings; UserError only for what the command line got wrong, a verdict for everything else."""
    w = Inquiry(s, say, progress, s.time_limit or TimeLimit(s.limit))
    _read(w)
    _to_runs(w)
    _feel(w)
    try:
        _free(w)
    except _NoJoint as reason:
        return _touch_only(w, str(reason))
    _prepare(w)
    _search(w)
    return _judge(w)


def _read(w: Inquiry) -> None:
    """The mechanism and the recordings, as far as they can be read."""
    from dexsim.recording import read
    from dexsim.recording.mechanism import mechanism

    try:
        w.m = mechanism(w.settings.model, w.settings.servo)
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
    for path in paths:
        try:
            r = read(path, w.settings.remap, w.settings.meta, joints=w.m.joints)
            r.path = Path(w.names[path])
            w.recordings.append(r)
        except UserError as error:
            w.failures.append(str(error))
            w.recordings.append(None)
    w.clock.lap("reading and audit")
    w.lengths = {r.path.name: r.duration for r in w.recordings if r is not None}
    _copies(w.recordings[: len(w.settings.recordings)], w.recordings[len(w.settings.recordings) :])


def _to_runs(w: Inquiry) -> None:
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
    w.channel = inputs.channel_findings([r for r in w.recordings if r is not None], w.m.joints)
    readable = [r for r in w.recordings if r is not None]
    w.notes += [
        f"{r.path.name}: {f.text}"
        for r in readable
        for f in r.findings
        if f.kind == "joint_names" and "left out" in f.text
    ]
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
    wrong, out, blind = channels.inspect(w.runs, w.m.spec.compile(), channels.spoiled(readable))
    w.channel = channels.secondary(w.channel + wrong)
    before = {id(r): k for k, r in enumerate(w.runs)}
    w.runs = channels.drop(w.runs, out, w.notes, w.m.spec.compile(), w.held)
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


def _feel(w: Inquiry) -> None:
    """What the taxels say."""
    held_names = {w.names[p] for p in w.settings.held_out or []}
    w.felt = touch.diagnose(
        [r for r in w.recordings if r is not None], w.m, held_names, w.settings.seed, w.settings.allowed, w.progress
    )
    if w.felt.before is not None and w.felt.floor is not None:
        w.felt.notes += confidence.of_touch(w.felt.findings, w.felt.before[0], w.felt.floor)
    w.felt.notes += touch_handed.handed(w.felt.findings, w.felt.facts).doubts
    w.notes += w.felt.notes
    w.clock.lap("touch")


def _touch_only(w: Inquiry, reason: str) -> Diagnosis:
    """What is left when no joint can be judged: touch, or the reason why nothing can be said."""
    if w.felt.before is None and not w.felt.findings:
        return _unusable(reason, w.channel, w.notes, w.m)
    w.notes.append(f"no joint is judged: {reason}")
    w.left_out = not_considered.reasons((), w.felt, w.settings.allowed)
    w.notes.extend(_cannot(w.settings, w.left_out))
    out = touch_alone(w.channel, w.felt, w.notes, w.m)
    out.data["unexplained"]["not_considered"] = w.left_out
    out.lengths = w.lengths
    if w.settings.next_recording:
        plan_next(out, w.settings, w.m, (), [r for r in w.recordings if r is not None])
    out.shares = w.clock.shares
    return out


def _free(w: Inquiry) -> None:
    """The stretches in which every joint moves by its own drive alone. Raises _NoJoint where none are left."""
    if not w.runs or (w.settings.held_out and len(w.held) == len(w.runs)):
        raise _NoJoint("No recording can be used: " + "; ".join(w.failures))
    touched = inputs.merged_spans(w.felt.contact, inputs.self_touch(w.runs, w.m.spec.compile()))
    w.clock.lap("contacts along the motion")
    if touched:
        w.runs, w.held = inputs.free_air(w.runs, w.held, touched, w.notes)
        if not w.runs or (w.settings.held_out and len(w.held) == len(w.runs)):
            raise _NoJoint("every joint moves only while something is touched")
    try:
        w.runs = inputs.common_joints(w.runs, w.notes)
    except inputs.Unusable as error:
        raise _NoJoint(str(error)) from error
    if w.settings.held_out and not w.held:
        w.notes.append("none of the held_out recordings can be used; part of the others is kept out instead")
    w.model = w.m.spec.compile()
    w.notes += _limits(w.model, w.runs) + end_stops.used(w.model, [r for i, r in enumerate(w.runs) if i not in w.held])
    pressed = end_stops.unforeseen(w.model, [w.runs[i] for i in w.held])
    if pressed:
        w.runs, w.held = inputs.free_air(
            w.runs,
            w.held,
            inputs.merged_spans(pressed),
            w.notes,
            "presses against an end of its motion that no recording for the fit has shown",
        )
        if w.settings.held_out and not w.held:
            raise _NoJoint("the recordings kept out do nothing but press against an end of a joint's motion")
    w.pushes = external_force.find(w.model, w.runs, [i for i in range(len(w.runs)) if i not in w.held], w.settings.seed)
    w.runs, w.held = external_force.without(w.pushes, w.runs, w.held, w.notes)
    w.clock.lap("forces from outside")
    for run in w.runs:
        run.smooth()
    moving = [j for j, name in enumerate(w.runs[0].joints) if max(float(np.ptp(r.q[:, j])) for r in w.runs) > 2e-3]
    commanded = [j for j in range(len(w.runs[0].joints)) if max(float(np.ptp(r.cmd[:, j])) for r in w.runs) > 1e-4]
    if not moving and not commanded:
        raise _NoJoint(
            "Nothing moves in these recordings: no command changes and no joint moves, so no drive can be judged"
        )


def _prepare(w: Inquiry) -> None:
    """A case a joint: its plant along the motion, what is kept out of the fit, the noise floor."""
    count = len(w.runs[0].joints)
    seconds = sum(r.duration for r in w.runs)
    w.say(f"{len(w.runs)} recordings, {seconds:.0f} s, {count} joint{'s' * (count > 1)}")
    w.cases = build(w.model, w.runs, device=w.settings.device, dt=_step(w.runs))
    w.cases = sharpen(w.model, w.runs, w.cases, w.settings.device, _step(w.runs), only=w.settings.joints)
    w.left_out = not_considered.reasons(w.cases, w.felt, w.settings.allowed)
    w.notes += _cannot(w.settings, w.left_out) + not_considered.not_fitted(w.cases)
    if w.settings.joints is not None:
        w.cases = [c for c in w.cases if c.joint in w.settings.joints]
        if not w.cases:
            raise UserError(
                f"joints: none of {', '.join(sorted(w.settings.joints))} is in the recordings ({', '.join(w.runs[0].joints)})"
            )
    w.clock.lap("model along the motion")
    group = conditions(w.runs)
    drives = [json.dumps(plain(r.servo.to_dict()), sort_keys=True) for r in w.runs]
    w.fold_groups = [sorted(set(drives)).index(x) for x in drives] if len(set(drives)) > 2 else group
    w.parts = keep_out.split(w.runs, w.held, group, w.cases)
    w.say(f"kept out of the fit: {w.parts.how}")
    w.floor, w.floor_how = errors.floor(w.runs, w.cases)
    w.floors = errors.floors(w.runs, w.cases)[0]
    w.say(f"noise floor {1e3 * w.floor:.2f} mrad ({w.floor_how})")


def _test_stages(w: Inquiry) -> None:
    """What recorded torque, duty and current say before any search; what they tell of friction is believed."""
    w.stages = stage_tests.tests(w.cases, w.runs, w.parts.train, w.settings.seed)
    for x in w.stages[:4]:
        w.say(f"  {x.text}")
    w.by_torque = torque_told.found(
        w.cases, w.runs, w.parts.train, w.parts.test, w.settings.seed, w.model, w.parts.span_train, w.parts.span_test
    )
    w.behind = torque_told.texts(w.by_torque)
    w.nothing_believed = [c.joint for c, _, _ in w.by_torque if "coulomb_friction" in c.unknown]
    w.notes += torque_told.believe(w.by_torque)
    w.mute = torque_told.mute(w.by_torque, w.stages, w.notes)
    for x in w.behind[:4]:
        w.say(f"  {x}")
    w.clock.lap("stage tests")


def _search(w: Inquiry) -> None:
    """Which effects each joint has; again where what was found in one moves the others otherwise than was thought."""

    def begun(k: int, tell: Callable[[float], None]) -> JointSearch:
        share = min(1.0, lanes(w.settings.device, len(w.cases)) / max(left[0], 1))
        return JointSearch(
            w.cases[k],
            w.parts.train,
            w.parts.span_train,
            w.fold_groups,
            seed=w.settings.seed + k,
            allowed=w.settings.allowed,
            tell=tell,
            deadline=w.limit.share(w.cases[k].joint, share),
        )

    def search_of(k: int, tell: Callable[[float], None]) -> tuple[JointSearch, Outcome | None]:
        search = begun(k, tell)
        if len(search.long.window) == 0:
            return search, None
        found = search.run() if w.cases[k].moved and w.cases[k].joint not in w.mute else search.idle()
        search.settle(found)
        left[0] -= 1
        return search, found

    def start_of(k: int, tell: Callable[[float], None]) -> Trial | None:
        search = begun(k, tell)
        return search.start() if len(search.long.window) else None

    joints, left = [c.joint for c in w.cases], [len(w.cases)]
    linked = len(w.cases) > 1 and w.settings.joints is None and coupled(w.cases)
    if linked:
        first = together(joints, start_of, w.settings.device)
        if all(t is not None for t in first):
            w.cases = again(w.model, w.runs, w.cases, first, w.settings.device, _step(w.runs))
        w.clock.lap("model along the motion")
    _test_stages(w)
    answers = together(joints, search_of, w.settings.device, w.progress)
    unsettled = [
        k
        for k, (_, found) in enumerate(answers)
        if found is not None and joints[k] not in w.mute and (found.best.members or found.best.fit.loss > UNSETTLED)
    ]
    if linked and len(unsettled) > 1 and all(found is not None for _, found in answers):
        # what was found in one joint moves the others otherwise than was thought
        w.cases = again(
            w.model, w.runs, w.cases, [found.best for _, found in answers], w.settings.device, _step(w.runs)
        )
        unsettled = [k for k in unsettled if not w.limit.stopped and _other(begun(k, lambda _: None), answers[k][1])]
        left[0] = len(unsettled)
        for k, answer in zip(
            unsettled,
            together(
                [joints[k] for k in unsettled],
                lambda i, tell: search_of(unsettled[i], tell),
                w.settings.device,
                w.progress,
            ),
            strict=True,
        ):
            answers[k] = answer
    for search, found in answers:
        case = search.case
        if not case.moved:
            w.notes.append(f"{case.joint} does not move: nothing can be said of it")
        if found is None:
            w.notes.append(f"{case.joint}: no stretch long enough to simulate")
        else:
            w.outcomes.append((case, search, found))
    if w.limit.cut:
        why = "it was interrupted" if w.limit.stopped else f"the limit of {w.limit.seconds:g} s"
        w.notes.insert(
            0,
            f"the search of {', '.join(sorted(w.limit.cut))} ended early ({why}): this is the best answer by then, further effects were not looked for",
        )
    w.clock.lap("search")


def _judge(w: Inquiry) -> Diagnosis:
    """The answers on what was kept out, as a diagnosis: findings, verdict, what is handed on, what to record next."""
    plains = [
        b
        for case, search, _ in w.outcomes
        if case.moved
        and (
            b := baseline.fit(
                case, w.parts.train, w.parts.test, w.parts.span_train, w.parts.span_test, w.settings.seed, search.whole
            )
        )
    ]
    w.clock.lap("plain model")
    result = assemble(
        w.settings,
        w.m,
        w.outcomes,
        Kept(w.runs, w.parts.train, w.parts.test, w.parts.span_train, w.parts.span_test),
        (w.floor, w.floor_how, w.floors),
        w.parts.how,
        w.channel,
        w.notes,
        plains,
    )
    result.data["held_out"]["not_judged"] = w.parts.not_judged
    if w.parts.not_judged:
        w.notes.append(
            f"not judged: {', '.join(w.parts.not_judged)}; what was kept out visits it and no recording that is fitted does"
        )
    result.stages = [x.text for x in w.stages] + w.behind
    add_behind(result, torque_told.findings(w.by_torque, w.nothing_believed, w.runs, w.parts.train), w.by_torque)
    torque_told.hand_on(w.by_torque, result, w.outcomes, w.parts.test, w.parts.span_test, w.stages)
    external_force.claim(result, w.pushes)
    result.data["unexplained"]["not_considered"] = w.left_out
    add_touch(result, w.felt)
    result.lengths = w.lengths
    w.clock.lap("judging on held-out data")
    if result.data["verdict"] in ("unknown", "partly_explained"):
        _stand_in(
            result,
            w.outcomes,
            w.runs,
            w.parts.train,
            w.parts.test,
            w.parts.span_train,
            w.parts.span_test,
            w.floor,
            w.settings.seed,
        )
        w.clock.lap("stand-in")
    _confirm(result, w.settings, w.m, w.runs, w.outcomes, w.parts.test, w.parts.span_test, w.floor)
    w.clock.lap("replay in the engine that trains")
    if w.settings.next_recording:
        plan_next(result, w.settings, w.m, w.outcomes, [r for r in w.recordings if r is not None])
        w.clock.lap("next recording")
    result.shares = w.clock.shares
    return result


def _other(search: JointSearch, found: Outcome) -> bool:
    """Whether what was fitted to a joint follows it otherwise, now that the others are known to move otherwise than was
    thought."""
    for trial in (found.none, found.best):
        with search._fix(trial.members):
            loss = float(search.fitter.loss(search.fitter.evaluate(trial.fit.params, trial.fit.x)[None])[0])
        if abs(loss - trial.fit.loss) > OTHERWISE * trial.fit.loss:
            return True
    return False


def _stand_in(d: Diagnosis, outcomes, runs, train, test, span_train, span_test, floor: float, seed: int) -> None:
    """Stand-ins for joints of which something is left that no effect explains."""
    for case, search, outcome in outcomes:
        if d.joints[case.joint]["after"] < 1.5 * floor:
            continue
        claimed = any(case.joint in f["where"]["joints"] and modelled(f) for f in d.data["findings"])
        trial = search.polish(outcome.best if claimed else outcome.none)
        found = residual_fit.fit(case, runs, trial, train, test, span_train, span_test, seed)
        if found is not None:
            d.standins.append(found)
            d.notes.append(found.text)


def _confirm(d: Diagnosis, s: Settings, m: Mechanism, runs, outcomes, test, span_test, floor: float) -> None:
    """The believed, the final and the second-best hypothesis in the engine that trains; where it leaves more, the
    sentence says so."""
    if s.replay == "none":
        return
    named = [f for f in d.data["findings"] if f["where"]["joints"] and modelled(f)]
    claimed = {j for f in named for j in f["where"]["joints"]}
    searches = {case.joint: (search, outcome) for case, search, outcome in outcomes}
    none = {case.joint: search.polish(outcome.none) for case, search, outcome in outcomes}
    final = none | {j: searches[j][0].polish(searches[j][1].best) for j in claimed}
    hypotheses = [full_model.Hypothesis("believed", none)] + (
        [full_model.Hypothesis("found", final)] if claimed else []
    )
    for f in named:
        rivals = [a["effect"] for a in f["alternatives"]]
        joint = f["where"]["joints"][0]
        other = rival_of(*searches[joint], f["effect"], rivals[0]) if rivals else None
        if other is not None:
            hypotheses.append(
                full_model.Hypothesis(f"{rivals[0]} instead", final | {joint: searches[joint][0].polish(other)})
            )
            break
    try:
        finer = [replace(case, plant=search.whole) for case, search, _ in outcomes]
        found = full_model.confirm(
            m,
            runs,
            [case for case, _, _ in outcomes],
            hypotheses,
            test,
            span_test,
            floor,
            s.device,
            s.replay,
            finer=finer,
        )
    except UserError as error:
        d.notes.append(f"not replayed in the engine that trains: {error}")
        return
    if found is None:
        return
    d.confirmation = found
    d.data["held_out"]["confirmed"] = found.entry()
    if d.data["held_out"]["error"].startswith("position"):
        d.sentence += " " + found.text("mm" if d.data["held_out"]["error"].endswith("_m") else "mrad")


def _step(runs: list[Run]) -> float:
    """Integration step [s]: 1 ms, and no coarser than half a sampling period."""
    period = min(float(np.median(np.diff(r.t))) for r in runs)
    return float(min(1e-3, period / 2)) if period > 4e-4 else float(period)


def _limits(model, runs: list[Run]) -> list[str]:
    """Measured positions outside the model's range: the limit is taken away, and said."""
    notes = []
    for j, name in enumerate(runs[0].joints):
        joint = model.joint(name).id
        if not model.jnt_limited[joint]:
            continue
        low, high = model.jnt_range[joint]
        mn, mx = min(r.q[:, j].min() for r in runs), max(r.q[:, j].max() for r in runs)
        margin = 0.02 * (high - low) + 0.01
        if mn < low - margin or mx > high + margin:
            notes.append(f"{name} moved {mn:.3g} to {mx:.3g}, beyond the model's range {low:.3g} to {high:.3g} (degrees for radians in the"
                         " model, another zero, or another joint?); the range is not used")  # fmt: skip
            model.jnt_limited[joint] = 0
    return notes


def _unique_names(paths: Sequence[Path]) -> dict[Path, str]:
    names = [p.name for p in paths]
    return {p: p.name if names.count(p.name) == 1 else f"{p.parent.name}/{p.name}" for p in paths}


def _unusable(reason: str, channel, notes, m) -> Diagnosis:
    data = empty("unusable")
    data["findings"] = channel
    data["unexplained"]["depends_on"] = []
    data["reason"] = reason
    return Diagnosis(data, f"{reason.rstrip('.')}.", notes, mechanism=m)


def _copies(train: Sequence[Any], held: Sequence[Any]) -> None:
    """UserError where a held-out recording is one of the others under another name."""
    for h in held:
        for r in train:
            a, b = (None if x is None else x.states.position for x in (h, r))
            if (
                a is not None
                and b is not None
                and len(a) > 20
                and a.value.shape == b.value.shape
                and np.array_equal(a.value, b.value, equal_nan=True)
            ):
                raise UserError(
                    f"held_out: {h.path.name} holds the same readings as {r.path.name}; what is held out must not be fitted"
                )


def _cannot(s: Settings, left_out: dict[str, str]) -> list[str]:
    """Of the effects that were asked for: those that this mechanism, or these recordings, cannot show."""
    from dexsim.gap.effects.catalogue import TOUCH_EFFECTS

    asked = [e for e in sorted(s.allowed or ()) if e in left_out]
    return [
        f"{e} cannot be seen here: {left_out[e]}; to see it: {(EFFECTS.get(e) or TOUCH_EFFECTS[e]).experiment}"
        for e in asked
    ]


def _still(s: Settings) -> str:
    """What can be said although the model or the servo cannot be used: of the recordings alone, in one line."""
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
            f"{path.name}: {r.duration:.1f} s of {len(r.joints)} joint{'s' * (len(r.joints) != 1)}, {'; '.join(bad[:2]) if bad else 'no fault'}"
        )
    return f" (of the recordings themselves: {' | '.join(said)})" if said else ""


__all__ = ["Diagnosis", "Settings", "diagnose", "save"]
