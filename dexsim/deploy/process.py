"""A hand's bus in a process of its own, beside the loop: a driver that blocks, prints or aborts takes only itself.

`BusDriver` is the loop's side, a `HandDriver`; a `Body` is the hand's side, made in the child by a function that can be
pickled. They share memory: two slots of states and two of commands, one writer each, no locks. Each watches the other.
The child lets go where the loop is silent for `hang` seconds or is gone (SIGKILL, a debugger, a machine that swaps);
the loop learns in its next turn that the child has ended. With a `VirtualClock` the body is stepped in place.
"""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from dexsim import system
from dexsim.deploy.driver import PASSIVE, Clock, HandCommand, HandState, VirtualClock
from dexsim.errors import UserError

HANG = 0.15
"""s that the loop may be silent before the child lets go of the hand."""
LAST = 6.0
"""s that the child tries to let go at its end: a firmware in its boot mode takes 4.2 s to hear."""
NOBODY = "nobody holds the bus, and the hand keeps its last target: cut its power"
_SEEN = 9  # numbers at the end of a state: the object's place and its time, its orientation and its time
_TEXT = 1000  # bytes of a message
_STATE = ("position", "current", "temperature", "error")  # what of a state is one number a joint, always
_MODES = ("kp", "ki", "kd", "mode")  # what of a command is one number


class Body(Protocol):
    """A hand behind its bus. due [s]: when the next cycle begins, or a slow hand's next state is there."""

    clock: Clock

    @property
    def due(self) -> float: ...

    def open(self) -> dict[str, str]:
        """Connect; returns what to log. Raises UserError."""

    def cycle(self, command: HandCommand | None) -> HandState | None:
        """Return one bus cycle, which takes its time: the command goes out (None: none yet; the same object: sent
        before), what comes back is returned, None where nothing new did."""

    def problem(self) -> str:
        """Return why the hand cannot be driven any longer; empty while it can."""

    def released(self) -> tuple[bool, str] | None:
        """Return, after a passive command, whether the hand is limp, and by what that is known; None while not."""

    def seen(self) -> np.ndarray:
        """Return the object [9]: place [3] m, its time [s], orientation [4] w x y z, its time [s]; NaN where none."""

    def handle(self, what: int) -> None:
        """Hold the object out (1), let it go (2), press finger k (3 + k), block joint j (101 + j), or none any more
        (100)."""

    def close(self) -> None:
        """Close the connection."""


class BusDriver:
    """The driver of a hand whose `Body` lives in a child process; see the module.

    make: gives the body, in the child, from the clock that it runs by; joints, taxels, sensed: sizes of a state. hang
    [s]: see `HANG`. start [s] that opening may take. clock: a `VirtualClock` keeps the body in this process, in step.
    """

    name = "hand"

    def __init__(
        self, make: Callable[[Clock], Body], joints: int, taxels: tuple[int, int], clock: Clock | None = None,
        hang: float = HANG, start: float = 60.0, sensed: int = 0,
    ):  # fmt: skip
        self.clock, self.joints, self.taxels, self.hang = clock or Clock(), joints, taxels, hang
        self._make, self.start, self._layouts = make, start, _layouts(joints, taxels, sensed)
        self.body: Body | None = None
        self._process: multiprocessing.context.SpawnProcess | None = None
        self._lock = threading.Lock()
        self._ended = ""
        self.rescued = ""  # by what a hand was let go whose process had died

    # -- HandDriver
    def open(self) -> dict[str, str]:
        """Connect; returns what to log. Raises UserError."""
        self._era = self._number = self._object = 0
        self._ended = ""
        if type(self.clock) is not Clock:
            assert isinstance(self.clock, VirtualClock)
            self.body = self._make(self.clock)
            info = self.body.open()  # which takes its time
            self._bus_time = self.clock.now()
            self._command: HandCommand | None = None
            self._waiting: list[tuple[float, HandState | None, np.ndarray]] = []
            self._state: HandState | None = None
            self._object_row = np.full(_SEEN, np.nan)
            return info
        context = multiprocessing.get_context("spawn")
        shared = _shared(context, self._layouts)
        self._v = v = _views(shared, self._layouts)
        handle, path = tempfile.mkstemp(prefix="dexsim-bus-")
        os.close(handle)
        self._output = Path(path)
        v["beat"].value = time.monotonic()
        self._process = context.Process(
            target=_child, args=(self._make, shared, self._layouts, self.hang, path), daemon=True
        )
        self._process.start()
        limit = time.monotonic() + self.start
        while not v["ready"].value:
            if not self._process.is_alive() or time.monotonic() > limit:
                why = _text(v["problem"]) or (
                    self._how() if not self._process.is_alive() else f"it did not start within {self.start:g} s"
                )
                self._end()
                raise UserError(f"{self.name}: {why}")
            time.sleep(0.005)
        return dict(line.split("=", 1) for line in _text(v["info"]).splitlines())

    def read(self) -> HandState | None:
        """Return the newest state, None before the first."""
        if self.body is not None:
            return self._step(self.body)
        v = self._v
        v["beat"].value = time.monotonic()
        while True:
            k = v["newest"].value
            if k < 0:
                return None
            row = v["state"][k % 2].copy()
            if v["newest"].value - k < 2:
                break  # else the slot was written over while it was copied
        part = {name: row[name] for name in (*_STATE, "tactile", "silent")}
        speed, follower = row["velocity"], row["follower"]
        return HandState(float(row["time"]), int(row["sequence"]), **part,
                         velocity=speed if np.isfinite(speed).all() else None,
                         follower=follower if follower.size and np.isfinite(follower).all() else None)  # fmt: skip

    def send(self, command: HandCommand) -> None:
        """Hand over targets for the next bus cycle. Those of before the last `relax` are not carried out any more."""
        self._post(command, self._era)

    def relax(self) -> None:
        """Let go in the next bus cycle; nothing that was sent before drives again. Raises UserError where nobody holds
        the bus."""
        self.renew()
        zero = np.zeros(self.joints)
        self._post(HandCommand(zero, zero, kp=0, mode=PASSIVE), self._era)
        if self._gone():
            raise UserError(self._ended)

    def renew(self) -> None:
        """Let what was sent until now drive no more."""
        self._era += 1
        if self.body is None and self._process is not None:
            self._v["era"].value = self._era  # counts at once, even where a thread hangs inside `send`

    def problem(self) -> str:
        """Return why the hand cannot be driven any longer; empty while it can."""
        if self.body is not None:
            return self.body.problem()
        return self._ended if self._gone() else _text(self._v["problem"])

    def released(self) -> tuple[bool, str] | None:
        """Return whether the hand is limp since it was let go, and by what that is known; None while it is not."""
        if self.body is not None:
            return self.body.released()
        if self._gone():
            return False, self._ended
        state = self._v["released"].value
        return None if state < 0 else (state == 1, _text(self._v["proof"]))

    def present(self) -> None:
        """Hold the object out."""
        self._handle(1)

    def started(self) -> None:
        """Let the object go: the policy begins."""
        self._handle(2)

    def press(self, finger: int) -> None:
        """Press a fingertip, where somebody simulates that."""
        self._handle(3 + finger)
        self.relax()

    def block(self, joint: int) -> None:
        """Hold something hard before a joint (-1: no longer), where somebody simulates that."""
        self._handle(101 + joint)

    def close(self) -> None:
        """Let go, wait until it is known whether the hand is limp, disconnect. Where the process had died, a new one
        opens the bus and lets go. Raises UserError where the hand may still drive."""
        if self.body is not None:
            with contextlib.suppress(UserError):
                self.relax()
            self.body.close()
            return
        if self._process is None:
            return
        died = self._gone()
        if died:
            why = self._ended
            self._end()
            try:
                self.open()
            except UserError as error:
                raise UserError(f"{self.name}: {why} (a new process could not let go either: {error})") from None
        with contextlib.suppress(UserError):
            self.relax()
        self._v["stop"].value = 1
        self._process.join(8.0)  # it lets go, and knows how that went, before it ends
        limp = self._v["released"].value == 1 or not self._number
        why = _text(self._v["proof"]) or _text(self._v["problem"]) or "it gave no answer"
        self._end()
        self.rescued = f"a new process opened the bus and let go of the hand ({why})" if died and limp else ""
        if not limp:
            raise UserError(f"{self.name}: the hand is not known to be limp ({why}); cut its power")

    # -- the object, of a simulated hand
    def place(self, now: float) -> tuple[np.ndarray, float] | None:
        """Return the object (a HeightSource) as a simulated camera last saw it."""
        return self._object_seen(slice(0, 4))

    def orientation(self, now: float) -> tuple[np.ndarray, float] | None:
        """Return the orientation (an OrientationSource) as the object's IMU last said."""
        return self._object_seen(slice(4, 9))

    def pose(self, now: float) -> tuple[np.ndarray, float] | None:
        """Return both, [7]: x y z m, w x y z; the older one's time."""
        place, turned = self.place(now), self.orientation(now)
        if place is None or turned is None:
            return None
        return np.concatenate([place[0], turned[0]]), min(place[1], turned[1])

    def _object_seen(self, part: slice) -> tuple[np.ndarray, float] | None:
        if self.body is not None:
            self._step(self.body)
            row = self._object_row[part]
        else:
            row = self._v["state"]["seen"][max(self._v["newest"].value, 0) % 2][part].copy()
        return None if not np.isfinite(row).all() else (row[:-1], float(row[-1]))

    # -- parts
    def _handle(self, what: int) -> None:
        self._object = what
        if self.body is not None:
            self.body.handle(what)

    def _post(self, c: HandCommand, era: int) -> None:
        if self.body is not None:
            if era == self._era:
                self._command = c
            return
        if self._process is None:
            return
        held = self._lock.acquire(timeout=0.02)  # a thread that holds it longer hangs, and its era is over
        try:
            v = self._v
            v["beat"].value = time.monotonic()
            number = self._number = self._number + 1
            row, known = v["command"][number % 2], {"number": number, "era": era, "object": self._object}
            for name in row.dtype.names:
                row[name] = known[name] if name in known else getattr(c, name)
            v["sent"].value = number
        finally:
            if held:
                self._lock.release()

    def _step(self, body: Body) -> HandState | None:
        """Step in place: the bus cycles that have begun by now."""
        clock, now = self.clock, self.clock.now()
        assert isinstance(clock, VirtualClock)
        clock.go(self._bus_time)  # the bus is ahead of the loop, by one clock: the package may have been given it
        while body.due <= now + 1e-6:
            state = body.cycle(self._command)
            self._waiting.append((clock.now() if state is None else state.time, state, body.seen()))
        self._bus_time = clock.now()
        clock.go(now)
        while self._waiting and self._waiting[0][0] <= now + 1e-6:
            _, state, self._object_row = self._waiting.pop(0)
            self._state = state or self._state
        return self._state

    def _gone(self) -> bool:
        """Return whether the child has ended by itself; says how, once."""
        if self._process is not None and not self._ended and self._process.exitcode is not None:
            self._ended = f"the process of the bus ended ({self._how()}): {NOBODY}"
        return bool(self._ended)

    def _how(self) -> str:
        code = self._process.exitcode if self._process is not None else None
        how = "" if code is None else signal.Signals(-code).name if code < 0 else f"exit status {code}"
        with contextlib.suppress(OSError):
            lines = self._output.read_bytes()[-2000:].decode(errors="replace").split("\n")
            said = [" ".join(line.split())[:160] for line in lines if line.strip()]
            how += f"; the package's last words: {said[-1]}" if said else ""
        return how

    def _end(self) -> None:
        """End the child and delete its files."""
        p, self._process = self._process, None
        if p is not None and p.is_alive():
            p.terminate()
            p.join(0.5)
            if p.is_alive():
                p.kill()
                p.join(1.0)
        with contextlib.suppress(OSError):
            self._output.unlink()


# -- the child
def _child(make: Callable[[Clock], Body], raw: tuple, layouts: Sequence[np.dtype], hang: float, output: str) -> None:
    """Run the child's process: no key of the loop's terminal reaches the one that holds the hand."""
    system.leave_terminal()
    for number in system.hand_signals():
        signal.signal(number, signal.SIG_IGN)
    lives = multiprocessing.parent_process().is_alive  # type: ignore[union-attr]  # this is a child
    stop: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: stop.append(number))
    with open(output, "ab") as sink:  # a native package prints to standard output
        os.dup2(sink.fileno(), 1)
    status = _serve(make, _views(raw, layouts), hang, lambda: bool(stop) or not lives())
    sys.stdout.flush()
    os._exit(status)  # threads of a native package may wait for ever


def _serve(make: Callable[[Clock], Body], v: dict[str, Any], hang: float, orphan: Callable[[], bool]) -> int:
    """Return bus cycles until the loop says stop, is silent or is gone; the last of them let go. Returns an exit
    status."""
    try:
        body = make(Clock())
        info = body.open()
    except BaseException as error:  # whatever a package raises
        _say(v["problem"], str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}")
        return 2
    _say(v["info"], "\n".join(f"{k}={' '.join(str(x).split())}" for k, x in info.items()))
    v["ready"].value = 1
    command: HandCommand | None = None
    taken, handled, count, era, last = 0, 0, -1, 0, float("inf")
    silent_at, silent = 0, ""  # what was sent before this era drives no more: the loop had fallen silent
    while True:
        if (number := v["sent"].value) > taken:
            row = v["command"][number % 2].copy()
            taken, era = int(row["number"]), int(row["era"])
            command = HandCommand(row["position"], row["tor_max"], *(int(row[name]) for name in _MODES))
            if row["object"] != handled:
                handled = int(row["object"])
                body.handle(handled)
        now, alone = time.monotonic(), orphan()
        silence = now - v["beat"].value
        if command is not None and command.mode != PASSIVE:
            if (alone or silence > hang) and era >= silent_at:
                silent_at = era + 1
                silent = (
                    f"the loop was silent for {1e3 * silence:.0f} ms, allowed {1e3 * hang:.0f}: the process of the bus"
                    " let go of the hand"
                )
            if era < max(v["era"].value, silent_at) or v["stop"].value:
                command = HandCommand(command.position, np.zeros_like(command.tor_max), 0, mode=PASSIVE)
        if alone or (v["stop"].value and v["sent"].value == taken):  # what was sent before it is carried out
            last = min(last, now + LAST)
            if command is None or body.released() is not None or now > last:
                break
        try:
            state = body.cycle(command)
        except SystemExit as error:
            print(f"the driver called sys.exit({error.code})", flush=True)
            return 3
        silent = "" if v["era"].value >= silent_at else silent
        _say(v["problem"], silent or body.problem())
        proof = body.released()
        if proof is not None:
            _say(v["proof"], proof[1])
        v["released"].value = -1 if proof is None else int(proof[0])
        if state is None:
            continue
        count += 1
        slot = v["state"][count % 2]
        for name in ("time", "sequence", *_STATE):
            slot[name] = getattr(state, name)
        for name in ("velocity", "follower"):
            slot[name] = np.nan if (x := getattr(state, name)) is None else x
        slot["silent"] = False if state.silent is None else state.silent
        slot["seen"] = body.seen()
        if state.tactile.size:
            slot["tactile"] = state.tactile
        v["newest"].value = count
    with contextlib.suppress(Exception):
        body.close()
    return 0


def _layouts(joints: int, taxels: tuple[int, int], sensed: int) -> list[np.dtype]:
    """Return the fields of a state and of a command, as the two processes share them."""
    each = (joints,)
    state = [
        ("time", float), ("sequence", int), ("position", np.float32, each), ("current", np.int16, each),
        ("temperature", float, each), ("error", int, each), ("velocity", float, each), ("follower", float, (sensed,)),
        ("tactile", np.int16, (*taxels, 3)), ("silent", bool, taxels[:1]), ("seen", float, (_SEEN,)),
    ]  # fmt: skip
    command = [("number", int), ("era", int), ("object", int), ("position", float, each), ("tor_max", float, each)]
    return [np.dtype(x, align=True) for x in (state, [*command, *((name, int) for name in _MODES)])]


def _shared(context: Any, layouts: Sequence[np.dtype]) -> tuple:
    whole, text = ctypes.c_int64, ctypes.c_char
    return (*(context.RawArray(ctypes.c_byte, 2 * x.itemsize) for x in layouts),
            context.RawValue(ctypes.c_double, 0.0), *(context.RawValue(whole, x) for x in (-1, 0, 0, 0, 0, -1)),
            *(context.RawArray(text, _TEXT) for _ in range(3)))  # fmt: skip


def _views(raw: tuple, layouts: Sequence[np.dtype]) -> dict[str, Any]:
    names = "beat newest sent era stop ready released problem proof info".split()
    slots = {name: np.frombuffer(x, kind) for name, x, kind in zip(("state", "command"), raw, layouts, strict=False)}
    return slots | dict(zip(names, raw[2:], strict=True))


def _say(where: Any, text: str) -> None:
    data = text.encode(errors="replace")[: _TEXT - 1]
    if where.value != data:
        where.value = data


def _text(where: Any) -> str:
    return where.value.decode(errors="replace")
