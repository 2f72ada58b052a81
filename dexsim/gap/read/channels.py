"""Signals that are not what they say, found before any physics: what they are, and what must be left out because of
them.

The reader's audit names what a recording alone shows. Beside the model and the commands more can be told: degrees on
both sides, a position that runs against its target or before it, readings that are repeated while the joint moves, an
encoder that stops.

Readings repeat old ones for a while where a bus sends again what it read last or an encoder is not read. Quantised
readings of a joint at rest repeat honestly, and so do those of one that sticks while its target creeps. Two things give
a frozen one away, both by what the same joint does elsewhere in its recordings. It ends in a jump: between two samples
the reading goes faster than just before and just after, by more than a mass can (noise, quantum and stick-slip make
such pulses too, but not one of this size). And its target went a way in the meantime that the joint has never let pass
before.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass, field, replace
from typing import Any

import mujoco
import numpy as np
from scipy.ndimage import uniform_filter1d

from dexsim.actuator.columns import INDEX
from dexsim.gap.finding import WRONG_SIGNAL, Finding
from dexsim.gap.read import COLUMNS, Run, pieces
from dexsim.gap.read.agreement import sliding_correlation
from dexsim.gap.rules import JUDGE, SIGNAL
from dexsim.recording.audit_values import repeats
from dexsim.recording.schema import COMMANDS, STATES, Recording
from dexsim.recording.schema import Finding as AuditFinding

# kinds of the audit's errors after which a position or a target cannot be used
SPOILS = ("joint_order", "wrap", "unit")
LAGS = np.arange(0.0, 0.201, 0.02)  # s by which a joint may follow its target
SLUGGISH, LONG_LAGS = 0.8, np.arange(0.0, 0.501, 0.02)  # and where it goes less far than so much of its target's way
EDGE, EDGES = 0.3, 3  # s before and after an edge of a target that are looked at, and edges that tell
REACTS = 0.06  # s within which a joint follows a step of its target, at the latest
PAUSE = 1.0  # s without a sample, over which no lag is measured
STEP, BEFORE, AFTER = 0.005, 120, 80  # s of the grid on which a lag is measured, and steps of it on either side
TURN = 180 / np.pi

Spans = list[tuple[float, float]]  # s


def finding(
    kind: str, text: str, joint: str, topics: list[str], when: list[dict[str, Any]], confidence: float | None = None
) -> Finding:
    """Return a finding that a signal is not what it says."""
    told = SIGNAL.told if confidence is None else confidence
    return Finding(WRONG_SIGNAL, told, f"{kind}: {text}", [joint] if joint else (), topics=topics, when=when)


def driven_openly(runs: list[Run]) -> set[tuple[str, str]]:
    """(run, joint) whose drive can give what its gain makes of every target, which may lie anywhere for that."""
    return {(run.name, joint) for run in runs for j, joint in enumerate(run.joints) if _within_drive(run, j)}


def far_target(f: AuditFinding, name: str, openly: Set[tuple[str, str]]) -> bool:
    """Return whether what the audit found in the recording `name` is that targets lie far off on a joint that is driven
    so: it knows no gains."""
    return f.kind == "unit" and f.topic == COMMANDS and (name, f.joint) in openly


def spoiled(recordings: list[Recording], openly: Set[tuple[str, str]] = frozenset()) -> dict[tuple[str, str], str]:
    """Return (recording, joint) whose position or target the audit found wrong -> why. openly: of `driven_openly`."""
    out: dict[tuple[str, str], str] = {}
    for r in recordings:
        for f in r.findings:
            if (
                f.severity == "error"
                and f.kind in SPOILS
                and f.joint
                and f.text.split(" ")[0] in ("position", "command")
                and not far_target(f, r.path.name, openly)
            ):
                out.setdefault((r.path.name, f.joint), f"{f.kind}: {f.text}")
    return out


def secondary(findings: list[Finding]) -> list[Finding]:
    """Return the findings without those that follow from another: an effort's sign is read against the position."""
    spoiled = [f for f in findings if f.regime.split(":")[0] in SPOILS and "position" in f.regime]
    wrong = {j for f in spoiled for j in f.joints}
    of_sign = ("sign_mismatch", "lost_sign")
    return [f for f in findings if not (f.regime.startswith(of_sign) and set(f.joints) & wrong)]


def inspect(runs: list[Run], model: mujoco.MjModel, known: dict[tuple[str, str], str]
            ) -> tuple[list[Finding], dict[tuple[str, str], str], dict[str, list[tuple[float, float]]]]:
    """Return (findings that runs, model and commands show together, (run, joint) that must be left out -> why,
    stretches by run in s in which nothing is known of a joint). `known`: what the audit has named already. Repeated
    readings are taken out of the runs, which can then be used, but for those stretches."""
    found: dict[tuple[str, str], Finding] = {}
    out = dict(known)
    targets = [Targets(run) for run in runs]
    long = {joint: repeated_stretches(runs, joint, targets) for joint in {j for run in runs for j in run.joints}}
    blind: dict[str, list[tuple[float, float]]] = {}
    beat = {joint: common_rhythm(runs, joint) for joint in long}
    ways = {joint: directions(runs, targets, joint) for joint in long}

    def add(
        kind: str, text: str, run: Run, joint: str, topics: list[str], spans: Spans, confidence: float | None = None
    ) -> None:
        first = found.get((kind, joint)) or finding(kind, text, joint, topics, [], confidence)
        when = [{"recording": run.name, "start": float(a), "end": float(b)} for a, b in spans]
        found[kind, joint] = replace(first, when=[*first.when, *when])

    for i, run in enumerate(runs):
        if (spans := _pauses(run)):
            blind[run.name] = spans
        stale, between = np.zeros(len(run.t), bool), np.ones(len(run.t), bool)
        for j, joint in enumerate(run.joints):
            if (run.name, joint) in out:
                continue
            whole = [(run.t[0], run.t[-1])]
            unlike = [r.name for r, w in zip(runs, ways[joint], strict=True) if w == 1]
            wrong = _wrong(runs, run, j, model, targets[i], ways[joint][i], unlike)
            if wrong is not None:
                add(wrong.kind, wrong.text, run, joint, wrong.topics, wrong.spans or whole, wrong.confidence)
                out[run.name, joint] = f"{wrong.kind}: {wrong.text}"
                continue
            if beat[joint] > 0:
                old = _on_rows(run, j, between_readings(*run.readings(j), beat[joint]))
                if run.read is None:
                    between &= old  # joints of one bus are read one after the other
                else:
                    stale |= old
                text = f"{joint} is read every {1e3 * beat[joint]:.3g} ms only; the samples between repeat it"
                add("stale", text, run, joint, [STATES], whole)
                continue
            t, q = run.readings(j)
            seen = np.stack([run.command_at(t - lag)[:, j] for lag in (0.0, REACTS)])
            repeated, said, lost = _repeated(t, q, seen, joint, long[joint][i])
            if lost:
                blind.setdefault(run.name, []).extend(lost)
            for text, spans in said:
                add("stale", text, run, joint, [STATES], spans)
            stale |= _on_rows(run, j, repeated)
            if {w for w in ways[joint] if w} == {-0.5} and ways[joint][i]:  # drops nothing
                text = f"{joint} may follow the negative of its target: in a narrow band a lag looks like another sign"
                add("sign", text, run, joint, [STATES, COMMANDS], whole, JUDGE.hinted)
        if run.read is None and not between.all():
            stale |= between
        if stale.any() and (~stale).sum() >= 20:
            # where it rested until its first reading, it is known from the begin on, as a replay takes it
            stale[0] &= not np.array_equal(run.q[0], run.q[np.argmin(stale)], equal_nan=True)
            _keep(run, ~stale)
    return list(found.values()), out, blind


def _on_rows(run: Run, j: int, on: np.ndarray) -> np.ndarray:
    """Return [S] bool of a run's samples from that of joint j's readings."""
    if run.read is None:
        return on
    out = np.zeros(len(run.t), bool)
    out[run.read[:, j]] = on
    return out


def _repeated(
    t: np.ndarray, q: np.ndarray, targets: np.ndarray, joint: str, long: Sequence[tuple[int, int]]
) -> tuple[np.ndarray, list[tuple[str, Spans]], Spans]:
    """(samples [S] that repeat an old reading, what is said of them with its stretches [s], those of the `long`
    stretches that are too long to know the motion over)."""
    held, single = _held(t, q, targets), repeated_samples(t, q)
    for a, b in long:
        held[a + 1 : b + 1] = True
    lost = [(float(t[a]), float(t[b])) for a, b in long if t[b] - t[a] > SIGNAL.blind]
    said: list[tuple[str, Spans]] = []
    if held.any():
        text = (
            f"position of {joint} is repeated for {100 * held.mean():.0f} % of the time and then jumps: old "
            "readings, sent again"
        )
        said.append((text, [(t[a], t[min(b, len(q)) - 1]) for a, b in pieces(held)]))
    elif single.any():
        text = (
            f"{100 * single.mean():.0f} % of the positions of {joint} repeat the one before while it moves: "
            "old readings, sent again"
        )
        said.append((text, [(t[0], t[-1])]))
    return held | single, said, lost


class Targets:
    """The targets in force at a run's samples, found once for all of its joints."""

    def __init__(self, run: Run):
        self.run = run
        self._at: dict[float, np.ndarray] = {}
        self._even: tuple[np.ndarray, np.ndarray, slice] | None = None

    def before(self, delay: float = 0.0) -> np.ndarray:
        """Return [S, J] `delay` s before each sample."""
        if delay not in self._at:
            self._at[delay] = self.run.command_at(self.run.t - delay if delay else self.run.t)
        return self._at[delay]

    def even(self) -> tuple[np.ndarray, np.ndarray, slice]:
        """Return (even grid [n] s over the longest stretch without a pause, targets [n + BEFORE + AFTER, J] from AFTER
        steps before it to BEFORE steps behind it, samples of the stretch); no targets where it is too short."""
        if self._even is None:
            t = self.run.t
            edges = np.r_[0, np.flatnonzero(np.diff(t) > PAUSE) + 1, len(t)]
            k = int(np.argmax(np.diff(edges)))
            part = slice(int(edges[k]), int(edges[k + 1]))
            grid = np.arange(t[part][0], t[part][-1], STEP)
            wide = t[part][0] + STEP * np.arange(-AFTER, len(grid) + BEFORE)
            self._even = grid, self.run.command_at(wide if len(grid) >= 200 else wide[:0]), part
        return self._even


@dataclass
class _Wrong:
    """Why a joint's position or target is of no use in a recording. spans: when, in s; all the time where there are
    none."""

    kind: str
    text: str
    topics: list[str]
    spans: list[tuple[float, float]] = field(default_factory=list)
    confidence: float | None = None


def _wrong(
    runs: list[Run],
    run: Run,
    j: int,
    model: mujoco.MjModel,
    targets: Targets | None = None,
    way: float | None = None,
    unlike: Sequence[str] = (),
) -> _Wrong | None:
    """Return what is wrong with the position or the target of joint j in `run`, one of `runs`; None where nothing is.
    targets: the run's, where they are found already; way: its direction there (`directions`); unlike: runs in which
    that is another."""
    targets = targets or Targets(run)
    way = directions([run], [targets], run.joints[j])[0] if way is None else way
    joint, q, cmd = run.joints[j], run.q[:, j], targets.before()[:, j]
    limits = _range(model, joint)
    if limits is not None and _degrees(q, cmd, limits):
        return _Wrong(
            "unit",
            f"position and target of {joint} reach {np.abs(q).max():.3g}, where the model allows "
            f"{np.abs(limits).max():.3g}: degrees? "
            "(state meta.position_unit=deg)",
            [STATES, COMMANDS],
        )
    far = [] if limits is None else [
        (what, topic, float(x[np.argmax(np.abs(x - np.mean(limits)))]))
        for what, topic, x in (("position", STATES, q), ("target", COMMANDS, run.cmd[:, j]))
        if _outside(x, limits) > max(SIGNAL.far * (limits[1] - limits[0]), 2 * np.pi)
        and not (what == "target" and _within_drive(run, j))
    ]
    if limits is not None and far:
        return _Wrong(
            "unit",
            f"{' and '.join(what for what, _, _ in far)} of {joint} reach"
            f"{'es' if len(far) == 1 else ''} {' and '.join(f'{x:.4g}' for _, _, x in far)}, where the model"
            f" allows {limits[0]:.3g} to {limits[1]:.3g}: of another unit, or of another joint",
            [topic for _, topic, _ in far],
        )
    if way == -1:
        text = f"{joint} follows the negative of its target: another direction of its position or its commands"
        return _Wrong("sign", text + (f"; not so in {', '.join(unlike[:3])}" if unlike else ""), [STATES, COMMANDS])
    lead = _lead(run, j, targets)
    if lead > SIGNAL.early and not _clocked(run, j, targets):
        return _Wrong(
            "clock_skew",
            f"{joint} moves {1e3 * lead:.0f} ms before its target is sent: commands and states are on different clocks",
            [COMMANDS, STATES],
        )
    early = _early_edges(run, j)
    if early > max(SIGNAL.early, 1.5 * run.period):
        return _Wrong(
            "clock_skew",
            f"{joint} moves {1e3 * early:.0f} ms before the edges of its target: these are logged late",
            [COMMANDS, STATES],
        )
    stop = _stops(runs, run, joint, cmd)
    if stop is not None:
        return _Wrong(
            "stuck",
            f"position of {joint} stops at {stop:.2f} s while its target moves on: a dead encoder, a jam or a "
            "drive that is off",
            [STATES],
            [(stop, run.t[-1])],
            SIGNAL.stopped,
        )
    return None


def drop(
    runs: list[Run], out: dict[tuple[str, str], str], notes: list[str], model: mujoco.MjModel, held: Sequence[int] = ()
) -> list[Run]:
    """Return the runs without what must be left out of them.

    A joint that others of the recordings tell of stays in a run in which it is spoiled, as one of `Run.left_out`: it is
    not judged there, and what the joints beside it feel of it is that of its targets (where those are spoiled too, of a
    joint at rest). A joint that is spoiled in every run, in all that are held out (`held`) or in all others, goes
    altogether, but for one whose direction alone is in doubt: it is judged in none, and moves the others as its
    readings say, which is how it is replayed. A run without joints is gone."""
    every = {j for run in runs for j in run.joints}
    sides = [[r for i, r in enumerate(runs) if (i in held) == side] for side in ((True, False) if held else (False,))]
    told = {j for j in every if all(any(j in r.joints and (r.name, j) not in out for r in part) for part in sides)}
    kept = []
    for run in runs:
        wrong = [j for j in run.joints if (run.name, j) in out]
        notes += [f"{run.name}: {j} is left out ({out[run.name, j]})" for j in wrong]
        bad = [j for j in run.joints if j not in told]
        notes += [
            f"{run.name}: {j} is left out, for no recording on one side of the fit tells of it"
            for j in bad
            if j not in wrong
        ]
        if all((run.name, j) in out for j in run.joints):
            continue
        moving = [j for j in bad if all(x.startswith("sign") for (_, k), x in out.items() if k == j)]
        bad = [j for j in bad if j not in moving]
        run.left_out = frozenset(j for j in wrong if j in told)
        for j in run.left_out:
            _assume(run, run.joints.index(j), out[run.name, j].startswith("stuck"), model)
        run.left_out |= frozenset(moving)
        if bad:
            k = [i for i, j in enumerate(run.joints) if j not in bad]
            if not k:
                continue
            run.only(k)
        kept.append(run)
    return kept


def _pauses(run: Run) -> list[tuple[float, float]]:
    """Stretches [s] without samples, and those over which the clock was set anew: a joint is judged before and after
    them."""
    step = np.diff(run.t)
    long = np.flatnonzero(step > max(SIGNAL.blind, 8 * float(np.median(step))))
    out = [(float(run.t[k]), float(run.t[k + 1])) for k in long]
    # the first sample after a break is of the other time already
    first, last = float(run.t[0]), float(run.t[-1])
    return sorted({*out, *((max(a, first), min(b, last)) for a, b in run.breaks if a < last and b > first)})


def _assume(run: Run, j: int, follows: bool, model: mujoco.MjModel) -> None:
    """What a joint without usable readings is taken to do: to follow its targets smoothly, or to rest where the model
    does."""
    if follows:
        rate = 1 / max(float(np.median(np.diff(run.t))), 1e-4)
        width = int(np.clip(round(0.1 * rate), 1, len(run.t) // 4))
        q = run.command_at(run.t)[:, j]
        for _ in range(2):
            q = uniform_filter1d(q, 2 * width + 1, mode="nearest")
        run.q[:, j] = q
    else:
        run.q[:, j] = run.cmd[:, j] = model.qpos0[model.joint(run.joints[j]).qposadr[0]]
    for name in ("v", "torque"):
        x = getattr(run, name)
        if x is not None:
            x[:, j] = np.nan


def _range(model: mujoco.MjModel, joint: str) -> np.ndarray | None:
    i = model.joint(joint).id
    hinge = int(model.jnt_type[i]) == int(mujoco.mjtJoint.mjJNT_HINGE)
    return model.jnt_range[i] if model.jnt_limited[i] and hinge else None


def _outside(x: np.ndarray, limits: np.ndarray) -> float:
    """Return how far beyond a range the values go, 0 or less where they do not."""
    return float(max(x.max() - limits[1], limits[0] - x.min()))


def _within_drive(run: Run, j: int) -> bool:
    """Return whether the believed drive can give what its gain makes of every target: one without a loop of its own is
    told its torque so, as a target far off through a small gain."""
    row = run.servo.nominal(run.joints)[j]
    asked = row[INDEX["kp"]] * (float(np.abs(run.cmd[:, j]).max()) + float(np.abs(run.q[:, j]).max()))
    return bool(0 < asked <= (1.0 if run.servo.drive == "voltage" else row[INDEX["torque_limit"]]))


def _degrees(q: np.ndarray, cmd: np.ndarray, limits: np.ndarray) -> bool:
    """Find values far outside the range and more than a turn, both of them, and inside once divided. (Less than a turn
    outside: the model's range may be the one in degrees.)"""
    wide = 0.1 * (limits[1] - limits[0])
    outside = lambda x: _outside(x, limits) > SIGNAL.far * (limits[1] - limits[0])  # noqa: E731
    inside = (q / TURN).min() > limits[0] - wide and (q / TURN).max() < limits[1] + wide
    return bool(outside(q) and outside(cmd) and inside and min(np.abs(q).max(), np.abs(cmd).max()) > 2 * np.pi)


def _ways(targets: Targets, q: np.ndarray, j: int) -> tuple[float, float]:
    """Return (largest correlation of the position with its target of up to `LAGS` s before, and with the target's
    negative). In a narrow band both are large: a lag of half a period looks like another sign. A joint beyond its
    resonance lags by more than a quarter period, and goes less far than its target for that: its own target may be
    `LONG_LAGS` before."""

    def most(lags: np.ndarray) -> tuple[float, float]:
        on = targets.run.t >= targets.run.cmd_t[0] + lags[-1]  # from where on all of them are known
        each = [0.0]
        if on.sum() > 10 and q[on].std() > 0:
            at = [targets.before(delay)[on, j] for delay in lags]
            each += [float(np.corrcoef(c, q[on])[0, 1]) for c in at if c.std() > 0]
        return max(each), max(-x for x in each)

    along, against = most(LAGS)
    if against > along and np.ptp(q) < SLUGGISH * np.ptp(targets.before()[:, j]):
        along = max(along, most(LONG_LAGS)[0])
    return along, against


def directions(runs: Sequence[Run], targets: Sequence[Targets], joint: str) -> list[float]:
    """Return of each run, 1 where the joint follows its target, -1 where it follows the target's negative, half of it
    where a narrow band lets it seem so, 0 where it cannot tell or lacks the joint. Of several, one that cannot tell has
    the direction that the slowest of the others shows, and so has a much faster one."""
    out = []
    for run, at in zip(runs, targets, strict=True):
        way = 0.0
        if joint in run.joints:
            j = run.joints.index(joint)
            q, cmd = run.q[:, j], at.before()[:, j]
            if np.ptp(cmd) > 1e-3 and np.ptp(q) > SIGNAL.follows * np.ptp(cmd):
                along, against = _ways(at, q, j)
                most = max(along, against)
                clear = min(along, against) < most - SIGNAL.beyond
                way = np.sign(along - against) * (1.0 if clear else 0.5) if most > SIGNAL.against else 0.0
        out.append(way)
    told = [k for k, w in enumerate(out) if abs(w) == 1]
    if len(runs) < 2 or not told:
        return out
    # a machine has one direction, which the slowest motion shows best: the faster, the more of a turn a lag is
    rate = {k: _rate(runs[k], joint) for k, run in enumerate(runs) if joint in run.joints}
    slowest = min(told, key=lambda k: rate[k])
    for k in rate:
        if abs(out[k]) < 1 or rate[k] > FASTER * rate[slowest]:
            out[k] = out[slowest]
    return out


FASTER = 2.0
"""x the speed of the slowest motion that tells of a direction: from there on another one may be a lag."""


def _rate(run: Run, joint: str) -> float:
    """Return how fast a target goes to and fro [1/s]: its speed over its size, rms."""
    cmd = run.command_at(run.t)[:, run.joints.index(joint)]
    return float(np.sqrt(np.mean((np.diff(cmd) / np.diff(run.t)) ** 2)) / max(float(np.std(cmd)), 1e-9))


def _clocked(run: Run, j: int, targets: Targets) -> bool:
    """Return whether other joints of the run, of whom most that can tell do not lead, show that its clocks belong
    together."""
    others = [k for k in range(len(run.joints)) if k != j and directions([run], [targets], run.joints[k])[0] == 1]
    leads = [_lead(run, k, targets) > SIGNAL.early for k in others]
    return len(leads) > 1 and sum(leads) < 0.5 * len(leads)


def _early_edges(run: Run, j: int) -> float:
    """Return s by which the joint moves before the edges of its target, in the median of those before and after which
    both stood still; 0 where there are few such, or most come first."""
    t, q = run.readings(j)
    c, at = run.cmd[:, j], run.cmd_t
    jump = np.diff(c)
    size = np.abs(jump)
    edges = np.flatnonzero(size > max(0.1 * np.ptp(c), 0.02)) + 1
    leads = []
    for k in edges.tolist():
        a, b = np.searchsorted(t, [at[k] - EDGE, at[k] + EDGE])
        stood = np.abs(c[(at >= at[k] - EDGE) & (at < at[k])] - c[k - 1]).max(initial=0.0) < 0.02 * size[k - 1]
        if not stood or b - a < 8 or not a:
            continue
        way = np.sign(jump[k - 1]) * (q[a:b] - np.median(q[a : a + max((b - a) // 5, 2)]))
        still = np.abs(way[: max((b - a) // 5, 2)]).max()
        moved = np.flatnonzero(way > max(3 * still, 0.03 * size[k - 1]))
        if len(moved) and still < 0.02 * size[k - 1]:
            leads.append(float(at[k] - t[a + moved[0]]))
    if len(leads) < EDGES or np.mean(np.array(leads) > 0) < 0.75:
        return 0.0
    return max(float(np.median(leads)), 0.0)


def _lead(run: Run, j: int, targets: Targets | None = None) -> float:
    """Time [s] by which the joint moves before its target: 0 where it does not.

    Correlation of the speed with the target's, shifted by -0.6 to 0.4 s, over the longest stretch without a pause."""
    grid, command, part = (targets or Targets(run)).even()
    if len(grid) < 200:
        return 0.0
    step, after = STEP, AFTER
    dq = np.gradient(np.interp(grid, run.t[part], run.q[part, j]))
    dc = np.convolve(np.gradient(command[:, j]), np.ones(9) / 9, "same")
    scores = sliding_correlation(dc, dq)  # by where the target's stretch begins: shift = 80 - place
    best = int(np.argmax(scores))
    causal = float(scores[: after + 1].max())
    ahead = best > after and scores[best] > SIGNAL.leads and scores[best] > causal + SIGNAL.beyond
    return step * (best - after) if ahead else 0.0


def _stops(runs: Sequence[Run], run: Run, joint: str, cmd: np.ndarray) -> float | None:
    """Return when [s] the position stops for good although its target goes on; None where it does not, and where dry
    friction may hold it: where its target goes no further away than it has been when the joint broke away from rest
    before."""
    j = run.joints.index(joint)
    q = run.q[:, j]
    last = np.flatnonzero(q != q[-1])
    k = last[-1] + 1 if len(last) else 0
    if k > SIGNAL.late * len(q) or (len(last) and np.ptp(q[:k]) < SIGNAL.stirred):
        return None
    if run.enabled is not None and (run.enabled[k:, j] < 0.5).any():
        return None
    moved = np.ptp(cmd[:k]) if k else 0.0
    if np.ptp(cmd[k:]) <= max(SIGNAL.further * max(moved, np.ptp(q)), 0.0 if k else SIGNAL.still):
        return None
    held = [_holds(r, r.joints.index(joint), k if r is run else len(r.t)) for r in runs if joint in r.joints]
    return None if np.abs(cmd[k:] - q[-1]).max() < SIGNAL.holds * max(held) else float(run.t[k])


def _holds(run: Run, j: int, end: int) -> float:
    """Return the largest error [rad] at which a joint stood still for 50 ms and more, and then moved, in the samples
    before `end`."""
    q = run.q[:end, j]
    error = np.abs(run.command_at(run.t[:end])[:, j] - q)
    stood = [(a, b) for a, b in rests(q) if b + 1 < end and run.t[b] - run.t[a] >= SIGNAL.rest]
    return max((float(np.median(error[max(b - 2, a) : b + 1])) for a, b in stood), default=0.0)


def _held(t: np.ndarray, q: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return the readings [S] that repeat the one before and end in a jump that a joint of this speed cannot make in
    one sample. targets [2, S]: in force at each reading, and REACTS s before; a joint whose target stood with it, or
    went no farther than dry friction has held it elsewhere, and then stepped, was at rest."""
    step = np.abs(np.diff(q))
    out = np.zeros(len(q), bool)
    edge = np.flatnonzero(np.diff(np.concatenate([[False, False], step == 0, [False]]).astype(np.int8)))
    first, end = edge[::2], edge[1::2]
    long = (end < len(q)) & (t[end - 1] - t[first - 1] >= SIGNAL.held)
    moving = step[step > 0]
    if not long.any() or len(moving) < 20:
        return out
    usual = float(np.percentile(moving, 90))
    stood = list(zip(first[long].tolist(), end[long].tolist(), strict=True))
    now, before = targets
    passed = max((_way(t, before, a, b) for a, b in stood if step[b - 1] <= usual), default=0.0)

    def woken(a: int, b: int) -> bool:
        stepped = abs(now[b] - before[b - 1]) > 0.5 * step[b - 1]
        return bool(stepped) and t[b - 1] - t[a] > REACTS and _way(t, before, a, b) <= max(0.2 * step[b - 1], passed)

    jumps = [(a, b) for a, b in stood if step[b - 1] > SIGNAL.jump * usual and not woken(a, b)]
    # a joint at rest may start with a jump: at least two must have been on their way when they froze (what comes and
    # goes at once is no way)
    if sum(a >= 4 and abs(q[a - 1] - q[a - 4]) > 3 * SIGNAL.moving * usual for a, _ in jumps) >= 2:
        for a, b in jumps:
            out[a:b] = True
    return out


def _way(t: np.ndarray, before: np.ndarray, first: int, end: int) -> float:
    """Return how far the target went while a joint's readings `first` to `end` stood, that it could follow: what it
    does in the last REACTS s is left out, and the rest counted as if it went on. before [S]: the target REACTS s before
    each reading."""
    seen = before[first:end][t[first:end] - REACTS >= t[first]]
    stood = t[end - 1] - t[first]
    return float(np.ptp(seen)) * stood / (stood - REACTS) if len(seen) > 1 else 0.0


def _keep(run: Run, on: np.ndarray) -> None:
    run.t, run.q = run.t[on], run.q[on]
    for name in (*COLUMNS, "supply"):
        x = getattr(run, name)
        setattr(run, name, None if x is None else x[on])


def rests(q: np.ndarray) -> list[tuple[int, int]]:
    """Return (first, last) sample of each stretch of readings that are all the same."""
    return pieces(np.diff(q) == 0)


def pulses(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return [S - 1] how far the step after each sample goes beyond what the faster of the steps beside it would give
    in its time; 0 where one beside it goes the other way just as far (a reading that comes back is a spike, not a
    jump)."""
    dt, dq = np.maximum(np.diff(t), 1e-6), np.diff(q)
    speed = dq / dt
    before, after = np.r_[0.0, speed[:-1]], np.r_[speed[1:], 0.0]
    sign = np.sign(dq)
    beside = np.maximum(np.maximum(before * sign, after * sign), 0.0)
    back = np.minimum(np.r_[0.0, dq[:-1]] * sign, np.r_[dq[1:], 0.0] * sign) < -0.5 * np.abs(dq)
    return np.where(back, 0.0, np.maximum(np.abs(speed) - beside, 0.0) * np.minimum(dt, 2 * np.median(dt)))


def repeated_stretches(
    runs: Sequence[Run], joint: str, targets: Sequence[Targets] | None = None
) -> list[list[tuple[int, int]]]:
    """Return of each run, (first, last) number of the joint's readings in the stretches in which they are old ones;
    `last` is the last old one. Runs without the joint have none. targets: of each run, where they are found already."""
    out: list[list[tuple[int, int]]] = [[] for _ in runs]
    stood: dict[int, list[tuple[int, int]]] = {}
    for k, run in enumerate(runs):
        if joint in run.joints and len(run.t) >= 20:
            t, q = run.readings(run.joints.index(joint))
            stood[k] = [(a, b) for a, b in rests(q) if b + 1 < len(q) and t[b] - t[a] >= SIGNAL.long]
    if not any(stood.values()):
        return out
    seen: list[tuple[int, int, int, float, float]] = []  # run, first, last, pulse at its end, way of the target
    pulse, spans = [], []
    for k, long in stood.items():
        run, j = runs[k], runs[k].joints.index(joint)
        on = slice(None) if run.read is None else run.read[:, j]
        cmd = (Targets(run) if targets is None else targets[k]).before(REACTS)[on, j]
        t, q = run.readings(j)
        size = pulses(t, q)
        spans.append(float(np.ptp(cmd)))
        for a, b in long:
            seen.append((k, a, b, float(size[b]), _way(t, cmd, a, b + 1)))
            size[b] = 0.0
        pulse.append(size)
    usual = float(max(x.max() for x in pulse))
    jump = [s for s in seen if s[3] > SIGNAL.pulse * usual]
    passed = max((s[4] for s in seen if s not in jump), default=0.0)
    for k, a, b, _, way in jump:
        if way > max(SIGNAL.passed * passed, SIGNAL.way * max(spans)):
            out[k].append((a, b))
    return out


def repeated_samples(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return [S] bool: single readings that repeat the one before in a steady motion and are made up for by the next;
    none where there are few."""
    again = repeats(t, q)
    return again if again.sum() >= max(SIGNAL.few, SIGNAL.often * len(t)) else np.zeros(len(t), bool)


# -- the rhythm of an encoder's readings ------------------------------------------------------------------------------
# An encoder that is read more seldom than it is logged: the rhythm of its readings, and the samples between them.

def common_rhythm(runs: Sequence[Run], joint: str) -> float:
    """Return s between readings of a joint that is read more seldom than it is logged, in most of the runs that can
    tell; 0 else."""
    told = [rhythm(*r.readings(r.joints.index(joint))) for r in runs if joint in r.joints]
    told = [x for x in told if not np.isnan(x)]
    slow = [x for x in told if x > 0]
    return float(np.median(slow)) if slow and len(slow) > 0.5 * len(told) else 0.0


def rhythm(t: np.ndarray, q: np.ndarray) -> float:
    """Return s from one reading to the next of an encoder that is read at a slower rate than it is logged; 0 where each
    sample is a reading of its own, NaN where it moves too little to tell.

    Such a position leaps, by several of its smallest steps within one sample, at the beats of one rhythm. A joint that
    turns slowly past a coarse encoder's steps has a rhythm but no leaps, one that sticks and slips leaps but in no
    rhythm."""
    change = np.flatnonzero(np.diff(q) != 0) + 1
    if len(change) < SIGNAL.anew:
        return float("nan")
    size, since = np.abs(q[change] - q[change - 1]), np.diff(t[change])
    leap, usual = t[change[size > SIGNAL.leap * size.min()]], float(np.median(since))
    logged = float(np.median(np.diff(t)))
    if len(leap) < SIGNAL.leaps * len(change) or usual < SIGNAL.seldom * logged:
        return 0.0
    if np.mean(since < 0.7 * usual) > SIGNAL.between:  # it moves between its leaps
        return 0.0
    if len(leap) < SIGNAL.anew:
        return float("nan")
    period, turn = _beat(leap, usual, 0.1)
    # a reading is seen up to a sample after it was made: evenly spread, such turns have a mean as long as a sinc
    return period if np.abs(turn) > SIGNAL.rhythm * np.sinc(logged / period) else 0.0


def between_readings(t: np.ndarray, q: np.ndarray, period: float) -> np.ndarray:
    """Return [S] bool: samples that repeat the last reading of an encoder that is read every `period` s. New readings
    are those that differ from the one before and, at the beats without one, the sample next to it."""
    change = np.flatnonzero(np.diff(q) != 0) + 1
    old = np.ones(len(t), bool)
    old[change] = False
    first = float(t[0])
    if len(change):
        period, turn = _beat(t[change], period, 0.01)
        first = float(np.angle(turn)) / (2 * np.pi) * period
    beats = first + period * np.arange(np.ceil((t[0] - first) / period), np.floor((t[-1] - first) / period) + 1)
    if len(change):
        i = np.clip(np.searchsorted(t[change], beats), 1, max(len(change) - 1, 1))
        near = t[change[np.stack([i - 1, np.minimum(i, len(change) - 1)])]]
        beats = beats[np.abs(near - beats).min(0) > 0.4 * period]
    old[np.clip(np.searchsorted(t, beats), 0, len(t) - 1)] = False
    return old


def own_readings(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return [S] bool: finite samples, of an encoder that is read more seldom than it is logged the new ones."""
    own = np.isfinite(q)
    period = rhythm(t[own], q[own]) if own.sum() > 2 else 0.0
    if period > 0:
        own[own] = ~between_readings(t[own], q[own], period)
    return own


def _beat(t: np.ndarray, period: float, within: float) -> tuple[float, complex]:
    """Return (period within a share of the given one with which times t are most in step, mean of their turns round
    it)."""
    # at neighbouring ones the first and the last time are a sixteenth of a turn apart
    n = int(32 * within * (t[-1] - t[0]) / period) + 3
    periods = period * np.linspace(1 - within, 1 + within, min(n, 4001))
    turns = np.exp(2j * np.pi * t[None] / periods[:, None]).mean(1)
    best = int(np.argmax(np.abs(turns)))
    return float(periods[best]), complex(turns[best])
