"""Which touch effects a pad has: its plant fitted to what was recorded, effects added while they earn it on presses
left out."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import least_squares

from dexsim import intervals
from dexsim.gap.effects import TouchEffect
from dexsim.gap.effects.catalogue import TOUCH_CATALOGUE, TOUCH_EFFECTS, touch_compatible, touch_confusable
from dexsim.gap.read import BLOCK
from dexsim.gap.read.noise import noise
from dexsim.gap.rules import BELIEF, JUDGE, SEARCH, TOUCH
from dexsim.gap.search.fit import huber_square
from dexsim.gap.touch.plant import PARAMS, cell, neutral, readings, shear
from dexsim.gap.touch.read import PadRun

# -- a pad's plant fitted ---------------------------------------------------------------------------------------------
# A pad's plant fitted to what was recorded: which residuals count, least squares, gains of single taxels, intervals.

OF_LAW = ("stiffness", "neighbours", "fraction", "c10", "c01")  # sizes that hang on how a force spreads over taxels
PLACE = {"zero": 1.0, "along": 4.0, "across": 4.0}  # x the doubt about where the object is: bounds of the shifts


@dataclass
class Sample:
    """Residuals of one stage in one recording: rows of `run` that count, and their noise."""

    run: PadRun
    stage: str
    mask: np.ndarray  # [S, K] taxels, [G] cell, [S, 2] shear
    sigma: np.ndarray  # the same shape
    block: np.ndarray  # of each residual, unique over all recordings
    train: np.ndarray  # of each residual


@dataclass
class TouchTrial:
    """A hypothesis: effects, values, gains and order of taxels (None where not fitted), residuals in sigmas by
    block."""

    ids: tuple[str, ...]
    values: dict[str, float]
    gains: np.ndarray | None = None
    order: np.ndarray | None = None
    keys: tuple[str, ...] = ()
    jac: np.ndarray | None = None
    res: np.ndarray = field(default_factory=lambda: np.zeros(0))
    left_out: np.ndarray | None = None
    folds: list[dict[str, float]] = field(default_factory=list)  # values without one fold each


class PadFit:
    """One pad's readings and the plant fitted to them. held: names of recordings held out; with none, the last quarter
    of each recording's time; name: the pad's."""

    def __init__(
        self,
        runs: list[PadRun],
        held: set[str],
        scale_known: bool,
        thermometer: bool,
        seed: int = 0,
        allowed: set[str] | None = None,
    ):
        self.runs, self.scale_known, self.allowed = runs, scale_known, allowed
        self.name = runs[0].name
        self.rng = np.random.default_rng(seed)
        self.load = all(r.load is not None for r in runs)
        if not self.load:
            for r in runs:
                r.load = None
        self.shear = all(r.shear is not None for r in runs) and self._slid()
        self.noise = self._noise()
        self.doubt = max(r.doubt for r in runs)
        self.load_noise = 0.0
        if self.load:
            loads = [noise(r.grid, r.load)[0] for r in runs if r.load is not None]
            self.load_noise = max(float(np.median(loads)), 1e-3)
        self.base = neutral()
        self.silent = self._silent()
        self.samples = self._samples(held)
        train = np.concatenate([s.train for s in self.samples])
        block = np.concatenate([s.block for s in self.samples])
        self.train, self.block = train, block
        names = sorted({b // 100000 for b in block[train]})
        if len(names) >= 3:  # conditions left out in turn
            self.fold = np.array([names.index(b // 100000) % 4 if b // 100000 in names else -1 for b in block])
        else:
            order = np.unique(block[train])
            place = {b: min(3 * i // max(len(order), 1), 2) for i, b in enumerate(order)}
            self.fold = np.array([place.get(b, -1) for b in block])
        self.folds = [f for f in np.unique(self.fold[train]) if f >= 0]
        self.warm = max(float(np.ptp(np.concatenate([r.warm for r in runs]))), 1e-9)
        self.thermometer = thermometer

    def _slid(self) -> bool:
        return any(
            np.ptp(r.slide[np.interp(r.grid, r.t, r.z.sum(1)) > 0.3], axis=0).max(initial=0.0) > 2e-4 for r in self.runs
        )

    def _noise(self) -> float:
        """Return n, of one reading: from the counts, or the scatter about a local parabola where there are none."""
        lsb = max(r.lsb for r in self.runs)
        k = int(np.argmax(sum(r.z.sum(0) for r in self.runs)))
        scatter = float(np.median([noise(r.t, r.z[:, k])[0] for r in self.runs]))
        return max(lsb / np.sqrt(12), min(scatter, 5 * lsb) if lsb else scatter, 1e-4)

    def _silent(self) -> dict[int, float]:
        """Return taxels whose reading never changes although they are pressed: taxel -> the reading [N] (0: dead, else
        stuck)."""
        z = np.concatenate([r.z for r in self.runs])
        p = np.concatenate([readings(r, self.base) for r in self.runs])
        step = max(r.lsb for r in self.runs)
        still = np.ptp(z, axis=0) <= max(0.5 * step, 1e-9)
        least = max(JUDGE.far * self.noise, 2 * BELIEF.zero * step)  # the reading's own zero, and its neighbours'
        pressed = p.max(0) > least
        # the object may touch beside where the joints say: neighbours on both sides must feel it
        near = [sum(z[:, b].max() > least for b in beside) >= min(3, len(beside)) for beside in self.runs[0].beside]
        pressed &= np.array(near)
        stuck = still & (z[0] > BELIEF.zero * step)
        return {int(k): float(z[0, k]) for k in np.flatnonzero((still & pressed) | stuck)}

    def _samples(self, held: set[str]) -> list[Sample]:
        out = []
        for i, r in enumerate(self.runs):
            v = self.base
            expected = readings(r, v)
            quiet = 1.0 * r.lsb
            mask = ((r.z > quiet) | (expected > quiet)) & ~r.full
            mask[:, list(self.silent)] = False
            sigma = np.sqrt(
                self.noise**2 + (TOUCH.plant * np.maximum(r.z, 0.0)) ** 2 + (TOUCH.timing * _rate(r.t, r.z)) ** 2
            )
            out.append(self._sample(r, i, "taxels", mask, sigma, r.t, held))
            if self.load and r.load is not None:
                touched = (r.load > 0.05 * r.load.max()) | (cell(r, v) > 0.05)
                wide = np.sqrt(
                    self.load_noise**2 + (TOUCH.plant * r.load) ** 2 + (TOUCH.timing * _rate(r.grid, r.load)) ** 2
                )
                # the grid is denser than the readings: neighbours say the same
                mine = touched & (np.arange(len(r.grid)) % 2 == 0)
                out.append(self._sample(r, i, "cell", mine, wide, r.grid, held))
            if self.shear:
                n = r.grip
                on = np.repeat((n > 0.3)[:, None], 2, 1)
                wide = np.repeat(np.hypot(2 * self.noise, 0.03 * n)[:, None], 2, 1)
                out.append(self._sample(r, i, "shear", on, wide, r.t, held))
        return out

    def _sample(
        self, r: PadRun, i: int, stage: str, mask: np.ndarray, sigma: np.ndarray, t: np.ndarray, held: Collection[str]
    ) -> Sample:
        block = i * 100000 + {"taxels": 0, "cell": 20000, "shear": 40000}[stage] + ((t - t[0]) / BLOCK).astype(int)
        train = np.full(len(t), r.recording not in held) if held else t < t[0] + 0.75 * (t[-1] - t[0])
        spread = lambda x: np.broadcast_to(x.reshape(len(t), *[1] * (mask.ndim - 1)), mask.shape)[mask]  # noqa: E731
        return Sample(r, stage, mask, sigma, spread(block), spread(train))

    def residual(
        self, v: dict[str, float], gains: np.ndarray | None = None, order: np.ndarray | None = None
    ) -> np.ndarray:
        """Return measured minus predicted, in sigmas, of everything that counts."""
        out = []
        for s in self.samples:
            r = s.run
            if s.stage == "taxels":
                d = r.z - readings(r, v, gains, order)
            elif s.stage == "cell":
                d = r.load - cell(r, v)
            else:
                d = r.shear - shear(r, v)
            out.append((d / s.sigma)[s.mask])
        return np.concatenate(out)

    def stage_of(self) -> np.ndarray:
        """Number of the stage (0 taxels, 1 cell, 2 shear) of each residual."""
        return np.concatenate(
            [np.full(int(s.mask.sum()), ("taxels", "cell", "shear").index(s.stage)) for s in self.samples]
        )

    def _keys(self, ids: tuple[str, ...], mapped: bool = False) -> tuple[str, ...]:
        effects = [TOUCH_EFFECTS[e] for e in ids]
        keys = [k for e in effects for k in e.fits if not (e.by_taxel and mapped)]
        # single taxels' gains leave nothing to a common one
        keys += (
            ([] if mapped and self.scale_known else ["scale"])
            + ["zero", "along", "across", "spread"]
            + (["skin"] if self.shear else [])
        )
        if not any("clock" in e.replaces for e in effects):
            keys.append("clock")
        return tuple(dict.fromkeys(keys))

    def _bounds(self, key: str) -> tuple[float, float]:
        p = PARAMS[key]
        if key == "scale" and not self.scale_known:
            return 0.05, 20.0
        if key in PLACE:  # how well the joints know where the object is
            return -PLACE[key] * self.doubt, PLACE[key] * self.doubt
        if key == "drift":
            return -0.7 / self.warm, 0.7 / self.warm
        return p.low, p.high

    def fit(
        self,
        ids: tuple[str, ...],
        start: dict[str, float],
        where: np.ndarray | None = None,
        gains: np.ndarray | None = None,
        order: np.ndarray | None = None,
        evaluations: int = 60,
        still: tuple[str, ...] = (),
    ) -> TouchTrial:
        """Return least squares of the effects' numbers and the nuisances but `still` on residuals `where` (default:
        training), from `start`."""
        keys = tuple(k for k in self._keys(ids, gains is not None) if k not in still)
        where = self.train if where is None else where
        low, high = np.array([self._bounds(k) for k in keys]).T
        scale = np.array([PLACE[k] * self.doubt / 3 if k in PLACE else PARAMS[k].scale for k in keys])
        if "drift" in keys:
            scale[keys.index("drift")] = 0.1 / self.warm
        free = {k for k in keys if PARAMS[k].nuisance and not (k == "scale" and not self.scale_known)}
        centre = np.array([PARAMS[k].neutral for k in keys])
        soft = np.array([1.0 if k in free else 0.0 for k in keys])
        x0 = np.clip(
            [start.get(k, PARAMS[k].neutral) for k in keys], low + 1e-6 * (high - low), high - 1e-6 * (high - low)
        )

        def values(x: np.ndarray) -> dict[str, float]:
            fixed = {"scale": start["scale"]} if "scale" not in keys and "scale" in start else {}
            return self.base | fixed | dict(zip(keys, (float(a) for a in x), strict=True))

        def error(y: np.ndarray) -> np.ndarray:
            x = y * scale
            # a nuisance is believed within its scale: a prior as strong as one block of readings
            return np.concatenate([self.residual(values(x), gains, order)[where], 3.0 * soft * (x - centre) / scale])

        found = least_squares(
            error,
            x0 / scale,
            bounds=(low / scale, high / scale),
            loss="soft_l1",
            f_scale=3.0,
            diff_step=1e-2,
            x_scale=1.0,
            max_nfev=max(6, evaluations // max(len(keys), 1)),
        )
        v = values(found.x * scale)
        n = int(where.sum())
        return TouchTrial(ids, v, gains, order, keys, found.jac[:n] / scale, self.residual(v, gains, order))

    def gain_map(self, trial: TouchTrial, where: np.ndarray) -> np.ndarray:
        """Return gains [K] of single taxels, closed form with a prior, on what the trial predicts without them."""
        K = self.runs[0].z.shape[1]
        up, down = np.zeros(K), np.zeros(K)
        a = 0
        for s in self.samples:
            n = int(s.mask.sum())
            if s.stage == "taxels":
                use = np.zeros(s.mask.shape, bool)
                use[s.mask] = where[a : a + n]
                p = readings(s.run, trial.values, None, trial.order)
                w = use / s.sigma**2
                up += (w * p * s.run.z).sum(0)
                down += (w * p * p).sum(0)
            a += n
        # readings of one press are alike: they count as fewer
        independent = 0.1
        return (independent * up + 1 / TOUCH.gain_prior**2) / (independent * down + 1 / TOUCH.gain_prior**2)

    def mapped(self, trial: TouchTrial, where: np.ndarray | None = None) -> TouchTrial:
        """Return a trial of single taxels' gains with those that residuals `where` (default: training) ask for."""
        if trial.gains is None:
            return trial
        gains = self.gain_map(trial, self.train if where is None else where)
        return replace(trial, gains=gains, res=self.residual(trial.values, gains, trial.order))

    def loss(self, res: np.ndarray) -> np.ndarray:
        """Return [B] squared (Huber) residuals by block, stages weighed so that each counts alike per residual."""
        _, b = np.unique(self.block[self.train], return_inverse=True)
        return np.bincount(b, huber_square(res[self.train], 3.0))

    def cross(self, trial: TouchTrial) -> np.ndarray:
        """Return [B] losses of the training blocks when their fold is left out of the fit."""
        if trial.left_out is not None:
            return trial.left_out
        res = np.zeros(len(self.train))
        for f in self.folds:
            inside = self.train & (self.fold != f)
            if inside.sum() < 50:
                inside = self.train
            again = self.fit(trial.ids, trial.values, inside, trial.gains, trial.order, 24)
            mine = self.train & (self.fold == f)
            res[mine] = self.mapped(again, inside).res[mine]
            trial.folds.append(again.values)
        trial.left_out = self.loss(res)
        return trial.left_out

    def size(self, res: np.ndarray) -> float:
        return float(huber_square(res[self.train], 3.0).sum())

    def intervals(self, trial: TouchTrial) -> dict[str, tuple[float, float]]:
        """Return 90 % intervals of the fitted numbers: the sandwich over blocks, with the disagreement of the folds
        and 1.5 % of the value (6 % where it hangs on how a force spreads) added in
        squares."""
        keys = trial.keys
        fitted = self.fit(trial.ids, trial.values, None, trial.gains, trial.order, 12)
        J, r = fitted.jac, np.clip(fitted.res[self.train], -3, 3)
        scale = np.array([PARAMS[k].scale for k in fitted.keys])
        Js = J * scale
        _, b = np.unique(self.block[self.train], return_inverse=True)
        scores = np.stack([np.bincount(b, Js[:, i] * r) for i in range(Js.shape[1])], 1)
        scores = scores - scores.mean(0)
        n = len(scores)
        prior = np.diag([9.0 if PARAMS[k].nuisance else 0.0 for k in fitted.keys])
        A = np.linalg.pinv(Js.T @ Js + prior + 1e-9 * np.eye(len(scale)))
        cov = A @ (scores.T @ scores * n / max(n - 1, 1) + prior) @ A
        variance = np.maximum(np.diag(cov), 0.0) * scale**2
        self.cross(trial)
        folds = (
            np.array([[f[k] for k in fitted.keys] for f in trial.folds])
            if len(trial.folds) > 1
            else np.zeros((1, len(fitted.keys)))
        )
        m = len(folds)
        variance += (m - 1) / max(m, 1) * ((folds - folds.mean(0)) ** 2).sum(0)
        out = {}
        for k, s in zip(fitted.keys, variance, strict=True):
            x = trial.values[k]
            half = 1.645 * float(np.sqrt(s + ((TOUCH.law if k in OF_LAW else SEARCH.doubt) * x) ** 2))
            low, high = self._bounds(k)
            out[k] = (max(x - half, low), min(x + half, high))
        return {k: v for k, v in out.items() if k in keys}

    def gain_width(self, t: TouchTrial) -> np.ndarray:
        """Return half of the 90 % interval of each taxel's gain [K]: the disagreement of the folds, and 2 %."""
        maps = [self.gain_map(t, self.train & (self.fold != f)) for f in self.folds]
        if len(maps) < 2:
            return np.full(self.runs[0].z.shape[1], 0.1)
        n = len(maps)
        se = np.sqrt((n - 1) / n * ((np.array(maps) - np.mean(maps, 0)) ** 2).sum(0))
        return 1.645 * np.hypot(se, 0.02)


def _rate(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return |dx/dt| along the first axis, the largest of a sample and its neighbours."""
    rate = np.abs(np.gradient(x, t, axis=0))
    out = rate.copy()
    out[1:] = np.maximum(out[1:], rate[:-1])
    out[:-1] = np.maximum(out[:-1], rate[1:])
    return out


BOOTSTRAPS, STRETCH = 300, 3  # and of how many neighbouring blocks a stretch of theirs is


@dataclass
class PadOutcome:
    """What the search of one pad ends with: the trials without and with what was found, rivals by effect."""

    pad: int
    none: TouchTrial
    best: TouchTrial
    rivals: dict[str, list[tuple[str, float]]] = field(default_factory=dict)
    confidence: dict[str, float] = field(default_factory=dict)


class PadSearch(PadFit):
    """The search on one pad: effects are added while they earn it on presses left out."""

    def run(self) -> PadOutcome:
        """Adds effects while they earn it; then what else would do in the place of each."""
        none = self.fit((), {})
        current = none
        trials: dict[frozenset, TouchTrial] = {frozenset(): none}
        for _ in range(SEARCH.most):
            if float(self.cross(current).sum()) / max(int(self.train.sum()), 1) < TOUCH.enough**2:
                break
            listed = self.scan(current)
            if any(x.widens for x in listed):
                listed += [e for e in TOUCH_CATALOGUE if e.widens and e not in listed and self._possible(current, e)]
            options = [t for e in listed if (t := self._try(current, e)) is not None]
            # one number for the pad, beside one for each taxel
            options += [self._common(e, current, 120) for e in listed if e.by_taxel and self.scale_known]
            for t in options:
                trials[frozenset(t.ids)] = t
            options.sort(key=lambda t: float(np.minimum(np.abs(t.res[self.train]), 30).sum()))
            for t in options[:4]:
                self.cross(t)
            good = [t for t in options[:4] if self._earns(t, current)]
            if not good:
                break

            def priced(t: TouchTrial, had: bool = current.gains is not None) -> float:
                """Return a gain for every taxel must do clearly better than one number."""
                return self.cross(t).sum() * (1.0 if t.gains is None or had else JUDGE.within**2)

            least = min(map(priced, good))
            current = min(
                (t for t in good if priced(t) <= (1 + SEARCH.tie) * least), key=lambda t: self.size(t.res) * priced(t)
            )
        current = self._drop(current, trials)
        if current.ids and current.gains is None:  # the numbers, to their end
            full = self.fit(current.ids, current.values, None, current.gains, current.order, 240)
            if self.size(full.res) < self.size(current.res):
                current = full
        out = PadOutcome(self.runs[0].pad, none, current)
        for e in current.ids:
            out.rivals[e], out.confidence[e] = self._rivals(current, e, trials)
        return out

    def _possible(self, current: TouchTrial, effect: TouchEffect) -> bool:
        e = effect.id
        if e in current.ids or (self.allowed is not None and e not in self.allowed):
            return False
        if not touch_compatible(effect, current.ids) or (effect.stage == "shear" and not self.shear):
            return False
        return effect.possible(self)

    def scan(self, current: TouchTrial, most: int = 4) -> list[TouchEffect]:
        """Return the effects that would remove most of what `current` leaves, by a linear score at their starts with
        the refitted numbers projected out; gains of single taxels are always tried."""
        if current.jac is None:
            current = self.fit(current.ids, current.values, None, current.gains, current.order, 12)
        r0 = np.clip(current.res[self.train], -10, 10)
        weight = np.minimum(1.0, 3.0 / np.maximum(np.abs(current.res[self.train]), 1e-9)) ** 0.5
        J = current.jac * np.array([PARAMS[k].scale for k in current.keys])
        gram = J.T @ J + 9.0 * np.eye(J.shape[1])
        project = lambda y: y - J @ np.linalg.solve(gram, J.T @ y)  # noqa: E731
        clean = project(r0 * weight)
        total = float(clean @ clean)
        found = []
        for effect in TOUCH_CATALOGUE:
            if not self._possible(current, effect):
                continue
            best = 0.0
            for s in effect.begin(self):
                d = project(
                    (current.res - self.residual(current.values | s, current.gains, current.order))[self.train] * weight
                )
                dd = float(d @ d)
                if dd > 1e-9 * total:
                    c = np.clip(float(d @ clean) / dd, 0.0, 3.0)
                    best = max(best, (2 * c * float(d @ clean) - c * c * dd) / max(total, 1e-12))
            found.append((1.0 if effect.by_taxel else best, effect))
        found.sort(key=lambda f: -f[0])
        return [e for g, e in found[:most] if g > SEARCH.apart]

    def _try(self, current: TouchTrial, effect: TouchEffect) -> TouchTrial | None:
        """Return the hypothesis with one effect more; None where it cannot be there."""
        if not self._possible(current, effect):
            return None
        ids = (*current.ids, effect.id)
        if effect.by_taxel:
            # single taxels must not be taken for a shifted object or a wider contact: order and gains first, against
            # the believed geometry
            believed = {k: p.neutral for k, p in PARAMS.items() if p.nuisance and (k != "scale" or self.scale_known)}
            order = self._swaps(current.values | believed)
            # where the object lies may be off, but a wider contact looks like what exchanged taxels do
            if order is None:
                place = {k: v for k, v in current.values.items() if k != "spread"}
                order = self._swaps(self.fit(current.ids, place, None, None, None, 40, ("spread",)).values)
            base = current if order is None else self.fit(current.ids, current.values, None, None, order, 24)
            base.values = base.values | believed
            for _ in range(2):
                base = self.fit(current.ids, base.values, None, self.gain_map(base, self.train), base.order, 24)
            each = replace(self.mapped(base), ids=ids, jac=None)
            # a map where one number does not follow: nearer than this they follow alike
            common = self._common(effect, current, 60) if self.scale_known else each
            return common if JUDGE.within**2 * self.size(each.res) > self.size(common.res) else each
        starts = sorted(
            effect.begin(self), key=lambda s: self.size(self.residual(current.values | s, current.gains, current.order))
        )
        tries = [self.fit(ids, current.values | s, None, current.gains, current.order, 50) for s in starts[:2]]
        return self.mapped(min(tries, key=lambda t: self.size(t.res)))

    def _common(self, effect: TouchEffect, current: TouchTrial, evaluations: int) -> TouchTrial:
        """Return the hypothesis with one gain for all of the pad, of an effect that may be another on each taxel."""
        predicted = [readings(r, current.values, current.gains, current.order).sum() for r in self.runs]
        ratio = np.median([r.z.sum() / max(p, 1e-9) for r, p in zip(self.runs, predicted, strict=True)])
        start = current.values | dict.fromkeys(effect.fits, float(ratio))
        return self.fit((*current.ids, effect.id), start, None, current.gains, current.order, evaluations)

    def _swaps(self, values: dict[str, float]) -> np.ndarray | None:
        """Order of the taxels [K] in which exchanged pairs are put right, by what `values` predict; None where there
        are none."""
        K = self.runs[0].z.shape[1]
        z = np.concatenate([r.z for r in self.runs])
        p = np.concatenate([readings(r, values, None, None) for r in self.runs])
        live = [k for k in range(K) if p[:, k].max() > JUDGE.far * self.noise and z[:, k].max() > 3 * self.noise]
        if len(live) < 3:
            return None
        zz, pp = z[:, live], p[:, live]
        dot = zz.T @ pp
        scale = np.maximum((pp**2).sum(0), 1e-12)
        left = (zz**2).sum(0)[:, None] - 2 * dot + scale[None]  # squared error of reading i explained by place j
        own = np.diag(left)
        out, used = np.arange(K), set()
        gain = own[:, None] + own[None] - left - left.T
        # each of the two must fit the other's place far better than its own
        fits = JUDGE.within**2 * left < own[:, None]
        good = fits & (JUDGE.within**2 * left.T < own[None]) & (gain > (JUDGE.far * self.noise) ** 2)
        pairs = sorted(((gain[i, j], i, j) for i, j in zip(*np.nonzero(np.triu(good, 1)), strict=True)), reverse=True)
        for _, i, j in pairs:
            if i not in used and j not in used:
                out[[live[i], live[j]]] = out[[live[j], live[i]]]
                used |= {i, j}
        return out if used else None

    def _earns(self, new: TouchTrial, old: TouchTrial) -> bool:
        a, b = self.cross(old), self.cross(new)
        if 1 - b.sum() / max(a.sum(), 1e-12) < SEARCH.least:
            return False
        return bool(np.quantile(self._boot(a - b), SEARCH.chance) > 0)

    def _boot(self, x: np.ndarray) -> np.ndarray:
        """Sums of a block bootstrap of x [B], in stretches of neighbouring blocks."""
        return x[intervals.stretches(len(x), STRETCH, self.rng, BOOTSTRAPS)].sum(1)

    def _drop(self, current: TouchTrial, trials: dict[frozenset[str], TouchTrial]) -> TouchTrial:
        for e in current.ids if len(current.ids) > 1 else ():
            less = self.without(current, e)
            if not self._earns(current, less):
                trials[frozenset(less.ids)] = less
                return self._drop(less, trials)
        return current

    def without(self, current: TouchTrial, e: str) -> TouchTrial:
        rest = tuple(x for x in current.ids if x != e)
        start = {k: v for k, v in current.values.items() if k not in TOUCH_EFFECTS[e].fits}
        keep = not TOUCH_EFFECTS[e].by_taxel
        gains, order = (current.gains, current.order) if keep else (None, None)
        return self.mapped(self.fit(rest, start, None, gains, order, 40))

    def _rivals(
        self, current: TouchTrial, e: str, trials: dict[frozenset[str], TouchTrial]
    ) -> tuple[list[tuple[str, float]], float]:
        """Return what else in the place of one effect would do (its share of bootstraps), and the effect's own
        share."""
        base = self.without(current, e)
        others = []
        tried = self.scan(base, 3)
        for x in TOUCH_CATALOGUE:
            alike = touch_confusable(x.id, e)
            if x.id in current.ids or not (x in tried or alike or (x.widens and TOUCH_EFFECTS[e].widens)):
                continue
            t = trials.get(frozenset((*base.ids, x.id))) or self._try(base, x)
            if alike and t is not None:  # what is said to be no rival must have been fitted to its end
                start = t.values
                if x.by_taxel and t.gains is not None and self.scale_known:
                    t = self._common(x, base, 120)
                    start = t.values
                elif current.gains is None:
                    start = x.in_place(t.values, base, current)
                if t.gains is None:
                    again = self.fit(t.ids, start, None, t.gains, t.order, 160)
                    t = again if self.size(again.res) < self.size(t.res) else t
            if t is not None and (self.size(t.res) < JUDGE.within**2 * self.size(current.res) or alike):
                self.cross(t)
                others.append((x.id, t))
        table = np.stack([self.cross(current), *[self.cross(t) for _, t in others], self.cross(base)])
        drawn = intervals.stretches(table.shape[1], STRETCH, self.rng, BOOTSTRAPS)
        shares = intervals.wins(table, drawn, SEARCH.apart)
        rows = sorted(
            ((name, float(s)) for (name, _), s in zip(others, shares[1:-1], strict=True)), key=lambda r: -r[1]
        )
        return rows, float(shares[0])
