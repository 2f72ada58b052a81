"""Stage tests: where a signal inside the drive was logged, each stage is tested with its own recorded input.

The firmware's law along the measured motion against the logged duty or effort exonerates (or accuses) everything before
the motor at no cost; what is after it is the rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dexsim import intervals
from dexsim.actuator.columns import INDEX
from dexsim.actuator.reference import loop_torque
from dexsim.gap.read import BLOCK, Run
from dexsim.gap.rules import BELIEF, TORQUE

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case

DRAWS = 300  # of the bootstrap
SHIFTS = np.arange(-0.01, 0.0401, 0.002)  # s: by which a drive may act later than is believed


@dataclass
class Stage:
    """The law of one joint's drive against what was logged. slope: logged over predicted, with its 90 % interval by a
    block bootstrap; delay [s] at which they agree best, and the most that any drive may
    have; fit: share of the variance explained."""

    joint: str
    signal: str
    slope: float
    slope_low: float
    slope_high: float
    delay: float
    fit: float
    late: float

    @property
    def sound(self) -> bool:
        """The drive does what is believed: gain within 5 % and nearly all of the signal."""
        return self.fit > TORQUE.fit and abs(self.slope - 1) < BELIEF.tolerance and abs(self.delay) <= self.late

    @property
    def text(self) -> str:
        """The result in words."""
        head = (
            f"{self.joint}: the believed law explains {100 * self.fit:.0f} % of the logged {self.signal}, at "
            f"{self.slope:.3f} of its size"
        )
        head += f" ({self.slope_low:.3f} to {self.slope_high:.3f})"
        if abs(self.delay) >= 0.002:
            head += f", {1e3 * self.delay:.0f} ms {'later' if self.delay > 0 else 'earlier'}"
        return head + (
            "; what is missing lies after the motor" if self.sound else "; the drive itself is not as believed"
        )


def tests(cases: list[Case], runs: list[Run], train: list[int], seed: int = 0) -> list[Stage]:
    """Return one Stage for each joint whose duty (voltage drives) or effort was logged."""
    out = []
    rng = np.random.default_rng(seed)
    for case in cases:
        read = [(r, x) for r in train if (x := _logged(runs[r], case.index)) is not None]
        if not read or sum(len(x.logged) for _, x in read) < 50:
            continue
        law = np.concatenate([x.law for _, x in read], 1)
        logged = np.concatenate([x.logged for _, x in read])
        block = np.concatenate([1000 * r + (x.t / BLOCK).astype(int) for r, x in read])
        _, blocks = np.unique(block, return_inverse=True)
        if logged.std() < 1e-9 or law.std() < 1e-9:
            continue
        correlation = [np.corrcoef(row, logged)[0, 1] if row.std() > 0 else 0.0 for row in law]
        best = int(np.argmax(correlation))
        p = law[best]
        count = int(blocks.max()) + 1
        sums = [np.bincount(blocks, v, count) for v in (np.ones_like(p), p, logged, p * p, p * logged)]
        slopes = intervals.draws(sums, _slope, rng, DRAWS)
        slope, offset = np.polyfit(p, logged, 1)
        fit = 1 - np.var(logged - slope * p - offset) / np.var(logged)
        out.append(
            Stage(
                case.joint,
                read[-1][1].signal,
                float(slope),
                float(np.quantile(slopes, 0.05)),
                float(np.quantile(slopes, 0.95)),
                float(SHIFTS[best]),
                float(fit),
                _late(case, [runs[r] for r, _ in read]),
            )
        )
    return out


def _late(case: Case, runs: list[Run]) -> float:
    """Return s by which a drive may act late and be as believed: `BELIEF.late` of its loop's period, or of the
    readings' where those are further apart."""
    readings = max(float(np.median(np.diff(run.t))) for run in runs)
    return BELIEF.late * max(1.0 / (case.loop_rate or 1000.0), readings)


@dataclass
class _Logged:
    """A drive's logged signal [n] at times t [n] s while it was on, and what the believed law gives for it [D, n] where
    it acts later by each of `SHIFTS` than is believed."""

    signal: str
    t: np.ndarray
    logged: np.ndarray
    law: np.ndarray


def _logged(run: Run, j: int) -> _Logged | None:
    """Return what joint j's drive logged in a recording; None where it logged nothing that its law gives."""
    row = run.servo.nominal(run.joints)[j]
    gains, limit = {n: row[INDEX[n]] for n in ("kp", "kd")}, row[INDEX["torque_limit"]]
    if run.duty is not None and run.servo.drive == "voltage":
        logged, top, signal = run.duty[:, j], 1.0, "duty"
    elif run.torque is not None and run.servo.drive == "torque":
        logged, top, signal = run.torque[:, j], limit, "effort"
    else:
        return None
    on = np.isfinite(logged)
    if run.enabled is not None:
        on &= run.enabled[:, j] > 0.5
    law = []
    for d in SHIFTS + row[INDEX["delay"]]:
        cmd = run.command_at(run.t - d)[:, j]
        q, v = (np.interp(run.t - d, run.t, x[:, j]) for x in (run.qs, run.vs))
        law.append(np.clip(loop_torque(gains, cmd - q, v, 2.0), -top, top))
    return _Logged(signal, run.t[on], logged[on], np.array(law)[:, on])


def _slope(
    n: np.ndarray, sx: np.ndarray, sy: np.ndarray, sxx: np.ndarray, sxy: np.ndarray, axis: int = -1
) -> np.ndarray:
    """Return slopes of the lines through resampled blocks, of the blocks' sums: samples, x, y, x x and x y."""
    n, sx, sy, sxx, sxy = (s.sum(axis) for s in (n, sx, sy, sxx, sxy))
    return (n * sxy - sx * sy) / np.maximum(n * sxx - sx**2, 1e-30)
