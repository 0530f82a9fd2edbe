"""Serve the page: files, and one live connection per page, on loopback only.

The server is a separate, read-only process. Requests are sent to the run like those of ``hilctl
set`` and ``hilctl stop``, so that a run does not depend on a server.

Every process of every user of this computer can reach a loopback port, and so can every web page in
a browser. A request must name a loopback host; an upgrade must come from a page of that host and
port and carry the token. The port may differ from the server's, as it does through an SSH tunnel.
The number of unauthenticated connections is limited.
"""

import asyncio
import hmac
import logging
import re
import secrets
import socket
import tempfile
import time
from asyncio.subprocess import DEVNULL, PIPE
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack, ExitStack, suppress
from functools import cache
from http import HTTPStatus
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import Field, ValidationError
from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidHeader
from websockets.headers import parse_subprotocol
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from hilctl.base.errors import HilctlError, InputError, RunError
from hilctl.base.files import ADDRESS_REMEDIES, reason
from hilctl.base.formatting import finite_json, printable
from hilctl.base.strict import HALF_CHARACTER, StrictModel, first_problem, without_halves
from hilctl.base.subprocesses import python_command
from hilctl.live.run_reader import (
    NO_PATH,
    RunList,
    RunReader,
    ScopeMode,
    frame_of,
    nearest_window_s,
    path_of,
)
from hilctl.run.control.client import ask, request_stop
from hilctl.run.run_folder import RunFolder

MAX_MESSAGE_BYTES = 4096
"""Largest message of a page."""
_IMMEDIATE = {"view", "stop"}
_MOST_WAITING = 16
SLOW_S = 5.0
"""A page that reads nothing for this time is disconnected."""


WindowLength: TypeAlias = Annotated[float, Field(ge=1e-3, le=1e5)]


class PageView(StrictModel):
    """What a page shows.

    Attributes:
        run: The run; None for the server's default.
        axis: Its axis; None for the first one.
        mode: Mode of the scope.
        window_s: Length of the rolling window.
        across: Axis on the abscissa of the path; empty for no path.
        up: Axis on the ordinate of the path.
        path_s: Length of the path.
    """

    run: str | None = None
    axis: str | None = None
    mode: ScopeMode = "cycle"
    window_s: WindowLength = 2.0
    across: str = ""
    up: str = ""
    path_s: WindowLength = 2.0


class PageMessage(StrictModel):
    """Message of a page; its number is returned with the answer.

    ``view`` changes the :class:`PageView`, ``stop`` stops the run, ``report`` makes the report of
    its recording, ``reset`` begins a new peak error of the view's axis, ``run`` sends a request to
    the run's control socket. They concern the named run, by default the one of the view.
    """

    id: int
    run: str | None = None
    ask: Literal["view", "stop", "report", "reset", "run"]
    view: dict[str, Any] = Field(default_factory=dict)
    request: dict[str, Any] = Field(default_factory=dict)


def answer_text(message: PageMessage, **values: Any) -> str:
    """Return the answer to a message as JSON."""
    return finite_json({"kind": "answer", "id": message.id, "ask": message.ask, **values})


class PageSession:
    """Session of an authenticated page; ``answer`` executes a request and returns its answer."""

    def __init__(
        self,
        connection: ServerConnection,
        answer: "Callable[[PageSession, PageMessage], Awaitable[str]]",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.view = PageView()
        self.run: str | None = None
        """Run of the last status, empty if there was none; None before the first status."""
        self._connection, self._answer, self._clock = connection, answer, clock
        self._sending: asyncio.Task[None] | None = None
        self._began_s = 0.0

    @property
    def ready(self) -> bool:
        """Whether all earlier messages were sent; a page that is too slow is disconnected."""
        if self._sending is None or self._sending.done():
            return True
        if self._clock() - self._began_s > SLOW_S:
            self._connection.transport.abort()
        return False

    def offer(self, *messages: str | bytes) -> None:
        """Send messages in order; call it only if the session is :attr:`ready`."""
        self._began_s = self._clock()
        self._sending = asyncio.create_task(self._send(messages))

    async def _send(self, messages: tuple[str | bytes, ...]) -> None:
        try:
            for message in messages:
                await self._connection.send(message)
        except ConnectionClosed:
            return

    async def serve(self) -> None:
        """Execute the requests of the page until it disconnects; a stop waits for no other one."""
        waiting: asyncio.Queue[PageMessage] = asyncio.Queue(_MOST_WAITING)
        async with asyncio.TaskGroup() as group:
            executing = group.create_task(self._execute(waiting))
            async for raw in self._connection:
                text = raw if isinstance(raw, str) else ""
                try:
                    message = PageMessage.model_validate_json(without_halves(text))
                except ValidationError:
                    await self._connection.close(1008, "invalid message")
                    break
                if problem := self._taken(message, waiting, whole=without_halves(text) == text):
                    await self._send((answer_text(message, ok=False, error=problem),))
                elif message.ask in _IMMEDIATE:
                    await self._send((await self._answer(self, message),))
            executing.cancel()

    def _taken(
        self, message: PageMessage, waiting: asyncio.Queue[PageMessage], *, whole: bool
    ) -> str:
        """Take a message; return why it is refused, or an empty text."""
        if not whole:
            return f"a text {HALF_CHARACTER}"
        try:
            if message.ask == "view":
                self.view = PageView.model_validate(message.view)
            if message.ask not in _IMMEDIATE:
                waiting.put_nowait(message)
        except ValidationError as error:
            return first_problem(error)
        except asyncio.QueueFull:
            return f"{_MOST_WAITING} requests of this page are already waiting: try again"
        return ""

    async def _execute(self, waiting: asyncio.Queue[PageMessage]) -> None:
        while True:
            await self._send((await self._answer(self, await waiting.get()),))


PROTOCOL = Subprotocol("hilctl.live.1")
"""Subprotocol of the page's connection; its number changes with the messages."""
TOKEN_PREFIX = "token."  # noqa: S105  not a token itself
_LOOPBACK = re.compile(r"(127\.0\.0\.1|\[::1\]|localhost)(:\d+)?")
MOST_PENDING = 64
"""Largest number of unauthenticated connections; the oldest is aborted."""


def refusal(headers: Headers, token: str, *, upgrade: bool) -> tuple[HTTPStatus, str] | None:
    """Return the reason to refuse a request for a file, or an upgrade, or None.

    An upgrade needs the token, which has 32 hexadecimal digits.
    """
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or not _LOOPBACK.fullmatch(hosts[0].lower()):
        return HTTPStatus.MISDIRECTED_REQUEST, "the host is not loopback"
    if (origins or upgrade) and origins != [f"http://{hosts[0].lower()}"]:
        return HTTPStatus.FORBIDDEN, "the origin is not this server"
    if upgrade and not _has_token(headers, token):
        return HTTPStatus.UNAUTHORIZED, "the token is missing or wrong"
    return None


def _has_token(headers: Headers, token: str) -> bool:
    lines = headers.get_all("Sec-WebSocket-Protocol")
    try:
        offered = [name for line in lines for name in parse_subprotocol(line)]
    except InvalidHeader:
        return False
    tokens = [name[len(TOKEN_PREFIX) :] for name in offered if name.startswith(TOKEN_PREFIX)]
    return len(tokens) == 1 and hmac.compare_digest(tokens[0].encode(), token.encode())


def bounded(pending: dict[ServerConnection, Callable[[], None]]) -> type[ServerConnection]:
    """Return a connection class that is in ``pending``, with its abort, until it is removed."""

    class BoundedConnection(ServerConnection):
        """A connection that may be aborted until it is authenticated."""

        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            """Register the connection, and abort the oldest ones if there are too many."""
            super().connection_made(transport)
            while len(pending) >= MOST_PENDING:
                pending.pop(next(iter(pending)))()
            pending[self] = self.transport.abort

        def connection_lost(self, exc: Exception | None) -> None:
            """Unregister the connection."""
            pending.pop(self, None)
            super().connection_lost(exc)

    return BoundedConnection


HTML = "text/html; charset=utf-8"
FILES = {
    "/": ("index.html", HTML),
    "/live.js": ("live.js", "text/javascript; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
    "/live.css": ("live.css", "text/css; charset=utf-8"),
    "/uplot.js": ("uplot/uPlot.iife.min.js", "text/javascript; charset=utf-8"),
    "/uplot.css": ("uplot/uPlot.min.css", "text/css; charset=utf-8"),
}
"""File and content type of each path."""
_POLICY = "default-src 'self'"
_REPORT_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
_NO_FRAMES = "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
    "Connection": "close",
}
_FRAME_S = 1.0 / 30.0
_STATUS_FRAMES = 6  # values that change more often are unreadable
_MOST_VIEWERS = 16
_LIVE = "/live"
_REQUEST_S = 30.0
_REPORT_S = 300.0
_MOST_REPORTS = 4


@cache
def _content(name: str) -> bytes:
    return files("hilctl.live").joinpath("page", name).read_bytes()


def file_response(path: str) -> Response:
    """Return the file at a path; 404 if it does not exist."""
    if path not in FILES:
        return plain_response(HTTPStatus.NOT_FOUND, "no such file")
    name, kind = FILES[path]
    return _response(HTTPStatus.OK, kind, _content(name))


def plain_response(status: HTTPStatus, text: str) -> Response:
    """Return a response of one line of text."""
    return _response(status, "text/plain; charset=utf-8", f"{text}\n".encode())


def _response(status: HTTPStatus, kind: str, body: bytes, policy: str = _POLICY) -> Response:
    more = {"Content-Type": kind, "Content-Length": str(len(body))}
    more["Content-Security-Policy"] = f"{policy}; {_NO_FRAMES}"
    return Response(status.value, status.phrase, Headers({**_HEADERS, **more}), body)


class LiveServer:
    """Serves the page of all runs of this user on a port, 0 for any, unless taken (InputError)."""

    def __init__(
        self, chosen: Callable[[list[RunFolder]], RunFolder | None], port: int = 0
    ) -> None:
        self._sockets = listeners(port)
        self.port = int(self._sockets[0].getsockname()[1])
        self._token = secrets.token_hex(16)
        self._pending: dict[ServerConnection, Callable[[], None]] = {}  # not authenticated yet
        self._viewers: set[PageSession] = set()
        self._feeds = RunList(chosen)
        self._reports: dict[str, bytes] = {}  # the newest ones
        self._reporting = asyncio.Lock()

    @property
    def url(self) -> str:
        """Address of the page; the token is in the fragment, which browsers never send."""
        return f"http://127.0.0.1:{self.port}/#{self._token}"

    async def run(self, over: Callable[[RunList], bool]) -> None:
        """Serve until ``over`` returns true."""
        quiet = logging.getLogger(f"{__name__}.requests")  # discards messages on invalid requests
        quiet.propagate = False
        quiet.addHandler(logging.NullHandler())
        settings: dict[str, Any] = {
            "process_request": self._admit,
            "subprotocols": [PROTOCOL],  # never the token, which is offered too
            "compression": None,  # slower than loopback
            "server_header": None,
            "open_timeout": 3.0,
            "close_timeout": 1.0,
            "max_size": MAX_MESSAGE_BYTES,
            "max_queue": 4,
            "create_connection": bounded(self._pending),
            "logger": quiet,
        }
        async with AsyncExitStack() as stack:
            for listener in self._sockets:
                await stack.enter_async_context(serve(self._serve_page, sock=listener, **settings))
            await self._tick(over)

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        upgrade = request.path == _LIVE
        refused = refusal(request.headers, self._token, upgrade=upgrade)
        if refused is None and upgrade and len(self._viewers) >= _MOST_VIEWERS:
            refused = (HTTPStatus.SERVICE_UNAVAILABLE, "too many pages are connected")
        if getattr(request, "method", "GET") != "GET":  # before 17.0, websockets refuses others
            refused = (HTTPStatus.METHOD_NOT_ALLOWED, "only GET is served")
        if refused is not None:
            return plain_response(*refused)
        if not upgrade:
            path = request.path.partition("?")[0]
            if path in self._reports:
                return _response(HTTPStatus.OK, HTML, self._reports[path], _REPORT_POLICY)
            return file_response(path)
        self._pending.pop(connection, None)
        return None

    async def _serve_page(self, connection: ServerConnection) -> None:
        viewer = PageSession(connection, self._answer)
        self._viewers.add(viewer)
        try:
            await viewer.serve()
        finally:
            self._viewers.discard(viewer)

    async def _answer(self, viewer: PageSession, message: PageMessage) -> str:
        try:
            return answer_text(message, **await self._executed(viewer, message))
        except HilctlError as error:
            return answer_text(message, ok=False, error=str(error))

    async def _executed(self, viewer: PageSession, message: PageMessage) -> dict[str, Any]:
        feed = self._feeds.feed(message.run or viewer.view.run, viewer.view.axis)
        if message.ask == "view":
            return {"ok": True}
        if feed is None:
            raise InputError("no such active run")
        if message.ask == "stop":
            requested = request_stop(feed.folder)
            if not requested and feed.folder.alive:
                raise RunError("its supervisor is gone; its loop ramps down by itself")
            return {"ok": True, "requested": requested, "run": feed.folder.card.name}
        if message.ask == "reset":
            feed.reset_peak()
            return {"ok": True}
        if message.ask == "report":
            return {"ok": True, "path": await self._report(feed.recording)}
        answer = await asyncio.to_thread(ask, feed.folder.socket, message.request, _REQUEST_S)
        return {"ok": True, **answer}

    async def _report(self, recording: Path) -> str:
        """Return the path of the report of a recording, which only this page knows.

        Raises:
            InputError: It has no report, or another report is being made.
        """
        if self._reporting.locked():
            raise InputError("another report is being made: try again when it is finished")
        async with self._reporting:
            with tempfile.TemporaryDirectory(prefix="hilctl-") as folder:
                page = Path(folder) / "report.html"
                await _made(
                    python_command("-m", "hilctl", "report", str(recording), "--html", str(page))
                )
                path = f"/report/{secrets.token_hex(16)}"
                self._reports[path] = page.read_bytes()
        while len(self._reports) > _MOST_REPORTS:
            del self._reports[next(iter(self._reports))]
        return path

    async def _tick(self, over: Callable[[RunList], bool]) -> None:
        number, due_s = 0, time.monotonic()
        while not over(self._feeds):
            self._show(number)
            now_s = time.monotonic()
            # Skip frames if there was no time.
            number, due_s = number + 1, max(due_s + _FRAME_S, now_s + _FRAME_S / 4.0)
            await asyncio.sleep(due_s - now_s)

    def _show(self, number: int) -> None:
        now_s = time.monotonic()
        self._feeds.update(now_s, [each.view.run for each in self._viewers])
        self._feeds.feed(None)  # read from the first sample, even without a page
        for feed in self._feeds:
            feed.poll(now_s)
        frames: dict[tuple[str, PageView], bytes] = {}
        for viewer in [each for each in self._viewers if each.ready]:
            view = viewer.view
            shown = self._feeds.feed(view.run, view.axis)
            # A frame never precedes the status of its run and axis.
            name = f"{shown.folder.card.name}/{shown.axis}" if shown is not None else ""
            due = number % _STATUS_FRAMES == 0 or viewer.run != name
            status, viewer.run = [self._status(shown)] if due else [], name
            if shown is None:
                viewer.offer(*status)
                continue
            key = (name, view)
            if key not in frames:
                frames[key] = self._frame(shown, view)
            viewer.offer(*status, frames[key])

    def _frame(self, shown: RunReader, view: PageView) -> bytes:
        path = NO_PATH
        if view.across and view.up:
            feeds = [self._feeds.feed(view.run, axis) or shown for axis in (view.across, view.up)]
            scopes, rate_hz = [each.scope for each in feeds], shown.description.sample_rate_hz
            path = path_of(scopes, nearest_window_s(view.path_s), rate_hz)
        return frame_of(shown.scope, view.mode, nearest_window_s(view.window_s), path)

    def _status(self, feed: RunReader | None) -> str:
        cards = [run.card for run in self._feeds.runs]
        runs = [{"name": card.name, "experiment": card.experiment} for card in cards]
        state: dict[str, Any] = {"kind": "status", "runs": runs}
        if feed is not None:
            hz, um = feed.spectrum.points()
            state |= feed.status() | {
                "spectrum": {"hz": hz.tolist(), "um": um.tolist()},
                "description": feed.description.model_dump(),
                "signals": [[each.name, each.label, each.unit] for each in feed.signals],
            }
        return finite_json(state)


async def _made(command: list[str]) -> None:
    """Wait for a command that makes a report; raise InputError if it fails or takes too long."""
    made = await asyncio.create_subprocess_exec(
        *command, stdin=DEVNULL, stdout=DEVNULL, stderr=PIPE
    )
    try:
        async with asyncio.timeout(_REPORT_S):
            _, error = await made.communicate()
    except TimeoutError:
        raise InputError(
            f"not finished within {_REPORT_S:g} s: use hilctl report --html in a terminal"
        ) from None
    finally:
        if made.returncode is None:  # too slow, or the page was closed
            made.kill()
            await made.wait()
    if made.returncode:
        raise InputError(printable(error.decode(errors="replace").strip()))


def listeners(port: int) -> list[socket.socket]:
    """Return sockets on a port of 127.0.0.1 and ::1 (with IPv6); raise InputError if taken."""
    with ExitStack() as stack:
        try:
            first = stack.enter_context(socket.create_server(("127.0.0.1", port)))
            found = [first]
            if socket.has_ipv6:
                with suppress(OSError):  # IPv6 is disabled
                    address = ("::1", first.getsockname()[1])
                    found.append(socket.create_server(address, family=socket.AF_INET6))
        except OSError as error:
            raise InputError(f"--port {port}: {reason(error, ADDRESS_REMEDIES)}") from None
        stack.pop_all()
        return found
