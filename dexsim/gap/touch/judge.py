"""One pad's answer judged on what was held out of the fit: errors before and after, where touch and its simulation
part, findings with their doubts, facts for training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from dexsim.gap.effects import Fit, PadFacts, word
from dexsim.gap.effects.catalogue import TOUCH_EFFECTS, touch_confusable
from dexsim.gap.effects.touch import TactileGain
from dexsim.gap.finding import Finding, chances, removed
from dexsim.gap.inquiry import PadCurve
from dexsim.gap.judge import confidence
from dexsim.gap.judge.held_out import gain_interval, rms
from dexsim.gap.read import spans
from dexsim.gap.rules import JUDGE, SEARCH, TOUCH
from dexsim.gap.touch.plant import PARAMS, contact, readings
from dexsim.gap.touch.read import newtons
from dexsim.gap.touch.search import PadFit, PadOutcome, PadSearch, TouchTrial
from dexsim.recording.schema import TACTILE, Recording
from dexsim.tactile.sensors import Sensors


class PadAnswer:
    """A searched pad on what was held out.

    before, after: squared errors [N^2] of the signals in which something was found (readings, the cell's force, shear)
    without any effect and with what was found; times: of each [s], unique over the recordings; bounds: 90 % intervals
    of the fitted parameters; numbers: rms [N] for the page; facts: what training is told beside the findings. felt:
    whether what was held out feels anything; nothing is judged otherwise."""

    def __init__(self, search: PadSearch, outcome: PadOutcome, kept: set[str]):
        self.search, self.outcome, self.kept = search, outcome, kept
        self.pad, self.name = outcome.pad, search.name
        self.none, self.best = outcome.none, outcome.best
        self.notes: list[str] = []
        self.bounds = search.intervals(self.best) if self.best.keys else {}
        self.constant = pressed(search.silent, self.pad)
        unmoved = {0} if self.constant is not None or not self.best.ids else set()
        self.stages = sorted({_stage(search, e) for e in self.best.ids} | unmoved)
        e0, e1 = (np.concatenate([held_out(search, t, k)[1] for k in self.stages]) for t in (self.none, self.best))
        blocks = np.concatenate([held_out(search, self.best, k)[2] for k in self.stages])
        self.felt = bool(len(e0))
        if not self.felt:
            self.notes.append(f"the {self.name}'s pad feels nothing in what was held out: nothing is judged there")
            return
        silent = _silent_squares(search) if 0 in self.stages else (np.zeros(0), np.zeros(0))
        self.before, self.after = np.concatenate([e0, silent[0]]), np.concatenate([e1, silent[1]])
        self.times = np.concatenate([blocks, np.repeat(blocks[-1:], len(silent[0]))]) * 0.5
        self.floor = _floor(search, self.stages)
        self.left = float(np.sqrt(e1.mean()))  # what the plant leaves, constant taxels apart
        self.numbers = {"before": rms(self.before), "after": rms(self.after), "noise": search.noise}
        if self.constant is not None:
            left = {"before": self.numbers["before"], "after": rms(np.concatenate([e0, silent[1]]))}
            self.constant = replace(self.constant, held_out=left)

    def findings(self) -> list[Finding]:
        """Return what was found."""
        found = [f for e in self.best.ids if (f := self._finding(e)) is not None]
        if self.constant is not None:  # one finding per effect and pad: constant taxels are gains of 0
            k = next((k for k, f in enumerate(found) if TOUCH_EFFECTS[f.effect].by_taxel), None)
            if k is None:
                found.append(self.constant)
            else:
                found[k] = with_constant(found[k], self.constant)
        return found

    def _finding(self, e: str) -> Finding | None:
        """Return one effect; None where it did not help on what was held out."""
        search, best, effect = self.search, self.best, TOUCH_EFFECTS[e]
        stage = _stage(search, e)
        less = search.without(best, e) if len(best.ids) > 1 else self.none
        (b, without, blocks), (a, with_it, _) = (held_out(search, x, stage) for x in (less, best))
        rivals, share = self.outcome.rivals[e], self.outcome.confidence[e]
        same = [r for r in rivals if touch_confusable(r[0], e) and r[1] >= JUDGE.level][:2]
        judged = np.isfinite(a)  # what nothing held out shows is doubted
        earned = confidence.earned(b, a) if judged else JUDGE.doubted
        if earned <= TOUCH.earned:
            self.notes.append(
                f"{e} on the {self.name}'s pad earned its place in training but not on what was held out; not claimed"
            )
            return None
        taxels, parameters = self._parameters(e)
        gain = gain_interval(without, with_it, 0.5 * blocks)
        return Finding(
            e,
            round(float(min(share * earned, JUDGE.surest)), 3),
            effect.shows,
            taxels=taxels,
            topics=[TACTILE],
            alternatives=chances(rivals),
            indistinguishable=[e, *(x for x, _ in same)] if same else [],
            separating_experiment=effect.experiment if same else None,
            when=when(e, search, best),
            parameters=parameters,
            held_out=removed(b, a, gain),
        )

    def facts(self) -> PadFacts:
        """Return what training is told of the pad beside its findings."""
        search, best, run = self.search, self.best, self.search.runs[0]
        common = (best.values["gain"], *self.bounds["gain"]) if "gain" in best.keys else None
        warmest = max(float(r.warm.max()) for r in search.runs)
        return PadFacts(
            dict(search.silent), common, self._rest(), self._chord(), warmest, run.stiffness, run.friction, search.shear
        )

    def nuisance(self) -> dict[str, float]:
        """Return the refitted beliefs by the keys of `diagnosis.json`."""
        keys = [k for k in ("scale", "zero", "along", "across", "spread", "clock") if k in self.best.keys]
        return {f"touch_{k}@{self.name}": round(self.best.values[k], 7) for k in keys}

    def recordings(self) -> set[str]:
        """Names of the recordings that it was judged by."""
        return self.kept or {r.recording for r in self.search.runs}

    def structured(self) -> bool:
        """Return whether something is left that no effect explains."""
        search = self.search
        loss = float(search.cross(self.best).sum()) / max(int(search.train.sum()), 1)
        return loss > JUDGE.within**2 and self.left > JUDGE.within * self.floor

    def _rest(self) -> Fit | None:
        """Return gain of the taxels that hardly felt anything, where those that did agree on one that is not 1; None
        where they do not."""
        search, t = self.search, self.best
        if t.gains is None:
            return None
        moved = np.zeros(len(t.gains), bool) if t.order is None else t.order != np.arange(len(t.gains))
        width = search.gain_width(t)
        sure = (width < TOUCH.law) & ~moved & (sum(r.z.sum(0) for r in search.runs) > 0)
        sure[list(search.silent)] = False
        if sure.sum() < TOUCH.agree:
            return None
        # one barely known counts little
        at = {"weights": width[sure] ** -2.0, "method": "inverted_cdf"}
        low, value, high = (float(x) for x in np.quantile(t.gains[sure], (0.05, 0.5, 0.95), **at))
        return (value, low, high) if abs(value - 1) > TOUCH.law and high - low < abs(value - 1) else None

    def _chord(self) -> Fit | None:
        """Return the linear contact that stands for a fitted rubber over the recorded presses, as far as its numbers
        are known; None without one."""
        t = self.best
        rubber = [key for e in t.ids for key in TOUCH_EFFECTS[e].rubber]
        if not rubber:
            return None
        fits = []
        for k in (None, 0, 1):
            v = t.values if k is None else t.values | {key: self.bounds[key][k] for key in rubber}
            pairs = [(contact(r, v)[0], r.depth + v["zero"]) for r in self.search.runs]
            fits.append(chord(*(np.concatenate(x) for x in zip(*pairs, strict=True))))
        found = [f for f in fits if f is not None]
        if len(found) < len(fits):
            return None
        return found[0][0], min(f[1] for f in found), max(f[2] for f in found)

    def _parameters(self, e: str) -> tuple[list[str], dict[str, Any]]:
        """Return (taxels concerned, parameters with intervals by the catalogue's keys)."""
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
        """Return the same of a gain for every taxel: those that are off, and those that are exchanged."""
        t, pad = self.best, self.pad
        g = t.gains
        assert g is not None  # of such an effect
        moved = [] if t.order is None else [int(k) for k in np.flatnonzero(t.order != np.arange(len(g)))]
        half = self.search.gain_width(t)
        off = [int(k) for k in np.flatnonzero(np.abs(g - 1) > np.maximum(TOUCH.law, half))]
        chosen = sorted(set(off) | set(moved))
        names = [f"{pad}:{k}" for k in chosen]
        value = [round(float(g[k]), 4) for k in chosen]
        low = [max(v - float(half[k]), 0.0) for k, v in zip(chosen, value, strict=True)]
        high = [v + float(half[k]) for k, v in zip(chosen, value, strict=True)]
        each: dict[str, list[float]] = {"value": value, "low": low, "high": high}
        # one number stands for them where they are; no name hangs on it
        alike = len(chosen) == 1 or (len(chosen) and np.ptp(value) < 0.05)
        gain: dict[str, Any] = {k: float(np.mean(x)) if alike else x for k, x in each.items()} | {"unit": "1"}
        taxels: dict[str, Any] = {"value": ", ".join(names), "low": None, "high": None, "unit": ""}
        out = {"gain": gain, "taxels": taxels}
        if t.order is not None and moved:
            pairs = sorted({tuple(sorted((k, int(t.order[k])))) for k in moved})
            out["taxels"]["swapped"] = [[f"{pad}:{a}", f"{pad}:{b}"] for a, b in pairs]
        return names, out


def held_out(pad: PadFit, trial: TouchTrial, stage: int = 0) -> tuple[float, np.ndarray, np.ndarray]:
    """Return (rms [N], squared errors, blocks) on residuals held out, of one stage, over taxels that feel something."""
    at = ~pad.train & (pad.stage_of() == stage)
    sigma = np.concatenate([s.sigma[s.mask] for s in pad.samples])
    e = (trial.res * sigma)[at] ** 2
    return (float(np.sqrt(e.mean())) if len(e) else float("nan")), e, pad.block[at]


def _stage(search: PadFit, effect: str) -> int:
    """Return which signal judges an effect: 0 the taxels, 1 the load cell (where there is one), 2 shear."""
    return {"cell": 1 if search.load else 0, "shear": 2}.get(TOUCH_EFFECTS[effect].stage, 0)


def _floor(search: PadFit, stages: list[int]) -> float:
    """Return n: the noise of one reading; of a sum of taxels or a load cell, with what is not trusted of the plant."""
    if stages == [0]:
        return search.noise
    stage = search.stage_of()
    sigma = np.concatenate([s.sigma[s.mask] for s in search.samples])
    return float(np.sqrt(np.mean(sigma[np.isin(stage, stages)] ** 2)))


def _silent_squares(search: PadFit) -> tuple[np.ndarray, np.ndarray]:
    """Return squared errors of the dead and stuck taxels on what was held out: as believed, and as constants."""
    a, b = [], []
    for s in search.samples:
        if s.stage != "taxels" or s.train.all():
            continue
        r = s.run
        p = readings(r, search.base)
        on = p.max(1) > JUDGE.far * search.noise  # the pad is touched: elsewhere both errors are noise
        if s.train.any():
            on &= r.t > r.t[0] + 0.75 * (r.t[-1] - r.t[0])
        for k, value in search.silent.items():
            a.append((r.z[on, k] - p[on, k]) ** 2)
            b.append((r.z[on, k] - value) ** 2)
    return (np.concatenate(a), np.concatenate(b)) if a else (np.zeros(0), np.zeros(0))


def chord(force: np.ndarray, depth: np.ndarray) -> Fit | None:
    """Return stiffness [N/m] of a straight line through a law's points (force [n] N, depth [n] m): the least-squares
    one, and force over depth under and over which a tenth of the force is felt; None where nothing is pressed."""
    on = (force > 0.2) & (depth > 1e-4)  # below, force over depth is noise over noise
    if on.sum() < 5:
        return None
    force, depth = force[on], depth[on]
    order = np.argsort(force / depth)
    felt = np.cumsum(force[order]) / force.sum()
    low, high = (force / depth)[order][np.searchsorted(felt, [0.1, 0.9])]
    return float(force @ depth / (depth @ depth)), float(low), float(high)


# -- where touch and its simulation part ------------------------------------------------------------------------------
# Where touch and its simulation part: by taxel, in time, and with what the rest of a pad's error goes.


def by_taxel(pad: PadFit, t: TouchTrial) -> np.ndarray:
    """Return [K] N, rms error of each taxel over all recordings."""
    return np.sqrt(np.mean(np.concatenate([(r.z - readings(r, t.values)) ** 2 for r in pad.runs]), 0))


def when(e: str, pad: PadFit, t: TouchTrial) -> list[dict]:
    """Stretches in which the effect changes the readings by more than `JUDGE.acts` of its most."""
    out = []
    for r in pad.runs:
        off = TOUCH_EFFECTS[e].changes(r, t, pad.base)
        on = off > JUDGE.acts * max(float(np.percentile(off, 99.5)), 1e-9)
        out += [{"recording": r.recording, "start": round(a, 4), "end": round(b, 4)} for a, b in spans(r.t, on, 0.03)]
    return out[:400]


def depends_on(pad: PadFit, t: TouchTrial, name: str) -> list[str]:
    """Return what the error that is left on a pad goes with, in words."""
    error, load, depth, speed = [], [], [], []
    for r in pad.runs:
        e = np.abs(r.z - readings(r, t.values, t.gains, t.order)).max(1)
        on = r.z.sum(1) > 0.2
        error.append(e[on])
        load.append(r.z.sum(1)[on])
        depth.append(np.interp(r.t, r.grid, r.depth)[on])
        speed.append(np.interp(r.t, r.grid, np.abs(np.gradient(r.depth, r.grid)))[on])
    y = np.concatenate(error)
    if len(y) < 20 or y.std() == 0:
        return []
    said = []
    for what, parts in (("the force", load), ("the depth", depth), ("how fast it is pressed", speed)):
        x = np.concatenate(parts)
        c = float(spearmanr(x, y).statistic) if x.std() > 0 else 0.0
        if c**2 > SEARCH.least:
            said.append((abs(c), f"{what} (touch of the {name}, rank correlation {c:.2f})"))
    return [x for _, x in sorted(said, reverse=True)[:2]]


def curve(pad: PadFit, name: str, none: TouchTrial, best: TouchTrial, whole: bool) -> PadCurve:
    """Return the last recording of a pad for the page: all of it, or its last quarter, which was held out of the
    fit."""
    run = pad.runs[-1]
    before, after = readings(run, none.values), readings(run, best.values, best.gains, best.order)
    for k, value in pad.silent.items():
        after[:, k] = value
    load = None if run.load is None else np.interp(run.t, run.grid, run.load)
    pick = run.t >= (run.t[0] if whole else run.t[0] + 0.75 * (run.t[-1] - run.t[0]))
    measured, before, after = (x[pick].sum(1) for x in (run.z, before, after))
    return PadCurve(name, run.recording, run.t[pick], measured, before, after, None if load is None else load[pick])


# -- taxels that read the same for ever -------------------------------------------------------------------------------
# Taxels that read the same for ever, dead or stuck: seen from the readings alone, without any geometry.


def constant_taxels(recordings: list[Recording], sensors: Sensors) -> list[Finding]:
    """Return findings `tactile_gain` from the taxels alone: those that stay constant while at least three neighbours on
    the pad feel many counts. Their gain is 0."""
    if sensors.layout is None:
        return []
    worst: dict[int, set[int]] = {}
    beside = [sensors.beside(f) for f in range(sensors.layout.pads)]
    seen = False
    for r in recordings:
        if r.tactile is None or r.tactile.value.ndim != 4 or len(r.tactile) < 20:
            continue
        seen = True
        z = np.nan_to_num(r.tactile.value[..., 2])  # [T, F, K]
        span = z.max(0) - z.min(0)
        for f in range(min(span.shape[0], len(beside))):
            bad = _constant(span[f], beside[f])
            worst[f] = worst[f] & bad if f in worst else bad
    if not seen:
        return []
    regime = "constant while their neighbours feel a touch"
    return [
        constant_finding([f"{f}:{k}" for k in sorted(taxels)], regime, JUDGE.sure)
        for f, taxels in sorted(worst.items())
        if taxels
    ]


def _constant(span: np.ndarray, beside: list[list[int]]) -> set[int]:
    """Return taxels [K] with no change although `TOUCH.neighbours` beside them changed by `TOUCH.spread` of the pad's
    largest: more than what a touch beside them may pass on."""
    top = float(span.max())
    if top <= 0 or len(span) < len(beside):
        return set()
    felt = span > TOUCH.spread * top
    return {k for k, near in enumerate(beside) if span[k] == 0 and felt[near].sum() >= TOUCH.neighbours}


def readings_of(recordings: list[Recording], taxels: Sequence[str]) -> dict[int, float]:
    """Return what constant taxels ("pad:k") of one pad read for ever [N], by number; under two counts it is 0."""
    out = {}
    for pad, k in (map(int, t.split(":")) for t in taxels):
        values = [
            (float(np.median(np.nan_to_num(newtons(r)[0][:, pad, k, 2]))), 2 * (r.tactile_lsb or 0.0))
            for r in recordings
            if r.tactile is not None and r.tactile.value.ndim == 4
        ]
        value, step = max(values)
        out[k] = value if value > max(step, 1e-6) else 0.0
    return out


def constant_finding(names: list[str], regime: str, sure: float) -> Finding:
    """Return gains of 0 of taxels ("pad:k")."""
    sizes = {"gain": {"value": 0.0, "low": 0.0, "high": 0.05, "unit": "1"}, "taxels": word(", ".join(names))}
    return Finding(TactileGain.id, sure, regime, taxels=names, topics=[TACTILE], parameters=sizes)


def pressed(silent: dict[int, float], pad: int) -> Finding | None:
    """Return the finding of a pad's taxels that read the same although the plant has them pressed. silent: their
    reading [N] by number."""
    if not silent:
        return None
    kinds = {"dead": [k for k, v in silent.items() if v == 0], "stuck": [k for k, v in silent.items() if v != 0]}
    said = "; ".join(f"{kind}: {', '.join(map(str, taxels))}" for kind, taxels in kinds.items() if taxels)
    regime = f"constant while they are pressed ({said})"
    return constant_finding([f"{pad}:{k}" for k in sorted(silent)], regime, JUDGE.surest)


def with_constant(gain: Finding, dead: Finding) -> Finding:
    """Return the finding of a pad's gains with its broken taxels."""
    p, count, more = gain.parameters["gain"], len(gain.taxels), len(dead.taxels)
    wide = lambda x: list(np.atleast_1d(x)) if len(np.atleast_1d(x)) == count else [float(x)] * count  # noqa: E731
    ends = {k: [float(x) for x in wide(p[k])] + [z] * more for k, z in (("value", 0.0), ("low", 0.0), ("high", 0.05))}
    names = [*gain.taxels, *dead.taxels]
    sizes = gain.parameters | {"gain": p | ends, "taxels": gain.parameters["taxels"] | {"value": ", ".join(names)}}
    return replace(gain, taxels=names, parameters=sizes, regime=f"{gain.regime}; {dead.regime}")
