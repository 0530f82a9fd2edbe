"""A run with its live page in processes of its own, and what looking on costs it."""

import asyncio
import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilctl.base.samples import Head
from hilctl.run.client import going_on
from hilctl.run.ring import SampleRing
from hilctl.run.shared_page import Field, Phase

CONFIGS = Path(__file__).parents[2] / "configs"
EXPERIMENT = CONFIGS / "terfenol_sine_6a.yaml"
_LOOK_S = 0.4


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
                [sys.executable, "-m", "hilctl", "run", *words],
                stdout=subprocess.PIPE,
                stderr=log,
            )

    def __enter__(self):
        return self

    def __exit__(self, *error):
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            self.process.communicate()

    @property
    def log(self):
        """What it has said on its standard error."""
        return self._log.read_text()

    async def url(self):
        while not (found := re.search(r"http\S+", self.log)):
            if self.process.poll() is not None:
                raise RuntimeError(self.log)
            await asyncio.sleep(0.05)
        return found[0]

    async def result(self):
        said, _ = await asyncio.to_thread(self.process.communicate)
        return json.loads(said)

    async def stopped(self):
        """End it as ``hilctl stop`` does; return its result."""
        self.process.send_signal(signal.SIGUSR1)
        return await self.result()

    def server(self, nice=0):
        """Return the process number of the page's server; give it that niceness."""
        number = child(self.process.pid, b"hilctl.desk.live")
        if nice:
            Path(f"/proc/{number}/autogroup").write_text(str(nice))
        return number


def rss_mb(process):
    """Return the resident memory of a process, in MB."""
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGESIZE") / 1e6


@asynccontextmanager
async def page_server(name):
    """``hilctl live`` for a run, in a process of its own; yield its number and its address."""
    process = subprocess.Popen(
        [sys.executable, "-m", "hilctl", "live", name], stdout=subprocess.PIPE
    )
    try:
        line = await asyncio.to_thread(process.stdout.readline)
        yield process.pid, re.search(r"http\S+", line.decode())[0]
    finally:
        process.terminate()
        process.communicate()


@dataclass(frozen=True)
class Stretch:
    """What a run did for some seconds.

    Attributes:
        late_us: How late each tick woke.
        unseen: Ticks that were gone before they were looked at.
        dropped: Samples that the run dropped.
        supervisor_s: Processor time of the supervisor, a second.
        loop_s: Processor time of the loop, a second.
    """

    late_us: np.ndarray
    unseen: int
    dropped: int
    supervisor_s: float
    loop_s: float

    def percentile_us(self, percent):
        """Return a percentile of the lateness, in us."""
        return float(np.percentile(self.late_us, percent))


class Meter:
    """Looks at a run from outside, in the same way whoever else does.

    Args:
        run: The run.
    """

    def __init__(self, run):
        self.folder = next(each for each in going_on() if each.card.supervisor == run.process.pid)
        self._ring = SampleRing(self.folder.ring, look_only=True)
        self._supervisor = run.process.pid
        self._loop = child(run.process.pid, b"hilctl.run.loop_process")

    @classmethod
    async def of(cls, run):
        """Return that of a run, once its waveform runs."""
        while run.process.poll() is None:
            with suppress(StopIteration, OSError, ValueError, RuntimeError):  # it is starting
                meter = cls(run)
                page = meter._ring.page
                if page.get(Field.PHASE) == Phase.RUNNING and page.get(Field.HEAD) > 500:
                    return meter
            await asyncio.sleep(0.1)
        raise RuntimeError(run.log)

    async def stretch(self, seconds, doing=None):
        """Look on for some seconds, or until ``doing`` is done."""
        page, late_us, unseen, dropped = self._ring.page, [], 0, 0
        next_block = page.get(Field.HEAD)
        began, spent = time.monotonic(), self._spent()
        work = asyncio.ensure_future(doing if doing is not None else asyncio.sleep(seconds))
        while True:
            done, _ = await asyncio.wait([work], timeout=_LOOK_S)
            batch, after = self._ring.look(next_block)
            unseen += after - next_block - batch.heads.shape[0]
            next_block = after
            late_us.append(batch.heads[:, Head.LATE_NS] * 1e-3)
            dropped += int(batch.heads[:, Head.DROPPED_BEFORE].sum())
            if done:
                break
        took_s = time.monotonic() - began
        used = [(now - before) / took_s for now, before in zip(self._spent(), spent, strict=True)]
        return Stretch(np.concatenate(late_us), unseen, dropped, *used), work.result()

    def _spent(self):
        return [processor_s(each) for each in (self._supervisor, self._loop)]


def child(process, part):
    """Return the process number of a process's child whose command line has a part."""
    children = Path(f"/proc/{process}/task/{process}/children").read_text()
    for number in map(int, children.split()):
        if part in Path(f"/proc/{number}/cmdline").read_bytes():
            return number
    raise RuntimeError(f"it has no {part.decode()}")


def processor_s(process):
    """Return the processor time that the threads of a process have taken, in s."""
    threads = Path(f"/proc/{process}/task").glob("*/schedstat")
    return sum(int(each.read_text().split()[0]) for each in threads) * 1e-9
