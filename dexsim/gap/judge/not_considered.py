"""Effects that are not considered, each with the reason: what the mechanism has not, or the recordings do not carry."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from dexsim.gap.effects.catalogue import EFFECTS, TOUCH_EFFECTS
from dexsim.gap.search.beliefs import unknown
from dexsim.gap.touch.result import TouchResult


def reasons(cases: Sequence, felt: TouchResult, allowed: Collection[str] | None) -> dict[str, str]:
    """Effect id -> why it was not considered on any joint or pad (or on which), in the catalogue's order.

    cases: `plant.case.Case`."""
    out: dict[str, str] = {}
    moved = [c for c in cases if c.moved]
    for e, x in EFFECTS.items():
        if allowed is not None and e not in allowed:
            out[e] = "not asked for (effects=)"
            continue
        if not moved:
            out[e] = "no joint is judged" if not cases else "no joint moves"
            continue
        given = {c.joint: x.unseen(c.scales) for c in moved}
        lacking = {j: r for j, r in given.items() if r}
        if not lacking:
            continue
        first = next(iter(lacking.values()))
        if len(lacking) == len(given):
            same = all(r == first for r in lacking.values())
            out[e] = first if same else "; ".join(f"{j}: {r}" for j, r in lacking.items())
        else:
            out[e] = "; ".join(f"on {j}: {r}" for j, r in lacking.items())
    touch = (
        "no /tactile is recorded"
        if not felt.tactile
        else "nothing is touched"
        if not felt.contact
        else "no force could be predicted"
        if felt.before is None
        else ""
    )
    for e in TOUCH_EFFECTS:
        if e in EFFECTS:
            continue
        if allowed is not None and e not in allowed:
            out[e] = "not asked for (effects=)"
        elif touch and not any(f["effect"] == e for f in felt.findings):
            out[e] = touch
    return out


def not_fitted(cases: Sequence) -> list[str]:
    """Columns that the servo's file says are unknown and that are not refitted, by joints: what is done instead."""
    by: dict[str, list[str]] = {}
    for c in cases:
        for name in c.unknown:
            if unknown(name, c.scales) is None:
                by.setdefault(name, []).append(c.joint)
    return [
        f"{name} is unknown on {', '.join(joints)} and cannot be fitted to these recordings by itself: it is taken as "
        "absent"
        for name, joints in by.items()
    ]
