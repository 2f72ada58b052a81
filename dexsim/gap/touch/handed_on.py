"""What a diagnosis finds of touch and contact, as training takes it: `tactile.yaml` (`dexsim.tactile.file`).

Which setting an effect writes stands in its class (`dexsim.gap.effects`).

A world has one friction and one stiffness for all fingertips: their ranges hold what was found on every fingertip, and
what was believed where a fingertip was judged and nothing was found. The range of what is not sure holds what was
believed as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dexsim.gap.effects.catalogue import TOUCH_EFFECTS
from dexsim.gap.rules import JUDGE
from dexsim.gap.touch.result import Fit, PadFacts, PadSettings, ranged, times
from dexsim.tactile.config import COLUMNS
from dexsim.tactile.file import RANGES
from dexsim.tactile.pads import PAD_COLUMNS

SHARED = ("object.friction", "contact.stiffness")  # a world has one for all fingertips

HEAD = """\
# What diagnose.py found of touch and contact: python train.py task=grasp tactile_file=FILE (play.py too) lays it over
# the tactile group and the task's ranges. value is the best guess; low to high is drawn anew in each world at each
# episode.
"""


@dataclass
class Handed:
    """tactile, randomize: as the file holds them. said: a line for each finding; doubts: for the notes."""

    tactile: dict[str, Any] = field(default_factory=dict)
    randomize: dict[str, Any] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)


def doubted(finding: dict[str, Any]) -> bool:
    return finding["confidence"] < JUDGE.sure or bool(finding["indistinguishable"])


def handed(findings: list[dict[str, Any]], facts: dict[str, PadFacts], names: Sequence[str]) -> Handed:
    """The settings that findings of touch ask for. facts: by name of pad; names: of the hand's pads [F]."""
    out = Handed()
    pads: dict[str, dict[str, Any]] = {}
    drifts: dict[str, Any] = {}
    for f in findings:
        if not f["where"]["taxels"]:
            continue
        name, effect = names[int(f["where"]["taxels"][0].split(":")[0])], TOUCH_EFFECTS[f["effect"]]
        pad = pads.setdefault(name, PadSettings(facts.get(name) or PadFacts(judged=False)))
        doubt, drift = doubted(f), effect.drift(f, pad.fact)
        if drift is not None:
            drifts[name] = drift
        lost = effect.hand_on(f, pad, doubt)
        either = " or ".join(f["indistinguishable"] or [f["effect"]])
        unsure = ", not sure: its range holds what was believed" if doubt else ""
        out.said.append(f"{name}: {either}, confidence {f['confidence']:.2f}{unsure}")
        if doubt:
            out.doubts.append(
                f"{f['effect']} on the {name}'s pad is not sure: in tactile.yaml its range holds what was "
                f"believed as well{lost}"
            )
    for name, drift in drifts.items():
        values = pads[name].values
        values["gain"] = times(values.get("gain"), drift)
        if "taxels" in values:
            values["taxels"] = {k: times(g, drift) for k, g in values["taxels"].items()}
    for name, pad in pads.items():
        values = pad.values
        if values:
            for key in [k for k in values if k in PAD_COLUMNS]:
                values[key] = ranged(values[key], *PAD_COLUMNS[key][1:3])
            if "taxels" in values:
                values["taxels"] = {k: ranged(g, *PAD_COLUMNS["gain"][1:3]) for k, g in values["taxels"].items()}
            out.tactile.setdefault("pads", {})[name] = values
    shared = {key: {name: pad.shared[key] for name, pad in pads.items() if key in pad.shared} for key in SHARED}
    for key, by_pad in shared.items():
        if by_pad:
            out.randomize[key] = ranged(_hull(key, by_pad, facts), *RANGES[key][1:])
    if "object.friction" in out.randomize:
        out.tactile["friction"] = ranged(
            _hull("object.friction", shared["object.friction"], facts), *COLUMNS["friction"][1:3]
        )
    return out


def _hull(name: str, by_pad: dict[str, Fit], facts: dict[str, PadFacts]) -> Fit:
    """One range for all fingertips: every fit, and what was believed of a fingertip that was judged and follows it."""
    if name == "object.friction":
        believed = [x.friction for pad, x in facts.items() if x.judged and x.slid and pad not in by_pad]
    else:
        believed = [x.stiffness for pad, x in facts.items() if x.judged and pad not in by_pad]
    value, low, high = (np.array(x) for x in zip(*by_pad.values(), strict=True))
    return float(value.mean()), float(min([*low, *believed])), float(max([*high, *believed]))


def chord(force: np.ndarray, depth: np.ndarray) -> Fit | None:
    """Stiffness [N/m] of a straight line through a law's points (force [n] N, depth [n] m): the least-squares one, and
    force over depth under and over which a tenth of the force is felt; None where nothing is pressed."""
    on = (force > 0.2) & (depth > 1e-4)
    if on.sum() < 5:
        return None
    force, depth = force[on], depth[on]
    order = np.argsort(force / depth)
    felt = np.cumsum(force[order]) / force.sum()
    low, high = (force / depth)[order][np.searchsorted(felt, [0.1, 0.9])]
    return float(force @ depth / (depth @ depth)), float(low), float(high)


def save(h: Handed, path: Path) -> bool:
    """Writes the file, whole or not at all. Where there is nothing to hand on, returns False, and an earlier
    diagnosis's file goes."""
    content = {k: v for k, v in (("tactile", h.tactile), ("randomize", h.randomize)) if v}
    if not content:
        if path.is_file() and path.read_text(encoding="utf-8").startswith(HEAD):
            path.unlink()
        return False
    text = (
        HEAD
        + "".join(f"# {line}\n" for line in h.said)
        + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=130)
    )
    part = path.with_name(f".{path.name}.part")
    part.write_text(text, encoding="utf-8")
    part.replace(path)
    return True
