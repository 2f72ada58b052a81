"""Where a parameter says that nothing is missing, and whether a size stopped at the end of what is physical."""

from __future__ import annotations

from collections.abc import Sequence

from dexsim.gap.plant.case import Case
from dexsim.gap.plant.columns import INDEX, NEUTRAL

# parameters that say what an effect is like, not how large it is
SHAPES = ("v_s", "per_turn", "phase", "rebound", "rotor")


def neutral_of(param, case: Case) -> float:
    """Value of a parameter at which its effect is not there."""
    if param.mode == "add":
        return 0.0
    if param.mode == "factor":
        return 1.0
    name = param.columns[0]
    return float(case.scales.nominal.get(name, NEUTRAL[INDEX[name]]))


def at_bound(params: Sequence, values: dict[str, float], case: Case) -> str:
    """Key of a parameter that stopped at a bound of what is physical; empty where none did."""
    for p in params:
        if p.key in ("phase", "rebound", "rotor"):
            continue
        zero = neutral_of(p, case)
        for bound in (p.low, p.high):
            away = abs(bound - zero)
            # a fit comes to rest a little before a bound; where an effect begins near one, it may be as small
            room = (0.01 if away > 0.25 * p.span else 1e-3) * p.span
            if away > room and abs(values[p.key] - bound) <= room:
                return p.key
    return ""
