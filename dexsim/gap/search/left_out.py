"""What hypotheses lose on conditions that their fit has not seen, and whether one earns its place by that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dexsim import intervals
from dexsim.gap.plant.columns import SHAPES, at_bound
from dexsim.gap.rules import SEARCH
from dexsim.gap.search.fit import Fitter, disbelief, prior_weight, slopes_of
from dexsim.gap.search.hypotheses import JointHypotheses, subset
from dexsim.gap.search.trial import Trial, dear_of

BOOTSTRAPS, STRETCH = 300, 4  # and of how many neighbouring half-second blocks a stretch of theirs is


class JointLosses(JointHypotheses):
    """Losses of one joint's hypotheses on conditions left out."""

    none_loss: np.ndarray  # by block, without any effect

    def _score(self, trial: Trial) -> float:
        """Left-out loss with a price on parameters."""
        return (
            float(self._left(trial).sum())
            * (1 + SEARCH.per_parameter * sum(len(m.variant.params) for m in trial.members))
            * self._dear(trial)
        )

    def _dear(self, trial: Trial) -> float:
        """Factor on the losses of a hypothesis that can imitate simpler ones, or whose size stopped at the end of what
        is physical: the data would have it where it cannot be."""
        at, begin = dear_of(trial), 0
        for m in trial.members:
            fitted = trial.fit.x[begin : begin + len(m.variant.params)]
            begin += len(m.variant.params)
            values = {p.key: x for p, x in zip(m.variant.params, fitted, strict=True) if p.key not in SHAPES}
            if at_bound([p for p in m.variant.params if p.key in values], values, self.case):
                at *= SEARCH.bounded
        return at

    def _left(self, trial: Trial) -> np.ndarray:
        """Losses by block [B] on what was left out, and what the beliefs had to give for them, spread over the
        blocks."""
        out = self.cross(trial)
        return out + disbelief(trial.fit.params, trial.fit.x) / len(out)

    def cross(self, trial: Trial) -> np.ndarray:
        """Losses by block [B] when the block's condition is left out of the fit: from the optimum of all, one bounded
        Gauss-Newton step on the other conditions, its length chosen there."""
        if trial.left_out is not None:
            return trial.left_out
        f, fitter = trial.fit, self.fitter
        P = len(f.params)
        out = np.zeros(int(self.blocks.max()) + 1)
        low, high = np.array([p.low for p in f.params]), np.array([p.high for p in f.params])
        span = high - low
        folds = np.unique(self.fold_of)
        fold = self.fold_of[fitter.window]
        k = self.r.huber
        weight = np.minimum(1.0, k / np.maximum(np.abs(f.residual), 1e-12)) if k > 0 else np.ones(len(f.residual))
        guesses = [f.x]
        believed, centre = prior_weight(f.params), np.array([p.start for p in f.params], float)
        lengths = (0.35, 1.0)
        for number in folds:
            on = fold != number if len(folds) > 1 else fold == number
            if P == 0:
                continue
            J = f.jacobian[on] * span
            w = weight[on]
            A, b = (J * w[:, None]).T @ J, -(J * w[:, None]).T @ f.residual[on] - believed * (f.x - centre) * span
            A[np.diag_indices(P)] += believed * span**2
            free = ~(((f.x <= low + 1e-12) & (b < 0)) | ((f.x >= high - 1e-12) & (b > 0)))
            step = np.zeros(P)
            i = np.flatnonzero(free)
            if len(i):
                M = A[np.ix_(i, i)] + np.diag(1e-3 * np.diag(A)[i] + 1e-9 * np.trace(A) + 1e-12)
                step[i] = np.linalg.solve(M, b[i])
            step = np.clip(step, -0.3, 0.3)
            guesses += [np.clip(f.x + length * step * span, low, high) for length in lengths]
        with self._fix(trial.members):
            _, s = fitter.init_directions(f.params, f.x) if fitter.eliminate else (None, None)
            res = fitter.eliminated(fitter.residuals(f.params, np.array(guesses)), s)
        a = np.abs(res)
        a = np.where(a <= k, a * a, 2 * k * a - k * k) if k > 0 else a * a
        for n, number in enumerate(folds):
            test = fold == number
            on = ~test if len(folds) > 1 else test
            options = [0] if P == 0 else [0, *range(1 + n * len(lengths), 1 + (n + 1) * len(lengths))]
            best = min(options, key=lambda o: a[o][on].sum())
            trial.folds.append(np.array(guesses)[best])
            out += np.bincount(self.blocks[test], a[best][test], len(out))
        trial.left_out = out
        return out

    def refold(self, trial: Trial) -> Trial:
        """The trial with its losses on what was left out from fits of their own: where an effect is kinked (a limit, a
        sag, play), one step from the optimum of all lands anywhere."""
        f = trial.fit
        out = np.zeros(int(self.blocks.max()) + 1)
        folds, parts = np.unique(self.fold_of), []
        if len(folds) < 2 or not len(f.params):
            return trial
        with self._fix(trial.members):
            for number in folds:
                on = self.fold_of != number
                fitter = Fitter(self.case.plant, subset(self.long, on), self.r)
                rows = on[self.fitter.window]
                known = {key: v[rows] for key, v in slopes_of(f).items()}
                x = fitter.fit(f.params, x0=f.x, iterations=4, tolerance=1e-2, slopes=known, exact=False).x
                r = self.fitter.evaluate(f.params, x)
                a, k = np.abs(r), self.r.huber
                a = np.where(a <= k, a * a, 2 * k * a - k * k) if k > 0 else a * a
                test = ~on[self.fitter.window]
                out += np.bincount(self.blocks[test], a[test], len(out))
                parts.append(x)
        return replace(trial, left_out=out, folds=parts, refitted=True)

    def _earns(self, new: Trial, old: Trial, further: bool = True) -> bool:
        a, b = self._left(old), self._left(new)
        gain = 1 - b.sum() / a.sum()
        # what was left out may be lost by the step to it alone: what is fitted must be followed better too
        if gain < SEARCH.least or self._here(new) > (1 - 0.5 * SEARCH.least) * self._here(old) or self._shrunk(new):
            return False
        if old.members and further:  # what follows must matter beside what was found
            rms = lambda x: np.sqrt(x.sum() / len(self.blocks))  # noqa: E731
            if rms(a) - rms(b) < SEARCH.second * (rms(self.none_loss) - rms(a)):
                return False
        # what only a few moments show (a limit, a sag) varies much between draws, and more of the error goes with it
        chance = (
            SEARCH.chance
            if old.members or gain < 2 * SEARCH.least
            else (2.5 if gain < 4 * SEARCH.least else 5.0) * SEARCH.chance
        )
        return bool(np.quantile(self._boot(a - b), chance) > 0)

    def _boot(self, x: np.ndarray) -> np.ndarray:
        """Sums of a block bootstrap of x [B]: 2-s stretches of neighbouring half-second blocks."""
        return x[intervals.stretches(len(x), STRETCH, self.rng, BOOTSTRAPS)].sum(1)

    def _by_condition(self, lost: np.ndarray, mine: np.ndarray) -> list[float]:
        """Relative gain of `mine` over `lost` (losses by block [B]) on each condition that was left out."""
        fold = self.fold_of[self.fitter.window]
        out = []
        for number in np.unique(fold):
            pick = np.unique(self.blocks[fold == number])
            out.append(float(1 - mine[pick].sum() / max(float(lost[pick].sum()), 1e-30)))
        return out

    def gain(self, new: Trial, old: Trial) -> float:
        """Share of the squared error that `new` removes, with what the beliefs give for it: on conditions left out or
        where it was fitted, whichever is less."""
        return 1 - max(float(self._left(new).sum() / self._left(old).sum()), self._here(new) / self._here(old))
