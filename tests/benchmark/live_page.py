"""The live page in a headless Chromium, and what it costs the run.

    python -m tests.benchmark.live_page frames --seconds 120
    python -m tests.benchmark.live_page spikes
    python -m tests.benchmark.live_page stop --kill-server
    python -m tests.benchmark.live_page hostile
    python -m tests.benchmark.live_page cost --pairs 5 --seconds 20
    python -m tests.benchmark.live_page pictures OUT

Each prints one JSON object. ``--nice`` is that of all processes started, for a busy machine.
"""

import argparse
import asyncio
import json
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import numpy as np
from websockets.asyncio.client import connect

from hilctl.base.samples import Head
from hilctl.run.description import RunDescription
from hilctl.run.ring import SampleRing
from hilctl.run.run_folder import run_folder
from hilctl.run.shared_page import Field, Phase
from hilctl.run.start import checked_experiment
from tests.benchmark.devtools import browser

CONFIGS = Path(__file__).parents[2] / "configs"
EXPERIMENT = CONFIGS / "terfenol_sine_6a.yaml"
_FRAMES = "JSON.stringify([hilctlLive.frames, hilctlLive.errors, performance.now()])"


class LiveRun:
    """``hilctl run --live`` of 50 kHz in a process of its own, with the page's address."""

    def __init__(self, folder, seconds, *more, live=True):
        self.output = Path(folder) / "run.mcap"
        self._log = Path(folder) / "log"
        settings = (f"waveform.duration_s={seconds}", "waveform.frequency_hz=100", *more)
        words = [word for each in settings for word in ("--set", each)]
        self.began = time.monotonic()
        with self._log.open("wb") as log:
            words = [str(EXPERIMENT), "--json", *words, "--output", str(self.output)]
            words += ["--overwrite", "--live"] if live else ["--overwrite"]
            self.process = subprocess.Popen(
                [sys.executable, "-m", "hilctl.cli", "run", *words],
                stdout=subprocess.PIPE,
                stderr=log,
            )

    def __enter__(self):
        return self

    def __exit__(self, *error):
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            self.process.communicate()

    async def url(self):
        while not (found := re.search(r"http\S+", self._log.read_text())):
            if self.process.poll() is not None:
                raise RuntimeError(self._log.read_text())
            await asyncio.sleep(0.05)
        return found[0]

    async def result(self):
        said, _ = await asyncio.to_thread(self.process.communicate)
        return json.loads(said)

    def server(self, nice=0):
        """Return the process number of the page's server; give it that niceness."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text()
        for number in map(int, children.split()):
            if b"hilctl.desk.live" in Path(f"/proc/{number}/cmdline").read_bytes():
                if nice:
                    Path(f"/proc/{number}/autogroup").write_text(str(nice))
                return number
        raise RuntimeError("it has no page")


def rss_mb(process):
    """Return the resident memory of a process, in MB."""
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGESIZE") / 1e6


async def frames(folder, given):
    """Frames a second of all signals over a whole run, memory in its first and last part."""
    with LiveRun(folder, given.seconds + 20, "recording.on_failure=go_on") as run:
        async with browser(await run.url()) as tab:
            tab.hurry(given.nice)
            run.server(given.nice)
            await tab.until("hilctlLive.frames > 30")
            rates, memory = [], []
            until = time.monotonic() + given.seconds
            before = json.loads(await tab.value(_FRAMES))
            while time.monotonic() < until:
                await asyncio.sleep(5.0)
                now = json.loads(await tab.value(_FRAMES))
                rates.append((now[0] - before[0]) / (now[2] - before[2]) * 1e3)
                memory.append((rss_mb(run.server()), tab.memory_mb()))
                before = now
            errors = [*map(str, tab.errors), *(["in the page"] if now[1] else [])]
        run.process.send_signal(signal.SIGTERM)
        result = await run.result()
        third = max(1, len(memory) // 3)
        early, late = (
            np.mean(part, axis=0) for part in (memory[third : 2 * third], memory[-third:])
        )
        return {
            "frames_per_s": {"median": np.median(rates), "least": min(rates)},
            "server_mb": {"middle": early[0], "end": late[0]},
            "browser_mb": {"middle": early[1], "end": late[1]},
            "page_errors": errors,
            "dropped": result["dropped"],
            "lateness_us": result["lateness_us"],
        }


@asynccontextmanager
async def ringing(folder, spikes):
    """A run's folder with a loop of 50 kHz that puts single samples 50 um away."""
    description = RunDescription.of(checked_experiment(EXPERIMENT, []))
    with run_folder("spikes", Path(folder) / "run.mcap", time.time()) as (run, _):
        description.write(run.description)
        ring = SampleRing.create(run.ring, slots=10_000, block=50, state_size=1)
        ring.page.put(Field.PHASE, Phase.RUNNING)

        async def loop():
            start, number = time.monotonic(), 0
            while True:
                while number < (time.monotonic() - start) * 1000.0:
                    _exchange(ring, number, spikes)
                    number += 1
                    if number % 500 == 0:
                        while ring.pop() is not None:
                            pass
                        ring.release(keep=ring.slots // 8)
                await asyncio.sleep(0.005)

        task = asyncio.create_task(loop())
        try:
            yield run
        finally:
            task.cancel()


def _exchange(ring, number, spikes):
    block = ring.claim()
    index = number * 50 + np.arange(50)
    block.head[Head.FIRST_SAMPLE] = index[0]
    block.reference[:] = 40.0 * np.sin(2.0 * np.pi * index / 500.0)
    block.command[:] = block.wanted[:] = block.reference / 8.0
    block.flags[:] = 0
    ring.sending(block)
    block.displacement_um[:] = block.reference
    if number in spikes:
        block.displacement_um[spikes[number] % 50] += 50.0 + spikes[number]
    ring.answered(block)


async def spikes(folder, given):
    """Spikes of one sample each, and how many of them the page has drawn."""
    wanted = {}
    async with ringing(folder, wanted) as run:
        server = subprocess.Popen(
            [sys.executable, "-m", "hilctl.cli", "live", run.card.name],
            stdout=subprocess.PIPE,
        )
        seen = set()
        try:
            said = await asyncio.to_thread(server.stdout.readline)
            url = re.search(r"http\S+", said.decode())[0]
            async with browser(url) as tab:
                tab.hurry(given.nice)
                await tab.until("hilctlLive.frames > 5")
                await tab.value("document.getElementById('mode').click()")
                ring = SampleRing(run.ring, look_only=True)
                begin = ring.page.get(Field.HEAD) + 1000
                wanted |= {begin + 2400 * each: each for each in range(10)}
                while ring.page.get(Field.HEAD) < max(wanted) + 1500:
                    seen.add(round(await tab.value("hilctlLive.highest('plot-error')") - 50.0))
                    await asyncio.sleep(0.2)
        finally:
            server.terminate()
            server.communicate()
    missing = sorted(set(wanted.values()) - seen)
    return {"spikes": len(wanted), "not_drawn": missing}


async def stop(folder, given):
    """STOP pressed in the page, its acknowledgement and the end of the run."""
    with LiveRun(folder, 300) as run:
        async with browser(await run.url()) as tab:
            tab.hurry(given.nice)
            run.server(given.nice)
            await tab.until("hilctlLive.frames > 30")
            server = run.server()
            await tab.value("document.getElementById('stop').click()")
            pressed = time.monotonic()
            await tab.until("hilctlLive.acknowledgedMs !== null")
            acknowledged = await tab.value("hilctlLive.acknowledgedMs")
            if given.kill_server:
                os.kill(server, signal.SIGKILL)
            result = await run.result()
        return {
            "acknowledged_s": acknowledged / 1e3,
            "ended_after_s": time.monotonic() - pressed,
            "code": result["code"],
            "output_safe": result["output_safe"],
            "dropped": result["dropped"],
        }


async def hostile(folder, given):
    """Strangers at the door while a run goes on; what each of them got."""
    resource.setrlimit(resource.RLIMIT_NOFILE, (16384, 20000))
    with LiveRun(folder, 60, "recording.on_failure=go_on") as run:
        url = await run.url()
        port, token = int(re.search(r":(\d+)/", url)[1]), url.partition("#")[2]
        own = f"http://127.0.0.1:{port}"
        found = {
            "foreign_origin": await _refused(port, token, "http://evil.example"),
            "no_token": await _refused(port, "", own),
            "wrong_token": await _refused(port, "0" * 32, own),
            "foreign_host": await _status(port, "evil.example"),
            "crowd_of_10000": await _crowd(port, token, own),
            "message_of_100_mb": await _flood(port, token, own),
            "slow_reader": await _slow(port, token, own),
            "another_user": _as_nobody(port),
        }
        run.process.send_signal(signal.SIGTERM)
        result = await run.result()
        return found | {"code": result["code"], "dropped": result["dropped"]}


def _opened(port, token, origin, **more):
    names = ["hilctl.live.1", f"token.{token}"]
    return connect(
        f"ws://127.0.0.1:{port}/live", origin=origin, subprotocols=names, proxy=None, **more
    )


async def _refused(port, token, origin):
    try:
        async with _opened(port, token, origin):
            return "LET IN"
    except Exception as error:  # noqa: BLE001  whatever it is, it is printed
        return str(error)


async def _status(port, host):
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(f"GET / HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
    line = await reader.readline()
    writer.close()
    return line.decode().strip()


async def _crowd(port, token, origin):
    """Connect 10000 times without a word; then a page must still get in."""
    held, refused = [], 0
    for _ in range(10_000):
        try:
            held.append(await asyncio.wait_for(asyncio.open_connection("127.0.0.1", port), 5.0))
        except (OSError, TimeoutError):
            refused += 1
    began = time.monotonic()
    async with _opened(port, token, origin, max_size=None) as connection:
        await connection.recv()
    took_s = time.monotonic() - began
    for _, writer in held:
        with suppress(OSError):
            writer.close()
    return {"refused": refused, "page_got_in_after_s": took_s}


async def _flood(port, token, origin):
    with suppress(Exception):
        async with _opened(port, token, origin, max_size=None) as connection:
            with suppress(Exception):
                await connection.send("x" * 100_000_000)
            await connection.wait_closed()
            return f"closed by code {connection.close_code}"
    return "closed"


async def _slow(port, token, origin):
    """Take no frame; return after how many seconds the connection was cut."""
    async with _opened(port, token, origin, max_size=None) as connection:
        connection.transport.pause_reading()
        began = time.monotonic()
        place = socket.SO_ERROR
        while time.monotonic() - began < 30.0:
            await asyncio.sleep(0.5)
            if connection.transport.get_extra_info("socket").getsockopt(socket.SOL_SOCKET, place):
                break
            with suppress(Exception):
                await asyncio.wait_for(connection.ping(), 0.5)
        return {"cut_after_s": time.monotonic() - began}


def _as_nobody(port):
    """Ask for the live connection as another user, who has no token to give."""
    host = f"127.0.0.1:{port}"
    request = f"GET /live HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\n\r\n"
    script = (
        f"import socket; s = socket.create_connection(('127.0.0.1', {port})); "
        f"s.sendall({request.encode()!r}); print(s.recv(60).split(b'\\r')[0].decode())"
    )
    said = subprocess.run(
        ["setpriv", "--reuid=65534", "--clear-groups", "python3", "-c", script],
        capture_output=True,
        text=True,
        check=False,
    )
    return said.stdout.strip() or said.stderr.strip()[-200:]


async def cost(folder, given):
    """Lateness and processor time of paired runs, with a page open and without."""
    order = [live for pair in range(given.pairs) for live in (pair % 2 == 0, pair % 2 == 1)]
    rows = [(live, *await _one_cost(folder, given, live=live)) for live in order]
    plain, shown = (np.array([row[1:] for row in rows if row[0] is live]) for live in (False, True))
    return {
        "p99_us": {"plain": plain[:, 0].tolist(), "page": shown[:, 0].tolist()},
        "p99_ratio_median": float(np.median(shown[:, 0]) / np.median(plain[:, 0])),
        "supervisor_cpu_ratio": float(np.median(shown[:, 1]) / np.median(plain[:, 1])),
        "dropped": float(plain[:, 2].sum() + shown[:, 2].sum()),
    }


async def _one_cost(folder, given, *, live):
    with LiveRun(folder, given.seconds, "recording.on_failure=go_on", live=live) as run:
        if not live:
            cpu_s = await _cpu_of(run)
            result = await run.result()
            return result["lateness_us"]["p99"], cpu_s, result["dropped"]
        async with browser(await run.url()) as tab:
            await tab.until("hilctlLive.frames > 5")
            cpu_s = await _cpu_of(run)
            result = await run.result()
        return result["lateness_us"]["p99"], cpu_s, result["dropped"]


async def _cpu_of(run):
    """Return the processor time that the supervisor took in 10 s of the run."""
    while not read_ready(run.output):
        await asyncio.sleep(0.05)
    stat, spent = Path(f"/proc/{run.process.pid}/stat"), []
    for _ in range(2):
        fields = stat.read_text().rpartition(")")[2].split()
        spent.append((int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK"))
        await asyncio.sleep(10.0)
    return spent[1] - spent[0]


def read_ready(path):
    """Return whether samples are being recorded."""
    return path.exists() and path.stat().st_size > 200_000


async def pictures(folder, given):
    """Write pictures: light, dark, phone and 4K, with the inverse and without."""
    out = Path(given.out)
    out.mkdir(parents=True, exist_ok=True)
    with LiveRun(folder, 240, "recording.on_failure=go_on") as run:
        looks = {
            "light": (1440, 1060, False),
            "dark": (1440, 1060, True),
            "phone": (375, 812, False),
            "4k": (3840, 2160, True),
        }
        async with browser(await run.url()) as tab:
            tab.hurry(given.nice)
            run.server(given.nice)
            await tab.until("hilctlLive.frames > 20")
            for inverse in ("in", "out"):
                await tab.value(f"document.getElementById('inverse-{inverse}').click()")
                pressed = (
                    f"document.getElementById('inverse-{inverse}').getAttribute('aria-pressed')"
                )
                await tab.until(f"{pressed} === 'true'")
                for name, (width, height, dark) in looks.items():
                    await tab.look(width, height, dark=dark)
                    await asyncio.sleep(4.0)
                    await tab.picture(out / f"live-{name}-{inverse}.png")
            errors = [str(error) for error in tab.errors]
        run.process.send_signal(signal.SIGTERM)
        result = await run.result()
        return {
            "errors": errors,
            "code": result["code"],
            "figures": sorted(map(str, out.iterdir())),
        }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=[f.__name__ for f in MEASURED])
    parser.add_argument("out", nargs="?", default="pictures")
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--kill-server", action="store_true")
    parser.add_argument("--nice", type=int, default=0)
    given = parser.parse_args()
    if given.nice:
        os.setpriority(os.PRIO_PROCESS, 0, given.nice)
        Path("/proc/self/autogroup").write_text(str(given.nice))
    measure = next(each for each in MEASURED if each.__name__ == given.what)
    with tempfile.TemporaryDirectory(prefix="hilctl-live-", dir="/dev/shm") as folder:
        print(json.dumps(asyncio.run(measure(folder, given)), indent=1))


MEASURED = (frames, spikes, stop, hostile, cost, pictures)

if __name__ == "__main__":
    main()
