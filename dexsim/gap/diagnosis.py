"""The whole diagnosis: recordings in, verdict, findings, fitted servo and model, report out."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
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

OTHERWISE = 0.1  # of what is left of a joint: by as much it must change with what is known of the others to be searched again
UNSETTLED = 1.7  # x the noise squared: what more than one joint of a mechanism leaves is looked at again with what was found in each


def diagnose(s: Settings, say: Callable[[str], None] = print, progress: Callable[[float, int, str], None] | None = None) -> Diagnosis:
    """Diagnoses recordings; UserError only for what the command line got wrong, a verdict for everything else."""
    from dexsim.recording import read
    from dexsim.recording.mechanism import mechanism

    clock = Clock()
    limit = s.time_limit or TimeLimit(s.limit)
    notes: list[str] = []
    try:
        m = mechanism(s.model, s.servo)
    except UserError as error:
        raise UserError(f"{error}{_still(s)}") from None
    overlap = {p.resolve() for p in s.recordings} & {p.resolve() for p in s.held_out or []}
    if overlap:
        raise UserError(f"held_out: {', '.join(sorted(p.name for p in overlap))} is also in recordings; what is held out must not be fitted")
    paths = [*s.recordings, *(s.held_out or [])]
    names = _unique_names(paths)
    recordings = []
    failures = []
    for path in paths:
        try:
            r = read(path, s.remap, s.meta, joints=m.joints)
            r.path = Path(names[path])
            recordings.append(r)
        except UserError as error:
            failures.append(str(error))
            recordings.append(None)
    clock.lap("reading and audit")
    lengths = {r.path.name: r.duration for r in recordings if r is not None}
    _copies(recordings[: len(s.recordings)], recordings[len(s.recordings) :])
    runs: list[Run] = []
    held: list[int] = []
    for i, r in enumerate(recordings):
        if r is None:
            continue
        try:
            run = inputs.to_run(r, m, notes)
        except inputs.Unusable as error:
            failures.append(str(error))
            continue
        if i >= len(s.recordings):
            held.append(len(runs))
        runs.append(run)
    channel = inputs.channel_findings([r for r in recordings if r is not None], m.joints)
    readable = [r for r in recordings if r is not None]
    notes += [f"{r.path.name}: {f.text}" for r in readable for f in r.findings if f.kind == "joint_names" and "left out" in f.text]
    notes[:0] = [f"{r.path.name}: {f.text}; left out" for r in readable for f in r.findings if f.kind == "nan" and f.joint in ("", *m.joints)]
    absent = [j for j in m.joints if runs and not any(j in r.joints for r in runs)]
    if absent:
        notes.append(f"in the model but in no recording: {', '.join(absent)}; nothing can be said of {'it' if len(absent) == 1 else 'them'}, taken to stand at rest")
    wrong, out, blind = channels.inspect(runs, m.spec.compile(), channels.spoiled(readable))
    channel = channels.secondary(channel + wrong)
    before = {id(r): k for k, r in enumerate(runs)}
    runs = channels.drop(runs, out, notes, m.spec.compile(), held)
    held = [k for k, r in enumerate(runs) if before[id(r)] in held]
    if blind:
        runs, held = inputs.free_air(runs, held, inputs.merged_spans(blind), notes, "part of it tells nothing (old readings, a pause, or a clock that was set)", "that does", (0.0, 0.0), inputs.SHORTEST)
    notes += failures
    failures += [f"{name}: {joint}: {why}" for (name, joint), why in out.items()] if not runs else []
    if failures and runs and len(held) < len(runs):
        say(f"  left out: {'; '.join(failures)}")
    held_names = {names[p] for p in s.held_out or []}
    felt = touch.diagnose([r for r in recordings if r is not None], m, held_names, s.seed, s.allowed, progress)
    if felt.before is not None and felt.floor is not None:
        felt.notes += confidence.of_touch(felt.findings, felt.before[0], felt.floor)
    felt.notes += touch_handed.handed(felt.findings, felt.facts).doubts
    notes += felt.notes
    clock.lap("touch")

    def alone(reason: str) -> Diagnosis:
        """What is left when no joint can be judged: touch, or the reason why nothing can be said."""
        if felt.before is None and not felt.findings:
            return _unusable(reason, channel, notes, m)
        notes.append(f"no joint is judged: {reason}")
        left_out = not_considered.reasons((), felt, s.allowed)
        notes.extend(_cannot(s, left_out))
        out = touch_alone(channel, felt, notes, m)
        out.data["unexplained"]["not_considered"] = left_out
        out.lengths = lengths
        if s.next_recording:
            plan_next(out, s, m, (), [r for r in recordings if r is not None])
        out.shares = clock.shares
        return out

    if not runs or (s.held_out and len(held) == len(runs)):
        return alone("No recording can be used: " + "; ".join(failures))
    touched = inputs.merged_spans(felt.contact, inputs.self_touch(runs, m.spec.compile()))
    clock.lap("contacts along the motion")
    if touched:
        runs, held = inputs.free_air(runs, held, touched, notes)
        if not runs or (s.held_out and len(held) == len(runs)):
            return alone("every joint moves only while something is touched")
    try:
        runs = inputs.common_joints(runs, notes)
    except inputs.Unusable as error:
        return alone(str(error))
    if s.held_out and not held:
        notes.append("none of the held_out recordings can be used; part of the others is kept out instead")
    model = m.spec.compile()
    notes += _limits(model, runs) + end_stops.used(model, [r for i, r in enumerate(runs) if i not in held])
    pressed = end_stops.unforeseen(model, [runs[i] for i in held])
    if pressed:
        runs, held = inputs.free_air(runs, held, inputs.merged_spans(pressed), notes, "presses against an end of its motion that no recording for the fit has shown")
        if s.held_out and not held:
            return alone("the recordings kept out do nothing but press against an end of a joint's motion")
    pushes = external_force.find(model, runs, [i for i in range(len(runs)) if i not in held], s.seed)
    runs, held = external_force.without(pushes, runs, held, notes)
    clock.lap("forces from outside")
    for run in runs:
        run.smooth()
    moving = [j for j, name in enumerate(runs[0].joints) if max(float(np.ptp(r.q[:, j])) for r in runs) > 2e-3]
    commanded = [j for j in range(len(runs[0].joints)) if max(float(np.ptp(r.cmd[:, j])) for r in runs) > 1e-4]
    if not moving and not commanded:
        return alone("Nothing moves in these recordings: no command changes and no joint moves, so no drive can be judged")

    say(f"{len(runs)} recordings, {sum(r.duration for r in runs):.0f} s, {len(runs[0].joints)} joint{'s' * (len(runs[0].joints) > 1)}")
    cases = build(model, runs, device=s.device, dt=_step(runs))
    cases = sharpen(model, runs, cases, s.device, _step(runs), only=s.joints)
    left_out = not_considered.reasons(cases, felt, s.allowed)
    notes += _cannot(s, left_out) + not_considered.not_fitted(cases)
    if s.joints is not None:
        cases = [c for c in cases if c.joint in s.joints]
        if not cases:
            raise UserError(f"joints: none of {', '.join(sorted(s.joints))} is in the recordings ({', '.join(runs[0].joints)})")
    clock.lap("model along the motion")
    group = conditions(runs)
    drives = [json.dumps(plain(r.servo.to_dict()), sort_keys=True) for r in runs]
    fold_groups = [sorted(set(drives)).index(x) for x in drives] if len(set(drives)) > 2 else group
    parts = keep_out.split(runs, held, group, cases)
    train, test, span_train, span_test, how = parts.train, parts.test, parts.span_train, parts.span_test, parts.how
    say(f"kept out of the fit: {how}")
    floor, floor_how = errors.floor(runs, cases)
    floors = errors.floors(runs, cases)[0]
    say(f"noise floor {1e3 * floor:.2f} mrad ({floor_how})")

    mute: set[str] = set()  # joints whose closed loop says nothing of them

    def begun(k: int, tell: Callable[[float], None]) -> JointSearch:
        share = min(1.0, lanes(s.device, len(cases)) / max(left[0], 1))
        return JointSearch(cases[k], train, span_train, fold_groups, seed=s.seed + k, allowed=s.allowed, tell=tell,
                           deadline=limit.share(cases[k].joint, share))

    def search_of(k: int, tell: Callable[[float], None]) -> tuple[JointSearch, Outcome | None]:
        search = begun(k, tell)
        if len(search.long.window) == 0:
            return search, None
        found = search.run() if cases[k].moved and cases[k].joint not in mute else search.idle()
        search.settle(found)
        left[0] -= 1
        return search, found

    def start_of(k: int, tell: Callable[[float], None]) -> Trial | None:
        search = begun(k, tell)
        return search.start() if len(search.long.window) else None

    joints, left = [c.joint for c in cases], [len(cases)]
    linked = len(cases) > 1 and s.joints is None and coupled(cases)
    if linked:
        first = together(joints, start_of, s.device)
        if all(t is not None for t in first):
            cases = again(model, runs, cases, first, s.device, _step(runs))
        clock.lap("model along the motion")
    stages = stage_tests.tests(cases, runs, train, s.seed)
    for x in stages[:4]:
        say(f"  {x.text}")
    by_torque = torque_told.found(cases, runs, train, test, s.seed, model, span_train, span_test)
    behind = torque_told.texts(by_torque)
    nothing_believed = [c.joint for c, _, _ in by_torque if "coulomb_friction" in c.unknown]
    notes += torque_told.believe(by_torque)
    mute |= torque_told.mute(by_torque, stages, notes)
    for x in behind[:4]:
        say(f"  {x}")
    clock.lap("stage tests")
    outcomes: list[tuple[Case, JointSearch, Outcome]] = []
    answers = together(joints, search_of, s.device, progress)
    unsettled = [k for k, (_, found) in enumerate(answers) if found is not None and joints[k] not in mute and (found.best.members or found.best.fit.loss > UNSETTLED)]
    if linked and len(unsettled) > 1 and all(found is not None for _, found in answers):
        # what was found in one joint moves the others otherwise than was thought
        cases = again(model, runs, cases, [found.best for _, found in answers], s.device, _step(runs))
        unsettled = [k for k in unsettled if not limit.stopped and _other(begun(k, lambda _: None), answers[k][1])]
        left[0] = len(unsettled)
        for k, answer in zip(unsettled, together([joints[k] for k in unsettled], lambda i, tell: search_of(unsettled[i], tell), s.device, progress), strict=True):
            answers[k] = answer
    for search, found in answers:
        case = search.case
        if not case.moved:
            notes.append(f"{case.joint} does not move: nothing can be said of it")
        if found is None:
            notes.append(f"{case.joint}: no stretch long enough to simulate")
        else:
            outcomes.append((case, search, found))
    if limit.cut:
        why = "it was interrupted" if limit.stopped else f"the limit of {limit.seconds:g} s"
        notes.insert(0, f"the search of {', '.join(sorted(limit.cut))} ended early ({why}): this is the best answer by then, further effects were not looked for")
    clock.lap("search")
    plains = [b for case, search, _ in outcomes if case.moved and (b := baseline.fit(case, train, test, span_train, span_test, s.seed, search.whole))]
    clock.lap("plain model")
    result = assemble(s, m, outcomes, Kept(runs, train, test, span_train, span_test), (floor, floor_how, floors), how, channel, notes, plains)
    result.data["held_out"]["not_judged"] = parts.not_judged
    if parts.not_judged:
        notes.append(f"not judged: {', '.join(parts.not_judged)}; what was kept out visits it and no recording that is fitted does")
    result.stages = [x.text for x in stages] + behind
    add_behind(result, torque_told.findings(by_torque, nothing_believed, runs, train), by_torque)
    torque_told.hand_on(by_torque, result, outcomes, test, span_test, stages)
    external_force.claim(result, pushes)
    result.data["unexplained"]["not_considered"] = left_out
    add_touch(result, felt)
    result.lengths = lengths
    clock.lap("judging on held-out data")
    if result.data["verdict"] in ("unknown", "partly_explained"):
        _stand_in(result, outcomes, runs, train, test, span_train, span_test, floor, s.seed)
        clock.lap("stand-in")
    _confirm(result, s, m, runs, outcomes, test, span_test, floor)
    clock.lap("replay in the engine that trains")
    if s.next_recording:
        plan_next(result, s, m, outcomes, [r for r in recordings if r is not None])
        clock.lap("next recording")
    result.shares = clock.shares
    return result


def _other(search: JointSearch, found: Outcome) -> bool:
    """Whether what was fitted to a joint follows it otherwise, now that the others are known to move otherwise than was thought."""
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
    """The believed, the final and the second-best hypothesis in the engine that trains; where it leaves more, the sentence says so."""
    if s.replay == "none":
        return
    named = [f for f in d.data["findings"] if f["where"]["joints"] and modelled(f)]
    claimed = {j for f in named for j in f["where"]["joints"]}
    searches = {case.joint: (search, outcome) for case, search, outcome in outcomes}
    none = {case.joint: search.polish(outcome.none) for case, search, outcome in outcomes}
    final = none | {j: searches[j][0].polish(searches[j][1].best) for j in claimed}
    hypotheses = [full_model.Hypothesis("believed", none)] + ([full_model.Hypothesis("found", final)] if claimed else [])
    for f in named:
        rivals = [a["effect"] for a in f["alternatives"]]
        joint = f["where"]["joints"][0]
        other = rival_of(*searches[joint], f["effect"], rivals[0]) if rivals else None
        if other is not None:
            hypotheses.append(full_model.Hypothesis(f"{rivals[0]} instead", final | {joint: searches[joint][0].polish(other)}))
            break
    try:
        finer = [replace(case, plant=search.whole) for case, search, _ in outcomes]
        found = full_model.confirm(m, runs, [case for case, _, _ in outcomes], hypotheses, test, span_test, floor, s.device, s.replay, finer=finer)
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
            if a is not None and b is not None and len(a) > 20 and a.value.shape == b.value.shape and np.array_equal(a.value, b.value, equal_nan=True):
                raise UserError(f"held_out: {h.path.name} holds the same readings as {r.path.name}; what is held out must not be fitted")


def _cannot(s: Settings, left_out: dict[str, str]) -> list[str]:
    """Of the effects that were asked for: those that this mechanism, or these recordings, cannot show."""
    from dexsim.gap.effects.catalogue import TOUCH_EFFECTS

    asked = [e for e in sorted(s.allowed or ()) if e in left_out]
    return [f"{e} cannot be seen here: {left_out[e]}; to see it: {(EFFECTS.get(e) or TOUCH_EFFECTS[e]).experiment}" for e in asked]


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
        said.append(f"{path.name}: {r.duration:.1f} s of {len(r.joints)} joint{'s' * (len(r.joints) != 1)}, {'; '.join(bad[:2]) if bad else 'no fault'}")
    return f" (of the recordings themselves: {' | '.join(said)})" if said else ""


__all__ = ["Diagnosis", "Settings", "diagnose", "save"]
