"""Touch and contact: what the taxels show that simulation leaves out, pad by pad, judged on recordings kept out.

Without the geometry of what is touched, the taxels alone still show the dead, the stuck and the exchanged ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dexsim.assets import xhand
from dexsim.gap.effects.catalogue import TOUCH_EFFECTS, touch_confusable
from dexsim.gap.effects.effect import word
from dexsim.gap.effects.tactile_gain import TactileGain
from dexsim.gap.judge.errors import rms_interval
from dexsim.gap.touch.handed_on import chord
from dexsim.gap.touch.plant import contact, readings
from dexsim.gap.touch.read import TouchData, collect, newtons
from dexsim.gap.touch.search import GAIN_OFF, PadOutcome, PadSearch, TouchTrial, held_out_rms
from dexsim.gap.touch.settings import Fit, PadFacts
from dexsim.recording.mechanism import Mechanism
from dexsim.recording.schema import Recording

ROWS = xhand.ROWS  # k = column * 12 + row
SET_SHARE = 0.12  # of the bootstraps: a rival of the same class with as much belongs to the set
AGREE = 5  # taxels with one gain from which on those that hardly felt anything are taken to have it too
SHORT = 3.0  # s of touch on a pad, at least, before anything but broken taxels is looked for


@dataclass
class PadCurve:
    """A held-out stretch of one pad: sums over its taxels [N] against t [s]; load: of the cell, or None."""

    pad: str
    recording: str
    t: np.ndarray
    measured: np.ndarray
    before: np.ndarray
    after: np.ndarray
    load: np.ndarray | None


@dataclass
class TouchResult:
    """findings as `diagnosis.json` has them; before, after: [N] held-out rms of the taxels' readings (of all judged
    pads) with 90 % intervals (value, low, high), None where no force could be predicted; floor [N]; error [F, K] N rms
    of each taxel before; structured: whether something is left that no effect explains; pads: by name (before, after,
    noise)."""

    findings: list[dict[str, Any]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    before: tuple[float, float, float] | None = None
    after: tuple[float, float, float] | None = None
    floor: float | None = None
    error: np.ndarray | None = None
    structured: bool = False
    pads: dict[str, dict[str, float]] = field(default_factory=dict)
    curves: list[PadCurve] = field(default_factory=list)
    nuisance: dict[str, float] = field(default_factory=dict)
    recordings: list[str] = field(default_factory=list)
    depends_on: list[str] = field(default_factory=list)
    contact: dict[str, list[tuple[float, float]]] = field(default_factory=dict)  # by recording: stretches in touch, s
    tactile: bool = False  # whether taxels were recorded at all
    facts: dict[str, PadFacts] = field(
        default_factory=dict
    )  # by name of pad: what `touch_handed` needs beside the findings


def diagnose(
    recordings: list[Recording],
    m: Mechanism,
    held: set[str],
    seed: int = 0,
    allowed: set[str] | None = None,
    progress: Callable[[int, int, str], None] | None = None,
) -> TouchResult:
    """Touch of all recordings. held: names of those kept out of the fit."""
    out = TouchResult(contact={r.path.name: s for r in recordings if (s := stretches(r))})
    touching = [r for r in recordings if r.tactile is not None]
    if not touching:
        return out
    out.tactile = True
    data = collect(touching, m)
    out.notes += data.notes
    broken = findings(touching)
    searched = set()
    squares: dict[str, list[np.ndarray]] = {"before": [], "after": []}
    times: list[np.ndarray] = []
    floors = []
    pads = data.pads()
    for i, pad in enumerate(pads):
        name = xhand.FINGERS[pad]
        if progress:
            progress(i, len(pads), f"touch of the {name}")
        runs = [r for r in data.runs if r.pad == pad]
        seconds = sum(float(np.sum(r.z.sum(1) > 0.1) * np.median(np.diff(r.t))) for r in runs)
        if seconds < SHORT:
            out.notes.append(
                f"the {name}'s pad is touched for {seconds:.1f} s only: its forces are not judged (at least {SHORT:g} s)"
            )
            continue
        names = {r.recording for r in runs}
        kept = held & names if held & names and names - held else set()
        if not kept and len(names) >= 3:
            kept = {runs[-1].recording}
        search = PadSearch(runs, kept, data.scale_known, data.thermometer, seed + pad, allowed)
        outcome = search.run()
        searched.add(pad)
        _judge(out, search, outcome, data, squares, times, floors, kept)
    for f in broken:
        pad = int(f["where"]["taxels"][0].split(":")[0])
        if pad not in searched:
            out.findings.append(f)
            out.facts[xhand.FINGERS[pad]] = PadFacts(_readings_of(touching, f["where"]["taxels"]), judged=False)
    if progress and pads:
        progress(len(pads), len(pads), "")
    if times:
        out.before = rms_interval(squares["before"], times, seed)
        out.after = rms_interval(squares["after"], times, seed)
        out.floor = float(np.sqrt(np.mean(np.square(floors))))
    return out


def _judge(out: TouchResult, search: PadSearch, o: PadOutcome, data: TouchData, squares, times, floors, kept) -> None:
    name = xhand.FINGERS[o.pad]
    none, best = o.none, o.best
    bounds = search.intervals(best) if best.keys else {}
    dead = _broken(search, o.pad)
    # the error is that of the signals in which something was found: readings, the cell's force, shear
    stages = sorted({_stage(search, e) for e in best.ids} | ({0} if dead is not None or not best.ids else set()))
    e0, e1 = (np.concatenate([held_out_rms(search, t, k)[1] for k in stages]) for t in (none, best))
    blocks = np.concatenate([held_out_rms(search, best, k)[2] for k in stages])
    after = float(np.sqrt(e1.mean())) if len(e1) else 0.0
    if not len(e0):
        out.notes.append(f"the {name}'s pad feels nothing in what was kept out: nothing is judged there")
        return
    silent = _silent_squares(search) if 0 in stages else (np.zeros(0), np.zeros(0))
    squares["before"].append(np.concatenate([e0, silent[0]]))
    squares["after"].append(np.concatenate([e1, silent[1]]))
    times.append(np.concatenate([blocks, np.repeat(blocks[-1:], len(silent[0]))]) * 0.5)
    floors.append(_floor(search, stages))
    rms = lambda x: float(np.sqrt(np.mean(x))) if len(x) else 0.0  # noqa: E731
    out.pads[name] = {"before": rms(squares["before"][-1]), "after": rms(squares["after"][-1]), "noise": search.noise}
    if dead is not None:
        dead["held_out"] = {"before": out.pads[name]["before"], "after": rms(np.concatenate([e0, silent[1]]))}
    fresh: list[dict[str, Any]] = []
    for e in best.ids:
        effect = TOUCH_EFFECTS[e]
        stage = _stage(search, e)
        less = search._without(best, e) if len(best.ids) > 1 else none
        b, a = held_out_rms(search, less, stage)[0], held_out_rms(search, best, stage)[0]
        rivals, share = o.rivals[e], o.confidence[e]
        same = [r for r in rivals if touch_confusable(r[0], e) and r[1] >= SET_SHARE][:2]
        earned = float(np.clip((b - a) / (0.1 * b + 1e-12), 0.0, 1.0)) if np.isfinite(a) else 0.5
        if earned <= 0.2:
            out.notes.append(
                f"{e} on the {name}'s pad earned its place in training but not on what was kept out; not claimed"
            )
            continue
        taxels, parameters = _parameters(e, best, bounds, search, o.pad)
        fresh.append({
            "effect": e, "confidence": round(float(min(share * (0.3 + 0.7 * earned), 0.99)), 3),
            "alternatives": [{"effect": x, "confidence": round(c, 3)} for x, c in rivals[:3]],
            "indistinguishable": [e, *(x for x, _ in same)] if same else [],
            "separating_experiment": effect.experiment if same else None,
            "where": {"joints": [], "taxels": taxels, "topics": ["/tactile"]}, "regime": effect.shows,
            "when": _when(e, search, best), "parameters": parameters,
            "held_out": {"before": b, "after": a},
        })  # fmt: skip
    if dead is not None:  # one finding per effect and pad: broken taxels are gains of 0
        gain = next((f for f in fresh if TOUCH_EFFECTS[f["effect"]].by_taxel), None)
        if gain is None:
            fresh.append(dead)
        else:
            _merge(gain, dead)
    out.findings += fresh
    run = search.runs[0]
    common = (best.values["gain"], *bounds["gain"]) if "gain" in best.keys else None
    out.facts[name] = PadFacts(dict(search.silent), common, _rest(search, best), _chord(search, best, bounds), max(float(r.warm.max()) for r in search.runs), run.stiffness, run.friction,
                               search.shear)  # fmt: skip
    for k in ("scale", "zero", "along", "across", "spread", "clock"):
        if k in best.keys:
            out.nuisance[f"touch_{k}@{name}"] = round(best.values[k], 7)
    out.recordings = sorted(set(out.recordings) | (kept or {r.recording for r in search.runs}))
    loss = float(search.cross(best).sum()) / max(int(search.train.sum()), 1)
    if loss > 2.0**2 and after > 2.0 * _floor(search, stages):
        out.structured = True
        out.depends_on += _depends(search, best, name)
    error = np.zeros((len(xhand.FINGERS), xhand.TAXELS_PER_FINGER)) if out.error is None else out.error
    error[o.pad] = np.sqrt(np.mean(np.concatenate([(r.z - readings(r, none.values)) ** 2 for r in search.runs]), 0))
    out.error = error
    run = search.runs[-1]
    gains = best.gains
    p0, p1 = readings(run, none.values), readings(run, best.values, gains, best.order)
    for k, value in search.silent.items():
        p1[:, k] = value
    load = None if run.load is None else np.interp(run.t, run.grid, run.load)
    pick = run.t >= (run.t[0] if kept else run.t[0] + 0.75 * (run.t[-1] - run.t[0]))
    out.curves.append(
        PadCurve(
            name,
            run.recording,
            run.t[pick],
            run.z[pick].sum(1),
            p0[pick].sum(1),
            p1[pick].sum(1),
            None if load is None else load[pick],
        )
    )


def _rest(search: PadSearch, t: TouchTrial) -> Fit | None:
    """Gain of the taxels that hardly felt anything, where those that did agree on one that is not 1; None where they do
    not."""
    if t.gains is None:
        return None
    moved = np.zeros(len(t.gains), bool) if t.order is None else t.order != np.arange(len(t.gains))
    sure = (_gain_width(search, t) < 0.1) & ~moved & (sum(r.z.sum(0) for r in search.runs) > 0)
    sure[list(search.silent)] = False
    if sure.sum() < AGREE:
        return None
    low, value, high = _quantiles(
        t.gains[sure], _gain_width(search, t)[sure] ** -2.0, (0.05, 0.5, 0.95)
    )  # one barely known counts little
    return (value, low, high) if abs(value - 1) > GAIN_OFF and high - low < abs(value - 1) else None


def _quantiles(x: np.ndarray, weight: np.ndarray, at: tuple[float, ...]) -> list[float]:
    """Quantiles of x [n], each counting by its weight: the least value below or at which that share of the weights
    lies."""
    order = np.argsort(x)
    share = np.cumsum(weight[order]) / weight.sum()
    return [float(x[order][min(int(np.searchsorted(share, q)), len(x) - 1)]) for q in at]


def _chord(search: PadSearch, t: TouchTrial, bounds: dict[str, tuple[float, float]]) -> Fit | None:
    """The linear contact that stands for a fitted rubber over the recorded presses, as far as its numbers are known;
    None without one."""
    if not any("c10" in TOUCH_EFFECTS[e].fits for e in t.ids):
        return None
    fits = []
    for k in (None, 0, 1):
        v = t.values if k is None else t.values | {key: bounds[key][k] for key in ("c10", "c01")}
        pairs = [(contact(r, v)[0], r.depth + v["zero"]) for r in search.runs]
        fits.append(chord(*(np.concatenate(x) for x in zip(*pairs, strict=True))))
    if any(f is None for f in fits):
        return None
    return fits[0][0], min(f[1] for f in fits), max(f[2] for f in fits)


def _readings_of(recordings: list[Recording], taxels: list[str]) -> dict[int, float]:
    """What constant taxels ("pad:k") of one pad read for ever [N], by number; under two counts it is 0."""
    out = {}
    for pad, k in (map(int, t.split(":")) for t in taxels):
        values = [
            (float(np.median(np.nan_to_num(newtons(r)[0][:, pad, k, 2]))), 2 * (r.tactile_lsb or 0.0))
            for r in recordings
            if r.tactile.value.ndim == 4
        ]
        value, step = max(values)
        out[k] = value if value > max(step, 1e-6) else 0.0
    return out


def _stage(search: PadSearch, effect: str) -> int:
    """Which signal judges an effect: 0 the taxels, 1 the load cell (where there is one), 2 shear."""
    return {"cell": 1 if search.load else 0, "shear": 2}.get(TOUCH_EFFECTS[effect].stage, 0)


def _floor(search: PadSearch, stages: list[int]) -> float:
    """N: the noise of one reading; of a sum of taxels or a load cell, with what is not trusted of the plant."""
    if stages == [0]:
        return search.noise
    stage = search.stage_of()
    sigma = np.concatenate([s.sigma[s.mask] for s in search.samples])
    return float(np.sqrt(np.mean(sigma[np.isin(stage, stages)] ** 2)))


def _silent_squares(search: PadSearch) -> tuple[np.ndarray, np.ndarray]:
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


def _broken(search: PadSearch, pad: int) -> dict[str, Any] | None:
    if not search.silent:
        return None
    dead = [k for k, v in search.silent.items() if v == 0]
    stuck = [k for k, v in search.silent.items() if v != 0]
    said = "; ".join(
        x
        for x in (
            f"dead: {', '.join(map(str, dead))}" if dead else "",
            f"stuck: {', '.join(map(str, stuck))}" if stuck else "",
        )
        if x
    )
    return _taxel_finding(
        [f"{pad}:{k}" for k in sorted(search.silent)], f"constant while they are pressed ({said})", 0.95
    )


def _taxel_finding(names: list[str], regime: str, confidence: float) -> dict[str, Any]:
    return {
        "effect": TactileGain.id, "confidence": confidence, "alternatives": [], "indistinguishable": [], "separating_experiment": None,
        "where": {"joints": [], "taxels": names, "topics": ["/tactile"]}, "regime": regime, "when": [],
        "parameters": {"gain": {"value": 0.0, "low": 0.0, "high": 0.05, "unit": "1"}, "taxels": {"value": ", ".join(names), "low": None, "high": None, "unit": ""}},
        "held_out": None,
    }  # fmt: skip


def _merge(gain: dict, dead: dict) -> None:
    """Broken taxels into the finding of the pad's gains."""
    p = gain["parameters"]["gain"]
    count = len(gain["where"]["taxels"])
    wide = lambda x: list(np.atleast_1d(x)) if len(np.atleast_1d(x)) == count else [float(x)] * count  # noqa: E731
    for key, zero in (("value", 0.0), ("low", 0.0), ("high", 0.05)):
        p[key] = [float(x) for x in wide(p[key])] + [zero] * len(dead["where"]["taxels"])
    gain["where"]["taxels"] = [*gain["where"]["taxels"], *dead["where"]["taxels"]]
    gain["parameters"]["taxels"]["value"] = ", ".join(gain["where"]["taxels"])
    gain["regime"] += "; " + dead["regime"]


def _group(search: PadSearch, pad: int) -> list[str]:
    """Names of the taxels that felt anything."""
    felt = sum((r.z > max(2 * r.lsb, 3 * search.noise)).sum(0) for r in search.runs)
    return [f"{pad}:{k}" for k in np.flatnonzero(felt > 3)]


def _parameters(e: str, t: TouchTrial, bounds, search: PadSearch, pad: int) -> tuple[list[str], dict[str, Any]]:
    """(taxels concerned, parameters with intervals by the catalogue's keys)."""
    effect = TOUCH_EFFECTS[e]
    taxels, out = _group(search, pad), {}
    if effect.by_taxel and t.gains is not None:
        g = t.gains
        moved = [] if t.order is None else [int(k) for k in np.flatnonzero(t.order != np.arange(len(g)))]
        half = _gain_width(search, t)
        off = [int(k) for k in np.flatnonzero(np.abs(g - 1) > np.maximum(GAIN_OFF, half))]
        chosen = sorted(set(off) | set(moved))
        names = [f"{pad}:{k}" for k in chosen]
        value = [round(float(g[k]), 4) for k in chosen]
        out["gain"] = {"value": value, "low": [max(v - float(half[k]), 0.0) for k, v in zip(chosen, value, strict=True)],
                       "high": [v + float(half[k]) for k, v in zip(chosen, value, strict=True)], "unit": "1"}  # fmt: skip
        if len(chosen) == 1 or (len(chosen) and np.ptp(value) < 0.05):
            out["gain"] = {
                "value": float(np.mean(value)),
                "low": float(np.mean(out["gain"]["low"])),
                "high": float(np.mean(out["gain"]["high"])),
                "unit": "1",
            }
        out["taxels"] = {"value": ", ".join(names), "low": None, "high": None, "unit": ""}
        if moved:
            pairs = sorted({tuple(sorted((k, int(t.order[k])))) for k in moved})
            out["taxels"]["swapped"] = [[f"{pad}:{a}", f"{pad}:{b}"] for a, b in pairs]
        return names, out
    run = search.runs[0]
    factor = {"stiffness": run.stiffness, "mu": run.friction}
    for key, name in effect.report:
        f = factor.get(key, 1.0)
        low, high = bounds.get(key, (t.values[key], t.values[key]))
        unit = "1/degC" if key == "drift" and search.thermometer else "1/s" if key == "drift" else _unit(key)
        out[name] = {"value": float(f * t.values[key]), "low": float(f * low), "high": float(f * high), "unit": unit}
    return taxels, out | {k: word(v) for k, v in effect.words_beside.items()}


def _unit(key: str) -> str:
    from dexsim.gap.touch.plant import PARAMS

    return PARAMS[key].unit


def _gain_width(search: PadSearch, t: TouchTrial) -> np.ndarray:
    """Half of the 90 % interval of each taxel's gain [K]: the disagreement of the folds, and 2 %."""
    maps = [search.gain_map(t, search.train & (search.fold != f)) for f in search.folds]
    if len(maps) < 2:
        return np.full(len(t.gains), 0.1)
    n = len(maps)
    se = np.sqrt((n - 1) / n * ((np.array(maps) - np.mean(maps, 0)) ** 2).sum(0))
    return 1.645 * np.hypot(se, 0.02)


def _when(e: str, search: PadSearch, t: TouchTrial) -> list[dict]:
    """Stretches in which the effect changes the readings by more than a quarter of its most."""
    out = []
    for r in search.runs:
        off = TOUCH_EFFECTS[e].changes(r, t, search.base)
        on = off > 0.25 * max(float(np.percentile(off, 99.5)), 1e-9)
        if not on.any():
            continue
        edge = np.flatnonzero(np.diff(np.r_[0, on.astype(int), 0]))
        step = float(np.median(np.diff(r.t)))
        merged: list[list[float]] = []
        for a, b in zip(r.t[edge[::2]], r.t[edge[1::2] - 1] + step, strict=True):
            if merged and a - merged[-1][1] < 0.03:
                merged[-1][1] = float(b)
            else:
                merged.append([float(a), float(b)])
        out += [{"recording": r.recording, "start": round(a, 4), "end": round(b, 4)} for a, b in merged]
    return out[:400]


def _depends(search: PadSearch, t: TouchTrial, name: str) -> list[str]:
    """What the leftover of a pad goes with, in words."""
    error, load, depth, speed = [], [], [], []
    for r in search.runs:
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
    for what, x in (("the force", load), ("the depth", depth), ("how fast it is pressed", speed)):
        x = np.concatenate(x)
        c = float(np.corrcoef(np.argsort(np.argsort(x)), np.argsort(np.argsort(y)))[0, 1]) if x.std() > 0 else 0.0
        if abs(c) > 0.4:
            said.append((abs(c), f"{what} (touch of the {name}, rank correlation {c:.2f})"))
    return [x for _, x in sorted(said, reverse=True)[:2]]


def stretches(r: Recording) -> list[tuple[float, float]]:
    """Times (start, end) [s] in which something is touched: taxels, or a load cell where there are none."""
    if r.tactile is not None and r.tactile.value.ndim == 4 and len(r.tactile) > 5:
        z = np.nan_to_num(newtons(r)[0][..., 2])
        still = np.ptp(z, axis=0) == 0  # a stuck taxel is no touch
        t, on = r.tactile.t, np.where(still, 0.0, z).max((1, 2)) > 0.15
    elif r.external_force is not None and len(r.external_force) > 5:
        size = np.linalg.norm(np.nan_to_num(r.external_force.value[:, :3]), axis=1)
        size = size - np.percentile(size, 5)
        t, on = r.external_force.t, size > max(0.3, 0.05 * float(size.max()))
    else:
        return []
    edge = np.flatnonzero(np.diff(np.r_[0, on.astype(int), 0]))
    step = float(np.median(np.diff(t)))
    out: list[tuple[float, float]] = []
    for a, b in zip(t[edge[::2]], t[edge[1::2] - 1] + step, strict=True):
        if out and a - out[-1][1] < 0.3:
            out[-1] = (out[-1][0], float(b))
        else:
            out.append((float(a), float(b)))
    return [(a, b) for a, b in out if b - a > 0.03]


def findings(recordings: list[Recording]) -> list[dict[str, Any]]:
    """Findings `tactile_gain` from the taxels alone: those that stay constant while at least three neighbours on the
    pad feel many counts. Their gain is 0."""
    worst: dict[int, set[int]] = {}
    seen = False
    for r in recordings:
        if r.tactile is None or r.tactile.value.ndim != 4 or len(r.tactile) < 20:
            continue
        seen = True
        z = np.nan_to_num(r.tactile.value[..., 2])  # [T, F, K]
        span = z.max(0) - z.min(0)
        for f in range(span.shape[0]):
            bad = _constant(span[f])
            worst[f] = worst[f] & bad if f in worst else bad
    if not seen:
        return []
    return [_taxel_finding([f"{f}:{k}" for k in sorted(taxels)], "constant while their neighbours feel a touch", 0.85)
            for f, taxels in sorted(worst.items()) if taxels]  # fmt: skip


def _constant(span: np.ndarray) -> set[int]:
    """Taxels [K] with no change although three neighbours changed by a tenth of the pad's largest."""
    top = float(span.max())
    if top <= 0 or len(span) % ROWS:
        return set()
    grid = span.reshape(-1, ROWS)
    felt = (grid > 0.1 * top).astype(int)
    neighbours = np.zeros_like(felt)
    neighbours[1:] += felt[:-1]
    neighbours[:-1] += felt[1:]
    neighbours[:, 1:] += felt[:, :-1]
    neighbours[:, :-1] += felt[:, 1:]
    return {int(k) for k in np.flatnonzero(((grid == 0) & (neighbours >= 3)).reshape(-1))}
