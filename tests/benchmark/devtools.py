"""A headless Chromium, driven over its DevTools protocol."""

import asyncio
import base64
import json
import os
import shutil
import signal
import subprocess
import tempfile
import urllib.request
from contextlib import asynccontextmanager, suppress
from pathlib import Path

from websockets.asyncio.client import connect

_QUIET = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-sync",
    "--disable-background-networking",
    "--disable-component-update",
    "--remote-debugging-port=0",
)


class Tab:
    """One page of a browser.

    Attributes:
        errors: What it said of errors: exceptions, and what the log has.
    """

    def __init__(self, socket, browser):
        self.errors = []
        self._socket, self._browser, self._number, self._waiting = socket, browser, 0, {}
        self._reading = asyncio.create_task(self._read())

    async def _read(self):
        async for raw in self._socket:
            message = json.loads(raw)
            if "id" in message:
                self._waiting.pop(message["id"]).set_result(message)
            elif message["method"] == "Runtime.exceptionThrown":
                self.errors.append(message["params"]["exceptionDetails"])
            elif message["method"] == "Log.entryAdded":
                self.errors.append(message["params"]["entry"]["text"])

    async def call(self, method, **parameters):
        """Call a method of the protocol; return its result."""
        self._number += 1
        number = self._number
        self._waiting[number] = asyncio.get_running_loop().create_future()
        call = {"id": number, "method": method, "params": parameters}
        await self._socket.send(json.dumps(call))
        return (await self._waiting[number]).get("result")

    async def value(self, expression):
        """Return the value of an expression in the page."""
        found = await self.call(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        return found["result"].get("value")

    async def until(self, expression, timeout_s=180.0):
        """Wait until an expression is true."""
        async with asyncio.timeout(timeout_s):
            while not await self.value(expression):
                await asyncio.sleep(0.02)

    async def look(self, width, height, *, dark=False):
        """Set the size of the page, and whether it is dark."""
        mobile = width < 600
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": mobile}
        await self.call("Emulation.setDeviceMetricsOverride", **size)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        await self.call("Emulation.setEmulatedMedia", features=[scheme])

    async def picture(self, path):
        """Write what it shows as PNG."""
        shot = await self.call("Page.captureScreenshot", format="png")
        Path(path).write_bytes(base64.b64decode(shot["data"]))

    def memory_mb(self):
        """Return the resident memory of the browser's processes, in MB."""
        pages = 0
        for process in self._processes():
            with suppress(OSError):
                pages += int((process / "statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGESIZE") / 1e6

    def hurry(self, nice):
        """Set the niceness of the browser's threads, which it sets itself when it starts."""
        for process in self._processes():
            with suppress(OSError):  # where sessions have shares, their niceness counts
                (process / "autogroup").write_text(str(nice))
            for thread in (process / "task").iterdir():
                with suppress(OSError):
                    os.setpriority(os.PRIO_PROCESS, int(thread.name), nice)

    def processes(self):
        """Return the numbers of the browser's processes."""
        return [int(each.name) for each in self._processes()]

    def _processes(self):
        """Return the folders in /proc of the browser's processes: its session."""
        found = []
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                session = (process / "stat").read_text().rpartition(")")[2].split()[3]
                if int(session) == self._browser:
                    found.append(process)
        return found


@asynccontextmanager
async def browser(url, width=1440, height=1060, *, dark=False):
    """Open a page in a browser of its own; yield its tab."""
    folder = tempfile.mkdtemp(prefix="hilctl-browser-")
    program = shutil.which("chromium") or "chromium-browser"
    process = subprocess.Popen(
        [program, *_QUIET, f"--user-data-dir={folder}", "about:blank"],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        port = await asyncio.to_thread(_port, process)
        asyncio.get_running_loop().run_in_executor(None, process.stderr.read)
        async with connect(_page(port), max_size=None, proxy=None) as socket:
            tab = Tab(socket, process.pid)
            for part in ("Page", "Runtime", "Log"):
                await tab.call(f"{part}.enable")
            await tab.look(width, height, dark=dark)
            await tab.call("Page.navigate", url=url)
            yield tab
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        shutil.rmtree(folder, ignore_errors=True)


def _port(process):
    for line in process.stderr:
        if "DevTools listening on" in line:
            return int(line.split("127.0.0.1:")[1].split("/")[0])
    raise RuntimeError("the browser does not start")


def _page(port):
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list") as answer:
        return next(
            each["webSocketDebuggerUrl"] for each in json.load(answer) if each["type"] == "page"
        )
