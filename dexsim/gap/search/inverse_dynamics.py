"""Inverse dynamics: what lies behind the motor, from the recorded motor torque alone, whatever the firmware did.

    torque = inertia * a + viscous * v + coulomb * sign(v) + offset          (IDIM-LS: Gautier, Janot, Vandanjon 2013)

Position and torque pass the same low-pass forth and back, so that both are late by nothing. Linear, hence at once and without
a start; it needs a logged torque, and readings fast beside the motion. Further effects are named one after another, each only
where it helps on quarters of the recording that its fit has not seen; a recording kept out only judges them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.signal import butter, filtfilt

CUTOFF = 0.2  # of half the sampling rate, and no more than TOP Hz
TOP = 60.0
RATE = 200.0  # Hz: readings slower than this are too few for a second derivative
DRAWS = 300
BLOCK = 0.5  # s
NAMES = ("inertia", "viscous_friction", "coulomb_friction", "offset")
QUARTERS = 4
LEAST = 0.12  # of the squared residual on the quarters left out: what a further effect must remove
MOST = 4
LATE = 0.02  # s: a torque that acts later than this is no drive's lag
BY_DIRECTION, SQUARE, LAG, STRIBECK = "viscous friction that differs by direction", "friction with the square of the speed", "lag", "stribeck_friction"
GIVES = "dry friction that gives way before it slides"
DISTANCES = (3e-5, 1e-4, 3e-4, 1e-3, 3e-3)  # of the whole motion: over which it may give way (P. Dahl 1968)
SPEEDS = (0.02, 0.04, 0.08, 0.14, 0.2, 0.3)  # of the top speed: where Stribeck's excess may be down to 1/e


@dataclass
class Named:
    """One further effect. text: as `Inverse.extra` names it; value, low, high (90 %) of its coefficients; share of the bootstraps
    in which it was the best to add; residual rms before and after on the recording kept out (N.m, N for a slide)."""

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
    """value, low, high [4] by `NAMES` (90 %, block bootstrap), in kg.m2, N.m.s/rad, N.m (kg, N.s/m, N for a slide); residual:
    rms of what is left over the rms of the torque. extra: (one further effect alone, share of the residual's rms it removes);
    named: further effects one after another; full: `NAMES` fitted with those of them that the catalogue has."""

    value: dict[str, float]
    low: dict[str, float]
    high: dict[str, float]
    residual: float
    extra: list[tuple[str, float]]
    named: list[Named] = field(default_factory=list)
    full: dict[str, float] = field(default_factory=dict)


def identify(t: np.ndarray, q: np.ndarray, torque: np.ndarray, seed: int = 0, test: tuple[np.ndarray, ...] | None = None) -> Inverse:
    """From times [n] s, positions [n] and motor torques [n] of one joint without gravity. test: (t, q, torque) of a recording
    that only judges the further effects. Raises ValueError for fewer than 200 samples."""
    if len(t) < 200:
        raise ValueError(f"{len(t)} samples are too few for inverse dynamics (200)")
    own = _filtered(t, q, torque)
    other = own if test is None else _filtered(*test)
    rng = np.random.default_rng(seed)
    X, u, blocks = own.X, own.u, own.blocks
    theta, low, high = _intervals(X, u, blocks, rng)
    columns = _further(float(np.abs(own.v).max()), float(np.ptp(q)))
    mine, theirs = ({n: c(d) for n, c in columns.items()} for d in (own, other))
    before = np.std(other.u - other.X @ theta)
    extra = []
    for name in columns:
        more = np.linalg.lstsq(np.column_stack([X, mine[name]]), u, rcond=None)[0]
        extra.append((name, float(1 - np.std(other.u - np.column_stack([other.X, theirs[name]]) @ more) / before)))
    pack = lambda x: {n: float(y) for n, y in zip(NAMES, x, strict=False)}  # noqa: E731
    named, full = _name(own, other, mine, theirs, rng)
    return Inverse(pack(theta), pack(low), pack(high), float(np.std(u - X @ theta) / np.std(u)), sorted(extra, key=lambda e: -e[1]), named, pack(full))


def _name(own, other, mine, theirs, rng) -> tuple[list[Named], np.ndarray]:
    """Further effects in the order in which they help on quarters left out, and the coefficients with the catalogue's."""
    chosen: list[str] = []
    out: list[tuple[str, float, str]] = []
    X, Y = own.X, other.X
    quarter = np.minimum(np.arange(len(own.u)) * QUARTERS // len(own.u), QUARTERS - 1)
    count = int(own.blocks.max()) + 1

    def left_out(A: np.ndarray) -> np.ndarray:
        """[blocks] squared residual, each quarter with coefficients of the others."""
        r = np.empty(len(own.u))
        for k in range(QUARTERS):
            on = quarter == k
            r[on] = own.u[on] - A[on] @ np.linalg.lstsq(A[~on], own.u[~on], rcond=None)[0]
        return np.bincount(own.blocks, r * r, count)

    now = left_out(X)
    for _ in range(MOST):
        tried = {}
        for name, column in mine.items():
            if name in chosen or (_kind(name) in map(_kind, chosen)):
                continue
            A = np.column_stack([X, column])
            c = np.linalg.lstsq(A, own.u, rcond=None)[0]
            if _sensible(name, c[-1], c):
                tried[name] = left_out(A)
        if not tried:
            break
        best = min(tried, key=lambda n: tried[n].sum())
        pick = rng.integers(0, count, (DRAWS, count))
        if tried[best].sum() > (1 - LEAST) * now.sum() or np.quantile((now - tried[best])[pick].sum(1), 0.03) <= 0:
            break
        kinds = {k: min((n for n in tried if _kind(n) == k), key=lambda n: tried[n].sum()) for k in map(_kind, tried)}
        table = np.stack([tried[n][pick].sum(1) for n in kinds.values()])
        wins = dict(zip(kinds, (table.argmin(0)[None] == np.arange(len(kinds))[:, None]).mean(1), strict=True))
        rival = max((k for k in wins if k != _kind(best)), key=wins.get, default="")
        out.append((best, float(wins[_kind(best)]), kinds.get(rival, "")))
        chosen.append(best)
        now, X, Y = tried[best], np.column_stack([X, mine[best]]), np.column_stack([Y, theirs[best]])
    # what the catalogue has no name for must not lend its trace to what has one
    known = [n for n in chosen if _effect(n)]
    theta, low, high = _intervals(np.column_stack([own.X, *(mine[n] for n in known)]), own.u, own.blocks, rng)
    size = {n: (theta[4 + i], low[4 + i], high[4 + i]) for i, n in enumerate(known)}
    all_, below, above = _intervals(X, own.u, own.blocks, rng)
    named = []
    for i, (name, share, rival) in enumerate(out):
        with_, without = (np.linalg.lstsq(X[:, :k], own.u, rcond=None)[0] for k in (5 + i, 4 + i))
        a, b = np.std(other.u - Y[:, : 4 + i] @ without), np.std(other.u - Y[:, : 5 + i] @ with_)
        c = size.get(name, (all_[4 + i], below[4 + i], above[4 + i]))
        named.append(Named(name, *map(float, c), share, rival, float(a), float(b)))
    return named, theta


def _effect(name: str) -> str:
    return {BY_DIRECTION: "viscous_friction", LAG: "lag", STRIBECK: STRIBECK}.get(_kind(name), "")


def _kind(name: str) -> str:
    return name.split(" (")[0]


def _sensible(name: str, c: float, theta: np.ndarray) -> bool:
    """Whether a coefficient can be what it is called: a lag is late, an excess is more, and what gives way is friction that is there."""
    if name == LAG:
        return 0 < c < LATE * abs(theta[0])
    if _kind(name) == GIVES:
        return 0 < c < 2 * theta[2]
    return c > 0 if _kind(name) == STRIBECK else True


def _intervals(X: np.ndarray, u: np.ndarray, blocks: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least squares and 90 % by a block bootstrap."""
    count = int(blocks.max()) + 1
    grams = np.stack([X[blocks == b].T @ X[blocks == b] for b in range(count)])
    sides = np.stack([X[blocks == b].T @ u[blocks == b] for b in range(count)])
    pick = rng.integers(0, count, (DRAWS, count))
    draws = np.stack([np.linalg.lstsq(grams[i].sum(0), sides[i].sum(0), rcond=None)[0] for i in pick])
    return np.linalg.lstsq(X, u, rcond=None)[0], *np.quantile(draws, [0.05, 0.95], axis=0)


def found(cases, runs, train: list[int], test: list[int], seed: int = 0) -> list[tuple]:
    """(case, Inverse, names of the recordings that judged its further effects) of each joint that gravity and other joints do not
    load and whose motor torque was logged fast enough, from the first such training recording."""
    out = []
    for case in cases:
        seen = lambda r, j=case.index: (runs[r].t, runs[r].q[:, j], runs[r].torque[:, j])  # noqa: E731
        good = lambda r: runs[r].torque is not None and np.isfinite(seen(r)[2]).all() and len(runs[r].t) >= 2000  # noqa: B023, E731
        first = next((r for r in train if good(r)), None)
        if first is None or case.scales.gravity > 0.02 * case.scales.tau or 1 / np.median(np.diff(runs[first].t)) < RATE or case.scales.others:
            continue
        other = next((r for r in test if r not in train and good(r)), None)
        out.append((case, identify(*seen(first), seed, None if other is None else seen(other)), [] if other is None else [runs[other].name]))
    return out


def texts(given: Sequence[tuple]) -> list[str]:
    """What `found` gave, in words."""
    out = []
    for case, x, judged in given:
        said = ", ".join(f"{n.replace('_', ' ')} {x.value[n]:.4g} ({x.low[n]:.4g} to {x.high[n]:.4g})" for n in NAMES)
        text = f"{case.joint}: by the recorded motor torque alone: {said}; {100 * x.residual:.1f} % of the torque is left"
        where = " in the recording kept out" if judged else ""
        for k, n in enumerate(x.named):
            size = f" ({1e3 * n.value / x.full['inertia']:.2g} ms)" if n.effect == LAG else ""
            text += f"; {'then ' if k else ''}{n.text}{size} takes {100 * (1 - n.after / n.before):.0f} % of that away{where}"
        out.append(text)
    return out


def believe(given: Sequence[tuple]) -> list[str]:
    """Writes what the torque tells into the belief of what was unknown, so that the search in closed loop starts from it; in words.

    Friction of which nothing is believed, and then the inertia too, within what the residuals allow.
    """
    from dexsim.actuator.columns import INDEX as SERVO
    from dexsim.gap.plant.case import BELIEF

    said = []
    for case, x, _ in given:
        open_ = [n for n in ("viscous_friction", "coulomb_friction") if n in case.unknown]
        if not open_ or x.value["coulomb_friction"] <= 0 or x.value["viscous_friction"] < 0:
            continue
        values = {n: (x.value[n], max(x.low[n], 0.0), x.high[n]) for n in open_}
        if "coulomb_friction" in open_ and case.scales.nominal["friction_asymmetry"] == 0:
            per = 2.0 / x.value["coulomb_friction"]
            values["friction_asymmetry"] = tuple(float(np.clip(per * v, -2, 2)) for v in (x.value["offset"], x.low["offset"], x.high["offset"]))
        for name, (value, low, high) in values.items():
            for row in case.plant.nominal:
                row[SERVO[name]] = value
            case.scales.nominal[name] = value
            case.ranges[name] = (low, max(high, low + 1e-9))
        case.unknown = tuple(n for n in case.unknown if n not in open_)
        case.told = True
        factor = x.value["inertia"] / max(case.scales.inertia, 1e-12)
        if abs(factor - 1) < BELIEF:
            half = max(0.5 * (x.high["inertia"] - x.low["inertia"]) / x.value["inertia"], 1e-3)
            case.factors["inertia"] = (factor - half, factor + half)
        said.append(f"{case.joint}: {' and '.join(n.replace('_', ' ') for n in open_)} was unknown and is taken from the recorded motor torque")
    return said


def write(given: Sequence[tuple], servo, joints: Sequence[str]) -> None:
    """Writes what was believed by the torque into the servo table that is handed on, for `joints`, where nothing else was fitted."""
    for case, _, _ in given:
        for name in ("viscous_friction", "coulomb_friction", "friction_asymmetry") if case.joint in joints else ():
            if name in case.ranges and (name == "friction_asymmetry" or servo.value(case.joint, name).unknown):
                servo.set(case.joint, name, round(case.scales.nominal[name], 9), *(round(x, 9) for x in case.ranges[name]))


def findings(given: Sequence[tuple], unknown: Sequence[str], runs, train: list[int]) -> list[dict]:
    """The further effects as findings of `diagnosis.json`, for joints of which nothing of the friction was believed (`unknown`)."""
    from dexsim.gap.effects.catalogue import EFFECTS
    from dexsim.gap.judge.errors import intervals_of

    out = []
    for case, x, judged in given:
        force, length = ("N", "m") if case.scales.slide else ("N.m", "rad")
        for n in x.named if case.joint in unknown and judged else ():
            if not n.effect:
                continue
            entry = lambda v, lo, hi, unit: {"value": v, "low": min(lo, hi), "high": max(lo, hi), "unit": unit}  # noqa: E731
            if n.effect == LAG:
                m = x.full["inertia"]
                parameters = {"time_constant": entry(n.value / m, n.low / m, n.high / m, "s")}
            elif n.effect == STRIBECK:
                parameters = {"peak": entry(n.value, n.low, n.high, force), "v_s": entry(n.speed, 0.5 * n.speed, 2 * n.speed, f"{length}/s")}
            else:
                f = x.full["viscous_friction"]
                parameters = {"coefficient": entry(f, f * 0.95, f * 1.05, f"{force}.s/{length}"),
                              "asymmetry": entry(2 * n.value / f, 2 * n.low / f, 2 * n.high / f, "1")}  # fmt: skip
            same = [LAG, "command_delay"] if n.effect == LAG else []
            signal = EFFECTS[n.effect].signal(case, {k: v["value"] for k, v in parameters.items()}, {})
            active = signal > 0.25 * max(float(np.percentile(signal, 99.9)), 1e-12)
            helped = 1 - (n.after / n.before) ** 2
            confidence = min(n.share, 0.95) * (1.0 if helped > LEAST else 0.5)
            out.append({
                "effect": n.effect, "confidence": round(float(confidence), 3),
                "alternatives": [{"effect": n.rival, "confidence": round(1 - n.share, 3)}] if n.rival and n.share < 1 else [],
                "indistinguishable": same, "separating_experiment": EFFECTS[n.effect].experiment if same else None,
                "where": {"joints": [case.joint], "taxels": [], "topics": []},
                "regime": EFFECTS[n.effect].shows + ("; differs by direction" if n.text == BY_DIRECTION else ""),
                "when": intervals_of(active, case, runs, train), "parameters": parameters, "held_out": {"before": n.before, "after": n.after, "error": f"effort_rmse_{force.replace('.', '')}"},
            })  # fmt: skip
    return out


def _further(top: float, span: float) -> dict:
    """One more effect each, as a column of what was filtered. top: the highest speed, span: of the motion."""
    out = {BY_DIRECTION: lambda d: np.abs(d.X[:, 1]), SQUARE: lambda d: d.X[:, 1] * np.abs(d.X[:, 1]), LAG: lambda d: d.jerk}
    for part in SPEEDS:
        out[f"{STRIBECK} (v_s {part * top:.3g})"] = lambda d, s=part * top: d.smooth(np.sign(d.v) * np.exp(-((d.v / s) ** 2)))
    for part in DISTANCES:
        out[f"{GIVES} (over {part * span:.2g})"] = lambda d, s=part * span: d.smooth(_taken_up(d.q, s) - np.sign(d.v))
    return out


def _taken_up(q: np.ndarray, distance: float) -> np.ndarray:
    """[n] share -1..1 of a dry friction that is taken up along q: dz = (1 - z sign(dq)) dq / distance, each step exactly."""
    z, out = 0.0, np.empty(len(q))
    steps = np.diff(q, prepend=q[0])
    keep = np.exp(-np.abs(steps) / distance)
    for i, (step, k) in enumerate(zip(steps, keep, strict=True)):
        way = 1.0 if step > 0 else -1.0
        z = way + (z - way) * k
        out[i] = z
    return out


@dataclass
class _Filtered:
    """Positions q, speeds v [m + ends]; columns X [m, 4], jerks [m], torques u [m], blocks [m]; smooth: the filter for a further column, which must
    pass it as the torque does where it jumps with the sign of the speed."""

    q: np.ndarray
    v: np.ndarray
    jerk: np.ndarray
    X: np.ndarray
    u: np.ndarray
    blocks: np.ndarray
    smooth: object


def _filtered(t: np.ndarray, q: np.ndarray, torque: np.ndarray) -> _Filtered:
    step = float(np.median(np.diff(t)))
    even = np.arange(t[0], t[-1], step)
    q, torque = np.interp(even, t, q), np.interp(even, t, torque)
    b, a = butter(4, min(CUTOFF, TOP * 2 * step))
    once, u = filtfilt(b, a, q), filtfilt(b, a, torque)
    v = np.gradient(once, step)
    acceleration = np.gradient(v, step)
    edge = slice(50, -50)  # the filter's ends
    smooth = lambda x: filtfilt(b, a, x)[edge]  # noqa: E731
    X = np.stack([acceleration[edge], v[edge], smooth(np.sign(v)), np.ones(len(v[edge]))], 1)
    return _Filtered(once, v, np.gradient(acceleration, step)[edge], X, u[edge], ((even[edge] - even[0]) / BLOCK).astype(int), smooth)
