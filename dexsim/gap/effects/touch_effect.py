"""What an entry of the catalogue holds of an effect of touch or contact."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from dexsim.gap.touch.plant import contact, readings
from dexsim.gap.touch.settings import Fit, PadFacts, PadSettings

if TYPE_CHECKING:
    from dexsim.gap.touch.read import PadRun
    from dexsim.gap.touch.search import PadSearch, TouchTrial


class TouchEffect:
    """An entry of the catalogue of touch.

    id, words, shows, experiment as of `effect.Effect`; fits: parameters of `touch.plant.PARAMS`; starts: values of them
    to begin from; stage: `cell` where a load cell judges it alone, `taxels`, `shear`; report: parameter -> key in
    `diagnosis.json`; classes: those of `confusion.TOUCH_CLASSES`.
    """

    id: ClassVar[str]
    words: ClassVar[str]
    shows: ClassVar[str]
    experiment: ClassVar[str]
    fits: ClassVar[tuple[str, ...]]
    starts: ClassVar[tuple[tuple[float, ...], ...]]
    stage: ClassVar[str] = "taxels"
    report: ClassVar[tuple[tuple[str, str], ...]] = ()
    classes: ClassVar[tuple[str, ...]] = ()
    simulated: ClassVar[bool] = True  # the plant has a law of it
    by_taxel: ClassVar[bool] = False  # may be another on each taxel
    widens: ClassVar[bool] = False  # with a wider contact beside it one such follows much of the other: all are tried
    replaces: ClassVar[frozenset[str]] = frozenset()  # refitted figures that it takes the place of
    excludes: ClassVar[frozenset[str]] = frozenset()  # effects that it replaces: both at once mean nothing
    words_beside: ClassVar[dict[str, str]] = {}  # parameters that are words

    def possible(self, search: PadSearch) -> bool:
        """Whether the recordings of a pad can show it."""
        return True

    def begin(self, search: PadSearch) -> list[dict[str, float]]:
        """Values of its parameters to begin from."""
        return [dict(zip(self.fits, s, strict=True)) for s in self.starts]

    def in_place(self, values: dict[str, float], base: TouchTrial, current: TouchTrial) -> dict[str, float]:
        """Where its fit begins in the place of a member of `current`; values: of its own trial so far; base: `current`
        without that member."""
        return values

    def changes(self, run: PadRun, t: TouchTrial, base: dict[str, float]) -> np.ndarray:
        """[S] by how much it changes the readings of a recording [N]; base: values at which nothing is there."""
        neutral = t.values | {k: base[k] for k in self.fits}
        if self.stage == "cell" and run.load is not None:
            return np.interp(run.t, run.grid, np.abs(contact(run, t.values)[0] - contact(run, neutral)[0]))
        return np.abs(readings(run, t.values, t.gains, t.order) - readings(run, neutral, t.gains, t.order)).max(1)

    def doubt(self, finding: dict[str, Any]) -> str:
        """A reason of its own to doubt a finding; empty for none."""
        return ""

    def drift(self, finding: dict[str, Any], fact: PadFacts) -> Fit | None:
        """Factor on all gains of the pad over the recordings; None where it is none."""
        return None

    def hand_on(self, finding: dict[str, Any], pad: PadSettings, doubt: bool) -> str:
        """Writes a finding into the settings of its pad; returns what of it is left out, in words.

        doubt: whether its ranges are to hold what was believed."""
        return ""
