"""Ctrl-C, SIGTERM and SIGHUP, for commands that have something to save before they end."""

from __future__ import annotations

import math
import os
import signal
import sys
import time
from types import FrameType
from typing import Any, Self

from dexsim import system

SAME_SIGNAL_S = 5.0  # torchrun passes on a Ctrl-C that the terminal has sent to every process already


class Stop:
    """At once by default; while ``gently`` is set, the first signal only asks the work to end. A SIGHUP that was
    ignored before (nohup) still is. ``status``: the exit status then, 128 + the signal's number.

    several: it is one of several processes: signals within SAME_SIGNAL_S count as one.
    """

    def __init__(self, several: bool = False) -> None:
        self.gently, self.status = False, 130
        self._requested, self._several, self._last = False, several, -math.inf
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        try:
            for number in self.signals():
                self._before[number] = signal.signal(number, self._handle)
        except ValueError:  # not in the main thread: whoever runs us handles signals
            pass
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _handle(self, number: int, _frame: FrameType | None) -> None:
        before, self._last = self._last, time.monotonic()
        if self._several and self._last - before < SAME_SIGNAL_S:
            return
        self.status = 128 + number
        if system.terminal_gone(number):
            without_terminal()
        if not self.gently or self._requested:
            raise KeyboardInterrupt
        self._requested = True
        print("\nstopping and saving (Ctrl-C again: stop at once, without saving)", flush=True)

    def signals(self) -> dict[int, str]:
        """Return the signals that are handled, with their names."""
        return system.stop_signals()

    def requested(self) -> bool:
        """Return whether someone asked to stop."""
        return self._requested


def without_terminal() -> None:
    """Send, where the terminal is gone, what is still printed nowhere: an error of ``print`` must not keep anything
    from being saved."""
    for stream, number in ((sys.stdout, 1), (sys.stderr, 2)):
        try:
            stream.write("\n")
            stream.flush()
        except (OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, number)
            os.close(nowhere)
