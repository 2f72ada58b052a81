"""The search on one joint: its selection, then what was found on whole recordings, and intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dexsim.gap.rules import SEARCH
from dexsim.gap.search.fit import AWAY, Fitter, Residuals, slopes_of
from dexsim.gap.search.hypotheses import LONG, MAYBE, subset
from dexsim.gap.search.selection import JointSelection
from dexsim.gap.search.trial import Member, Outcome, Trial

FINER = 2  # steps of whole recordings, where an effect was found, in one of the windows'
PIN = 1e-6  # of room for what is held at a value


class JointSearch(JointSelection):
    """The search on one joint: hypotheses (`JointHypotheses`), their losses on what was left out (`JointLosses`),
    the scan (`JointScan`), the selection (`JointSelection`), and what was found on whole recordings."""

    def law_spread(self, trial: Trial) -> np.ndarray:
        """[P, 2] lowest and highest value of each parameter over the laws that do about as well (`SEARCH.alike` of the
        loss on what was left out)."""
        x = trial.fit.x
        out = np.stack([x, x], 1)
        at = {p.key: i for i, p in enumerate(trial.fit.params)}
        for tries in self.by_law.values():
            least = min(float(self._left(t).sum()) for t in tries)
            for t in tries:
                if t.ids != trial.ids or float(self._left(t).sum()) > (1 + SEARCH.alike) * least:
                    continue
                for p, value in zip(t.fit.params, t.fit.x, strict=True):
                    if not p.nuisance and p.key in at:
                        out[at[p.key]] = min(out[at[p.key], 0], value), max(out[at[p.key], 1], value)
        return out

    def settle(self, found: Outcome) -> None:
        """What was found, and nothing, as they are judged: on whole recordings, in shorter steps where an effect was
        found (where a joint sticks, or rattles in a dead zone, a millisecond leaves errors beyond the noise)."""
        if found.best.members:
            if not self.deadline.over():
                found.best = self._simpler(found.best)
            self.whole = self.case.plant.refined(FINER)
        self._on(0.3)
        self.polish(found.best), self.polish(found.none)  # kept for the judgement

    def _simpler(self, trial: Trial) -> Trial:
        """The trial without what may be so or otherwise in a drive (`MAYBE`), where it follows as well without: slopes
        stall at such kinks, and what was kept out may go beyond what told them."""
        params = trial.fit.params
        away = [
            p.key
            for p, x in zip(params, trial.fit.x, strict=True)
            if p.key in MAYBE and abs(x - MAYBE[p.key]) > AWAY * p.span
        ]
        best = trial
        for back in [{k} for k in away] + [set(away)] * (len(away) > 1):
            pinned = [
                replace(p, low=MAYBE[p.key] - PIN, high=MAYBE[p.key] + PIN, start=MAYBE[p.key]) if p.key in back else p
                for p in params
            ]
            with self._fix(trial.members):
                f = self.fitter.fit(pinned, x0=trial.fit.x, iterations=6)
            new = Trial(trial.members, f)
            if self._here(new) < (1 + 2 * SEARCH.tie) * self._here(trial):  # the more of them go back, the better
                best = new
        if best is not trial:
            self.cross(best)
        return best

    def polish(self, trial: Trial) -> Trial:
        """The trial refitted on whole training recordings run free from their first sample, where that follows them
        better than the windows' fit: state carried over windows is right there. Done once a trial."""
        if id(trial) not in self._polished:
            self._polished[id(trial)] = trial, self._polish(trial)
        return self._polished[id(trial)][1]

    def _polish(self, trial: Trial) -> Trial:
        if self.deadline.over():
            return trial
        plant = self.whole
        whole = plant.windows(None, self.train, span=self.span)
        r = Residuals(self.r.sigma_q, self.r.sigma_torque, huber=max(self.r.huber, 3.0))
        fitter = Fitter(plant, whole, r)
        params = trial.fit.params
        with self._fix(trial.members, plant):
            here = fitter.residuals(params, trial.fit.x[None])[0]
            fitter.r.huber = 3.0 * max(1.0, float(np.sqrt(np.median(here**2))) / 0.67)
            # slopes in the windows' own steps serve for shorter ones
            slopes = slopes_of(
                Fitter(self.case.plant, self.case.plant.windows(None, self.train, span=self.span), r).fit(
                    params, x0=trial.fit.x, iterations=0
                )
            )
            f = fitter.fit(params, x0=trial.fit.x, iterations=3, tolerance=1e-2, slopes=slopes, exact=False)
        if fitter.loss(f.residual[None])[0] < 0.97 * fitter.loss(here[None])[0]:
            with self._fix(trial.members):
                again = self.fitter.fit(params, x0=f.x, iterations=0)
            polished = Trial(trial.members, again, trial.left_out, trial.folds)
            if again.loss < 1.5 * trial.fit.loss and not self._shrunk(polished):
                return polished
        return trial

    def by_run(self, trial: Trial) -> np.ndarray:
        """[R] mean Huber square of each run's windows where it was fitted; 0 for runs without."""
        with self._fix(trial.members):
            r = self.fitter.evaluate(trial.fit.params, trial.fit.x)
        a, k = np.abs(r), self.r.huber
        a = np.where(a <= k, a * a, 2 * k * a - k * k) if k > 0 else a * a
        run, count = self.long.run[self.fitter.window], self.case.plant.runs
        return np.bincount(run, a, count) / np.maximum(np.bincount(run, minlength=count), 1)

    def in_windows(self, trial: Trial, runs: Sequence[int], span: dict[int, tuple[float, float]] | None) -> float:
        """Mean Huber square, in sigmas, over windows of `runs` that begin anew at smoothed measured states."""
        windows = self.case.plant.windows(LONG, runs, span=span)
        if not len(windows.window):
            return np.nan
        fitter = Fitter(self.case.plant, windows, self.r)
        with self._fix(trial.members):
            return float(fitter.loss(fitter.evaluate(trial.fit.params, trial.fit.x)[None])[0])

    def widen(self, trial: Trial, bounds: np.ndarray) -> np.ndarray:
        """Intervals that also hold what the residuals do not show, added in squares: the disagreement of the fits
        without one condition each (a jackknife); the believed figures being off by more than their fit says (SEARCH.off
        each, the effects' parameters answering); and SEARCH.doubt of the value itself, the plant being no truer."""
        f = trial.fit
        x, P = f.x, len(f.x)
        if P == 0:
            return bounds
        low, high = np.array([p.low for p in f.params]), np.array([p.high for p in f.params])
        span = high - low
        square = (0.75 * (bounds[:, 1] - bounds[:, 0])) ** 2
        folds = np.array([g for g in trial.folds if len(g) == P])
        if len(folds) >= 2:
            n = len(folds)
            square += 1.645**2 * (n - 1) / n * ((folds - folds.mean(0)) ** 2).sum(0)
        mine = np.array([not p.nuisance for p in f.params])
        J = f.jacobian * span
        A = J.T @ J
        i, k = np.flatnonzero(mine), np.flatnonzero(~mine)
        if len(i) and len(k):
            M = A[np.ix_(i, i)] + 1e-9 * np.trace(A) * np.eye(len(i))
            answer = np.linalg.solve(M, A[np.ix_(i, k)]) * span[i][:, None] / span[k][None]  # d effect / d nuisance
            off = np.array(
                [
                    SEARCH.off * abs(v)
                    if p.mode == "factor"
                    else 0.25 * min(p.span, 4 * SEARCH.off * abs(v) + 1e-3 * p.span)
                    for p, v in zip(np.array(f.params, object)[k], x[k], strict=True)
                ]
            )
            square[i] += ((1.645 * answer * off) ** 2).sum(1)
        itself = np.array([0.03 if p.key.endswith(("kp_factor", "kd_factor")) else SEARCH.doubt for p in f.params])
        square += (1.645 * itself * np.abs(x)) ** 2
        half, laws = np.sqrt(square), self.law_spread(trial)
        return np.stack([np.maximum(laws[:, 0] - half, low), np.minimum(laws[:, 1] + half, high)], 1)


__all__ = ["JointSearch", "Member", "Outcome", "Trial", "subset"]
