"""Time what a tick costs beside the device: from each wake-up to the next sleep, less the exchange.

Run it with ``python -m tests.benchmark.tick``; see README.md beside it. It runs the loop process's
own code on the simulated rig, one sample a tick, with a clock that takes notes. Where LinuxCNC is
installed, a thread of its HAL does the closest thing it has, for comparison.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import ClassVar

import numpy as np

from hilctl.base.private import memory_folder
from hilctl.base.samples import Head
from hilctl.experiment.check import Checked, check
from hilctl.experiment.load import LoadedExperiment, load_experiment
from hilctl.loop.pacer import SystemClock
from hilctl.machine.realtime import prepare
from hilctl.machine.settings import Realtime
from hilctl.run import carried_out
from hilctl.run.job import Job
from hilctl.run.ring import SampleRing
from hilctl.run.run_folder import RunCard, RunFolder
from hilctl.run.shared_page import Field, Phase, SharedPage

EXPERIMENT = Path(__file__).parents[2] / "configs" / "terfenol_sine_6a.yaml"
MODELS = EXPERIMENT.parent / "models"
TARGETS_US = {"terfenol_omega": 5.0, "terfenol_staged": 6.0, "terfenol_staged_preisach": 10.0}
HAL = """\
loadrt threads name1=servo period1={period_ns}
loadrt siggen num_chan=1
loadrt limit3 count=1
loadrt sampler depth=4000 cfg=ffff
net wanted siggen.0.sine limit3.0.in sampler.0.pin.0
net command limit3.0.out sampler.0.pin.1
setp limit3.0.min -10
setp limit3.0.max 10
setp limit3.0.maxv 1e9
setp limit3.0.maxa 1e9
addf siggen.0.update servo
addf limit3.0 servo
addf sampler.0 servo
start
"""
LOOKS = 50
NOBODY = 65534


class NotingClock(SystemClock):
    """The loop's clock, which notes when each sleep began and ended."""

    slept: ClassVar[list[int]] = []
    woke: ClassVar[list[int]] = []

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Sleep as ever."""
        self.slept.append(time.monotonic_ns())
        super().sleep_until_ns(deadline_ns)
        self.woke.append(time.monotonic_ns())


def experiment(options: argparse.Namespace, model: Path) -> LoadedExperiment:
    """Return the shipped experiment with a model, one sample a tick."""
    settings = {
        "sample_rate_hz": float(options.rate),
        "block": 1,
        "waveform.frequency_hz": 1.0,
        "waveform.duration_s": options.ticks / options.rate,
        "compensator.model": model.resolve(),
    }
    return load_experiment(EXPERIMENT, [f"{key}={value}" for key, value in settings.items()])


def job(folder: RunFolder, checked: Checked) -> Job:
    """Return what the supervisor hands to the loop process, with nobody to be silent."""
    return Job.of(checked, folder, supervisor=os.getppid(), silence_s=1e9)


def start(page: SharedPage) -> None:
    """Give the start signal once all is compiled, as the supervisor does."""
    while page.get(Field.PHASE) != Phase.READY:
        time.sleep(0.01)
    page.put(Field.START_NS, time.monotonic_ns() + 50_000_000)
    page.put(Field.GO, 1)


def ticks_us(options: argparse.Namespace, model: Path) -> tuple[np.ndarray, np.ndarray]:
    """Run the loop; return the cost of each tick beside the exchange, and the exchange, in us."""
    checked = check(experiment(options, model))
    NotingClock.slept.clear()
    NotingClock.woke.clear()
    config = checked.loaded.config
    slots = options.ticks + 10 * round(config.safe.ramp_s * options.rate)
    carried_out.SystemClock = NotingClock  # type: ignore[misc]
    with tempfile.TemporaryDirectory(prefix="hilctl-", dir=memory_folder()) as name:
        folder = RunFolder(Path(name), RunCard("tick", "tick", "", os.getpid(), 0.0))
        ring = SampleRing.create(folder.ring, slots=slots, block=1, state_size=checked.state_size)
        work = job(folder, checked)
        threading.Thread(target=start, args=(ring.page,), daemon=True).start()
        outcome = carried_out.run_job(work, ring, work.parts())
        heads = [batch.heads for batch in ring.batches()]
    if outcome.code != "completed" or not heads:
        sys.exit(f"the run ended as {outcome.code}: {outcome.reason}")
    exchange_ns = np.concatenate(heads)[:, Head.EXCHANGE_NS]
    slept, woke = np.array([NotingClock.slept, NotingClock.woke])
    busy_ns = slept[1:] - woke[:-1] - exchange_ns[: slept.size - 1]
    return busy_ns[: options.ticks] * 1e-3, exchange_ns[: options.ticks] * 1e-3


def linuxcnc(options: argparse.Namespace) -> str:
    """Run a HAL thread with signal generator, limiter and sampler; say what a cycle takes."""
    if shutil.which("halrun") is None:
        return "not installed (Debian: linuxcnc-uspace)"
    looks = "loadusr -w sleep 0.05\ngetp servo.time\n" * LOOKS
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o777)  # where root starts it, its own process is nobody's
        script = folder / "tick.hal"
        script.write_text(HAL.format(period_ns=round(1e9 / options.rate)) + looks)
        environment = os.environ | {"RTAPI_FIFO_PATH": str(folder / "fifo")}
        if os.geteuid() == 0:
            environment["RTAPI_UID"] = str(NOBODY)
        command = ["halrun", "-f", str(script)]
        ran = subprocess.run(
            command, capture_output=True, text=True, stdin=subprocess.DEVNULL, env=environment
        )
    cycles = [int(line) for line in ran.stdout.split() if line.isdigit()]
    said = ran.stderr + ran.stdout
    if not cycles:
        return f"would not run: {said.strip().splitlines()[-1]}"
    real = "without real time, " if "non-realtime" in said else ""
    return f"{real}median {np.median(cycles):.0f} CPU cycles, {np.median(cycles) / mhz():.2f} us"


def mhz() -> float:
    """Return the rate of the CPU's cycle counter."""
    text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    return float(re.search(r"cpu MHz\s*: ([\d.]+)", text)[1])


def figures(values_us: np.ndarray) -> str:
    """Return p50, p99, p99.9 and max as text."""
    p50, p99, p999, top = np.percentile(values_us, [50, 99, 99.9, 100])
    return f"median {p50:6.1f}  p99 {p99:6.1f}  p99.9 {p999:6.1f}  max {top:7.1f} us"


def main() -> int:
    """Run the benchmark; the exit code is 1 where a median is above its target."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--ticks", type=int, default=10_000)
    parser.add_argument("--rate", type=float, default=1000.0, help="ticks a second")
    parser.add_argument("--priority", type=int, default=80)
    parser.add_argument("--model", type=Path, help="a model of your own; three shipped ones else")
    parser.add_argument("--max-us", type=float, help="target of the median; each model's own else")
    options = parser.parse_args()
    for step in prepare(Realtime(priority=options.priority)):
        print(f"{step.name:>13}  {step.outcome}: {step.detail}")
    shipped = [MODELS / f"{name}.yaml" for name in TARGETS_US]
    missed = False
    for model in [options.model] if options.model else shipped:
        tick_us, exchange_us = ticks_us(options, model)
        target_us = options.max_us or TARGETS_US.get(model.stem, min(TARGETS_US.values()))
        ratio = np.median(tick_us) / target_us
        missed |= ratio > 1.0
        print(f"{model.stem}: {ratio:.2f} of the target, {target_us:g} us")
        print(f"  tick beside the device  {figures(tick_us)}")
        print(f"  simulated device        {figures(exchange_us)}")
    print(f"LinuxCNC HAL thread     {linuxcnc(options)}")
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
