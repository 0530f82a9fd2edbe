"""Session of one page."""

import asyncio
import json
from unittest.mock import Mock

import pytest

from hilctl.live.page_session import SLOW_S, PageSession, PageView
from tests.fakes import SteppingClock


class Connection:
    """A connection that receives the given messages and blocks while ``free`` is unset."""

    def __init__(self, *messages):
        self.messages, self.sent, self.closed = list(messages), [], None
        self.transport = Mock()
        self.free = asyncio.Event()
        self.free.set()

    async def __aiter__(self):
        for message in self.messages:
            if self.closed:
                return
            yield message

    async def send(self, message):
        await self.free.wait()
        self.sent.append(message)

    async def close(self, code, reason):
        self.closed = (code, reason)


async def answer(viewer, message):
    return f"{message.id} {message.ask}"


def message(**fields):
    return json.dumps({"id": 1, "ask": "view"} | fields)


def served(*messages):
    """Return a session that has received messages at one time, and its connection."""

    async def exchanged():
        connection = Connection(*messages)
        viewer = PageSession(connection, answer, clock=lambda: 0.0)
        await viewer.serve()
        return viewer, connection

    return asyncio.run(exchanged())


def test_messages_are_answered_and_change_the_view():
    view = {"run": "a", "mode": "roll", "window_s": 10.0}
    viewer, connection = served(message(view=view), message(id=2, ask="stop"))
    assert viewer.view == PageView(**view)
    assert connection.sent == ["1 view", "2 stop"]


def test_invalid_message_ends_the_connection():
    for raw in ("", "{}", b"\xff\x00", message(ask="format"), message(more=1), message(id="1")):
        _, connection = served(raw, message(id=2))
        assert (connection.closed[0], connection.sent) == (1008, [])


BAD_TIMES = ("0", "-0.0", "-1", "1e-320", "1e308", "NaN", "Infinity", "1e999", "true", '"2"', "[]")


@pytest.mark.parametrize("value", [*BAD_TIMES, "null", "1" + "0" * 400])
def test_invalid_window_is_refused_without_effect(value):
    raw = f'{{"id": 5, "ask": "view", "view": {{"window_s": {value}}}}}'
    viewer, connection = served(raw, message(id=6, ask="stop"))
    assert viewer.view == PageView()
    assert connection.closed is None
    refused = json.loads(connection.sent[0])
    assert (refused["kind"], refused["id"], refused["ok"]) == ("answer", 5, False)
    assert refused["error"].startswith("window_s: ")
    assert connection.sent[1] == "6 stop"


def test_slow_page_gets_the_newest_frame_and_is_disconnected():
    async def slow():
        clock, connection = SteppingClock(), Connection()
        viewer = PageSession(connection, answer, clock)
        connection.free.clear()
        viewer.offer("status", b"old")
        await asyncio.sleep(0)
        assert not viewer.ready
        connection.free.set()
        await asyncio.sleep(0.01)
        assert viewer.ready
        assert connection.sent == ["status", b"old"]
        connection.free.clear()
        viewer.offer(b"new")
        clock.now = SLOW_S - 0.1
        assert not viewer.ready
        assert not connection.transport.abort.called
        clock.now = SLOW_S + 0.1
        assert not viewer.ready
        assert connection.transport.abort.called
        connection.free.set()
        await asyncio.sleep(0.01)

    asyncio.run(slow())
