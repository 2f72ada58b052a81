"""Inverse dynamics: what lies behind the motor, from the recorded motor torque alone, whatever the firmware did.

    torque = body + inertia * a + viscous * v + coulomb * sign(v) + offset + gravity's share    (IDIM-LS:
                                                            Gautier, Janot, Vandanjon 2013)

with the body's torque from the MuJoCo model along the measured motion of all joints (`body_torque.py`), so that coupled
joints and gravity are no hindrance. Linear, hence at once and without a start; it needs a logged torque of 100 Hz or
more. How much is filtered away follows from the data: a second derivative is noise above what moves. Further effects
are named one after another, each only where it helps on quarters of the recordings that its fit has not seen; what is
kept out only judges them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from dexsim import intervals
from dexsim.gap.effects.load_friction import LoadFriction
from dexsim.gap.effects.stribeck_friction import StribeckFriction
from dexsim.gap.rules import SEARCH, TORQUE
from dexsim.gap.search import body_torque
from dexsim.gap.search.body_torque import WEIGHT, Columns, columns_of, least, misfit, solved, sums, unphysical

DRAWS = 300  # of a bootstrap
QUARTERS = 4  # of a recording, each left out in turn
BY_DIRECTION, SQUARE, LAG, STRIBECK = (
    "viscous friction that differs by direction",
    "friction with the square of the speed",
    "lag",
    StribeckFriction.id,
)
LOAD = LoadFriction.id
GIVES = "dry friction that gives way before it slides"
DISTANCES = (3e-5, 1e-4, 3e-4, 1e-3, 3e-3)  # of the whole motion: over which it may give way (P. Dahl 1968)
SPEEDS = (0.02, 0.04, 0.08, 0.14, 0.2, 0.3)  # of the top speed: where Stribeck's excess may be down to 1/e


@dataclass
class Named:
    """One further effect. text: as `Inverse.extra` names it; value, low, high (90 %) of its coefficients; share of the
    bootstraps in which it was the best to add; residual rms before and after on the recording kept out (N.m, N for a
    slide)."""

    text: str
    value: float
    low: float
    high: float
    share: float
    rival: str
    before: float
    after: float

    @property
    def effect(self) -> str:
        """Its id in the catalogue; empty where it has none."""
        return _effect(self.text)

    @property
    def speed(self) -> float:
        """v_s of a Stribeck excess."""
        return float(self.text.split()[-1].rstrip(")")) if self.effect == STRIBECK else 0.0


@dataclass
class Inverse:
    """value, low, high by `NAMES` (90 %, block bootstrap), in kg.m2, N.m.s/rad, N.m (kg, N.s/m, N for a slide), all but
    the inertia beyond the model's, and by `WEIGHT` where gravity pulls; residual: rms of what is left over the rms of
    the torque. extra: (one further effect alone, share of the residual's rms it removes); named: further effects one
    after another; full: `NAMES` fitted with those of them that the catalogue has. refused: figures that came out
    negative where nothing can be, with the reason; they are 0 in `value`, the rest refitted."""

    value: dict[str, float]
    low: dict[str, float]
    high: dict[str, float]
    residual: float
    extra: list[tuple[str, float]]
    named: list[Named] = field(default_factory=list)
    full: dict[str, float] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)
    cutoff: float = 0.0  # Hz, of the filter


def identify(
    t: np.ndarray, q: np.ndarray, torque: np.ndarray, seed: int = 0, test: tuple[np.ndarray, ...] | None = None
) -> Inverse:
    """From times [n] s, positions [n] and motor torques [n] of one joint without gravity. test: (t, q, torque) of a
    recording that only judges the further effects. Raises ValueError for fewer than 200 samples."""
    if len(t) < 200:
        raise ValueError(f"{len(t)} samples are too few for inverse dynamics (200)")

    def at(cutoff: float) -> tuple[Columns, Columns]:
        given = [
            body_torque.motion(x[0], x[1][:, None], x[2][:, None], cutoff)
            for x in ((t, q, torque), *([] if test is None else [test]))
        ]
        made = [columns_of([(m, None)], 0) for m in given]
        return made[0], made[-1]

    return solve(at, body_torque.highest(t), seed)


def solve(at: Callable[[float], tuple[Columns, Columns]], top: float, seed: int = 0) -> Inverse:
    """From what `at` makes of the fitted and of the judging recordings at a cutoff [Hz], from `top` down while halving
    it sheds noise."""
    cutoff, (own, other) = top, at(top)
    while 0.5 * cutoff >= body_torque.LEAST:
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
    further = _further(own)
    mine, theirs = ({n: c(d) for n, c in further.items()} for d in (own, other))
    before = np.std(other.u - other.X @ theta)
    extra = []
    for name in further:
        more = least(np.column_stack([X, mine[name]]), u)
        extra.append((name, float(1 - np.std(other.u - np.column_stack([other.X, theirs[name]]) @ more) / before)))
    named, full = _name(own, other, mine, theirs, rng)
    left = float(np.std(u - X @ theta) / max(np.std(own.torque), 1e-12))
    pack = lambda x: {n: 0.0 for n in refused} | own.pack(x)  # noqa: E731
    return Inverse(
        pack(theta), pack(low), pack(high), left, sorted(extra, key=lambda e: -e[1]), named, pack(full), refused, cutoff
    )


def _not_weighed(d: Columns) -> list[str]:
    """Factors on gravity that these recordings tell worse than a model does (each half second one reading of it)."""
    at = {n: d.names.index(n) for n in WEIGHT if n in d.names}
    reach = {n: float(np.std(d.X[:, k])) * np.sqrt(d.blocks.max() + 1.0) for n, k in at.items()}
    return [n for n in at if max(reach.values()) * TORQUE.weighed < misfit(d.without(list(at)))]


def _name(own, other, mine, theirs, rng) -> tuple[list[Named], np.ndarray]:
    """Further effects in the order in which they help on quarters left out, and the coefficients with the
    catalogue's."""
    chosen: list[str] = []
    out: list[tuple[str, float, str]] = []
    X, Y, base = own.X, other.X, own.X.shape[1]
    quarter = np.minimum(np.arange(len(own.u)) * QUARTERS // len(own.u), QUARTERS - 1)
    count = int(own.blocks.max()) + 1

    def left_out(A: np.ndarray) -> np.ndarray:
        """[blocks] squared residual, each quarter with coefficients of the others."""
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
            if _sensible(name, c[-1], own.pack(c)):
                tried[name] = left_out(A)
        if not tried:
            break
        best = min(tried, key=lambda n: tried[n].sum())
        kinds = {k: min((n for n in tried if _kind(n) == k), key=lambda n: tried[n].sum()) for k in map(_kind, tried)}
        each = (now - tried[best], *(tried[n] for n in kinds.values()))
        gained, *table = intervals.draws(each, lambda *x, axis: np.stack([one.sum(axis) for one in x]), rng, DRAWS)
        if tried[best].sum() > (1 - TORQUE.further) * now.sum() or np.quantile(gained, TORQUE.chance) <= 0:
            break
        wins = dict(zip(kinds, (np.argmin(table, 0)[None] == np.arange(len(kinds))[:, None]).mean(1), strict=True))
        rival = max((k for k in wins if k != _kind(best)), key=wins.get, default="")
        out.append((best, float(wins[_kind(best)]), kinds.get(rival, "")))
        chosen.append(best)
        now, X, Y = tried[best], np.column_stack([X, mine[best]]), np.column_stack([Y, theirs[best]])
    # what the catalogue has no name for must not lend its trace to what has one
    known = [n for n in chosen if _effect(n)]
    theta, low, high = _intervals(np.column_stack([own.X, *(mine[n] for n in known)]), own.u, own.blocks, rng)
    size = {n: (theta[base + i], low[base + i], high[base + i]) for i, n in enumerate(known)}
    all_, below, above = _intervals(X, own.u, own.blocks, rng)
    named = []
    for i, (name, share, rival) in enumerate(out):
        with_, without = (least(X[:, :k], own.u) for k in (base + 1 + i, base + i))
        a, b = np.std(other.u - Y[:, : base + i] @ without), np.std(other.u - Y[:, : base + 1 + i] @ with_)
        c = size.get(name, (all_[base + i], below[base + i], above[base + i]))
        named.append(Named(name, *map(float, c), share, rival, float(a), float(b)))
    return named, theta


def _effect(name: str) -> str:
    return {BY_DIRECTION: "viscous_friction", LAG: "lag", STRIBECK: STRIBECK, LOAD: LOAD}.get(_kind(name), "")


def _kind(name: str) -> str:
    return name.split(" (")[0]


def _sensible(name: str, c: float, theta: dict[str, float]) -> bool:
    """Whether a coefficient can be what it is called: a lag is late, an excess is more, and what gives way is friction
    that is there."""
    if name == LAG:
        return 0 < c < TORQUE.lag * abs(theta["inertia"])
    if _kind(name) == GIVES:
        return 0 < c < 2 * theta.get("coulomb_friction", 0.0)
    if name == LOAD:
        return 0 < c < 1 and theta.get("coulomb_friction", 0.0) >= 0
    return c > 0 if _kind(name) == STRIBECK else True


def _intervals(
    X: np.ndarray, u: np.ndarray, blocks: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least squares and 90 % by a block bootstrap."""
    count = int(blocks.max()) + 1
    grams, sides = sums(X, u, blocks, count)
    weight = intervals.weights(count, rng, DRAWS)
    draws = solved(np.einsum("db,bkl->dkl", weight, grams), weight @ sides)
    return least(X, u), *np.quantile(draws, [0.05, 0.95], axis=0)


def _further(own: Columns) -> dict:
    """One more effect each, as a column of what was filtered."""
    top, span = float(np.abs(own.v).max()), own.span
    out = {BY_DIRECTION: lambda d: np.abs(d.v), SQUARE: lambda d: d.v * np.abs(d.v), LAG: lambda d: d.rise}
    if own.loaded:
        out[LOAD] = lambda d: d.column(lambda q, v, load: np.abs(load) * np.sign(v))
    for part in SPEEDS:
        out[f"{STRIBECK} (v_s {part * top:.3g})"] = lambda d, s=part * top: d.column(
            lambda q, v, load: np.sign(v) * np.exp(-((v / s) ** 2))
        )
    for part in DISTANCES:
        out[f"{GIVES} (over {part * span:.2g})"] = lambda d, s=part * span: d.column(
            lambda q, v, load: _taken_up(q, s) - np.sign(v)
        )
    return out


def _taken_up(q: np.ndarray, distance: float) -> np.ndarray:
    """[n] share -1..1 of a dry friction that is taken up along q: dz = (1 - z sign(dq)) dq / distance, each step
    exactly."""
    z, out = 0.0, np.empty(len(q))
    steps = np.diff(q, prepend=q[0])
    keep = np.exp(-np.abs(steps) / distance)
    for i, (step, k) in enumerate(zip(steps, keep, strict=True)):
        way = 1.0 if step > 0 else -1.0
        z = way + (z - way) * k
        out[i] = z
    return out

