"""Time what a tick costs beside the device: from each wake-up to the next sleep, less the exchange.

Run it with ``python -m tests.benchmark.tick``; see README.md beside it. It runs the loop process's
own code on the simulated rig with a clock that records each sleep. With ``--aux``, runs without and
with auxiliary channels take turns, so that both have the same load of the machine.
"""

import argparse
import os
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from hilctl.base.device import AuxChannel
from hilctl.base.private_dirs import memory_folder
from hilctl.base.samples import BlockHeader
from hilctl.experiment.devices import BUILTIN
from hilctl.experiment.load import LoadedExperiment, load_experiment
from hilctl.experiment.preflight import CheckedExperiment, CheckedRun, check
from hilctl.loop.pacer import SystemClock
from hilctl.machine.rt_setup import Realtime, prepare
from hilctl.run import loop_process
from hilctl.run.job import Job
from hilctl.run.run_folder import RunCard, RunFolder
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import PageField, Phase, SharedPage
from hilctl_drivers.simulated.devices import SimulatedTerfenol, TerfenolOptions

EXPERIMENT = Path(__file__).parents[2] / "configs" / "terfenol_sine_6a.yaml"
MODELS = EXPERIMENT.parent / "models"
ROUNDS = 6  # of a comparison
CHANNELS = ("a_c", "b_c", "c_c", "d_c")
WITH_CHANNELS = (
    "device.kind=four_channels",
    f"limits.aux={{{', '.join(f'{name}: 80' for name in CHANNELS)}}}",
)
SHIPPED = [MODELS / f"{name}.yaml" for name in ("terfenol_omega", "terfenol_staged")]


class FourChannels(SimulatedTerfenol):
    """The rig with auxiliary channels of constant values, which cost the device nothing."""

    def __init__(self, options: TerfenolOptions) -> None:
        super().__init__(options)
        channels = tuple(AuxChannel(name, "°C", "") for name in CHANNELS)
        self._info = replace(self._info, aux=channels)
        self.aux = np.full(len(channels), 25.0)


BUILTIN["four_channels"] = f"{__name__}:FourChannels"


class TimedClock(SystemClock):
    """The loop's clock; it records when each sleep began and ended."""

    slept: ClassVar[list[int]] = []
    woke: ClassVar[list[int]] = []

    def sleep_until_ns(self, deadline_ns: int) -> None:
        self.slept.append(time.monotonic_ns())
        super().sleep_until_ns(deadline_ns)
        self.woke.append(time.monotonic_ns())


def experiment(
    options: argparse.Namespace, model: Path, settings: Sequence[str]
) -> LoadedExperiment:
    """Return the shipped experiment with a model."""
    own = {
        "sample_rate_hz": float(options.rate),
        "block": options.block,
        "waveform.frequency_hz": 1.0,
        "waveform.duration_s": options.ticks * options.block / options.rate,
        "compensator.model": model.resolve(),
    }
    return load_experiment(EXPERIMENT, [*(f"{k}={value}" for k, value in own.items()), *settings])


def job(folder: RunFolder, axes: Sequence[CheckedExperiment]) -> Job:
    """Return what the supervisor hands to the loop process, without a heartbeat timeout."""
    return Job.of(
        CheckedRun((*axes,)),
        folder,
        locks=[],
        take_over=False,
        supervisor=os.getppid(),
        silence_s=1e9,
    )


def start(page: SharedPage) -> None:
    """Give the device and, once all is compiled, the start signal, as the supervisor does."""
    page.put(PageField.HAS_DEVICE, 1)
    while page.get(PageField.PHASE) != Phase.READY:
        time.sleep(0.01)
    page.put(PageField.START_NS, time.monotonic_ns() + 50_000_000)
    page.put(PageField.GO, 1)


def ticks_us(
    options: argparse.Namespace, model: Path, settings: Sequence[str] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Run the loop; return the cost of each tick beside the exchange, and the exchange, in us."""
    checked = check(experiment(options, model, settings))
    TimedClock.slept.clear()
    TimedClock.woke.clear()
    config = checked.loaded.config
    slots = options.ticks + 10 * round(config.safe.ramp_s * options.rate)
    loop_process.SystemClock = TimedClock  # type: ignore[misc]
    with tempfile.TemporaryDirectory(prefix="hilctl-", dir=memory_folder()) as name:
        folder = RunFolder(Path(name), RunCard("tick", "tick", "", os.getpid(), 0.0))
        names = [f"axis{k}" for k in range(options.axes)] if options.axes > 1 else [""]
        axes = [replace(checked, loaded=replace(checked.loaded, axis=name)) for name in names]
        work = job(folder, axes)
        rings = [
            SampleRing.create(
                Path(each.ring),
                slots=slots,
                block=options.block,
                state_size=checked.state_size,
                aux=len(checked.loaded.device.info.aux),
            )
            for each in work.axes
        ]
        threading.Thread(target=start, args=(rings[0].page,), daemon=True).start()
        outcome = loop_process.run_job(work, rings)
        heads = [np.concatenate([batch.heads for batch in ring.batches()]) for ring in rings]
    if outcome.code != "completed":
        sys.exit(f"the run ended as {outcome.code}: {outcome.reason}")
    exchange_ns = np.sum([each[:, BlockHeader.EXCHANGE_NS] for each in heads], axis=0)
    slept, woke = np.array([TimedClock.slept, TimedClock.woke])
    busy_ns = slept[1:] - woke[:-1] - exchange_ns[: slept.size - 1]
    return busy_ns[: options.ticks] * 1e-3, exchange_ns[: options.ticks] * 1e-3


def figures(values_us: np.ndarray) -> str:
    """Return p50, p99, p99.9 and max as text."""
    p50, p99, p999, top = np.percentile(values_us, [50, 99, 99.9, 100])
    return f"median {p50:6.1f}  p99 {p99:6.1f}  p99.9 {p999:6.1f}  max {top:7.1f} us"


def main() -> int:
    """Run the benchmark; the exit code is 1 if a median is above its target."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--ticks", type=int, default=10_000)
    parser.add_argument("--rate", type=float, default=1000.0, help="samples per second")
    parser.add_argument("--block", type=int, default=1, help="samples per tick")
    parser.add_argument("--axes", type=int, default=1, help="equal axes, exchanged in turn")
    parser.add_argument("--aux", action="store_true", help="compare with four auxiliary channels")
    parser.add_argument("--priority", type=int, default=80)
    parser.add_argument("--model", type=Path, help="model file; default: Omega and staged")
    parser.add_argument("--max-us", type=float, default=25.0, help="target of the median")
    options = parser.parse_args()
    for step in prepare(Realtime(priority=options.priority)):
        print(f"{step.name:>13}  {step.outcome}: {step.detail}")
    missed = False
    for model in [options.model] if options.model else SHIPPED:
        tick_us, exchange_us = ticks_us(options, model)
        missed |= bool(np.median(tick_us) > options.max_us)
        print(f"{model.stem}: target {options.max_us:g} us")
        print(f"  tick beside the device  {figures(tick_us)}")
        print(f"  simulated device        {figures(exchange_us)}")
        if options.aux:
            medians_us = [
                [np.median(ticks_us(options, model, settings)[0]) for settings in pair]
                for pair in [((), WITH_CHANNELS)] * ROUNDS
            ]
            none_us, four_us = np.min(medians_us, axis=0)  # other load only adds
            print(f"  with four channels      {four_us / none_us:.2f} times {none_us:.1f} us")
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
