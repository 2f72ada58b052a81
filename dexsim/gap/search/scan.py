"""The priced linear scan: what every effect would remove of what a hypothesis leaves, and how often by accident."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dexsim.gap.effects.catalogue import CATALOGUE, confusable
from dexsim.gap.effects.effect import Variant
from dexsim.gap.plant.case import Case
from dexsim.gap.plant.columns import INDEX, Param, expand
from dexsim.gap.rules import SEARCH
from dexsim.gap.search.fit import prior_weight, slopes_of
from dexsim.gap.search.left_out import BOOTSTRAPS, JointLosses
from dexsim.gap.search.trial import Member, Trial, fits_beside

SWEEPS = 60  # over the beliefs, by which the scan moves them


class JointScan(JointLosses):
    """The scan of the catalogue on one joint."""

    def scan(self, current: Trial) -> list[tuple[float, float, Member, np.ndarray]]:
        """Every effect against what `current` leaves: (share of squared error removed, price, member, start)."""
        case = self.case
        params = current.fit.params
        fitter = self.scan_fitter
        with self._fix(current.members):
            here = fitter.fit(params, x0=current.fit.x, iterations=0)
            self.short_slopes = slopes_of(here)
            x = current.fit.x
            raw, s = fitter.init_directions(params, x)
            r0 = fitter.eliminated(raw[None], s)[0] if fitter.eliminate else raw
        base = expand_one(case, params, x)
        taken = {m.id for m in current.members}
        guesses, owners = [], []
        for effect in CATALOGUE:
            if effect.id in taken or (self.allowed is not None and effect.id not in self.allowed):
                continue
            for variant in effect.variants(case.scales):
                variant = None if variant.refines else self._narrow(variant)
                if variant is None:
                    continue
                member = Member(effect, variant)
                for start in variant.starts:
                    g = base.copy()
                    for name, value in variant.fixed:
                        g[:, INDEX[name]] = value
                    for p, value in zip(variant.params, start, strict=True):
                        value = float(np.clip(value, p.low, p.high))
                        p.apply(g[None], np.array([value]), case.plant.base())
                    guesses.append(legal(g))
                    owners.append((member, np.array(start)))
        rows, dots, squares, cross = [], [], [], []
        J = here.jacobian * np.array([p.span for p in params]) if params else np.zeros((len(r0), 0))
        k = self.r.huber
        weight = np.minimum(1.0, k / np.maximum(np.abs(r0), 1e-9)) if k > 0 else np.ones_like(r0)
        sw = np.sqrt(weight)
        Jw, rw = J * sw[:, None], r0 * sw
        all_J = Jw
        # nuisances absorb what they may: a prior of a quarter of their span
        low, high = np.array([p.low for p in params]), np.array([p.high for p in params])
        inside = (x > low + 0.02 * (high - low)) & (x < high - 0.02 * (high - low)) if params else np.zeros(0, bool)
        Jw = Jw[:, inside]  # one at its bound has nothing left to give
        gram = Jw.T @ Jw + 16.0 * float(np.mean(rw**2)) * np.eye(Jw.shape[1])
        project = lambda y: y - Jw @ np.linalg.solve(gram, Jw.T @ y) if Jw.shape[1] else y  # noqa: E731
        total = float(rw @ rw)
        clean = project(rw)
        block = fitter.window
        count = fitter.count
        flips = self.rng.choice([-1.0, 1.0], size=(BOOTSTRAPS, count))
        null = np.zeros(BOOTSTRAPS)
        size = max(1, int(2e7 // max(len(r0), 1)))
        for a in range(0, len(guesses), size):
            with self._fix(()):
                q = self._simulate(fitter, np.stack(guesses[a : a + size]), s)
            for i, res in enumerate(q):
                d = project((r0 - res) * sw)
                dd = float(d @ d)
                if not np.isfinite(dd) or dd < 1e-6 * total * 1e-3 + 1e-12:
                    continue
                part = np.bincount(block, d * clean, count)
                dot = float(part.sum())
                c = np.clip(dot / dd, 0.0, 2.0)
                gain = (2 * c * dot - c * c * dd) / total
                null = np.maximum(null, np.maximum(flips @ part, 0.0) ** 2 / dd / total)
                member, start = owners[a + i]
                rows.append((gain, member, start))
                raw_d = (r0 - res) * sw
                dots.append(float(raw_d @ rw))
                squares.append(float(raw_d @ raw_d))
                cross.append(all_J.T @ raw_d)
        self.saved = self._saved(
            [(m, st) for _, m, st in rows], np.array(dots), np.array(squares), np.array(cross), all_J, rw, params, x
        )
        best: dict[tuple, tuple] = {}
        self.other_start: dict[str, np.ndarray] = {}
        for gain, member, start in sorted(rows, key=lambda r: -r[0]):
            key = (member.id, member.variant.label)
            if key not in best:
                best[key] = (gain, member, start)
            elif member.id not in self.other_start and best[key][1] is member:
                self.other_start[member.id] = start
        out = [(g, float(np.mean(null >= g)), m, st) for g, m, st in best.values()]
        return sorted(out, key=lambda o: -o[0])

    def _saved(
        self,
        owners,
        dots: np.ndarray,
        squares: np.ndarray,
        cross: np.ndarray,
        J: np.ndarray,
        r: np.ndarray,
        params: list[Param],
        x: np.ndarray,
    ):
        """What each guess of the scan would save where beliefs, moved out to follow the data, may go back: [(share of
        the squared error with what beliefs gave for it, member, start)] by member, the best first.

        owners [H]: (member, start); dots, squares [H]: of the residuals' change d by the guess with the residuals and
        itself; cross [H, P]: J' d. Least squares over the guess's size (0 to 2) and every belief inside its bounds, by
        coordinates."""
        if not owners:
            return []
        P = len(params)
        span = np.array([p.span for p in params])
        centre, believed = np.array([p.start for p in params], float), prior_weight(params) * span**2
        low, high = (np.array([p.low for p in params]) - x) / span, (np.array([p.high for p in params]) - x) / span
        off = (x - centre) / span
        A = J.T @ J + np.diag(believed + 1e-9 * max(float(r @ r), 1e-12))
        b = -(J.T @ r) - believed * off  # of the beliefs' moves z: A z = b + c * cross
        total = float(r @ r) + float(believed @ off**2)
        H = len(owners)
        z, c = np.zeros((H + 1, P)), np.zeros(H + 1)  # the last: without any guess
        d_r, d_d, d_J = np.r_[dots, 0.0], np.r_[squares, 1.0], np.vstack([cross, np.zeros((1, P))])
        for _ in range(SWEEPS):
            for i in range(P):
                push = b[i] + c * d_J[:, i] - z @ A[:, i] + A[i, i] * z[:, i]
                z[:, i] = np.clip(push / A[i, i], low[i], high[i])
            c[:-1] = np.clip((d_r + (z * d_J).sum(1)) / d_d, 0.0, 2.0)[:-1]
        left = (
            total - 2 * c * d_r + c * c * d_d - 2 * c * (z * d_J).sum(1) - 2 * z @ b + np.einsum("hi,ij,hj->h", z, A, z)
        )
        saved = (left[-1] - left[:-1]) / max(left[-1], 1e-30)
        best: dict[str, tuple] = {}
        for gain, (member, start) in sorted(zip(saved.tolist(), owners, strict=True), key=lambda o: -o[0]):
            best.setdefault(member.id, (gain, member, start))
        return sorted(best.values(), key=lambda o: -o[0])

    def _narrow(self, variant: Variant) -> Variant | None:
        """The variant without parameters that are fitted anyway, because nothing in particular is believed of them."""
        keep = [i for i, p in enumerate(variant.params) if not set(p.columns) & self.wide]
        if len(keep) == len(variant.params):
            return variant
        # without its size nothing is left of an effect, but for friction (its directions may differ) and gains (there
        # are two)
        if not keep or (keep[0] > 0 and variant.params[0].key not in ("torque", "kp_factor")):
            return None
        starts = tuple(dict.fromkeys(tuple(s[i] for i in keep) for s in variant.starts))
        return replace(variant, params=tuple(variant.params[i] for i in keep), starts=starts)

    def _shortlist(self, scan, size, loss, members):
        """The best variants of the best effects, every kind of those that ask for it, and what the first is confused
        with."""
        seen: dict[str, int] = {}
        out = []
        for row in scan:
            g, p, m, _ = row
            if g < 0.25 * SEARCH.least * min(1.0, SEARCH.rough / loss) or (
                p > 4 * SEARCH.price and loss < SEARCH.rough
            ):
                continue
            if seen.get(m.id, 0) >= m.effect.kinds:
                continue
            if any(not fits_beside(m, other) for other in members):
                continue
            leader = out[0][2].id if out else None
            asked = m.id in seen and m.effect.every_kind
            if len(out) < size or asked or (leader and confusable(leader, m.id) and len(out) < size + 2):
                seen[m.id] = seen.get(m.id, 0) + 1
                out.append(row)
        return out

    def _hinted(self, listed, members, least: float):
        """The list, and up to four more that, by the scan, save at least `least` of the squared error with what the
        beliefs give for it: where those moved out to follow the data, what is left shows little, and the right effect
        lets them go back."""
        known = {row[2].id for row in listed}
        more = [
            row
            for row in self.saved
            if row[0] >= least and row[1].id not in known and all(fits_beside(row[1], m) for m in members)
        ]
        return listed + [(gain, 1.0, member, start) for gain, member, start in more[:4]]


def expand_one(case: Case, params: list[Param], x: np.ndarray) -> np.ndarray:
    """[R, C] plant parameters at one guess."""
    return expand(case.plant, params, x[None])[0]


def legal(g: np.ndarray) -> np.ndarray:
    for name in ("coulomb_friction", "viscous_friction", "delay", "backlash", "softness", "deadband"):
        g[:, INDEX[name]] = np.maximum(g[:, INDEX[name]], 0.0)
    return g
