"""One joint's answer judged on what was held out of the fit: errors before and after, findings with their doubts, where
its residual lives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from dexsim.gap import locate
from dexsim.gap.effects import FittedEffect
from dexsim.gap.effects.catalogue import confusable, inseparable, separating
from dexsim.gap.finding import Finding, chances, removed
from dexsim.gap.inquiry import Curve
from dexsim.gap.judge import confidence, held_out
from dexsim.gap.judge.held_out import rms
from dexsim.gap.plant.case import Case, intervals_of
from dexsim.gap.plant.columns import at_bound
from dexsim.gap.plant.free_run import free_run
from dexsim.gap.read import Run
from dexsim.gap.rules import BELIEF, JUDGE, SEARCH
from dexsim.gap.search.fit import Box, Fitted, intervals
from dexsim.gap.search.hypotheses import JointSearch, Member, Outcome, Trial
from dexsim.gap.search.scan import cv_loss
from dexsim.gap.search.search import law_spread, polished, widened
from dexsim.recording.mechanism import Mechanism


class JointAnswer:
    """A searched joint on what was held out.

    before, after: squared errors of free runs (rows,) [rad^2 or m^2] without any effect and with what was found, at
    times t (rows,) [s]; effort_before, effort_after: those of the torque where it was recorded, else None; bounds: 90 %
    intervals of the fitted parameters; widest: as they are before it is known how well what was held out is followed,
    by which names are doubted; numbers: the same as figures for the page; nuisance: refitted beliefs; found, evidence:
    see `judge`; spots, depends_on: see `locate`."""

    def __init__(self, case: Case, search: JointSearch, outcome: Outcome, kept: held_out.Split):
        self.case, self.search, self.outcome, self.kept = case, search, outcome, kept
        self.best, self.none = polished(search, outcome.best), polished(search, outcome.none)
        self.whole = replace(case, plant=search.whole)
        self.windows = self.whole.plant.windows(None, kept.test, span=kept.span_test)
        rows = self.rows = self.windows.sample_row
        self.q_before, effort_before = without = self._run_free(self.none)
        self.q_after, effort_after = self._run_free(self.best) if self.best.members else without
        self.measured, self.t = case.plant.q[rows], case.plant.t[rows] + 1e4 * case.plant.run_of[rows]
        self.before, self.after = (self.measured - self.q_before) ** 2, (self.measured - self.q_after) ** 2
        self.torque = case.plant.torque[rows]
        self.sensed = np.isfinite(self.torque)
        self.effort_before = (self.torque - effort_before)[self.sensed] ** 2 if self.sensed.any() else None
        self.effort_after = (self.torque - effort_after)[self.sensed] ** 2 if self.sensed.any() else None
        self.widest = widened(search, self.best, intervals(self.best.fit, search.blocks, huber=search.r.huber))
        left = max(rms(self.after) / case.sigma, self.best.fit.loss**0.5) if len(rows) else 0.0
        told, laws = stretched(self.widest, self.best.fit, left), law_spread(search, self.best)
        self.bounds = np.stack([np.minimum(told[:, 0], laws[:, 0]), np.maximum(told[:, 1], laws[:, 1])], 1)
        self.nuisance = nuisances(case.joint, self.best)
        self._trials: dict[str, tuple[Trial, np.ndarray, np.ndarray]] = {}  # of `_without`
        self.earlier: JointAnswer | None = None  # with an effect that was taken back since
        self.found: list[Finding] = []
        self.evidence: list[confidence.Evidence] = []
        self.spots: list[locate.Spot] = []
        self.depends_on: list[str] = []

    @property
    def numbers(self) -> dict[str, float]:
        """Errors for the page."""
        return {
            "before": rms(self.before),
            "after": rms(self.after),
            "sigma": self.case.sigma,
            "fitted": self._followed,
        }

    @property
    def shown(self) -> np.ndarray:
        """(rows,) bool: samples away from what no fitted recording visits."""
        apart = self.kept.apart.get(self.case.joint)
        return np.ones(len(self.rows), bool) if apart is None else ~apart[self.rows]

    def mae(self) -> dict[str, tuple[float, float]]:
        """Mean |error| before and after by recording; one that was cut is several runs."""
        out, runs, run_of = {}, self.kept.runs, self.case.plant.run_of[self.rows]
        for i in self.kept.test:
            pick = np.isin(run_of, [k for k in self.kept.test if runs[k].name == runs[i].name])
            if pick.any():
                before, after = (np.abs(self.measured - q)[pick].mean() for q in (self.q_before, self.q_after))
                out[runs[i].name] = float(before), float(after)
        return out

    @classmethod
    def of(cls, case: Case, search: JointSearch, outcome: Outcome, kept: held_out.Split) -> JointAnswer:
        """Return the answer without those of several effects on the joint that what was held out refutes, the one that
        harms most first. `outcome` stays as it is: others may still be searched by it, and must not learn of what was
        kept out."""
        answer = cls(case, search, outcome, kept)
        while (better := answer._without_refuted()) is not None:
            earlier, answer = answer, cls(case, search, replace(answer.outcome, best=better), kept)
            answer.earlier = earlier
        return answer

    def _without_refuted(self) -> Trial | None:
        """Return the best hypothesis without the effect whose absence follows what was held out best; None where each
        lowers that error, or may remove as much of it as a name has to. No free run keeps step with what makes a joint
        ring, and a reading of the effort moves nothing."""
        if len(self.best.members) < 2 or not len(self.after):
            return None
        best, least = None, float(np.mean(self.after))
        for mm in self.best.members:
            if mm.effect.effort_only or mm.effect.rings:
                continue
            trial, q, _ = self._without(mm)
            lost = (self.measured - q) ** 2
            if np.mean(lost) < least and held_out.gain_interval(lost, self.after, self.t)[1] < JUDGE.part:
                best, least = trial, float(np.mean(lost))
        return best

    def _run_free(self, trial: Trial) -> tuple[np.ndarray, np.ndarray]:
        """Return position and effort (rows,) of a hypothesis' free run over what was held out."""
        return free_run(self.whole, trial.fit.params, trial.fit.x, self.windows, trial.fixed, True)

    def _without_id(self, effect: str) -> np.ndarray:
        """Return position (rows,) of a free run by the best hypothesis without an effect of this id."""
        return self._without(next(mm for mm in self.best.members if mm.id == effect))[1]

    def _without(self, mm: Member) -> tuple[Trial, np.ndarray, np.ndarray]:
        """Return (the best hypothesis without an effect, position and effort (rows,) of its free run)."""
        if mm.id not in self._trials:
            rest = tuple(x for x in self.best.members if x is not mm)
            less = lambda: self.best.but(self.best.members.index(mm))  # noqa: E731
            trial = self.search.fit(*less(), self.best, quick=True) if rest else self.none
            self._trials[mm.id] = trial, *self._run_free(trial)
        return self._trials[mm.id]

    def judge(self, m: Mechanism) -> None:
        """Fills `found`: what was found, and the evidence behind each.

        Where an effect was taken back, what is left is judged with it and without, and believed the more: unless the
        one that went explains a part of what was held out by itself. It is another explanation then, and the less
        counts."""
        self.found = [self._finding(mm, m) for mm in self.best.members]
        if self.earlier is None:
            return
        self.earlier.judge(m)
        for k, mm in enumerate(self.best.members):
            with_it = next(e for e in self.earlier.evidence if e.effect == mm.id)
            lost = np.mean((self.measured - self.earlier._without_id(mm.id)) ** 2)
            other = lost <= (1 - JUDGE.part) * np.mean(self.before)
            chosen = (min if other else max)(self.evidence[k], with_it, key=lambda e: e.confidence)
            self.evidence[k], self.found[k] = chosen, replace(self.found[k], confidence=chosen.confidence)

    def _finding(self, mm: Member, m: Mechanism) -> Finding:
        case = self.case
        raw, spread = self._fitted(mm, self.bounds)
        trial, q, effort = self._without(mm)
        lost = (self.measured - q) ** 2
        effort_only = mm.effect.effort_only
        of_effort = self.effort_after if effort_only else None
        gain = told = held_out.gain_interval(lost, self.after, self.t)
        if of_effort is not None:
            misread = (self.torque - effort)[self.sensed] ** 2
            was, left = rms(misread), rms(of_effort)
            told = held_out.gain_interval(misread, of_effort, self.t[self.sensed])
        else:
            was, left = rms(lost), rms(self.after)
        evidence = self._judged(mm, raw, was, left, gain[0])
        evidence.score = self._score(trial)
        self.evidence.append(evidence)
        rivals = self.outcome.rivals.get(mm.id, [])
        same = [r for r in rivals if confusable(r[0], mm.id) and r[1] >= JUDGE.level][:2]
        alike = inseparable(mm.id, case, sorted({*self.kept.train, *self.kept.test}))
        same += [(e, 0.0) for e in alike if e not in dict(same)][: 2 - len(same)]
        signal = mm.effect.signal(case, raw, mm.variant.note)
        active = signal > JUDGE.acts * max(float(np.percentile(signal, 99.9)), 1e-12)
        sizes = mm.effect.parameters(FittedEffect(mm.variant, raw, spread, case, m.table))
        alike = [mm.id, *(e for e, _ in same)] if same else []
        return Finding(
            mm.id,
            evidence.confidence,  # what the other findings say of it comes last
            mm.effect.shows,
            [case.joint],
            alternatives=chances(rivals),
            indistinguishable=alike,
            separating_experiment=separating(alike) if alike else None,
            when=intervals_of(active, case, self.kept.runs, sorted({*self.kept.train, *self.kept.test})),
            parameters=sizes,
            held_out=removed(was, left, told),
        )

    def _judged(self, mm: Member, raw: dict[str, float], was: float, left: float, surely: float) -> confidence.Evidence:
        """Return the evidence of one effect: was, left: rms error of what was held out without and with it; surely:
        share of the squared error that it removes in all but a twentieth of its draws."""
        effort_only = mm.effect.effort_only
        evidence = self._weighed(mm, raw, was, left)
        if left**2 > (1 - JUDGE.part) * was**2:
            evidence.hint(
                f"it removes {100 * max(1 - (left / max(was, 1e-12)) ** 2, 0):.0f} % of the squared error on what was "
                f"held out, less than {100 * JUDGE.part:.0f} %"
            )
        elif not effort_only and surely < -SEARCH.tie:
            evidence.hint("the error on what was held out is not lower with it than without, as far as its blocks tell")
        return evidence

    def _score(self, without_it: Trial) -> float:
        """Return log of the odds [nats] by which conditions left out speak for what the best hypothesis has beside
        another: normal residuals of unknown size, alike within half a second and independent beyond."""
        lost, mine = (cv_loss(self.search, t) for t in (without_it, self.best))
        return 0.5 * len(mine) * float(np.log(lost.sum() / mine.sum()))

    def _fitted(self, mm: Member, bounds: np.ndarray) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
        """Return values and intervals of one effect's parameters, of `bounds` [P, 2]."""
        best = self.best
        index = [[p.key for p in best.fit.params].index(f"{mm.id}.{p.key}") for p in mm.variant.params]
        raw = {p.key: float(best.fit.x[i]) for p, i in zip(mm.variant.params, index, strict=True)}
        spread = {
            p.key: (float(bounds[i][0]), float(bounds[i][1])) for p, i in zip(mm.variant.params, index, strict=True)
        }
        # a level that was unknown and is fitted anyway
        for p, x, b in zip(best.fit.params, best.fit.x, bounds, strict=True):
            key = mm.effect.fitted_anyway.get(p.key)
            if key is not None and key not in raw:
                raw[key], spread[key] = float(x), (float(b[0]), float(b[1]))
        return raw, spread

    def _weighed(self, mm: Member, raw: dict[str, float], error_without: float, after: float) -> confidence.Evidence:
        """Return how sure the name is, and every reason to doubt it. error_without, after: rms error on what was held
        out without and with it: of the motion, or of the effort where the motion is unaffected (what is left of the
        motion then tells nothing of it)."""
        case, outcome, effort_only, params = self.case, self.outcome, mm.effect.effort_only, mm.variant.params
        # the one effect of the reading: nothing else explains the effort
        before, noise = (error_without, self.search.r.sigma_torque) if effort_only else (rms(self.before), case.sigma)
        earned = 1.0 if effort_only else confidence.earned(error_without, after)
        as_fitted, reported = (self._fitted(mm, x)[1] for x in (self.widest, self.bounds))
        evidence = confidence.Evidence(
            mm.id, case.joint, outcome.confidence[mm.id], earned,
            confidence.left_over(after, before, noise),
            confidence.left_over(after, error_without, noise), 0.0, len(self.best.members))  # fmt: skip
        nothing, as_reported = (confidence.holds_nothing(params, x, case) for x in (as_fitted, reported))
        if nothing:
            evidence.reasons.append("its interval holds the size at which nothing is missing")
        elif as_reported:
            evidence.reasons.append(
                "its interval, as wide as what is left and the laws it may follow make it, holds the size at which "
                "nothing is missing"
            )
        small = blurred = ""
        if not effort_only:
            small = confidence.too_small(before, error_without, after, case.sigma, len(self.best.members) == 1)
            blurred = "" if small else confidence.unresolved(error_without, after, case.quantum)
        evidence.reasons += [x for x in (small, blurred) if x]
        if mm.id in self.search.unasked:
            evidence.reasons.append("the search ended before all that it may be confused with was tried in its place")
        if stopped := at_bound(params, raw, case):
            evidence.reasons.append(f"its {stopped.replace('_', ' ')} stopped at the bound of what is physical")
        elif far := confidence.beyond(params, reported, case):
            evidence.reasons.append(f"its {far.replace('_', ' ')} may be larger than what is looked for")
        evidence.reasons += mm.effect.doubts(case, sorted({*self.kept.train, *self.kept.test}))
        evidence.confidence = confidence.weigh(evidence)
        if unlike := confidence.not_repeated(params, self._by_fold(mm), case):
            evidence.reasons.append(unlike)
        if (nothing and as_reported) or small or blurred or stopped or unlike:
            evidence.confidence = min(evidence.confidence, JUDGE.hinted)
        if not self.kept.proven:
            evidence.doubt("nothing that moves is left to try it on: record the motion twice")
        return evidence

    def _by_fold(self, mm: Member) -> np.ndarray:
        """Return what each fit without one condition makes of an effect's parameters [F, P]."""
        index = [[p.key for p in self.best.fit.params].index(f"{mm.id}.{p.key}") for p in mm.variant.params]
        folds = [x[index] for x in self.outcome.best.folds if len(x) == len(self.best.fit.params)]
        return np.array(folds).reshape(len(folds), len(index))

    def floor_beyond(self) -> float:
        """Return what repeats differ by beyond what was found [rad or m]; inf without repeats."""
        return held_out.floor_beyond(self.whole, self.kept.runs, self.best.fit.params, self.best.fit.x, self.best.fixed)

    def locate(self, rng: np.random.Generator, seed: int) -> None:
        """Fills `spots`, where the believed simulator's residual lives, and `depends_on`, what the residual that is
        left depends on."""
        case, search = self.case, self.search
        n, blocks = search.long.n, search.blocks[: search.long.n]
        regimes = {k: v[search.long.sample_row] for k, v in case.regimes.items()}
        everything = search.fitter.evaluate(self.none.fit.params, self.none.fit.x)
        found = locate.spots(case.joint, everything[:n] * case.sigma, blocks, regimes, rng)
        if search.fitter.use_torque:
            on = search.fitter.tau_on
            effort = everything[n:][on] * search.r.sigma_torque
            found += locate.spots(
                case.joint,
                effort,
                blocks[on],
                {k: v[on] for k, v in regimes.items()},
                np.random.default_rng(seed + 1),
                "effort",
            )
        left = search.fitter.given(self.best.members).evaluate(self.best.fit.params, self.best.fit.x)[:n]
        spots = locate.control(locate.spots(case.joint, left * case.sigma, blocks, regimes, rng))
        self.spots, self.depends_on = (
            found,
            [f"{x.text} ({case.joint})" for x in spots[:2]] if rms(left**2) > JUDGE.within else [],
        )

    def curve(self) -> Curve | None:
        """Return the stretch where the believed simulator is worst."""
        return (
            _curve(self.case, self.kept.runs, self.rows, self.q_before, self.q_after, int(np.argmax(self.before)))
            if len(self.rows)
            else None
        )

    @cached_property
    def _followed(self) -> float:
        """Error (rms) of a free run over what was fitted, without any effect; simulated once."""
        case, fit = self.case, self.none.fit
        windows = self.search.fitted_whole
        q = free_run(case, fit.params, fit.x, windows, underway=True)[0]
        return float(np.sqrt(np.mean((case.plant.q[windows.sample_row] - q) ** 2)))


def stretched(bounds: np.ndarray, fit: Fitted, left: float) -> np.ndarray:
    """Return intervals [P, 2] about a fit, by how well it follows what was recorded, fitted or held out, whichever is
    followed worse (left: x the noise): what follows to the noise is known better than by all that might be off in it,
    what does not only looks like it and is something else. The law is from concealed cases (docs/concepts/gap.md)."""
    if left <= 0 or not fit.params:
        return bounds
    low, high = Box(fit.params).low[:, None], Box(fit.params).high[:, None]
    x, least = fit.x[:, None], traded(fit)[:, None] * np.array([-1.0, 1.0])
    by = np.clip(JUDGE.stretch * left**2, JUDGE.stretch_least, JUDGE.stretch_most) * (bounds - x)
    return np.clip(x + np.where(np.abs(by) < np.abs(least), least, by), low, high)


def traded(fit: Fitted) -> np.ndarray:
    """Return [P] half-widths (90 %) of effects' sizes by what they trade with beliefs (a rotor's inertia with the
    link's), however well all is followed: the variance that the beliefs' own, as far as the residuals leave it, adds to
    that of the sizes alone. 0 for beliefs."""
    span, mine = Box(fit.params).span, np.array([not p.nuisance for p in fit.params], bool)
    J = fit.jacobian * span
    A = J.T @ J
    believed = Box(fit.params).prior * span**2
    A[np.diag_indices(len(A))] += np.where(
        mine, 1e-9 * max(np.trace(A), 1e-30), np.where(believed > 0, believed, 12.0 * BELIEF.prior)
    )
    i = np.flatnonzero(mine)
    out = np.zeros(len(span))
    if len(i):
        out[i] = np.maximum(np.diag(np.linalg.inv(A))[i] - np.diag(np.linalg.inv(A[np.ix_(i, i)])), 0.0)
    return 1.645 * np.sqrt(BELIEF.prior * out) * span


def nuisances(joint: str, trial: Trial) -> dict[str, float]:
    """Return the refitted beliefs of one joint by the keys of `diagnosis.json`."""
    return {f"{p.key}_factor@{joint}" if p.mode == "factor" else f"{p.key}@{joint}": round(float(x), 6)
            for p, x in zip(trial.fit.params, trial.fit.x, strict=True) if p.nuisance}  # fmt: skip


def _curve(case: Case, runs: Sequence[Run], rows: np.ndarray, q0: np.ndarray, q1: np.ndarray, worst: int) -> Curve:
    t, r = case.plant.t[rows], case.plant.run_of[rows]
    run = r[worst]
    pick = np.flatnonzero((r == run) & (np.abs(t - t[worst]) < 4.0))
    command = runs[run].command_at(t[pick])[:, case.index]
    return Curve(case.joint, runs[run].name, t[pick], case.plant.q[rows][pick], q0[pick], q1[pick], command)
