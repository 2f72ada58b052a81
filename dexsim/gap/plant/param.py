"""One fitted number: which columns of the plant it acts on, inside which bounds, what is believed of it, and at which
value it says that nothing is missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dexsim.gap.plant.batch import JointPlant
from dexsim.gap.plant.columns import INDEX, NEUTRAL

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case

# parameters that say what an effect is like, not how large it is
SHAPES = ("v_s", "per_turn", "phase", "rebound", "rotor")


@dataclass(frozen=True)
class Param:
    """One number that is fitted. `key` is unique in a fit; it acts on plant columns [.., R, C].

    mode: `factor` multiplies the believed value, `add` adds to it, `set` replaces it, `inverse` sets 1 / x.
    """

    key: str
    columns: tuple[str, ...]
    mode: str
    low: float
    high: float
    start: float
    unit: str = "1"
    nuisance: bool = False
    sd: float = (
        0.0  # what is believed of it beforehand: its start to this standard deviation; 0: nothing inside the bounds
    )

    @property
    def span(self) -> float:
        return self.high - self.low

    def apply(self, params: np.ndarray, x: np.ndarray, base: np.ndarray) -> None:
        """Writes x [H] into params [H, R, C], base [R, C] being what is believed."""
        for name in self.columns:
            c = INDEX[name]
            if self.mode == "factor":
                params[:, :, c] = params[:, :, c] * x[:, None]
            elif self.mode == "add":
                params[:, :, c] = params[:, :, c] + x[:, None]
            elif self.mode == "inverse":
                params[:, :, c] = 1.0 / np.maximum(x[:, None], 1e-12)
            else:
                params[:, :, c] = x[:, None]


def expand(plant: JointPlant, params: list[Param], x: np.ndarray) -> np.ndarray:
    """[H, R, C] plant parameters of the guesses x [H, P]: what replaces first, factors and additions after."""
    base = plant.base()
    out = np.repeat(base[None], len(x), 0)
    for modes in (("set", "inverse"), ("factor", "add")):
        for i, p in enumerate(params):
            if p.mode in modes:
                p.apply(out, x[:, i], base)
    lag = INDEX["stribeck_speed"]
    out[:, :, lag] = np.maximum(out[:, :, lag], 1e-4)
    for name in ("coulomb_friction", "viscous_friction", "delay", "backlash", "softness", "deadband"):
        c = INDEX[name]
        out[:, :, c] = np.maximum(out[:, :, c], 0.0)
    return out


def neutral_of(param: Param, case: Case) -> float:
    """Value of a parameter at which its effect is not there."""
    if param.mode == "add":
        return 0.0
    if param.mode == "factor":
        return 1.0
    name = param.columns[0]
    return float(case.scales.nominal.get(name, NEUTRAL[INDEX[name]]))


def at_bound(params: Sequence[Param], values: dict[str, float], case: Case) -> str:
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
