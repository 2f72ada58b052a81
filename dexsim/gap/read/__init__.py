"""Step 1: recordings in, their signals tested, out of it the runs that all further steps work on: one recording as
plain arrays, in the order of the joints that are diagnosed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dexsim.actuator.table import ServoTable
from dexsim.recording.smooth import LocalPolynomial, local_polynomial

BLOCK = 0.5
"""s of a stretch whose samples are resampled together: errors that lie nearer to each other are not independent."""

COLUMNS = ("v", "torque", "temperature", "duty", "enabled", "read")
"""Of a run, what may be absent and has a column for each joint."""


@dataclass
class Run:
    """One recording, J joints; times in s from the recording's first sample, positions in rad (m for a slide).

    cmd_t [K], cmd [K, J]: targets, held until the next; t [S], q [S, J]: measured positions. Optional, None where not
    logged: v [S, J] rad/s as reported; torque [S, J] motor torque the effort shows, N.m; duty, temperature, enabled [S,
    J]; supply [S] V. gravity: the world's, m/s2, [3].
    servo: the table believed for this recording; counted: the mechanism's joints, by whose number its `coupling_from`
    counts (empty: `joints`). left_out: joints of which this recording tells nothing; their q is what is assumed of
    them. breaks: stretches [s] over which its clock cannot be trusted. read [S, J]: where a position was read; between
    these q is interpolated (None: all were).
    """

    name: str
    joints: tuple[str, ...]
    cmd_t: np.ndarray
    cmd: np.ndarray
    t: np.ndarray
    q: np.ndarray
    servo: ServoTable
    gravity: np.ndarray
    v: np.ndarray | None = None
    torque: np.ndarray | None = None
    duty: np.ndarray | None = None
    temperature: np.ndarray | None = None
    enabled: np.ndarray | None = None
    supply: np.ndarray | None = None
    counted: tuple[str, ...] = ()
    left_out: frozenset[str] = frozenset()
    breaks: tuple[tuple[float, float], ...] = ()
    read: np.ndarray | None = None
    # filled by `smooth`
    qs: np.ndarray = None  # type: ignore[assignment]  # asked for only after it
    vs: np.ndarray = None  # type: ignore[assignment]
    as_: np.ndarray = None  # type: ignore[assignment]
    # filled by `refined_cases`: times [n], position, speed, acceleration [n, J]
    fine: tuple[np.ndarray, ...] | None = None
    # filled by `gap.read.noise.noise_of`: the positions that it is of, of each joint, and what these miss by sample
    noises: tuple[np.ndarray, list[tuple[float, float]], list[np.ndarray]] | None = None
    # filled by `local`: the times that it is of, its width
    smoother: tuple[np.ndarray, float, LocalPolynomial] | None = None

    def readings(self, j: int) -> tuple[np.ndarray, np.ndarray]:
        """Times [s] and positions of joint j where they were read."""
        return (self.t, self.q[:, j]) if self.read is None else (self.t[self.read[:, j]], self.q[self.read[:, j], j])

    @property
    def period(self) -> float:
        """s between readings of a joint."""
        return float(np.median([np.median(np.diff(self.readings(j)[0])) for j in range(len(self.joints))]))

    @property
    def duration(self) -> float:
        """s"""
        return float(self.t[-1] - self.t[0]) if len(self.t) else 0.0

    def smooth(self) -> None:
        """Fills qs, vs, as_ [S, J]: position, speed and acceleration by a local cubic through the samples near each."""
        if self.qs is None:
            self.qs, self.vs, self.as_ = local_polynomial(self.t, self.q)

    def local(self, width: float) -> LocalPolynomial:
        """Return what smooths signals [S, J] at this run's times in windows of +- width s."""
        if self.smoother is None or self.smoother[0] is not self.t or self.smoother[1] != width:
            self.smoother = self.t, width, LocalPolynomial(self.t, width)
        return self.smoother[2]

    def only(self, columns: Sequence[int]) -> None:
        """Keep these columns of its joints alone, in this order."""
        k = list(columns)
        self.joints = tuple(self.joints[i] for i in k)
        for name in ("cmd", "q", *COLUMNS):
            x = getattr(self, name)
            setattr(self, name, None if x is None else x[:, k])

    def between(self, start: float, end: float) -> Run:
        """Return the run between two times [s]; commands stay, for what was sent before still acts."""
        on = (self.t >= start) & (self.t <= end)
        parts: dict[str, Any] = dict.fromkeys(("qs", "vs", "as_", "fine", "noises", "smoother"))  # of all of it
        parts |= {n: None if (x := getattr(self, n)) is None else x[on] for n in ("t", "q", "supply", *COLUMNS)}
        return replace(self, **parts, breaks=())

    def command_at(self, t: np.ndarray) -> np.ndarray:
        """Return [n, J] the target in force at each time (the first target before any)."""
        k = np.clip(np.searchsorted(self.cmd_t, t, side="right") - 1, 0, len(self.cmd_t) - 1)
        return self.cmd[k]


def conditions(runs: list[Run]) -> list[int]:
    """Return a group number for each run: runs with the same commands (repeats) share one."""
    groups: list[int] = []
    representatives: list[Run] = []
    for run in runs:
        for g, other in enumerate(representatives):
            if same_commands(run, other):
                groups.append(g)
                break
        else:
            representatives.append(run)
            groups.append(len(representatives) - 1)
    return groups


def same_commands(a: Run, b: Run) -> bool:
    """Return whether two runs were sent the same targets (and have the same drive), so that they are repeats."""
    if a.joints != b.joints or a.servo.to_dict() != b.servo.to_dict() or abs(a.duration - b.duration) > 0.5:
        return False
    t = np.linspace(0.05, 0.95, 200) * min(a.duration, b.duration)
    start_a, start_b = a.t[0], b.t[0]
    x, y = a.command_at(start_a + t), b.command_at(start_b + t)
    span = max(np.ptp(x), np.ptp(y), 1e-6)
    return bool(np.quantile(np.abs(x - y), 0.9) < 0.01 * span + 1e-6)


def spans(t: np.ndarray, on: np.ndarray, join: float) -> list[tuple[float, float]]:
    """Stretches of time (start, end) [s] in which `on` [S] holds at the samples t [S] s, those less than `join` s apart
    joined."""
    step = float(np.median(np.diff(t))) if on.any() else 0.0
    return joined([(float(t[a]), float(t[b - 1] + step)) for a, b in pieces(on)], join)


def pieces(on: np.ndarray) -> list[tuple[int, int]]:
    """Return (first sample, first behind it) of each stretch in which `on` [S] bool holds."""
    edge = np.flatnonzero(np.diff(np.r_[0, on.astype(int), 0])).tolist()
    return list(zip(edge[::2], edge[1::2], strict=True))


def joined(spans: Iterable[tuple[float, float]], gap: float) -> list[tuple[float, float]]:
    """Return stretches of time (start, end) [s], in their order; those less than `gap` s apart joined."""
    out: list[tuple[float, float]] = []
    for a, b in spans:
        if out and a - out[-1][1] < gap:
            out[-1] = (out[-1][0], max(out[-1][1], b))
        else:
            out.append((a, b))
    return out
