"""What holds in all recordings of one machine, judged over them together: the lag and the scale of a position, and the
sign and the scale of an effort. A recording that contradicts the others is named; nothing is left out for it.

Also the delays between a target, the duty, the effort and the motion, by which their order shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dexsim.gap.read import Run

STEP, REACH = 0.005, 0.4
"""s: grid on which a lag is measured, and the longest that is looked for."""
CLEAR, ALONE = 0.8, 0.1
"""Correlation of speeds that tells a lag, and by how much it is above that of any other lag: less in a narrow band."""
DIFFERS = {"lag": 0.03, "scale": np.log(1.5), "effort scale": np.log(4.0)}
"""s, or log of a factor, by which one recording must differ from the others to contradict them."""
MADE, USUAL = 3.0, 0.6
"""x the others' own spread, and of a lag x their median, that this must be, too: a drive at its limits lags more."""
FINE, LATEST = 0.002, 0.1
"""s: grid and reach of the delay of a stage."""
EXPLAINED, SHARP = 0.7, 0.1
"""Part of a stage that the one before explains, and of what is left that must come back 40 ms off the best delay."""


@dataclass(frozen=True)
class Seen:
    """What a recording shows of a joint, each None where it cannot tell: lag [s] of the position behind its target;
    scale: of the position, over the target's; effort: N.m (or A) for each rad of target minus position, signed."""

    lag: float | None
    scale: float | None
    effort: float | None


def seen(run: Run, j: int) -> Seen:
    """Return what a run shows of joint j."""
    t, q = run.readings(j)
    if run.joints[j] in run.left_out or len(t) < 50 or t[-1] - t[0] < 4 * REACH:
        return Seen(None, None, None)
    grid = np.arange(t[0] + REACH, t[-1] - REACH, STEP)
    lag = _lag(run, j, grid, t, q)
    scale = None
    if lag is not None:
        c, x = run.command_at(grid - lag)[:, j], np.interp(grid, t, q)
        if np.corrcoef(c, x)[0, 1] > 0.9:
            scale = float(np.std(x) / np.std(c))
    effort = None
    if run.torque is not None and np.isfinite(run.torque[:, j]).sum() > 50:
        ok = np.isfinite(run.torque[:, j])
        drive, shown = (run.command_at(run.t)[:, j] - run.q[:, j])[ok], run.torque[ok, j]
        if min(drive.std(), shown.std()) > 0 and abs(r := np.corrcoef(drive, shown)[0, 1]) > 0.5:
            effort = float(r * shown.std() / drive.std())
    return Seen(lag, scale, effort)


def _lag(run: Run, j: int, grid: np.ndarray, t: np.ndarray, q: np.ndarray) -> float | None:
    """Return s by which the position follows its target, negative where it comes first; None where a correlation of
    speeds does not tell."""
    reach = round(REACH / STEP)
    wide = np.arange(grid[0] - REACH, grid[-1] + REACH + STEP / 2, STEP)[: len(grid) + 2 * reach]
    rate = lambda x: np.convolve(np.gradient(x), np.ones(5) / 5, "same")  # noqa: E731
    dq, dc = rate(np.interp(grid, t, q)), rate(run.command_at(wide)[:, j])
    if len(wide) < len(grid) + 2 * reach or np.ptp(run.cmd[:, j]) < 0.02 or dq.std() == 0 or dc.std() == 0:
        return None
    found = sliding_correlation(dc, dq)  # by where the target's stretch begins: lag = reach - place
    best = int(np.argmax(found))
    away = np.abs(np.arange(len(found)) - best) > 0.15 / STEP
    if found[best] < CLEAR or best in (0, len(found) - 1) or found[best] - found[away].max(initial=-1.0) < ALONE:
        return None
    return STEP * (reach - best)


def sliding_correlation(wide: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Return correlation of `part` [n] with every stretch of `wide` that is as long, by where the stretch begins."""
    from scipy.signal import correlate  # it takes an audit half a second to import

    power = np.r_[0.0, np.cumsum(wide**2)]
    size = np.sqrt(np.maximum(power[len(part) :] - power[: -len(part)], 1e-30)) * np.linalg.norm(part)
    return correlate(wide, part, "valid", "fft") / (size + 1e-12)


def contradictions(runs: Sequence[Run], joint: str) -> list[tuple[str, str, str]]:
    """Return (recording, kind of finding, text) of each that contradicts the others in what holds of one machine. Two
    that contradict each other are both named."""
    each = [(r, seen(r, r.joints.index(joint))) for r in runs if joint in r.joints]
    out = []
    alike = all(r.servo.to_dict() == runs[0].servo.to_dict() for r in runs)  # another gain has another lag
    for what in ("lag", "scale", "effort sign", "effort scale") if alike else ("scale", "effort sign"):
        field = what.split(" ")[0]
        values_of = [(r.name, x) for r, s in each if (x := getattr(s, field)) is not None]
        if what == "effort sign":
            values = np.array([np.sign(x) for _, x in values_of])
        elif what == "lag":
            values = np.array([x for _, x in values_of])
        else:
            values = np.log([abs(x) for _, x in values_of])
        for k, (name, x) in enumerate(values_of):
            others = np.delete(values, k)
            if not len(others):
                continue
            middle = float(np.median(others))
            spread = float(np.abs(others - middle).max())
            least = 1.0 if what == "effort sign" else max(DIFFERS[what], MADE * spread)
            if what == "lag":
                least = max(least, USUAL * abs(middle))
            if (what == "effort sign" and spread) or abs(values[k] - middle) <= least:
                continue
            theirs = [y for n, y in values_of if n != name]
            out.append((name, *_said(joint, what, x, theirs, np.exp(abs(values[k] - middle)))))
    return out


def _said(joint: str, what: str, mine: float, theirs: Sequence[float], factor: float) -> tuple[str, str]:
    """Return (kind of finding, text) of a value that contradicts those of other recordings."""
    rest = f"in {len(theirs)} other recordings" if len(theirs) > 1 else "in the other recording"
    if what == "lag":
        span = " to ".join(dict.fromkeys(f"{1e3 * x:.0f}" for x in (min(theirs), max(theirs))))
        return "clock_skew", (
            f"{joint} follows its target {1e3 * mine:.0f} ms late here and {span} ms late {rest}: the clocks of "
            "commands and states may be shifted, or the drive is set otherwise"
        )
    if what == "scale":
        return "unit", (
            f"{joint} goes {mine:.3g} x as far as its target here and {np.median(theirs):.3g} x {rest}: another unit, "
            "or something holds it"
        )
    if what == "effort sign":
        drives = "with" if mine > 0 else "against"
        return "sign_mismatch", (
            f"effort of {joint} acts {drives} target minus position here, and the other way {rest}: effort_sign of one "
            "of them is wrong (meta.effort_sign=...)"
        )
    text = f"effort of {joint} is {factor:.3g} times as large or small as {rest}: another unit, or another gain"
    return "unit", text


@dataclass(frozen=True)
class Stage:
    """How late a signal is behind the one before: s; None where it does not tell."""

    before: str
    after: str
    delay: float | None


def stages(runs: Sequence[Run], joint: str) -> list[Stage]:
    """Return the delays along the drive of a joint, as far as its signals are recorded: target, duty, effort, motion.

    Of each stage the delay is that at which a least squares explains it best by the one before: duty or effort by
    target, position and speed (a PD law), effort by duty and speed (an armature), torque by acceleration and speed (a
    mass with friction). Negative: it is logged before what it follows."""
    mine = [(r, r.joints.index(joint)) for r in runs if joint in r.joints]
    has = {k: any(getattr(r, k) is not None and np.isfinite(getattr(r, k)[:, j]).any() for r, j in mine)
           for k in ("duty", "torque")}  # fmt: skip
    chain = ["target", *(["duty"] if has["duty"] else []), *(["effort"] if has["torque"] else []), "motion"]
    if len(chain) == 2:
        return []
    out = []
    for before, after in zip(chain[:-1], chain[1:], strict=True):
        found = [x for r, j in mine if (x := _delay(r, j, before, after)) is not None]
        out.append(Stage(before, after, float(np.median(found)) if found else None))
    return out


def _delay(run: Run, j: int, before: str, after: str) -> float | None:
    """Return s by which a stage follows the one before in a run."""
    run.smooth()
    series = {"duty": run.duty, "effort": run.torque}
    x, y = series.get(before), series.get(after)
    t, v, on = run.t, run.vs[:, j], slice(10, -10)
    ones = np.ones_like(v)
    late = np.arange(-LATEST, LATEST + FINE / 2, FINE)
    if before == "target" and y is not None:
        shown, beside = y[:, j], [run.qs[:, j], v, ones]
        first = [run.command_at(t - d)[:, j] for d in late]
    elif after == "motion" and x is not None:
        # the motion's own side is shifted the other way: what it has later, the effort has now
        shown, beside = x[:, j], [np.sign(v) * (np.abs(v) > 0.05 * np.abs(v).max()), run.qs[:, j], ones]
        first = [np.interp(t + d, t, run.as_[:, j]) for d in late]
    elif x is not None and y is not None:
        shown, beside = y[:, j], [v, ones]
        first = [np.interp(t - d, t, x[:, j]) for d in late]
    else:
        return None
    if not np.isfinite(shown).all() or np.ptp(shown) == 0:
        return None
    residual = np.array([_residual(shown[on], [f[on], *(b[on] for b in beside)]) for f in first])
    best = int(np.argmin(residual))
    near = [residual[k] for k in (best - 20, best + 20) if 0 <= k < len(residual)]
    sharp = min(near) > (1 + SHARP) * residual[best]
    return float(late[best]) if residual[best] < 1 - EXPLAINED and sharp and 0 < best < len(late) - 1 else None


def _residual(y: np.ndarray, columns: Sequence[np.ndarray]) -> float:
    """Part of the variance of y [n] that a least squares on columns leaves."""
    a = np.stack(columns, 1)
    a = a / np.maximum(np.abs(a).max(0), 1e-12)
    rest = y - a @ np.linalg.lstsq(a, y, rcond=None)[0]
    return float(np.var(rest) / max(np.var(y), 1e-30))
