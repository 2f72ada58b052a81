"""A joint that rings by itself, faster than its recordings resolve: what makes its loop do so, told by how much it
shakes and when.

Where a transmission gives, a loop that reads the joint and drives the motor may be unstable, and then rings on between
friction and the limits of its drive, often beyond half the rate of the samples. No simulation keeps step with that for
longer than a few swings, so that sample by sample all hypotheses miss it alike, the true one too. What lasts is when it
rings and how strongly. Of windows of a second that begin at the measured motion are compared, measured and simulated:
the rms by which a reading differs from the line between its neighbours one, two and three samples away (by logarithms:
of what rings by itself only the order of size is to be trusted), and the mean position. A loop with play is at rest in
one state and rings on in another, with the same command, and a measured motion that was smoothed or sampled slowly does
not tell its speed: a window whose first part rings, which is not compared, begins with the speed of a swing of that
size. Sizes are tried over their
whole range and then at random about the best (a loop rings or it does not: there is no slope to follow), beliefs with
them, which decide by how little it rings.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dexsim import intervals
from dexsim.gap.effects.catalogue import CATALOGUE
from dexsim.gap.plant.batch import Windows
from dexsim.gap.plant.case import Case
from dexsim.gap.plant.columns import Param, expand, neutral_of
from dexsim.gap.rules import SEARCH
from dexsim.gap.search.fit import Box
from dexsim.gap.search.hypotheses import SCAN_BUDGET, SHORT, JointSearch, Member, Outcome, Trial, subset, thin
from dexsim.gap.search.scan import narrowed

APART = (1, 2, 3)  # samples between a reading and those that it is compared with
SETTLES = 0.25  # s of a window before it is looked at: what was let go at a measured state swings in
# caps of a misfit: log ratio of what shakes, and x the usual miss of the mean: more counts as much
MOST_LOG, MOST_AWAY = 3.0, 5.0
# speed of a sine over its `levels[0]` and the time between samples: sqrt(2) wT / (1 - cos wT), within a tenth of this
# from 1.6 to 3 rad a sample
KICK = 2.1
RINGS = (0.02, 0.05, 0.1, 0.16, 0.22, 0.3, 0.4)  # damping ratios that are tried: a little more or less decides
LIMITS: tuple[dict[str, float], ...] = (  # laws of the drive's limits, which end how far it swings
    {"braking_slope": -1.0, "limit_speed": 1.0},
    {"braking_slope": -1.0, "limit_speed": 0.0},
    {"braking_slope": 1.0, "limit_speed": 1.0},
    {},
)
ROUNDS, DRAWN, CLOSER, FIRST = 6, 32, 0.7, 0.35  # about the best: rounds, guesses of each, and how far they are
CHUNK = 24  # guesses simulated at once
DRAWS = 300  # of a bootstrap over windows


class Ringing:
    """How much a joint shakes in windows of the recordings `runs`. loud [W] bool: windows that shake; rung [W] bool:
    those that begin ringing."""

    def __init__(
        self,
        search: JointSearch,
        none: Trial,
        runs: Sequence[int] | None = None,
        span: dict | None = None,
        quiet: float = np.inf,
    ):
        """runs: None for what is fitted; quiet: level at rest [rad] that other recordings have shown."""
        self.search, self.plant = search, search.case.plant
        self.w = (
            search.short
            if runs is None
            else thin(self.plant.windows(SHORT, list(runs), span=span), search.case, SCAN_BUDGET)
        )
        self.quiet, self.loud = quiet, np.zeros(len(self.w.window), bool)
        self.rung, self.speed = self.loud.copy(), 0.0
        self._parts: dict[bytes, Windows] = {}
        if not len(self.loud) or self.w.n < 20:
            return
        t, window = self.plant.t[self.w.sample_row], self.w.sample_window
        first = np.full(len(self.loud), np.inf)
        np.minimum.at(first, window, t)
        settled = t - first[window] > SETTLES
        self.near = []
        for g in APART:
            mid = np.flatnonzero((window[2 * g :] == window[: -2 * g]) & settled[g:-g]) + g
            part = (t[mid] - t[mid - g]) / np.maximum(t[mid + g] - t[mid - g], 1e-9)
            self.near.append((mid, g, part, window[mid]))
        self.kept = np.flatnonzero(settled)
        self.levels, self.means = (x[0] for x in self._of(self.plant.q[self.w.sample_row][None]))
        least = max(search.case.quantum / np.sqrt(12), 1e-12)  # readings of a joint at rest do not differ at all
        noise = np.sqrt(1.5) * search.case.sigma  # that of one reading and half of both its neighbours'
        self.quiet = max(min(float(self.levels[0].min()), quiet, noise), least)
        self.loud = self.levels[0] > SEARCH.loud * self.quiet
        if not self.loud.any():
            return
        self._begun(t, window, ~settled)
        levels, means = self._simulated(none.members, none.fit.params, none.fit.x[None])
        self.loud &= self.levels[0] > SEARCH.loud * levels[0, 0]
        self.usual = max(1.5 * float(np.median(np.abs(means[0] - self.means))), self.quiet / 3)

    def _begun(self, t: np.ndarray, window: np.ndarray, early: np.ndarray) -> None:
        """Fills `rung` and the speed [rad/s] at which such windows begin; t, window [n]: of each sample, early [n]
        bool: those that are not compared."""
        mid = np.flatnonzero((window[2:] == window[:-2]) & early[1:-1]) + 1
        q, step = self.plant.q[self.w.sample_row], np.diff(t)[np.diff(window) == 0]
        part = (t[mid] - t[mid - 1]) / np.maximum(t[mid + 1] - t[mid - 1], 1e-9)
        off = q[mid] - (q[mid - 1] * (1 - part) + q[mid + 1] * part)
        count = np.bincount(window[mid], None, len(self.loud))
        level = np.sqrt(np.bincount(window[mid], off**2, len(self.loud)) / np.maximum(count, 1))
        self.rung = level > SEARCH.loud * self.quiet
        if self.rung.any():
            self.speed = KICK * float(np.median(level[self.rung])) / float(np.median(step))

    def _of(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return ([H, gaps, W] rms by which readings q [H, n] differ from the line between their neighbours, [H, W]
        their mean)."""
        W = len(self.w.window)
        by = lambda x, of: np.bincount(of, x, W) / np.maximum(np.bincount(of, None, W), 1)  # noqa: E731
        levels = []
        for mid, g, part, of in self.near:
            off = q[:, mid] - (q[:, mid - g] * (1 - part) + q[:, mid + g] * part)
            levels.append(np.sqrt(np.stack([by(x * x, of) for x in off])))
        means = np.stack([by(x[self.kept], self.w.sample_window[self.kept]) for x in q])
        return np.stack(levels, 1), means

    def _simulated(
        self, members: tuple[Member, ...], params: list[Param], x: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        parts = []
        fixed = [f for m in members for f in m.variant.fixed]
        for i in range(0, len(x), CHUNK):
            rows = expand(self.plant, params, x[i : i + CHUNK], fixed)
            q = np.empty((len(rows), self.w.n))
            for on, speed in ((~self.rung, 0.0), (self.rung, self.speed)):
                if on.any():
                    inits = np.tile([0.0, speed], (len(rows), 1))
                    q[:, on[self.w.sample_window]] = self.plant.simulate(rows, self._part(on), inits)[0]
            parts.append(self._of(np.clip(np.nan_to_num(q, nan=1e4), -1e4, 1e4)))
        return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])

    def _part(self, on: np.ndarray) -> Windows:
        """Return the windows `on` [W] bool; made once, with what is known of them."""
        key = on.tobytes()
        if key not in self._parts:
            self._parts[key] = self.w if on.all() else subset(self.w, on)
        return self._parts[key]

    def missed(self, members: tuple[Member, ...], params: list[Param], x: np.ndarray) -> np.ndarray:
        """Return [H, W] by how much each guess x [H, P] misses each window."""
        levels, means = self._simulated(members, params, x)
        noise = 1.5 * self.quiet**2
        ratio = 0.5 * np.log((self.levels**2 + noise) / (levels**2 + 2 * noise))
        away = (means - self.means) / self.usual
        return (np.clip(ratio, -MOST_LOG, MOST_LOG) ** 2).sum(1) + SEARCH.resting * np.minimum(away**2, MOST_AWAY**2)

    def of(self, trial: Trial) -> np.ndarray:
        """Return [W] by how much a fitted hypothesis misses each window."""
        return self.missed(trial.members, trial.fit.params, trial.fit.x[None])[0]

    def best(self, member: Member, rng: np.random.Generator) -> tuple[float, list[Param], np.ndarray]:
        """Return (what is missed in all, params, sizes [P]) of one effect, looked for over its range and then about the
        best."""
        search, case = self.search, self.search.case
        own = len(member.variant.params)
        taken = {c for p in member.variant.params for c in p.columns}
        # as in a fit: keys of the effect's own parameters are unique in the hypothesis
        params = [p for p in search.params_of((member,)) if not p.nuisance]
        params += [p for p in search.all_nuisances if not (p.late or taken & set(p.columns))]
        box = Box(params)
        low, high = box.low, box.high
        keys = [p.key for p in params]
        guesses = []
        for start in _starts(member):
            for limits in LIMITS:
                x = box.centre.copy()
                x[:own] = start
                for key, value in limits.items():
                    if key in keys:
                        x[keys.index(key)] = value
                guesses.append(x)
        tried = np.unique(np.clip(np.array(guesses), low, high), axis=0)
        lost = self.missed((member,), params, tried).sum(1)
        least, x = float(lost.min()), tried[int(np.argmin(lost))]
        zero = np.array([neutral_of(p, case) for p in member.variant.params])
        zero = np.where(np.abs(zero) < 1e6, zero, 0.0)
        spread = np.array([p.sd if p.sd > 0 else 0.25 * p.span for p in params[own:]])
        for k in range(ROUNDS):
            size = CLOSER**k
            tried = np.repeat(x[None], DRAWN, 0)
            tried[:, :own] = zero + (x[:own] - zero) * np.exp(FIRST * size * rng.standard_normal((DRAWN, own)))
            moved = rng.random((DRAWN, len(spread))) < 0.3
            tried[:, own:] += moved * size * spread * rng.standard_normal(moved.shape)
            tried = np.clip(tried, low, high)
            lost = self.missed((member,), params, tried).sum(1)
            if lost.min() < least:
                least, x = float(lost.min()), tried[int(np.argmin(lost))]
        return least, params, x


def _starts(member: Member) -> list[tuple[float, ...]]:
    """Sizes from which an effect's are looked for, its damping finer than where a slope is followed."""
    keys, starts = [p.key for p in member.variant.params], member.variant.starts
    if "rebound" not in keys:
        return list(starts)
    i = keys.index("rebound")
    return list(dict.fromkeys((*s[:i], ring, *s[i + 1 :]) for s in starts for ring in RINGS))


def without_loop(case: Case) -> bool:
    """Return whether a joint's loop gives next to nothing of the torque that moves it (a duty or a torque is commanded,
    through a gain that stands for none): only what is fed back makes a joint ring by itself."""
    s = case.scales
    return s.stiffness * s.span < SEARCH.doubt * s.tau


def answered(search: JointSearch, found: Outcome) -> Outcome:
    """Return what the search of a joint found; where it rings by itself and that is hardly followed, the effect that
    makes it ring as measured in the place of what was found, if any does by at least `SEARCH.plainly` more."""
    followed = bool(found.best.members) and found.best.fit.loss < SEARCH.unsettled
    if followed or without_loop(search.case) or search.deadline.over():
        return found  # without an effect even ringing may be within the noise: it is what the noise was told by
    swings = Ringing(search, found.none)
    if swings.loud.sum() < SEARCH.shaking:
        return found
    before = swings.of(found.best)
    asked = [e for e in CATALOGUE if e.rings and search.asked(e)]
    tries: dict[str, tuple[float, Trial]] = {}
    for effect in asked:
        if effect.id in found.best.ids:
            return found  # it is what was found by the motion itself
        for whole in effect.variants(search.case.scales):
            variant = None if whole.refines or whole.approximate else narrowed(search, effect, whole)
            for law in [] if variant is None else [variant, *variant.by_law()]:
                if search.deadline.over():
                    continue
                member = Member(effect, law)
                lost, params, x = swings.best(member, search.rng)
                if effect.id not in tries or lost < tries[effect.id][0]:
                    fit = search.fitter.given((member,)).fit(params, x0=x, iterations=0)
                    tries[effect.id] = lost, Trial((member,), fit)
    if not tries:
        return found
    left = {e: swings.of(t) for e, (_, t) in tries.items()}
    name = min(left, key=lambda e: float(left[e].sum()))
    gain = 1 - left[name].sum() / before.sum()
    draws = intervals.singles(len(before), search.rng, DRAWS)
    sums = {e: x[draws].sum(1) for e, x in left.items()}
    if gain < SEARCH.plainly or np.mean(sums[name] < before[draws].sum(1)) < 1 - SEARCH.chance:
        return found
    won = np.argmin(np.stack(list(sums.values())), 0)
    share = {e: float(np.mean(won == k)) for k, e in enumerate(sums)}
    rivals = sorted(((e, s) for e, s in share.items() if e != name), key=lambda o: -o[1])
    return Outcome(found.joint, found.none, tries[name][1], {name: rivals}, {name: share[name]}, found.scanned)


def shown(search: JointSearch, outcome: Outcome, runs: Sequence[int], span: dict | None) -> float:
    """Share of what is missed of how a joint rings by itself in `runs`, which were held out, that what was found takes
    away; 0 where it does not ring there."""
    if not any(m.effect.rings for m in outcome.best.members):
        return 0.0
    fitted = Ringing(search, outcome.none)
    if not fitted.loud.any():
        return 0.0
    swings = Ringing(search, outcome.none, runs, span, fitted.quiet)
    # what is held out is a part of the recordings: one stretch of it bears out what several of the others show
    if not swings.loud.any() or sum((x.loud | x.rung).sum() for x in (fitted, swings)) < SEARCH.shaking:
        return 0.0
    before, after = (float(swings.of(t).sum()) for t in (outcome.none, outcome.best))
    return max(1.0 - after / before, 0.0)
