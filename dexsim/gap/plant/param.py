"""One fitted number: which columns of the plant it acts on, inside which bounds, and what is believed of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dexsim.gap.plant.batch import JointPlant
from dexsim.gap.plant.columns import INDEX


@dataclass(frozen=True)
class Param:
    """One number that is fitted. `key` is unique in a fit; it acts on plant columns [.., R, C].

    mode: `factor` multiplies the believed value, `add` adds to it, `set` replaces it, `inverse` sets 1 / x.
    runs: the runs it acts in (None: all).
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
