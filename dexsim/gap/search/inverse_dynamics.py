"""Inverse dynamics: what lies behind the motor, from the recorded motor torque alone, whatever the firmware did.

    torque = body + inertia * a + viscous * v + coulomb * sign(v) + offset + gravity's share      (IDIM-LS: Gautier, Janot, Vandanjon 2013)

with the body's torque from the MuJoCo model along the measured motion of all joints (`body_torque.py`), so that coupled joints and
gravity are no hindrance. Linear, hence at once and without a start; it needs a logged torque of 100 Hz or more. How much is filtered away
follows from the data: a second derivative is noise above what moves. Further effects are named one after another, each only where it
helps on quarters of the recordings that its fit has not seen; what is kept out only judges them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np

from dexsim.gap.effects.command_delay import CommandDelay
from dexsim.gap.effects.stribeck_friction import StribeckFriction
from dexsim.gap.search import body_torque
from dexsim.gap.search.body_torque import EDGE, Body, Motion

RATE = 100.0  # Hz: readings slower than this are too few for a second derivative
SHORTEST, FEWEST = 5.0, 500  # s, samples in all: of what is fitted
PER_CUTOFF = 10.0  # samples kept a period of the filter's cutoff
SHED = 0.8  # of the misfit: what halving the cutoff leaves, where what it sheds is noise of derivatives
HEAVY = 0.02  # of a joint's torque: gravity that matters
WEIGHED = 0.03  # what gravity's factor must be known to by the recordings, to be fitted beside the friction and not believed
TRUSTED = 0.6  # of the torque's rms: what may be left for figures to be believed
ALIKE = 1.05  # x the error of a free run in closed loop: within it the loop does not tell one from the other
DRAWS = 300
BLOCK = 0.5  # s
NAMES = ("inertia", "viscous_friction", "coulomb_friction", "offset")
WEIGHT = ("gravity", "gravity_across")  # factors on gravity's torque, beyond the model's, that are fitted beside them
QUARTERS = 4
LEAST = 0.12  # of the squared residual on the quarters left out: what a further effect must remove
MOST = 4
LATE = 0.02  # s: a torque that acts later than this is no drive's lag
BY_DIRECTION, SQUARE, LAG, STRIBECK = "viscous friction that differs by direction", "friction with the square of the speed", "lag", StribeckFriction.id
LOAD = "load_friction"
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
    """value, low, high by `NAMES` (90 %, block bootstrap), in kg.m2, N.m.s/rad, N.m (kg, N.s/m, N for a slide), all but the inertia beyond the
    model's, and by `WEIGHT` where gravity pulls; residual: rms of what is left over the rms of the torque. extra: (one further effect alone,
    share of the residual's rms it removes); named: further effects one after another; full: `NAMES` fitted with those of them that the
    catalogue has. refused: figures that came out negative where nothing can be, with the reason; they are 0 in `value`, the rest refitted."""

    value: dict[str, float]
    low: dict[str, float]
    high: dict[str, float]
    residual: float
    extra: list[tuple[str, float]]
    named: list[Named] = field(default_factory=list)
    full: dict[str, float] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)
    cutoff: float = 0.0  # Hz, of the filter


def identify(t: np.ndarray, q: np.ndarray, torque: np.ndarray, seed: int = 0, test: tuple[np.ndarray, ...] | None = None) -> Inverse:
    """From times [n] s, positions [n] and motor torques [n] of one joint without gravity. test: (t, q, torque) of a recording
    that only judges the further effects. Raises ValueError for fewer than 200 samples."""
    if len(t) < 200:
        raise ValueError(f"{len(t)} samples are too few for inverse dynamics (200)")

    def columns(cutoff: float) -> tuple[_Columns, _Columns]:
        given = [body_torque.motion(x[0], x[1][:, None], x[2][:, None], cutoff) for x in ((t, q, torque), *([] if test is None else [test]))]
        made = [_columns([(m, None)], 0) for m in given]
        return made[0], made[-1]

    return solve(columns, body_torque.highest(t), seed)


def solve(columns: Callable[[float], tuple[_Columns, _Columns]], top: float, seed: int = 0) -> Inverse:
    """From what `columns` makes of the fitted and of the judging recordings at a cutoff [Hz], from `top` down while halving it sheds noise."""
    cutoff, (own, other) = top, columns(top)
    while 0.5 * cutoff >= body_torque.LEAST:
        lower = columns(0.5 * cutoff)
        if _misfit(lower[0]) > SHED * _misfit(own):
            break
        cutoff, (own, other) = 0.5 * cutoff, lower
    believed = _not_weighed(own)
    own, other = own.without(believed), other.without(believed)
    refused = _unphysical(own)
    own, other = own.without(refused), other.without(refused)
    rng = np.random.default_rng(seed)
    X, u, blocks = own.X, own.u, own.blocks
    theta, low, high = _intervals(X, u, blocks, rng)
    further = _further(own)
    mine, theirs = ({n: c(d) for n, c in further.items()} for d in (own, other))
    before = np.std(other.u - other.X @ theta)
    extra = []
    for name in further:
        more = _least(np.column_stack([X, mine[name]]), u)
        extra.append((name, float(1 - np.std(other.u - np.column_stack([other.X, theirs[name]]) @ more) / before)))
    named, full = _name(own, other, mine, theirs, rng)
    left = float(np.std(u - X @ theta) / max(np.std(own.torque), 1e-12))
    pack = lambda x: {n: 0.0 for n in refused} | own.pack(x)  # noqa: E731
    return Inverse(pack(theta), pack(low), pack(high), left, sorted(extra, key=lambda e: -e[1]), named, pack(full), refused, cutoff)


def _misfit(d: _Columns) -> float:
    return float(np.std(d.u - d.X @ _least(d.X, d.u)))


def _not_weighed(d: _Columns) -> list[str]:
    """Factors on gravity that these recordings tell worse than a model does (each half second one reading of it)."""
    at = {n: d.names.index(n) for n in WEIGHT if n in d.names}
    reach = {n: float(np.std(d.X[:, k])) * np.sqrt(d.blocks.max() + 1.0) for n, k in at.items()}
    return [n for n in at if max(reach.values()) * WEIGHED < _misfit(d.without(list(at)))]


def _unphysical(d: _Columns) -> dict[str, str]:
    """Figures that least squares make negative where nothing can be, one after another, each with the reason."""
    out: dict[str, str] = {}
    while True:
        left = d.without(out)
        x = left.pack(_least(left.X, left.u))
        negative = [n for n in ("inertia", "coulomb_friction", "viscous_friction") if n not in out and x[n] < 0]
        if not negative:
            return out
        out[negative[0]] = f"the least squares give {x[negative[0]]:.3g}, and nothing has a negative {negative[0].replace('_', ' ')}"


def _name(own, other, mine, theirs, rng) -> tuple[list[Named], np.ndarray]:
    """Further effects in the order in which they help on quarters left out, and the coefficients with the catalogue's."""
    chosen: list[str] = []
    out: list[tuple[str, float, str]] = []
    X, Y, base = own.X, other.X, own.X.shape[1]
    quarter = np.minimum(np.arange(len(own.u)) * QUARTERS // len(own.u), QUARTERS - 1)
    count = int(own.blocks.max()) + 1

    def left_out(A: np.ndarray) -> np.ndarray:
        """[blocks] squared residual, each quarter with coefficients of the others."""
        grams, sides = _sums(A, own.u, quarter, QUARTERS)
        x = _solved(grams.sum(0) - grams, sides.sum(0) - sides)
        r = own.u - np.einsum("nk,nk->n", A, x[quarter])
        return np.bincount(own.blocks, r * r, count)

    now = left_out(X)
    for _ in range(MOST):
        tried = {}
        for name, column in mine.items():
            if name in chosen or (_kind(name) in map(_kind, chosen)):
                continue
            A = np.column_stack([X, column])
            c = _least(A, own.u)
            if _sensible(name, c[-1], own.pack(c)):
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
    size = {n: (theta[base + i], low[base + i], high[base + i]) for i, n in enumerate(known)}
    all_, below, above = _intervals(X, own.u, own.blocks, rng)
    named = []
    for i, (name, share, rival) in enumerate(out):
        with_, without = (_least(X[:, :k], own.u) for k in (base + 1 + i, base + i))
        a, b = np.std(other.u - Y[:, : base + i] @ without), np.std(other.u - Y[:, : base + 1 + i] @ with_)
        c = size.get(name, (all_[base + i], below[base + i], above[base + i]))
        named.append(Named(name, *map(float, c), share, rival, float(a), float(b)))
    return named, theta


def _effect(name: str) -> str:
    return {BY_DIRECTION: "viscous_friction", LAG: "lag", STRIBECK: STRIBECK, LOAD: LOAD}.get(_kind(name), "")


def _kind(name: str) -> str:
    return name.split(" (")[0]


def _sensible(name: str, c: float, theta: dict[str, float]) -> bool:
    """Whether a coefficient can be what it is called: a lag is late, an excess is more, and what gives way is friction that is there."""
    if name == LAG:
        return 0 < c < LATE * abs(theta["inertia"])
    if _kind(name) == GIVES:
        return 0 < c < 2 * theta.get("coulomb_friction", 0.0)
    if name == LOAD:
        return 0 < c < 1 and theta.get("coulomb_friction", 0.0) >= 0
    return c > 0 if _kind(name) == STRIBECK else True


def _sums(X: np.ndarray, u: np.ndarray, of: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations [count, K, K], [count, K] of the rows of each part `of` [m]."""
    rows = [np.flatnonzero(of == b) for b in range(count)]
    return np.stack([X[i].T @ X[i] for i in rows]), np.stack([X[i].T @ u[i] for i in rows])


def _solved(grams: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Coefficients [.., K] of normal equations [.., K, K], [.., K], columns scaled alike; 0 for a column that is not there."""
    scale = np.sqrt(np.maximum(np.einsum("...kk->...k", grams), 1e-300))
    scaled = grams / (scale[..., :, None] * scale[..., None, :]) + 1e-13 * np.eye(grams.shape[-1])
    return np.linalg.solve(scaled, (sides / scale)[..., None])[..., 0] / scale


def _least(X: np.ndarray, u: np.ndarray) -> np.ndarray:
    return _solved(X.T @ X, X.T @ u)


def _intervals(X: np.ndarray, u: np.ndarray, blocks: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least squares and 90 % by a block bootstrap."""
    count = int(blocks.max()) + 1
    grams, sides = _sums(X, u, blocks, count)
    pick = rng.integers(0, count, (DRAWS, count))
    weight = np.stack([np.bincount(i, minlength=count) for i in pick]).astype(float)
    draws = _solved(np.einsum("db,bkl->dkl", weight, grams), weight @ sides)
    return _least(X, u), *np.quantile(draws, [0.05, 0.95], axis=0)


def found(cases, runs, train: Sequence[int], test: Sequence[int], seed: int = 0, model: mujoco.MjModel | None = None,
          span_train: dict[int, tuple[float, float]] | None = None, span_test: dict[int, tuple[float, float]] | None = None) -> list[tuple]:
    """(case, Inverse, names of the recordings that judged its further effects) of each joint whose motor torque was logged in N.m, fast
    and long enough. Without `model` only joints that neither gravity nor others load. span_*: part of each run [s from its start]."""
    out, motions = [], {}
    for case in cases:
        if model is None and (case.scales.gravity > HEAVY * case.scales.tau or case.scales.others):
            continue
        use = [r for r in train if _readable(runs[r], case.index)]
        judge = [r for r in test if _readable(runs[r], case.index) and (r not in train or span_test is not None)]
        if not use or not case.moved:
            continue

        def columns(cutoff: float, case=case, use=use, judge=judge):
            def piece(r: int, span):
                if (r, cutoff) not in motions:
                    motions[r, cutoff] = _moved(runs[r], model, cutoff)
                return *motions[r, cutoff], None if span is None else span.get(r)

            efficiency = float(case.scales.nominal.get("efficiency", 1.0))
            own = _columns([piece(r, span_train) for r in use], case.index, efficiency)
            return own, own if not judge else _columns([piece(r, span_test) for r in judge], case.index, efficiency)

        top = min(body_torque.highest(runs[r].t) for r in use)
        first = columns(top)[0]
        if len(first.u) < FEWEST * min(PER_CUTOFF * top * float(np.median(np.diff(runs[use[0]].t))), 1.0) or first.seconds < SHORTEST:
            continue
        out.append((case, solve(columns, top, seed), [runs[r].name for r in judge]))
    return out


def _readable(run, j: int) -> bool:
    """Whether a run's torque of joint j can be differentiated beside its motion."""
    if run.torque is None or run.torque_unit != "N.m" or not np.isfinite(run.torque[:, j]).all() or len(run.t) < 2 * EDGE + 100:
        return False
    return 1 / np.median(np.diff(run.t)) >= 0.97 * RATE


def _moved(run, model: mujoco.MjModel | None, cutoff: float) -> tuple[Motion, Body | None]:
    m = body_torque.motion(run.t, run.q, np.nan_to_num(run.torque), cutoff)
    return m, None if model is None else body_torque.body(model, run.gravity, run.joints, m)


def texts(given: Sequence[tuple]) -> list[str]:
    """What `found` gave, in words."""
    out = []
    for case, x, judged in given:
        said = ", ".join(f"{n.replace('_', ' ')} {x.value[n]:.4g} ({x.low[n]:.4g} to {x.high[n]:.4g})" for n in NAMES)
        text = f"{case.joint}: by the recorded motor torque alone: {said}; {100 * x.residual:.1f} % of the torque is left"
        text += "".join(f"; {n.replace('_', ' ')}: {why}" for n, why in x.refused.items())
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
        said += [f"{case.joint}: no {n.replace('_', ' ')} is taken from the recorded motor torque: {why}" for n, why in x.refused.items() if n in open_]
        open_ = [n for n in open_ if n not in x.refused or n == "viscous_friction"]  # friction that falls with speed leaves no viscous part
        if not open_ or x.value["coulomb_friction"] <= 0:
            continue
        if x.residual > TRUSTED:
            said.append(f"{case.joint}: the recorded motor torque is no witness: {100 * x.residual:.0f} % of it fits no inertia, gravity or friction")
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
        if abs(factor - 1) < BELIEF and "inertia" not in x.refused:
            half = max(0.5 * (x.high["inertia"] - x.low["inertia"]) / x.value["inertia"], 1e-3)
            case.factors["inertia"] = (factor - half, factor + half)
        said.append(f"{case.joint}: {' and '.join(n.replace('_', ' ') for n in open_)} was unknown and is taken from the recorded motor torque")
    return said


def hand_on(given: Sequence[tuple], d, outcomes: Sequence[tuple], test: Sequence[int], span_test: dict | None) -> None:
    """Writes the torque's figures into the servo table that is handed on, and the nuisances, where a joint's closed loop does not say
    otherwise: what it was refitted to then is the fit's own wandering.

    d: the Diagnosis; outcomes: (case, search, outcome) of each joint. A closed loop says otherwise where a free run over what was kept out
    is followed better than to `ALIKE` with its own figures, or where a finding of at least a half is about them.
    """
    by = {case.joint: (search, outcome) for case, search, outcome in outcomes}
    for case, x, _ in given:
        if not case.told or case.joint not in by:
            continue
        search, outcome = by[case.joint]
        held = [f for f in d.data["findings"] if f["confidence"] >= 0.5 and case.joint in f["where"]["joints"]]
        trial = search.polish(outcome.best if held else outcome.none)
        claimed = {c for m in trial.members for p in m.variant.params for c in p.columns}
        told = [n for n in ("viscous_friction", "coulomb_friction", "friction_asymmetry") if n in case.ranges and n not in claimed]
        ours = {n: case.scales.nominal[n] for n in told}
        if "inertia" in case.factors and "inertia_scale" not in claimed:
            ours["inertia"] = x.value["inertia"] / case.scales.inertia
        if not told or not _alike(case, search, trial, ours, test, span_test):
            continue
        for name in told:
            d.servo.set(case.joint, name, round(case.scales.nominal[name], 9), *(round(v, 9) for v in case.ranges[name]))
            if f"{name}@{case.joint}" in d.data["nuisance"]:
                d.data["nuisance"][f"{name}@{case.joint}"] = round(case.scales.nominal[name], 6)
        if "inertia" in ours:
            d.data["nuisance"][f"inertia_factor@{case.joint}"] = round(ours["inertia"], 6)
        d.notes.append(f"{case.joint}: friction is handed on as the recorded torque tells it; its closed loop does not tell it better")


def _alike(case, search, trial, ours: dict[str, float], test: Sequence[int], span_test: dict | None) -> bool:
    """Whether what was kept out is followed as well with the torque's figures as with those that the closed loop was refitted to."""
    from dexsim.gap.judge.errors import free_run

    whole = replace(case, plant=search.whole)
    windows = whole.plant.windows(None, test, span=span_test)
    params, fixed = trial.fit.params, [f for m in trial.members for f in m.variant.fixed]
    told = np.array([ours.get(p.key, x) for p, x in zip(params, trial.fit.x, strict=True)])
    measured = whole.plant.q[windows.sample_row]
    error = [float(np.sqrt(np.mean((measured - free_run(whole, params, x, windows, fixed, True)[0]) ** 2))) for x in (trial.fit.x, told)]
    return error[1] <= ALIKE * error[0] + 0.1 * case.sigma


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
            elif n.effect == LOAD:
                parameters = {"fraction": entry(n.value, n.low, n.high, "1")}
            else:
                f = x.full["viscous_friction"]
                parameters = {"coefficient": entry(f, f * 0.95, f * 1.05, f"{force}.s/{length}"),
                              "asymmetry": entry(2 * n.value / f, 2 * n.low / f, 2 * n.high / f, "1")}  # fmt: skip
            same = [LAG, CommandDelay.id] if n.effect == LAG else []
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


def _further(own: _Columns) -> dict:
    """One more effect each, as a column of what was filtered."""
    top, span = float(np.abs(own.v).max()), own.span
    out = {BY_DIRECTION: lambda d: np.abs(d.v), SQUARE: lambda d: d.v * np.abs(d.v), LAG: lambda d: d.rise}
    if own.loaded:
        out[LOAD] = lambda d: d.column(lambda q, v, load: np.abs(load) * np.sign(v))
    for part in SPEEDS:
        out[f"{STRIBECK} (v_s {part * top:.3g})"] = lambda d, s=part * top: d.column(lambda q, v, load: np.sign(v) * np.exp(-((v / s) ** 2)))
    for part in DISTANCES:
        out[f"{GIVES} (over {part * span:.2g})"] = lambda d, s=part * span: d.column(lambda q, v, load: _taken_up(q, s) - np.sign(v))
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
class _Piece:
    """One recording at its full rate: q, v, load (the body's torque) [n] and which samples are kept."""

    motion: Motion
    q: np.ndarray
    v: np.ndarray
    load: np.ndarray
    keep: np.ndarray


@dataclass
class _Columns:
    """One joint's pieces in a row, thinned to what the filter leaves: columns X [m, K] by `names`, torque beyond the body u [m], speeds v [m], what
    a lag of one second would add per unit of inertia `rise` [m], the torque itself [m], blocks [m]; inertia of the model (median), extent
    of the motion, whether gravity pulls, seconds in all."""

    pieces: list[_Piece]
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
        """[m] f(q, v, load) through the filter."""
        return np.concatenate([p.motion.smooth(f(p.q, p.v, p.load))[p.keep] for p in self.pieces])

    def without(self, names: Collection[str]) -> _Columns:
        """The same with figures that are held at 0."""
        on = [n not in names for n in self.names]
        return replace(self, X=self.X[:, on], names=tuple(n for n in self.names if n not in names))

    def pack(self, x: np.ndarray) -> dict[str, float]:
        """Coefficients by name, the inertia with the model's."""
        out = {n: float(y) for n, y in zip(self.names, x, strict=False)}
        return out | ({"inertia": out["inertia"] + self.inertia} if "inertia" in out else {"inertia": self.inertia})


def _columns(given: Sequence[tuple], j: int, efficiency: float = 1.0) -> _Columns:
    """Of joint j; given: (Motion, Body or None[, span s]) of each recording; efficiency: of the drive, believed."""
    pieces, parts, at = [], [], 0
    inertia = float(np.median(np.concatenate([b.inertia[:, j] for _, b, *_ in given]))) if given[0][1] is not None else 0.0
    weights = [np.abs(b.gravity[:, j]).max() / max(float(np.abs(m.u[:, j]).max()), 1e-12) for m, b, *_ in given if b is not None]
    loaded = bool(weights) and max(weights) > HEAVY
    for m, b, *rest in given:
        q, v, torque = m.q[:, j], m.v[:, j], efficiency * m.u[:, j]
        load = np.zeros_like(q) if b is None else b.torque[:, j]
        keep = np.zeros(len(q), bool)
        keep[m.edge : len(q) - m.edge : max(int(1.0 / (PER_CUTOFF * m.cutoff * m.step)), 1)] = True
        if rest and rest[0] is not None:
            keep &= (m.t - m.t[0] >= rest[0][0]) & (m.t - m.t[0] <= rest[0][1])
        columns = [m.a[:, j], v, m.smooth(np.sign(v)), np.ones(len(v))]
        columns += [b.gravity[:, j], b.across[:, j]] if loaded else []
        rise = np.gradient(m.a[:, j] if b is None else load / inertia, m.step)
        block = at + ((m.t - m.t[0]) / BLOCK).astype(int)
        at = int(block.max()) + 1
        parts.append(tuple(x[keep] for x in (np.stack(columns, 1), torque - load, v, rise, torque, block)))
        pieces.append(_Piece(m, q, v, load, keep))
    X, u, v, rise, torque, block = (np.concatenate(x) for x in zip(*parts, strict=True))
    q = np.concatenate([p.q[p.keep] for p in pieces])
    seconds = sum(float(p.keep.sum()) * max(int(1.0 / (PER_CUTOFF * p.motion.cutoff * p.motion.step)), 1) * p.motion.step for p in pieces)
    _, block = np.unique(block, return_inverse=True)
    names = NAMES + (WEIGHT if loaded else ())
    return _Columns(pieces, names, X, u, v, rise, torque, block, inertia, float(np.ptp(q)) if len(q) else 0.0, loaded, seconds)
