"""Scores diagnoses against the truth: the lines of the judging table, each with its interval."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.answers import SURE
from benchmarks.concealed import laws, touch_cases
from dexsim import intervals

LEAST = (0.5, SURE)  # confidences that a name may be asked for
TIERS = ("easy", "medium", "hard")
CLASSES = tuple(
    frozenset(c.split())
    for c in (
        "backlash stribeck_friction coulomb_friction", "command_delay lag",
        "viscous_friction torque_speed_limit gain_mismatch",
        "current_sensor payload gain_mismatch", "coulomb_friction load_friction",
        "supply_sag torque_speed_limit thermal",
        "position_offset payload", "tactile_gain contact_stiffness", "tactile_hysteresis thermal",
    )
)  # fmt: skip
"""Effects that recordings may fail to separate: a set within one of them, of three at most, may be an answer."""


def named_right(finding: dict | None, effect: str) -> bool:
    """Return whether the first finding holds the effect: by name, or in an allowed set that holds it."""
    if finding is None:
        return False
    group = set(finding.get("indistinguishable") or []) | {finding["effect"]}
    if len(group) > 1 and len(group) <= 3 and effect in group and any(group <= c for c in CLASSES):
        return True
    return finding["effect"] == effect


def sure(diagnosis: dict) -> list[dict]:
    """Return the findings that name one effect with confidence."""
    return [
        f for f in diagnosis["findings"] if f["confidence"] >= SURE and len(set(f.get("indistinguishable") or [])) < 2
    ]


TRAIN = ("a", "b", "c")


def _f1(hits: int, said: int, true: int) -> float:
    return 2 * hits / (said + true) if said + true else 1.0


def overlap(finding: dict, truth: list[list], step: float = 1e-3, seconds: float = 60.0) -> float:
    """Return the intersection over union of the finding's `when` with the true stretches [[recording, start, end]]."""
    n = int(seconds / step)
    both = either = 0
    for letter in TRAIN:
        a, b = np.zeros(n, bool), np.zeros(n, bool)
        for r, start, end in truth:
            if r == letter:
                a[int(start / step) : int(end / step) + 1] = True
        for w in finding.get("when") or []:
            if Path(w["recording"]).stem == letter:
                b[int(max(w["start"], 0) / step) : int(w["end"] / step) + 1] = True
        both, either = both + int((a & b).sum()), either + int((a | b).sum())
    return both / either if either else 0.0


def _parameters(finding: dict | None, truth: dict) -> tuple[list[float], list[bool]]:
    """Return the relative errors of the sizes, and whether their 90 % intervals hold the truth."""
    errors, covered = [], []
    for key, value in truth["parameters"].items():
        got = ((finding or {}).get("parameters") or {}).get(key)
        if not got or not isinstance(got.get("value"), (int, float)) or not value:
            continue
        v, low, high = got["value"], got.get("low"), got.get("high")
        if key == "eccentricity":
            value = abs(value)
        if key == "scale":  # 1 is right: the error is of what is off
            errors.append(abs(v - value) / abs(value - 1))
        else:
            errors.append(abs(v - value) / abs(value))
        if low is not None and high is not None:
            covered.append(bool(low <= value <= high))
    return errors, covered


def _removed(d: dict, effects: list[dict], joints: int) -> float | None:
    """Share of the explainable held-out error of the effect's joint that is gone; None where there is next to none."""
    e = effects[0]
    floor, known = e["facts"]["floor"], e["facts"].get("before")
    if e["effect"] == "current_sensor" or known is None or known < 1.3 * floor:
        return None
    h = d.get("held_out") or {}
    if joints > 1:  # the joint's own, as its findings have it
        mine = [f["held_out"] for f in d["findings"] if e["joint"] in f["where"]["joints"] and f.get("held_out")]
        h = (
            {"before": max(x["before"] for x in mine), "after": min(x["after"] for x in mine)}
            if mine
            else {"before": known, "after": known}
        )
    if h.get("before") is None or h.get("after") is None:
        return 0.0
    return (
        float(np.clip((h["before"] - h["after"]) / (h["before"] - floor), -1.0, 1.0))
        if h["before"] > 1.3 * floor
        else None
    )


def law_of(effect: dict) -> str:
    """Return which law a true effect follows: "first", "second", or "only" where it has one. Truths of before laws
    were drawn
    do not say: they are all of the first."""
    two = laws.SECOND.keys() | touch_cases.SECOND.keys()
    return effect.get("law") or ("first" if effect["kind"] in two else "only")


def one(truth: dict, d: dict) -> dict:
    """Return what the table needs of one case: truth and `diagnosis.json`. Missing figures are absent."""
    findings = list(d["findings"])  # in the tool's own order: its first name counts
    physics = [f for f in findings if f["effect"] != "bad_channel"]
    effects = truth["effects"]
    first = physics[0] if physics else (findings[0] if findings else None)
    out = {"name": truth["name"], "group": truth["group"], "decoy": truth["decoy"], "shape": truth["shape"],
           "tier": truth["tier"],
           "hidden": [(e["effect"] or e["kind"], e["joint"]) for e in effects], "kinds": [e["kind"] for e in effects],
           "laws": [law_of(e) for e in effects], "confidence": first["confidence"] if first else 0.0,
           "verdict": d["verdict"],
           "said": [(f["effect"], (f["where"]["joints"] or f["where"]["topics"] or ["-"])[0],
                     round(f["confidence"], 2), sorted(set(f.get("indistinguishable") or [])))
                    for f in findings], "ratio": effects[0]["facts"].get("ratio") if effects else None}  # fmt: skip
    confident = sure({"findings": physics})
    true_ids = {e["effect"] for e in effects if e["effect"]}

    # a linkage acts on both of the joints that it connects, a mass on all that carry it
    def ends(e: dict) -> list[str]:
        return [e["joint"], *e["also"]]

    def right_here(f: dict, e: dict) -> bool:
        joints = f["where"]["joints"]
        return named_right(f, e["effect"]) and (not joints or any(j in joints for j in ends(e)))

    group = truth["group"]
    inside = group in ("effect", "pair") or (group in ("hand", "large", "touch", "spatial") and effects)
    out["wrong_sure"] = any(
        f["effect"] not in true_ids or not any(f["effect"] == e["effect"] and right_here(f, e) for e in effects)
        for f in confident
    )
    if inside:
        if len(effects) == 1:
            e = effects[0]
            out["right"] = named_right(first, e["effect"])
            out["alone"] = bool(
                first and first["effect"] == e["effect"] and len(set(first.get("indistinguishable") or [])) < 2
            )
            mine = next(
                (
                    f
                    for f in physics
                    if f["effect"] == e["effect"] and e["joint"] in (f["where"]["joints"] or [e["joint"]])
                ),
                None,
            )
            out["parameter_errors"], out["covered"] = _parameters(mine, e)
            if mine is not None and e["when"]:
                out["overlap"] = overlap(mine, e["when"])
            elif e["when"]:
                out["overlap"] = 0.0
        hit = [e for e in effects if any(right_here(f, e) for f in physics)]
        out["f1"] = [len(hit), len(physics), len(effects)]
        said_joints = {j for f in physics for j in f["where"]["joints"]}
        # of several joints at which it is true, those that were named
        true_joints = {j for e in effects for j in ([j for j in ends(e) if j in said_joints] or [e["joint"]])}
        if truth["joints"] > 1:
            out["joint_f1"] = [len(said_joints & true_joints), len(said_joints), len(true_joints)]
        out["removed"] = _removed(d, effects, truth["joints"]) if len(effects) == 1 else None
    elif group in ("none", "noise") or (group in ("hand", "touch", "spatial") and not effects):
        out["false_alarm"] = bool(findings) or d["verdict"] == "failed"
        out["alarm"] = 1.0 if d["verdict"] == "failed" else max((f["confidence"] for f in findings), default=-1.0)
    elif group == "outside":
        out["humble"] = d["verdict"] not in ("explained", "failed") and not confident
        out["wrong_sure"] = bool(confident)
    else:
        decoy = truth["decoy"]
        if decoy == "bad_channel":
            out["caught"] = d["verdict"] == "unusable" or any(f["effect"] == "bad_channel" for f in findings)
            out["wrong_sure"] = bool(confident)
        elif decoy == "confounded":  # friction really grows: what is wrong is to put it down to temperature
            out["caught"] = out["wrong_sure"] = False
            out["wrong_sure"] = any(f["effect"] != "coulomb_friction" for f in confident)
            out["caught"] = not any(f["effect"] == "thermal" and f["confidence"] >= SURE for f in physics)
        elif decoy == "wrong_mass":  # mass and inertia of the believed model are off together
            out["caught"] = any(f["effect"] in ("payload", "inertia") for f in physics)
            out["wrong_sure"] = any(f["effect"] not in ("payload", "inertia") for f in confident)
        else:  # hardly excited, or touched by hand: not to be taken for something else
            out["caught"] = not out["wrong_sure"]
    return out


def rate(values: list) -> dict | None:
    """Return {value, low, high, n} of a share; None without cases."""
    values = [bool(v) for v in values]
    if not values:
        return None
    low, high = intervals.share(sum(values), len(values))
    return {"value": sum(values) / len(values), "low": low, "high": high, "n": len(values)}


def middle(values: list, statistic: Callable) -> dict | None:
    """Return {value, low, high, n} of a statistic, with its 95 % interval by resampling; None without cases."""
    if not values:
        return None
    low, high = intervals.bootstrap(*of_rows(values, statistic), 0, 2000)
    return {"value": float(statistic(values)), "low": float(low), "high": float(high), "n": len(values)}


def of_rows(rows: np.ndarray, statistic: Callable) -> tuple[tuple[np.ndarray], Callable]:
    """Return (samples, statistic) as `intervals.draws` takes them, of any statistic(rows [E, ...]) of one number."""
    rows = np.asarray(rows)

    def each(index: np.ndarray, axis: int = -1) -> np.ndarray:
        return np.apply_along_axis(lambda i: statistic(rows[i.astype(int)]), axis, index)

    return (np.arange(len(rows)),), each


def alone_at(r: dict, least: float) -> bool:
    """Return whether the hidden effect was named first, alone, with at least this confidence."""
    return r["alone"] and r.get("confidence", r["said"][0][2] if r["said"] else 0.0) >= least


def by_law(results: list[dict]) -> dict[str, dict[str, dict]]:
    """Return figures of the cases with one effect that has two laws, {line: {"first" or "second": {value, low, high,
    n}}}; and of those with but one ("only")."""
    lines: dict[str, dict[str, dict]] = {}
    for law in ("first", "second", "only"):
        mine = [r for r in results if "right" in r and r.get("laws") == [law]]
        found: dict[str, dict | None] = {}
        for tier in TIERS:
            found[f"right effect first, {tier}"] = rate([r["right"] for r in mine if r["tier"] == tier])
        found["right effect first, all"] = rate([r["right"] for r in mine])
        found[f"named alone at {SURE:g} or more, all"] = rate([alone_at(r, SURE) for r in mine])
        found["confident and wrong"] = rate([r["wrong_sure"] for r in mine])
        found["parameter error, median"] = middle([e for r in mine for e in r["parameter_errors"]], np.median)
        found["90 % interval covers the truth"] = rate([c for r in mine for c in r["covered"]])
        for line, value in found.items():
            if value is not None:
                lines.setdefault(line, {})[law] = value
    return lines


def table(results: list[dict]) -> dict[str, dict]:
    """Return the lines of the table: {line: {value, low, high, n}}; a line without cases is left out."""
    lines: dict[str, dict] = {}

    def put(line: str, value: dict | None) -> None:
        if value is not None:
            lines[line] = value

    def f1(line: str, counts: list) -> None:
        put(line, middle(counts, lambda x: _f1(*np.sum(np.asarray(x), 0))))

    hidden = [r for r in results if "right" in r and r["group"] in ("effect", "hand", "large", "touch")]
    for tier in TIERS:
        put(f"right effect first, {tier}", rate([r["right"] for r in hidden if r["tier"] == tier]))
    for tier in TIERS:
        put(f"  of them named alone, {tier}", rate([r["alone"] for r in hidden if r["tier"] == tier]))
    for least in LEAST:
        for tier in TIERS:
            these = [alone_at(r, least) for r in hidden if r["tier"] == tier]
            put(f"  named alone at {least:g} or more, {tier}", rate(these))
    f1("right joint (F1), rigs of several", [r["joint_f1"] for r in hidden if r.get("joint_f1")])
    timed = [r for r in hidden if r.get("overlap") is not None]
    put("regime: overlap >= 0.5, where named right", rate([r["overlap"] >= 0.5 for r in timed if r["alone"]]))
    put("regime: overlap >= 0.5, all", rate([r["overlap"] >= 0.5 for r in timed]))
    f1("several effects at once (F1)", [r["f1"] for r in results if r["group"] == "pair"])
    put("parameter error, median", middle([e for r in hidden for e in r["parameter_errors"]], np.median))
    put("90 % interval covers the truth", rate([c for r in hidden for c in r["covered"]]))
    removed = [r["removed"] for r in hidden if r.get("removed") is not None]
    put("held-out error removed, mean", middle(removed, np.mean))
    put("held-out error removed, median", middle(removed, np.median))
    empty = [r for r in results if "false_alarm" in r]
    nothing = [r for r in empty if r["group"] in ("none", "noise")]
    put("false alarm, nothing missing", rate([r["false_alarm"] for r in nothing]))
    put("  with doubled noise", rate([r["false_alarm"] for r in nothing if r["group"] == "noise"]))
    for least in LEAST:
        put(f"  a name of {least:g} or more", rate([r["alarm"] >= least for r in nothing if "alarm" in r]))
    hand = [r for r in results if r["group"] in ("hand", "large")]
    put("hand: right effect first", rate([r["right"] for r in hand if "right" in r]))
    put(f"  named alone at {SURE:g} or more", rate([alone_at(r, SURE) for r in hand if "right" in r]))
    f1("  effects at two joints (F1)", [r["f1"] for r in hand if len(r["hidden"]) > 1])
    put("  confident and wrong", rate([r["wrong_sure"] for r in hand]))
    put("false alarm, hand", rate([r["false_alarm"] for r in empty if r["group"] == "hand"]))
    spatial = [r for r in results if r["group"] == "spatial"]
    for tier in ("easy", "medium"):
        these = [r["right"] for r in spatial if "right" in r and r["tier"] == tier]
        put(f"spatial rigs, geometry a little off: right effect first, {tier}", rate(these))
    put("  false alarm", rate([r["false_alarm"] for r in spatial if "false_alarm" in r]))
    put("  nothing missing, unknown", rate([r["verdict"] == "unknown" for r in spatial if "false_alarm" in r]))
    put("touch and contact: right effect first", rate([r["right"] for r in hidden if r["group"] == "touch"]))
    put("  false alarm", rate([r["false_alarm"] for r in empty if r["group"] == "touch"]))
    put("outside the catalogue: not claimed", rate([r["humble"] for r in results if r["group"] == "outside"]))
    put("decoys seen through", rate([r["caught"] for r in results if r["group"] == "decoy"]))
    for decoy in sorted({r["decoy"] for r in results if r["decoy"]}):
        put(f"  {decoy.replace('_', ' ')}", rate([r["caught"] for r in results if r["decoy"] == decoy]))
    put("confident and wrong, all cases", rate([r["wrong_sure"] for r in results]))
    return lines


def by_effect(results: list[dict]) -> list[tuple[str, str]]:
    """Count for each effect: right of all at each tier, and what it was taken for."""
    out = []
    for effect in sorted({r["hidden"][0][0] for r in results if "right" in r}):
        mine = [r for r in results if "right" in r and r["hidden"][0][0] == effect]
        parts = []
        for tier in TIERS:
            these = [r for r in mine if r["tier"] == tier]
            parts.append(f"{sum(r['right'] for r in these)}/{len(these)}" if these else "-")
        taken: dict[str, int] = {}
        for r in mine:
            if not r["right"]:
                name = r["said"][0][0] if r["said"] else "nothing"
                taken[name] = taken.get(name, 0) + 1
        out.append(
            (
                effect,
                f"{parts[0]:>6}{parts[1]:>8}{parts[2]:>7}"
                "   " + ", ".join(f"{k} {v}" for k, v in sorted(taken.items(), key=lambda x: -x[1])),
            )
        )
    return out


def show(lines: dict[str, dict], results: list[dict], cases: bool = True) -> str:
    """Return all as text."""
    out = []
    if cases:
        out.append(f"{'case':<10}{'group':<9}{'rig':<8}{'tier':<8}{'hidden':<44}{'verdict':<18}said")
        for r in results:
            hidden = (
                " + ".join(
                    f"{k}{' (2nd law)' * (law == 'second')}@{j}"
                    for k, law, (_, j) in zip(r["kinds"], r["laws"], r["hidden"], strict=True)
                )
                or r["decoy"]
                or "-"
            )
            said = (
                "; ".join(f"{e}@{j} {c:.2f}" + (f" {{{' '.join(g)}}}" if g else "") for e, j, c, g in r["said"][:3])
                or "-"
            )
            out.append(
                f"{r['name']:<10}{r['group']:<9}{r['shape']:<8}{r['tier']:<8}{hidden:<44}{r['verdict']:<18}{said}"
            )
    out += ["", f"{'effect hidden':<22}{'easy':>6}{'medium':>8}{'hard':>7}   taken for"]
    out += [f"{e:<22}{text}" for e, text in by_effect(results)]
    out += ["", f"{'figure':<44}{'value':>8}   {'95 % interval':<18}{'n':>4}"]
    out += [f"{k:<44}{v['value']:>8.3f}   {v['low']:.3f} .. {v['high']:<10.3f}{v['n']:>4}" for k, v in lines.items()]
    out += ["", f"{'effects that have two laws':<38}{'first law':>26}{'second law':>26}{'(one law only)':>26}"]
    for k, of in by_law(results).items():
        cells = [_cell(of.get(law)) for law in ("first", "second", "only")]
        out.append(f"{k:<38}" + "".join(f"{c:>26}" for c in cells))
    return "\n".join(out)


def _cell(v: dict | None) -> str:
    return f"{v['value']:.3f} ({v['low']:.2f}-{v['high']:.2f}) {v['n']:>4}" if v else "-"
