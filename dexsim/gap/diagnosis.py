"""The whole diagnosis: recordings in, verdict, findings, fitted servo and model, report out."""

from __future__ import annotations

import copy
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from dexsim.actuator.columns import INDEX as SERVO_INDEX
from dexsim.actuator.table import ServoTable
from dexsim.errors import UserError
from dexsim.gap import channels, confidence, confirm, ends, excluded, inputs, inverse, jitter, judge, locate, stage, standin, touch, touch_handed
from dexsim.gap.catalogue import EFFECTS, confusable, separating
from dexsim.gap.charts import number
from dexsim.gap.findings import finding_parameters, model_changes, save_model, servo_changes, widen
from dexsim.gap.fit import Fitter, expand, intervals
from dexsim.gap.next_experiment import rival_of
from dexsim.gap.prepare import Case, build
from dexsim.gap.runs import Run, conditions
from dexsim.gap.search import LEAST, JointSearch, Outcome, Trial
from dexsim.gap.sharpen import again, coupled, sharpen
from dexsim.gap.together import together
from dexsim.gap.touch_effects import entry
from dexsim.recording.mechanism import Mechanism

KEEP_OUT = 0.25  # of the time of each recording, where there are too few to keep a whole condition out
DOUBTED = 0.8  # confidence below which training is also given what was believed before: of such names about half are true (docs/concealed.md)
WEAK = 0.3  # confidence below which a finding is not in the first sentence
NEUTRAL = 1.015  # x the error before on what was kept out: not more than this is not against a finding
ALONE = 2.0  # x the error where it was fitted: beyond it what was kept out shows something that the rest does not
UNSETTLED = 1.7  # x the noise squared: what more than one joint of a mechanism leaves is looked at again with what was found in each
SET_SHARE = 0.06  # of the bootstraps: a rival of the same class with as much belongs to the set


@dataclass
class Settings:
    """What was asked. recordings, held_out: paths; model, servo: files, None for the xHand's; allowed: effect ids to
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
    replay: str = "mujoco"  # see `confirm.REPLAY`


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
class Diagnosis:
    """Everything the page shows; `data` is what diagnosis.json holds."""

    data: dict[str, Any]
    sentence: str
    notes: list[str]
    curves: list[Curve] = field(default_factory=list)
    spots: list[locate.Spot] = field(default_factory=list)
    joints: dict[str, dict[str, float]] = field(default_factory=dict)  # by joint: before, after, sigma; as_fitted: after, where it was taken back
    outcomes: list[Outcome] = field(default_factory=list)
    servo: ServoTable | None = None
    model_spec: Any = None
    mechanism: Mechanism | None = None
    stages: list[str] = field(default_factory=list)
    shares: dict[str, float] = field(default_factory=dict)
    spans: dict[str, float] = field(default_factory=dict)
    touch: touch.TouchResult | None = None
    lengths: dict[str, float] = field(default_factory=dict)  # of each recording [s]
    standins: list[standin.StandIn] = field(default_factory=list)
    mae: dict[tuple[str, str], tuple[float, float]] = field(default_factory=dict)  # (joint, recording): mean |error| before, after
    untrained: list[str] = field(default_factory=list)
    confirmation: confirm.Confirmation | None = None
    evidence: list[confidence.Evidence] = field(default_factory=list)  # behind each finding of a joint


def empty(verdict: str = "unusable") -> dict[str, Any]:
    """diagnosis.json with nothing in it."""
    zero = {"recordings": [], "error": "position_rmse_rad"}
    zero |= {k: None for k in ("before", "after", "before_low", "before_high", "after_low", "after_high")}
    return {"schema": 1, "verdict": verdict, "noise_floor": {"position_rad": None, "how": "quantum"}, "nuisance": {}, "held_out": zero,
            "findings": [], "unexplained": {"fraction_of_gap": None, "depends_on": [], "not_considered": {}}, "next_recording": None}


class Clock:
    """Where the time goes, by stage."""

    def __init__(self) -> None:
        self.shares: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.shares[stage] = self.shares.get(stage, 0.0) + now - self._last
        self._last = now


def diagnose(s: Settings, say: Callable[[str], None] = print, progress: Callable[[int, int, str], None] | None = None) -> Diagnosis:
    """Diagnoses recordings; UserError only for what the command line got wrong, a verdict for everything else."""
    from dexsim.recording import read
    from dexsim.recording.mechanism import mechanism

    clock = Clock()
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
    wrong, out = channels.inspect(runs, m.spec.compile(), channels.spoiled(readable))
    channel = channels.secondary(channel + wrong)
    before = {id(r): k for k, r in enumerate(runs)}
    runs = channels.drop(runs, out, notes)
    held = [k for k, r in enumerate(runs) if before[id(r)] in held]
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
        left_out = excluded.reasons((), felt, s.allowed)
        notes.extend(_cannot(s, left_out))
        out = _touch_only(channel, felt, notes, m)
        out.data["unexplained"]["not_considered"] = left_out
        out.lengths = lengths
        if s.next_recording:
            _next(out, s, m, (), [r for r in recordings if r is not None])
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
    notes += _limits(model, runs) + ends.used(model, [r for i, r in enumerate(runs) if i not in held])
    pressed = ends.unforeseen(model, [runs[i] for i in held])
    if pressed:
        runs, held = inputs.free_air(runs, held, inputs.merged_spans(pressed), notes, "presses against an end of its motion that no recording for the fit has shown")
        if s.held_out and not held:
            return alone("the recordings kept out do nothing but press against an end of a joint's motion")
    for run in runs:
        run.smooth()
    moving = [j for j, name in enumerate(runs[0].joints) if max(float(np.ptp(r.q[:, j])) for r in runs) > 2e-3]
    commanded = [j for j in range(len(runs[0].joints)) if max(float(np.ptp(r.cmd[:, j])) for r in runs) > 1e-4]
    if not moving and not commanded:
        return alone("Nothing moves in these recordings: no command changes and no joint moves, so no drive can be judged")

    say(f"{len(runs)} recordings, {sum(r.duration for r in runs):.0f} s, {len(runs[0].joints)} joint{'s' * (len(runs[0].joints) > 1)}")
    cases = build(model, runs, device=s.device, dt=_step(runs))
    cases = sharpen(model, runs, cases, s.device, _step(runs), only=s.joints)
    left_out = excluded.reasons(cases, felt, s.allowed)
    notes += _cannot(s, left_out) + excluded.not_fitted(cases)
    if s.joints is not None:
        cases = [c for c in cases if c.joint in s.joints]
        if not cases:
            raise UserError(f"joints: none of {', '.join(sorted(s.joints))} is in the recordings ({', '.join(runs[0].joints)})")
    clock.lap("model along the motion")
    group = conditions(runs)
    drives = [json.dumps(_plain(r.servo.to_dict()), sort_keys=True) for r in runs]
    fold_groups = [sorted(set(drives)).index(x) for x in drives] if len(set(drives)) > 2 else group
    train, test, span_train, span_test, how = _split(runs, held, group)
    say(f"kept out of the fit: {how}")
    floor, floor_how = judge.floor(runs, cases)
    say(f"noise floor {1e3 * floor:.2f} mrad ({floor_how})")

    def begun(k: int) -> JointSearch:
        return JointSearch(cases[k], train, span_train, fold_groups, seed=s.seed + k, allowed=s.allowed)

    def search_of(k: int) -> tuple[JointSearch, Outcome | None]:
        search = begun(k)
        if len(search.long.window) == 0:
            return search, None
        found = search.run() if cases[k].moved else search.idle()
        search.settle(found)
        return search, found

    def start_of(k: int) -> Trial | None:
        search = begun(k)
        return search.start() if len(search.long.window) else None

    joints = [c.joint for c in cases]
    linked = len(cases) > 1 and s.joints is None and coupled(cases)
    if linked:
        first = together(joints, start_of, s.device)
        if all(t is not None for t in first):
            cases = again(model, runs, cases, first, s.device, _step(runs))
        clock.lap("model along the motion")
    stages = stage.tests(cases, runs, train, s.seed)
    for x in stages[:4]:
        say(f"  {x.text}")
    by_torque = inverse.found(cases, runs, train, test, s.seed)
    behind = inverse.texts(by_torque)
    nothing_believed = [c.joint for c, _, _ in by_torque if "coulomb_friction" in c.unknown]
    notes += inverse.believe(by_torque)
    for x in behind[:4]:
        say(f"  {x}")
    clock.lap("stage tests")
    outcomes: list[tuple[Case, JointSearch, Outcome]] = []
    rng = np.random.default_rng(s.seed)
    answers = together(joints, search_of, s.device, progress)
    unsettled = [k for k, (_, found) in enumerate(answers) if found is not None and (found.best.members or found.best.fit.loss > UNSETTLED)]
    if linked and len(unsettled) > 1 and all(found is not None for _, found in answers):
        # what was found in one joint moves the others otherwise than was thought
        cases = again(model, runs, cases, [found.best for _, found in answers], s.device, _step(runs))
        for k, answer in zip(unsettled, together([joints[k] for k in unsettled], lambda i: search_of(unsettled[i]), s.device, progress), strict=True):
            answers[k] = answer
    for search, found in answers:
        case = search.case
        if not case.moved:
            notes.append(f"{case.joint} does not move: nothing can be said of it")
        if found is None:
            notes.append(f"{case.joint}: no stretch long enough to simulate")
        else:
            outcomes.append((case, search, found))
    clock.lap("search")
    result = _assemble(s, m, runs, cases, outcomes, train, test, span_train, span_test, floor, floor_how, how, channel, notes, rng, clock)
    result.stages = [x.text for x in stages] + behind
    _behind(result, inverse.findings(by_torque, nothing_believed, runs, train), by_torque)
    inverse.write(by_torque, result.servo, nothing_believed)
    result.data["unexplained"]["not_considered"] = left_out
    _with_touch(result, felt)
    result.lengths = lengths
    clock.lap("judging on held-out data")
    if result.data["verdict"] in ("unknown", "partly_explained"):
        _stand_in(result, outcomes, runs, train, test, span_train, span_test, floor, s.seed)
        clock.lap("stand-in")
    _confirm(result, s, m, runs, outcomes, test, span_test, floor)
    clock.lap("replay in the engine that trains")
    if s.next_recording:
        _next(result, s, m, outcomes, [r for r in recordings if r is not None])
        clock.lap("next recording")
    result.shares = clock.shares
    return result


def _assemble(s, m, runs, cases, outcomes, train, test, span_train, span_test, floor, floor_how, how, channel, notes, rng, clock) -> Diagnosis:
    data = empty("none")
    data["noise_floor"] = {"position_rad": float(floor), "how": floor_how}
    out = Diagnosis(data, "", notes, mechanism=m)
    findings: list[dict[str, Any]] = []
    servo = copy.deepcopy(m.table)
    spec = m.spec.copy()
    changed_model = False
    squares = {"before": [], "after": []}
    effort_squares = {"before": [], "after": []}
    times, all_spots, leftover = [], [], []
    for case, search, outcome in outcomes:
        best, none = search.polish(outcome.best), search.polish(outcome.none)
        whole = replace(case, plant=search.whole)
        windows = whole.plant.windows(None, test, span=span_test)
        q0, e0 = judge.free_run(whole, none.fit.params, none.fit.x, windows)
        fixed = [f for mm in best.members for f in mm.variant.fixed]
        q1, e1 = judge.free_run(whole, best.fit.params, best.fit.x, windows, fixed) if best.members else (q0, e0)
        rows = windows.sample_row
        measured, t = case.plant.q[rows], case.plant.t[rows] + 1e4 * case.plant.run_of[rows]
        before, after = (measured - q0) ** 2, (measured - q1) ** 2
        squares["before"].append(before)
        squares["after"].append(after)
        times.append(t)
        rms = lambda x: float(np.sqrt(np.mean(x))) if len(x) else 0.0  # noqa: E731
        tau = case.plant.torque[rows]
        ok = np.isfinite(tau)
        eff = {"before": rms((tau - e0)[ok] ** 2), "after": rms((tau - e1)[ok] ** 2)} if ok.any() else None
        out.joints[case.joint] = {"before": rms(before), "after": rms(after), "mae_before": float(np.abs(measured - q0).mean()),
                                  "mae_after": float(np.abs(measured - q1).mean()), "sigma": case.sigma, "fitted": _followed(case, none, train, span_train)}
        if eff:
            out.joints[case.joint] |= {"effort_before": eff["before"], "effort_after": eff["after"]}
            effort_squares["before"].append((tau - e0)[ok] ** 2)
            effort_squares["after"].append((tau - e1)[ok] ** 2)
        for i in test:
            pick = np.isin(case.plant.run_of[rows], [k for k in test if runs[k].name == runs[i].name])  # one that was cut is several
            if pick.any():
                out.mae[case.joint, runs[i].name] = (float(np.abs(measured - q0)[pick].mean()), float(np.abs(measured - q1)[pick].mean()))
        out.outcomes.append(outcome)
        # nuisances
        data["nuisance"] |= _nuisances(case.joint, best)
        bounds = intervals(best.fit, search.blocks, knee=search.r.knee)
        bounds = search.widen(best, bounds)
        by_member: dict[str, dict[str, float]] = {}
        for mm in best.members:
            keys = [f"{mm.id}.{p.key}" for p in mm.variant.params]
            index = [[p.key for p in best.fit.params].index(k) for k in keys]
            raw = {p.key: float(best.fit.x[i]) for p, i in zip(mm.variant.params, index, strict=True)}
            spread = {p.key: (float(bounds[i][0]), float(bounds[i][1])) for p, i in zip(mm.variant.params, index, strict=True)}
            for p, x, b in zip(best.fit.params, best.fit.x, bounds, strict=True):  # a level that was unknown and is fitted anyway
                if mm.id == "coulomb_friction" and p.key == "coulomb_friction" and "torque" not in raw:
                    raw["torque"], spread["torque"] = float(x), (float(b[0]), float(b[1]))
            by_member[mm.id] = raw
            rest = tuple(x for x in best.members if x is not mm)
            without = judge_without(search, best, mm) if rest else none
            qw, ew = judge.free_run(whole, without.fit.params, without.fit.x, windows, [f for x in rest for f in x.variant.fixed])
            rivals = outcome.rivals.get(mm.id, [])
            same = [r for r in rivals if confusable(r[0], mm.id) and r[1] >= SET_SHARE][:2]
            signal = judge.own_signal(mm.id, case, raw, mm.variant.note)
            active = signal > 0.25 * max(float(np.percentile(signal, 99.9)), 1e-12)
            effort_only = mm.id == "current_sensor"
            earned = 1.0 if effort_only else float(np.clip((rms((measured - qw) ** 2) - rms(after)) / (0.1 * rms((measured - qw) ** 2) + 1e-12), 0.0, 1.0))
            evidence = confidence.Evidence(
                mm.id, case.joint, outcome.confidence.get(mm.id, 0.5), earned, confidence.left_over(rms(after), rms(before), case.sigma),
                confidence.left_over(rms(after), rms((measured - qw) ** 2), case.sigma), outcome.folds.get(mm.id, []), len(best.members), 0)  # fmt: skip
            if confidence.holds_nothing(mm.variant.params, spread, case):
                evidence.reasons.append("its interval holds the size at which nothing is missing")
            small = "" if effort_only else confidence.too_small(rms(before), rms((measured - qw) ** 2), rms(after), case.sigma, len(best.members) == 1)
            if small:
                evidence.reasons.append(small)
            stopped = confidence.at_bound(mm.variant.params, raw, case)
            if stopped:
                evidence.reasons.append(f"its {stopped.replace('_', ' ')} stopped at the bound of what is physical")
            follows = confidence.temperature_follows(case, sorted({*train, *test})) if mm.id == "thermal" else ""
            if follows:
                evidence.reasons.append(f"temperature follows {follows}, so it may stand for anything that changes with it")
            evidence.of_pose = confidence.of_pose(mm.id, raw, case)
            evidence.confidence = confidence.weigh(evidence, rms(before), rms(after), rms((measured - qw) ** 2), case.sigma)
            out.evidence.append(evidence)
            findings.append({
                "effect": mm.id,
                "confidence": evidence.confidence,  # what the other findings say of it comes last
                "alternatives": [{"effect": e, "confidence": round(c, 3)} for e, c in rivals[:3]],
                "indistinguishable": [mm.id, *(e for e, _ in same)] if same else [],
                "separating_experiment": separating([mm.id, *(e for e, _ in same)]) if same else None,
                "where": {"joints": [case.joint], "taxels": [], "topics": []},
                "regime": EFFECTS[mm.id].shows,
                "when": judge.intervals_of(active, case, runs, train),
                "parameters": finding_parameters(mm, raw, spread, case, m.table),
                "held_out": {"before": rms((tau - ew)[ok] ** 2), "after": eff["after"]} if effort_only and eff else
                            {"before": rms((measured - qw) ** 2), "after": rms(after)},
            })  # fmt: skip
            late = jitter.estimate(search, best) if mm.id == "command_delay" and best.fit.loss > jitter.LEFT else None
            if late is not None:
                findings[-1]["parameters"]["jitter"] = late.entry()
            out.spans[f"{mm.id}@{case.joint}"] = float(active.mean())
        leftover += servo_changes(servo, case, best, bounds, m.joints)
        mine = model_changes(spec, case, best, by_member)
        changed_model |= bool(mine)
        leftover_text = [x for x in mine]
        notes.extend(leftover_text)
        everything = search.fitter.evaluate(none.fit.params, none.fit.x)
        r = everything[: search.long.n]
        rows_train = search.long.sample_row
        regimes = {k: v[rows_train] for k, v in case.regimes.items()}
        found = locate.spots(case.joint, r * case.sigma, search.blocks[: search.long.n], regimes, rng)
        all_spots += found
        if search.fitter.use_torque:
            on, again = search.fitter.tau_on, np.random.default_rng(s.seed + 1)
            effort = everything[search.long.n :][on] * search.r.sigma_torque
            all_spots += locate.spots(case.joint, effort, search.blocks[: search.long.n][on], {k: v[on] for k, v in regimes.items()}, again, "effort")
        case_left = search.fitter
        with search._fix(best.members):
            r1 = case_left.evaluate(best.fit.params, best.fit.x)[: search.long.n]
        left = locate.control(locate.spots(case.joint, r1 * case.sigma, search.blocks[: search.long.n], regimes, rng))
        out.joints[case.joint]["left"] = 0.0
        if rms(r1**2) > 1.5:
            data["unexplained"]["depends_on"] += [f"{x.text} ({case.joint})" for x in left[:2]]
        order = np.argsort(-(before.reshape(-1)))[:1]
        if len(rows):
            out.curves.append(_curve(case, runs, rows, q0, q1, int(order[0])))
    out.spots = locate.control(all_spots)
    out.untrained = sorted(set(leftover))
    # a joint whose findings did not help on what was kept out keeps none of them
    for k, (case, search, outcome) in enumerate(outcomes):
        mine = [f for f in findings if case.joint in f["where"]["joints"] and f["effect"] != "current_sensor"]
        v = out.joints[case.joint]
        if not mine or v["after"] < 0.98 * v["before"]:
            continue
        reason = _not_refuted(search, outcome, v["after"] / v["before"], test, span_test)
        if reason:
            for e in out.evidence:
                if e.joint == case.joint and e.effect != "current_sensor":
                    e.reasons.append(reason)
                    e.confidence = min(e.confidence, confidence.DOUBTED)
            continue
        for f in mine:
            notes.append(f"{f['effect']} on {case.joint} earned its place on the training conditions but not on what was kept out; not claimed")
        findings = [f for f in findings if f not in mine]
        squares["after"][k] = squares["before"][k]
        data["nuisance"] = {key: x for key, x in data["nuisance"].items() if not key.endswith(f"@{case.joint}")} | _nuisances(case.joint, search.polish(outcome.none))
        v["as_fitted"], v["after"], v["mae_after"] = v["after"], v["before"], v["mae_before"]
        servo.entries.pop(case.joint, None)
        if case.joint in m.table.entries:
            servo.entries[case.joint] = copy.deepcopy(m.table.entries[case.joint])
        if any(f["effect"] in ("inertia", "payload") for f in mine):
            spec, changed_model = m.spec.copy(), False
    for joint in _shown_there_alone(out.joints, findings) if s.held_out else ():
        v = out.joints[joint]
        notes.append(f"{joint}: the recordings kept out are missed by {1e3 * v['before']:.3g} mrad, those that were fitted by {1e3 * v['fitted']:.3g}: "
                     "something shows there alone, and what is held out is not fitted. Give them as recordings= too, with others held out")
    findings.sort(key=lambda f: -_weight(f))
    _doubts(out, findings, channel)
    members = {(case.joint, m.id): (case, m) for case, _, outcome in outcomes for m in outcome.best.members}
    for f in findings:
        key = (f["where"]["joints"][0], f["effect"])
        if f["confidence"] < DOUBTED and key in members and widen(servo, *members[key], f["confidence"]):
            notes.append(f"{key[1]} on {key[0]} is not sure: in servo.yaml its range reaches towards what was believed")
    b, bl, bh = judge.rms_interval(squares["before"], times, s.seed)
    a, al, ah = judge.rms_interval(squares["after"], times, s.seed)
    slide = all(c.constants.slide for c in cases)
    data["held_out"] = {"recordings": [runs[i].name for i in test], "error": "position_rmse_m" if slide else "position_rmse_rad", "before": b,
                        "after": a, "before_low": bl, "before_high": bh, "after_low": al, "after_high": ah, "how": how}
    data["findings"] = sorted(channel, key=lambda f: -f["confidence"]) + findings
    only_effort = findings and all(f["effect"] == "current_sensor" for f in findings)
    structured = any(o.none.fit.loss > 1.3**2 and (len(o.scanned) > 0 or case.moved) for case, _, o in outcomes)
    word = judge.verdict(data["findings"], floor, b, bl, a, structured, judge.FAR)
    if only_effort:
        word = "explained"
        eb, ea = (float(np.sqrt(np.concatenate(effort_squares[k]).mean())) for k in ("before", "after"))
        data["held_out"] |= {"error": "effort_rmse_Nm", "before": eb, "after": ea, "before_low": eb, "before_high": eb, "after_low": ea, "after_high": ea}
    data["verdict"] = word
    gap = b**2 - floor**2
    data["unexplained"]["fraction_of_gap"] = round(float(np.clip((a**2 - floor**2) / gap, 0.0, 1.0)), 4) if gap > 0 and b > 1.3 * floor else 0.0
    if word in ("none", "explained"):
        data["unexplained"]["depends_on"] = []
    out.servo = servo
    out.model_spec = spec if changed_model else None
    out.sentence = _sentence(data, out, floor)
    return out


def _followed(case: Case, none: Trial, train: Sequence[int], span: dict | None) -> float:
    """Error (rms) of a free run over what was fitted, without any effect."""
    windows = case.plant.windows(None, train, span=span)
    return float(np.sqrt(np.mean((case.plant.q[windows.sample_row] - judge.free_run(case, none.fit.params, none.fit.x, windows)[0]) ** 2)))


def _shown_there_alone(joints: dict[str, dict[str, float]], findings: list[dict[str, Any]]) -> list[str]:
    """Joints without a finding of which what was kept out is followed far worse than what was fitted: what is missing (a limit, a sag) shows
    there alone, and what is kept out must not be fitted."""
    found = {j for f in findings for j in f["where"]["joints"]}
    return [j for j, v in joints.items() if j not in found and v["before"] > max(judge.FAR * v["sigma"], ALONE * v["fitted"])]


def _not_refuted(search: JointSearch, outcome: Outcome, ratio: float, test: Sequence[int], span: dict | None) -> str:
    """Why findings that do not lessen the error of a free run over what was kept out (after / before: `ratio`) are doubted, not dropped; empty
    where they are refuted. One stick more or less sends a free run another way; and a limit may just not have been reached there. What the
    recorded torque has told of a joint is known: nothing that is not shown goes beyond it."""
    if search.case.told:
        return ""
    before, after = (search.in_windows(search.polish(t), test, span) for t in (outcome.none, outcome.best))
    needed = confidence.NEEDED**2
    if before > needed and after < (1 - 2 * LEAST) * before:
        return "what was kept out is followed better from moment to moment, but not by a free run"
    sides_with_neither = ratio < NEUTRAL and after < NEUTRAL**2 * before
    plain = outcome.none.fit.loss > needed and search.gain(outcome.best, outcome.none) >= 2 * LEAST
    return "what was kept out does not show it" if sides_with_neither and plain else ""


def _nuisances(joint: str, trial: Trial) -> dict[str, float]:
    """The refitted beliefs of one joint by the keys of `diagnosis.json`."""
    return {f"{p.key}_factor@{joint}" if p.mode == "factor" else f"{p.key}@{joint}": round(float(x), 6)
            for p, x in zip(trial.fit.params, trial.fit.x, strict=True) if p.nuisance}  # fmt: skip


def _doubts(d: Diagnosis, findings: list[dict[str, Any]], channel: list[dict[str, Any]]) -> None:
    """Confidences of the joints' findings (the weightiest first), after what they and the signals say of each other."""
    by = {(e.joint, e.effect): e for e in d.evidence}
    mine = [by[f["where"]["joints"][0], f["effect"]] for f in findings]
    for joint in {e.joint for e in mine}:
        confidence.together([e for e in mine if e.joint == joint])
    coupled = {f["where"]["joints"][0]: f["parameters"]["from_joint"]["value"] for f in findings if f["effect"] == "joint_coupling"}
    confidence.of_the_whole(mine, coupled, {j for f in channel for j in f["where"]["joints"]})
    for f, e in zip(findings, mine, strict=True):
        f["confidence"] = round(e.confidence, 3)
        d.notes += [f"{e.effect} on {e.joint} is not sure: {reason}" for reason in e.reasons]
    d.evidence = mine


def _behind(d: Diagnosis, findings: list[dict], by_torque: Sequence[tuple]) -> None:
    """What the recorded motor torque names beyond what it was believed to be, into the diagnosis; judged by the torque that is left
    on the recording kept out, where the loop's own error shows nothing."""
    if not findings:
        return
    data = d.data
    shown = [f for f in data["findings"] if entry(f) is not None]
    taken = {(f["effect"], *f["where"]["joints"]) for f in shown}
    data["findings"] += [f for f in findings if (f["effect"], *f["where"]["joints"]) not in taken]
    if not shown:
        judged = [(x, names) for c, x, names in by_torque if any(c.joint in f["where"]["joints"] for f in findings)]
        last = [next(n for n in reversed(x.named) if n.effect) for x, _ in judged]  # not what the catalogue has no name for
        b, a = (float(np.sqrt(sum(y**2 for y in ys))) for ys in ([x.named[0].before for x, _ in judged], [n.after for n in last]))
        data["held_out"] = {"recordings": judged[0][1], "error": findings[0]["held_out"]["error"], "before": b, "after": a, "before_low": None, "before_high": None,
                            "after_low": None, "after_high": None, "how": "the motor torque recorded there, from the motion, with what was fitted elsewhere"}  # fmt: skip
        data["verdict"] = "partly_explained" if a < 0.7 * b else "unknown"
        data["unexplained"]["fraction_of_gap"] = round((a / b) ** 2, 4)
    d.sentence = _sentence(data, d, data["noise_floor"]["position_rad"])


def _stand_in(d: Diagnosis, outcomes, runs, train, test, span_train, span_test, floor: float, seed: int) -> None:
    """Stand-ins for joints of which something is left that no effect explains."""
    for case, search, outcome in outcomes:
        if d.joints[case.joint]["after"] < 1.5 * floor:
            continue
        claimed = any(case.joint in f["where"]["joints"] and entry(f) is not None for f in d.data["findings"])
        trial = search.polish(outcome.best if claimed else outcome.none)
        found = standin.fit(case, runs, trial, train, test, span_train, span_test, seed)
        if found is not None:
            d.standins.append(found)
            d.notes.append(found.text)


def _confirm(d: Diagnosis, s: Settings, m: Mechanism, runs, outcomes, test, span_test, floor: float) -> None:
    """The believed, the final and the second-best hypothesis in the engine that trains; where it leaves more, the sentence says so."""
    if s.replay == "none":
        return
    named = [f for f in d.data["findings"] if f["where"]["joints"] and f["effect"] in EFFECTS]
    claimed = {j for f in named for j in f["where"]["joints"]}
    searches = {case.joint: (search, outcome) for case, search, outcome in outcomes}
    none = {case.joint: search.polish(outcome.none) for case, search, outcome in outcomes}
    final = none | {j: searches[j][0].polish(searches[j][1].best) for j in claimed}
    hypotheses = [confirm.Hypothesis("believed", none)] + ([confirm.Hypothesis("found", final)] if claimed else [])
    for f in named:
        rivals = [a["effect"] for a in f["alternatives"]]
        joint = f["where"]["joints"][0]
        other = rival_of(*searches[joint], f["effect"], rivals[0]) if rivals else None
        if other is not None:
            hypotheses.append(confirm.Hypothesis(f"{rivals[0]} instead", final | {joint: searches[joint][0].polish(other)}))
            break
    try:
        finer = [replace(case, plant=search.whole) for case, search, _ in outcomes]
        found = confirm.confirm(m, runs, [case for case, _, _ in outcomes], hypotheses, test, span_test, floor, s.device, s.replay, finer=finer)
    except UserError as error:
        d.notes.append(f"not replayed in the engine that trains: {error}")
        return
    if found is None:
        return
    d.confirmation = found
    d.data["held_out"]["confirmed"] = found.entry()
    if d.data["held_out"]["error"].startswith("position"):
        d.sentence += " " + found.text("mm" if d.data["held_out"]["error"].endswith("_m") else "mrad")


def judge_without(search: JointSearch, best, member):
    """The best hypothesis without one member, refitted."""
    rest = tuple(x for x in best.members if x is not member)
    sizes = np.cumsum([len(x.variant.params) for x in best.members])[:-1]
    values = np.split(search._values(best), sizes)
    kept = [v for x, v in zip(best.members, values, strict=True) if x is not member]
    return search.fit(rest, np.concatenate(kept) if kept else np.zeros(0), best, quick=True)


def _weight(f: dict) -> float:
    h = f["held_out"]
    return (h["before"] - h["after"]) if h else 0.0


def _curve(case, runs, rows, q0, q1, worst) -> Curve:
    t, r = case.plant.t[rows], case.plant.run_of[rows]
    run = r[worst]
    pick = np.flatnonzero((r == run) & (np.abs(t - t[worst]) < 4.0))
    command = runs[run].command_at(t[pick])[:, case.index]
    return Curve(case.joint, runs[run].name, t[pick], case.plant.q[rows][pick], q0[pick], q1[pick], command)


def _step(runs: list[Run]) -> float:
    """Integration step [s]: 1 ms, and no coarser than half a sampling period."""
    period = min(float(np.median(np.diff(r.t))) for r in runs)
    return float(min(1e-3, period / 2)) if period > 4e-4 else float(period)


def _split(runs, held, group):
    """(training runs, test runs, spans of both, in words)."""
    if held:
        train = [i for i in range(len(runs)) if i not in held]
        return train, held, None, None, "the held_out recordings " + ", ".join(runs[i].name for i in held)
    groups = sorted(set(group))
    if len(groups) >= 3:
        test = [i for i in range(len(runs)) if group[i] == groups[-1]]
        train = [i for i in range(len(runs)) if i not in test]
        if sum(runs[i].duration for i in train) > sum(runs[i].duration for i in test):
            return train, test, None, None, "one condition, " + ", ".join(runs[i].name for i in test)
    every = list(range(len(runs)))
    cut = {i: (1 - KEEP_OUT) * runs[i].duration for i in every}
    return every, every, {i: (0.0, cut[i]) for i in every}, {i: (cut[i], runs[i].duration) for i in every}, (
        f"the last {100 * KEEP_OUT:.0f} % of each recording's time"
    )


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
    from dexsim.gap.touch_effects import BY_ID

    asked = [e for e in sorted(s.allowed or ()) if e in left_out]
    return [f"{e} cannot be seen here: {left_out[e]}; to see it: {(EFFECTS.get(e) or BY_ID[e]).experiment}" for e in asked]


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


def _touch_verdict(felt: touch.TouchResult) -> str | None:
    """The word for touch alone; None where it was not judged."""
    if felt.before is None:
        return "explained" if felt.findings else None
    named = [{"held_out": True} for f in felt.findings]
    word = judge.verdict(named, felt.floor, felt.before[0], felt.before[1], felt.after[0], felt.structured)
    return "partly_explained" if word == "explained" and felt.structured else word


def _with_touch(d: Diagnosis, felt: touch.TouchResult) -> None:
    """Touch into the diagnosis of the joints: findings, the verdict of both, the metric of what was found."""
    d.touch = felt
    word = _touch_verdict(felt)
    if word is None:
        return
    data = d.data
    joints = data["verdict"]
    bad = [f for f in data["findings"] if f["effect"] == "bad_channel"]
    rest = [f for f in data["findings"] if f["effect"] != "bad_channel"]
    data["findings"] = bad + rest + sorted(felt.findings, key=lambda f: -f["confidence"])
    data["nuisance"] |= felt.nuisance
    if felt.floor is not None:
        data["noise_floor"]["tactile_N"] = felt.floor
    if "none" in (joints, word):
        data["verdict"] = word if joints == "none" else joints
    elif joints != word:
        data["verdict"] = "partly_explained"
    if not rest and (felt.findings or joints == "none") and felt.before is not None and word != "none":
        _touch_metric(data, felt)
    data["unexplained"]["depends_on"] += felt.depends_on if data["verdict"] not in ("none", "explained") else []
    d.sentence = _sentence(data, d, data["noise_floor"]["position_rad"])


def _touch_metric(data: dict, felt: touch.TouchResult) -> None:
    (b, bl, bh), (a, al, ah) = felt.before, felt.after
    data["held_out"] = {"recordings": felt.recordings, "error": "tactile_rmse_N", "before": b, "after": a, "before_low": bl, "before_high": bh,
                        "after_low": al, "after_high": ah, "how": "presses kept out of the fit"}  # fmt: skip
    gap = b**2 - felt.floor**2
    data["unexplained"]["fraction_of_gap"] = round(float(np.clip((a**2 - felt.floor**2) / gap, 0.0, 1.0)), 4) if gap > 0 and b > 1.3 * felt.floor else 0.0


def _touch_only(channel, felt: touch.TouchResult, notes, m) -> Diagnosis:
    """A diagnosis of touch where no joint could be judged."""
    data = empty(_touch_verdict(felt) or "unusable")
    data["noise_floor"] = {"position_rad": None, "how": "quantum", "tactile_N": felt.floor}
    data["findings"] = channel + sorted(felt.findings, key=lambda f: -f["confidence"])
    data["nuisance"] = dict(felt.nuisance)
    if felt.before is not None:
        _touch_metric(data, felt)
    else:
        data["held_out"]["error"] = "tactile_rmse_N"
    data["unexplained"]["depends_on"] = felt.depends_on if data["verdict"] not in ("none", "explained") else []
    out = Diagnosis(data, "", notes, mechanism=m, touch=felt)
    out.sentence = _sentence(data, out, felt.floor or 0.0)
    return out


def _sentence(data: dict, d: Diagnosis, floor: float | None) -> str:
    """The verdict in one or two sentences."""
    h = data["held_out"]
    metric = h["error"]
    effort = metric.startswith("effort")
    unit = ("mN" if metric.endswith("_N") else "mN.m") if effort else "mN" if metric.startswith("tactile") else "mm" if metric.endswith("_m") else "mrad"
    if unit == "mN" and not effort:
        floor = data["noise_floor"].get("tactile_N")
    before, after = 1e3 * (h["before"] or 0), 1e3 * (h["after"] or 0)
    limit = f"the floor is {1e3 * floor:.2g}" if floor is not None and not effort else ""
    named = [f for f in data["findings"] if entry(f) is not None]
    bad = [f for f in data["findings"] if f["effect"] == "bad_channel"]
    prefix = f"{len(bad)} signal{'s are' * (len(bad) > 1) or ' is'} not what {'they say' if len(bad) > 1 else 'it says'} ({bad[0]['regime']}). " if bad else ""
    if data["verdict"] == "none":
        return prefix + f"Nothing in the catalogue is missing: the simulator follows recordings not used for the fit to {before:.2g} {unit}; {limit}."
    if not named:
        depends = "; it depends on " + ", ".join(data["unexplained"]["depends_on"][:2]) if data["unexplained"]["depends_on"] else ""
        return prefix + f"Something is missing that no effect of the catalogue explains: {number(before)} {unit} are left where {limit}{depends}."
    of = ""
    alone = {j for f in named for j in f["where"]["joints"]}
    if len(alone) == 1 and len(d.joints) > 1 and metric.startswith("position") and alone <= set(d.joints):  # not thinned by joints that are well
        of, mine = " of that joint", d.joints[next(iter(alone))]
        before, after = 1e3 * mine["before"], 1e3 * mine["after"]
    parts = []
    strong = [f for f in named if f["confidence"] >= WEAK] or named[:1]
    for f in strong[:2]:
        words = words_of(f, d.mechanism)
        others = " or ".join(x.replace("_", " ") for x in f["indistinguishable"] if x != f["effect"])
        parts.append(f"{spoken(f)} {words}{_size(f)}" + (f", or it is {others}: these recordings cannot tell" if others else ""))
    parts[0] = parts[0][:1].upper() + parts[0][1:] if not strong[0]["where"]["joints"] or strong[0]["where"]["joints"][0] in spoken(strong[0])[1:] else parts[0]
    left_out = len(named) - len(parts)
    more = f" ({left_out} more, {'smaller or less sure, ' if len(strong) < len(named) else ''}below)" if left_out else ""
    it = "it" if len(named) == 1 else "them"
    if h["before"] is None:
        return prefix + "; ".join(parts) + more + "."
    tail = f" Without {it} simulation{of} is wrong by {number(before)} {unit}; with {it}, by {number(after)} on recordings not used for the fit"
    return prefix + "; ".join(parts) + more + "." + tail + (f"; {limit}." if limit else ".")


ORDER = {"1": "first", "2": "second"}


def spoken(f: dict) -> str:
    """Where a finding sits as a person says it: the xHand's joints by finger, another mechanism's by name."""
    from dexsim.assets import xhand

    if len(f["where"]["joints"]) != 1:
        return place(f)
    joint = f["where"]["joints"][0]
    if joint not in xhand.JOINTS:
        return joint if "joint" in joint.lower() else f"joint {joint}"
    finger, _, rest = joint.partition("_")
    whose = {"thumb": "the thumb's", "mid": "the middle finger's", "pinky": "the little finger's"}.get(finger, f"the {finger} finger's")
    kind = "sideways joint" if "bend" in rest and finger != "thumb" else "bending joint" if "bend" in rest else f"{ORDER.get(rest[-1], '')} joint".strip()
    return f"{whose} {kind} ({joint})"


def words_of(f: dict, m: Mechanism | None) -> str:
    """What an effect does, in words, with its direction where its size tells that."""
    words, p = entry(f).words, f["parameters"]
    joint = next(iter(f["where"]["joints"]), None)
    if f["effect"] == "coulomb_friction" and m is not None and joint in m.joints:
        believed = float(m.column("coulomb_friction")[m.joints.index(joint)]) + float(np.ravel(m.spec.joint(joint).frictionloss)[0])
        return words.replace("more (or less)", "more" if p["torque"]["value"] > believed else "less")
    if f["effect"] == "inertia":
        return words.replace("more (or less)", "more" if p["armature"]["value"] > 0 else "less")
    if f["effect"] == "payload" and "mass" in p:
        return f"carries {'more' if p['mass']['value'] > 0 else 'less'} mass than the model"
    if f["effect"] == "payload":
        return "hangs in another direction of gravity than the model"
    return words


def place(f: dict) -> str:
    """Where a finding sits, in words."""
    if f["where"]["joints"]:
        return ", ".join(f["where"]["joints"])
    if f["where"]["taxels"]:
        from dexsim.assets import xhand

        pads = sorted({int(t.split(":")[0]) for t in f["where"]["taxels"]})
        count = len(f["where"]["taxels"])
        fingers = " and ".join(xhand.FINGERS[p] for p in pads)
        return f"the {fingers}'s pad" if count > 12 or f["effect"] != "tactile_gain" else f"the {fingers}'s pad (taxel{'s' * (count > 1)} {', '.join(t.split(':')[1] for t in f['where']['taxels'])})"
    return ", ".join(f["where"]["topics"])


def _size(f: dict) -> str:
    """The first parameter of a finding in words: degrees and millimetres where a person thinks in them."""
    name, p = next(iter(f["parameters"].items()), (None, None))
    if p is None or p["value"] is None or isinstance(p["value"], str):
        return ""
    number = np.atleast_1d(p["value"])  # com and tilt are vectors, gains one a taxel
    if len(number) > 4:
        return f" ({name} {number.min():.2g} to {number.max():.2g})"
    if p["unit"] == "rad" and len(number) == 1:
        return f" ({name} {np.degrees(number[0]):.3g} degrees)"
    if p["unit"] == "s" and len(number) == 1:
        return f" ({name.replace('_', ' ')} {1e3 * number[0]:.3g} ms)"
    return f" ({name.replace('_', ' ')} {' '.join(f'{v:.3g}' for v in number)}{' ' + p['unit'] if p['unit'] not in ('1', '') else ''})"


TABLE = {"coulomb_friction": ["triangles", "steps"], "stribeck_friction": ["triangles", "ladder"], "backlash": ["triangles", "chirp"],
         "load_friction": ["triangles", "holds"], "command_delay": ["steps", "chirp"], "lag": ["steps", "chirp"], "viscous_friction": ["ladder"],
         "torque_speed_limit": ["ladder", "steps"], "gain_mismatch": ["steps", "holds"], "inertia": ["chirp"], "payload": ["holds"],
         "position_offset": ["holds"]}  # fmt: skip
"""Motions that show an effect, where its hypotheses cannot be simulated over candidates."""


def _next(d: Diagnosis, s: Settings, m: Mechanism, outcomes: Sequence[tuple[Case, JointSearch, Outcome]] = (), recordings: Sequence[Any] = ()) -> None:
    """What to record next, written ready to send where a safe plan exists."""
    data = d.data
    named = [f for f in data["findings"] if entry(f) is not None]
    unsure = [f for f in named if f["indistinguishable"] or f["confidence"] < 0.8]
    kinds, joints, why = None, None, ""
    if unsure and not unsure[0]["where"]["joints"]:
        _next_touch(d, s, m, unsure[0], recordings)
        return
    if unsure:
        f = unsure[0]
        rivals = list(dict.fromkeys(f["indistinguishable"] or [f["effect"], *(a["effect"] for a in f["alternatives"][:1])]))
        joints = f["where"]["joints"]
        kinds = sorted({k for e in rivals for k in TABLE.get(e, ["steps", "chirp", "triangles"])})
        head = f"to tell {' from '.join(rivals)} on {joints[0]}" if len(rivals) > 1 else f"to make sure of {rivals[0]} on {joints[0]}"
        experiment = separating(rivals) if all(r in EFFECTS for r in rivals) else EFFECTS[f["effect"]].experiment
        why = f"{head}: {experiment}"
        choice = _choice(d, s, m, outcomes, f, rivals)
        if choice is not None:
            kinds = choice.chosen
            why = f"{head}: {' and '.join(kinds)}, because {choice.text}" if choice.settles else f"{why}. Of the motions that can be planned here, {choice.text}"
    elif data["verdict"] in ("unknown", "partly_explained"):
        worst = max(d.joints, key=lambda j: d.joints[j]["after"]) if d.joints else None
        joints, kinds = ([worst] if worst else None), ["triangles", "ladder", "chirp", "steps", "holds"]
        why = f"what is left on {worst} is not explained: every kind of motion, with repeats"
    if not why:
        return
    data["next_recording"] = {"why": why, "commands": None}
    try:
        from dexsim.recording.excitation import next_recording

        s.out.mkdir(parents=True, exist_ok=True)
        next_recording(s.out / "next_recording.mcap", m, joints, kinds, seed=s.seed)
        data["next_recording"]["commands"] = "next_recording.mcap"
    except UserError as error:
        d.notes.append(f"no commands for the next recording: {error}")


def _choice(d: Diagnosis, s: Settings, m: Mechanism, outcomes, f: dict, rivals: list[str]):
    """The motions on which the finding's hypotheses disagree most; None where they cannot be simulated or planned."""
    from dexsim.gap import next_experiment

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
    """The presses again, as they were sent, with what was missing: nothing else is known to be safe against the object."""
    names = " from ".join(dict.fromkeys(f["indistinguishable"] or [f["effect"]]))
    why = f"to tell {names} on {place(f)}: {entry(f).experiment}; the same commands, with /external_force of a load cell recorded beside /tactile"
    d.data["next_recording"] = {"why": why, "commands": None}
    pads = {w["recording"] for w in f["when"]}
    sent = [r for r in recordings if r.path.name in pads and len(r.commands)]
    if not sent:
        return
    from dexsim.recording.writer import Writer

    best = max(sent, key=lambda r: sum(w["end"] - w["start"] for w in f["when"] if w["recording"] == r.path.name))
    meta = {k: v for k, v in best.meta.items() if k in ("robot", "gravity")} | {
        "source": "sim", "effort_is": "none", "effort_sign": "+1", "notes": f"commands to send, not a measurement: those of {best.path.name}"}  # fmt: skip
    s.out.mkdir(parents=True, exist_ok=True)
    with Writer(s.out / "next_recording.mcap", best.joints, meta, start_ns=1_000_000_000) as w:
        for t, row in zip(best.commands.t, best.commands.value, strict=True):
            w.add_command(float(t), row)
    d.data["next_recording"]["commands"] = "next_recording.mcap"


def save(d: Diagnosis, out: Path) -> list[Path]:
    """Writes diagnosis.json, details.json, report.html, servo.yaml and, where there is something in them, model.xml and tactile.yaml; returns
    what was written."""
    from dexsim.gap.report import page

    out.mkdir(parents=True, exist_ok=True)
    written = []
    d.notes = grouped(d.notes)
    path = out / "diagnosis.json"
    asked, more = specified(d.data)
    path.write_text(json.dumps(_plain(asked), indent=1, allow_nan=False), encoding="utf-8")
    written.append(path)
    more |= {"notes": d.notes, "seconds": d.shares}
    path = out / "details.json"
    path.write_text(json.dumps(_plain(more), indent=1, allow_nan=False), encoding="utf-8")
    written.append(path)
    if d.evidence:
        path = out / "evidence.json"
        path.write_text(json.dumps(_plain([e.plain() for e in d.evidence]), indent=1, allow_nan=False), encoding="utf-8")
        written.append(path)
    if d.servo is not None:
        d.servo.save(out / "servo.yaml")
        written.append(out / "servo.yaml")
    if d.touch is not None and touch_handed.save(touch_handed.handed(d.touch.findings, d.touch.facts), out / "tactile.yaml"):
        written.append(out / "tactile.yaml")
    if d.standins:
        standin.write(d.servo, d.standins, out / "servo_standin.yaml")
        written.append(out / "servo_standin.yaml")
    if d.model_spec is not None:
        try:
            d.model_spec.compile()
            save_model(d.model_spec, out / "model.xml")
            written.append(out / "model.xml")
        except (ValueError, OSError, mujoco.FatalError) as error:
            d.notes.append(f"model.xml could not be written: {error}")
    if (d.data["next_recording"] or {}).get("commands"):
        written.append(out / d.data["next_recording"]["commands"])
    path = out / "report.html"
    path.write_text(page(d), encoding="utf-8")
    written.append(path)
    return written


BEYOND = (("reason",), ("held_out", "how"), ("held_out", "confirmed"), ("unexplained", "not_considered"))


def specified(data: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """(what diagnosis.json holds, and nothing else: programs rely on its keys; what is known beyond that, for details.json)."""
    asked, more = copy.deepcopy(data), {}
    for *parents, key in BEYOND:
        there = asked[parents[0]] if parents else asked
        if key in there:
            (more.setdefault(parents[0], {}) if parents else more)[key] = there.pop(key)
    return asked, more


def grouped(notes: Sequence[str]) -> list[str]:
    """Notes that several recordings share, said once: "a.mcap, b.mcap: ..." with at most three names."""
    out: dict[str, list[str]] = {}
    for note in notes:
        name, colon, text = note.partition(": ")
        if colon and name.endswith((".mcap", ".bag")) and " " not in name:
            out.setdefault(text, []).append(name)
        else:
            out.setdefault(note, [])
    join = lambda names: ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")  # noqa: E731
    return [f"{join(list(dict.fromkeys(names)))}: {text}" if names else text for text, names in out.items()]


def _plain(x: Any) -> Any:
    if isinstance(x, dict):
        return {str(k): _plain(v) for k, v in x.items()}
    if isinstance(x, (list, tuple)):
        return [_plain(v) for v in x]
    if isinstance(x, (np.floating, float)):
        return float(x) if np.isfinite(x) else None
    if isinstance(x, np.integer):
        return int(x)
    return x


__all__ = ["SERVO_INDEX", "Diagnosis", "Fitter", "Settings", "diagnose", "expand", "save"]
