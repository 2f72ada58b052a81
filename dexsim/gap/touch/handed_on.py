"""What a diagnosis finds of touch and contact, as training takes it: `tactile.yaml` (`dexsim.tactile.file`).

    finding              setting
    tactile_gain         pads.F.gain, taxels, dead, stuck, swapped
    tactile_stiffening   pads.F.rubber (how a force spreads over the taxels) and contact.stiffness (the chord of its law)
    tactile_hysteresis   pads.F.hysteresis, hysteresis_time
    tactile_crosstalk    pads.F.crosstalk
    tactile_delay        pads.F.delay
    thermal (of taxels)  pads.F.gain, over what it drifted in the recordings
    contact_friction     randomize object.friction, and friction (the cap of fx, fy)
    contact_stiffness    randomize contact.stiffness

A world has one friction and one stiffness for all fingertips: their ranges hold what was found on every fingertip, and what was
believed where a fingertip was judged and nothing was found. The range of what is not sure holds what was believed as well.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dexsim.assets import xhand
from dexsim.gap.touch.plant import THICKNESS
from dexsim.gap.touch.read import FRICTION, STIFFNESS
from dexsim.tactile.config import COLUMNS
from dexsim.tactile.file import RANGES
from dexsim.tactile.pads import PAD_COLUMNS

SURE = 0.8  # confidence from which a finding stands alone, unless it is one of a set
Fit = tuple[float, float, float]  # value, low, high

HEAD = """\
# What diagnose.py found of touch and contact: python train.py task=grasp tactile_file=FILE (play.py too) lays it over the tactile
# group and the task's ranges. value is the best guess; low to high is drawn anew in each world at each episode.
"""


@dataclass
class PadFacts:
    """Of a judged pad, beside its findings: silent: constant taxels and their reading [N] (0: dead); common: gain of all its taxels;
    rest: of those that a map of single gains does not name; chord: contact stiffness [N/m] that
    stands for a fitted rubber; warmest: where a drift ends (degC above the coldest, or s); stiffness [N/m], friction: what was
    believed; slid: whether friction could be judged."""

    silent: dict[int, float] = field(default_factory=dict)
    common: Fit | None = None
    rest: Fit | None = None
    chord: Fit | None = None
    warmest: float = 0.0
    stiffness: float = STIFFNESS
    friction: float = FRICTION
    slid: bool = False
    judged: bool = True


@dataclass
class Handed:
    """tactile, randomize: as the file holds them. said: a line for each finding; doubts: for the notes."""

    tactile: dict[str, Any] = field(default_factory=dict)
    randomize: dict[str, Any] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)


def doubted(finding: dict[str, Any]) -> bool:
    return finding["confidence"] < SURE or bool(finding["indistinguishable"])


def handed(findings: list[dict[str, Any]], facts: dict[str, PadFacts]) -> Handed:
    """The settings that findings of touch ask for. facts: by name of pad."""
    out, pads, drifts = Handed(), {}, {}
    shared: dict[str, dict[str, Fit]] = {"object.friction": {}, "contact.stiffness": {}}
    for f in findings:
        if not f["where"]["taxels"]:
            continue
        name = xhand.FINGERS[int(f["where"]["taxels"][0].split(":")[0])]
        pad, fact, doubt = pads.setdefault(name, {}), facts.get(name) or PadFacts(judged=False), doubted(f)
        if f["effect"] == "thermal":
            ends = [1.0 + f["parameters"]["per_degree"][k] * fact.warmest for k in ("value", "low", "high")]
            drifts[name] = (0.5 * (1.0 + ends[0]), min(1.0, *ends[1:]), max(1.0, *ends[1:]))
        lost = _one(f, name, pad, fact, shared, doubt)
        either = " or ".join(f["indistinguishable"] or [f["effect"]])
        out.said.append(f"{name}: {either}, confidence {f['confidence']:.2f}" + (", not sure: its range holds what was believed" if doubt else ""))
        if doubt:
            out.doubts.append(f"{f['effect']} on the {name}'s pad is not sure: in tactile.yaml its range holds what was believed as well{lost}")
    for name, drift in drifts.items():
        pad = pads[name]
        pad["gain"] = _times(pad.get("gain"), drift)
        if "taxels" in pad:
            pad["taxels"] = {k: _times(g, drift) for k, g in pad["taxels"].items()}
    for name, pad in pads.items():
        if pad:
            for key in [k for k in pad if k in PAD_COLUMNS]:
                pad[key] = _entry(pad[key], *PAD_COLUMNS[key][1:3])
            if "taxels" in pad:
                pad["taxels"] = {k: _entry(g, *PAD_COLUMNS["gain"][1:3]) for k, g in pad["taxels"].items()}
            out.tactile.setdefault("pads", {})[name] = pad
    for name, by_pad in shared.items():
        if by_pad:
            out.randomize[name] = _entry(_hull(name, by_pad, facts), *RANGES[name][1:])
    if "object.friction" in out.randomize:
        out.tactile["friction"] = _entry(_hull("object.friction", shared["object.friction"], facts), *COLUMNS["friction"][1:3])
    return out


def _one(f: dict[str, Any], name: str, pad: dict[str, Any], fact: PadFacts, shared: dict[str, dict[str, Fit]], doubt: bool) -> str:
    """One finding into the settings; returns what of it is left out, in words."""
    e, p, lost = f["effect"], f["parameters"], ""
    fit = lambda key, believed: _fit(p[key], believed if doubt else None)  # noqa: E731
    if e == "tactile_gain":
        lost = _gains(f, pad, fact, doubt)
        if "contact_stiffness" in f["indistinguishable"] and fact.common is not None:  # without a load cell they are one factor
            shared["contact.stiffness"][name] = _instead(_times((fact.stiffness,) * 3, fact.common), fact.stiffness)
    elif e == "tactile_stiffening":
        if doubt:
            lost = "; its rubber is left out"
        else:
            clip = lambda x: _entry(_fit(x, None), *PAD_COLUMNS["c10"][1:3])  # noqa: E731
            pad["rubber"] = {k: clip(p[k]) for k in ("c10", "c01")} | {"thickness": THICKNESS}
            lowest = pad["rubber"]["c10"]["low"] + pad["rubber"]["c01"]["low"]
            if lowest <= 0.0:  # a rubber has to press back
                pad["rubber"]["c10"]["low"] = pad["rubber"]["c10"]["value"] * 0.1 or 1.0
        if fact.chord is not None:
            shared["contact.stiffness"][name] = _wide(fact.chord, fact.stiffness if doubt else None)
    elif e == "tactile_hysteresis":
        pad["hysteresis"], pad["hysteresis_time"] = fit("fraction", 0.0), _fit(p["time_constant"], None)
    elif e == "tactile_crosstalk":
        pad["crosstalk"] = fit("fraction", 0.0)
    elif e == "tactile_delay":
        pad["delay"] = fit("delay", 0.0)
    elif e == "contact_friction":
        shared["object.friction"][name] = fit("mu", fact.friction)
    elif e == "contact_stiffness":
        shared["contact.stiffness"][name] = fit("stiffness", fact.stiffness)
        if "tactile_gain" in f["indistinguishable"]:
            pad["gain"] = _times(pad.get("gain"), _instead(_fit(p["stiffness"], None, 1.0 / fact.stiffness), 1.0))
    return lost


def _gains(f: dict[str, Any], pad: dict[str, Any], fact: PadFacts, doubt: bool) -> str:
    """Gains into a pad's settings; returns what is left out, in words."""
    p, taxels = f["parameters"]["gain"], f["parameters"].get("taxels", {})
    whole = fact.common or fact.rest
    if whole is not None:
        pad["gain"] = _times(pad.get("gain"), _wide(whole, 1.0 if doubt else None))
    numbers = [int(t.split(":")[1]) for t in f["where"]["taxels"]]
    lists = {k: np.broadcast_to(np.atleast_1d(p[k]), len(numbers)) for k in ("value", "low", "high")}
    gains: dict[int, Fit] = {}
    for k, v, low, high in zip(numbers, *lists.values(), strict=True):
        if fact.common is not None and k not in fact.silent:
            continue  # the pad's
        if k in fact.silent and not doubt:
            if fact.silent[k] == 0.0:
                pad.setdefault("dead", []).append(k)
            else:
                pad.setdefault("stuck", {})[k] = round(fact.silent[k], 6)
            continue
        gains[k] = _fit({"value": v, "low": low, "high": high}, 1.0 if doubt else None)
    if gains:
        pad["taxels"] = gains
    swapped = [[int(t.split(":")[1]) for t in pair] for pair in taxels.get("swapped", [])]
    if swapped and not doubt:
        pad["swapped"] = swapped
    return "; exchanged taxels are left out" if swapped and doubt else ""


def _wide(fit: Fit, believed: float | None) -> Fit:
    """A fit whose range also holds what was believed."""
    return fit if believed is None else (fit[0], min(fit[1], believed), max(fit[2], believed))


def _instead(fit: Fit, believed: float) -> Fit:
    """What the other effect of a set would be in the place of the one named: best guess that it is not there, in a range that holds it."""
    return believed, min(fit[1], believed), max(fit[2], believed)


def _fit(p: dict[str, Any], believed: float | None, times: float = 1.0) -> Fit:
    """(value, low, high) of a parameter, widened to what was believed (in the parameter's unit), times a factor."""
    return _times((times,) * 3, _wide(tuple(float(p[k]) for k in ("value", "low", "high")), believed))


def _times(a: Fit | None, b: Fit) -> Fit:
    return b if a is None else (a[0] * b[0], a[1] * b[1], a[2] * b[2])


def _hull(name: str, by_pad: dict[str, Fit], facts: dict[str, PadFacts]) -> Fit:
    """One range for all fingertips: every fit, and what was believed of a fingertip that was judged and follows it."""
    if name == "object.friction":
        believed = [x.friction for pad, x in facts.items() if x.judged and x.slid and pad not in by_pad]
    else:
        believed = [x.stiffness for pad, x in facts.items() if x.judged and pad not in by_pad]
    value, low, high = (np.array(x) for x in zip(*by_pad.values(), strict=True))
    return float(value.mean()), float(min([*low, *believed])), float(max([*high, *believed]))


def _entry(fit: Fit, lowest: float, highest: float) -> dict[str, float]:
    value, low, high = (float(f"{np.clip(x, lowest, highest):.6g}") for x in fit)
    return {"value": value, "low": min(low, value), "high": max(high, value)}


def chord(force: np.ndarray, depth: np.ndarray) -> Fit | None:
    """Stiffness [N/m] of a straight line through a law's points (force [n] N, depth [n] m): the least-squares one, and force over depth
    under and over which a tenth of the force is felt; None where nothing is pressed."""
    on = (force > 0.2) & (depth > 1e-4)
    if on.sum() < 5:
        return None
    force, depth = force[on], depth[on]
    order = np.argsort(force / depth)
    felt = np.cumsum(force[order]) / force.sum()
    low, high = (force / depth)[order][np.searchsorted(felt, [0.1, 0.9])]
    return float(force @ depth / (depth @ depth)), float(low), float(high)


def save(h: Handed, path: Path) -> bool:
    """Writes the file, whole or not at all. Where there is nothing to hand on, returns False, and an earlier diagnosis's file goes."""
    content = {k: v for k, v in (("tactile", h.tactile), ("randomize", h.randomize)) if v}
    if not content:
        if path.is_file() and path.read_text(encoding="utf-8").startswith(HEAD):
            path.unlink()
        return False
    text = HEAD + "".join(f"# {line}\n" for line in h.said) + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=130)
    part = path.with_name(f".{path.name}.part")
    part.write_text(text, encoding="utf-8")
    part.replace(path)
    return True
