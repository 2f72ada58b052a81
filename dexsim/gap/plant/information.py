"""Whether beliefs about a drive could be told from recordings: the information that their motions hold of each.

A position is simulated with each figure a step away from what is believed. The changes J [n, P], in steps, and the
noise s of a reading give the Fisher information J'J / s^2 of the figures (Ljung, System Identification, 7.4); what is
wrong with a model stays so for a while, so one reading in `HOLDS` s counts. The inverse has the variance with which an
unbiased fit could tell a figure while all others are fitted too (Cramer and Rao).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dexsim.gap.plant.case import Case
from dexsim.gap.plant.columns import INDEX

HOLDS = 0.1
WINDOW = 1.0
"""s over which a simulation runs freely from the recorded state."""
STILL = 8.0
"""x its noise that a joint must move in a window."""
DOUBT = 10.0
"""Steps by which a figure is uncertain before: more is not looked at."""
SLOPE = 0.05
"""Of a step: over a whole one two figures of one slope differ by how they bend, and seem to be told apart."""
ALIKE = 0.95
"""Correlation from which on two figures can only be told together."""


@dataclass(frozen=True)
class Figure:
    """A figure that is believed. step: what one would want to know it by, a share of the figure (`relative`) or in its
    unit; motion: what shows it, and the motions of `dexsim excite` that have it."""

    words: str
    column: str
    step: float
    relative: bool
    unit: str
    motion: str
    kinds: str


FIGURES = (
    Figure("stiffness", "kp", 0.1, True, "%", "holds and slow motion under load", "holds,triangles"),
    Figure("damping", "kd", 0.1, True, "%", "steps and a fast chirp", "steps,chirp"),
    Figure("torque limit", "torque_limit", 0.1, True, "%", "steps so large that the drive is at its limit", "steps"),
    Figure("no-load speed", "no_load_speed", 0.1, True, "%", "steps across the whole range, at full speed", "steps"),
    Figure("inertia", "inertia_scale", 0.1, True, "%", "steps and a fast chirp", "steps,chirp"),
    Figure("dry friction", "coulomb_friction", 0.02, False, "% of its torque", "slow triangles that turn back often",
           "triangles,ladder"),
    Figure("viscous friction", "viscous_friction", 0.02, False, "% of its torque", "triangles of several speeds",
           "triangles"),
    Figure("delay", "delay", 0.005, False, "ms", "steps, or a chirp of 5 Hz and more", "steps,chirp"),
    Figure("play", "backlash", 0.005, False, "mrad", "slow reversals of its load", "triangles,holds"),
)  # fmt: skip
"""What a belief about a drive is made of."""


@dataclass(frozen=True)
class Precision:
    """How well a figure could be told: steps (of `Figure.step`) of one standard deviation; beside: the figure that
    it can only be told together with, if any."""

    figure: Figure
    steps: float
    beside: Figure | None

    @property
    def possible(self) -> bool:
        """Whether it is told to a step."""
        return self.steps < 1.0

    def within(self) -> str:
        """Return what it could be told by, in words."""
        scale = {"%": 100, "% of its torque": 100, "ms": 1e3, "mrad": 1e3}[self.figure.unit]
        return f"{scale * self.figure.step * self.steps:.2g} {self.figure.unit}"


def informed(case: Case, floor: float = 0.0) -> list[Precision]:
    """Return how well recordings could tell each figure of a joint. floor [rad]: by what repeats differ, where that is
    more than the noise."""
    plant = case.plant
    base = plant.base()
    windows = plant.windows(WINDOW)
    if not windows.n:
        return []
    used, guesses, parts = [], [base], []
    for figure in FIGURES:
        row = base.copy()
        now = row[..., INDEX[figure.column]]
        change = figure.step * now if figure.relative else own_step(figure, case)
        if not np.isfinite(now).all() or not np.any(change):
            continue  # a limit that is not believed in
        part = 1.0 if figure.column == "backlash" else SLOPE  # none of a play that is far below the noise shows
        row[..., INDEX[figure.column]] = now + part * change
        used.append(figure)
        parts.append(part)
        guesses.append(row)
    q = plant.simulate(np.array(guesses), windows)[0]
    ok = np.isfinite(q).all(0)
    J = (q[1:, ok] - q[:1, ok]).T / np.array(parts)
    # where a joint stands it shows its stiffness against gravity; the rest of what is simulated there is how it came
    # to stand
    shown, of = plant.q[windows.sample_row[ok]], windows.sample_window[ok]
    way = np.array([np.ptp(shown[of == w]) if (of == w).any() else 0.0 for w in range(len(windows.window))])
    J[np.ix_(way[of] < STILL * case.sigma, [f.column != "kp" for f in used])] = 0.0
    J -= J.mean(0)  # an encoder's zero is fitted too
    rate = 1 / max(float(np.median(np.diff(plant.t))), 1e-6) if len(plant.t) > 1 else 1.0
    noise = max(case.sigma, floor) * np.sqrt(max(HOLDS * rate, 1.0))
    information = J.T @ J / noise**2
    spread = np.linalg.inv(information + np.eye(len(used)) / DOUBT**2)
    size = np.sqrt(np.diag(spread))
    alike = np.abs(spread / np.outer(size, size)) - np.eye(len(used))
    out = []
    for k, figure in enumerate(used):
        alone = float(1 / np.sqrt(information[k, k] + 1 / DOUBT**2))
        other = int(np.argmax(alike[k]))
        beside = used[other] if size[k] >= 1.0 > alone and alike[k, other] > ALIKE else None
        out.append(Precision(figure, float(size[k]), beside))
    return out


def own_step(figure: Figure, case: Case) -> float:
    """Return the step of a figure that is no share of itself, in its column's unit."""
    if figure.column == "coulomb_friction":
        return figure.step * case.scales.tau
    if figure.column == "viscous_friction":
        return figure.step * case.scales.tau / max(case.scales.peak_speed, 1e-6)
    return figure.step


SUM = {"damping", "viscous friction"}
"""Figures of which a position shows the sum, whatever the motion."""


def advice(known: Sequence[Precision]) -> list[tuple[str, str]]:
    """Return (figure that recordings do not tell, what to record for it) in words."""
    out = []
    for x in known:
        if not x.possible:
            both = x.beside is not None and {x.figure.words, x.beside.words} == SUM
            how = "the effort too, or a swing with the drive off" if both else f"{x.figure.motion} ({x.figure.kinds})"
            out.append((x.figure.words, how))
    return out
