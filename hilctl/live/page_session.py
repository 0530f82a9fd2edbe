"""Session of one page: its requests and the newest frame for it.

Frames are not queued: a frame is made when the previous one has been sent, so that a slow page gets
fewer frames, always the newest. A page that reads nothing for seconds is disconnected.
"""

import asyncio
import time
from collections.abc import Awaitable, Callable
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from hilctl.base.formatting import finite_json
from hilctl.base.strict import StrictModel
from hilctl.live.frame_codec import ScopeMode

MAX_MESSAGE_BYTES = 4096
"""Largest message of a page."""
SLOW_S = 5.0
"""A page that reads nothing for this time is disconnected."""


class PageView(StrictModel):
    """Run (None for the server's default), mode and rolling window that a page shows."""

    run: str | None = None
    mode: ScopeMode = "cycle"
    window_s: Annotated[float, Field(ge=1e-3, le=1e5)] = 2.0


class PageMessage(StrictModel):
    """Message of a page; its number is returned with the answer.

    ``view`` changes the :class:`PageView`, ``stop`` stops the run, ``report`` makes the report of
    its recording, ``run`` sends a request to the run's control socket.
    """

    id: int
    ask: Literal["view", "stop", "report", "run"]
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
        """Execute the requests of the page until it disconnects."""
        async for raw in self._connection:
            try:
                message = PageMessage.model_validate_json(raw)
            except ValidationError:
                await self._connection.close(1008, "invalid message")
                return
            if message.ask == "view":
                try:
                    self.view = PageView.model_validate(message.view)
                except ValidationError as error:
                    first = error.errors(include_url=False, include_input=False)[0]
                    text = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
                    await self._connection.send(answer_text(message, ok=False, error=text))
                    continue
            await self._connection.send(await self._answer(self, message))
