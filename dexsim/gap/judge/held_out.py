"""What is held out of the fit (a hold-out by conditions, not a k-fold cross-validation), the errors on it, and the
verdict by them."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from dexsim import intervals
from dexsim.gap.finding import Finding
from dexsim.gap.plant.batch import JointPlant
from dexsim.gap.plant.case import Case
from dexsim.gap.plant.columns import Param
from dexsim.gap.plant.free_run import free_run
from dexsim.gap.read import BLOCK, Run, same_commands
from dexsim.gap.rules import JUDGE, SEARCH

# -- what is held out -------------------------------------------------------------------------------------------------
# What is held out of the fit: a condition whose regimes are fitted elsewhere, and ends of recordings with regimes that
# it does not visit.
#
# A limit that is reached in one recording only can neither be learned if that recording is held out nor be judged if it
# is not. So the condition is held out whose regimes the other conditions visit too; and of recordings that alone visit
# a regime which it does not, the end is held out beside it.


@dataclass
class Split:
    """What every joint is judged by: all runs; train, test: indices of those that are fitted and held out; span_train,
    span_test: the parts of them [s], None for whole runs; how: in words;
    not_judged: regimes that only what is held out visits; apart: by joint the measured rows [n] bool in and near
    them; proven: whether what is found is tried on what was not fitted."""

    runs: list[Run]
    train: list[int]
    test: list[int]
    span_train: dict[int, tuple[float, float]] | None = None
    span_test: dict[int, tuple[float, float]] | None = None
    how: str = ""
    not_judged: list[str] = field(default_factory=list)
    apart: dict[str, np.ndarray] = field(default_factory=dict)
    proven: bool = True


def regimes(cases: Sequence[Case]) -> dict[str, np.ndarray]:
    """Samples [n] bool of the measured rows that are in each regime, by its name with the joint's."""
    out: dict[str, np.ndarray] = {}
    for c in cases:
        if not c.moved:
            continue
        m = c.regimes
        saturated = m["saturation"] > 1.0
        against = m["_asked"] * m["_speed"] < 0
        moving = np.abs(m["_speed"]) > JUDGE.turning * c.scales.peak_speed
        out[f"saturation of {c.joint}"] = saturated
        out[f"saturation of {c.joint} while braking"] = saturated & against & moving
        for name in ("speed", "load", "acceleration"):
            x = np.abs(m[name])
            out[f"large {name} of {c.joint}"] = x > (1 - JUDGE.outer) * float(np.percentile(x, 99.8))
        if "temperature" in m:
            heat = m["temperature"]
            cold, hot = np.percentile(heat, [1, 99])
            if (1 - 2 * JUDGE.outer) * (hot - cold) > SEARCH.warmth:  # between what is cold and what is warm
                out[f"a warm {c.joint}"] = heat > hot - JUDGE.outer * (hot - cold)
                out[f"a cold {c.joint}"] = heat < cold + JUDGE.outer * (hot - cold)
        q = m["position"]
        low, high = np.percentile(q, [0.5, 99.5])
        out[f"{c.joint} at its upper end"] = q > high - 0.5 * JUDGE.outer * (high - low)
        out[f"{c.joint} at its lower end"] = q < low + 0.5 * JUDGE.outer * (high - low)
    return out


def visits(runs: Sequence[Run], cases: Sequence[Case]) -> tuple[list[str], np.ndarray]:
    """(names of regimes, time [regimes, runs] s spent in each)."""
    found = regimes(cases)
    plant = cases[0].plant
    step = [float(np.median(np.diff(r.t))) if len(r.t) > 1 else 0.0 for r in runs]
    time = np.array([[on[plant.rows(i)].sum() * step[i] for i in range(len(runs))] for on in found.values()]).reshape(
        len(found), len(runs)
    )
    return list(found), time


def split(runs: list[Run], held: list[int], group: list[int], cases: Sequence[Case]) -> Split:
    """Return what is fitted and what is held out. held: runs that were asked to be held out; group: condition of each
    run."""
    names, time = visits(runs, cases)
    if held:
        train = [i for i in range(len(runs)) if i not in held]
        out = Split(runs, train, held, None, None, "the held_out recordings " + ", ".join(runs[i].name for i in held))
        out.not_judged = _alone(names, time, held, train)
        out.apart = _near(cases, out.not_judged)
        return out
    chosen = _condition(runs, group, time)
    if chosen is None:
        every = list(range(len(runs)))
        cut = {i: (1 - JUDGE.kept_end) * runs[i].duration for i in every}
        how = f"the last {100 * JUDGE.kept_end:.0f} % of each recording's time"
        if not any(_goes_on(r, cut[i]) for i, r in enumerate(runs)):
            whole = {i: (0.0, r.duration) for i, r in enumerate(runs)}
            how = f"{NOTHING}, for all stands still in {how}; what is found is doubted until a motion is recorded twice"
            return Split(runs, every, every, whole, whole, how, proven=False)
        early, late = {i: (0.0, cut[i]) for i in every}, {i: (cut[i], runs[i].duration) for i in every}
        return Split(runs, every, every, early, late, how)
    test = [i for i in range(len(runs)) if group[i] == chosen]
    train = [i for i in range(len(runs)) if i not in test]
    how = "one condition, " + ", ".join(runs[i].name for i in test)
    ends = _ends(runs, train, test, time, regimes(cases), cases[0].plant)
    alone = _alone(names, time, test, train)
    out = Split(runs, train, test, None, None, how, alone, _near(cases, alone))
    if ends:
        whole = {i: (0.0, runs[i].duration + 1.0) for i in (*train, *test)}
        out.span_train = whole | {i: (0.0, at) for i, at in ends.items()}
        out.span_test = {i: whole[i] for i in test} | {i: (at, runs[i].duration + 1.0) for i, at in ends.items()}
        out.test = sorted([*test, *ends])
        out.how += f", and the end of {', '.join(runs[i].name for i in ends)}"
    return out


NOTHING = "nothing"
"""What is held out where all that moves is fitted: what is found is judged by the very recordings."""
STANDS = 0.02
"""Of a joint's motion: less is none."""


def _goes_on(run: Run, at: float) -> bool:
    """Return whether a joint still moves from `at` s on."""
    late = run.t - run.t[0] >= at
    return bool(late.any() and (np.ptp(run.q[late], 0) > STANDS * np.ptp(run.q, 0)).any())


def _condition(runs: Sequence[Run], group: Sequence[int], time: np.ndarray) -> int | None:
    """Return the condition that leaves the fewest regimes without a recording to fit, of those the one that visits
    most; the last of them. None where there are too few conditions."""
    numbers = sorted(set(group))
    if len(numbers) < 3:
        return None
    total = sum(r.duration for r in runs)
    best, least = None, None
    for g in numbers:
        mine = [i for i in range(len(runs)) if group[i] == g]
        rest = [i for i in range(len(runs)) if group[i] != g]
        seconds = sum(runs[i].duration for i in mine)
        if seconds > JUDGE.kept_most * total or seconds >= sum(runs[i].duration for i in rest):
            continue
        here, there = time[:, mine].sum(1), time[:, rest].sum(1)
        visited = here > JUDGE.visited
        score = (int((visited & (there < JUDGE.visited)).sum()), -int(visited.sum()))
        if least is None or score <= least:
            best, least = g, score
    return best


def _ends(
    runs: Sequence[Run],
    train: Sequence[int],
    test: list[int],
    time: np.ndarray,
    found: dict[str, np.ndarray],
    plant: JointPlant,
) -> dict[int, float]:
    """Return where the end of a fitted recording begins that is held out too [s], by run: those that visit regimes
    which `test` does not, before that moment and after."""
    out: dict[int, float] = {}
    missing = [k for k in range(len(time)) if time[k, test].sum() < JUDGE.visited <= time[k, train].sum()]
    on = list(found.values())
    begins = {run: (1 - JUDGE.kept_end) * runs[run].duration for run in train}

    def served(run: int) -> list[int]:
        """Return of the missing regimes those that the recording visits at its end and before: seen at its begin alone
        they would not be judged."""
        t = runs[run].t - runs[run].t[0]
        step = float(np.median(np.diff(t)))
        late = t >= begins[run]
        inside = {k: on[k][plant.rows(run)] for k in missing}
        return [
            k
            for k, x in inside.items()
            if x[late].sum() * step >= 0.5 * JUDGE.visited and x[~late].sum() * step >= JUDGE.visited
        ]

    while missing:
        by_run = {run: served(run) for run in train}
        run = max(train, key=lambda i: len(by_run[i]))
        if not by_run[run]:
            break
        out[run] = begins[run]
        missing = [k for k in missing if k not in by_run[run]]
    return out


def _alone(names: Sequence[str], time: np.ndarray, test: Sequence[int], train: Sequence[int]) -> list[str]:
    """Return regimes that what is held out visits and no fitted recording does."""
    here, there = time[:, list(test)].sum(1), time[:, list(train)].sum(1)
    alone = (here > JUDGE.visited) & (there < JUDGE.visited)
    return [name for name, so in zip(names, alone, strict=True) if so]


def _near(cases: Sequence[Case], names: Collection[str]) -> dict[str, np.ndarray]:
    """By joint its measured rows [n] bool that are in one of the regimes `names` or within a block of one: a free run
    that a limit has thrown off takes a while to come back. Joints without any are left out."""
    out: dict[str, np.ndarray] = {}
    for c in cases:
        inside = [on for name, on in regimes([c]).items() if name in names]
        if not inside:
            continue
        # runs lie behind each other, further apart than a block
        at = c.plant.t + 1e4 * c.plant.run_of
        visits_at = at[np.any(inside, 0)]
        next_one = np.searchsorted(visits_at, at)
        away = [np.abs(at - visits_at[np.clip(next_one + k, 0, len(visits_at) - 1)]) for k in (-1, 0)]
        out[c.joint] = np.minimum(*away) <= BLOCK
    return out


# -- errors -----------------------------------------------------------------------------------------------------------

DRAWS = 400  # of a bootstrap


def rms(squares: np.ndarray) -> float:
    """Return root of the mean of squares; 0 for none."""
    return float(np.sqrt(np.mean(squares))) if len(squares) else 0.0


def floor(runs: list[Run], cases: list[Case]) -> tuple[float, str, dict[str, float]]:
    """Return (noise floor of the position error, root mean square over joints; how; that of each joint): from repeats
    of the same commands, never below the noise of samples, else from split samples, else from the encoder's quantum.

    Repeats hold what differs from run to run (friction, temperature, how it is mounted), which no effect can
    explain."""
    mean = lambda x: float(np.sqrt(np.mean([y**2 for y in x])))  # noqa: E731
    pairs = repeats(runs)
    if any(len(_common(a, b)) for a, b in pairs):
        each = {c.joint: max(_apart(_positions(pairs, c)), c.sigma) for c in cases}
        return mean([each[c.joint] for c in cases]), "repeats", each
    split, quantum = mean([c.sigma for c in cases]), mean([c.quantum for c in cases]) / np.sqrt(12)
    return split, "quantum" if split <= 1.02 * quantum else "split", {c.joint: c.sigma for c in cases}


def _positions(pairs: Sequence[tuple[Run, Run]], case: Case) -> list[tuple[_Left, _Left]]:
    """Return a joint's positions in pairs of runs."""
    return [((a, a.t, a.q[:, case.index]), (b, b.t, b.q[:, case.index])) for a, b in pairs]


def repeats(runs: list[Run]) -> list[tuple[Run, Run]]:
    """Return pairs of runs of the same commands; pieces of one recording are aligned only by where they were cut."""
    return [(a, b) for i, a in enumerate(runs) for b in runs[i + 1 :] if a.name != b.name and same_commands(a, b)]


def by_motion(runs: list[Run], cases: list[Case]) -> dict[int, dict[str, float]]:
    """Return by run that was repeated the noise floor of each joint [rad or m] by its own repeats alone: ramps may
    repeat to a hundredth of what saturated steps do."""
    pairs, out = [(a, b) for a, b in repeats(runs) if len(_common(a, b))], {}
    for i, run in enumerate(runs):
        mine = [p for p in pairs if run is p[0] or run is p[1]]
        if mine:
            out[i] = {c.joint: max(_apart(_positions(mine, c)), c.sigma) for c in cases}
    return out


def floor_beyond(
    case: Case, runs: list[Run], params: list[Param], x: np.ndarray, fixed: Sequence[tuple[str, float]] = ()
) -> float:
    """Return noise floor of a joint's position error [rad or m] from what repeats differ by beyond what a fit says that
    they do (a drive that was warmer in one of them moves otherwise, and that is no noise); never below the noise of its
    samples, inf without repeats."""
    number = {id(run): k for k, run in enumerate(runs)}
    pairs = [p for p in repeats(runs) if not {number[id(r)] for r in p} & case.plant.left_out]
    if not any(len(_common(a, b)) for a, b in pairs):
        return float("inf")
    windows = case.plant.windows(None, sorted({number[id(r)] for p in pairs for r in p}))
    rows = windows.sample_row
    left = case.plant.q[rows] - free_run(case, params, x, windows, fixed, True)[0]

    def of(run: Run) -> tuple[Run, np.ndarray, np.ndarray]:
        mine = case.plant.run_of[rows] == number[id(run)]
        return run, case.plant.t[rows][mine], left[mine]

    return max(_apart([(of(a), of(b)) for a, b in pairs]), case.sigma)


_Left = tuple[Run, np.ndarray, np.ndarray]
"""What a fit leaves of a run: the run, times [S] s, values [S]."""


def _common(a: Run, b: Run) -> np.ndarray:
    """Times since their starts [s] at which repeats are compared: they are aligned by their commands, which were sent
    at the same times from the start."""
    return np.arange(0.2, min(a.duration, b.duration) - 0.05, 0.01)


def _apart(pairs: Sequence[tuple[_Left, _Left]]) -> float:
    """Return standard deviation by which what (run, times [S] s, values [S]) have in pairs of repeats scatters."""
    d = []
    for (a, ta, xa), (b, tb, xb) in pairs:
        t = _common(a, b)
        d.append(np.interp(a.t[0] + t, ta, xa) - np.interp(b.t[0] + t, tb, xb))
    return float(np.sqrt(np.mean(np.concatenate(d) ** 2) / 2.0))


def rms_interval(squares: list[np.ndarray], times: list[np.ndarray], seed: int = 0) -> tuple[float, float, float]:
    """Return (rms, low, high): 90 % by a bootstrap over half-second blocks of squared errors, drawn alike for all
    joints."""
    sums, counts = [], []
    for s, t in zip(squares, times, strict=True):
        b = ((t - t[0]) / BLOCK).astype(int) if len(t) else np.zeros(0, int)
        if len(b):
            sums.append(np.bincount(b, s))
            counts.append(np.bincount(b))
    if not sums:
        return 0.0, 0.0, 0.0
    total, count = np.concatenate(sums), np.concatenate(counts)
    total, count = total[count > 0], count[count > 0]
    mean = lambda s, n, axis=-1: np.sqrt(s.sum(axis) / n.sum(axis))  # noqa: E731
    values = intervals.draws((total, count), mean, seed, DRAWS)
    return float(np.sqrt(total.sum() / count.sum())), float(np.quantile(values, 0.05)), float(np.quantile(values, 0.95))


# -- the verdict ------------------------------------------------------------------------------------------------------
# The one word of a diagnosis, and which names count for it: by the error on what was held out, never by a name alone.
#
# One place decides, last (`conclude.decide`): the sentence, the page and `diagnosis.json` follow what stands in the
# findings after `settle`.

STRETCH = 4  # neighbouring blocks that the bootstraps of a gain draw together


def unneeded(f: Finding, quiet: set[str]) -> Finding:
    """Return a finding, as a hint where its joints are followed to their floor without any effect (`quiet`)."""
    return f.at_most(JUDGE.hinted) if f.joints and set(f.joints) <= quiet and f.held_out else f


def settle(findings: Sequence[Finding]) -> list[Finding]:
    """Return the findings, those as hints that are named below `JUDGE.firm`: of a joint, a signal, a push, of touch."""
    return [replace(f, hint=True) if f.confidence < JUDGE.firm else f for f in findings]


def whispered(f: Finding) -> Finding:
    """Return a name as a hint: nothing is missing."""
    return replace(f.at_most(JUDGE.hinted), hint=True)


def firm(findings: Sequence[Finding]) -> list[Finding]:
    """Return the findings of physics that are more than hints."""
    return [f for f in findings if f.held_out and not f.hint]


def lowers(f: Finding) -> bool:
    """Return whether a finding lowers the error on what was held out, by more than the interval of what it removes.
    What acts in a few moments alone, as a limit does, removes nothing in draws without them: an interval that begins at
    nothing (`SEARCH.tie`) is no loss then, and the part that it removes of the whole decides (`JUDGE.part`)."""
    h = f.held_out or {}
    if "removed_low" not in h or h["removed_low"] > 0:
        return bool(h["after"] < h["before"] or "removed_low" in h)
    return bool(h["removed_low"] >= -SEARCH.tie and h["after"] ** 2 <= (1 - JUDGE.part) * h["before"] ** 2)


def verdict(
    findings: Sequence[Finding],
    floor: float,
    before: float,
    before_low: float,
    after: float,
    structured: bool,
    quiet: bool = False,
    loud: bool = False,
    step: float = 0.0,
) -> str:
    """Return the one word. findings: after `settle`; floor, before, after: of the error on what was held out;
    before_low: of its 90 % interval; structured: whether what is left without any effect has structure; quiet: whether
    every joint is followed to its own floor; loud: whether some recording is surely missed by more than its own repeats
    differ by; step: that of the encoders. Where the rest is followed to the floor a wrong signal is the answer:
    something was amiss, and it has a name. Names of which none surely lowers the error explain nothing. What has no
    name and moves the joints by less than their encoders' step is a size, no verdict."""
    named = firm(findings)
    if not any(map(lowers, named)):
        blurred = not named and before**2 - floor**2 < step**2
        borne = before_low <= JUDGE.within * floor or not structured or blurred
        if not loud and (quiet or before <= JUDGE.within * floor or (before <= JUDGE.far * floor and borne)):
            return "explained" if any(f.wrong_signal and f.confidence >= JUDGE.firm for f in findings) else "none"
        return "unknown"
    # where every name is doubtful and none stands for a set, an error that is gone is not yet explained
    if after <= JUDGE.within * floor:
        sure = any(f.confidence >= JUDGE.sure_of_one or f.indistinguishable for f in named)
        return "explained" if sure else "partly_explained"
    return "partly_explained" if (before - after) / max(before - floor, 1e-12) >= JUDGE.removed else "unknown"


def gain_interval(without: np.ndarray, with_it: np.ndarray, times: np.ndarray) -> tuple[float, float]:
    """Return 90 % interval of the share of the squared error `without` [n] that an effect removes (`with_it` [n]), both
    at times [n] s on what was held out: a bootstrap over half-second blocks in stretches of two seconds, paired, of the
    whole error: draws without the few moments in which a limit acts show nothing, not a loss. (0, 0) without
    samples."""
    if not len(without):
        return 0.0, 0.0
    # half seconds without any sample are not counted
    _, b = np.unique(((times - times.min()) / BLOCK).astype(int), return_inverse=True)
    a, c = np.bincount(b, without), np.bincount(b, with_it)
    index = intervals.stretches(len(a), STRETCH, 0, DRAWS)
    share = (a - c)[index].sum(1) / max(float(a.sum()), 1e-300)
    return float(np.quantile(share, 0.05)), float(np.quantile(share, 0.95))
