"""A run with its live page in real processes: view, stop, and a killed server."""

import asyncio
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from websockets.asyncio.client import connect

EXPERIMENT = Path(__file__).parents[2] / "configs" / "terfenol_sine_6a.yaml"
SETTINGS = ("waveform.duration_s=120", "waveform.frequency_hz=100", "recording.on_failure=go_on")


class LiveRun:
    """A ``hilctl run --live`` at 50 kHz in a process of its own."""

    def __init__(self, folder):
        self._log = folder / "log"
        words = [sys.executable, "-m", "hilctl", "run", str(EXPERIMENT), "--json", "--live"]
        words += ["--output", str(folder / "run.mcap")]
        words += [word for each in SETTINGS for word in ("--set", each)]
        with self._log.open("wb") as log:
            self.process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=log)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            self.process.communicate()

    async def url(self):
        """Return the page's address once the run has printed it."""
        while not (found := re.search(r"http\S+", self._log.read_text())):
            assert self.process.poll() is None, self._log.read_text()
            await asyncio.sleep(0.05)
        return found[0]

    async def result(self):
        """Return what the run prints at its end."""
        printed, _ = await asyncio.to_thread(self.process.communicate)
        return json.loads(printed)

    def server(self):
        """Return the process number of the page's server."""
        supervisor = self.process.pid
        children = Path(f"/proc/{supervisor}/task/{supervisor}/children").read_text()
        return next(
            int(each)
            for each in children.split()
            if b"hilctl.live.server_process" in Path(f"/proc/{each}/cmdline").read_bytes()
        )


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
    async def looked():
        with LiveRun(tmp_path) as run:
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
