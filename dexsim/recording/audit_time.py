"""Faults of time: gaps, bursts, repeated times, clocks that disagree."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dexsim.recording import timeline
from dexsim.recording.schema import COMMANDS, Finding, Recording, Series
from dexsim.recording.smooth import at

GAP = 3.5  # periods without a sample
SKEW_S = 0.010  # s between header.stamp and host time that a transport does not explain
DRIFT_PPM = 200.0
LEAD_S = 0.005  # s by which a response may seem to come before its command
ALIKE = 0.15  # of a correlation: two shifts that differ by less are both likely
TIME_UNITS = (1e3, 1e6, 1e9)
"""ms, us and ns in a second."""
SHIFT_S = 0.2  # s by which one topic's whole span may be shifted against another's
EPOCH_S = 1e6  # s: stamps this far off count from another zero


def timing(series: Series) -> Iterator[Finding]:
    """Yield gaps, dropped samples, times that repeat, bursts."""
    topic, t = series.topic, series.t
    if len(t) < 5:
        return
    dt = np.diff(t)
    period = float(np.median(dt[dt > 0])) if (dt > 0).any() else 0.0
    same = np.flatnonzero(dt == 0)
    if len(same) and not series.lines:
        text = f"{len(same)} samples have the host time of the one before"
        yield series.finding("time_repeated", text, "error" if len(same) > len(t) / 2 else "warning", at=same)
    if period == 0.0:
        return
    period = max(period, 0.5 * float(dt.mean()))  # where most come in bursts, the median says nothing
    regular = np.percentile(dt, 75) < 1.5 * period and np.percentile(dt, 25) > 0.5 * period
    gaps = np.flatnonzero(dt > GAP * period)
    # a command may be sent only when it changes: then its pauses say nothing
    if len(gaps) and regular and (topic != COMMANDS or len(gaps) < 0.02 * len(t)):
        longest = gaps[np.argmax(dt[gaps])]
        text = (f"{len(gaps)} gaps of more than {GAP:g} periods ({period * 1e3:.3g} ms);"
                f" the longest is {dt[longest] * 1e3:.4g} ms at {t[longest]:.3f} s")  # fmt: skip
        severity = "info" if topic == COMMANDS else "warning"
        yield series.finding("gap", text, severity, at=(gaps[0], gaps[-1] + 1), count=len(gaps))
    dropped = np.flatnonzero((dt > 1.6 * period) & (dt <= GAP * period))
    if len(dropped) and regular and len(dropped) > 0.001 * len(t):
        text = f"{len(dropped)} samples or so are missing singly ({100 * len(dropped) / len(t):.2g} %)"
        yield series.finding("dropped", text, "info", at=dropped)
    burst = np.flatnonzero((dt > 0) & (dt < 0.1 * period))
    if len(burst) > 0.05 * len(t):
        yield series.finding("burst", f"{len(burst)} samples came within a tenth of a period of the one before:"
                                      " read from a buffer, not when measured", "warning", at=burst)  # fmt: skip


def stamps(all_series: list[Series]) -> Iterator[Finding]:
    """Yield header.stamp against host time, in each topic and between topics."""
    offsets: dict[str, float] = {}
    for s in all_series:
        if s.stamp is None:
            continue
        series = s.take(np.isfinite(s.stamp))
        t, stamp = series.t, series.stamp
        if len(t) < 5 or stamp is None:
            continue
        late = t - stamp
        middle = float(np.median(late))
        again = np.flatnonzero((np.diff(stamp) == 0) & (np.diff(t) > 0))
        if len(again):
            text = f"{len(again)} messages carry the header.stamp of the one before: repeated"
            yield series.finding("held", text, "warning", at=(again[0] + 1, again[-1] + 1), count=len(again))
        back = np.flatnonzero(np.diff(stamp) < 0)
        if len(back):
            text = f"header.stamp goes backwards {len(back)} times"
            yield series.finding("time_not_monotonic", text, "warning", at=(back[0] + 1, back[-1] + 1), count=len(back))
        other_epoch = abs(middle) > EPOCH_S
        if not other_epoch:
            offsets[s.topic] = middle
            if abs(middle) > SKEW_S:
                text = (f"header.stamp is {abs(middle) * 1e3:.4g} ms {'behind' if middle > 0 else 'ahead of'}"
                        " host time (median); host time is used")  # fmt: skip
                yield series.finding("clock_skew", text)
        rate = _slope(t, late)
        if len(t) > 50 and abs(rate) * 1e6 > DRIFT_PPM and abs(rate) * (t[-1] - t[0]) > 0.5 * SKEW_S:
            text = (f"header.stamp drifts against host time by {rate * 1e6:+.0f} ppm:"
                    f" {rate * (t[-1] - t[0]) * 1e3:+.3g} ms over the recording")  # fmt: skip
            yield series.finding("clock_skew", text, "error")
        jumps = np.flatnonzero(np.abs(np.diff(late)) > 5 * SKEW_S)
        if len(jumps) and abs(np.median(late[: jumps[0] + 1]) - np.median(late[jumps[-1] + 1 :])) > 5 * SKEW_S:
            text = f"header.stamp jumps against host time by {np.diff(late)[jumps[0]] * -1e3:+.4g} ms"
            yield series.finding("clock_skew", text, "error", at=(jumps[0] + 1, jumps[-1] + 1), count=len(jumps))
    if len(offsets) > 1:
        low, high = min(offsets, key=offsets.__getitem__), max(offsets, key=offsets.__getitem__)
        skew = offsets[high] - offsets[low]
        if skew > 2 * SKEW_S:
            text = f"the clocks that stamp {high} and {low} are {skew * 1e3:.4g} ms apart"
            yield Finding("clock_skew", high, 0.0, 1, text)


def between_topics(r: Recording) -> Iterator[Finding]:
    """Yield topics whose host times cannot be of one clock: one is shifted as a whole, or answers come before
    commands; and commands that go on after the last state."""
    state = r.states.position
    if len(state) < 20:
        return
    late = r.commands.t > state.t[-1]
    if late.any() and not late.all() and r.commands.t[-1] > state.t[-1] + SHIFT_S:
        text = (f"commands go on for {r.commands.t[-1] - state.t[-1]:.3g} s after the last sample of {state.topic}:"
                f" without states, {late.sum()} of {len(late)} are left out")  # fmt: skip
        yield r.commands.finding("gap", text, "warning", at=np.flatnonzero(late))
    for other in (r.commands, r.tactile, r.external_force, r.object_pose, r.imu, r.temperature, r.duty):
        if other is None or len(other) < 20:
            continue
        first, last = other.t[0] - state.t[0], other.t[-1] - state.t[-1]
        spans = float(other.t[-1] - other.t[0]), float(state.t[-1] - state.t[0])
        longer = max(spans) / max(min(spans), 1e-12)
        if any(abs(longer / unit - 1) < 0.2 for unit in TIME_UNITS):
            text = f"spans {spans[0]:.4g} s, {state.topic} {spans[1]:.4g} s: the times of one are of another unit"
            yield other.finding("clock_skew", text, "error")
        elif (
            min(abs(first), abs(last)) > SHIFT_S
            and first * last > 0
            and abs(first - last) < 0.3 * max(abs(first), abs(last))
        ):
            text = (f"begins {first:+.3g} s and ends {last:+.3g} s from {state.topic}:"
                    " shifted as a whole, so their host times may be of two clocks")  # fmt: skip
            yield other.finding("clock_skew", text)
    lead = command_lead(r)
    if lead is not None and lead > LEAD_S + 0.5 * float(np.median(np.diff(state.t))):
        text = (f"motion comes {lead * 1e3:.3g} ms before its command (median over joints):"
                f" the host times of {state.topic} and {COMMANDS} are not of one clock")  # fmt: skip
        yield Finding("clock_skew", state.topic, 0.0, len(state), text, "error", end=float(state.t[-1]))


def command_lead(r: Recording, reach: float = 0.5, step: float = 0.005) -> float | None:
    """Return median time [s] by which measured speed leads commanded speed (negative: it lags, as it should), from
    their cross-correlation over joints that follow well, in each half of the recording alike (a joint that sticks or
    hits its torque limit stops early, which looks like a lead); None where nothing can be said."""
    state, leads = r.states.position, []
    if len(r.commands) < 20:
        return None
    first, last = timeline.stretch(state.t)
    start, end = max(first, r.commands.t[0]), min(last, r.commands.t[-1])
    if end - start < 4 * reach:
        return None
    grid = np.arange(start, end, step)
    for j in range(len(r.joints)):
        sides = (r.commands.t, r.commands.value[:, j], True), (state.t, state.value[:, j], False)
        if any(np.isfinite(x).sum() < 5 for _, x, _ in sides):
            continue
        command, position = (at(grid, *side) for side in sides)
        half = len(grid) // 2
        found: list[int] = []
        for part in (slice(None), slice(0, half), slice(half, None)):
            one = _lead(command[part], position[part], int(reach / step), alone=part == slice(None))
            if one is None:
                break
            found.append(one)
        else:
            if max(found) - min(found) <= 3:
                leads.append(found[0] * step)
    return float(np.median(leads)) if leads else None


def _lead(command: np.ndarray, position: np.ndarray, reach: int, width: int = 5, alone: bool = False) -> int | None:
    """Return grid steps by which the position's change comes before the command's; None where they do not go
    together; alone: and where it might as well come after it (a narrow band repeats, a lost sign is half a period)."""
    if np.ptp(command) < 0.05 or np.ptp(position) < 0.05:
        return None
    a, b = command[width:] - command[:-width], position[width:] - position[:-width]
    a, b = a - a.mean(), b - b.mean()
    size = 1 << (len(a) + reach).bit_length()
    full = np.fft.irfft(np.fft.rfft(b, size) * np.conj(np.fft.rfft(a, size)), size)
    corr = np.concatenate([full[-reach:], full[: reach + 1]]) / (np.linalg.norm(a) * np.linalg.norm(b) + 1e-12)
    best, size = int(np.argmax(corr)), np.abs(corr)
    peaks = np.flatnonzero((size[1:-1] >= size[:-2]) & (size[1:-1] >= size[2:])) + 1
    if alone and best < reach and size[peaks[peaks >= reach]].max(initial=0.0) > corr[best] - ALIKE:
        return None
    return reach - best if corr[best] > 0.8 else None


def _slope(t: np.ndarray, y: np.ndarray) -> float:
    """Return robust slope: medians of the first and last quarter."""
    q = max(len(t) // 4, 1)
    return float((np.median(y[-q:]) - np.median(y[:q])) / max(np.median(t[-q:]) - np.median(t[:q]), 1e-9))
