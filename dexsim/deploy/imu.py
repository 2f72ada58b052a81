"""How the object is turned, from an IMU inside it: an interface, and a source over UDP for one that a program of yours reads.

The palm of the hand looks up, and orientations are from the object's frame to one whose z axis points up; its heading may
be any: the policy sees only R_object^T R_goal, in which a heading common to both cancels (`observations_rotate.relative`).
A hand mounted otherwise needs its IMU's readings turned into the palm frame first.
"""

from __future__ import annotations

import socket
import time
from typing import Protocol

import numpy as np

from dexsim.errors import UserError


class OrientationSource(Protocol):
    """What the loop reads: the object's orientation [4] (w x y z) and the time [s] it was measured; None if never."""

    def orientation(self, now: float) -> tuple[np.ndarray, float] | None: ...


class UdpImu:
    """Orientations that another program sends to a UDP port of this machine, a line of text each: `w x y z`.

    The newest counts, at the time it is read here; a line that is not four finite numbers is counted in `bad` and left out.
    """

    def __init__(self, port: int, host: str = "127.0.0.1"):
        self.bad, self._last = 0, None
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, port))
        except (OSError, OverflowError) as error:
            raise UserError(f"imu=udp:{port}: cannot listen on that port: {error}") from None
        self._socket.setblocking(False)
        self.port = self._socket.getsockname()[1]

    def orientation(self, now: float) -> tuple[np.ndarray, float] | None:
        """Never waits: what has come in since the last call, at most a hundred lines of it."""
        for _ in range(100):
            try:
                text = self._socket.recv(256)
            except OSError:  # nothing waits
                break
            try:
                q = np.array([float(x) for x in text.replace(b",", b" ").split()])
                size = float(np.linalg.norm(q))
                if q.shape != (4,) or not 0.5 < size < 2.0:
                    raise ValueError
            except ValueError:
                self.bad += 1
                continue
            self._last = q / size, now
        return self._last

    def wait(self, seconds: float) -> bool:
        """Whether a first orientation comes within that time."""
        limit = time.monotonic() + seconds
        while self.orientation(time.monotonic()) is None and time.monotonic() < limit:
            time.sleep(0.02)
        return self._last is not None

    def close(self) -> None:
        """Free the port."""
        self._socket.close()
