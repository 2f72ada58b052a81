"""Where touch and its simulation part: by taxel, in time, and with what the rest of a pad's error goes."""

from __future__ import annotations

import numpy as np

from dexsim.gap.effects.catalogue import TOUCH_EFFECTS
from dexsim.gap.read.runs import spans
from dexsim.gap.touch.fit import PadFit, TouchTrial
from dexsim.gap.touch.plant import readings
from dexsim.gap.touch.result import PadCurve


def by_taxel(pad: PadFit, t: TouchTrial) -> np.ndarray:
    """[K] N, rms error of each taxel over all recordings."""
    return np.sqrt(np.mean(np.concatenate([(r.z - readings(r, t.values)) ** 2 for r in pad.runs]), 0))


def when(e: str, pad: PadFit, t: TouchTrial) -> list[dict]:
    """Stretches in which the effect changes the readings by more than a quarter of its most."""
    out = []
    for r in pad.runs:
        off = TOUCH_EFFECTS[e].changes(r, t, pad.base)
        on = off > 0.25 * max(float(np.percentile(off, 99.5)), 1e-9)
        out += [{"recording": r.recording, "start": round(a, 4), "end": round(b, 4)} for a, b in spans(r.t, on, 0.03)]
    return out[:400]


def depends_on(pad: PadFit, t: TouchTrial, name: str) -> list[str]:
    """What the error that is left on a pad goes with, in words."""
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
        c = float(np.corrcoef(np.argsort(np.argsort(x)), np.argsort(np.argsort(y)))[0, 1]) if x.std() > 0 else 0.0
        if abs(c) > 0.4:
            said.append((abs(c), f"{what} (touch of the {name}, rank correlation {c:.2f})"))
    return [x for _, x in sorted(said, reverse=True)[:2]]


def curve(pad: PadFit, name: str, none: TouchTrial, best: TouchTrial, whole: bool) -> PadCurve:
    """The last recording of a pad for the page: all of it, or its last quarter, which was kept out of the fit."""
    run = pad.runs[-1]
    before, after = readings(run, none.values), readings(run, best.values, best.gains, best.order)
    for k, value in pad.silent.items():
        after[:, k] = value
    load = None if run.load is None else np.interp(run.t, run.grid, run.load)
    pick = run.t >= (run.t[0] if whole else run.t[0] + 0.75 * (run.t[-1] - run.t[0]))
    measured, before, after = (x[pick].sum(1) for x in (run.z, before, after))
    return PadCurve(name, run.recording, run.t[pick], measured, before, after, None if load is None else load[pick])
