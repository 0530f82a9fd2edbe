"""What those who look on cost a run: its page, and strangers at the page's door.

Windows of one and the same run, with and without them, follow one another every few seconds: what
else this machine does changes from minute to minute, and runs apart from one another can't be
compared. In the windows without it the page's processes are stopped where they stand (SIGSTOP).
"""

import asyncio
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import asynccontextmanager, contextmanager, suppress

import numpy as np
from websockets.exceptions import ConnectionClosed

from tests.benchmark.devtools import browser
from tests.benchmark.live_client import opened
from tests.benchmark.live_run import LiveRun, Meter, page_server, processor_s

_SETTLE_S = 1.0
_LONG = ("message_of_100_mb", "crowd_of_10000", "slow_reader")
"""Strangers that take their time, and come once."""
_ERROR = (socket.SOL_SOCKET, socket.SO_ERROR)


async def cost(folder, given):
    """Lateness and processor time in windows of a run with a page open, and without."""
    window_s = given.seconds or 3.0
    pair_s = 2.0 * (window_s + _SETTLE_S)
    _say(f"{given.pairs} pairs of {window_s:g} s: about {given.pairs * pair_s:.0f} s and the start")
    pairs, spent_s = [], 0.0
    seconds = given.pairs * 2.0 * pair_s + 300.0
    with LiveRun(folder, seconds, "recording.on_failure=go_on", live=False) as run:
        meter = await Meter.of(run)
        async with _open_page(meter, given) as (server, others):
            for number in range(given.pairs):
                found = {}
                for shown in (number % 2 == 0, number % 2 == 1):
                    _signal([server, *others], signal.SIGCONT if shown else signal.SIGSTOP)
                    await asyncio.sleep(_SETTLE_S)
                    before_s = processor_s(server)
                    found[shown], _ = await meter.stretch(window_s)
                    spent_s += processor_s(server) - before_s
                pairs.append((found[False], found[True]))
                left_s = (given.pairs - len(pairs)) * pair_s
                _say(f"pair {len(pairs)}: {_pair_text(*pairs[-1])}; {left_s:.0f} s left")
            _signal([server, *others], signal.SIGCONT)
        result = await run.stopped()
    more = {
        "page_server_cores": spent_s / len(pairs) / window_s,
        "run_dropped": result["dropped"],
        "load": os.getloadavg()[1],
    }
    return {"client": given.client} | _compared(pairs) | more


def _signal(processes, number):
    for each in processes:
        with suppress(ProcessLookupError):  # browsers let helpers come and go
            os.kill(each, number)


@asynccontextmanager
async def _open_page(meter, given):
    """A page that takes all it is given; yield its server's number, and those of its processes."""
    async with page_server(meter.folder.card.name) as (server, url):
        if given.client == "browser":
            async with browser(url) as tab:
                tab.hurry(given.nice)
                await tab.until("hilctlLive.frames > 10")
                yield server, tab.processes()
            return
        client = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "tests.benchmark.live_client", url, stdout=subprocess.PIPE
        )
        try:
            await client.stdout.readline()  # it gets frames
            yield server, [client.pid]
        finally:
            client.terminate()
            await client.wait()


def _pair_text(plain, shown):
    late = [f"{each.percentile_us(99):.1f}" for each in (plain, shown)]
    used = [f"{100 * each.supervisor_s:.1f}" for each in (plain, shown)]
    return f"p99 {late[0]} / {late[1]} us, supervisor {used[0]} / {used[1]} % of a core"


def _compared(pairs):
    """Return the second of each pair against the first."""

    def ratios(value):
        return [value(second) / value(first) for first, second in pairs]

    def spread(values):
        """Return the median, and the interval that it lies in with a chance of 95 %."""
        values = np.sort(values)
        below = int(max(0.0, np.floor(values.size / 2 - 0.98 * np.sqrt(values.size))))
        most = values.size - 1
        found = (np.median(values), values[below], values[most - below])
        return dict(zip(("median", "from", "to"), (round(float(e), 3) for e in found), strict=True))

    all_us = [np.concatenate([each.late_us for each in half]) for half in zip(*pairs, strict=True)]
    pooled = [float(np.percentile(each, 99)) for each in all_us]
    return {
        "pairs": len(pairs),
        "p99_ratio": spread(ratios(lambda each: each.percentile_us(99))),
        "p50_ratio": spread(ratios(lambda each: each.percentile_us(50))),
        "p99_pooled_us": pooled,
        "p99_pooled_ratio": pooled[1] / pooled[0],
        "supervisor_ratio": spread(ratios(lambda each: each.supervisor_s)),
        "loop_ratio": spread(ratios(lambda each: each.loop_s)),
        "dropped": [sum(each.dropped for each in half) for half in zip(*pairs, strict=True)],
        "ticks": [each.size for each in all_us],
        "ticks_not_seen": sum(each.unseen for pair in pairs for each in pair),
    }


def _say(text):
    print(text, file=sys.stderr, flush=True)


async def hostile(folder, given):
    """Strangers at the door of a run; what each of them got, and the run meanwhile.

    They take the processor's time themselves. So windows without them have the same strangers at
    the door of another program, but for those that no other would keep as long.
    """
    resource.setrlimit(resource.RLIMIT_NOFILE, (16384, 20000))
    found, pairs, window_s = {}, [], given.seconds or 3.0
    with LiveRun(folder, 900, "recording.on_failure=go_on") as run, _another_program() as elsewhere:
        url = await run.url()
        strangers = _strangers(int(re.search(r":(\d+)/", url)[1]), url.partition("#")[2])
        others = _strangers(elsewhere, "0" * 32)
        meter = await Meter.of(run)
        for turn in range(given.turns):
            for name in [each for each in strangers if given.only in each]:
                if turn and name in _LONG:
                    continue
                there = None if name in _LONG else _for(window_s, others[name])
                plain, _ = await meter.stretch(window_s, there)
                visited, found[name] = await meter.stretch(0.0, _for(window_s, strangers[name]))
                pairs.append((plain, visited))
                _say(f"{turn} {name}: {found[name]}; elsewhere / here: {_pair_text(*pairs[-1])}")
                await asyncio.sleep(_SETTLE_S)
        result = await run.stopped()
    return found | _compared(pairs) | {"code": result["code"], "run_dropped": result["dropped"]}


def _strangers(port, token):
    """Return who comes to a server, by what is wrong with them."""
    own = f"http://127.0.0.1:{port}"
    return {
        "foreign_origin": lambda: _refused(port, token, "http://evil.example"),
        "no_token": lambda: _refused(port, "", own),
        "wrong_token": lambda: _refused(port, "0" * 32, own),
        "foreign_host": lambda: _status(port, "evil.example"),
        "another_user": lambda: asyncio.to_thread(_as_nobody, port),
        "message_of_100_mb": lambda: _flood(port, token, own),
        "crowd_of_10000": lambda: _crowd(port, token, own),
        "slow_reader": lambda: _slow(port, token, own),
    }


@contextmanager
def _another_program():
    """A server that knows nothing of runs; yield its port."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    words = [sys.executable, "-m", "http.server", "--bind", "127.0.0.1", str(port)]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with tempfile.TemporaryDirectory() as empty:
        process = subprocess.Popen(words, cwd=empty, **quiet)
        try:
            yield port
        finally:
            process.terminate()
            process.wait()


async def _for(seconds, stranger):
    """Let one come again and again for some seconds, and once at least; return the last answer."""
    until, times = time.monotonic() + seconds, 0
    while times == 0 or time.monotonic() < until:
        answer, times = await stranger(), times + 1
    return {"times": times, "got": answer}


def _asked(port, token, origin, **more):
    return opened(f"http://127.0.0.1:{port}/#{token}", origin=origin, **more)


async def _refused(port, token, origin):
    try:
        async with _asked(port, token, origin):
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
    async with _asked(port, token, origin, max_size=None) as connection:
        await connection.recv()
    took_s = time.monotonic() - began
    for _, writer in held:
        with suppress(OSError):
            writer.close()
    return {"refused": refused, "page_got_in_after_s": took_s}


async def _flood(port, token, origin):
    with suppress(Exception):
        async with _asked(port, token, origin, max_size=None) as connection:
            with suppress(Exception):
                await connection.send("x" * 100_000_000)
            await connection.wait_closed()
            return f"closed by code {connection.close_code}"
    return "closed"


async def _slow(port, token, origin):
    """Take no frame; return after how many seconds the connection was cut."""
    async with _asked(port, token, origin, max_size=None) as connection:
        connection.transport.pause_reading()
        began = time.monotonic()
        with suppress(OSError):  # closed by now
            sock = connection.transport.get_extra_info("socket")
            while time.monotonic() - began < 90.0 and not sock.getsockopt(*_ERROR):
                await asyncio.sleep(0.5)
                with suppress(TimeoutError, ConnectionClosed):
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
