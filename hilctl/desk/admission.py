"""Who may look on: checked in the upgrade itself, before there is a connection to speak of.

Every process of every user of this machine can reach a port of loopback, and so can every page in
a browser. So a request must name this server as its host, an upgrade must come from a page of this
server and bring the token; and those who connect without asking anything are few at a time.
"""

import asyncio
import hmac
from collections.abc import Callable
from http import HTTPStatus

from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.exceptions import InvalidHeader
from websockets.headers import parse_subprotocol
from websockets.typing import Subprotocol

PROTOCOL = Subprotocol("hilctl.live.1")
"""Subprotocol of the page's connection; its number changes with the messages."""
TOKEN_PREFIX = "token."  # noqa: S105  not one itself
MOST_PENDING = 64
"""Connections at a time that have not been let in; the oldest gives way."""


class Admission:
    """Decides on requests.

    Args:
        port: That the server listens at.
        token: 32 hexadecimal digits.
    """

    def __init__(self, port: int, token: str) -> None:
        self._token = token
        self._hosts = {f"{name}:{port}" for name in ("127.0.0.1", "[::1]", "localhost")}
        self._origins = {f"http://{host}" for host in self._hosts}

    def refusal(self, headers: Headers, *, upgrade: bool) -> tuple[HTTPStatus, str] | None:
        """Return why a request is refused, or None.

        Args:
            headers: Of the request.
            upgrade: Whether it asks for the live connection, and not for a file.
        """
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or hosts[0].lower() not in self._hosts:
            return HTTPStatus.MISDIRECTED_REQUEST, "this server is on loopback only"
        if (origins or upgrade) and (len(origins) != 1 or origins[0] not in self._origins):
            return HTTPStatus.FORBIDDEN, "not from a page of this server"
        if upgrade and not self._has_token(headers):
            return HTTPStatus.UNAUTHORIZED, "the token is missing or wrong"
        return None

    def _has_token(self, headers: Headers) -> bool:
        try:
            offered = [
                name
                for line in headers.get_all("Sec-WebSocket-Protocol")
                for name in parse_subprotocol(line)
            ]
        except InvalidHeader:
            return False
        tokens = [name[len(TOKEN_PREFIX) :] for name in offered if name.startswith(TOKEN_PREFIX)]
        return len(tokens) == 1 and hmac.compare_digest(tokens[0].encode(), self._token.encode())


class PendingConnections:
    """Connections that have not been let in; the oldest is cut where there are too many.

    Args:
        most: How many there may be.
    """

    def __init__(self, most: int = MOST_PENDING) -> None:
        self._most = most
        self._abort: dict[object, Callable[[], None]] = {}

    def add(self, connection: object, abort: Callable[[], None]) -> None:
        """Let one in the waiting room; ``abort`` cuts it."""
        while len(self._abort) >= self._most:
            self._abort.pop(next(iter(self._abort)))()
        self._abort[connection] = abort

    def remove(self, connection: object) -> None:
        """Let one out: it was let in, or is gone."""
        self._abort.pop(connection, None)

    def __len__(self) -> int:
        return len(self._abort)


def bounded(pending: PendingConnections) -> type[ServerConnection]:
    """Return a kind of connection that waits its turn among those pending."""

    class BoundedConnection(ServerConnection):
        """A connection that is cut where others come after it and it has not been let in."""

        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            """Begin; some other one may be cut for it."""
            super().connection_made(transport)
            pending.add(self, self.transport.abort)

        def connection_lost(self, exc: Exception | None) -> None:
            """End."""
            pending.remove(self)
            super().connection_lost(exc)

    return BoundedConnection
