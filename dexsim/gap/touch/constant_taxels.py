"""Taxels that read the same for ever, dead or stuck: seen from the readings alone, without any geometry."""

from __future__ import annotations

from typing import Any

import numpy as np

from dexsim.gap.effects.tactile_gain import TactileGain
from dexsim.gap.touch.read import newtons
from dexsim.recording.schema import TACTILE, Recording
from dexsim.tactile.sensors import Sensors


def found(recordings: list[Recording], sensors: Sensors) -> list[dict[str, Any]]:
    """Findings `tactile_gain` from the taxels alone: those that stay constant while at least three neighbours on the
    pad feel many counts. Their gain is 0."""
    if sensors.layout is None:
        return []
    worst: dict[int, set[int]] = {}
    beside = [sensors.beside(f) for f in range(sensors.layout.pads)]
    seen = False
    for r in recordings:
        if r.tactile is None or r.tactile.value.ndim != 4 or len(r.tactile) < 20:
            continue
        seen = True
        z = np.nan_to_num(r.tactile.value[..., 2])  # [T, F, K]
        span = z.max(0) - z.min(0)
        for f in range(min(span.shape[0], len(beside))):
            bad = _constant(span[f], beside[f])
            worst[f] = worst[f] & bad if f in worst else bad
    if not seen:
        return []
    return [finding([f"{f}:{k}" for k in sorted(taxels)], "constant while their neighbours feel a touch", 0.85)
            for f, taxels in sorted(worst.items()) if taxels]  # fmt: skip


def _constant(span: np.ndarray, beside: list[list[int]]) -> set[int]:
    """Taxels [K] with no change although three neighbours changed by a tenth of the pad's largest."""
    top = float(span.max())
    if top <= 0 or len(span) < len(beside):
        return set()
    felt = span > 0.1 * top
    return {k for k, near in enumerate(beside) if span[k] == 0 and felt[near].sum() >= 3}


def readings_of(recordings: list[Recording], taxels: list[str]) -> dict[int, float]:
    """What constant taxels ("pad:k") of one pad read for ever [N], by number; under two counts it is 0."""
    out = {}
    for pad, k in (map(int, t.split(":")) for t in taxels):
        values = [
            (float(np.median(np.nan_to_num(newtons(r)[0][:, pad, k, 2]))), 2 * (r.tactile_lsb or 0.0))
            for r in recordings
            if r.tactile is not None and r.tactile.value.ndim == 4
        ]
        value, step = max(values)
        out[k] = value if value > max(step, 1e-6) else 0.0
    return out


def finding(names: list[str], regime: str, confidence: float) -> dict[str, Any]:
    """Gains of 0 of taxels ("pad:k"), as `diagnosis.json` has a finding."""
    return {
        "effect": TactileGain.id,
        "confidence": confidence,
        "alternatives": [],
        "indistinguishable": [],
        "separating_experiment": None,
        "where": {"joints": [], "taxels": names, "topics": [TACTILE]},
        "regime": regime,
        "when": [],
        "parameters": {
            "gain": {"value": 0.0, "low": 0.0, "high": 0.05, "unit": "1"},
            "taxels": {"value": ", ".join(names), "low": None, "high": None, "unit": ""},
        },
        "held_out": None,
    }


def pressed(silent: dict[int, float], pad: int) -> dict[str, Any] | None:
    """The finding of a pad's taxels that read the same although the plant has them pressed. silent: their reading [N]
    by number."""
    if not silent:
        return None
    kinds = {"dead": [k for k, v in silent.items() if v == 0], "stuck": [k for k, v in silent.items() if v != 0]}
    said = "; ".join(f"{kind}: {', '.join(map(str, taxels))}" for kind, taxels in kinds.items() if taxels)
    return finding([f"{pad}:{k}" for k in sorted(silent)], f"constant while they are pressed ({said})", 0.95)


def merge(gain: dict, dead: dict) -> None:
    """Broken taxels into the finding of the pad's gains."""
    p = gain["parameters"]["gain"]
    count = len(gain["where"]["taxels"])
    wide = lambda x: list(np.atleast_1d(x)) if len(np.atleast_1d(x)) == count else [float(x)] * count  # noqa: E731
    for key, zero in (("value", 0.0), ("low", 0.0), ("high", 0.05)):
        p[key] = [float(x) for x in wide(p[key])] + [zero] * len(dead["where"]["taxels"])
    gain["where"]["taxels"] = [*gain["where"]["taxels"], *dead["where"]["taxels"]]
    gain["parameters"]["taxels"]["value"] = ", ".join(gain["where"]["taxels"])
    gain["regime"] += "; " + dead["regime"]
