"""Authenticate requests to the live page.

Every process of every user of this computer can reach a loopback port, and so can every web page in
a browser. A request must name a loopback host; an upgrade must come from a page of that host and
port and carry the token. The port may differ from the server's, as it does through an SSH tunnel.
The number of unauthenticated connections is limited.
"""

import asyncio
import hmac
import re
from collections.abc import Callable
from http import HTTPStatus

from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.exceptions import InvalidHeader
from websockets.headers import parse_subprotocol
from websockets.typing import Subprotocol

PROTOCOL = Subprotocol("hilctl.live.1")
"""Subprotocol of the page's connection; its number changes with the messages."""
TOKEN_PREFIX = "token."  # noqa: S105  not a token itself
_LOOPBACK = re.compile(r"(127\.0\.0\.1|\[::1\]|localhost)(:\d+)?")
MOST_PENDING = 64
"""Largest number of unauthenticated connections; the oldest is aborted."""


class Admission:
    """Accepts or refuses requests; the token has 32 hexadecimal digits."""

    def __init__(self, token: str) -> None:
        self._token = token

    def refusal(self, headers: Headers, *, upgrade: bool) -> tuple[HTTPStatus, str] | None:
        """Return the reason to refuse a request for a file or an upgrade, or None."""
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not _LOOPBACK.fullmatch(hosts[0].lower()):
            return HTTPStatus.MISDIRECTED_REQUEST, "the host is not loopback"
        if (origins or upgrade) and origins != [f"http://{hosts[0].lower()}"]:
            return HTTPStatus.FORBIDDEN, "the origin is not this server"
        if upgrade and not self._has_token(headers):
            return HTTPStatus.UNAUTHORIZED, "the token is missing or wrong"
        return None

    def _has_token(self, headers: Headers) -> bool:
        lines = headers.get_all("Sec-WebSocket-Protocol")
        try:
            offered = [name for line in lines for name in parse_subprotocol(line)]
        except InvalidHeader:
            return False
        tokens = [name[len(TOKEN_PREFIX) :] for name in offered if name.startswith(TOKEN_PREFIX)]
        return len(tokens) == 1 and hmac.compare_digest(tokens[0].encode(), self._token.encode())


class PendingConnections:
    """Connections that are not authenticated yet; the oldest is aborted if there are too many."""

    def __init__(self, most: int = MOST_PENDING) -> None:
        self._most = most
        self._abort: dict[object, Callable[[], None]] = {}

    def add(self, connection: object, abort: Callable[[], None]) -> None:
        """Add a connection; ``abort`` closes it."""
        while len(self._abort) >= self._most:
            self._abort.pop(next(iter(self._abort)))()
        self._abort[connection] = abort

    def remove(self, connection: object) -> None:
        """Remove a connection that is authenticated or closed."""
        self._abort.pop(connection, None)

    def __len__(self) -> int:
        return len(self._abort)


def bounded(pending: PendingConnections) -> type[ServerConnection]:
    """Return a connection class that is registered as pending until it is authenticated."""

    class BoundedConnection(ServerConnection):
        """A connection that may be aborted until it is authenticated."""

        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            """Register the connection; the oldest pending one may be aborted."""
            super().connection_made(transport)
            pending.add(self, self.transport.abort)

        def connection_lost(self, exc: Exception | None) -> None:
            """Unregister the connection."""
            pending.remove(self)
            super().connection_lost(exc)

    return BoundedConnection
