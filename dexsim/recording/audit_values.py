"""Faults of values: not finite, wrapped, held, stuck, saturated, of the wrong unit, without their sign."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from dexsim.recording import smooth
from dexsim.recording.schema import COMMANDS, COMMANDS_FIX, STATES, Finding, Recording, Series, note
from dexsim.recording.spikes import of_effort, spiked

MODULI = (2 * np.pi, 360.0, 256.0, 4096.0, 16384.0, 65536.0, 65.536, 2.0**32)
"""Angles, 8, 12, 14, 16 (also in thousandths) and 32 bit."""
RATIOS = {
    180 / np.pi: "degrees",
    4096 / (2 * np.pi): "counts of a 12-bit encoder",
    1000.0: "thousandths",
    65536 / (2 * np.pi): "counts of a 16-bit encoder",
}
FOLLOWS, STRAY = 0.9, 0.5
"""Correlation from which on a position follows a command, and below which it does not."""
LARGEST = 1e6
"""rad (m): no joint gets there; a wheel that turns ten times a second needs four hours."""
POSSIBLE = {"temperature": (-40.0, 150.0, "degC"), "duty": (-1.02, 1.02, "full drive"),
            "supply voltage": (0.0, 100.0, "V"), "enabled": (0.0, 1.0, "0 or 1")}  # fmt: skip
SPEED_RATIOS = {180 / np.pi: "deg/s", 60 / (2 * np.pi): "rpm", 1000.0: "thousandths of rad/s"}


def quantum(x: np.ndarray) -> float:
    """Step of a quantised signal: the largest that divides (nearly) all differences of its values; 0 where there is
    none."""
    values = np.unique(x[np.isfinite(x)])
    if len(values) < 3:
        return 0.0
    gaps = np.diff(values)
    for part in range(1, 11):
        step = float(gaps.min()) / part
        if step > 1e-9 and (np.abs(gaps / step - np.round(gaps / step)) < 0.02).mean() > 0.97:
            return step
    return 0.0


def is_integer(x: np.ndarray) -> bool:
    """Return whether every finite value is a whole number, and not all are 0 or 1."""
    x = x[np.isfinite(x)]
    return len(x) > 0 and bool((x == np.round(x)).all()) and float(np.abs(x).max()) > 1


def channels(r: Recording) -> Iterator[tuple[Series, str, str, np.ndarray]]:
    """Yield (series, quantity, joint, values [T]) of every per-joint signal."""
    for name, series in r.series().items():
        if name in ("command", "position", "velocity", "effort", "temperature", "duty", "enabled"):
            for j, joint in enumerate(r.joints):
                yield series, name, joint, series.value[:, j]


def commanded(r: Recording) -> Iterator[Finding]:
    """Yield that nothing says what the joints were asked for: an error, but where touch was recorded, which `calibrate
    touch` reads by itself."""
    if not np.isfinite(r.commands.value).any():
        has_touch = r.tactile is not None and len(r.tactile) > 0
        use = "calibrate touch can use this recording, diagnose and replay cannot" if has_touch else (
            "diagnose and replay cannot use this recording")  # fmt: skip
        text = f"no commands: {use}; {COMMANDS_FIX}"
        yield note("missing_topic", text, "warning" if has_touch else "error", COMMANDS, len(r.commands))
    have = [np.isfinite(x.value).any(0) if len(x) else np.zeros(len(r.joints), bool) for x in (
        r.commands, r.states.position)]  # fmt: skip
    if have[0].any() and have[1].any() and not (have[0] & have[1]).any():
        sent, seen = (", ".join(np.array(r.joints)[x][:4]) for x in have)
        text = f"no joint has both a command ({sent}) and a position ({seen}): say which is which, remap.OURS=THEIRS"
        yield note("joint_names", text, "error", STATES, len(r.joints))
    if len(r.commands) and not have[1].any():
        text = "no positions: nothing says where the joints went; name their columns with remap.position.JOINT=COLUMN"
        yield note("missing_topic", f"{text}, or their topic with remap.{STATES}=TOPIC", "error", STATES, 0)


def order(r: Recording) -> Iterator[Finding]:
    """Commands that belong to another joint: of those joints that move, each follows another's command and not its
    own."""
    grid, commands, positions = _together(r)
    if len(grid) < 100:
        return
    moving = [j for j in range(len(r.joints)) if np.ptp(commands[:, j]) > 0.02 and np.ptp(positions[:, j]) > 0.02]
    if len(moving) < 2:
        return
    like = {(k, j): _follows(commands[:, k], positions[:, j]) for k in moving for j in moving}
    whose = {j: max(moving, key=lambda k: like[k, j]) for j in moving}
    wrong = [j for j, k in whose.items() if k != j and like[k, j] > FOLLOWS and like[j, j] < STRAY]
    wrong = [j for j in wrong if sum(whose[i] == whose[j] for i in moving) == 1]
    if len(wrong) < 2:
        return
    nameless = next((f.text for f in r.findings if f.topic == COMMANDS and "carry no joint names" in f.text), "")
    taken = nameless.partition("in the order ")[2].partition(";")[0].split(", ")  # not a model's, which `joints` have
    instead = {r.joints[whose[j]]: r.joints[j] for j in wrong}
    names = [instead.get(name, name) for name in taken]
    exchanged = {*instead} == {*instead.values()} <= {*taken}  # not where they are renamed
    for j in wrong:
        k = whose[j]
        right = ",".join(names) if exchanged else f"... with {r.joints[j]} where {r.joints[k]} is now"
        cure = f"the values are in another order: meta.joint_names={right}" if nameless else (
            f"whose commands are these? remap.{r.joints[j]}=... or, of columns, remap.command.{r.joints[j]}=COLUMN")
        text = (
            f"command of {r.joints[j]} is not what it follows: that is the command of {r.joints[k]} (correlation "
            f"{like[k, j]:.2f}, with its own {like[j, j]:.2f}); {cure}"
        )
        yield Series(grid, commands, COMMANDS).finding("joint_order", text, "error", r.joints[j])


def _together(r: Recording) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(times [n] every 10 ms, targets in force [n, J], positions [n, J]) while both are recorded."""
    c, s, none = r.commands, r.states.position, np.zeros((0, len(r.joints)))
    if len(c) < 20 or len(s) < 20:
        return none[:, 0], none, none
    first = max(c.t[0], s.t[0])
    grid = np.arange(first, min(c.t[-1], s.t[-1], first + 300.0), 0.01)
    there = [np.isfinite(x.value).sum(0) > 5 for x in (c, s)]
    return grid, np.where(there[0], c.at(grid, held=True), 0.0), np.where(there[1], s.at(grid), 0.0)


def _follows(command: np.ndarray, position: np.ndarray) -> float:
    """Return the largest correlation of a position with a command of up to 0.3 s before."""
    return max(_corr(command[: len(command) - k], position[k:]) for k in range(0, 31, 3))


def finite(r: Recording) -> Iterator[Finding]:
    """Yield values that are missing or infinite."""
    for series, name, joint, x in channels(r):
        bad = ~np.isfinite(x)
        if not bad.any():
            continue
        at = np.flatnonzero(bad)
        if bad.all():
            severity = "warning" if name == "position" else "info"
            yield series.finding("absent", f"no {name} of {joint}", severity, joint)
        elif np.isinf(x).any() or name not in ("command", "enabled"):
            text = f"{name} of {joint} is not a finite number in {len(at)} of {len(x)} samples"
            yield series.finding("nan", text, "warning", joint, at)
    for name, whole in r.series().items():
        if name in ("tactile", "supply voltage", "external force", "object pose", "imu"):
            bad = np.flatnonzero(~np.isfinite(whole.value.reshape(len(whole), -1)).all(1))
            if len(bad):
                text = f"{len(bad)} of {len(whole)} samples hold values that are not finite"
                yield whole.finding("nan", text, "warning", at=bad)


def wraps(r: Recording) -> Iterator[Finding]:
    """Yield a signed number read as unsigned, or an angle that starts again after a turn."""
    for series, name, joint, x in channels(r):
        if name not in ("temperature", "enabled"):
            found = wrapped(x)
            if found is not None:
                m, at = found
                what = (
                    "the angle starts again after a turn (of ticks: units.position=ticks:4096@TICK, TICK the middle)"
                    if m in (2 * np.pi, 360.0)
                    else f"a signed number was read as unsigned (modulus {m:g})"
                )
                yield series.finding("wrap", f"{name} of {joint} jumps by {m:.6g}: {what}", "error", joint, at)
    if r.tactile is not None and len(r.tactile) > 5:
        value = r.tactile.value
        for axis, label in enumerate(("fx", "fy", "fz")):
            x = value[..., axis].reshape(len(value), -1)
            if np.nanmin(x) < 0 or np.nanmax(x) <= 200:
                continue
            high, low = x > 160, x < 96
            jumps = np.abs(np.diff(x, axis=0)) > 192
            # -1 as 255: large values, with hardly any between them and the small ones, reached in one step
            if jumps.any() and axis < 2 and (x[~high & ~low].size < 0.2 * high.sum()):
                at = np.flatnonzero(high.any(1))
                text = (f"{label} holds values near 255 beside values near 0 and no negative ones:"
                        " signed bytes were read as unsigned")  # fmt: skip
                yield r.tactile.finding("wrap", text, "error", at=at, count=int(high.sum()))


def wrapped(x: np.ndarray) -> tuple[float, np.ndarray] | None:
    """Return (modulus, indices of the samples beyond half of it) of a wrapped signal; None otherwise."""
    ok = np.flatnonzero(np.isfinite(x))
    v = x[ok]
    if len(v) < 10 or np.ptp(v) == 0:
        return None
    steps = np.abs(np.diff(v))
    if steps.max() < 0.5 * np.ptp(v):  # shorter than 0.6 of any modulus that the values lie within
        return None
    step = quantum(v)
    for m in dict.fromkeys((*(bits * step for bits in (256, 4096, 65536) if step), *MODULI)):
        angle = m in (2 * np.pi, 360.0)
        if m <= 0 or np.ptp(v) > m * 1.0001 or steps.max() < 0.6 * m or (not angle and v.min() < 0):
            continue
        back = np.unwrap(v, period=m) if angle else np.where(v >= m / 2, v - m, v)
        jumps = steps > 0.6 * m
        between = jumps.mean() > 0.3 if angle else ((v > 0.25 * m) & (v < 0.75 * m)).any()
        if np.abs(np.diff(back)).max() < 0.4 * m and np.abs(np.diff(back)).sum() < 0.5 * steps.sum() and not between:
            at = np.flatnonzero(np.abs(back - v) > 0.5 * m) if not angle else np.flatnonzero(jumps) + 1
            return float(m), ok[at]
    return None


def spikes(r: Recording) -> Iterator[Finding]:
    """Yield single samples of position, command and effort far from their neighbours."""
    s = r.states
    for series, name in ((s.position, "position"), (r.commands, "command"), (s.effort, "effort")):
        if series is None or not len(series):
            continue
        for j, joint in enumerate(r.joints):
            x = series.value[:, j]
            at = np.flatnonzero(of_effort(r, j) if name == "effort" else spiked(x, name))
            if len(at) and wrapped(x) is None:
                text = (f"{name} of {joint}: {len(at)} single samples ({100 * len(at) / len(x):.2g} %) far from their "
                        "neighbours")  # fmt: skip
                yield series.finding("spike", text, "warning", joint, at)


def held(r: Recording) -> Iterator[Finding]:
    """Samples that repeat while the joint moves, found by the jump that makes up for them."""
    s = r.states.position
    if len(s) < 10:
        return
    effort = r.states.effort.value if r.states.effort is not None else None
    rows = s.value if effort is None else np.concatenate([s.value, effort], 1)
    same_row = np.append(False, ((np.diff(rows, axis=0) == 0) | np.isnan(np.diff(rows, axis=0))).all(1))
    stale = np.zeros(len(s), bool)
    alone: dict[int, np.ndarray] = {}
    for j in range(len(r.joints)):
        late = repeats(s.t, s.value[:, j])
        if late.any() and effort is not None and np.isfinite(effort[:, j]).any() and np.nanstd(effort[:, j]) > 0:
            late &= np.append(False, np.diff(effort[:, j]) == 0)  # a current that moves on means a joint that sticks
        stale |= late & same_row
        alone[j] = late & ~same_row
    if stale.sum() >= 3:
        at = np.flatnonzero(stale)
        yield s.finding("held", f"{len(at)} whole samples repeat the one before while joints move", "warning", at=at)
    for j, late in alone.items():
        at = np.flatnonzero(late)
        if len(at) >= (5 if effort is not None else 12):
            text = f"{r.joints[j]}: {len(at)} samples repeat the one before while it moves and others go on"
            yield s.finding("held", text, "warning", r.joints[j], at)
    if r.tactile is not None and len(r.tactile) > 10:
        x = r.tactile.value.reshape(len(r.tactile), -1)
        total = np.nansum(np.abs(x), axis=1)
        late = repeats(r.tactile.t, total) & np.append(False, (np.diff(x, axis=0) == 0).all(1))
        if late.sum() >= 3:
            at = np.flatnonzero(late)
            text = f"{len(at)} samples repeat the one before while the force changes"
            yield r.tactile.finding("held", text, "warning", at=at)


def repeats(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return [T] bool: samples equal to the one before within a steady motion, followed by a jump that makes up for
    them."""
    out = np.zeros(len(x), bool)
    dx = np.diff(x)
    edge = np.flatnonzero(np.diff(np.concatenate([[False], dx == 0, [False]]).astype(np.int8)))
    a, b = edge[::2], edge[1::2]  # x[a] == ... == x[b], which are finite then; x[a - 1] and x[b + 1] differ

    def those(on: Any) -> None:
        nonlocal a, b
        a, b = a[on], b[on]

    those((a >= 2) & (b + 3 < len(x)))
    those(np.isfinite(x[a - 2]) & np.isfinite(x[a - 1]) & np.isfinite(x[b[:, None] + (1, 2, 3)]).all(1))
    # what shakes faster than it is read turns back between two readings, and stands now and then by chance
    those(~(np.stack([dx[a - 2], dx[a - 1], dx[b + 1], dx[b + 2]]) * dx[b] < 0).any(0))
    if not len(a):
        return out
    before = (x[a] - x[a - 2]) / np.maximum(t[a] - t[a - 2], 1e-9)
    after = (x[b + 3] - x[b + 1]) / np.maximum(t[b + 3] - t[b + 1], 1e-9)
    fast, slow = np.maximum(np.abs(before), np.abs(after)), np.minimum(np.abs(before), np.abs(after))
    # of neighbours equally fast: the missed way shows as a jump of its size, in one sample
    jump = (x[b + 1] - x[b]) * np.sign(before)
    way = 0.5 * (np.abs(before) + np.abs(after)) * (t[b + 1] - t[a])
    found = ~(before * after <= 0) & ~(fast > 2 * slow) & (0.7 * way < jump) & (jump < 1.4 * way)
    if found.any():
        step = max(quantum(x), 1e-9)
        found &= ~(slow * (t[b] - t[a]) < 3 * step)
    for first, last in zip(a[found], b[found], strict=True):
        out[first + 1 : last + 1] = True
    return out


def stuck(r: Recording) -> Iterator[Finding]:
    """Yield a channel that never changes where it must."""
    s = r.states.position
    for j, joint in enumerate(r.joints):
        x = s.value[:, j]
        if len(s) > 20 and np.isfinite(x).any() and np.nanmax(x) == np.nanmin(x) and len(r.commands):
            c = r.commands.value[:, j]
            if np.isfinite(c).any() and np.nanmax(c) - np.nanmin(c) > 0.1:
                yield s.finding("stuck", f"position of {joint} is {x[0]:.4g} throughout while its command spans"
                                         f" {np.nanmax(c) - np.nanmin(c):.3g}", "error", joint)  # fmt: skip
    e = r.states.effort
    if e is not None and len(e) > 20:
        for j, joint in enumerate(r.joints):
            x = e.value[:, j]
            if not np.isfinite(x).any() or np.nanmax(x) != np.nanmin(x):
                continue
            drive = np.abs(_drive(r, j, e.t))
            # what drives it is beyond what a deadband or dry friction may hide
            if (drive[np.isfinite(drive)] > 0.05).mean() > 0.05 and np.ptp(s.value[:, j]) > 0.05:
                text = f"effort of {joint} is {x[np.isfinite(x)][0]:.4g} throughout while it moves"
                yield e.finding("stuck", text, "error", joint)


def saturation(r: Recording) -> Iterator[Finding]:
    """Yield values that pile up at their largest."""
    for series, name, joint, x in channels(r):
        if name not in ("effort", "duty"):
            continue
        x = np.where(np.isfinite(x), x, 0.0)
        step: float | None = None
        for limit, side in ((x.max(), "highest"), (x.min(), "lowest")):
            at = np.flatnonzero(x == limit)
            if len(at) < 10 or np.ptp(x) == 0:
                continue
            step = quantum(x) if step is None else step
            if abs(limit) <= 10 * step:
                continue
            runs = np.split(at, np.flatnonzero(np.diff(at) > 1) + 1)
            long = [run for run in runs if len(run) >= 3]
            near = ((np.abs(x - limit) < 0.05 * np.ptp(x)) & (x != limit)).sum()
            if len(long) >= 2 and sum(map(len, long)) > near:
                text = f"{name} of {joint} is at its {side} value, {limit:.4g}, in {len(at)} samples"
                yield series.finding("saturation", text, "info", joint, (long[0][0], long[-1][-1]), count=len(at))
    if r.tactile is not None and r.meta["tactile_unit"] == "count" and is_integer(r.tactile.value):
        v = r.tactile.value
        full = np.stack(
            [(v[..., 0] >= 127) | (v[..., 0] <= -128), (v[..., 1] >= 127) | (v[..., 1] <= -128), v[..., 2] >= 255]
        )
        if full.any():
            at = np.flatnonzero(full.any((0, 2, 3)))
            text = f"taxels at the end of their 8-bit range ({full.any((0, 1)).sum()} of them)"
            yield r.tactile.finding("saturation", text, "warning", at=at, count=int(full.sum()))


def signs(r: Recording) -> Iterator[Finding]:
    """Yield effort that lost its sign, or whose sign is not the one that is stated."""
    e = r.states.effort
    if e is None or len(e) < 50:
        return
    stated = r.effort_sign
    lost: list[int] = []
    for j, joint in enumerate(r.joints):
        x = e.value[:, j]
        drive = _drive(r, j, e.t)
        ok = np.isfinite(x) & np.isfinite(drive)
        if ok.sum() < 50 or stated[j] == 0 or np.ptp(x[ok]) == 0 or drive[ok].std() == 0:
            continue
        x, d = x[ok], drive[ok]
        strong = np.abs(d) > 0.25 * np.percentile(np.abs(d), 95)
        both = min((d[strong] > 0).mean(), (d[strong] < 0).mean()) if strong.any() else 0.0
        plain, absolute = _corr(x, d), _corr(x, np.abs(d))
        if both > 0.15 and (x >= 0).all() and absolute > 0.3 and absolute > plain * stated[j] + 0.2:
            lost.append(j)
            text = (f"effort of {joint} is never negative and follows the size, not the sign, of what drives it"
                    f" (correlation {absolute:.2f} against {plain:.2f})")  # fmt: skip
            yield e.take(ok).finding("lost_sign", text, "error", joint)
        elif both > 0.15 and not (x >= 0).all() and plain * stated[j] < -0.5:
            text = (f"effort of {joint} is opposite to what effort_sign={int(stated[j]):+d} says"
                    f" (correlation {plain * stated[j]:.2f} with target minus position)")  # fmt: skip
            yield e.take(ok).finding("sign_mismatch", text, "error", joint)
    if lost and not (e.value < 0).any():
        rest = [r.joints[j] for j in range(len(r.joints)) if j not in lost and np.nanmax(e.value[:, j]) > 0]
        if rest:
            yield e.finding("lost_sign", f"effort of {', '.join(rest)} is never negative either")


def _drive(r: Recording, j: int, t: np.ndarray) -> np.ndarray:
    """Return what an effort should follow [T]: target minus position; where nothing is commanded, the speed."""
    s = r.states.position
    if np.isfinite(s.value[:, j]).sum() < 5:
        return np.full(len(t), np.nan)
    q = smooth.at(t, s.t, s.value[:, j])
    c = r.commands
    if len(c) and (there := np.isfinite(c.value[:, j])).sum() > 5:
        return np.where(t >= c.t[there][0], smooth.at(t, c.t, c.value[:, j], held=True) - q, np.nan)
    return np.gradient(q, t) if len(np.unique(t)) == len(t) else np.full(len(t), np.nan)


def units(r: Recording) -> Iterator[Finding]:
    """Numbers that cannot be of the unit that is stated."""
    s, c = r.states, r.commands
    limits = {} if r.hand is None else dict(zip(r.hand.joints, r.hand.limits, strict=True))

    def finding(series: Series, text: str, joint: str = "", severity: str = "error") -> Finding:
        return series.finding("unit", text, severity, joint)

    for series, name in ((s.position, "position"), (c, "command")):
        for j, joint in enumerate(r.joints):
            if not len(series) or not np.isfinite(series.value[:, j]).any():
                continue
            x = series.value[:, j]
            top = float(np.nanmax(np.abs(x)))
            if top > LARGEST and (beyond := (np.abs(x) > LARGEST) & ~spiked(x, name)).any():
                text = f"{name} of {joint} is {x[beyond][0]:.4g} in {int(beyond.sum())} of {len(x)} samples, farther"
                yield finding(series, f"{text} than any joint gets", joint)
            elif joint in limits and top > (most := np.abs(limits[joint]).max()) + 0.5:
                guess = "counts?" if is_integer(x) and top > 200 else "degrees?" if top < 400 else "counts?"
                text = f"{name} of {joint} reaches {top:.4g} rad, its limit is {most:.3g}: {guess}"
                yield finding(series, text, joint)
            elif not limits and is_integer(x) and top > 100:
                text = f"{name} of {joint} holds whole numbers up to {top:.0f}: encoder counts, or registers? State"
                yield finding(series, f"{text} units.position=ticks:4096, or registers=LOW..HIGH [rad]", joint)
            elif not limits and 4 * np.pi < top < 400 and _jumpless(x):
                ways = "deg" if top > 101 else "deg or percent" if np.nanmin(x) > -0.5 else "deg or signed_percent"
                text = f"{name} of {joint} reaches {top:.4g} rad: degrees? percent? State units.position={ways}"
                yield finding(series, f"{text}; of one joint, units.position.{joint}=", joint, "warning")
    for j, joint in enumerate(r.joints):  # one against the other
        if len(c) > 20 and len(s.position) > 20:
            drive, q = _drive(r, j, s.position.t), s.position.value[:, j]
            ratio = _ratio(drive + q, q)
            # a drive may follow less than it is asked, but none goes twenty times as far and beyond a turn
            far = ratio is not None and ratio > 20 and np.nanmax(np.abs(q)) > 2 * np.pi
            nearest = min((abs(np.log(ratio / k)), k) for k in RATIOS)[1] if far and ratio is not None else None
            named = False
            for known, unit in RATIOS.items():
                for k, whose in ((known, "position"), (1 / known, "command")):
                    if ratio is None:
                        continue
                    loose = whose == "position" and known == nearest and 0.5 < ratio / k < 1.3
                    if abs(ratio / k - 1) < 0.1 or loose:
                        named = True
                        text = f"{whose} of {joint} is {known:.4g} times the other: {unit}?"
                        yield finding(s.position if whose == "position" else c, text, joint)
            if far and not named:
                text = f"position of {joint} goes {ratio:.4g} times as far as its command: which unit?"
                yield finding(s.position, text, joint)
        if s.velocity is not None and len(s.velocity) > 20 and np.isfinite(s.velocity.value[:, j]).all():
            speed = np.gradient(s.position.value[:, j], s.position.t) if (np.diff(s.position.t) > 0).all() else None
            ratio = None if speed is None else _ratio(_smooth(speed), _smooth(s.velocity.value[:, j]))
            if ratio is not None and ratio < -0.5:
                yield finding(s.velocity, f"velocity of {joint} has the opposite sign of its position's change", joint)
            for known, unit in SPEED_RATIOS.items():
                if ratio is not None and abs(ratio / known - 1) < 0.15:
                    text = f"velocity of {joint} is {ratio:.4g} times its position's change: {unit}?"
                    yield finding(s.velocity, text, joint)
    yield from _effort_units(r, finding)
    there = r.series()
    for name, (low, high, unit) in POSSIBLE.items():
        if name not in there:
            continue
        series = there[name]
        bad = (series.value < low) | (series.value > high)
        if name == "duty":  # a wrapped one is found as such
            bad[:, [wrapped(x) is not None for x in series.value.T]] = False
        if bad.any():
            at = np.flatnonzero(bad.reshape(len(series), -1).any(1))
            text = (f"{name} reaches {np.nanmin(series.value):.4g} .. {np.nanmax(series.value):.4g} {unit};"
                    f" {low:g} .. {high:g} is possible")  # fmt: skip
            yield series.finding("unit", text, "error", at=at, count=int(bad.sum()))
    if (touch := there.get("tactile")) is not None:
        most, whole, unit = np.nanmax(np.abs(touch.value)), is_integer(touch.value), r.meta["tactile_unit"]
        if unit == "N" and whole and most > 20:
            yield finding(touch, f"tactile_unit is N, yet all values are whole and reach {most:.0f}: counts?")
        if unit == "count" and not whole and most > 0:
            yield finding(touch, "tactile_unit is count, yet values are not whole: newtons?")
    if r.object_pose is not None:
        p = r.object_pose.value
        if (away := np.nanmedian(np.abs(p[:, :3]).max(1))) > 10:
            yield finding(r.object_pose, f"the object is {away:.4g} m away: millimetres?")
        if np.nanmax(np.abs(np.linalg.norm(p[:, 3:], axis=1) - 1)) > 0.02:
            yield finding(r.object_pose, "the orientation is not a unit quaternion")
    if r.imu is not None:
        size = np.linalg.norm(r.imu.value[:, 7:], axis=1)
        g = float(np.median(size[np.isfinite(size)])) if np.isfinite(size).any() else 9.81
        if 0.8 < g < 1.25:
            yield finding(r.imu, f"the acceleration at rest is {g:.3g}: in g, not m/s2?")


def _effort_units(r: Recording, finding: Callable[..., Finding]) -> Iterator[Finding]:
    e = r.states.effort
    if e is None:
        return
    limit = {} if r.hand is None else dict(zip(r.hand.joints, r.hand.efforts, strict=True))
    for j, joint in enumerate(r.joints):
        x = e.value[:, j]
        if not np.isfinite(x).any():
            continue
        top = float(np.nanmax(np.abs(x)))
        if r.effort_is == "current_A" and top > 20 and (is_integer(x) or joint in limit):
            yield finding(e, f"effort of {joint} reaches {top:.4g} A: milliamperes?", joint)
        elif r.effort_is == "torque_Nm" and (top > 20 * limit.get(joint, np.inf) or (is_integer(x) and top > 50)):
            yield finding(e, f"effort of {joint} reaches {top:.4g} N.m: a current in mA, or counts?", joint)
        elif r.effort_is == "torque_Nm" and top > 50 and any("effort_is is not stated" in f.text for f in r.findings):
            text = f"effort of {joint} reaches {top:.4g} N.m, if it is a torque: a current in mA? State"
            yield finding(e, f"{text} meta.effort_is=current_A units.effort=mA, or meta.effort_is=torque_Nm", joint,
                          "warning")  # fmt: skip


def _smooth(x: np.ndarray, width: int = 5) -> np.ndarray:
    return np.convolve(x, np.ones(width) / width, mode="same")


def _ratio(a: np.ndarray, b: np.ndarray) -> float | None:
    """Return b / a where they go together; None where they do not."""
    ok = np.isfinite(a) & np.isfinite(b)
    if ok.sum() < 20 or a[ok].std() == 0 or b[ok].std() == 0:
        return None
    corr = _corr(a[ok], b[ok])
    return float(np.sign(corr) * b[ok].std() / a[ok].std()) if abs(corr) > 0.7 else None


def _corr(a: np.ndarray, b: np.ndarray) -> float:
    a, b = a - a.mean(), b - b.mean()
    size = np.linalg.norm(a) * np.linalg.norm(b)
    return float(a @ b / size) if size > 0 else 0.0


def _jumpless(x: np.ndarray) -> bool:
    x = x[np.isfinite(x)]
    return len(x) > 1 and float(np.abs(np.diff(x)).max()) < 0.5 * np.ptp(x)
