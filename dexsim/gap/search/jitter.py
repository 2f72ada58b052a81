"""Jitter of a command delay: how much the time at which single commands act varies.

When each command acts is not recorded, but what its time does to the motion can be simulated: with every 128th command
late by a little, one guess for each, a batch gives the motion's answer H [commands, samples] to the time of each
command of a window. If the times vary by chance with standard deviation s, residuals are normal with covariance

    C(s) = a^2 1 + b^2 exp(-|t - t'| / tau) + sum over k of g_k^2 H' K_k H + s^2 H' H

(a: white noise; b: what the plant follows no better, correlated over tau; g_k: times that are off, but alike for
commands 50 and 200 ms apart, as what is missing elsewhere looks: jitter is what has no memory), and s comes from the
likelihood of all windows, its interval from where that falls by 1.35 (90 %). A likelihood-ratio test against s = 0
decides whether there is any to report.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import brentq, minimize

from dexsim.gap.plant.columns import INDEX, LATE_GROUPS, expand
from dexsim.gap.rules import JUDGE
from dexsim.gap.search.fit import Fitter
from dexsim.gap.search.search import JointSearch, Trial, subset

LATE = 2e-3  # s: by what a command is late to see what it does, at most a fifth of the time between commands
WINDOWS = 24  # at most, evenly over the recordings
ALIKE = (0.05, 0.2)  # s: over which times that are off may be alike
SPAN = 1.25  # s of commands that may act within a window of a second
FALL = 0.5 * 1.645**2  # of the log likelihood at the ends of a 90 % interval
LEFT = 2.0  # x the noise squared that a hypothesis leaves, from which jitter is looked for


@dataclass
class Jitter:
    """Standard deviation [s] of the delay of single commands, its 90 % interval, gain of the log likelihood over
    none."""

    value: float
    low: float
    high: float
    gain: float

    def entry(self) -> dict[str, float | str]:
        """As a parameter in diagnosis.json."""
        return {"value": self.value, "low": self.low, "high": self.high, "unit": "s"}


def certain(gain: float, value: float, beside: float, noise: float) -> bool:
    """Whether jitter of `value` [s] is reported. gain: of the log likelihood; beside: what stays with it that is
    correlated, to compare with the noise: where that is more, something else is missing that looks alike (an unmodelled
    resonance does)."""
    return not (gain < JUDGE.jitter or value < JUDGE.clocks or beside > noise)


def _windows(search: JointSearch, trial: Trial) -> list[tuple[np.ndarray, np.ndarray, list[np.ndarray], np.ndarray]]:
    """Of each window of n samples: the residual [n] of a fitted hypothesis, H' H and H' K_k H [n, n] (H in ms), and the
    time between its samples [n, n] s; none where the commands' times do nothing."""
    plant = search.case.plant
    keep = np.zeros(len(search.short.window), bool)
    keep[np.unique(np.linspace(0, len(keep) - 1, min(WINDOWS, len(keep))).astype(int))] = True
    fitter = Fitter(plant, subset(search.short, keep), search.r)
    use = slice(0, fitter.w.n)  # positions only: a logged effort follows the same commands, but its noise is another
    gaps = np.concatenate([np.diff(t) for t in plant.command_times])
    gaps = gaps[gaps > 1e-6]
    if not len(gaps):
        return []
    spacing = float(np.median(gaps))
    late, group = min(LATE, 0.2 * spacing), max(1, int(np.ceil(SPAN / spacing / LATE_GROUPS)))
    with search._fix(trial.members):
        residual, s = fitter.init_directions(trial.fit.params, trial.fit.x)
        guess = np.repeat(expand(plant, trial.fit.params, trial.fit.x[None]), LATE_GROUPS, 0)
        guess[:, :, INDEX["late_by"]], guess[:, :, INDEX["late_group"]] = late, group
        guess[:, :, INDEX["late_at"]] = np.arange(LATE_GROUPS)[:, None]
        q, tau = plant.simulate(guess, fitter.w)
        moved = (fitter.compare(q, tau, guess) - residual) / late
    moved, residual = (fitter.eliminated(x, s)[:, use] for x in (moved, residual[None]))
    t = plant.t[fitter.w.sample_row]
    apart = np.abs(np.arange(LATE_GROUPS)[:, None] - np.arange(LATE_GROUPS)[None])
    apart = np.minimum(apart, LATE_GROUPS - apart) * group * spacing
    kernels = [np.exp(-apart / width) for width in ALIKE]
    windows = []
    for w in range(fitter.count):
        on = fitter.window[use] == w
        if on.sum() > 8:
            h = 1e-3 * moved[:, on]  # in units in which 1 ms counts as 1
            windows.append(
                (residual[0, on], h.T @ h, [h.T @ k @ h for k in kernels], np.abs(t[on][:, None] - t[on][None]))
            )
    return windows if windows and max(float(np.trace(h)) for _, h, _, _ in windows) >= 1e-6 else []


def estimate(search: JointSearch, trial: Trial) -> Jitter | None:
    """The jitter that the residuals of a fitted hypothesis hold; None where they hold none for certain."""
    windows = _windows(search, trial)
    if not windows:
        return None

    def cost(z: np.ndarray, jitter: float) -> float:
        """Minus the log likelihood of all windows; z: logs of a, b, tau and of each g."""
        a, b, width, *alike = np.exp(np.clip(z, -12, 12))
        total = 0.0
        for r, h, slow, d in windows:
            c = b * b * np.exp(-d / width) + jitter * jitter * h
            for g, x in zip(alike, slow, strict=True):
                c += g * g * x
            c[np.diag_indices(len(r))] += a * a + 1e-6
            root = cholesky(c, lower=True, check_finite=False)
            y = solve_triangular(root, r, lower=True, check_finite=False)
            total += float(np.log(np.diag(root)).sum() + 0.5 * y @ y)
        return total

    spread = float(np.std(np.concatenate([w[0] for w in windows])))
    noise = search.case.sigma / search.r.sigma_q  # measured: what would need less of it is not jitter
    start = np.log([noise, 0.3, 0.08, *(0.5 * np.sqrt(spread) for _ in ALIKE)])
    bounds = [(np.log(0.75 * noise), np.log(1.5 * noise)), (-4, 6), (-4, 0.7)] + [(-4, 5)] * len(ALIKE)
    options = {"maxiter": 30}
    none = minimize(cost, start, args=(0.0,), method="L-BFGS-B", bounds=bounds, options=options)
    both = minimize(
        lambda z: cost(z[:-1], np.exp(z[-1])),
        np.r_[none.x, np.log(1.0)],
        method="L-BFGS-B",
        bounds=[*bounds, (-4, 5)],
        options=options,
    )
    best, value = float(both.fun), float(np.exp(both.x[-1]))
    gain = float(none.fun) - best
    if not certain(gain, 1e-3 * value, float(np.exp(both.x[1])), noise):
        return None
    over = lambda log: cost(both.x[:-1], np.exp(log)) - best - FALL  # noqa: E731
    middle = np.log(value)
    low = brentq(over, middle - 3, middle, xtol=0.01) if over(middle - 3) > 0 else -np.inf
    high = brentq(over, middle, middle + 2, xtol=0.01) if over(middle + 2) > 0 else middle + 2
    return Jitter(1e-3 * value, 1e-3 * float(np.exp(low)), 1e-3 * float(np.exp(high)), gain)
