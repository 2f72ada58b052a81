"""What to record next: the safe motion on which the leading hypotheses, as fitted, disagree most.

Candidates are the motions of `dexsim.recording.excitation` at the size that is safe. Both hypotheses are simulated over
each; what the refitted figures could make up for is taken out; what is left counts in units of the joint's noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dexsim.gap.plant.case import Case, build
from dexsim.gap.plant.columns import INDEX
from dexsim.gap.plant.param import expand
from dexsim.gap.read.runs import Run
from dexsim.gap.search.search import JointSearch, Trial
from dexsim.recording.excitation import Limits, Plan, plan
from dexsim.recording.mechanism import Mechanism

KINDS = ("steps", "chirp", "triangles", "ladder", "holds")
RATE = 100.0  # Hz
ENOUGH = 3.0  # x the noise: a motion on which they differ by as much settles it


@dataclass
class Choice:
    """Kinds of motion, the best first, and by how many times the noise the hypotheses differ on each; chosen: what to
    record."""

    scores: dict[str, float]
    chosen: list[str]

    @property
    def text(self) -> str:
        """The choice in words."""
        ranked = sorted(self.scores.items(), key=lambda s: -s[1])
        if not self.settles:
            return (
                f"none settles it: the two differ by {ranked[0][1]:.1f} times the noise on {ranked[0][0]}, and by "
                "less on the others"
            )
        first = f"on {ranked[0][0]} the two differ by {ranked[0][1]:.1f} times the noise"
        return first + (f" ({', '.join(f'{k} {v:.1f}' for k, v in ranked[1:])})" if len(ranked) > 1 else "")

    @property
    def settles(self) -> bool:
        """Whether the best motion shows more than the noise."""
        return max(self.scores.values()) >= 1.0


def rival_of(search: JointSearch, outcome, effect: str, rival: str | None) -> Trial | None:
    """The fitted hypothesis with `rival` in the place of `effect`; None for "without it" where no rival was fitted."""
    rest = {m.id for m in outcome.best.members} - {effect}
    if rival is not None:
        return search.fitted.get(frozenset({rival, *rest}))
    return search.fitted.get(frozenset(rest)) if rest else outcome.none


def choose(
    m: Mechanism, search: JointSearch, a: Trial, b: Trial, seed: int = 0, kinds: Sequence[str] = KINDS, most: int = 2
) -> Choice:
    """The motions of one joint that tell hypothesis a from b. Raises UserError where nothing safe can be planned."""
    case = search.case
    made = plan(m, [case.joint], list(kinds), seed, repeats=0)
    scores = disagreement(m, case, search, a, b, made)
    ranked = sorted(scores, key=lambda k: -scores[k])
    chosen = ranked[:1]
    # a second kind where the first alone may not settle it, or says nearly as much
    chosen += [k for k in ranked[1:most] if scores[ranked[0]] < ENOUGH or scores[k] > 0.7 * scores[ranked[0]]]
    return Choice(scores, chosen)


def disagreement(m: Mechanism, case: Case, search: JointSearch, a: Trial, b: Trial, p: Plan) -> dict[str, float]:
    """rms difference of the positions that two hypotheses predict on each kind of motion of a plan, over the joint's
    noise, with what the refitted figures of `a` could make up for taken out."""
    every = max(1, round(1 / RATE / float(p.run.t[1] - p.run.t[0])))
    t = p.run.t[::every]
    column = m.joints.index(case.joint)
    gravity = np.asarray(m.spec.option.gravity, float)
    joints = tuple(m.joints)
    run = Run("plan", joints, p.t, p.value, t, p.run.position[::every].copy(), m.table, gravity, counted=joints)
    run.smooth()
    there = build(m.spec.compile(), [run])[column]
    plant, windows = there.plant, there.plant.windows(None)
    guesses = [_guess(plant, a, a.fit.x), _guess(plant, b, b.fit.x)]
    moves = []
    for i, q in enumerate(a.fit.params):
        if q.nuisance:
            x = a.fit.x.copy()
            x[i] = np.clip(x[i] + 0.05 * q.span * (1 if x[i] + 0.05 * q.span <= q.high else -1), q.low, q.high)
            guesses.append(_guess(plant, a, x))
            moves.append(q)
    q, _ = plant.simulate(np.stack(guesses), windows)
    difference = (q[1] - q[0]) / case.sigma
    J = ((q[2:] - q[0]) / case.sigma).T
    stamp = t[windows.sample_row]
    out: dict[str, float] = {}
    for kind in {s.kind for s in p.segments}:
        on = np.zeros(len(stamp), bool)
        for s in p.segments:
            if s.kind == kind:
                on |= (stamp >= s.start) & (stamp <= s.end)
        if on.sum() < 20:
            continue
        d = difference[on]
        if J.shape[1]:
            j = J[on]
            d = d - j @ np.linalg.solve(j.T @ j + 400.0 / 12 * np.eye(j.shape[1]), j.T @ d)
        out[kind] = float(np.sqrt(np.mean(np.minimum(np.abs(d), 1e4) ** 2)))
    return out


def _guess(plant, trial: Trial, x: np.ndarray) -> np.ndarray:
    """[R, C] plant parameters of a hypothesis at x."""
    out = expand(plant, trial.fit.params, x[None])[0]
    for member in trial.members:
        for name, value in member.variant.fixed:
            out[:, INDEX[name]] = value
    return out


__all__ = ["Choice", "Limits", "choose", "disagreement", "rival_of"]
