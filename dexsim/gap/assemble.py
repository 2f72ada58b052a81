"""From the search's answers to the diagnosis: errors on what was kept out, findings with their doubts, the verdict, the fitted servo and model."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dexsim.gap import confidence, jitter, judge, locate
from dexsim.gap.catalogue import EFFECTS, confusable, separating
from dexsim.gap.findings import finding_parameters, model_changes, servo_changes, widen
from dexsim.gap.fit import intervals
from dexsim.gap.prepare import Case
from dexsim.gap.result import Curve, Diagnosis, empty
from dexsim.gap.search import LEAST, JointSearch, Outcome, Trial
from dexsim.gap.sentence import sentence
from dexsim.gap.touch_effects import entry

DOUBTED = 0.8  # confidence below which training is also given what was believed before: of such names about half are true (docs/concealed.md)
NEUTRAL = 1.015  # x the error before on what was kept out: not more than this is not against a finding
ALONE = 2.0  # x the error where it was fitted: beyond it what was kept out shows something that the rest does not
SET_SHARE = 0.06  # of the bootstraps: a rival of the same class with as much belongs to the set


def assemble(s, m, runs, cases, outcomes, train, test, span_train, span_test, floor, floor_how, how, channel, notes, rng, clock) -> Diagnosis:
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
    out.sentence = sentence(data, out, floor)
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


def add_behind(d: Diagnosis, findings: list[dict], by_torque: Sequence[tuple]) -> None:
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
    d.sentence = sentence(data, d, data["noise_floor"]["position_rad"])
