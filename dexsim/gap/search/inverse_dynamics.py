"""Inverse dynamics: what lies behind the motor, from the recorded motor torque alone, whatever the firmware did.

    torque = body + inertia * a + viscous * v + coulomb * sign(v) + offset + gravity's share    (IDIM-LS:
                                                            Gautier, Janot, Vandanjon 2013)

with the body's torque from the MuJoCo model along the measured motion of all joints (`body`), so that coupled
joints and gravity are no hindrance. Linear, hence at once and without a start; it needs a logged torque of 100 Hz or
more. How much is filtered away follows from the data: a second derivative is noise above what moves. Further effects
are named one after another, each only where it helps on quarters of the recordings that its fit has not seen; what is
held out only judges them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np
from scipy.signal import butter, filtfilt

from dexsim import intervals
from dexsim.gap.effects.catalogue import BY_TORQUE
from dexsim.gap.plant.columns import SERIES_INDEX
from dexsim.gap.plant.lines import on_lines
from dexsim.gap.plant.mechanics import of_motion
from dexsim.gap.read import BLOCK, Run
from dexsim.gap.rules import BELIEF, SEARCH, TORQUE

# -- the body's torque ------------------------------------------------------------------------------------------------
# The recorded torque of a joint beside what the model's rigid body asks for along the recorded motion, and what is left
# as columns of a linear least squares: what friction, inertia, offset and gravity's factors would make of it.
#
# Position and torque pass the same low-pass forth and back (Butterworth, 4th order), so that both are late by nothing;
# the body's torque is MuJoCo's inverse dynamics M(q) a + c(q, v) + g(q) less its passive forces, with the model's own
# dry friction in the joints.

CUTOFF = 0.2  # of half the sampling rate, and no more than
TOP = 60.0  # Hz: of the cutoff, too
LEAST = 5.0  # Hz: of the cutoff
EDGE, SWING = 50, 2.0  # samples, and periods of the cutoff, at each end in which the filter still swings in
# Hz at which the model is evaluated; inertia and bias change slowly, accelerations keep their own rate
MODEL_RATE = 250.0
RATE = 100.0  # Hz: readings slower than this are too few for a second derivative
PER_CUTOFF = 10.0  # samples kept a period of the filter's cutoff
NAMES = ("inertia", "viscous_friction", "coulomb_friction", "offset")
WEIGHT = ("gravity", "gravity_across")  # factors on gravity's torque, beyond the model's, that are fitted beside them


@dataclass
class Motion:
    """Even times t [n] s; filtered positions q, speeds v, accelerations a and torques u [n, J]; step [s]; cutoff
    [Hz]."""

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    u: np.ndarray
    step: float
    cutoff: float

    @property
    def edge(self) -> int:
        """Samples at each end that are not to be used."""
        return max(EDGE, int(SWING / (self.cutoff * self.step)))

    def smooth(self, x: np.ndarray) -> np.ndarray:
        """Return x [n] through the filter that the torque passed: what jumps with the sign of a speed must pass it as
        well."""
        return low_pass(x, self.cutoff, self.step)


@dataclass
class Body:
    """By sample and joint [n, J]: torque that the model's body asks for (positive along positive motion), of it
    gravity's, gravity's a quarter turn on (what a shifted centre of mass adds), and the inertia about the joint. N.m,
    N.m, N.m, kg.m2 (N, N, N, kg for a slide)."""

    torque: np.ndarray
    gravity: np.ndarray
    across: np.ndarray
    inertia: np.ndarray


def highest(t: np.ndarray) -> float:
    """Return the highest cutoff [Hz] that readings at times t [n] s allow."""
    return min(CUTOFF * 0.5 / float(np.median(np.diff(t))), TOP)


def motion(t: np.ndarray, q: np.ndarray, torque: np.ndarray, cutoff: float) -> Motion:
    """From times [S], positions and torques [S, J] as recorded."""
    step = float(np.median(np.diff(t)))
    even = np.arange(t[0], t[-1], step)
    through = lambda x: np.stack([low_pass(np.interp(even, t, c), cutoff, step) for c in x.T], 1)  # noqa: E731
    q, u = through(q), through(torque)
    v = np.gradient(q, step, axis=0)
    return Motion(even, q, v, np.gradient(v, step, axis=0), u, step, cutoff)


def low_pass(x: np.ndarray, cutoff: float, step: float) -> np.ndarray:
    """Return x [n], every `step` s, without what is faster than the cutoff [Hz]: forth and back, so that it is not
    late."""
    b, a = butter(4, cutoff * 2 * step)
    return filtfilt(b, a, x)


def body(model: mujoco.MjModel, gravity: np.ndarray, joints: Sequence[str], m: Motion) -> Body:
    """Return of `joints` (the motion's columns) in world gravity [3] m/s2."""
    every = max(int(round(1.0 / (MODEL_RATE * m.step))), 1)
    rows = np.unique(np.r_[np.arange(0, len(m.t), every), len(m.t) - 1])
    series, own = of_motion(model, joints, gravity, m.q[rows], m.v[rows], m.a[rows], False)
    names = ("inertia", "rest", "gravity_cos", "gravity_sin")
    inertia, rest, pull, across = (on_lines(m.t, m.t[rows], series[:, :, SERIES_INDEX[n]].T) for n in names)
    torque = inertia * m.a + rest + pull + m.v * [c.damping for c in own]
    for j in np.flatnonzero([c.friction > 0 for c in own]):
        torque[:, j] += own[j].friction * m.smooth(np.sign(m.v[:, j]))
    return Body(torque, pull, across, inertia)


@dataclass(frozen=True)
class Stretch:
    """A recorded motion with what the model's body asks for along it, and the span [s from its start] that is used,
    None for all."""

    motion: Motion
    body: Body
    span: tuple[float, float] | None = None


@dataclass
class Piece:
    """One recording at its full rate: q, v, load (the body's torque) [n] and which samples are kept."""

    motion: Motion
    q: np.ndarray
    v: np.ndarray
    load: np.ndarray
    keep: np.ndarray


@dataclass
class Columns:
    """One joint's pieces in a row, thinned to what the filter leaves: columns X [m, K] by `names`, torque beyond the
    body u [m], speeds v [m], what a lag of one second would add per unit of inertia `rise` [m], the torque itself [m],
    blocks [m]; inertia of the model (median), extent of the motion, whether gravity pulls, seconds in all."""

    pieces: list[Piece]
    names: tuple[str, ...]
    X: np.ndarray
    u: np.ndarray
    v: np.ndarray
    rise: np.ndarray
    torque: np.ndarray
    blocks: np.ndarray
    inertia: float
    span: float
    loaded: bool
    seconds: float

    def column(self, f: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
        """Return [m] f(q, v, load) through the filter."""
        return np.concatenate([p.motion.smooth(f(p.q, p.v, p.load))[p.keep] for p in self.pieces])

    def without(self, names: Collection[str]) -> Columns:
        """Return the same with figures that are held at 0."""
        on = [n not in names for n in self.names]
        return replace(self, X=self.X[:, on], names=tuple(n for n in self.names if n not in names))

    def pack(self, x: np.ndarray) -> dict[str, float]:
        """Return coefficients by name, the inertia with the model's."""
        out = {n: float(y) for n, y in zip(self.names, x, strict=False)}
        return out | ({"inertia": out["inertia"] + self.inertia} if "inertia" in out else {"inertia": self.inertia})


def columns_of(given: Sequence[Stretch], j: int, efficiency: float = 1.0, loaded: bool | None = None) -> Columns:
    """Build it for joint j; given: of each recording; efficiency: of the drive, believed; loaded: whether gravity's
    factors are among the columns, by default where it matters in these recordings."""
    pieces, parts, at = [], [], 0
    inertia = float(np.median(np.concatenate([x.body.inertia[:, j] for x in given])))
    if loaded is None:
        weights = [np.abs(x.body.gravity[:, j]).max() / max(np.abs(x.motion.u[:, j]).max(), 1e-12) for x in given]
        loaded = bool(max(weights) > BELIEF.tolerance)
    for x in given:
        m, b = x.motion, x.body
        q, v, torque = m.q[:, j], m.v[:, j], efficiency * m.u[:, j]
        load = b.torque[:, j]
        keep = np.zeros(len(q), bool)
        keep[m.edge : len(q) - m.edge : max(int(1.0 / (PER_CUTOFF * m.cutoff * m.step)), 1)] = True
        if x.span is not None:
            keep &= (m.t - m.t[0] >= x.span[0]) & (m.t - m.t[0] <= x.span[1])
        columns = [m.a[:, j], v, m.smooth(np.sign(v)), np.ones(len(v))]
        if loaded:
            columns += [b.gravity[:, j], b.across[:, j]]
        rise = np.gradient(load / inertia, m.step)
        block = at + ((m.t - m.t[0]) / BLOCK).astype(int)
        at = int(block.max()) + 1
        parts.append(tuple(c[keep] for c in (np.stack(columns, 1), torque - load, v, rise, torque, block)))
        pieces.append(Piece(m, q, v, load, keep))
    X, u, v, rise, torque, block = (np.concatenate(x) for x in zip(*parts, strict=True))
    q = np.concatenate([p.q[p.keep] for p in pieces])
    seconds = sum(
        float(p.keep.sum()) * max(int(1.0 / (PER_CUTOFF * p.motion.cutoff * p.motion.step)), 1) * p.motion.step
        for p in pieces
    )
    _, block = np.unique(block, return_inverse=True)
    names = NAMES + (WEIGHT if loaded else ())
    return Columns(
        pieces, names, X, u, v, rise, torque, block, inertia, float(np.ptp(q)) if len(q) else 0.0, loaded, seconds
    )


def readable(run: Run, j: int) -> bool:
    """Return whether a run's torque of joint j can be differentiated beside its motion."""
    if (
        run.torque is None
        or not np.isfinite(run.torque[:, j]).all()
        or run.read is not None
        or len(run.t) < 2 * EDGE + 100
    ):
        return False
    return 1 / np.median(np.diff(run.t)) >= 0.97 * RATE


def moved(run: Run, model: mujoco.MjModel, cutoff: float) -> Stretch:
    """Return a run's motion beside the model's body."""
    assert run.torque is not None  # as `readable` has looked
    m = motion(run.t, run.q, np.nan_to_num(run.torque), cutoff)
    return Stretch(m, body(model, run.gravity, run.joints, m))


def sums(X: np.ndarray, u: np.ndarray, of: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return normal equations [count, K, K], [count, K] of the rows of each part `of` [m]."""
    rows = [np.flatnonzero(of == b) for b in range(count)]
    return np.stack([X[i].T @ X[i] for i in rows]), np.stack([X[i].T @ u[i] for i in rows])


def solved(grams: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Return coefficients [.., K] of normal equations [.., K, K], [.., K], columns scaled alike; 0 for a column that is
    not there."""
    scale = np.sqrt(np.maximum(np.einsum("...kk->...k", grams), 1e-300))
    scaled = grams / (scale[..., :, None] * scale[..., None, :]) + 1e-13 * np.eye(grams.shape[-1])
    return np.linalg.solve(scaled, (sides / scale)[..., None])[..., 0] / scale


def least(X: np.ndarray, u: np.ndarray) -> np.ndarray:
    return solved(X.T @ X, X.T @ u)


def misfit(d: Columns) -> float:
    return float(np.std(d.u - d.X @ least(d.X, d.u)))


def unphysical(d: Columns) -> dict[str, str]:
    """Return figures that least squares make negative where nothing can be, one after another, each with the reason."""
    out: dict[str, str] = {}
    while True:
        left = d.without(out)
        x = left.pack(least(left.X, left.u))
        negative = [n for n in ("inertia", "coulomb_friction", "viscous_friction") if n not in out and x[n] < 0]
        if not negative:
            return out
        out[negative[0]] = (
            f"the least squares give {x[negative[0]]:.3g}, and nothing has a negative {negative[0].replace('_', ' ')}"
        )


DRAWS = 300  # of a bootstrap
STRETCH = 4  # neighbouring blocks that the bootstrap of what an effect removes draws together
QUARTERS = 4  # of a recording, each left out in turn
EFFECT = {e.by_torque: e for e in BY_TORQUE}
SQUARE = "friction with the square of the speed"  # a law that the catalogue has no effect for


@dataclass
class Named:
    """One further effect. text: its law, and what that was given; value, low, high (90 %) of its coefficients; share of
    the bootstraps in which it was the best to add; residual rms before and after on the recording held out (N.m, N for
    a slide), and the share of its square that it removes there (90 %, stretches of two seconds)."""

    text: str
    value: float
    low: float
    high: float
    share: float
    rival: str
    before: float
    after: float
    removed: tuple[float, float] = (0.0, 0.0)

    @property
    def effect(self) -> str:
        """Its id in the catalogue; empty where it has none."""
        return _effect(self.text)

    @property
    def speed(self) -> float:
        """v_s of a law that has one, as its text says; else 0."""
        return float(self.text.split()[-1].rstrip(")")) if "(v_s " in self.text else 0.0


@dataclass
class Inverse:
    """value, low, high by `NAMES` (90 %, block bootstrap), in kg.m2, N.m.s/rad, N.m (kg, N.s/m, N for a slide), all but
    the inertia beyond the model's, and by `WEIGHT` where gravity pulls; residual: rms of what is left over the rms of
    the torque. named: further effects one after another; full: `NAMES` fitted with those of them that the catalogue
    has. refused: figures that came out negative where nothing can be, with the reason; they are 0 in `value`, the rest
    refitted."""

    value: dict[str, float]
    low: dict[str, float]
    high: dict[str, float]
    residual: float
    named: list[Named] = field(default_factory=list)
    full: dict[str, float] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)
    cutoff: float = 0.0  # Hz, of the filter


def solve(at: Callable[[float], tuple[Columns, Columns]], top: float, seed: int = 0) -> Inverse:
    """From what `at` makes of the fitted and of the judging recordings at a cutoff [Hz], from `top` down while halving
    it sheds noise."""
    cutoff, (own, other) = top, at(top)
    while 0.5 * cutoff >= LEAST:
        lower = at(0.5 * cutoff)
        if misfit(lower[0]) > TORQUE.shed * misfit(own):
            break
        cutoff, (own, other) = 0.5 * cutoff, lower
    believed = _not_weighed(own)
    own, other = own.without(believed), other.without(believed)
    refused = unphysical(own)
    own, other = own.without(refused), other.without(refused)
    rng = np.random.default_rng(seed)
    X, u, blocks = own.X, own.u, own.blocks
    theta, low, high = _intervals(X, u, blocks, rng)
    mine, theirs = ({n: c(d) for n, c in _further(own).items()} for d in (own, other))
    named, full, impossible = _name(own, other, mine, theirs, rng)
    left = float(np.std(u - X @ theta) / max(np.std(own.torque), 1e-12))
    pack = lambda x: {n: 0.0 for n in refused} | own.pack(x)  # noqa: E731
    return Inverse(pack(theta), pack(low), pack(high), left, named, pack(full), refused | impossible, cutoff)


def _not_weighed(d: Columns) -> list[str]:
    """Return factors on gravity that these recordings tell worse than a model does (each half second one reading of
    it)."""
    at = {n: d.names.index(n) for n in WEIGHT if n in d.names}
    reach = {n: float(np.std(d.X[:, k])) * np.sqrt(d.blocks.max() + 1.0) for n, k in at.items()}
    return [n for n in at if max(reach.values()) * BELIEF.tolerance < misfit(d.without(list(at)))]


def _name(
    own: Columns, other: Columns, mine: dict[str, np.ndarray], theirs: dict[str, np.ndarray], rng: np.random.Generator
) -> tuple[list[Named], np.ndarray, dict[str, str]]:
    """Return further effects in the order in which they help on quarters left out, the coefficients with the
    catalogue's, and effects that would have helped but cannot be what they are called, each with the reason."""
    chosen: list[str] = []
    impossible: dict[str, str] = {}
    out: list[tuple[str, float, str]] = []
    X, Y, base = own.X, other.X, own.X.shape[1]
    quarter = np.minimum(np.arange(len(own.u)) * QUARTERS // len(own.u), QUARTERS - 1)
    count = int(own.blocks.max()) + 1

    def left_out(A: np.ndarray) -> np.ndarray:
        """Return [blocks] squared residual, each quarter with coefficients of the others."""
        grams, sides = sums(A, own.u, quarter, QUARTERS)
        x = solved(grams.sum(0) - grams, sides.sum(0) - sides)
        r = own.u - np.einsum("nk,nk->n", A, x[quarter])
        return np.bincount(own.blocks, r * r, count)

    now = left_out(X)
    for _ in range(SEARCH.most):
        tried = {}
        for name, column in mine.items():
            if name in chosen or (_kind(name) in map(_kind, chosen)):
                continue
            A = np.column_stack([X, column])
            c = least(A, own.u)
            why = _refused(name, c[-1], own.pack(c))
            if why is None:
                tried[name] = left_out(A)
            elif why and left_out(A).sum() < (1 - SEARCH.least) * now.sum():
                impossible[name] = why
        if not tried:
            break
        best = min(tried, key=lambda n: tried[n].sum())
        kinds = {k: min((n for n in tried if _kind(n) == k), key=lambda n: tried[n].sum()) for k in map(_kind, tried)}
        each = (now - tried[best], *(tried[n] for n in kinds.values()))
        gained, *table = intervals.draws(each, lambda *x, axis: np.stack([one.sum(axis) for one in x]), rng, DRAWS)
        if tried[best].sum() > (1 - SEARCH.least) * now.sum() or np.quantile(gained, SEARCH.chance) <= 0:
            break
        wins = dict(zip(kinds, (np.argmin(table, 0)[None] == np.arange(len(kinds))[:, None]).mean(1), strict=True))
        rival = max((k for k in wins if k != _kind(best)), key=wins.__getitem__, default="")
        out.append((best, float(wins[_kind(best)]), kinds.get(rival, "")))
        chosen.append(best)
        now, X, Y = tried[best], np.column_stack([X, mine[best]]), np.column_stack([Y, theirs[best]])
    # what the catalogue has no name for must not lend its trace to what has one
    known = [n for n in chosen if _effect(n)]
    both = least(np.column_stack([own.X, *(mine[n] for n in known)]), own.u)
    for i, wrong in enumerate(known):
        if not _refused(wrong, both[base + i], own.pack(both)):
            continue
        rest = {n: c for n, c in mine.items() if n != wrong}
        named, theta, more = _name(own, other, rest, theirs, rng)
        others = " and ".join(_kind(n).replace("_", " ") for n in known if n != wrong)
        return named, theta, impossible | more | {wrong: f"beside {others} one direction's would be negative"}
    theta, low, high = _intervals(np.column_stack([own.X, *(mine[n] for n in known)]), own.u, own.blocks, rng)
    size = {n: (theta[base + i], low[base + i], high[base + i]) for i, n in enumerate(known)}
    all_, below, above = _intervals(X, own.u, own.blocks, rng)
    named = []
    for i, (name, share, rival) in enumerate(out):
        with_, without = (least(X[:, :k], own.u) for k in (base + 1 + i, base + i))
        before, after = other.u - Y[:, : base + i] @ without, other.u - Y[:, : base + 1 + i] @ with_
        a, b = np.std(before), np.std(after)
        value, least_, most = size.get(name, (all_[base + i], below[base + i], above[base + i]))
        gain = _removed(before - before.mean(), after - after.mean(), other.blocks)
        named.append(Named(name, float(value), float(least_), float(most), share, rival, float(a), float(b), gain))
    return named, theta, {n: why for n, why in impossible.items() if n not in chosen}


def _removed(before: np.ndarray, after: np.ndarray, blocks: np.ndarray) -> tuple[float, float]:
    """Return 90 % interval of the share of the squared residual `before` [m] that is gone in `after`, by a bootstrap
    over stretches of neighbouring blocks."""
    was = np.bincount(blocks, before**2)
    less = was - np.bincount(blocks, after**2)
    share = less[intervals.stretches(len(was), STRETCH, 0, DRAWS)].sum(1) / max(float(was.sum()), 1e-300)
    return float(np.quantile(share, 0.05)), float(np.quantile(share, 0.95))


def _effect(name: str) -> str:
    e = EFFECT.get(_kind(name))
    return e.id if e is not None and e.named_by_torque else ""


def _kind(name: str) -> str:
    return name.split(" (")[0]


def _refused(name: str, c: float, theta: dict[str, float]) -> str | None:
    """Return why a coefficient cannot be what it is called; empty where that is passed over, None where it can."""
    effect = EFFECT.get(_kind(name))
    return None if effect is None else effect.refused_by_torque(c, theta, LEAST)


def _intervals(
    X: np.ndarray, u: np.ndarray, blocks: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return least squares and 90 % by a block bootstrap."""
    count = int(blocks.max()) + 1
    grams, sides = sums(X, u, blocks, count)
    weight = intervals.weights(count, rng, DRAWS)
    draws = solved(np.einsum("db,bkl->dkl", weight, grams), weight @ sides)
    return least(X, u), *np.quantile(draws, [0.05, 0.95], axis=0)


def _further(own: Columns) -> dict[str, Callable[[Columns], np.ndarray]]:
    """Return one more effect each, as a column of what was filtered, by its law (`_kind`) and what it was given."""
    laws = [e.torque_columns(own) for e in BY_TORQUE]
    laws.insert(1, {SQUARE: lambda d: d.v * np.abs(d.v)})  # beside the other friction that grows with speed
    return {name: column for law in laws for name, column in law.items()}
