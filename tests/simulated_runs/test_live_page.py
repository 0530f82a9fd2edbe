"""A run with its live page, in real processes: looked at, stopped by it, and its server killed."""

import asyncio
import json
import os
import signal

import pytest
from websockets.asyncio.client import connect

from tests.benchmark.live_run import LiveRun


async def messages(url):
    """Yield what a page gets: the connection, then each message."""
    address, _, token = url.partition("#")
    place = address.removeprefix("http://").rstrip("/")
    async with connect(
        f"ws://{place}/live",
        origin=f"http://{place}",
        subprotocols=["hilctl.live.1", f"token.{token}"],
        proxy=None,
    ) as connection:
        yield connection
        async for message in connection:
            yield json.loads(message) if isinstance(message, str) else message


@pytest.mark.long
@pytest.mark.parametrize("kill", [False, True])
def test_a_run_is_seen_and_stopped_by_its_page(tmp_path, kill):
    """STOP is acknowledged, and holds though the page's server dies at once."""

    async def looked():
        with LiveRun(tmp_path, 120, "recording.on_failure=go_on") as run:
            seen = messages(await run.url())
            connection, frames, states = await anext(seen), 0, []
            async for message in seen:
                if isinstance(message, bytes):
                    frames += 1
                elif message["kind"] == "answer":
                    assert message["ok"]
                    if kill:
                        os.kill(run.server(), signal.SIGKILL)
                    break
                elif message.get("figures"):
                    states.append(message["state"])
                if frames > 20 and states:
                    await connection.send('{"id": 1, "ask": "stop"}')
            result = await run.result()
            await seen.aclose()
            return states, result

    states, result = asyncio.run(looked())
    assert set(states) <= {"running", "stopping"}
    assert (result["code"], result["output_safe"]) == ("stopped", True)
    assert result["dropped"] == 0
