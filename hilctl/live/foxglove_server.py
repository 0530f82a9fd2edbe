"""Serve runs to Foxglove, Lichtblick and PlotJuggler with Foxglove's protocol, on loopback.

Clients are read-only. The library checks neither the user nor the origin of a request, so every
user and every web page on this computer can read the run while the server is active. It is
therefore started on request only.
"""

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from hilctl.base.errors import InputError, RunError
from hilctl.live.foxglove_topics import (
    DIAGNOSTICS,
    DIAGNOSTICS_SCHEMA,
    MESSAGES,
    SCOPE_TOPICS,
    LiveTopics,
)
from hilctl.live.run_list import RunList
from hilctl.live.run_reader import RunReader
from hilctl.recording import schema
from hilctl.recording.encoder import Encoded
from hilctl.run.run_folder import RunFolder

if TYPE_CHECKING:
    from foxglove import Channel, Context
    from foxglove.websocket import WebSocketServer

PORT = 8765
"""Where the applications look for a server unless they are given another port."""
_FRAME_S = 1.0 / 30.0
_STATUS_FRAMES = 15
_STOP_S = 1.0
_BACKLOG = 4096  # messages for one client, about a second of them; the oldest are dropped


class FoxgloveServer:
    """Serves the active run.

    Args:
        chosen: See :class:`hilctl.live.run_list.RunList`.
        port: Port to listen on; 0 for any.
        clock: Monotonic time in s.
        unix_ns: Unix time in ns.
        sleep: Sleeps for the given time in s.

    Raises:
        InputError: The library is not installed.
        RunError: The port is not available.
    """

    def __init__(
        self,
        chosen: Callable[[list[RunFolder]], RunFolder | None],
        port: int = PORT,
        clock: Callable[[], float] = time.monotonic,
        unix_ns: Callable[[], int] = time.time_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._feeds = RunList(chosen)
        self._shown: RunReader | None = None
        self._topics: LiveTopics | None = None
        self._clock, self._unix_ns, self._sleep = clock, unix_ns, sleep
        self._context, self._channels, self._server = _started(port)

    @property
    def url(self) -> str:
        """Address for the applications."""
        return f"ws://127.0.0.1:{self._server.port}"

    def run(self, over: Callable[["FoxgloveServer"], bool]) -> None:
        """Serve until ``over`` returns true."""
        number = 0
        try:
            while not over(self):
                began_s = self._clock()
                self._show(number)
                number += 1
                self._sleep(max(_FRAME_S / 4.0, began_s + _FRAME_S - self._clock()))
        finally:
            # In a thread: the library waits for clients that do not read.
            stopping = threading.Thread(target=self._server.stop, daemon=True)
            stopping.start()
            stopping.join(_STOP_S)

    def feed(self, name: str | None) -> RunReader | None:
        """Return the reader of a run, see :meth:`hilctl.live.run_list.RunList.feed`."""
        return self._feeds.feed(name)

    def _show(self, number: int) -> None:
        now_s = self._clock()
        self._feeds.look(now_s)
        feed = self.feed(None)
        if feed is None:
            return
        feed.poll(now_s)
        if feed is not self._shown and feed.start_ns:
            start_unix_ns = self._unix_ns() - round(now_s * 1e9) + feed.start_ns
            if self._shown is not None:
                self._server.clear_session()  # discards client data of another run
            self._shown, self._topics = feed, LiveTopics(feed, start_unix_ns)
        if self._topics is None:
            return
        wanted = [topic for topic in SCOPE_TOPICS if self._channels[topic].has_sinks()]
        for message in self._topics.scope(wanted):
            self._log(message)
        for message in self._topics.events():
            self._log(message)
        if number % _STATUS_FRAMES == 0:
            self._log(self._topics.diagnostics(self._unix_ns()))

    def _log(self, message: Encoded) -> None:
        self._channels[message.topic].log(message.data, log_time=message.time_ns)


@contextmanager
def _logging_as_before() -> Iterator[None]:
    """Restore the level and handlers of all logs, which the library changes globally."""
    root = logging.getLogger()
    level, handlers = root.level, root.handlers[:]
    yield
    root.setLevel(level)
    root.handlers[:] = handlers


def _started(port: int) -> tuple["Context", dict[str, "Channel"], "WebSocketServer"]:
    """Return the channels by topic, the server, and the context that keeps them alive.

    Without the context, the channels would be removed from the server.

    Raises:
        InputError: The library is not installed.
        RunError: The port is not available.
    """
    try:
        import foxglove
    except ImportError:
        raise InputError(
            "--foxglove: its library is not installed: pip install 'hilctl[foxglove]'"
        ) from None
    with _logging_as_before():
        foxglove.set_log_level("ERROR")  # discards messages on invalid requests
    context = foxglove.Context()
    descriptors = schema.descriptor_set()
    channels = {
        DIAGNOSTICS: foxglove.Channel(DIAGNOSTICS, schema=DIAGNOSTICS_SCHEMA, context=context)
    }
    for topic, name in MESSAGES.items():
        form = foxglove.Schema(name=f"hilctl.{name}", encoding="protobuf", data=descriptors)
        channels[topic] = foxglove.Channel(
            topic, schema=form, message_encoding="protobuf", context=context
        )
    try:
        # No capabilities: clients can only subscribe.
        server = foxglove.start_server(
            name="hilctl",
            host="127.0.0.1",
            port=port,
            context=context,
            message_backlog_size=_BACKLOG,
        )
    except RuntimeError as error:
        raise RunError(f"port {port} of 127.0.0.1: {error}") from None
    return context, channels, server
