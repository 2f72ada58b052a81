"""Something outside that pushes: recorded torque that no inertia, gravity or friction of the joint's own makes, in
stretches of time.

Of each joint whose torque was logged the torque route is fitted to the half seconds that agree with each other best
(least trimmed squares by blocks), so that what pushes now and then does not spoil the fit. Where a plain fit leaves
much of the torque, and that trimmed fit is missed by far in some stretches only, something pushes then, by what is
missed. Where nothing agrees, the torque is no witness of this body at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from dexsim.gap.effects.external_force import ExternalForce
from dexsim.gap.read.runs import Run
from dexsim.gap.rules import TORQUE
from dexsim.gap.search import body_torque
from dexsim.gap.search.body_torque import Columns, columns_of, moved, readable, solved, sums, unphysical

if TYPE_CHECKING:
    from dexsim.gap.result import Diagnosis

HALF, STARTS, STEPS = 0.5, 40, 12  # share of the blocks that are fitted, random beginnings, and steps from each
MOVING = 0.1  # of the joint's large speed


@dataclass
class Push:
    """Of one joint: torque [N.m, N for a slide], the largest from outside (positive along positive motion); its quiet
    residual as noise; spans by recording [s]; left: share of the torque's variance that a plain fit leaves; clear:
    whether the rest fits."""

    joint: str
    torque: float
    noise: float
    left: float
    clear: bool
    slide: bool
    spans: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    cut: bool = False  # whether the joint was judged without these stretches

    def finding(self) -> dict[str, Any]:
        """As `diagnosis.json` has it."""
        half, unit = 3.0 * self.noise, "N" if self.slide else "N.m"
        count = sum(map(len, self.spans.values()))
        said = (
            f"in {count} stretch{'es' * (count != 1)} of time, {'forwards' if self.torque > 0 else 'backwards'} at "
            "its largest; elsewhere the joint's torque fits its body"
            if self.clear
            else f"all the time: {100 * self.left:.0f} % of the torque's variance fits no inertia, gravity or "
                 "friction (or it is not this joint's torque)"
        )
        return {
            "effect": ExternalForce.id,
            "confidence": TORQUE.told if self.clear else TORQUE.hinted,
            "alternatives": [],
            "indistinguishable": [],
            "separating_experiment": None,
            "where": {"joints": [self.joint], "taxels": [], "topics": []},
            "regime": said,
            "when": [
                {"recording": name, "start": round(a, 3), "end": round(b, 3)}
                for name, spans in self.spans.items()
                for a, b in spans
            ],
            "parameters": {
                "torque": {
                    "value": abs(self.torque),
                    "low": max(abs(self.torque) - half, 0.0),
                    "high": abs(self.torque) + half,
                    "unit": unit,
                }
            },
            "held_out": None,
        }


def find(model: mujoco.MjModel, runs: Sequence[Run], fitted: Sequence[int], seed: int = 0) -> list[Push]:
    """Of every joint that is pushed in `runs` (all with the same joints), as told by the recordings `fitted`; [] where
    no torque was logged."""
    out, motions = [], {}
    rng = np.random.default_rng(seed)
    for j, joint in enumerate(runs[0].joints):
        use = [r for r in range(len(runs)) if readable(runs[r], j)]
        own = [r for r in use if r in fitted]
        if not own:
            continue
        cutoff = min(min(body_torque.highest(runs[r].t) for r in use), 20.0)
        for r in use:
            if r not in motions:
                motions[r] = moved(runs[r], model, cutoff)
        push = _of_joint([columns_of([motions[r]], j) for r in use], [r in own for r in use], rng)
        if push is not None:
            spans, slide = (
                _spans(push[0], [runs[r] for r in use]),
                int(model.jnt_type[model.joint(joint).id]) == int(mujoco.mjtJoint.mjJNT_SLIDE),
            )
            if push[4] and not spans:
                continue
            out.append(Push(joint, push[1], push[2], push[3], push[4], slide, spans))
    return out


def _of_joint(pieces: Sequence[Columns], own: Sequence[bool], rng: np.random.Generator):
    """([(times, pushed) of each piece], largest push, quiet residual, share left by a plain fit, whether the rest
    fits); None where little is left.

    Fitted while the joint moves: at rest its dry friction carries any torque up to its level, and only what is beyond
    that speaks."""
    names = [n for n in pieces[0].names if all(n in p.names for p in pieces)]
    X = [p.X[:, [p.names.index(n) for n in names]] for p in pieces]
    fast = MOVING * float(np.percentile(np.abs(np.concatenate([p.v for p in pieces])), 95))
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
    fits = noise**2 < TORQUE.quiet * quiet_torque and not unphysical(_part(pieces[mine[0]], names, A[on], u[on]))
    least = max(TORQUE.far * noise, TORQUE.least * float(np.sqrt(np.mean(torque**2))))
    residual = [
        _beyond(p.u, a, x, names.index("coulomb_friction"), m) for p, a, m in zip(pieces, X, moves, strict=True)
    ]
    pushed = [np.abs(r) > least for r in residual]
    share = float(np.mean(np.concatenate(pushed)))
    if fits and share == 0 or not fits and not _slow(u - A @ x, block):
        return None  # nothing stands out, or noise does
    top = max((float(r[np.argmax(np.abs(r))]) for r in residual if len(r)), key=abs)
    times = [np.concatenate([q.motion.t[q.keep] - q.motion.t[0] for q in p.pieces]) for p in pieces]
    # what the motor gives less, something else gives
    return list(zip(times, pushed, strict=True)), -top, noise, left, fits and share < TORQUE.most


def _beyond(u: np.ndarray, A: np.ndarray, x: np.ndarray, coulomb: int, moves: np.ndarray) -> np.ndarray:
    """[m] torque that the fit misses; at rest only beyond what dry friction may carry either way."""
    still = A.copy()
    still[:, coulomb] = 0.0
    held = u - still @ x
    free = np.sign(held) * np.maximum(np.abs(held) - TORQUE.carries * max(float(x[coulomb]), 0.0), 0.0)
    return np.where(moves, u - A @ x, free)


def _slow(residual: np.ndarray, block: np.ndarray) -> bool:
    """Whether residuals are alike over half a second, as forces are and noise is not."""
    count = np.maximum(np.bincount(block), 1)
    means = np.bincount(block, residual) / count
    return float(np.sum(count * means**2)) > TORQUE.slow * float(np.sum(residual**2))


def _part(of: Columns, names: list[str], A: np.ndarray, u: np.ndarray) -> Columns:
    """Other rows in the place of a piece's, for the look whether their figures can be."""
    return replace(of, names=tuple(names), X=A, u=u)


def _trimmed(
    A: np.ndarray, u: np.ndarray, block: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """(coefficients [K], fitted blocks [count] bool) of the least trimmed squares by blocks (P. Rousseeuw, K. Van
    Driessen 2006)."""
    grams, sides = sums(A, u, block, count)
    squares, n = np.bincount(block, u * u, count), np.maximum(np.bincount(block, minlength=count), 1)
    keep, best = max(int(HALF * count), 4), (np.inf, None, None)
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
        if loss < best[0]:
            best = (loss, x, on)
    return best[1], best[2]


def _spans(given: Sequence[tuple[np.ndarray, np.ndarray]], runs: Sequence[Run]) -> dict[str, list[tuple[float, float]]]:
    """Stretches by recording, in its own time."""
    out: dict[str, list[tuple[float, float]]] = {}
    for (t, on), run in zip(given, runs, strict=True):
        edge = np.flatnonzero(np.diff(np.r_[0, on.astype(int), 0]))
        merged: list[list[float]] = []
        for a, b in zip(edge[::2], edge[1::2], strict=True):
            start, end = float(t[a] + run.t[0]), float(t[b - 1] + run.t[0])
            if merged and start - merged[-1][1] < TORQUE.join:
                merged[-1][1] = end
            else:
                merged.append([start, end])
        spans = [(a, b) for a, b in merged if b - a >= TORQUE.lasts]
        if spans:
            out[run.name] = out.get(run.name, []) + spans
    return out


def without(pushes: Sequence[Push], runs: list[Run], held: list[int], notes: list[str]) -> tuple[list[Run], list[int]]:
    """The runs without the stretches in which something pushes, and which are held out, where enough is left of both to
    judge by."""
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
    if not rest or bool(held) != bool(kept) or len(kept) == len(rest) or seconds(rest) < TORQUE.rest * seconds(runs):
        return runs, held
    for p in clear:
        p.cut = True
    notes += said
    return rest, kept


def claim(d: Diagnosis, pushes: Sequence[Push]) -> None:
    """Puts the findings into the diagnosis, and takes from it what was claimed of these joints beside signals: their
    motion had another cause."""
    if not pushes:
        return
    from dexsim.gap.effects.catalogue import EFFECTS
    from dexsim.gap.report.sentence import sentence

    joints = {p.joint for p in pushes if not p.cut}
    kept = [
        f
        for f in d.data["findings"]
        if f["effect"] not in EFFECTS or EFFECTS[f["effect"]].effort_only or not joints & set(f["where"]["joints"])
    ]
    d.notes += [
        f"{f['effect']} on {', '.join(f['where']['joints'])} is not claimed: something outside moved the joint, or "
        "its recorded torque is not its own"
        for f in d.data["findings"]
        if f not in kept
    ]
    d.data["findings"] = [p.finding() for p in pushes] + kept
    if not any(f["held_out"] for f in kept) and d.data["verdict"] in ("explained", "partly_explained"):
        d.data["verdict"] = "unknown"
    d.sentence = sentence(d.data, d, d.data["noise_floor"]["position_rad"])
