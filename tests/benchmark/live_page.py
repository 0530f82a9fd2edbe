"""The live page in a headless Chromium, and what it costs the run.

    python -m tests.benchmark.live_page frames --seconds 120
    python -m tests.benchmark.live_page spikes
    python -m tests.benchmark.live_page stop --kill-server
    python -m tests.benchmark.live_page hostile
    python -m tests.benchmark.live_page cost --pairs 30 --client browser
    python -m tests.benchmark.live_page pictures OUT

Each prints one JSON object. ``--nice`` is that of all processes started, for a busy machine.
"""

import argparse
import asyncio
import json
import os
import signal
import tempfile
import time
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np

from hilctl.base.samples import Head
from hilctl.run.description import RunDescription
from hilctl.run.ring import SampleRing
from hilctl.run.run_folder import run_folder
from hilctl.run.shared_page import Field, Phase
from hilctl.run.start import checked_experiment
from tests.benchmark.devtools import browser
from tests.benchmark.live_cost import cost, hostile
from tests.benchmark.live_run import EXPERIMENT, LiveRun, page_server, rss_mb

_FRAMES = "JSON.stringify([hilctlLive.frames, hilctlLive.errors, performance.now()])"


async def frames(folder, given):
    """Frames a second of all signals over a whole run, memory in its first and last part."""
    seconds = given.seconds or 120.0
    with LiveRun(folder, seconds + 20, "recording.on_failure=go_on") as run:
        async with browser(await run.url()) as tab:
            tab.hurry(given.nice)
            run.server(given.nice)
            await tab.until("hilctlLive.frames > 30")
            rates, memory = [], []
            until = time.monotonic() + seconds
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
        seen = set()
        async with page_server(run.card.name) as (_, url), browser(url) as tab:
            tab.hurry(given.nice)
            await tab.until("hilctlLive.frames > 5")
            await tab.value("document.getElementById('mode').click()")
            ring = SampleRing(run.ring, look_only=True)
            begin = ring.page.get(Field.HEAD) + 1000
            wanted |= {begin + 2400 * each: each for each in range(10)}
            while ring.page.get(Field.HEAD) < max(wanted) + 1500:
                seen.add(round(await tab.value("hilctlLive.highest('plot-error')") - 50.0))
                await asyncio.sleep(0.2)
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
    parser.add_argument("--seconds", type=float, help="120 of frames, 3 of each half of a pair")
    parser.add_argument("--pairs", type=int, default=30)
    parser.add_argument("--client", choices=("browser", "plain"), default="browser")
    parser.add_argument("--turns", type=int, default=5, help="how often strangers come")
    parser.add_argument("--only", default="", help="strangers whose name has this")
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
