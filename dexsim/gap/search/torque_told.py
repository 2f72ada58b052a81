"""What the torque route says of each joint, and what becomes of it: beliefs, findings, and figures that are handed
on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from dexsim.gap.effects.command_delay import CommandDelay
from dexsim.gap.rules import TORQUE
from dexsim.gap.search import body_torque
from dexsim.gap.search.body_torque import HEAVY, NAMES, PER_CUTOFF, columns_of, moved, readable
from dexsim.gap.search.inverse_dynamics import BY_DIRECTION, LAG, LOAD, STRIBECK, solve

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case
    from dexsim.gap.read.runs import Run
    from dexsim.gap.result import Diagnosis

SHORTEST, FEWEST = 5.0, 500  # s, samples in all: of what is fitted


def found(
    cases: Sequence[Case],
    runs: Sequence[Run],
    train: Sequence[int],
    test: Sequence[int],
    seed: int = 0,
    model: mujoco.MjModel | None = None,
    span_train: dict[int, tuple[float, float]] | None = None,
    span_test: dict[int, tuple[float, float]] | None = None,
) -> list[tuple]:
    """(case, Inverse, names of the recordings that judged its further effects) of each joint whose motor torque was
    logged in N.m, fast and long enough. Without `model` only joints that neither gravity nor others load. span_*: part
    of each run [s from its start]."""
    out, motions = [], {}
    for case in cases:
        if model is None and (case.scales.gravity > HEAVY * case.scales.tau or case.scales.others):
            continue
        use = [r for r in train if readable(runs[r], case.index)]
        judge = [r for r in test if readable(runs[r], case.index) and (r not in train or span_test is not None)]
        if not use or not case.moved:
            continue

        def at(cutoff: float, case=case, use=use, judge=judge):
            def piece(r: int, span):
                if (r, cutoff) not in motions:
                    motions[r, cutoff] = moved(runs[r], model, cutoff)
                return *motions[r, cutoff], None if span is None else span.get(r)

            efficiency = float(case.scales.nominal.get("efficiency", 1.0))
            own = columns_of([piece(r, span_train) for r in use], case.index, efficiency)
            if not judge:
                return own, own
            # the same columns: gravity may matter in what is fitted and hardly in what judges, or the other way round
            return own, columns_of([piece(r, span_test) for r in judge], case.index, efficiency, own.loaded)

        top = min(body_torque.highest(runs[r].t) for r in use)
        first = at(top)[0]
        if (
            len(first.u) < FEWEST * min(PER_CUTOFF * top * float(np.median(np.diff(runs[use[0]].t))), 1.0)
            or first.seconds < SHORTEST
        ):
            continue
        out.append((case, solve(at, top, seed), [runs[r].name for r in judge]))
    return out


def texts(given: Sequence[tuple]) -> list[str]:
    """What `found` gave, in words."""
    out = []
    for case, x, judged in given:
        said = ", ".join(f"{n.replace('_', ' ')} {x.value[n]:.4g} ({x.low[n]:.4g} to {x.high[n]:.4g})" for n in NAMES)
        text = (
            f"{case.joint}: by the recorded motor torque alone: {said}; {100 * x.residual:.1f} % of the torque is left"
        )
        text += "".join(f"; {n.replace('_', ' ')}: {why}" for n, why in x.refused.items())
        where = " in the recording kept out" if judged else ""
        for k, n in enumerate(x.named):
            size = f" ({1e3 * n.value / x.full['inertia']:.2g} ms)" if n.effect == LAG else ""
            text += (
                f"; {'then ' if k else ''}{n.text}{size} takes {100 * (1 - n.after / n.before):.0f} % of that "
                f"away{where}"
            )
        out.append(text)
    return out


def believe(given: Sequence[tuple]) -> list[str]:
    """Writes what the torque tells into the belief of what was unknown, so that the search in closed loop starts from
    it; in words.

    Friction of which nothing is believed, and then the inertia too, within what the residuals allow.
    """
    from dexsim.actuator.columns import INDEX as SERVO
    from dexsim.gap.plant.case import BELIEF

    said = []
    for case, x, _ in given:
        open_ = [n for n in ("viscous_friction", "coulomb_friction") if n in case.unknown]
        said += [
            f"{case.joint}: no {n.replace('_', ' ')} is taken from the recorded motor torque: {why}"
            for n, why in x.refused.items()
            if n in open_
        ]
        # friction that falls with speed leaves no viscous part
        open_ = [n for n in open_ if n not in x.refused or n == "viscous_friction"]
        if not open_ or x.value["coulomb_friction"] <= 0:
            continue
        if x.residual > TORQUE.trusted:
            said.append(
                f"{case.joint}: the recorded motor torque is no witness: {100 * x.residual:.0f} % of it fits no "
                "inertia, gravity or friction"
            )
            continue
        values = {n: (x.value[n], max(x.low[n], 0.0), x.high[n]) for n in open_}
        if "coulomb_friction" in open_ and case.scales.nominal["friction_asymmetry"] == 0:
            per = 2.0 / x.value["coulomb_friction"]
            values["friction_asymmetry"] = tuple(
                float(np.clip(per * v, -2, 2)) for v in (x.value["offset"], x.low["offset"], x.high["offset"])
            )
        for name, (value, low, high) in values.items():
            for row in case.plant.nominal:
                row[SERVO[name]] = value
            case.scales.nominal[name] = value
            case.ranges[name] = (low, max(high, low + 1e-9))
        case.unknown = tuple(n for n in case.unknown if n not in open_)
        case.told = True
        factor = x.value["inertia"] / max(case.scales.inertia, 1e-12)
        if abs(factor - 1) < BELIEF and "inertia" not in x.refused:
            half = max(0.5 * (x.high["inertia"] - x.low["inertia"]) / x.value["inertia"], 1e-3)
            case.factors["inertia"] = (factor - half, factor + half)
        said.append(
            f"{case.joint}: {' and '.join(n.replace('_', ' ') for n in open_)} was unknown and is taken from the "
            "recorded motor torque"
        )
    return said


def hand_on(
    given: Sequence[tuple],
    d: Diagnosis,
    outcomes: Sequence[tuple],
    test: Sequence[int],
    span_test: dict | None,
    stages: Sequence = (),
) -> None:
    """Writes the torque's figures into the servo table that is handed on, and the nuisances, where a joint's closed
    loop does not say otherwise: what it was refitted to then is the fit's own wandering.

    d: the Diagnosis; outcomes: (case, search, outcome) of each joint. A closed loop says otherwise where a free run
    over what was kept out is followed better than to `TORQUE.alike` with its own figures, or where a finding of at
    least a half is about them; not where `stages` say that the drive itself is not as believed, since what its loop
    does then speaks of the drive.
    """
    strange = {x.joint for x in stages if not x.sound}
    by = {case.joint: (search, outcome) for case, search, outcome in outcomes}
    for case, x, _ in given:
        if not case.told or case.joint not in by:
            continue
        search, outcome = by[case.joint]
        held = [f for f in d.data["findings"] if f["confidence"] >= 0.5 and case.joint in f["where"]["joints"]]
        trial = search.polish(outcome.best if held else outcome.none)
        claimed = {c for m in trial.members for p in m.variant.params for c in p.columns}
        told = [
            n
            for n in ("viscous_friction", "coulomb_friction", "friction_asymmetry")
            if n in case.ranges and n not in claimed
        ]
        ours = {n: case.scales.nominal[n] for n in told}
        if "inertia" in case.factors and "inertia_scale" not in claimed:
            ours["inertia"] = x.value["inertia"] / case.scales.inertia
        if not told or not (case.joint in strange or _alike(case, search, trial, ours, test, span_test)):
            continue
        for name in told:
            d.servo.set(
                case.joint, name, round(case.scales.nominal[name], 9), *(round(v, 9) for v in case.ranges[name])
            )
            if f"{name}@{case.joint}" in d.data["nuisance"]:
                d.data["nuisance"][f"{name}@{case.joint}"] = round(case.scales.nominal[name], 6)
        if "inertia" in ours:
            d.data["nuisance"][f"inertia_factor@{case.joint}"] = round(ours["inertia"], 6)
        d.notes.append(
            f"{case.joint}: friction is handed on as the recorded torque tells it; its closed loop does not tell it "
            "better"
        )


def unknown_controllers(given: Sequence[tuple], stages: Sequence, notes: list[str]) -> set[str]:
    """Joints of which the torque told, but whose logged torque is not what the believed law of the drive gives, hardly
    in part: their closed loop speaks of an unknown controller, and no effect of the joint is looked for in it. Said in
    `notes`."""
    told = {case.joint for case, _, _ in given if case.told}
    out = {x.joint for x in stages if x.joint in told and x.fit < TORQUE.follows}
    for x in stages:
        if x.joint in out:
            notes.append(
                f"{x.joint}: the believed law of its drive gives {100 * max(x.fit, 0.0):.0f} % of the torque that was "
                "logged: its controller is another, "
                "and only the torque is judged"
            )
    return out


def _alike(case, search, trial, ours: dict[str, float], test: Sequence[int], span_test: dict | None) -> bool:
    """Whether what was kept out is followed as well with the torque's figures as with those that the closed loop was
    refitted to."""
    from dexsim.gap.judge.errors import free_run

    whole = replace(case, plant=search.whole)
    windows = whole.plant.windows(None, test, span=span_test)
    params, fixed = trial.fit.params, [f for m in trial.members for f in m.variant.fixed]
    told = np.array([ours.get(p.key, x) for p, x in zip(params, trial.fit.x, strict=True)])
    measured = whole.plant.q[windows.sample_row]
    error = [
        float(np.sqrt(np.mean((measured - free_run(whole, params, x, windows, fixed, True)[0]) ** 2)))
        for x in (trial.fit.x, told)
    ]
    return error[1] <= TORQUE.alike * error[0] + 0.1 * case.sigma


def findings(given: Sequence[tuple], unknown: Sequence[str], runs: list[Run], train: list[int]) -> list[dict]:
    """The further effects as findings of `diagnosis.json`, for joints of which nothing of the friction was believed
    (`unknown`)."""
    from dexsim.gap.effects.catalogue import EFFECTS
    from dexsim.gap.judge.errors import intervals_of

    out = []
    for case, x, judged in given:
        force, length = ("N", "m") if case.scales.slide else ("N.m", "rad")
        for n in x.named if case.joint in unknown and judged else ():
            if not n.effect:
                continue
            entry = lambda v, lo, hi, unit: {"value": v, "low": min(lo, hi), "high": max(lo, hi), "unit": unit}  # noqa: E731
            if n.effect == LAG:
                m = x.full["inertia"]
                parameters = {"time_constant": entry(n.value / m, n.low / m, n.high / m, "s")}
            elif n.effect == STRIBECK:
                parameters = {
                    "peak": entry(n.value, n.low, n.high, force),
                    "v_s": entry(n.speed, 0.5 * n.speed, 2 * n.speed, f"{length}/s"),
                }
            elif n.effect == LOAD:
                parameters = {"fraction": entry(n.value, n.low, n.high, "1")}
            else:
                f = x.full["viscous_friction"]
                parameters = {"coefficient": entry(f, f * 0.95, f * 1.05, f"{force}.s/{length}"),
                              "asymmetry": entry(2 * n.value / f, 2 * n.low / f, 2 * n.high / f, "1")}  # fmt: skip
            same = [LAG, CommandDelay.id] if n.effect == LAG else []
            signal = EFFECTS[n.effect].signal(case, {k: v["value"] for k, v in parameters.items()}, {})
            active = signal > 0.25 * max(float(np.percentile(signal, 99.9)), 1e-12)
            helped = 1 - (n.after / n.before) ** 2
            confidence = min(n.share, 0.95) * (1.0 if helped > TORQUE.further else 0.5)
            out.append(
                {
                    "effect": n.effect,
                    "confidence": round(float(confidence), 3),
                    "alternatives": [{"effect": n.rival, "confidence": round(1 - n.share, 3)}]
                    if n.rival and n.share < 1
                    else [],
                    "indistinguishable": same,
                    "separating_experiment": EFFECTS[n.effect].experiment if same else None,
                    "where": {"joints": [case.joint], "taxels": [], "topics": []},
                    "regime": EFFECTS[n.effect].shows + ("; differs by direction" if n.text == BY_DIRECTION else ""),
                    "when": intervals_of(active, case, runs, train),
                    "parameters": parameters,
                    "held_out": {
                        "before": n.before,
                        "after": n.after,
                        "error": f"effort_rmse_{force.replace('.', '')}",
                    },
                }
            )
    return out
