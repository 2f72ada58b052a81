"""How the object is turned, from an IMU inside it: an interface, and a source over UDP for one that a program of yours
reads.

The palm of the hand looks up, and orientations are from the object's frame to one whose z axis points up; its heading
may be any: the policy sees only R_object^T R_goal, in which a heading common to both cancels
(`observations_rotate.relative`). A hand mounted otherwise needs its IMU's readings turned into the palm frame first.
"""

from __future__ import annotations

import select
import socket
import time
from typing import Protocol

import numpy as np

from dexsim.errors import UserError

QUEUE = 16 << 10
"""Bytes of lines that wait in the kernel: few, so that what is read is young even when they come in a flood."""
MOST = 400
"""Lines read at a time; more do not wait."""


class OrientationSource(Protocol):
    """What the loop reads: the object's orientation [4] (w x y z) and the time [s] it was measured; None if never."""

    def orientation(self, now: float) -> tuple[np.ndarray, float] | None: ...


class UdpImu:
    """Orientations that another program sends to a UDP port of this machine, a line of text each: `w x y z`.

    The newest counts, at the time it is read here; a line that is not four finite numbers is counted in `bad` and left
    out. The first sender of a good line is the only one from then on (`sender`; sender_port names it beforehand): the
    socket is bound to it, so that the lines of others never fill the queue. Lines of others that were waiting by then
    are counted in `foreign`.
    """

    def __init__(self, port: int, host: str = "127.0.0.1", sender_port: int | None = None):
        self.bad, self.foreign = 0, 0
        self._last: tuple[np.ndarray, float] | None = None
        self.sender: tuple[str, int] | None = None
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, QUEUE)
        try:
            self._socket.bind((host, port))
            if sender_port is not None:
                self._keep_to((host, sender_port))
        except (OSError, OverflowError) as error:
            raise UserError(f"imu=udp:{port}: cannot listen on that port: {error}") from None
        self._socket.setblocking(False)
        self.port = self._socket.getsockname()[1]

    def _keep_to(self, sender: tuple[str, int]) -> None:
        self._socket.connect(sender)  # the kernel drops what others send
        self.sender = sender

    def orientation(self, now: float) -> tuple[np.ndarray, float] | None:
        """Return, without waiting, the newest good line that has come in since the last call, else the last one."""
        waiting: list[tuple[bytes, tuple[str, int]]] = []
        for _ in range(MOST):
            try:
                waiting.append(self._socket.recvfrom(256))
            except BlockingIOError:
                break
            except OSError:  # the sender's port is closed: nobody listens to what nobody sent
                continue
        known = self.sender is not None
        for text, sender in reversed(waiting) if known else waiting:
            if self.sender is not None and sender != self.sender:
                self.foreign += 1
                continue
            q = _orientation(text)
            if q is None:
                self.bad += 1
                continue
            self._last = q, now
            if known:
                break  # the newest; those before it do not matter
            if self.sender is None:
                self._keep_to(sender)
        return self._last

    def wait(self, seconds: float) -> bool:
        """Return whether a first orientation comes within that time. What comes is read at once: in a flood of others'
        lines a queue that is looked at now and then would nearly always be full."""
        limit = time.monotonic() + seconds
        while self.orientation(time.monotonic()) is None and (remaining := limit - time.monotonic()) > 0:
            select.select([self._socket], [], [], remaining)
        return self._last is not None

    def close(self) -> None:
        """Free the port."""
        self._socket.close()


def _orientation(text: bytes) -> np.ndarray | None:
    """Return a line's quaternion [4], w x y z, of length 1; None where it is not four numbers of about that length."""
    try:
        q = np.array([float(x) for x in text.replace(b",", b" ").split()])
    except ValueError:
        return None
    size = float(np.linalg.norm(q))
    return q / size if q.shape == (4,) and 0.5 < size < 2.0 else None
