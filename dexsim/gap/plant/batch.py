"""Batched simulation of one joint's recorded windows under many parameter guesses (see `kernel.py`)."""

from __future__ import annotations

import copy
import itertools
import platform
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from dexsim.actuator.law import brought
from dexsim.actuator.setpoint import FREE, PROFILE, setpoints
from dexsim.gap import compute
from dexsim.gap.plant import kernel as pk
from dexsim.gap.plant.columns import INDEX, NAMES, NEUTRAL, SERIES, SERIES_INDEX
from dexsim.gap.plant.lines import on_lines
from dexsim.gap.plant.mechanics import JointConstants

# threads of a GPU in a block: each block sits on a core of the GPU of its own, and a launch of a fit has fewer blocks
# than there are; one of a scan has more, and takes a quarter longer in blocks of 32
BLOCK = 64
PROFILED, PLAY = [INDEX[name] for name in PROFILE], [INDEX["backlash"], INDEX["softness"]]
WARM = 0.15  # s before a window in which the recorded motion is held
KNOWN = 1 << 24  # bytes of answers that one set of windows keeps
CHUNK = 16  # of them that are copied in one call, and forgotten when all are
# guesses x windows a core up to which a CPU is faster than one thread of a GPU each: a step of one takes a core 0.04 us
# (two inertias 0.16) and a GPU 5 us (14), whose thousands of threads are no use to a fit that asks for a hundred
FEW = 16
# guesses that simulate as fast alone as in a vector, and whether this machine has vectors of some width
FILLED, SIDE_BY_SIDE = 3, platform.machine() in ("x86_64", "AMD64")
_GPU = threading.Lock()  # Warp's own state is not for several threads; what waits for a GPU does not hold it
_LANE = threading.local()
_VERSIONS = itertools.count()  # of plants: what one simulated is not what another would


class Lane:
    """One thread's way to a GPU: a stream of its own, so that the launches of several joints overlap, and memory that
    is allocated once (an allocation or a release in between would wait for every stream)."""

    pinned = True  # memory of the CPU that the GPU copies by itself

    def __init__(self, device: str):
        self.device = device
        self.stream = wp.Stream(device)
        # for the thread's life: it also waits for its stream outside of the lock
        wp.get_device(device).context_guard.__enter__()
        self._room: dict[str, wp.array] = {}
        self._host: dict[str, wp.array] = {}

    def room(self, name: str, size: int) -> wp.array:
        """Return memory of the device for `size` numbers, the same for the same name."""
        if name not in self._room or self._room[name].shape[0] < size:
            self._room[name] = wp.empty(int(1.3 * size) + 1024, dtype=wp.float64, device=self.device)
        return self._room[name]

    def host(self, name: str, size: int) -> wp.array:
        """Return page-locked memory of the CPU for `size` numbers."""
        if name not in self._host or self._host[name].shape[0] < size:
            self._host[name] = wp.empty(int(1.3 * size) + 1024, dtype=wp.float64, device="cpu", pinned=self.pinned)
        return self._host[name]

    def part(self, of: wp.array, at: int, shape: tuple[int, ...]) -> wp.array:
        """`shape` numbers of an array, from number `at` on."""
        return wp.array(ptr=of.ptr + 8 * at, shape=shape, dtype=wp.float64, device=self.device)

    def up(self, given: Sequence[np.ndarray]) -> list[wp.array]:
        """Return the arrays on the device, by one copy; valid until this is called again, which must not be before the
        stream was waited for."""
        ends = np.cumsum([0, *(x.size for x in given)])
        here, there = self.host("in", int(ends[-1])), self.room("in", int(ends[-1]))
        np.concatenate([np.ravel(x) for x in given], out=here.numpy()[: ends[-1]])
        wp.copy(there, here, count=int(ends[-1]))
        return [self.part(there, int(at), x.shape) for at, x in zip(ends, given, strict=False)]


def lane(device: str) -> Lane:
    """This thread's lane; call it with the lock held."""
    known = getattr(_LANE, "by_device", None)
    if known is None:
        known = _LANE.by_device = {}
    if device not in known:
        known[device] = Lane(device)
    return known[device]


class Known:
    """What was simulated before: a search asks for the same guess where one fit ends and the next begins, where a step
    is damped more, where a fit is judged.

    Answers (positions [n], torques [n]) by all that they depend on, as bytes; of more than `KNOWN` bytes those go
    that were not asked for the longest."""

    def __init__(self) -> None:
        self._rows = OrderedDict[bytes, tuple[np.ndarray, np.ndarray]]()

    def clear(self) -> None:
        """Forgets all."""
        self._rows.clear()

    def answers(
        self, keys: Sequence[bytes], simulate: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and torques [H, n] of the keys. simulate(which [h]) makes those [h, n] of the keys with
        these numbers; it is asked for each that is not known, once."""
        rows = {key: self._rows[key] for key in keys if key in self._rows}
        new = {key: k for k, key in reversed(list(enumerate(keys))) if key not in rows}
        made = simulate(np.array(sorted(new.values()))) if new else None
        if made is not None and len(new) == len(keys):
            q, torque = made
        else:
            if made is not None:
                rows |= {keys[k]: row for k, row in zip(sorted(new.values()), zip(*made, strict=True), strict=True)}
            q, torque = (np.stack([rows[key][i] for key in keys]) for i in (0, 1))
        most = KNOWN // max(16 * q.shape[1], 1)
        last = range(max(len(keys) - most, 0), len(keys))
        kept = [k for k in last if keys[k] not in rows]
        copies: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}
        for some in (kept[a : a + CHUNK] for a in range(0, len(kept), CHUNK)):
            copies |= {keys[k]: row for k, row in zip(some, zip(q[some], torque[some], strict=True), strict=True)}
        for k in last:
            self._rows.setdefault(keys[k], copies.get(keys[k]) or rows[keys[k]])
            self._rows.move_to_end(keys[k])
        while len(self._rows) > most:
            self._rows.popitem(last=False)
        return q, torque


@dataclass
class Windows:
    """W stretches of recordings, to be simulated apart. Everything a launch needs, samples of all windows in a row.

    window [W, 8], window_t [W]: see the kernel; sample_step, sample_part [n]; of each sample: its window [n], its row
    in the joint's measurements [n]. run [W]: which run a window is of. known: what was simulated in them before.
    """

    window: np.ndarray
    window_t: np.ndarray
    sample_step: np.ndarray
    sample_part: np.ndarray
    sample_window: np.ndarray
    sample_row: np.ndarray
    run: np.ndarray
    device: dict | None = None
    known: Known = field(default_factory=Known)

    @property
    def n(self) -> int:
        return len(self.sample_row)

    def heads(self, counts: np.ndarray) -> Windows:
        """Return of each window the begin, up to its sample of this number [W], 1 at least."""
        place = np.arange(self.n) - self.window[self.sample_window, 3]
        keep = place < counts[self.sample_window]
        window = self.window.copy()
        window[:, 4] = np.bincount(self.sample_window[keep], minlength=len(window))
        window[:, 3] = np.r_[0, np.cumsum(window[:-1, 4])]
        step = self.sample_step[keep]
        window[:, 1] = step[window[:, 3] + window[:, 4] - 1] + 1
        return Windows(
            window,
            self.window_t,
            step,
            self.sample_part[keep],
            self.sample_window[keep],
            self.sample_row[keep],
            self.run,
        )


class JointPlant:
    """One joint over all runs: measurements in a row, series on the integration grid, and the simulation.

    t, q, run_of [n]: time in its run [s], measured position [rad], which run. torque [n] or None: measured motor
    torque [N.m]. nominal [R, C]: plant parameters believed in each run.
    """

    def __init__(self, joint: str, constants: JointConstants, dt: float, voltage: bool, loop: str, position: str,
                 device: str = "cpu"):
        self.joint, self.constants, self.dt = joint, constants, dt
        self.voltage, self.loop, self.position, self.device = voltage, loop, position, device
        self.nominal: list[np.ndarray] = []
        self._added: list[tuple] = []
        self._cmd_t: list[np.ndarray] = []
        self._cmd: list[np.ndarray] = []
        self._t: list[np.ndarray] = []
        self._q: list[np.ndarray] = []
        self._torque: list[np.ndarray] = []
        self._read: list[np.ndarray | None] = []
        self._start: list[float] = []
        self._grid, self._cmds = [0], [0]
        self._rows = [0]
        self.left_out: set[int] = set()  # runs that tell nothing of this joint: no window is cut from them

    def add(self, nominal: np.ndarray, times: np.ndarray, series: np.ndarray, cmd_t: np.ndarray,
            cmd: np.ndarray, t: np.ndarray, q: np.ndarray, torque: np.ndarray | None,
            exact: dict[str, np.ndarray], read: np.ndarray | None = None) -> None:
        """Adds a run. times [G0], series [G0, E] coarse; exact: columns of the series at the samples t [S]; read [S]:
        which of the positions were read (None: all); windows hold no others."""
        t0 = float(t[0])
        steps = max(int(np.ceil((float(t[-1]) - t0) / self.dt)) + 2, 2)
        self._added.append((times, series, exact))
        self._grid.append(self._grid[-1] + steps)
        self._cmd_t.append(cmd_t)
        self._cmd.append(cmd)
        self._cmds.append(self._cmds[-1] + len(cmd_t))
        self._t.append(t)
        self._q.append(q)
        self._read.append(read)
        self._torque.append(np.full(len(t), np.nan) if torque is None else torque)
        self._rows.append(self._rows[-1] + len(t))
        self.nominal.append(nominal)
        self._start.append(t0)

    def finish(self) -> None:
        """After the last `add`."""
        self.t, self.q = np.concatenate(self._t), np.concatenate(self._q)
        self.torque = np.concatenate(self._torque)
        self.run_of = np.repeat(np.arange(len(self._t)), [len(t) for t in self._t])
        self.series = _columns(self._grid[-1])  # long recordings of many joints are gigabytes: one copy
        for run in range(len(self._t)):
            self._fill(run)
        self._added = []
        c = self.constants
        kp = max(
            float(np.max([p[INDEX["kp"]] * (p[INDEX["torque_limit"]] if self.voltage else 1) for p in self.nominal])),
            1e-9,
        )
        stiff = 30.0 * kp + c.inertia * (2 * np.pi * 40.0) ** 2
        self._consts = np.array([self.voltage, self.loop == "motor", self.position == "motor", c.damping, c.friction,
                                 c.low, c.high, stiff, c.slide], float)  # fmt: skip
        self._d: dict[Any, Any] = {}
        self._version = next(_VERSIONS)

    def _fill(self, run: int) -> None:
        """What was added of a run, on its stretch of the grid."""
        (times, series, exact), t = self._added[run], self._t[run]
        fine = self.series[self._grid[run] : self._grid[run + 1]]
        grid = self._start[run] + self.dt * np.arange(len(fine))
        on_lines(grid, times, series, fine)
        for name, values in exact.items():
            fine[:, SERIES_INDEX[name]] = np.interp(grid, t, values)
        if "enabled" in exact:
            k = np.clip(np.searchsorted(t, grid, side="right") - 1, 0, len(t) - 1)
            fine[:, SERIES_INDEX["enabled"]] = exact["enabled"][k]

    def set_series(self, series: np.ndarray) -> None:
        """Other series [G, E] in the place of those that were added."""
        self.series, self._d, self._version = series, {}, next(_VERSIONS)

    def refined(self, times: int) -> JointPlant:
        """Return the same joint in steps `times` as short, the series between their samples on straight lines."""
        out = copy.copy(self)
        out.dt, out._d, out._version = self.dt / times, {}, next(_VERSIONS)
        sizes = [(b - a - 1) * times + 1 for a, b in zip(self._grid[:-1], self._grid[1:], strict=True)]
        out._grid = [0, *(int(end) for end in np.cumsum(sizes))]
        out.series = _columns(out._grid[-1])
        for column in np.flatnonzero(self.series.any(0)):
            for run in range(len(sizes)):
                coarse, fine = self.series[self.grid(run), column], out.series[out.grid(run), column]
                fine[::times] = coarse
                for k in range(1, times):
                    between = fine[k::times]
                    np.multiply(coarse[:-1], 1 - k / times, out=between)
                    between += k / times * coarse[1:]
        return out

    def grid(self, run: int) -> slice:
        """Return rows of a run in the series."""
        return slice(self._grid[run], self._grid[run + 1])

    @property
    def runs(self) -> int:
        return len(self._t)

    def rows(self, run: int) -> slice:
        """Return rows of a run in the measurements."""
        return slice(self._rows[run], self._rows[run + 1])

    def windows(
        self,
        length: float | None,
        runs: Sequence[int] | None = None,
        span: dict[int, tuple[float, float]] | None = None,
        every_run: bool = False,
        between: bool = False,
    ) -> Windows:
        """Return windows of `length` s (None: whole runs), each after `WARM` s in which the recorded motion is held.

        span: part of a run [s from its start] to keep to. every_run: also runs that tell nothing of this joint;
        between: also samples between its readings.
        """
        window, window_t, step, part, of, run_of = [], [], [], [], [], []
        row: list[int] = []
        for r in range(self.runs) if runs is None else runs:
            if r in self.left_out and not every_run:
                continue
            t = self._t[r]
            begin, stop = 0.0, t[-1] - t[0]
            if span and r in span:
                begin, stop = max(begin, span[r][0]), min(stop, span[r][1])
            size = (stop - begin) if length is None else min(length, stop - begin)
            if size <= 0:
                continue
            count = max(int((stop - begin) / size + 1e-6), 1)
            if length is not None:
                size = (stop - begin) / count  # no remainder is lost
            for i in range(count):
                a = begin + i * size
                b = a + size
                w = min(WARM, a) if length is not None else 0.0
                lo, hi = np.searchsorted(t - t[0], [a - 1e-9, b - 1e-9])
                if i == count - 1 and b >= stop - 1e-6:
                    hi = int(np.searchsorted(t - t[0], b + 1e-9))
                rows = np.arange(lo, hi)
                read = None if between else self._read[r]
                rows = rows if read is None else rows[read[rows]]
                if len(rows) < 3:
                    continue
                g = int(round((a - w) / self.dt))
                first_time = self._start[r] + g * self.dt
                warm_steps = int(round(w / self.dt))
                at = (t[rows] - first_time) / self.dt
                at = np.maximum(at, 0.0)
                total = int(np.floor(at[-1])) + 1
                total = min(total, self._grid[r + 1] - self._grid[r] - g)
                s = np.minimum(np.floor(at).astype(int), total - 1)
                c0, c1 = self._cmds[r], self._cmds[r + 1]
                k = c0 + int(np.clip(np.searchsorted(self._cmd_t[r], first_time - 0.6) - 1, 0, c1 - c0 - 1))
                window.append([self._grid[r] + g, total, warm_steps, len(row), len(rows), c0, c1, k])
                window_t.append(first_time)
                step.extend(s)
                part.extend(at - s)
                of.extend([len(window) - 1] * len(rows))
                row.extend(self._rows[r] + rows)
                run_of.append(r)
        return Windows(
            np.array(window, np.int32).reshape(-1, 8),
            np.array(window_t),
            np.array(step, np.int32),
            np.array(part, float),
            np.array(of, int),
            np.array(row, int),
            np.array(run_of, int),
        )

    def simulate(
        self, params: np.ndarray, windows: Windows, inits: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return reported position [H, n] rad and motor torque [H, n] N.m at the windows' samples.

        params [H, R, C]: plant parameters by run; inits [H, 2], or [H, W, 2] by window: added to the initial position
        and velocity.
        """
        inits = np.zeros((len(params), 1, 2)) if inits is None else np.asarray(inits, float).reshape(len(params), -1, 2)
        # what an answer depends on beside the windows and what does not change of a plant
        common = str(self._version).encode()
        told = params[:, np.unique(windows.run)]
        keys = [common + p.tobytes() + i.tobytes() for p, i in zip(told, inits, strict=True)]
        return windows.known.answers(keys, lambda which: self._simulated(params[which], windows, inits[which]))

    def _simulated(
        self, params: np.ndarray, windows: Windows, inits: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """`simulate`, whatever is known; inits [H, 1 or W, 2]."""
        H, n = len(params), windows.n
        q, torque = np.empty((H, n)), np.empty((H, n))
        # one launch a set of runs that shares its parameters: a guess is a row, so rows are (guess, distinct run)
        groups: dict[bytes, list[int]] = {}
        for r in np.unique(windows.run):
            groups.setdefault(params[:, r].tobytes(), []).append(int(r))
        begins = [self._setpoints(params[:, group[0]], windows, group) for group in groups.values()]
        if self._on_cpu(H * len(windows.window)):
            for group, begin in zip(groups.values(), begins, strict=True):
                pick, keep, steps, rest = self._inputs(windows, tuple(group), "cpu")
                rows, moves = params[:, group[0]], _of(inits, pick)
                for which, columns in self._side_by_side(rows):
                    kernel, lanes = (pk.lanes_kernel(columns), pk.LANES) if columns else (pk.plant_kernel(), 1)
                    alone = len(groups) == 1 and len(which) == H  # nothing to put together
                    size = (len(which), len(windows.sample_row[keep]))
                    oq, ot = (x if alone else np.empty(size) for x in (q, torque))
                    padded = np.r_[which, np.repeat(which[-1:], -len(which) % lanes)]
                    guesses = (_up(rows[padded]), *(_up(x[which]) for x in (moves, begin)), _up(self._consts))
                    given = recorded(*guesses, *rest, *(_up(x, copy=False) for x in (oq, ot)))
                    self._split(len(padded) // lanes, steps, given, kernel)
                    if not alone:
                        put = (which, keep) if isinstance(keep, slice) else np.ix_(which, keep)
                        q[put], torque[put] = oq, ot
            return q, torque
        with _GPU:
            mine = lane(self.device)
            with wp.ScopedStream(mine.stream, sync_enter=False):
                host, out = mine.host("out", 2 * H * n), mine.room("out", 2 * H * n)
                inputs = [self._inputs(windows, tuple(group), self.device) for group in groups.values()]
                told = [params[:, group[0]] for group in groups.values()]
                constants, *sent = mine.up([self._consts, *told, *(_of(inits, pick) for pick, *_ in inputs), *begins])
                at, parts = 0, []
                of_guesses = (sent[k * len(told) : (k + 1) * len(told)] for k in range(3))
                for guess, moves, begin, (_, keep, steps, rest) in zip(*of_guesses, inputs, strict=True):
                    count = len(windows.sample_row[keep])
                    room = H * count
                    mine_q, mine_t = (mine.part(out, at + k * room, (H, count)) for k in (0, 1))
                    given = recorded(guess, moves, begin, constants, *rest, mine_q, mine_t)
                    wp.launch(
                        pk.plant_kernel(),
                        dim=(len(steps), H),
                        inputs=[0, 0, self.dt, given],
                        device=self.device,
                        block_dim=BLOCK,
                    )
                    parts.append((keep, at, room))
                    at += 2 * room
                wp.copy(host, out, count=at)
        wp.synchronize_stream(mine.stream)
        numbers = host.numpy()
        for keep, at, room in parts:
            q[:, keep] = numbers[at : at + room].reshape(H, -1)
            torque[:, keep] = numbers[at + room : at + 2 * room].reshape(H, -1)
        return q, torque

    def _setpoints(self, rows: np.ndarray, windows: Windows, group: Sequence[int]) -> np.ndarray:
        """Return setpoint and its speed [H, W', 2] where the windows [W'] of these runs begin, by each guess's profile
        in rows [H, C]; [H, 0, 2] where no guess limits any."""
        if (rows[:, PROFILED] >= FREE).all():
            return np.zeros((len(rows), 0, 2))
        run, begin = (x[np.isin(windows.run, group)] for x in (windows.run, windows.window_t))
        out = np.empty((len(rows), len(run), 2))
        for r in np.unique(run):
            here = run == r
            first = self.series[self._grid[r], [SERIES_INDEX["q"], SERIES_INDEX["v"]]]
            offset, scale = rows[:, [INDEX["readout_offset"]]] * (1.0, 0.0), rows[:, [INDEX["readout_scale"]]]
            out[:, here] = setpoints(rows, (first - offset) / scale, self._cmd_t[r], self._cmd[r][:, None],
                                     self._start[r], begin[here], self.dt)  # fmt: skip
        return out

    def _on_cpu(self, threads: int) -> bool:
        return self.device == "cpu" or threads <= FEW * compute.cores()

    def _inputs(
        self, windows: Windows, group: tuple[int, ...], device: str
    ) -> tuple[np.ndarray, np.ndarray | slice, np.ndarray, list[wp.array]]:
        """Return (the windows that are of these runs, their samples, steps of each, the kernel's arrays of them), made
        once a device."""
        if windows.device is None:
            windows.device = {}
        if device not in self._d:
            columns, *sent = (
                _up(x, device=device, copy=False)
                for x in (self.series.T, np.concatenate(self._cmd_t), np.concatenate(self._cmd))
            )
            self._d[device] = [columns.transpose((1, 0)), *sent]
        key = (group, device)
        if key not in windows.device:
            pick = np.flatnonzero(np.isin(windows.run, group))
            keep = np.isin(windows.sample_window, pick)
            w = windows.window[pick].copy()
            w[:, 3] = np.concatenate([[0], np.cumsum(w[:-1, 4])])
            windows.device[key] = (
                pick,
                _stretch(np.flatnonzero(keep)),
                w[:, 1],
                [
                    _up(w, wp.int32, device),
                    _up(windows.window_t[pick], device=device),
                    _up(windows.sample_step[keep], wp.int32, device),
                    _up(windows.sample_part[keep], device=device),
                ],
            )
        pick, keep, steps, arrays = windows.device[key]
        return pick, keep, steps, [*self._d[device], *arrays]

    def _side_by_side(self, rows: np.ndarray) -> list[tuple[np.ndarray, tuple[int, ...]]]:
        """Return which guesses, of rows [H, C], have which columns only (`kernel.lanes_kernel`), as far as most of a
        vector of them is filled; the others, with none."""
        left, out = np.ones(len(rows), bool), []
        if SIDE_BY_SIDE and not (self.voltage or "motor" in (self.loop, self.position) or brought()):
            for columns in (pk.USUAL, pk.MORE, pk.TWO, pk.CALLED):
                rest = np.setdiff1d(np.arange(rows.shape[1]), columns)
                two = (rows[:, PLAY] > 0).any(1) == (columns == pk.TWO)
                some = np.flatnonzero(left & two & (rows[:, rest] == pk.ABSENT[rest]).all(1))
                some = some[: len(some) - len(some) % pk.LANES * (len(some) % pk.LANES < FILLED)]
                left[some] = False
                out.append((some, columns))
        return [(x, columns) for x, columns in (*out, (np.flatnonzero(left), ())) if len(x)]

    def _split(self, H: int, steps: np.ndarray, given: pk.Recorded, kernel: wp.Kernel) -> None:
        """H guesses, or as many at a time as the kernel takes, in windows of `steps` [W] on the CPU, in parts side by
        side."""

        def launch(windows: slice, guesses: slice) -> None:
            wp.launch(
                kernel,
                dim=(windows.stop - windows.start, guesses.stop - guesses.start),
                inputs=[windows.start, guesses.start, self.dt, given],
                device="cpu",
            )

        compute.run(launch, compute.parts(steps, H))

    def base(self) -> np.ndarray:
        """Return [R, C] nominal parameters by run."""
        return np.stack(self.nominal)


def _columns(rows: int) -> np.ndarray:
    """Return zeros [rows, E] for series, each column of which lies together: those of effects that are nowhere, most of
    them, then take neither time nor memory."""
    return np.zeros((len(SERIES), rows)).T


def _of(inits: np.ndarray, windows: np.ndarray) -> np.ndarray:
    """Return [H, 1 or W', 2] of where each guess begins [H, 1 or W, 2], that of these windows [W']."""
    return inits if inits.shape[1] == 1 else inits[:, windows]


def _stretch(rows: np.ndarray) -> np.ndarray | slice:
    """Return row numbers that grow, as a slice where none is left out: a fifth of the time to copy."""
    return slice(int(rows[0]), int(rows[-1]) + 1) if len(rows) and rows[-1] - rows[0] + 1 == len(rows) else rows


def _up(x: np.ndarray, dtype: Any = wp.float64, device: str = "cpu", copy: bool = True) -> wp.array:
    return wp.array(np.ascontiguousarray(x), dtype=dtype, device=device, copy=copy or device != "cpu")


def recorded(*arrays: wp.array) -> pk.Recorded:
    """Return the kernel's struct of its arrays, in the order of `kernel.FIELDS`."""
    out = pk.Recorded()
    for name, x in zip(pk.FIELDS, arrays, strict=True):
        setattr(out, name, x)
    return out


def nominal_row(servo_row: np.ndarray, rotor: float) -> np.ndarray:
    """Return [C] plant parameters of a servo table's row (infinite limits made large), all extras neutral. rotor
    [kg.m2]: where the row has none."""
    row = NEUTRAL.copy()
    row[: len(servo_row)] = servo_row
    row[INDEX["rotor"]] = row[INDEX["rotor"]] or rotor
    row[~np.isfinite(row)] = 1e9
    assert len(row) == len(NAMES)
    return row
