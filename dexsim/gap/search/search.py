"""The search on one joint: effects are added and dropped while they earn it on conditions left out; then what
was found on whole recordings, and intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy import stats

from dexsim import intervals
from dexsim.gap.effects import Variant
from dexsim.gap.effects.catalogue import CATALOGUE, confusable
from dexsim.gap.plant.case import Case
from dexsim.gap.plant.columns import INDEX, Param, expand
from dexsim.gap.rules import BELIEF, JUDGE, SEARCH, SIGNAL
from dexsim.gap.search import baseline
from dexsim.gap.search.fit import AWAY, Box, Fitted, Fitter, Residuals, slopes_of
from dexsim.gap.search.hypotheses import MAYBE, JointSearch, Member, Outcome, Trial, fits_beside, subset
from dexsim.gap.search.scan import (
    BOOTSTRAPS,
    STRETCH,
    Scanned,
    cross_validated,
    cv_loss,
    earns,
    narrowed,
    price_factor,
    priced_loss,
    refolded,
    scan_catalogue,
    shortlisted,
)

Pool = dict[str, tuple[Member, np.ndarray, float]]
"""By effect: what may stand in another's place, where its fit begins, and its price in the scan."""
Rivals = dict[str, tuple[list[tuple[str, float]], float]]
"""By member: what else in its place would do with its share of bootstraps, its confidence."""
CLOSELY = 2  # hypotheses of a level that are looked for nearby and with their beliefs drawn back to their prior
LISTED = 6  # effects of a short list
HOPELESS = 2.0  # x what would do: a draft that leaves more after its first steps is given up
LATEST = 0.5  # s by which commands may be stamped late
AGAIN = 2  # hypotheses from which the fit without any effect is begun again before one is claimed


def search_joint(search: JointSearch) -> Outcome:
    """Adds effects while they earn it on left-out conditions, drops them, and prices what is claimed."""
    search.fitted, search.first_laws = {}, {}
    none = search.start()
    search.none_loss = cv_loss(search, none)
    current = none
    scanned: list[tuple[str, float, float]] = []
    per = len(search.blocks)
    pool: Pool = {}
    for _ in range(SEARCH.most):
        loss = cv_loss(search, current).sum() / per
        if loss < SEARCH.enough**2 or search.deadline.over():
            break
        search.tell(f"effect {len(current.members) + 1}, all of the catalogue")
        scan = scan_catalogue(search, current)
        if not scanned:
            scanned = [(m.id + (f" ({m.variant.label})" if m.variant.label else ""), g, p) for g, p, m, _ in scan]
        if not scan:
            break
        listed = shortlisted(scan, LISTED, loss, current.members)
        if not listed:
            break
        drafts = drafts_of(search, listed, current, pool)
        for _, p, member, start in scan:  # what a candidate is confused with is asked in its place, seen or not
            if member.id not in pool and any(confusable(member.id, row[2].id) for row in listed[:3]):
                pool[member.id] = member, start, p
        trials = finished_drafts(search, drafts, current)
        best = best_of(search, trials, current)
        less = begun_again(search, current, trials)
        if less is not current:
            if not current.members:
                none, search.none_loss = less, cv_loss(search, less)
                search.fitted.clear()
            else:
                search.fitted[frozenset(less.ids)] = less
            current = less
            if not earns(
                search, best, current
            ):  # the fit without it had stopped short: what is missing is looked for anew
                continue
            search.fitted.update({frozenset(t.ids): t for t in (*trials, best)})
        if not earns(search, best, current):
            # a pair may be there where neither of its halves is seen alone
            best = current if search.deadline.over() else best_pair(search, current, listed[:3]) or current
            if best is current:
                break
        current = best
        if cv_loss(search, current).sum() / per > SEARCH.unsettled and not search.deadline.over():
            current = by_laws(search, current)  # before what its law gets wrong is taken for a further effect
    search.tell("what is not needed")
    if not search.deadline.over():
        for move in (dropped, approximated, refined_members, by_laws):
            current = move(search, current)
    current, final = settled(search, current, pool)
    rivals, confidence = {e: x[0] for e, x in final.items()}, {e: x[1] for e, x in final.items()}
    return Outcome(search.case.joint, none, current, rivals, confidence, scanned)


def drafts_of(
    search: JointSearch, listed: Sequence[tuple[float, float, Member, np.ndarray]], current: Trial, pool: Pool
) -> list[tuple[tuple[Member, ...], np.ndarray, Fitted]]:
    """Return the hypotheses with one of the `listed` (gain, price, effect, start) beside those of `current`, fitted
    on short windows: those that follow best, the best first.
    pool: is filled."""
    drafts: list[tuple[tuple[Member, ...], np.ndarray, Fitted]] = []
    followed: dict[str, float] = {}
    begin = lambda x: np.concatenate([*current.values, x])  # noqa: E731

    def drafted(k: int) -> tuple[tuple[Member, ...], np.ndarray, Fitted] | None:
        _, _, member, start = listed[k]
        if k and search.deadline.over():
            return None
        search.tell(f"effect {len(current.members) + 1}, candidate {k + 1} of {len(listed)}")
        hopeless = HOPELESS * _worth(min((d[2].loss for d in drafts), default=np.inf))
        tries = [search.draft((*current.members, member), begin(start), current, hopeless)]
        if k < 4 and member.id in search.other_start and len(start) == len(search.other_start[member.id]):
            other = search.other_start[member.id]
            tries.append(search.draft((*current.members, member), begin(other), current, hopeless))
        return min(tries, key=lambda d: d[2].loss)

    for (_, p, member, start), draft in zip(listed, map(drafted, range(len(listed))), strict=True):
        if draft is None:
            break
        known = pool.get(member.id)
        pool[member.id] = (*((member, start) if known is None or known[2] > p else known[:2]), p)
        drafts.append(draft)
        if drafts[-1][2].loss < followed.get(member.id, np.inf):  # of its kinds the one that follows best
            if member.id in followed:
                pool[member.id] = member, start, p
            followed[member.id] = drafts[-1][2].loss
    drafts.sort(key=lambda d: d[2].loss)
    # how many are looked at: two, and others that may still win when they are fitted on long windows
    return [d for k, d in enumerate(drafts) if k < 2 or (k < 6 and d[2].loss < _worth(drafts[0][2].loss))]


def _worth(least: float) -> float:
    """Return the loss up to which a draft may still win on long windows, where the best one leaves `least`."""
    return 1.3 * least + 0.15


def finished_drafts(
    search: JointSearch, drafts: Sequence[tuple[tuple[Member, ...], np.ndarray, Fitted]], current: Trial
) -> list[Trial]:
    """Return the drafts fitted on long windows, and judged on what was left out."""

    def finished(k: int) -> Trial | None:
        search.tell(f"effect {len(current.members) + 1}, candidate {k + 1} of {len(drafts)} in full")
        return search.finish(*drafts[k], current) if k == 0 or not search.deadline.over() else None

    each = map(finished, range(len(drafts)))
    trials = sorted((t for t in each if t is not None), key=lambda t: t.fit.loss)
    least = trials[0].fit.loss
    # those that may still be the best are looked at closely
    trials = [
        search.thorough(t)
        if not search.deadline.over() and (k == 0 or (k < CLOSELY and t.fit.loss < 1.3 * least + 0.1))
        else t
        for k, t in enumerate(trials)
    ]
    for trial in trials:
        known = search.fitted.get(frozenset(trial.ids))
        if known is None or trial.fit.loss < known.fit.loss:
            search.fitted[frozenset(trial.ids)] = trial
    for trial in trials:
        cross_validated(search, trial)
    return trials


def best_of(search: JointSearch, trials: Sequence[Trial], current: Trial) -> Trial:
    """Return the one of the trials that loses least on what was left out; fits of their own decide where what
    follows best seems to last less, or not to last."""
    best, close = min(trials, key=partial(priced_loss, search)), min(trials, key=lambda t: t.fit.loss)
    if close.fit.loss < (1 - SEARCH.tie) * best.fit.loss:
        two = [refolded(search, t) for t in (best, close)]
        for t in two:
            search.fitted[frozenset(t.ids)] = t
        best = min(two, key=partial(priced_loss, search))
    if not earns(search, best, current):  # a good fit that seems not to last: is it the fit's, or the step's from it?
        close = min(trials, key=lambda t: t.fit.loss)
        if close.fit.loss < (1 - SEARCH.least) * current.fit.loss:
            best = refolded(search, close)
            search.fitted[frozenset(best.ids)] = best
    return best


def settled(search: JointSearch, current: Trial, pool: Pool) -> tuple[Trial, Rivals]:
    """Return (the answer, its rivals): one that only seemed worse before it was fitted in full takes the place."""
    final = rivals_of(search, current, pool)
    for _ in range(len(current.members)):
        better = overtaken(search, current, final)
        if better is None:
            break
        search.fitted[frozenset(current.ids)] = current
        # what went with the other may not be needed with it
        current = dropped(search, better) if len(better.members) > 1 else better
        final = rivals_of(search, current, pool)
    return current, final


def begun_again(search: JointSearch, current: Trial, trials: list[Trial]) -> Trial:
    """Return the hypothesis fitted again from where those with one effect more ended that follow better: what they
    refitted, and of that effect what is inside the bounds of a belief. The fit without it may have stopped in a
    hollow beside; `current` where it had not."""
    best, params = current, current.fit.params
    columns = [INDEX[p.columns[0]] for p in params]
    believed = search.case.plant.base()[0][columns]
    ahead = [t for t in trials if t.fit.loss < (1 - SEARCH.tie) * current.fit.loss]
    for trial in sorted(ahead, key=lambda t: t.fit.loss)[:AGAIN]:
        own = {p.key: x for p, x in zip(trial.fit.params, trial.fit.x, strict=True) if not p.nuisance}
        at = expand(search.case.plant, trial.fit.params, trial.fit.x[None])[0, 0, columns]
        x0 = [
            own.get(p.key, p.start)
            if not p.nuisance
            else a / b
            if p.mode == "factor"
            else a - b
            if p.mode == "add"
            else a
            for p, a, b in zip(params, at, believed, strict=True)
        ]
        fitter = search.fitter.given(current.members)
        fit = fitter.fit(params, x0=np.array(x0), iterations=8, slopes=slopes_of(current.fit))
        new = Trial(current.members, fit)
        if search.objective(new) < (1 - 0.5 * SEARCH.tie) * search.objective(best):
            new = Trial(current.members, fitter.toward_prior(params, new.fit))
        if search.objective(new) < (1 - 0.5 * SEARCH.tie) * search.objective(best) and not search.shrunk(new):
            best = new
    return best


def plain_of(search: JointSearch) -> tuple[list[Param], np.ndarray] | None:
    """Return the plain model of this joint (`baseline.fitted`), fitted once."""
    if not search.plain:
        s = search
        s.plain.append(baseline.fitted(s.case, s.train, s.span, s.seed, s.deadline.passed))
    return search.plain[0]


def best_pair(search: JointSearch, current: Trial, listed: Sequence[Scanned]) -> Trial | None:
    best = None
    for i, (_, _, m1, s1) in enumerate(listed):
        for _, _, m2, s2 in listed[i + 1 :]:
            if m1.id == m2.id or not fits_beside(m1, m2):
                continue
            trial = search.fit(
                (*current.members, m1, m2), np.concatenate([*current.values, s1, s2]), current, quick=True
            )
            if best is None or trial.fit.loss < best.fit.loss:
                best = trial
    if best is not None and earns(search, best, current):
        return best
    return None


def dropped(search: JointSearch, current: Trial) -> Trial:
    """Return members that no longer earn their place are let go."""
    changed = True
    while changed and len(current.members) > 1:
        changed = False
        for i in range(len(current.members)):
            less = search.fit(*current.but(i), current, quick=True)
            if not earns(search, current, less):
                current, changed = less, True
                break
    return current


def refined_members(search: JointSearch, current: Trial) -> Trial:
    """Return members with more parameters (an elasticity that hardens), where those earn their place, without what had
    only imitated that."""
    found = False
    for i, member in enumerate(current.members):
        for whole in member.effect.variants(search.case.scales):
            variant = narrowed(search, member.effect, whole) if whole.refines else None
            if variant is None or {p.key for p in member.variant.params} - {p.key for p in variant.params}:
                continue
            values = current.values
            known = dict(zip([p.key for p in member.variant.params], values[i], strict=True))
            members = tuple(replace(m, variant=variant) if k == i else m for k, m in enumerate(current.members))
            extra = {
                tuple(v for p, v in zip(variant.params, start, strict=True) if p.key not in known): start
                for start in variant.starts
            }
            tries = []
            for start in extra.values():
                values[i] = np.array([known.get(p.key, v) for p, v in zip(variant.params, start, strict=True)])
                tries.append(search.draft(members, np.concatenate(values), current))
            more = search.finish(*min(tries, key=lambda d: d[2].loss), current, quick=True)
            if more.fit.loss < current.fit.loss:  # is it what was added, or the fit that goes on from there?
                values[i] = np.array([more.fit.value(f"{member.id}.{p.key}") for p in member.variant.params])
                again = search.fit(current.members, np.concatenate(values), more, quick=True)
                current = again if again.fit.loss < current.fit.loss else current
            better = earns(search, more, current, further=False)
            if not better and more.fit.loss < (1 - SEARCH.least) * current.fit.loss:  # as of `best_of`
                more = refolded(search, more)
                better = earns(search, more, current, further=False)
            if better and priced_loss(search, more) < priced_loss(search, current):
                current, found = more, True
                break
    return dropped(search, current) if found else current


def approximated(search: JointSearch, current: Trial) -> Trial:
    """Return the members that are confused with an effect replaced by a law of it that training has less exactly
    (`Variant.approximate`), where they leave more than noise and that law leaves but `SEARCH.approximate` of what
    is more.

    Asked too in the place of what is confused with their likes: before that law is tried, which of several
    imitations follows best (dry friction, or one that falls off with speed) is an accident, and what it lacks
    seems to be others."""
    mine, noise = cv_loss(search, current).sum(), float(len(search.blocks))
    if mine < SEARCH.unsettled * noise:
        return current
    best, count = current, range(len(current.members))
    for effect in CATALOGUE:
        laws = [v for v in effect.variants(search.case.scales) if v.approximate]
        if not laws or not search.asked(effect):
            continue
        likes = [e.id for e in CATALOGUE if confusable(effect.id, e.id)]
        near = tuple(k for k in count if not confusable(effect.id, current.members[k].id))
        far = tuple(k for k in near if not any(confusable(e, current.members[k].id) for e in likes))
        for rest in dict.fromkeys((near, far)):
            others, kept = current.but(*(k for k in count if k not in rest))
            for variant in laws if len(rest) < len(count) else ():
                if search.deadline.over():
                    return best
                member = Member(effect, variant)
                if any(not fits_beside(member, m) for m in others):
                    continue
                drafts = [
                    search.draft((*others, member), np.concatenate([kept, np.array(start)]), current)
                    for start in variant.starts
                ]
                trial = search.finish(*min(drafts, key=lambda d: d[2].loss), current)
                left = cv_loss(search, trial).sum()
                far_more = left - noise < SEARCH.approximate * (mine - noise)
                if far_more and left < cv_loss(search, best).sum() and not search.shrunk(trial):
                    best = trial
    return best if best is current else dropped(search, best)  # what made up for the imitations may not be needed


def by_laws(search: JointSearch, current: Trial) -> Trial:
    """Return each member by every law that its effect may have: the hypothesis by the one that lasts best, the fits
    by the others kept beside it, so that intervals hold what the law is not known to be."""
    for i, member in enumerate(current.members):
        tries = [current]
        for variant in laws_of(search, member):
            members = tuple(replace(m, variant=variant) if k == i else m for k, m in enumerate(current.members))
            tries.append(search.fit(members, np.concatenate(current.values), current, quick=True))
        current = min(tries, key=partial(priced_loss, search))
        search.by_law[member.id] = tries
    return current


def laws_of(search: JointSearch, member: Member) -> list[Variant]:
    """Return the other laws of a hypothesis' effect, the first among them where a later one has taken its place."""
    first = search.first_laws.get((member.id, member.variant.label), member.variant)
    laws = [first, *first.by_law()]
    search.first_laws |= {(member.id, v.label): first for v in laws}
    return [v for v in laws if v.label != member.variant.label]


def overtaken(search: JointSearch, current: Trial, final: Rivals) -> Trial | None:
    """Return the hypothesis in which a rival stands in the place of the member that it beats in most bootstraps;
    None where each holds its own."""
    ahead = []
    for k, m in enumerate(current.members):
        others, share = final[m.id]
        if others:
            rival = others[0][0]
            # draws that its like wins, which the recording cannot tell from it, are not lost to the rival
            like = (
                sum(s for e, s in others[1:] if confusable(e, m.id) and not confusable(e, rival))
                if not confusable(rival, m.id)
                else 0.0
            )
            ahead.append((others[0][1] - share - like, k, rival))
    for lead, k, rival in sorted(ahead, reverse=True):
        better = search.fitted.get(frozenset((rival, *(m.id for i, m in enumerate(current.members) if i != k))))
        if lead > SEARCH.lead and better is not None and not search.shrunk(better):
            return better
    return None


def rivals_of(search: JointSearch, current: Trial, pool: Pool) -> Rivals:
    """For each member: what else in its place would do (its share of bootstraps), and its confidence."""
    out = {}
    mine = cv_loss(search, current)
    short = _loss(search.scan_fitter, current)
    for i, member in enumerate(current.members):
        rest, kept = current.but(i)
        without = search.fit(rest, kept, current, quick=True) if rest else None
        lost = cv_loss(search, without) if without else search.none_loss
        others: list[Trial] = []
        for n, (key, (other, start, _)) in enumerate(pool.items(), 1):
            if key == member.id or key in current.ids or any(not fits_beside(other, m) for m in rest):
                continue
            search.tell(f"effect {i + 1}, rival {n} of {len(pool)}")
            known = search.fitted.get(frozenset((key, *(m.id for m in rest))))
            if known is None and len(others) >= 3 and not confusable(key, member.id):
                continue
            if known is None and search.deadline.over():
                search.unasked |= {member.id} if confusable(key, member.id) else set()
                continue
            trial = known
            if trial is None:
                # one that cannot follow even short stretches is no rival
                most = SEARCH.rival * max(short, 1.0)
                draft = search.draft((*rest, other), np.concatenate([kept, start]), current, HOPELESS * most)
                if draft[2].loss > most:
                    continue
                trial = search.finish(*draft, current, quick=True)
            search.fitted[frozenset(trial.ids)] = trial
            # one that cannot follow even what it was fitted to is no rival
            if trial.fit.loss < SEARCH.rival * max(current.fit.loss, 1.0):
                cross_validated(search, trial)
                others.append(trial)
        priced = [cv_loss(search, t) * price_factor(search, t) for t in others]
        table = np.stack([mine * price_factor(search, current), *priced, lost])
        drawn = intervals.stretches(table.shape[1], STRETCH, search.rng, BOOTSTRAPS)
        shares = intervals.wins(table, drawn, SEARCH.apart)
        rows = [
            (next(x for x in t.ids if x not in {m.id for m in rest}), float(s))
            for t, s in zip(others, shares[1:-1], strict=True)
        ]
        rows.sort(key=lambda r: -r[1])
        out[member.id] = rows, float(shares[0])
    return out


def without_search(search: JointSearch) -> Outcome:
    """No search: the nuisances alone."""
    search.fitted = {}
    none = search.start()
    search.none_loss = cv_loss(search, none)
    return Outcome(search.case.joint, none, none, {}, {}, [])


def _loss(fitter: Fitter, trial: Trial) -> float:
    """Mean Huber square of a fitted hypothesis over the fitter's windows."""
    mine = fitter.given(trial.members)
    return float(mine.loss(mine.evaluate(trial.fit.params, trial.fit.x)[None])[0])


FINER = 2  # steps of whole recordings, where an effect was found, in one of the windows'
PIN = 1e-6  # of room for what is held at a value


def law_spread(search: JointSearch, trial: Trial) -> np.ndarray:
    """Return [P, 2] lowest and highest value of each parameter over the laws that do about as well: within twice
    `SEARCH.apart` of the loss on what was left out."""
    x = trial.fit.x
    out = np.stack([x, x], 1)
    at = {p.key: i for i, p in enumerate(trial.fit.params)}
    for tries in search.by_law.values():
        least = min(float(cv_loss(search, t).sum()) for t in tries)
        for t in tries:
            if t.ids != trial.ids or float(cv_loss(search, t).sum()) > (1 + 2 * SEARCH.apart) * least:
                continue
            for p, value in zip(t.fit.params, t.fit.x, strict=True):
                if not p.nuisance and p.key in at:
                    out[at[p.key]] = min(out[at[p.key], 0], value), max(out[at[p.key], 1], value)
    return out


def settle_found(search: JointSearch, found: Outcome) -> None:
    """What was found, and nothing, as they are judged: on whole recordings, in shorter steps where an effect was
    found (where a joint sticks, or rattles in a dead zone, a millisecond leaves errors beyond the noise)."""
    if found.best.members:
        if not search.deadline.over():
            found.best = simpler(search, found.best)
        search.whole = search.case.plant.refined(FINER)
    search.tell("on whole recordings")
    polished(search, found.best), polished(search, found.none)  # kept for the judgement


def late_commands(search: JointSearch, best: Trial) -> float:
    """Return s by which all commands are stamped after they acted: a term of the loop that leads its target looks like
    it. 0 unless a feed-forward of speed is of little use to a plain model beside such a clock, and the clock of much
    beside the feed-forward."""
    if not any(m.effect.leads for m in best.members):
        return 0.0
    plain, nominal = baseline.plain_model(search.case, search.train), search.case.scales.nominal
    most = 3 * max(nominal["kd"], 0.2 * nominal["kp"])
    ahead = Param("ahead", ("speed_feedforward",), "set", 0.0, most, 0.0)
    late = Param("late_by", ("late_by",), "set", -LATEST, 0.0, 0.0, "s")
    shifts, box = np.linspace(-LATEST, 0.0, 101), Box(plain)
    believed = np.clip(box.centre, box.low, box.high)
    fit = lambda more, x: search.fitter.fit([*plain, *more], x0=np.array(x), iterations=12)  # noqa: E731
    tried = np.column_stack([np.repeat(believed[None], len(shifts), 0), shifts])
    first = shifts[np.argmin(search.fitter.loss(search.fitter.residuals([*plain, late], tried)))]
    term, clock = fit([ahead], [*believed, 0.0]), fit([late], [*believed, first])
    both = [fit([ahead, late], x) for x in ([*term.x, 0.0], [*clock.x[:-1], 0.0, clock.x[-1]])]
    least = min(f.loss for f in (term, clock, *both))
    gained = term.loss - least
    told = gained > SEARCH.least * term.loss and clock.loss - least < JUDGE.part * gained
    return -float(clock.x[-1]) if told and -clock.x[-1] > SIGNAL.early else 0.0


def simpler(search: JointSearch, trial: Trial) -> Trial:
    """Return the trial without what may be so or otherwise in a drive (`MAYBE`), where it follows as well without:
    slopes stall at such kinks, and what was held out may go beyond what told them."""
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
        new = Trial(trial.members, search.fitter.given(trial.members).fit(pinned, x0=trial.fit.x, iterations=6))
        # the more of them go back, the better
        if search.objective(new) < (1 + 2 * SEARCH.tie) * search.objective(trial):
            best = new
    if best is not trial:
        cross_validated(search, best)
    return best


def polished(search: JointSearch, trial: Trial) -> Trial:
    """Return the trial refitted on whole training recordings run free from their first sample, where that follows
    them better than the windows' fit: state carried over windows is right there. Done once a trial."""
    if id(trial) not in search.polished:
        search.polished[id(trial)] = trial, polished_anew(search, trial)
    return search.polished[id(trial)][1]


def polished_anew(search: JointSearch, trial: Trial) -> Trial:
    if search.deadline.over():
        return trial
    plant = search.whole
    coarse = search.fitted_whole  # in the steps of the windows' fit
    whole = coarse if plant is search.case.plant else plant.windows(None, search.train, span=search.span)
    r = Residuals(search.r.sigma_q, search.r.sigma_torque, huber=max(search.r.huber, 3.0))
    fitter = Fitter(plant, whole, r, search.deadline.passed).given(trial.members)
    params = trial.fit.params
    here = fitter.residuals(params, trial.fit.x[None])[0]
    fitter.r.huber = 3.0 * max(1.0, float(np.sqrt(np.median(here**2))) / 0.67)
    # slopes in the windows' own steps serve for shorter ones
    windows = Fitter(search.case.plant, coarse, r).given(() if plant is not search.case.plant else trial.members)
    slopes = slopes_of(windows.fit(params, x0=trial.fit.x, iterations=0))
    f = fitter.fit(params, x0=trial.fit.x, iterations=3, tolerance=1e-2, slopes=slopes, exact=False)
    # a fit that is no better than rounding, or that long windows speak against, is left as it was
    if fitter.loss(f.residual[None])[0] < 0.97 * fitter.loss(here[None])[0]:
        again = search.fitter.given(trial.members).fit(params, x0=f.x, iterations=0)
        polished = Trial(trial.members, again, trial.left_out, trial.folds)
        if again.loss < 1.5 * trial.fit.loss and not search.shrunk(polished):
            return polished
    return trial


def widened(search: JointSearch, trial: Trial, bounds: np.ndarray) -> np.ndarray:
    """Return intervals that also hold what the residuals do not show, added in squares: the disagreement of the
    fits without one condition each (a jackknife); the believed figures being off by more than their fit says (half
    of `BELIEF.tolerance` each, the effects' parameters answering); and SEARCH.doubt of the value itself, the plant
    being no truer."""
    f = trial.fit
    x, P = f.x, len(f.x)
    if P == 0:
        return bounds
    box = Box(f.params)
    low, high, span = box.low, box.high, box.span
    square = (0.75 * (bounds[:, 1] - bounds[:, 0])) ** 2
    folds = np.array([g for g in trial.folds if len(g) == P])
    if len(folds) >= 2:
        n = len(folds)
        # Student's: three conditions tell how far fits differ only roughly
        square += stats.t.ppf(0.95, n - 1) ** 2 * (n - 1) / n * ((folds - folds.mean(0)) ** 2).sum(0)
    mine = np.array([not p.nuisance for p in f.params])
    J = f.jacobian * span
    A = J.T @ J
    i, k = np.flatnonzero(mine), np.flatnonzero(~mine)
    if len(i) and len(k):
        M = A[np.ix_(i, i)] + 1e-9 * np.trace(A) * np.eye(len(i))
        answer = np.linalg.solve(M, A[np.ix_(i, k)]) * span[i][:, None] / span[k][None]  # d effect / d nuisance
        off = np.array(
            [
                0.5 * BELIEF.tolerance * abs(v)
                if p.mode == "factor"
                else 0.25 * min(p.span, 2 * BELIEF.tolerance * abs(v) + 1e-3 * p.span)
                for p, v in zip(np.array(f.params, object)[k], x[k], strict=True)
            ]
        )
        square[i] += ((1.645 * answer * off) ** 2).sum(1)
    itself = np.array([0.03 if p.key.endswith(("kp_factor", "kd_factor")) else SEARCH.doubt for p in f.params])
    square += (1.645 * itself * np.abs(x)) ** 2
    half, laws = np.sqrt(square), law_spread(search, trial)
    return np.stack([np.maximum(laws[:, 0] - half, low), np.minimum(laws[:, 1] + half, high)], 1)


@dataclass(frozen=True)
class SearchedJoint:
    """A joint after its search: its case as it was searched, the search, and what it ended with."""

    case: Case
    search: JointSearch
    outcome: Outcome


__all__ = ["JointSearch", "Member", "Outcome", "SearchedJoint", "Trial", "subset"]
