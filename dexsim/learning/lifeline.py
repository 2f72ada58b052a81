"""How the ranks of one run end together when one of them is gone.

A rank that dies in the middle of training leaves the others waiting inside a collective operation, where no signal
handler of Python runs; with NCCL for ten minutes. So each rank holds a plain TCP connection to rank 0, watched by a
thread: the kernel closes it however the process ends. Rank 0 passes the news on, one line is printed, and all processes
exit.
"""

from __future__ import annotations

import os
import selectors
import socket
import sys
import threading
import time
from typing import Any

BYE, FAIL, LOST = b"B", b"F", b"L"
KEY = "dexsim/lifeline"
STATUS = 1  # exit status of ranks that end because another did


class Lifeline:
    """Connections of one rank: to all others on rank 0, to rank 0 on the others.

    Args:
        rank, size: of this process; of the group.
        store: torch's key-value store that all ranks share; tells them rank 0's address.

    ``hint`` is appended to the line that is printed when a rank is lost.
    """

    def __init__(self, rank: int, size: int, store: Any) -> None:
        self.rank, self.hint = rank, ""
        self._lock, self._said = threading.Lock(), False
        self._peers: dict[socket.socket, int] = {}
        if rank == 0:
            host, token = os.environ.get("MASTER_ADDR", "127.0.0.1"), os.urandom(8).hex().encode()
            server = _listen(host)
            store.set(KEY, f"{host} {server.getsockname()[1]} {token.decode()}")
            server.settimeout(600.0)
            while len(self._peers) < size - 1:
                peer, _ = server.accept()
                peer.settimeout(10.0)
                hello = _receive(peer, len(token) + 8)
                if hello[: len(token)] == token:
                    self._peers[peer] = int(hello[len(token):])
                else:
                    peer.close()
            server.close()
        else:
            host, port, token = store.get(KEY).decode().split()
            peer = socket.create_connection((host, int(port)), timeout=600.0)
            peer.sendall(f"{token}{rank:08d}".encode())
            self._peers[peer] = 0
        for peer in self._peers:
            peer.settimeout(None)
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)  # a machine that loses its power
            for name, value in (("TCP_KEEPIDLE", 5), ("TCP_KEEPINTVL", 5), ("TCP_KEEPCNT", 3)):
                if hasattr(socket, name):
                    peer.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
        self._closing = False
        threading.Thread(target=self._watch, name="lifeline", daemon=True).start()

    def fail(self, text: str, status: int) -> None:
        """End this rank on purpose: the others follow. Rank 0 prints the text of another rank; its own is printed by
        the caller. An empty text: nothing to say. Ranks other than 0 exit here with ``status``."""
        with self._lock:
            self._said = True
        self._send(FAIL, f"rank {self.rank}: {text}" if text and self.rank else "")
        if self.rank:
            time.sleep(0.2)  # so that rank 0 has the line before it sees the connection end
            _exit(status)

    def close(self) -> None:
        """End in good order: from now on the end of another rank means nothing."""
        self._closing = True
        self._send(BYE, "")

    def _send(self, kind: bytes, text: str) -> None:
        data = text.encode()[:4000]
        for peer in list(self._peers):
            try:
                peer.sendall(kind + len(data).to_bytes(4, "big") + data)
            except OSError:
                pass  # gone already

    def _watch(self) -> None:
        with selectors.DefaultSelector() as selector:
            for peer in self._peers:
                selector.register(peer, selectors.EVENT_READ)
            open_peers = len(self._peers)
            while open_peers:
                for key, _ in selector.select():
                    end = key.fileobj
                    assert isinstance(end, socket.socket)  # registered above
                    kind, text = _message(end)
                    if kind in (BYE, b"") and (kind == BYE or self._closing):
                        selector.unregister(end)
                        open_peers -= 1
                        continue
                    self._end(kind, text, self._peers[end])
                    return

    def _end(self, kind: bytes, text: str, rank: int) -> None:
        """Pass on that another rank failed (it said why) or is lost, print one line, exit."""
        if kind == b"" and self.rank:
            text = "rank 0 is gone; the run ends" if self.rank == 1 else ""  # one speaks for all
        elif kind == b"":
            text = f"rank {rank} is gone; the run ends"
        with self._lock:
            if self._said and self.rank == 0:  # the main thread is about to end for a reason of its own
                return
            say, self._said = bool(text) and (self.rank == 0 or kind == b""), True
        if self.rank == 0:
            self._send(LOST, "")
        if say:
            sys.stdout.flush()
            print(f"error: {text}{f'; {self.hint}' if self.hint else ''}", file=sys.stderr, flush=True)
        _exit(STATUS)


def _listen(host: str) -> socket.socket:
    """Return a server on the interface that the others know rank 0 by."""
    try:
        return socket.create_server((host, 0))
    except OSError:  # a name that means something else here
        return socket.create_server(("", 0))


def _exit(status: int) -> None:
    """End at once: the main thread may be inside a collective operation that never returns."""
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except (OSError, ValueError):
        pass
    os._exit(status)


def _receive(peer: socket.socket, size: int) -> bytes:
    """Return exactly ``size`` bytes, fewer where the connection ends."""
    data = b""
    while len(data) < size:
        try:
            part = peer.recv(size - len(data))
        except OSError:
            break
        if not part:
            break
        data += part
    return data


def _message(peer: socket.socket) -> tuple[bytes, str]:
    """Return (kind, text) of one message; kind b"" where the connection ended."""
    head = _receive(peer, 5)
    if len(head) < 5:
        return b"", ""
    return head[:1], _receive(peer, int.from_bytes(head[1:], "big")).decode(errors="replace")
