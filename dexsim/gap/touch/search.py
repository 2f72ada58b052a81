"""Which touch effects a pad has: fits of the catalogue, added while they earn it on presses left out."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dexsim import intervals
from dexsim.gap.effects.catalogue import TOUCH_CATALOGUE, TOUCH_EFFECTS, touch_compatible, touch_confusable
from dexsim.gap.effects.effect import TouchEffect
from dexsim.gap.effects.tactile_gain import TactileGain
from dexsim.gap.rules import TOUCH
from dexsim.gap.touch.fit import PadFit, TouchTrial
from dexsim.gap.touch.plant import PARAMS, readings

BOOTSTRAPS, STRETCH = 300, 3  # and of how many neighbouring blocks a stretch of theirs is


@dataclass
class PadOutcome:
    """What the search of one pad ends with: the trials without and with what was found, rivals by effect, notes."""

    pad: int
    none: TouchTrial
    best: TouchTrial
    rivals: dict[str, list[tuple[str, float]]] = field(default_factory=dict)
    confidence: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


class PadSearch(PadFit):
    """The search on one pad: effects are added while they earn it on presses left out."""

    def run(self) -> PadOutcome:
        """Adds effects while they earn it; then what else would do in the place of each."""
        none = self.fit((), {})
        current = none
        notes: list[str] = []
        trials: dict[frozenset, TouchTrial] = {frozenset(): none}
        for _ in range(TOUCH.most):
            if float(self.cross(current).sum()) / max(int(self.train.sum()), 1) < TOUCH.enough**2:
                break
            listed = self.scan(current)
            if any(x.widens for x in listed):
                listed += [e for e in TOUCH_CATALOGUE if e.widens and e not in listed and self._possible(current, e)]
            options = [t for e in listed if (t := self._try(current, e)) is not None]
            # one number for the pad, beside one for each taxel
            if self.scale_known and any(e.by_taxel for e in listed):
                options.append(self._common(current, 120))
            for t in options:
                trials[frozenset(t.ids)] = t
            options.sort(key=lambda t: float(np.minimum(np.abs(t.res[self.train]), 30).sum()))
            for t in options[:4]:
                self.cross(t)
            good = [t for t in options[:4] if self._earns(t, current)]
            if not good:
                break

            def priced(t: TouchTrial, had: bool = current.gains is not None) -> float:
                """A gain for every taxel must do clearly better than one number."""
                return self.cross(t).sum() * (1.0 if t.gains is None or had else TOUCH.map_price)

            least = min(map(priced, good))
            current = min(
                (t for t in good if priced(t) <= (1 + TOUCH.close) * least), key=lambda t: self.size(t.res) * priced(t)
            )
        current = self._drop(current, trials)
        if current.ids and current.gains is None:  # the numbers, to their end
            full = self.fit(current.ids, current.values, None, current.gains, current.order, 240)
            if self.size(full.res) < self.size(current.res):
                current = full
        out = PadOutcome(self.runs[0].pad, none, current, notes=notes)
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
        """The effects that would remove most of what `current` leaves, by a linear score at their starts with the
        refitted numbers projected out; gains of single taxels are always tried."""
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
        return [e for g, e in found[:most] if g > 0.25 * TOUCH.least]

    def _try(self, current: TouchTrial, effect: TouchEffect) -> TouchTrial | None:
        """The hypothesis with one effect more; None where it cannot be there."""
        e = effect.id
        if not self._possible(current, effect):
            return None
        ids = (*current.ids, e)
        tries = []
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
                gains = self.gain_map(base, self.train)
                base = self.fit(current.ids, base.values, None, gains, base.order, 24)
            gains = self.gain_map(base, self.train)
            tries.append(
                TouchTrial(
                    ids, base.values, gains, base.order, base.keys, None, self.residual(base.values, gains, base.order)
                )
            )
            if self.scale_known:
                tries.append(self._common(current, 60))
            # a map where one number does not: a third less error, beside the price of its 120 numbers
            if len(tries) == 2 and self.size(tries[0].res) > TOUCH.map_better * self.size(tries[1].res):
                tries = tries[1:]
            return tries[0]
        starts = sorted(
            effect.begin(self), key=lambda s: self.size(self.residual(current.values | s, current.gains, current.order))
        )
        tries = [self.fit(ids, current.values | s, None, current.gains, current.order, 50) for s in starts[:2]]
        best = min(tries, key=lambda t: self.size(t.res))
        if best.gains is not None:
            best.gains = self.gain_map(best, self.train)
            best.res = self.residual(best.values, best.gains, best.order)
        return best

    def _common(self, current: TouchTrial, evaluations: int) -> TouchTrial:
        """The hypothesis with one gain for all of the pad."""
        ratio = float(
            np.median(
                [
                    r.z.sum() / max(readings(r, current.values, current.gains, current.order).sum(), 1e-9)
                    for r in self.runs
                ]
            )
        )
        return self.fit(
            (*current.ids, TactileGain.id),
            current.values | {"gain": ratio},
            None,
            current.gains,
            current.order,
            evaluations,
        )

    def _swaps(self, values: dict[str, float]) -> np.ndarray | None:
        """Order of the taxels [K] in which exchanged pairs are put right, by what `values` predict; None where there
        are none."""
        K = self.runs[0].z.shape[1]
        z = np.concatenate([r.z for r in self.runs])
        p = np.concatenate([readings(r, values, None, None) for r in self.runs])
        live = [k for k in range(K) if p[:, k].max() > 5 * self.noise and z[:, k].max() > 3 * self.noise]
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
        good = (
            (left < TOUCH.swapped * own[:, None]) & (left.T < TOUCH.swapped * own[None]) & (gain > 200 * self.noise**2)
        )
        pairs = sorted(((gain[i, j], i, j) for i, j in zip(*np.nonzero(np.triu(good, 1)), strict=True)), reverse=True)
        for _, i, j in pairs:
            if i not in used and j not in used:
                out[[live[i], live[j]]] = out[[live[j], live[i]]]
                used |= {i, j}
        return out if used else None

    def _earns(self, new: TouchTrial, old: TouchTrial) -> bool:
        a, b = self.cross(old), self.cross(new)
        if 1 - b.sum() / max(a.sum(), 1e-12) < TOUCH.least:
            return False
        return bool(np.quantile(self._boot(a - b), TOUCH.chance) > 0)

    def _boot(self, x: np.ndarray) -> np.ndarray:
        """Sums of a block bootstrap of x [B], in stretches of neighbouring blocks."""
        return x[intervals.stretches(len(x), STRETCH, self.rng, BOOTSTRAPS)].sum(1)

    def _drop(self, current: TouchTrial, trials) -> TouchTrial:
        changed = True
        while changed and len(current.ids) > 1:
            changed = False
            for e in current.ids:
                rest = tuple(x for x in current.ids if x != e)
                less = self.without(current, e)
                if not self._earns(current, less):
                    current, changed = less, True
                    trials[frozenset(rest)] = less
                    break
        return current

    def without(self, current: TouchTrial, e: str) -> TouchTrial:
        rest = tuple(x for x in current.ids if x != e)
        start = {k: v for k, v in current.values.items() if k not in TOUCH_EFFECTS[e].fits}
        keep = not TOUCH_EFFECTS[e].by_taxel
        less = self.fit(rest, start, None, current.gains if keep else None, current.order if keep else None, 40)
        if less.gains is not None:
            less.gains = self.gain_map(less, self.train)
            less.res = self.residual(less.values, less.gains, less.order)
        return less

    def _rivals(self, current: TouchTrial, e: str, trials) -> tuple[list[tuple[str, float]], float]:
        """What else in the place of one effect would do (its share of bootstraps), and the effect's own share."""
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
                    t = self._common(base, 120)
                    start = t.values
                elif current.gains is None:
                    start = x.in_place(t.values, base, current)
                if t.gains is None:
                    again = self.fit(t.ids, start, None, t.gains, t.order, 160)
                    t = again if self.size(again.res) < self.size(t.res) else t
            if t is not None and (self.size(t.res) < 2.5 * self.size(current.res) or alike):
                self.cross(t)
                others.append((x.id, t))
        table = np.stack([self.cross(current), *[t.left_out for _, t in others], self.cross(base)])
        drawn = intervals.stretches(table.shape[1], STRETCH, self.rng, BOOTSTRAPS)
        shares = intervals.wins(table, drawn, TOUCH.told_apart)
        rows = sorted(
            ((name, float(s)) for (name, _), s in zip(others, shares[1:-1], strict=True)), key=lambda r: -r[1]
        )
        return rows, float(shares[0])
