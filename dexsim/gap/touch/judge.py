"""One pad's answer judged on what was kept out of the fit: errors before and after, findings with their doubts, facts
for training."""

from __future__ import annotations

from typing import Any

import numpy as np

from dexsim.gap.effects.catalogue import TOUCH_EFFECTS, touch_confusable
from dexsim.gap.effects.effect import word
from dexsim.gap.judge.confidence import kept
from dexsim.gap.rules import JUDGE, TOUCH
from dexsim.gap.touch import constant_taxels, locate
from dexsim.gap.touch.fit import PadFit, TouchTrial
from dexsim.gap.touch.handed_on import chord
from dexsim.gap.touch.plant import PARAMS, contact, readings
from dexsim.gap.touch.result import Fit, PadFacts
from dexsim.gap.touch.search import PadOutcome, PadSearch
from dexsim.recording.schema import TACTILE


class PadAnswer:
    """A searched pad on what was kept out.

    before, after: squared errors [N^2] of the signals in which something was found (readings, the cell's force, shear)
    without any effect and with what was found; times: of each [s], unique over the recordings; bounds: 90 % intervals
    of the fitted parameters; numbers: rms [N] for the page; facts: what training is told beside the findings. felt:
    whether what was kept out feels anything; nothing is judged otherwise."""

    def __init__(self, search: PadSearch, outcome: PadOutcome, kept: set[str]):
        self.search, self.outcome, self.kept = search, outcome, kept
        self.pad, self.name = outcome.pad, search.name
        self.none, self.best = outcome.none, outcome.best
        self.notes: list[str] = []
        self.bounds = search.intervals(self.best) if self.best.keys else {}
        self.constant = constant_taxels.pressed(search.silent, self.pad)
        unmoved = {0} if self.constant is not None or not self.best.ids else set()
        self.stages = sorted({_stage(search, e) for e in self.best.ids} | unmoved)
        e0, e1 = (np.concatenate([held_out(search, t, k)[1] for k in self.stages]) for t in (self.none, self.best))
        blocks = np.concatenate([held_out(search, self.best, k)[2] for k in self.stages])
        self.felt = bool(len(e0))
        if not self.felt:
            self.notes.append(f"the {self.name}'s pad feels nothing in what was kept out: nothing is judged there")
            return
        silent = _silent_squares(search) if 0 in self.stages else (np.zeros(0), np.zeros(0))
        self.before, self.after = np.concatenate([e0, silent[0]]), np.concatenate([e1, silent[1]])
        self.times = np.concatenate([blocks, np.repeat(blocks[-1:], len(silent[0]))]) * 0.5
        self.floor = _floor(search, self.stages)
        self.left = float(np.sqrt(e1.mean()))  # what the plant leaves, constant taxels apart
        self.numbers = {"before": rms(self.before), "after": rms(self.after), "noise": search.noise}
        if self.constant is not None:
            self.constant["held_out"] = {
                "before": self.numbers["before"],
                "after": rms(np.concatenate([e0, silent[1]])),
            }

    def findings(self) -> list[dict[str, Any]]:
        """What was found, as `diagnosis.json` says it."""
        found = [f for e in self.best.ids if (f := self._finding(e)) is not None]
        if self.constant is not None:  # one finding per effect and pad: constant taxels are gains of 0
            gain = next((f for f in found if TOUCH_EFFECTS[f["effect"]].by_taxel), None)
            if gain is None:
                found.append(self.constant)
            else:
                constant_taxels.merge(gain, self.constant)
        return found

    def _finding(self, e: str) -> dict[str, Any] | None:
        """One effect; None where it did not help on what was kept out."""
        search, best, effect = self.search, self.best, TOUCH_EFFECTS[e]
        stage = _stage(search, e)
        less = search.without(best, e) if len(best.ids) > 1 else self.none
        b, a = held_out(search, less, stage)[0], held_out(search, best, stage)[0]
        rivals, share = self.outcome.rivals[e], self.outcome.confidence[e]
        same = [r for r in rivals if touch_confusable(r[0], e) and r[1] >= TOUCH.set_share][:2]
        earned = float(np.clip((b - a) / (JUDGE.earns * b + 1e-12), 0.0, 1.0)) if np.isfinite(a) else 0.5
        if earned <= TOUCH.earned:
            self.notes.append(
                f"{e} on the {self.name}'s pad earned its place in training but not on what was kept out; not claimed"
            )
            return None
        taxels, parameters = self._parameters(e)
        return {
            "effect": e,
            "confidence": round(float(min(share * kept(earned), 0.99)), 3),
            "alternatives": [{"effect": x, "confidence": round(c, 3)} for x, c in rivals[:3]],
            "indistinguishable": [e, *(x for x, _ in same)] if same else [],
            "separating_experiment": effect.experiment if same else None,
            "where": {"joints": [], "taxels": taxels, "topics": [TACTILE]},
            "regime": effect.shows,
            "when": locate.when(e, search, best),
            "parameters": parameters,
            "held_out": {"before": b, "after": a},
        }

    def facts(self) -> PadFacts:
        """What training is told of the pad beside its findings."""
        search, best, run = self.search, self.best, self.search.runs[0]
        common = (best.values["gain"], *self.bounds["gain"]) if "gain" in best.keys else None
        warmest = max(float(r.warm.max()) for r in search.runs)
        return PadFacts(
            dict(search.silent), common, self._rest(), self._chord(), warmest, run.stiffness, run.friction, search.shear
        )

    def nuisance(self) -> dict[str, float]:
        """The refitted beliefs by the keys of `diagnosis.json`."""
        keys = [k for k in ("scale", "zero", "along", "across", "spread", "clock") if k in self.best.keys]
        return {f"touch_{k}@{self.name}": round(self.best.values[k], 7) for k in keys}

    def recordings(self) -> set[str]:
        """Names of the recordings that it was judged by."""
        return self.kept or {r.recording for r in self.search.runs}

    def structured(self) -> bool:
        """Whether something is left that no effect explains."""
        search = self.search
        loss = float(search.cross(self.best).sum()) / max(int(search.train.sum()), 1)
        return loss > TOUCH.structured**2 and self.left > TOUCH.structured * self.floor

    def _rest(self) -> Fit | None:
        """Gain of the taxels that hardly felt anything, where those that did agree on one that is not 1; None where
        they do not."""
        search, t = self.search, self.best
        if t.gains is None:
            return None
        moved = np.zeros(len(t.gains), bool) if t.order is None else t.order != np.arange(len(t.gains))
        width = search.gain_width(t)
        sure = (width < 0.1) & ~moved & (sum(r.z.sum(0) for r in search.runs) > 0)
        sure[list(search.silent)] = False
        if sure.sum() < TOUCH.agree:
            return None
        # one barely known counts little
        low, value, high = _quantiles(t.gains[sure], width[sure] ** -2.0, (0.05, 0.5, 0.95))
        return (value, low, high) if abs(value - 1) > TOUCH.gain_off and high - low < abs(value - 1) else None

    def _chord(self) -> Fit | None:
        """The linear contact that stands for a fitted rubber over the recorded presses, as far as its numbers are
        known; None without one."""
        t = self.best
        if not any("c10" in TOUCH_EFFECTS[e].fits for e in t.ids):
            return None
        fits = []
        for k in (None, 0, 1):
            v = t.values if k is None else t.values | {key: self.bounds[key][k] for key in ("c10", "c01")}
            pairs = [(contact(r, v)[0], r.depth + v["zero"]) for r in self.search.runs]
            fits.append(chord(*(np.concatenate(x) for x in zip(*pairs, strict=True))))
        if any(f is None for f in fits):
            return None
        return fits[0][0], min(f[1] for f in fits), max(f[2] for f in fits)

    def _parameters(self, e: str) -> tuple[list[str], dict[str, Any]]:
        """(taxels concerned, parameters with intervals by the catalogue's keys)."""
        effect, t, search = TOUCH_EFFECTS[e], self.best, self.search
        if effect.by_taxel and t.gains is not None:
            return self._gains_of_taxels()
        run, out = search.runs[0], {}
        factor = {"stiffness": run.stiffness, "mu": run.friction}
        for key, name in effect.report:
            f = factor.get(key, 1.0)
            low, high = self.bounds.get(key, (t.values[key], t.values[key]))
            unit = "1/s" if key == "drift" and not search.thermometer else PARAMS[key].unit
            out[name] = {
                "value": float(f * t.values[key]),
                "low": float(f * low),
                "high": float(f * high),
                "unit": unit,
            }
        felt = sum((r.z > max(2 * r.lsb, 3 * search.noise)).sum(0) for r in search.runs)
        taxels = [f"{self.pad}:{k}" for k in np.flatnonzero(felt > 3)]
        return taxels, out | {k: word(v) for k, v in effect.words_beside.items()}

    def _gains_of_taxels(self) -> tuple[list[str], dict[str, Any]]:
        """The same of a gain for every taxel: those that are off, and those that are exchanged."""
        t, pad = self.best, self.pad
        g = t.gains
        moved = [] if t.order is None else [int(k) for k in np.flatnonzero(t.order != np.arange(len(g)))]
        half = self.search.gain_width(t)
        off = [int(k) for k in np.flatnonzero(np.abs(g - 1) > np.maximum(TOUCH.gain_off, half))]
        chosen = sorted(set(off) | set(moved))
        names = [f"{pad}:{k}" for k in chosen]
        value = [round(float(g[k]), 4) for k in chosen]
        low = [max(v - float(half[k]), 0.0) for k, v in zip(chosen, value, strict=True)]
        high = [v + float(half[k]) for k, v in zip(chosen, value, strict=True)]
        gain = {"value": value, "low": low, "high": high, "unit": "1"}
        if len(chosen) == 1 or (len(chosen) and np.ptp(value) < 0.05):
            gain |= {k: float(np.mean(gain[k])) for k in ("value", "low", "high")}
        out = {"gain": gain, "taxels": {"value": ", ".join(names), "low": None, "high": None, "unit": ""}}
        if moved:
            pairs = sorted({tuple(sorted((k, int(t.order[k])))) for k in moved})
            out["taxels"]["swapped"] = [[f"{pad}:{a}", f"{pad}:{b}"] for a, b in pairs]
        return names, out


def rms(squares: np.ndarray) -> float:
    """Root of the mean of squares; 0 for none."""
    return float(np.sqrt(np.mean(squares))) if len(squares) else 0.0


def held_out(pad: PadFit, trial: TouchTrial, stage: int = 0) -> tuple[float, np.ndarray, np.ndarray]:
    """(rms [N], squared errors, blocks) on residuals kept out, of one stage, over taxels that feel something."""
    at = ~pad.train & (pad.stage_of() == stage)
    sigma = np.concatenate([s.sigma[s.mask] for s in pad.samples])
    e = (trial.res * sigma)[at] ** 2
    return (float(np.sqrt(e.mean())) if len(e) else float("nan")), e, pad.block[at]


def _quantiles(x: np.ndarray, weight: np.ndarray, at: tuple[float, ...]) -> list[float]:
    """Quantiles of x [n], each counting by its weight: the least value below or at which that share of the weights
    lies."""
    order = np.argsort(x)
    share = np.cumsum(weight[order]) / weight.sum()
    return [float(x[order][min(int(np.searchsorted(share, q)), len(x) - 1)]) for q in at]


def _stage(search: PadFit, effect: str) -> int:
    """Which signal judges an effect: 0 the taxels, 1 the load cell (where there is one), 2 shear."""
    return {"cell": 1 if search.load else 0, "shear": 2}.get(TOUCH_EFFECTS[effect].stage, 0)


def _floor(search: PadFit, stages: list[int]) -> float:
    """N: the noise of one reading; of a sum of taxels or a load cell, with what is not trusted of the plant."""
    if stages == [0]:
        return search.noise
    stage = search.stage_of()
    sigma = np.concatenate([s.sigma[s.mask] for s in search.samples])
    return float(np.sqrt(np.mean(sigma[np.isin(stage, stages)] ** 2)))


def _silent_squares(search: PadFit) -> tuple[np.ndarray, np.ndarray]:
    """Squared errors of the dead and stuck taxels on what was kept out: as believed, and as constants."""
    a, b = [], []
    for s in search.samples:
        if s.stage != "taxels" or s.train.all():
            continue
        r = s.run
        p = readings(r, search.base)
        on = p.max(1) > 5 * search.noise
        if s.train.any():
            on &= r.t > r.t[0] + 0.75 * (r.t[-1] - r.t[0])
        for k, value in search.silent.items():
            a.append((r.z[on, k] - p[on, k]) ** 2)
            b.append((r.z[on, k] - value) ** 2)
    return (np.concatenate(a), np.concatenate(b)) if a else (np.zeros(0), np.zeros(0))
