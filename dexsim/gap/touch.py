"""Taxels that a recording alone shows to be wrong: dead or stuck ones, by their neighbours on the pad."""

from __future__ import annotations

from typing import Any

import numpy as np

from dexsim.recording.schema import Recording

ROWS = 12  # k = column * 12 + row


def findings(recordings: list[Recording]) -> list[dict[str, Any]]:
    """Findings `tactile_gain` as `diagnosis.json` has them: taxels that stay constant while at least three neighbours on the
    pad feel many counts. Their gain is 0."""
    worst: dict[int, set[int]] = {}
    seen = False
    for r in recordings:
        if r.tactile is None or r.tactile.value.ndim != 4 or len(r.tactile) < 20:
            continue
        seen = True
        z = np.nan_to_num(r.tactile.value[..., 2])  # [T, F, K]
        span = z.max(0) - z.min(0)
        for f in range(span.shape[0]):
            bad = _constant(span[f])
            worst[f] = worst[f] & bad if f in worst else bad
    if not seen:
        return []
    out = []
    for f, taxels in sorted(worst.items()):
        if not taxels:
            continue
        names = [f"{f}:{k}" for k in sorted(taxels)]
        out.append({
            "effect": "tactile_gain", "confidence": 0.85, "alternatives": [], "indistinguishable": [], "separating_experiment": None,
            "where": {"joints": [], "taxels": names, "topics": ["/tactile"]}, "regime": "constant while their neighbours feel a touch", "when": [],
            "parameters": {"gain": {"value": 0.0, "low": 0.0, "high": 0.05, "unit": "1"}, "taxels": {"value": ", ".join(names), "low": None, "high": None, "unit": ""}},
            "held_out": None,
        })  # fmt: skip
    return out


def _constant(span: np.ndarray) -> set[int]:
    """Taxels [K] with no change although three neighbours changed by a tenth of the pad's largest."""
    top = float(span.max())
    if top <= 0 or len(span) % ROWS:
        return set()
    grid = span.reshape(-1, ROWS)
    felt = (grid > 0.1 * top).astype(int)
    neighbours = np.zeros_like(felt)
    neighbours[1:] += felt[:-1]
    neighbours[:-1] += felt[1:]
    neighbours[:, 1:] += felt[:, :-1]
    neighbours[:, :-1] += felt[:, 1:]
    return {int(k) for k in np.flatnonzero(((grid == 0) & (neighbours >= 3)).reshape(-1))}
