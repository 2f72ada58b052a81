"""Everything the loop sees and sends, written to MCAP by a thread of its own: the loop only puts into a queue."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.recording.writer import Writer

OBSERVATION, ACTION, FORCE_COMMAND, HEIGHT, ERRORS = (
    "/policy/observation", "/policy/action", "/policy/force_command", "/object_seen", "/joint_errors",
)  # fmt: skip
TURNED, GOAL = "/object_turned", "/policy/goal"
HAND = "hand"
"""A record of metadata: serial number, side and versions, as the driver gave them."""
LABELS = {OBSERVATION: ("entry",), ACTION: ("joint",), FORCE_COMMAND: ("command",), HEIGHT: ("axis",),
          ERRORS: ("joint",),
          TURNED: ("wxyz",), GOAL: ("wxyz",)}  # fmt: skip
"""Topics beside those of a recording: Float32MultiArray."""


class Recorder:
    """Owns the writer's thread. `put` never waits; samples are dropped and counted once `most` of them are waiting.

    Times given are of the loop's clock; `zero` of it is the recording's start.
    """

    def __init__(
        self, path: str | Path, joints: Sequence[str], meta: Mapping[str, Any], config: str | None, zero: float,
        start_ns: int | None = None, most: int = 4000, chunk_s: float = 0.5, sensed: Sequence[str] = (),
    ):  # fmt: skip
        self.writer = Writer(path, joints, meta, start_ns, config, chunk_s=chunk_s, sensed=sensed)
        self.path, self.zero, self.dropped, self.written = self.writer.path, zero, 0, 0
        self.error: str | None = None
        self._queue: queue.SimpleQueue = queue.SimpleQueue()
        self._most = most
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def put(self, kind: str, t: float, *values: Any) -> None:
        """Queue values for the file. kind: command, state, tactile, temperature, `HAND`, or a topic of `LABELS`; values
        are not to be changed afterwards."""
        if self._queue.qsize() >= self._most or self.error:
            self.dropped += 1
        else:
            self._queue.put((kind, t - self.zero, values))

    def close(self, timeout: float = 10.0) -> None:
        """Write what waits, and the index; a file in which there is nothing goes. Raises nothing: what went wrong is
        said in `error`, and a run's report outlives its recording."""
        self._queue.put(None)
        self._thread.join(timeout)
        if self._thread.is_alive():
            self.error = (
                self.error
                or f"{self.path}: the disk did not take the last samples within {timeout:g} s; the index is missing"
            )
            return
        try:
            self.writer.close()
        except Exception as error:
            self.error = (
                self.error or f"{self.path}: {_reason(error)}; the index is missing, what was written before is there"
            )
            with contextlib.suppress(Exception):
                self.writer._file.close()
        if not self.written and self.error is None:
            with contextlib.suppress(OSError):
                self.path.unlink()

    def _run(self) -> None:
        w = self.writer
        add: dict[str, Callable[..., None]] = {
            "command": w.add_command, "tactile": partial(w.add, "tactile"),
            "temperature": partial(w.add, "temperature"),
        }  # fmt: skip
        first = None
        while (item := self._queue.get()) is not None:
            kind, t, values = item
            first = t if first is None else first
            try:
                if kind == HAND:
                    w.add_about(HAND, values[0])
                    continue
                if kind == "state":
                    position, velocity, effort, stamp, *follower = values
                    w.add_state(t, position, velocity, effort, stamp - self.zero, *follower)
                elif kind in add:
                    add[kind](t, *values)
                else:
                    w.add_array(kind, t, np.atleast_1d(np.asarray(values[0], np.float32)), LABELS[kind])
                self.written += 1
            except Exception as error:  # a full disk must not stop the hand, and neither must what cannot be written
                self.error = f"{self.path}: {_reason(error)}; nothing is recorded from {t - first:.1f} s on"
                return
            if self._queue.empty():
                time.sleep(0.002)  # a few samples at a time: fewer turns taken from the loop


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or f"{type(error).__name__}: {' '.join(str(error).split())[:160]}"
