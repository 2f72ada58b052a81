"""Scores diagnoses against the truth: the lines of the judging table that one-joint rigs allow, each with its interval."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

SURE = 0.8  # a name is confident from here, when it stands alone
CLASSES = tuple(
    frozenset(c.split())
    for c in (
        "backlash stribeck_friction coulomb_friction", "command_delay lag", "viscous_friction torque_speed_limit gain_mismatch",
        "current_sensor payload gain_mismatch", "coulomb_friction load_friction", "supply_sag torque_speed_limit thermal",
        "position_offset payload",
    )
)  # fmt: skip
"""Effects that recordings may fail to separate: a set within one of them, of three at most, may be an answer."""


def wilson(hits: int, n: int, z: float = 1.96) -> tuple[float, float]:
    """95 % interval of a rate (Wilson 1927)."""
    if n == 0:
        return 0.0, 1.0
    p, d = hits / n, 1 + z * z / n
    middle, half = (p + z * z / (2 * n)) / d, z / d * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return max(0.0, middle - half), min(1.0, middle + half)


def bootstrap(values: list[float], statistic: Callable, count: int = 2000) -> tuple[float, float]:
    """95 % interval of a statistic of `values` by resampling; (nan, nan) without any."""
    if not values:
        return math.nan, math.nan
    rng, x = np.random.default_rng(0), np.asarray(values)
    draws = [statistic(x[rng.integers(0, len(x), len(x))]) for _ in range(count)]
    return tuple(float(v) for v in np.percentile(draws, (2.5, 97.5)))


def named_right(finding: dict | None, effect: str) -> bool:
    """Whether the first finding holds the effect: by name, or in an allowed set that holds it."""
    if finding is None:
        return False
    group = set(finding.get("indistinguishable") or []) | {finding["effect"]}
    if len(group) > 1 and len(group) <= 3 and effect in group and any(group <= c for c in CLASSES):
        return True
    return finding["effect"] == effect


def sure(diagnosis: dict) -> list[dict]:
    """Findings that name one effect with confidence."""
    return [f for f in diagnosis["findings"] if f["confidence"] >= SURE and len(set(f.get("indistinguishable") or [])) < 2]


def one(truth: dict, d: dict) -> dict:
    """What the table needs of one case: truth and `diagnosis.json`. Missing figures are None."""
    findings = sorted(d["findings"], key=lambda f: -f["confidence"])
    first, effect = (findings[0] if findings else None), truth["effect"]
    out = {"name": truth["name"], "group": truth["group"], "kind": truth["kind"], "tier": truth["tier"], "verdict": d["verdict"],
           "said": first["effect"] if first else "-", "confidence": first["confidence"] if first else None,
           "set": sorted(set(first.get("indistinguishable") or [])) if first else []}  # fmt: skip
    confident = sure(d)
    if truth["group"] == "effect":
        out["right"] = named_right(first, effect)
        out["wrong_sure"] = any(f["effect"] != effect for f in confident)
        mine = next((f for f in findings if f["effect"] == effect), None)
        errors, covered = [], []
        for key, value in truth["parameters"].items():
            got = (mine or {}).get("parameters", {}).get(key)
            if got and isinstance(got["value"], (int, float)) and value:
                errors.append(abs(got["value"] - value) / abs(value))
                covered.append(bool(got["low"] <= value <= got["high"]))
        out |= {"parameter_errors": errors, "covered": covered}
        h, oracle = d.get("held_out") or {}, truth["floor"]
        # only where the effect stands out of the floor is there a gap to remove
        if h.get("before") is not None and h.get("after") is not None and h["before"] > 1.3 * oracle:
            out["removed"] = float(np.clip((h["before"] - h["after"]) / (h["before"] - oracle), -1.0, 1.2))
    elif truth["group"] in ("none", "noise"):
        out["false_alarm"] = bool(findings) or d["verdict"] == "failed"
        out["wrong_sure"] = bool(confident)
    elif truth["group"] == "outside":
        out["humble"] = d["verdict"] not in ("explained", "failed") and not confident
        out["wrong_sure"] = bool(confident)
    else:  # a decoy: the effect is there and hardly shows; naming it is fine, another one is not
        out["wrong_sure"] = any(f["effect"] != effect for f in confident)
        out["right"] = named_right(first, effect) if first else None
    return out


def table(results: list[dict]) -> dict[str, dict]:
    """The lines of the table: {line: {value, low, high, n}}; a line without cases is left out."""
    lines: dict[str, dict] = {}

    def rate(line: str, values: list) -> None:
        values = [bool(v) for v in values]
        if values:
            low, high = wilson(sum(values), len(values))
            lines[line] = {"value": sum(values) / len(values), "low": low, "high": high, "n": len(values)}

    def middle(line: str, values: list, statistic: Callable) -> None:
        if values:
            low, high = bootstrap(values, statistic)
            lines[line] = {"value": float(statistic(values)), "low": low, "high": high, "n": len(values)}

    hidden = [r for r in results if r["group"] == "effect"]
    for tier in ("easy", "medium", "hard"):
        rate(f"right effect first, {tier}", [r["right"] for r in hidden if r["tier"] == tier])
    middle("parameter error, median", [e for r in hidden for e in r["parameter_errors"]], np.median)
    rate("90 % interval covers the truth", [c for r in hidden for c in r["covered"]])
    middle("held-out error removed, mean", [r["removed"] for r in hidden if r.get("removed") is not None], np.mean)
    rate("false alarm, nothing missing", [r["false_alarm"] for r in results if r["group"] in ("none", "noise")])
    rate("outside the catalogue: not claimed", [r["humble"] for r in results if r["group"] == "outside"])
    rate("confident and wrong, all cases", [r["wrong_sure"] for r in results])
    return lines


def show(lines: dict[str, dict], results: list[dict]) -> str:
    """Both as text."""
    out = [f"{'case':<10}{'group':<9}{'hidden':<20}{'tier':<8}{'verdict':<18}{'named first':<20}{'set'}"]
    for r in results:
        out.append(f"{r['name']:<10}{r['group']:<9}{r['kind']:<20}{r['tier']:<8}{r['verdict']:<18}{r['said']:<20}{' '.join(r['set']) or '-'}")
    out += ["", f"{'figure':<38}{'value':>8}   {'95 % interval':<18}{'n':>4}"]
    out += [f"{k:<38}{v['value']:>8.3f}   {v['low']:.3f} .. {v['high']:<10.3f}{v['n']:>4}" for k, v in lines.items()]
    return "\n".join(out)
