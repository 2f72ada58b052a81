"""What is kept out of the fit: a condition whose regimes are fitted elsewhere, and ends of recordings with regimes that
it does not visit.

A limit that is reached in one recording only can neither be learned if that recording is kept out nor be judged if it
is not. So the condition is kept out whose regimes the other conditions visit too; and of recordings that alone visit a
regime which it does not, the end is kept out beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from dexsim.gap.plant.batch import JointPlant
from dexsim.gap.plant.case import Case
from dexsim.gap.read.runs import Run

KEEP_OUT = 0.25  # of the time of a recording, where its end is kept out
LARGE = 0.7  # of the largest anywhere: from there on a speed, a load, an acceleration is a regime of its own
LEAST_TIME = 0.25  # s in which a regime is visited
MOST = 0.45  # of all time that may be kept out


@dataclass
class Split:
    """train, test: indices of runs; span_train, span_test: the parts of them [s], None for whole runs; how: in words;
    not_judged: regimes that only what is kept out visits."""

    train: list[int]
    test: list[int]
    span_train: dict[int, tuple[float, float]] | None
    span_test: dict[int, tuple[float, float]] | None
    how: str
    not_judged: list[str] = field(default_factory=list)


def regimes(cases: Sequence[Case]) -> dict[str, np.ndarray]:
    """Samples [n] bool of the measured rows that are in each regime, by its name with the joint's."""
    out: dict[str, np.ndarray] = {}
    for c in cases:
        if not c.moved:
            continue
        m = c.regimes
        saturated = m["saturation"] > 1.0
        against = m["_asked"] * m["_speed"] < 0
        moving = np.abs(m["_speed"]) > 0.1 * c.scales.peak_speed
        out[f"saturation of {c.joint}"] = saturated
        out[f"saturation of {c.joint} while braking"] = saturated & against & moving
        for name in ("speed", "load", "acceleration"):
            x = np.abs(m[name])
            out[f"large {name} of {c.joint}"] = x > LARGE * float(np.percentile(x, 99.8))
        if "temperature" in m:
            heat = m["temperature"]
            cold, hot = np.percentile(heat, [1, 99])
            if hot - cold > 5.0:
                out[f"a warm {c.joint}"] = heat > hot - 0.3 * (hot - cold)
                out[f"a cold {c.joint}"] = heat < cold + 0.3 * (hot - cold)
        q = m["position"]
        low, high = np.percentile(q, [0.5, 99.5])
        out[f"{c.joint} at its upper end"] = q > high - 0.15 * (high - low)
        out[f"{c.joint} at its lower end"] = q < low + 0.15 * (high - low)
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
    """What is fitted and what is kept out. held: runs that were asked to be kept out; group: condition of each run."""
    names, time = visits(runs, cases)
    if held:
        train = [i for i in range(len(runs)) if i not in held]
        out = Split(train, held, None, None, "the held_out recordings " + ", ".join(runs[i].name for i in held))
        out.not_judged = _alone(names, time, held, train)
        return out
    chosen = _condition(runs, group, time)
    if chosen is None:
        every = list(range(len(runs)))
        cut = {i: (1 - KEEP_OUT) * runs[i].duration for i in every}
        return Split(every, every, {i: (0.0, cut[i]) for i in every}, {i: (cut[i], runs[i].duration) for i in every},
                     f"the last {100 * KEEP_OUT:.0f} % of each recording's time")  # fmt: skip
    test = [i for i in range(len(runs)) if group[i] == chosen]
    train = [i for i in range(len(runs)) if i not in test]
    how = "one condition, " + ", ".join(runs[i].name for i in test)
    ends = _ends(runs, train, test, time, regimes(cases), cases[0].plant)
    out = Split(train, test, None, None, how, _alone(names, time, test, train))
    if ends:
        whole = {i: (0.0, runs[i].duration + 1.0) for i in (*train, *test)}
        out.span_train = whole | {i: (0.0, at) for i, at in ends.items()}
        out.span_test = {i: whole[i] for i in test} | {i: (at, runs[i].duration + 1.0) for i, at in ends.items()}
        out.test = sorted([*test, *ends])
        out.how += f", and the end of {', '.join(runs[i].name for i in ends)}"
    return out


def _condition(runs: Sequence[Run], group: Sequence[int], time: np.ndarray) -> int | None:
    """The condition that leaves the fewest regimes without a recording to fit, of those the one that visits most; the
    last of them. None where there are too few conditions."""
    numbers = sorted(set(group))
    if len(numbers) < 3:
        return None
    total = sum(r.duration for r in runs)
    best, least = None, None
    for g in numbers:
        mine = [i for i in range(len(runs)) if group[i] == g]
        rest = [i for i in range(len(runs)) if group[i] != g]
        seconds = sum(runs[i].duration for i in mine)
        if seconds > MOST * total or seconds >= sum(runs[i].duration for i in rest):
            continue
        here, there = time[:, mine].sum(1), time[:, rest].sum(1)
        visited = here > LEAST_TIME
        score = (int((visited & (there < LEAST_TIME)).sum()), -int(visited.sum()))
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
    """Where the end of a fitted recording begins that is kept out too [s], by run: those that visit regimes which
    `test` does not, before that moment and after."""
    out: dict[int, float] = {}
    missing = [k for k in range(len(time)) if time[k, test].sum() < LEAST_TIME <= time[k, train].sum()]
    on = list(found.values())
    begins = {run: (1 - KEEP_OUT) * runs[run].duration for run in train}

    def served(run: int) -> list[int]:
        """Of the missing regimes those that the recording visits at its end and before: seen at its begin alone they
        would not be judged."""
        t = runs[run].t - runs[run].t[0]
        step = float(np.median(np.diff(t)))
        late = t >= begins[run]
        inside = {k: on[k][plant.rows(run)] for k in missing}
        return [
            k
            for k, x in inside.items()
            if x[late].sum() * step >= 0.5 * LEAST_TIME and x[~late].sum() * step >= LEAST_TIME
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
    """Regimes that what is kept out visits and no fitted recording does."""
    here, there = time[:, list(test)].sum(1), time[:, list(train)].sum(1)
    return [name for name, a, b in zip(names, here, there, strict=True) if a > LEAST_TIME and b < 0.1 * LEAST_TIME]
