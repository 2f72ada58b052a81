"""Who may talk to the live view, and what they may say: the address a request is for, the page it comes from, a token
where the view is served beyond this machine, how many at once, and which messages are passed on."""

from __future__ import annotations

import contextlib
import hmac
import http
import ipaddress
import logging
import math
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

from dexsim.errors import UserError

MOST_CLIENTS = 24
"""Pages open at once; one more is told to wait."""
MOST_WAITING = 64
"""Sockets that have not yet said what they want; one more closes the one that has waited longest."""
HANDSHAKE_S = 5.0
"""s after which a socket that has not said it is closed."""
MOST_BYTES = 1 << 18
"""Of a message from a page; those of the controls have some hundred."""
LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")


class Gate:
    """Decides about each request before viser sees it.

    host: where the view is served. On loopback a request must be for a name of loopback (another's name that was made
    to point here is not one); beyond it, it must carry `token`, once in the address and then in a cookie. A WebSocket
    must come from the page that is served here: its Origin names the same host and port as the request itself.
    """

    def __init__(self, host: str) -> None:
        self.loopback = is_loopback(host)
        self.token = "" if self.loopback else secrets.token_urlsafe(18)
        self.clients = 0
        self.refused = 0
        self.waiting: dict[int, Any] = {}  # transports of sockets in their handshake, oldest first
        self._lock = threading.Lock()

    def reason(self, path: str, headers: Any) -> tuple[int, str] | None:
        """Return why a request is refused (HTTP status, text), or None. headers: multi-valued, by name, any case."""
        hosts = headers.get_all("Host")
        if len(hosts) != 1 or not (host := _name(hosts[0])):
            return 400, "one Host header is needed"
        if self.loopback and host not in LOOPBACK_NAMES:
            return 403, f"this view is for {' or '.join(LOOPBACK_NAMES[:2])}, not for {host[:80]}"
        if _upgrades(headers):
            origins = headers.get_all("Origin")
            if len(origins) != 1 or _place(origins[0]) != hosts[0].lower():
                return 403, "only the page that is served here may connect"
        if self.token and not self._has_token(path, headers):
            return 401, "open the address with ?token=... that play.py printed"
        return None

    def cookie(self, path: str) -> str | None:
        """Return the Set-Cookie that keeps the token of an address, None where it has none."""
        if not self.token or not _same(_query_token(path), self.token):
            return None
        return f"dexsim={self.token}; Path=/; HttpOnly; SameSite=Strict"

    def _has_token(self, path: str, headers: Any) -> bool:
        if _same(_query_token(path), self.token):
            return True
        for text in headers.get_all("Cookie"):
            with contextlib.suppress(CookieError):
                morsel = SimpleCookie(text).get("dexsim")
                if morsel is not None and _same(morsel.value, self.token):
                    return True
        return False

    def enter(self) -> bool:
        """Count a page in; False where there are too many."""
        with self._lock:
            if self.clients >= MOST_CLIENTS:
                return False
            self.clients += 1
            return True

    def wait(self, transport: Any) -> None:
        """Note that a socket has connected and said nothing yet; the one that has waited longest goes where there
        are too many. Called from the server's own loop only, as `waited` is."""
        self.waiting[id(transport)] = transport
        if len(self.waiting) > MOST_WAITING:
            self.waiting.pop(next(iter(self.waiting))).abort()
            self.refused += 1

    def waited(self, transport: Any) -> None:
        """Note that it has said what it wants, or is gone."""
        self.waiting.pop(id(transport), None)

    def leave(self) -> None:
        """Count it out."""
        with self._lock:
            self.clients -= 1


@contextlib.contextmanager
def gated(gate: Gate) -> Iterator[None]:
    """Make the WebSocket server of viser's server, which starts in here, ask `gate` first."""
    import websockets.asyncio.server as ws
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    serve = ws.serve
    logger = logging.getLogger("dexsim.view.sockets")  # a broken handshake is not worth a traceback on the console
    logger.addHandler(logging.NullHandler())
    logger.propagate = False

    def answer(status: int, text: str) -> Response:
        gate.refused += 1
        body = f"{text}\n".encode()
        head = Headers(
            {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body)), "Connection": "close"}
        )
        return Response(status, http.HTTPStatus(status).phrase, head, body)

    def with_gate(handler: Callable[..., Any], *args: Any, process_request: Any = None, **kw: Any) -> Any:
        def first(connection: Any, request: Any) -> Response | None:
            refused = gate.reason(request.path, request.headers)
            if refused is not None:
                return answer(*refused)
            response = None if process_request is None else process_request(connection, request)
            if response is not None and (cookie := gate.cookie(request.path)) is not None:
                response.headers["Set-Cookie"] = cookie
            return response

        async def counted(connection: Any) -> None:
            if not gate.enter():
                gate.refused += 1
                await connection.close(1013, f"{MOST_CLIENTS} pages are open already")
                return
            try:
                await handler(connection)
            finally:
                gate.leave()

        class Connection(ws.ServerConnection):
            def connection_made(self, transport: Any) -> None:
                gate.wait(transport)
                super().connection_made(transport)

            def connection_lost(self, error: Exception | None) -> None:
                gate.waited(self.transport)
                super().connection_lost(error)

            async def handshake(self, *args: Any, **kw: Any) -> None:
                try:
                    await super().handshake(*args, **kw)
                finally:
                    gate.waited(self.transport)

        kw |= {"max_size": MOST_BYTES, "logger": logger, "open_timeout": HANDSHAKE_S, "create_connection": Connection}
        return serve(counted, *args, process_request=first, **kw)

    ws.serve = with_gate  # type: ignore[assignment, misc]  # for as long as the server is made
    try:
        yield
    finally:
        ws.serve = serve  # type: ignore[misc]


def only_known(server: Any, checks: dict[str, Callable[[Any], bool]]) -> None:
    """Let viser's server from now on pass on no message but where its page looks from, and new values of the
    controls in `checks` (viser's id -> whether a value is one that the control can have). All else a page may send
    is dropped."""
    from viser import _messages

    sockets = server._websock_server
    handle = sockets._handle_incoming_message

    async def judged(client: Any, message: Any) -> None:
        if isinstance(message, _messages.GuiUpdateMessage):
            updates = message.updates
            known = checks.get(message.uuid) if isinstance(message.uuid, str) else None
            if (
                known is None
                or not isinstance(updates, dict)
                or set(updates) != {"value"}
                or not known(updates["value"])
            ):
                return
            await handle(client, message)

    sockets._handle_incoming_message = judged


def number(low: float, high: float) -> Callable[[Any], bool]:
    """Return whether a value is a finite number in [low, high]."""
    return lambda v: isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v) and low <= v <= high


def one_of(choices: Any) -> Callable[[Any], bool]:
    """Return whether a value is one of these texts, as they are when it comes."""
    return lambda v: isinstance(v, str) and v in choices


def truth(v: Any) -> bool:
    """Return whether a value is true or false."""
    return isinstance(v, bool)


def is_loopback(host: str) -> bool:
    """Return whether an address to serve at is reached from this machine alone."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _upgrades(headers: Any) -> bool:
    return any("websocket" in text.lower() for text in headers.get_all("Upgrade"))  # in a list, too


def _name(host: str) -> str:
    """Return the name in a Host header, '' where it is none."""
    try:
        return (urlsplit(f"//{host}").hostname or "").rstrip(".")
    except ValueError:
        return ""


def _place(origin: str) -> str:
    """Return the host and port of a page's origin, '' where it is none."""
    try:
        parts = urlsplit(origin)
    except ValueError:
        return ""
    return parts.netloc.lower() if parts.scheme in ("http", "https") else ""


def _query_token(path: str) -> str:
    try:
        return parse_qs(urlsplit(path).query).get("token", [""])[0]
    except ValueError:
        return ""


def _same(a: str, b: str) -> bool:
    # a header's bytes that are no text come as halves of characters
    return hmac.compare_digest(a.encode("utf-8", "surrogatepass"), b.encode("utf-8", "surrogatepass"))


def check_free(host: str, port: int) -> None:
    """Raise UserError where nothing can be served at host:port."""
    try:
        family, kind, proto, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, proto) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        raise UserError(
            f"view_host={host} view_port={port}: cannot serve there ({error.strerror or error}); choose another"
            " view_port="
        ) from None
