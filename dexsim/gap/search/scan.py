"""What an effect is worth: the priced linear scan of what each would remove, and what hypotheses lose on conditions
left out."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from dexsim import intervals
from dexsim.gap.effects import Effect, Variant
from dexsim.gap.effects.catalogue import CATALOGUE, confusable
from dexsim.gap.plant.case import Case
from dexsim.gap.plant.columns import INDEX, NOT_NEGATIVE, SHAPES, at_bound, expand
from dexsim.gap.rules import SEARCH
from dexsim.gap.search.fit import Box, Fitter, Residuals, disbelief, huber_square, robust, slopes_of
from dexsim.gap.search.hypotheses import JointSearch, Member, Trial, complexity_price, fits_beside, subset

# -- what hypotheses lose on conditions that their fit has not seen, and whether one earns its place by that ----------

FREE_STEPS = 6  # of a fit to whole recordings
BOOTSTRAPS, STRETCH = 300, 4  # and of how many neighbouring half-second blocks a stretch of theirs is


def priced_loss(search: JointSearch, trial: Trial) -> float:
    """Return left-out loss with a price on parameters."""
    return (
        float(cv_loss(search, trial).sum())
        * (1 + SEARCH.apart * sum(len(m.variant.params) for m in trial.members))
        * price_factor(search, trial)
    )


def price_factor(search: JointSearch, trial: Trial) -> float:
    """Return factor on the losses of a hypothesis that can imitate simpler ones, or whose size stopped at the end
    of what is physical: the data would have it where it cannot be."""
    at = complexity_price(trial)
    for m, fitted in zip(trial.members, trial.values, strict=True):
        values = {p.key: x for p, x in zip(m.variant.params, fitted, strict=True) if p.key not in SHAPES}
        if at_bound([p for p in m.variant.params if p.key in values], values, search.case):
            at *= SEARCH.bounded
    return at


def cv_loss(search: JointSearch, trial: Trial) -> np.ndarray:
    """Return losses by block [B] on what was left out, and what the beliefs had to give for them, spread over the
    blocks."""
    out = cross_validated(search, trial)
    return out + disbelief(trial.fit.params, trial.fit.x) / len(out)


def cross_validated(search: JointSearch, trial: Trial) -> np.ndarray:
    """Return losses by block [B] when the block's condition is left out of the fit: from the optimum of all, one
    bounded Gauss-Newton step on the other conditions, its length chosen there."""
    if trial.left_out is not None:
        return trial.left_out
    f, fitter = trial.fit, search.fitter
    P = len(f.params)
    out = np.zeros(int(search.blocks.max()) + 1)
    box = Box(f.params)
    low, high, span, centre, believed = box.low, box.high, box.span, box.centre, box.prior
    folds = np.unique(search.fold_of)
    fold = search.fold_of[fitter.window]
    k = search.r.huber
    weight = robust(f.residual, k)
    guesses = [f.x]
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
    mine = fitter.given(trial.members)
    _, s = mine.init_directions(f.params, f.x) if fitter.eliminate else (None, None)
    res = mine.eliminated(mine.residuals(f.params, np.array(guesses)), s)
    a = huber_square(res, k)
    for n, number in enumerate(folds):
        test = fold == number
        on = ~test if len(folds) > 1 else test
        options = [0] if P == 0 else [0, *range(1 + n * len(lengths), 1 + (n + 1) * len(lengths))]
        best = min(options, key=lambda o: a[o][on].sum())
        trial.folds.append(np.array(guesses)[best])
        out += np.bincount(search.blocks[test], a[best][test], len(out))
    trial.left_out = out
    return out


def refolded(search: JointSearch, trial: Trial) -> Trial:
    """Return the trial with its losses on what was left out from fits of their own: where an effect is kinked (a
    limit, a sag, play), one step from the optimum of all lands anywhere."""
    f = trial.fit
    out = np.zeros(int(search.blocks.max()) + 1)
    folds, parts = np.unique(search.fold_of), []
    if len(folds) < 2 or not len(f.params):
        return trial
    whole = search.fitter.given(trial.members)
    for number in folds:
        on = search.fold_of != number
        part = Fitter(search.case.plant, subset(search.long, on), search.r, search.deadline.passed)
        rows = on[whole.window]
        known = {key: v[rows] for key, v in slopes_of(f).items()}
        x = part.given(trial.members).fit(f.params, x0=f.x, iterations=4, tolerance=1e-2, slopes=known, exact=False).x
        a = huber_square(whole.evaluate(f.params, x), search.r.huber)
        out += np.bincount(search.blocks[~rows], a[~rows], len(out))
        parts.append(x)
    return replace(trial, left_out=out, folds=parts)


def earns(search: JointSearch, new: Trial, old: Trial, further: bool = True) -> bool:
    """Return whether what `new` has beside `old` removes enough of what was left out: of windows or, far from the
    noise and beside other effects, of whole recordings."""
    return earns_in_windows(search, new, old, further) or earns_run_free(search, new, old)


def earns_in_windows(search: JointSearch, new: Trial, old: Trial, further: bool) -> bool:
    a, b = cv_loss(search, old), cv_loss(search, new)
    gain = 1 - b.sum() / a.sum()
    # what was left out may be lost by the step to it alone: what is fitted must be followed better too
    worse = search.objective(new) > (1 - 0.5 * SEARCH.least) * search.objective(old)
    if gain < SEARCH.least or worse or search.shrunk(new):
        return False
    if old.members and further:  # what follows must matter beside what was found
        rms = lambda x: np.sqrt(x.sum() / len(search.blocks))  # noqa: E731
        if rms(a) - rms(b) < SEARCH.doubt * (rms(search.none_loss) - rms(a)):
            return False
    # what only a few moments show (a limit, a sag) varies much between draws, and more of the error goes with it
    chance = (
        SEARCH.chance
        if old.members or gain < 2 * SEARCH.least
        else (SEARCH.rare if gain < 4 * SEARCH.least else 2 * SEARCH.rare) * SEARCH.chance
    )
    sums = (a - b)[intervals.stretches(len(a), STRETCH, search.rng, BOOTSTRAPS)].sum(1)
    return bool(np.quantile(sums, chance) > 0)


def earns_run_free(search: JointSearch, new: Trial, old: Trial) -> bool:
    """Return whether a further effect lasts on whole recordings of conditions left out.

    Where even with it far more than noise is left, a joint that sticks goes another way than the recorded one in a
    few windows, and their squares decide by which stick came first. Mean errors of free runs hang less on a few
    moments; they are asked only where what is fitted is followed clearly better."""
    if (
        search.objective(new) < SEARCH.astray**2
        or not old.members
        or search.fold_by != "conditions"
        or search.objective(new) > (1 - SEARCH.least) * search.objective(old)
        or search.shrunk(new)
        or search.deadline.over()
    ):
        return False
    a, b = free_run_errors(search, old), free_run_errors(search, new)
    return bool(b.mean() ** 2 < (1 - SEARCH.least) * a.mean() ** 2 and (b < a).mean() > 0.5)


def free_run_errors(search: JointSearch, trial: Trial) -> np.ndarray:
    """Mean |error| [G], in sigmas, of each condition's recordings run free from their first sample with a fit of
    its own to the other conditions' recordings, from the better of where the trial's fits ended. Made once."""
    if id(trial) in search.run_free:
        return search.run_free[id(trial)][1]
    plant, params, out = search.case.plant, trial.fit.params, []
    cross_validated(search, trial)
    parts = dict(zip(np.unique(search.fold_of).tolist(), trial.folds, strict=False))
    for k, (rest, left) in enumerate(search.folded):
        r = Residuals(search.r.sigma_q, search.r.sigma_torque)
        fitter = Fitter(plant, plant.windows(None, rest, span=search.span), r, search.deadline.passed)
        judge = Fitter(plant, plant.windows(None, left, span=search.span), Residuals(search.r.sigma_q))
        fitter, judge = fitter.given(trial.members), judge.given(trial.members)
        starts = np.stack([trial.fit.x, parts.get(k, trial.fit.x)])
        tried = np.abs(fitter.residuals(params, starts))
        best = int(np.argmin(tried.mean(1)))
        r.huber = max(1.0, float(np.median(tried[best])))
        x = fitter.fit(params, x0=starts[best], iterations=FREE_STEPS, tolerance=1e-2, exact=False).x
        out.append(float(np.abs(judge.residuals(params, x[None])[0]).mean()))
    search.run_free[id(trial)] = trial, np.array(out)
    return search.run_free[id(trial)][1]


PROJECTED = 16  # guesses of the scan that are projected in one call: they stay in a core's cache


Scanned = tuple[float, float, Member, np.ndarray]
"""Of one effect: share of the squared error that it removes, price, member, start."""


def guesses_of(
    search: JointSearch, current: Trial, base: np.ndarray
) -> tuple[list[np.ndarray], list[tuple[Member, np.ndarray]]]:
    """Return the plant's rows of every effect that `current` has not, at each of its starts, the others as in base
    [R, C]; and (effect, start) of each."""
    case, believed = search.case, search.case.plant.base()
    taken = {m.id for m in current.members}
    guesses: list[np.ndarray] = []
    owners: list[tuple[Member, np.ndarray]] = []
    for effect in CATALOGUE:
        if effect.id in taken or not search.asked(effect):
            continue
        for whole in effect.variants(case.scales):
            variant = None if whole.refines or whole.approximate else narrowed(search, effect, whole)
            if variant is None:
                continue
            member = Member(effect, variant)
            begun = np.array(variant.starts, float).reshape(len(variant.starts), len(variant.params))
            g = np.repeat(base[None], len(begun), 0)
            for name, value in variant.fixed:
                g[:, :, INDEX[name]] = value
            for p, values in zip(variant.params, begun.T, strict=True):
                p.apply(g, np.clip(values, p.low, p.high), believed)
            guesses += list(legal(g))
            owners += [(member, start) for start in begun]
    return guesses, owners


def scan_catalogue(search: JointSearch, current: Trial) -> list[Scanned]:
    """Return every effect against what `current` leaves: (share of squared error removed, price, member, start)."""
    case = search.case
    params = current.fit.params
    fitter = search.scan_fitter.given(current.members)
    here = fitter.fit(params, x0=current.fit.x, iterations=0)
    search.short_slopes = slopes_of(here)
    x = current.fit.x
    raw, s = fitter.init_directions(params, x)
    r0 = fitter.eliminated(raw[None], s)[0] if fitter.eliminate else raw
    guesses, owners = guesses_of(search, current, expand(case.plant, params, x[None])[0])
    rows = []
    box = Box(params)
    J = here.jacobian * box.span if params else np.zeros((len(r0), 0))
    k = search.r.huber
    weight = np.minimum(1.0, k / np.maximum(np.abs(r0), 1e-9)) if k > 0 else np.ones_like(r0)
    sw = np.sqrt(weight)
    Jw, rw = J * sw[:, None], r0 * sw
    # nuisances absorb what they may: a prior of a quarter of their span
    low, high = box.low, box.high
    inside = (x > low + 0.02 * (high - low)) & (x < high - 0.02 * (high - low)) if params else np.zeros(0, bool)
    Jw = Jw[:, inside]  # one at its bound has nothing left to give
    gram = Jw.T @ Jw + 16.0 * float(np.mean(rw**2)) * np.eye(Jw.shape[1])
    project = partial(_projected, Jw, gram)
    total = float(rw @ rw)
    clean = project(rw[None])[0]
    count = fitter.count
    flips = search.rng.choice([-1.0, 1.0], size=(BOOTSTRAPS, count))
    null = np.zeros(BOOTSTRAPS)
    size = max(1, int(2e7 // max(len(r0), 1)))
    for a in range(0, len(guesses), size):
        q = search.simulate(fitter, np.stack(guesses[a : a + size]), s)
        changes = np.subtract(r0, q, out=q)
        changes *= sw
        for b in range(0, len(changes), PROJECTED):
            d = project(changes[b : b + PROJECTED])
            dd = _dots(d, d)
            on = np.isfinite(dd) & ~(dd < 1e-6 * total * 1e-3 + 1e-12)
            d, dd = (d, dd) if on.all() else (d[on], dd[on])
            d *= clean
            part = fitter.by_window(d)
            dot = part.sum(1)
            c = np.clip(dot / dd, 0.0, 2.0)
            gain = (2 * c * dot - c * c * dd) / total
            chance = np.maximum(_times(flips, part), 0.0) ** 2 / dd[:, None] / total
            null = np.maximum(null, chance.max(0, initial=0.0))
            rows += [(float(g), *owners[a + b + i]) for g, i in zip(gain, np.flatnonzero(on), strict=True)]
    best: dict[tuple, tuple] = {}
    search.other_start = {}
    for gain, member, start in sorted(rows, key=lambda r: -r[0]):
        key = (member.id, member.variant.label)
        if key not in best:
            best[key] = (gain, member, start)
        elif member.id not in search.other_start and best[key][1] is member:
            search.other_start[member.id] = start
    out = [(g, float(np.mean(null >= g)), m, st) for g, m, st in best.values()]
    return sorted(out, key=lambda o: -o[0])


def drags_of(search: JointSearch, current: Trial, case: Case) -> dict[str, tuple[float, float]]:
    """By joint that may drag this one in `case`, another case of it (`case.dragged_by`): (share of the squared
    error that `current` leaves which a coupling with it would remove, its price)."""
    asked = copy.copy(search)
    asked.case, asked.scan_fitter = case, Fitter(case.plant, search.short, search.r)
    asked.allowed, asked.rng = {e.id for e in CATALOGUE if e.couples}, np.random.default_rng(search.seed)
    out: dict[str, tuple[float, float]] = {}
    for gain, price, member, _ in scan_catalogue(asked, current):
        out.setdefault(member.variant.note["from_joint"], (gain, price))
    return out


def narrowed(search: JointSearch, effect: Effect, variant: Variant) -> Variant | None:
    """Return a variant of the effect without parameters that are fitted anyway, because nothing in particular is
    believed of them."""
    keep = [i for i, p in enumerate(variant.params) if not set(p.columns) & search.wide]
    if len(keep) == len(variant.params):
        return variant
    if not keep or (keep[0] > 0 and not effect.parts_stand):
        return None
    starts = tuple(dict.fromkeys(tuple(s[i] for i in keep) for s in variant.starts))
    return replace(variant, params=tuple(variant.params[i] for i in keep), starts=starts)


def shortlisted(scan: list[Scanned], size: int, loss: float, members: Sequence[Member]) -> list[Scanned]:
    """Return the best variants of the best effects, every kind of those that ask for it, and what the first is
    confused with."""
    seen: dict[str, int] = {}
    out: list[Scanned] = []
    for row in scan:
        g, p, m, _ = row
        # what leaves far more than noise promises a share of much
        if g < SEARCH.apart * min(1.0, SEARCH.unsettled / loss):
            continue
        if p > 4 * SEARCH.price and loss < SEARCH.unsettled:
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


def _times(A: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return [H, K] A [K, m] times each of x [H, m]: each as one product of its own, so that no sum hangs on how many
    there are."""
    return np.matmul(A, x[..., None])[..., 0]


def _dots(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return [H] products of the rows of a and b [H, m]."""
    return np.matmul(a[:, None, :], b[..., None])[:, 0, 0]


def _projected(J: np.ndarray, gram: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return [H, m] y [H, m] without what the columns of J [m, P] may absorb of each, gram [P, P] being J' J and a
    prior."""
    if not J.shape[1]:
        return y.copy()
    taken = _times(J, np.linalg.solve(gram, _times(J.T, y)[..., None])[..., 0])
    return np.subtract(y, taken, out=taken)


def legal(g: np.ndarray) -> np.ndarray:
    """Return plant parameters [.., C] in place, those that cannot be negative at 0 at least."""
    g[..., NOT_NEGATIVE] = np.maximum(g[..., NOT_NEGATIVE], 0.0)
    return g
