"""Where motor torque was logged: what inverse dynamics (`inverse_dynamics.py`) say of each joint and what becomes of
it, and pushes from outside."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.ndimage import median_filter

from dexsim import intervals
from dexsim.gap.effects import ByTorque
from dexsim.gap.effects.body import ExternalForce
from dexsim.gap.effects.catalogue import EFFECTS
from dexsim.gap.finding import Finding, chances, removed
from dexsim.gap.plant.case import intervals_of
from dexsim.gap.plant.free_run import free_run
from dexsim.gap.plant.mechanics import chain
from dexsim.gap.read import Run, joined, pieces
from dexsim.gap.rules import BELIEF, JUDGE, SEARCH, TORQUE
from dexsim.gap.search import inverse_dynamics
from dexsim.gap.search.inverse_dynamics import (
    NAMES,
    PER_CUTOFF,
    Columns,
    Stretch,
    columns_of,
    moved,
    readable,
    solve,
    solved,
    sums,
    unphysical,
)
from dexsim.gap.search.search import polished

if TYPE_CHECKING:
    Spans = dict[int, tuple[float, float]]  # by run: the part [s from its start] to keep to

    from dexsim.actuator.table import ServoTable
    from dexsim.gap.plant.case import Case
    from dexsim.gap.read.stage_tests import Stage
    from dexsim.gap.search.search import JointSearch, SearchedJoint, Trial


# -- what inverse dynamics say of each joint --------------------------------------------------------------------------


@dataclass(frozen=True)
class IdentifiedJoint:
    """A joint of which inverse dynamics tell. judges: names of the recordings that judged its further effects."""

    case: Case
    inverse: inverse_dynamics.Inverse
    judges: list[str]


def identify_joints(
    cases: Sequence[Case],
    runs: Sequence[Run],
    train: Sequence[int],
    test: Sequence[int],
    model: mujoco.MjModel,
    seed: int = 0,
    span_train: dict[int, tuple[float, float]] | None = None,
    span_test: dict[int, tuple[float, float]] | None = None,
) -> list[IdentifiedJoint]:
    """Return each joint whose motor torque was logged in N.m, fast and long enough. span_*: part of each run [s from
    its start]."""
    out: list[IdentifiedJoint] = []
    motions: dict[tuple[int, float], Stretch] = {}
    for case in cases:
        use = [r for r in train if readable(runs[r], case.index)]
        judge = [r for r in test if readable(runs[r], case.index) and (r not in train or span_test is not None)]
        if not use or not case.moved:
            continue

        def at(
            cutoff: float, case: Case = case, use: list[int] = use, judge: list[int] = judge
        ) -> tuple[Columns, Columns]:
            def piece(r: int, span: Spans | None) -> Stretch:
                if (r, cutoff) not in motions:
                    motions[r, cutoff] = moved(runs[r], model, cutoff)
                return replace(motions[r, cutoff], span=None if span is None else span.get(r))

            efficiency = float(case.scales.nominal.get("efficiency", 1.0))
            own = columns_of([piece(r, span_train) for r in use], case.index, efficiency)
            if not judge:
                return own, own
            # the same columns: gravity may matter in what is fitted and hardly in what judges, or the other way round
            return own, columns_of([piece(r, span_test) for r in judge], case.index, efficiency, own.loaded)

        top = min(inverse_dynamics.highest(runs[r].t) for r in use)
        first = at(top)[0]
        kept = min(PER_CUTOFF * top * float(np.median(np.diff(runs[use[0]].t))), 1.0)
        if first.seconds < TORQUE.shortest or len(first.u) < inverse_dynamics.RATE * TORQUE.shortest * kept:
            continue
        out.append(IdentifiedJoint(case, solve(at, top, seed), [runs[r].name for r in judge]))
    return out


def _by_torque(case: Case, x: inverse_dynamics.Inverse, n: inverse_dynamics.Named) -> ByTorque:
    """Return a further effect of a joint's torque as its entry of the catalogue takes it."""
    force, length = ("N", "m") if case.scales.slide else ("N.m", "rad")
    return ByTorque(n.value, n.low, n.high, n.speed, x.full, force, length)


def torque_texts(given: Sequence[IdentifiedJoint]) -> list[str]:
    """Return what `identify_joints` found, in words."""
    out = []
    for joint in given:
        case, x = joint.case, joint.inverse
        said = ", ".join(f"{n.replace('_', ' ')} {x.value[n]:.4g} ({x.low[n]:.4g} to {x.high[n]:.4g})" for n in NAMES)
        text = (
            f"{case.joint}: by the recorded motor torque alone: {said}; {100 * x.residual:.1f} % of the torque is left"
        )
        text += "".join(f"; {n.replace('_', ' ')}: {why}" for n, why in x.refused.items())
        where = " in the recording held out" if joint.judges else ""
        for k, n in enumerate(x.named):
            told = EFFECTS[n.effect].size_by_torque(_by_torque(case, x, n)) if n.effect else ""
            size = f" ({told})" if told else ""
            text += (
                f"; {'then ' if k else ''}{n.text}{size} takes {100 * (1 - n.after / n.before):.0f} % of that "
                f"away{where}"
            )
        out.append(text)
    return out


def believe(given: Sequence[IdentifiedJoint]) -> list[str]:
    """Writes what the torque tells into the belief of what was unknown, so that the search in closed loop starts from
    it; in words.

    Friction of which nothing is believed, and then the inertia too, within what the residuals allow.
    """
    from dexsim.actuator.columns import INDEX as SERVO

    said = []
    for joint in given:
        case, x = joint.case, joint.inverse
        open_ = [n for n in ("viscous_friction", "coulomb_friction") if n in case.unknown]
        said += [
            f"{case.joint}: no {n.replace('_', ' ')} is taken from the recorded motor torque: {why}"
            for n, why in x.refused.items()
            if n in open_
        ]
        # friction that falls with speed leaves no viscous part
        open_ = [n for n in open_ if n not in x.refused or n == "viscous_friction"]
        if not open_ or x.value["coulomb_friction"] <= 0:
            continue
        if x.residual**2 > TORQUE.much:
            said.append(
                f"{case.joint}: the recorded motor torque is no witness: {100 * x.residual:.0f} % of it fits no "
                "inertia, gravity or friction"
            )
            continue
        values: dict[str, tuple[float, float, float]] = {n: (x.value[n], max(x.low[n], 0.0), x.high[n]) for n in open_}
        if "coulomb_friction" in open_ and case.scales.nominal["friction_asymmetry"] == 0:
            per = 2.0 / x.value["coulomb_friction"]
            a, b, c = (float(np.clip(per * v["offset"], -2, 2)) for v in (x.value, x.low, x.high))
            values["friction_asymmetry"] = a, b, c
        for name, (value, low, high) in values.items():
            for row in case.plant.nominal:
                row[SERVO[name]] = value
            case.scales.nominal[name] = value
            case.ranges[name] = (low, max(high, low + 1e-9))
        case.unknown = tuple(n for n in case.unknown if n not in open_)
        case.told = True
        factor = x.value["inertia"] / max(case.scales.inertia, 1e-12)
        if abs(factor - 1) < BELIEF.tolerance and "inertia" not in x.refused:
            half = max(0.5 * (x.high["inertia"] - x.low["inertia"]) / x.value["inertia"], 1e-3)
            case.factors["inertia"] = (factor - half, factor + half)
        said.append(
            f"{case.joint}: {' and '.join(n.replace('_', ' ') for n in open_)} was unknown and is taken from the "
            "recorded motor torque"
        )
    return said


@dataclass(frozen=True)
class Told:
    """What the recorded torque tells of a joint's friction, and goes before what its closed loop was refitted to.
    columns: servo columns, (value, low, high); inertia: factor on the model's, None where it is not told."""

    joint: str
    columns: dict[str, tuple[float, float, float]]
    inertia: float | None

    def over(
        self, write: Callable[[ServoTable, mujoco.MjSpec], list[str]]
    ) -> Callable[[ServoTable, mujoco.MjSpec], list[str]]:
        """Return the same as `write`, then these figures."""

        def both(table: ServoTable, spec: mujoco.MjSpec) -> list[str]:
            said = write(table, spec)
            for name, values in self.columns.items():
                table.set(self.joint, name, *(round(v, 9) for v in values))
            return said

        return both

    def note(self, nuisance: dict[str, float]) -> str:
        """Puts them among the refitted beliefs; in words."""
        given = {n: x[0] for n, x in self.columns.items() if f"{n}@{self.joint}" in nuisance}
        given |= {} if self.inertia is None else {"inertia_factor": self.inertia}
        nuisance |= {f"{n}@{self.joint}": round(x, 6) for n, x in given.items()}
        return (
            f"{self.joint}: friction is handed on as the recorded torque tells it; its closed loop does not tell it "
            "better"
        )


def told(
    given: Sequence[IdentifiedJoint],
    searched: Sequence[SearchedJoint],
    test: Sequence[int],
    span_test: Spans | None,
    stages: Sequence[Stage] = (),
) -> dict[str, Told]:
    """Return the torque's figures of each joint that is handed them on: where its closed loop does not say otherwise,
    what it was refitted to is the fit's own wandering.

    A closed loop says otherwise where a free run over what was held out is followed better with its own figures, by
    more than `BELIEF.tolerance`, or where what was found is about them; not where `stages` say that the drive itself is
    not as believed, since what its loop does then speaks of the drive.
    """
    strange = {x.joint for x in stages if not x.sound}
    by, out = {x.case.joint: x for x in searched}, {}
    for joint in given:
        case, x = joint.case, joint.inverse
        if not case.told or case.joint not in by:
            continue
        search = by[case.joint].search
        trial = polished(search, by[case.joint].outcome.best)
        claimed = {c for m in trial.members for p in m.variant.params for c in p.columns}
        known = [
            n
            for n in ("viscous_friction", "coulomb_friction", "friction_asymmetry")
            if n in case.ranges and n not in claimed
        ]
        ours: dict[str, float] = {n: case.scales.nominal[n] for n in known}
        if "inertia" in case.factors and "inertia_scale" not in claimed:
            ours["inertia"] = x.value["inertia"] / case.scales.inertia
        if known and (case.joint in strange or _alike(case, search, trial, ours, test, span_test)):
            columns: dict[str, tuple[float, float, float]] = {
                n: (case.scales.nominal[n], *case.ranges[n]) for n in known
            }
            out[case.joint] = Told(case.joint, columns, ours.get("inertia"))
    return out


def unknown_controllers(given: Sequence[IdentifiedJoint], stages: Sequence[Stage], notes: list[str]) -> set[str]:
    """Return joints of which the torque told, but whose logged torque is not what the believed law of the drive gives,
    hardly in part, or surely pushes the other way: their closed loop speaks of an unknown controller, and no effect of
    the joint is looked for in it. Said in `notes`.

    A line through the law and the torque fits well where one is the other's mirror image, too; but no gain of the
    believed law is negative, and the torque's own sign is borne out by its friction, which resists."""
    told = {x.case.joint for x in given if x.case.told}
    out = set()
    for x in stages:
        against = x.slope_high < 0
        if x.joint not in told or not (against or x.fit < 1 - TORQUE.much):
            continue
        out.add(x.joint)
        gives = "the opposite" if against else f"{100 * max(x.fit, 0.0):.0f} %"
        notes.append(
            f"{x.joint}: the believed law of its drive gives {gives} of the torque that was logged: its controller is "
            "another, and only the torque is judged"
        )
    return out


def _alike(
    case: Case, search: JointSearch, trial: Trial, ours: dict[str, float], test: Sequence[int], span_test: Spans | None
) -> bool:
    """Return whether what was held out is followed as well with the torque's figures as with those that the closed loop
    was refitted to."""
    whole = replace(case, plant=search.whole)
    windows = whole.plant.windows(None, test, span=span_test)
    params = trial.fit.params
    told = np.array([ours.get(p.key, x) for p, x in zip(params, trial.fit.x, strict=True)])
    measured = whole.plant.q[windows.sample_row]
    error = [
        float(np.sqrt(np.mean((measured - free_run(whole, params, x, windows, trial.fixed, True)[0]) ** 2)))
        for x in (trial.fit.x, told)
    ]
    return error[1] <= (1 + BELIEF.tolerance) * error[0] + 0.1 * case.sigma


def findings(
    given: Sequence[IdentifiedJoint], unknown: Sequence[str], runs: list[Run], train: list[int]
) -> list[Finding]:
    """Return the further effects as findings, for joints of which nothing of the friction was believed
    (`unknown`)."""
    out = []
    for joint in given:
        case, x = joint.case, joint.inverse
        for n in x.named if case.joint in unknown and joint.judges else ():
            if not n.effect:
                continue
            effect = EFFECTS[n.effect]
            parameters = effect.parameters_by_torque(_by_torque(case, x, n))
            signal = effect.signal(case, {k: v["value"] for k, v in parameters.items()}, {})
            active = signal > JUDGE.acts * max(float(np.percentile(signal, 99.9)), 1e-12)
            helped = 1 - (n.after / n.before) ** 2
            confidence = min(n.share, TORQUE.told if helped > SEARCH.least else JUDGE.hinted)
            metric = {"error": f"effort_rmse_{'N' if case.scales.slide else 'Nm'}"}
            out.append(
                Finding(
                    n.effect,
                    round(float(confidence), 3),
                    effect.shows_by_torque,
                    [case.joint],
                    alternatives=chances([(n.rival, 1 - n.share)] if n.rival and n.share < 1 else ()),
                    indistinguishable=effect.alike_by_torque,
                    separating_experiment=effect.experiment if effect.alike_by_torque else None,
                    when=intervals_of(active, case, runs, train),
                    parameters=parameters,
                    held_out=removed(n.before, n.after, n.removed) | metric,
                )
            )
    return out


# -- pushes from outside ----------------------------------------------------------------------------------------------
# Something outside that pushes: recorded torque that no inertia, gravity or friction of the joint's own makes, in
# stretches of time.
#
# Of each joint whose torque was logged the torque route is fitted to the half seconds that agree with each other best
# (least trimmed squares by blocks), so that what pushes now and then does not spoil the fit. Where a plain fit leaves
# much of the torque, and that trimmed fit is missed by far in some stretches only, something pushes then, by what is
# missed. Where nothing agrees, the torque is no witness of this body at all.

HALF, STARTS, STEPS = 0.5, 40, 12  # share of the blocks that are fitted, random beginnings, and steps from each
AROUND = 0.2  # s over which it is measured how much a joint shakes, and how hard it is pushed
TRAVEL = 0.02  # of its range: a joint that moves by less rests, between counts of its encoder
CREST = 0.8  # of the largest push: what is as strong is its crest
JUMP = 0.1  # of a target's whole way: as much from one command to the next is a jump
DRAWS = 200  # of a bootstrap


@dataclass
class Push:
    """Of one joint: torque [N.m, N for a slide], the largest from outside (positive along positive motion); interval
    (90 %) of its size; spans by recording [s]; left: share of the torque's variance that a plain fit leaves; clear:
    whether the rest fits."""

    joint: str
    torque: float
    interval: tuple[float, float]
    left: float
    clear: bool
    slide: bool
    spans: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    cut: bool = False  # whether the joint was judged without these stretches

    def finding(self) -> Finding:
        """As a name."""
        unit = "N" if self.slide else "N.m"
        count = sum(map(len, self.spans.values()))
        said = (
            f"in {count} stretch{'es' * (count != 1)} of time, {'forwards' if self.torque > 0 else 'backwards'} at "
            "its largest; elsewhere the joint's torque fits its body"
            if self.clear
            else f"all the time: {100 * self.left:.0f} % of the torque's variance fits no inertia, gravity or "
                 "friction (or it is not this joint's torque)"
        )
        size = {"value": abs(self.torque), "low": self.interval[0], "high": self.interval[1], "unit": unit}
        when = [
            {"recording": name, "start": round(a, 3), "end": round(b, 3)}
            for name, spans in self.spans.items()
            for a, b in spans
        ]
        confidence = TORQUE.told if self.clear else JUDGE.hinted
        return Finding(ExternalForce.id, confidence, said, [self.joint], when=when, parameters={"torque": size})


def find_pushes(
    model: mujoco.MjModel,
    runs: Sequence[Run],
    fitted: Sequence[int],
    seed: int = 0,
    asked: Collection[str] | None = None,
) -> list[Push]:
    """Return of every joint that is pushed in `runs` (all with the same joints), as told by the recordings `fitted`; []
    where no torque was logged. asked: joints (default all). One that rests tells of no inertia, gravity or friction."""
    out: list[Push] = []
    motions: dict[int, Stretch] = {}
    rng = np.random.default_rng(seed)
    for j, joint in enumerate(runs[0].joints):
        if asked is not None and joint not in asked:
            continue
        wide = float(np.ptp(model.joint(joint).range)) or 1.0
        use = [r for r in range(len(runs)) if readable(runs[r], j)]
        own = [r for r in use if r in fitted and np.ptp(runs[r].q[:, j]) > TRAVEL * wide]
        if not own:
            continue
        cutoff = min(min(inverse_dynamics.highest(runs[r].t) for r in use), 20.0)
        for r in use:
            if r not in motions:
                motions[r] = moved(runs[r], model, cutoff)
        push = _of_joint([columns_of([motions[r]], j) for r in use], [r in own for r in use], rng)
        if push is not None:
            spans, slide = (
                _spans(push[0], [runs[r] for r in use], 1.0 / cutoff),
                int(model.jnt_type[model.joint(joint).id]) == int(mujoco.mjtJoint.mjJNT_SLIDE),
            )
            moving = _moving_one_another(model, runs[0].joints, j)
            for run in runs:
                left = [x for x in spans.pop(run.name, []) if not thrown(x, run, moving)]
                spans |= {run.name: left} if left else {}
            if (push[4] and not spans) or _by_ringing(push[0], [runs[r] for r in use], moving, cutoff):
                continue
            out.append(Push(joint, push[1], push[2], push[3], push[4], slide, spans))
    return out


QUIETEST = 0.05  # of a joint's samples: those by which it is told what is no ringing


def _moving_one_another(model: mujoco.MjModel, joints: Sequence[str], j: int) -> list[int]:
    """Return of `joints` the j-th and those before and behind it in the mechanism: what one accelerates asks a torque
    of the others."""
    chains = [{*chain(model, model.jnt_bodyid[model.joint(x).id])} for x in joints]
    return [k for k, c in enumerate(chains) if c <= chains[j] or chains[j] <= c]


def thrown(span: tuple[float, float], run: Run, joints: Sequence[int]) -> bool:
    """Return whether a stretch [s] lies within `AROUND` of a jump of the target of one of `joints`: the drive asks for
    what happens then, faster than low-passed readings tell of it. A contact that ends a step lasts longer."""
    targets = run.cmd[:, joints]
    jumps = np.abs(np.diff(targets, axis=0)) > JUMP * np.ptp(targets, axis=0)
    at = run.cmd_t[1:][jumps.any(1)]
    return bool(np.any((at - AROUND <= span[0]) & (span[1] <= at + AROUND)))


def _by_ringing(
    given: Sequence[tuple[np.ndarray, np.ndarray]], runs: Sequence[Run], joints: Sequence[int], cutoff: float
) -> bool:
    """Return whether one of `joints` (`_moving_one_another`) rings in most of the samples in which something seems to
    push one of them, (times [S] s, pushed [S]) by run: it shakes by far more than where it is quietest, and by more
    than its motion below the cutoff [Hz] asks for. Inverse dynamics know no acceleration of what is faster than the
    readings, and a loop that rings by itself is pushed by nobody."""
    on = np.concatenate([pushed for _, pushed in given])
    for j in joints:
        swings = []
        for run in runs:
            step = float(np.median(np.diff(run.t)))
            even = np.arange(run.t[0], run.t[-1], step)
            raw = np.interp(even, run.t, run.q[:, j])
            swings.append((even, _swing(raw, step), _swing(inverse_dynamics.low_pass(raw, cutoff, step), step)))
        quiet = float(np.quantile(np.concatenate([all_ for _, all_, _ in swings]), QUIETEST))
        rings = []
        for (t, _), (even, all_, slow) in zip(given, swings, strict=True):
            beyond = (all_ > TORQUE.shakes * slow) & (all_ > SEARCH.loud * quiet)
            rings.append(np.interp(t, even - even[0], beyond.astype(float)) > 0.5)
        if on.any() and np.mean(np.concatenate(rings)[on]) > 0.5:
            return True
    return False


def _swing(x: np.ndarray, step: float) -> np.ndarray:
    """Return [n] rms of the second differences of x [n] within `AROUND` about each sample."""
    count = max(int(AROUND / step), 3)
    return np.sqrt(np.convolve(np.diff(x, 2, prepend=x[0], append=x[-1]) ** 2, np.ones(count) / count, "same"))


def _of_joint(
    pieces: Sequence[Columns], own: Sequence[bool], rng: np.random.Generator
) -> tuple[list[tuple[np.ndarray, np.ndarray]], float, tuple[float, float], float, bool] | None:
    """([(times, pushed) of each piece], largest push, the interval of its size, share left by a plain fit, whether the
    rest fits); None where little is left.

    Fitted while the joint moves: at rest its dry friction carries any torque up to its level, and only what is beyond
    that speaks."""
    names = [n for n in pieces[0].names if all(n in p.names for p in pieces)]
    X = [p.X[:, [p.names.index(n) for n in names]] for p in pieces]
    fast = JUDGE.turning * float(np.percentile(np.abs(np.concatenate([p.v for p in pieces])), 95))
    moves = [np.abs(p.v) > fast for p in pieces]
    mine = [k for k, x in enumerate(own) if x and moves[k].sum() > 20]
    if not mine or sum(int(moves[k].sum()) for k in mine) < 200:
        return None
    cat = lambda f: np.concatenate([f(k)[moves[k]] for k in mine])  # noqa: E731
    A, u, torque = cat(lambda k: X[k]), cat(lambda k: pieces[k].u), cat(lambda k: pieces[k].torque)
    left = float(np.var(u - A @ solved(A.T @ A, A.T @ u))) / max(float(np.var(torque)), 1e-30)
    if left < TORQUE.much:
        return None
    ends = np.cumsum([0, *(pieces[k].blocks.max() + 1 for k in mine)])
    _, block = np.unique(cat(lambda k: pieces[k].blocks + ends[mine.index(k)]), return_inverse=True)
    x, quiet = _trimmed(A, u, block, int(block.max()) + 1, rng)
    on = quiet[block]
    noise = float(np.sqrt(np.mean((u - A @ x)[on] ** 2)))
    quiet_torque = float(np.var(torque[on]))
    fits = noise**2 < TORQUE.much * quiet_torque and not unphysical(
        replace(pieces[mine[0]], names=tuple(names), X=A[on], u=u[on])  # the same with other rows
    )
    least = max(TORQUE.far * noise, np.sqrt((1 - TORQUE.fit) * np.mean(torque**2)))
    residual = [
        _beyond(p.u, a, x, names.index("coulomb_friction"), m) for p, a, m in zip(pieces, X, moves, strict=True)
    ]
    pushed = [np.abs(r) > least for r in residual]
    share = float(np.mean(np.concatenate(pushed)))
    if fits and share == 0 or not fits and not _slow(u - A @ x, block):
        return None  # nothing stands out, or noise does
    times = [np.concatenate([q.motion.t[q.keep] - q.motion.t[0] for q in p.pieces]) for p in pieces]
    _, quiet_block = np.unique(block[on], return_inverse=True)
    grams, sides = sums(A[on], u[on], quiet_block, int(quiet_block.max()) + 1)
    weight = intervals.weights(len(grams), rng, DRAWS)
    drawn = solved(np.einsum("db,bkl->dkl", weight, grams), weight @ sides)
    top, interval = _size(times, residual, pushed, X, drawn - x, noise)
    # what the motor gives less, something else gives
    return list(zip(times, pushed, strict=True)), -top, interval, left, fits and share < TORQUE.most


def _size(
    times: Sequence[np.ndarray],
    residual: Sequence[np.ndarray],
    pushed: Sequence[np.ndarray],
    X: Sequence[np.ndarray],
    off: np.ndarray,
    noise: float,
) -> tuple[float, tuple[float, float]]:
    """Return (the largest push, interval of its size): of the crest of the strongest stretch, where medians over
    `AROUND` are within `CREST` of the largest. One sample is no size: the largest of many is the noise's. The interval
    holds nine tenths of those medians and what their mean moves by with the fit's own figures. off [draws, K]: by which
    the figures of the fit differ when its blocks are drawn anew; noise: of one sample."""
    best: tuple[float, int, np.ndarray, np.ndarray] | None = None
    anywhere = any(on.any() for on in pushed)
    for k, (t, r, on) in enumerate(zip(times, residual, pushed, strict=True)):
        if not len(r):
            continue
        count = max(int(AROUND / max(float(np.median(np.diff(t))), 1e-6)), 1) if len(t) > 1 else 1
        smooth = median_filter(r, count, mode="nearest")
        for a, b in pieces(on if anywhere else np.ones(len(r), bool)):
            peak = float(smooth[a:b][np.argmax(np.abs(smooth[a:b]))])
            if best is None or abs(peak) > abs(best[0]):
                best = peak, k, smooth[a:b], np.arange(a, b)
    assert best is not None  # one piece has samples
    peak, k, smooth, rows = best
    crest = smooth * np.sign(peak) >= CREST * abs(peak)
    size = float(np.mean(smooth[crest] * np.sign(peak)))
    moves = 1.645 * float(np.std((X[k][rows[crest]] @ off.T).mean(0)))
    low, high = np.quantile(smooth[crest] * np.sign(peak), [0.05, 0.95])
    low, high = (size - np.hypot(size - low, moves) - noise, size + np.hypot(high - size, moves) + noise)
    return float(np.sign(peak) * size), (max(float(low), 0.0), float(high))


def _beyond(u: np.ndarray, A: np.ndarray, x: np.ndarray, coulomb: int, moves: np.ndarray) -> np.ndarray:
    """Return [m] torque that the fit misses; at rest only beyond what dry friction may carry either way."""
    still = A.copy()
    still[:, coulomb] = 0.0
    held = u - still @ x
    free = np.sign(held) * np.maximum(np.abs(held) - TORQUE.room * max(float(x[coulomb]), 0.0), 0.0)
    return np.where(moves, u - A @ x, free)


def _slow(residual: np.ndarray, block: np.ndarray) -> bool:
    """Return whether residuals are alike over half a second, as forces are and noise is not."""
    count = np.maximum(np.bincount(block), 1)
    means = np.bincount(block, residual) / count
    return float(np.sum(count * means**2)) > TORQUE.slow * float(np.sum(residual**2))


def _trimmed(
    A: np.ndarray, u: np.ndarray, block: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return (coefficients [K], fitted blocks [count] bool) of the least trimmed squares by blocks (P. Rousseeuw, K.
    Van Driessen 2006)."""
    grams, sides = sums(A, u, block, count)
    squares, n = np.bincount(block, u * u, count), np.maximum(np.bincount(block, minlength=count), 1)
    keep, lowest = max(int(HALF * count), 4), np.inf
    best = np.zeros(A.shape[1]), np.zeros(count, bool)
    for _ in range(STARTS):
        on = np.zeros(count, bool)
        on[rng.choice(count, min(max(A.shape[1], 4), count), replace=False)] = True
        for _ in range(STEPS):
            x = solved(grams[on].sum(0), sides[on].sum(0))
            energy = (squares - 2 * sides @ x + np.einsum("k,bkl,l->b", x, grams, x)) / n
            now = np.zeros(count, bool)
            now[np.argsort(energy)[:keep]] = True
            if (now == on).all():
                break
            on = now
        loss = float(energy[on].sum())
        if loss < lowest:
            lowest, best = loss, (x, on)
    return best


def _spans(
    given: Sequence[tuple[np.ndarray, np.ndarray]], runs: Sequence[Run], shortest: float
) -> dict[str, list[tuple[float, float]]]:
    """Stretches by recording, in its own time. shortest [s]: what the filter of the torque tells apart; neither a push
    nor a gap in it is shorter, so that the tops of a ripple are none."""
    out: dict[str, list[tuple[float, float]]] = {}
    for (t, on), run in zip(given, runs, strict=True):
        found = joined([(float(t[a] + run.t[0]), float(t[b - 1] + run.t[0])) for a, b in pieces(on)], shortest)
        if spans := [(a, b) for a, b in found if b - a >= shortest]:
            out[run.name] = out.get(run.name, []) + spans
    return out


def without_pushes(
    pushes: Sequence[Push], runs: list[Run], held: list[int], notes: list[str]
) -> tuple[list[Run], list[int]]:
    """Return the runs without the stretches in which something pushes, and which are held out, where enough is left of
    both to judge by."""
    from dexsim.gap.read import inputs

    clear = [p for p in pushes if p.clear]
    if not clear:
        return runs, held
    said: list[str] = []
    touched = inputs.merged_spans(*(p.spans for p in clear))
    rest, kept = inputs.free_air(
        runs,
        held,
        touched,
        said,
        f"something outside pushes ({', '.join(p.joint for p in clear)})",
        "in which nothing does",
    )
    seconds = lambda given: sum(r.duration for r in given)  # noqa: E731
    enough = seconds(rest) >= (1 - TORQUE.most) * seconds(runs)
    if not rest or bool(held) != bool(kept) or len(kept) == len(rest) or not enough:
        return runs, held
    for p in clear:
        p.cut = True
    notes += said
    return rest, kept
