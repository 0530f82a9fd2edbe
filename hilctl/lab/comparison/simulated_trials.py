"""Trials of inverses on a simulated device in this process, and their time per sample.

A trial is an unpaced run without recording, interlocks and feedback, so only for simulated devices.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hilctl.base.errors import DeviceError, InputError
from hilctl.base.samples import Flag
from hilctl.base.types import F64, U32
from hilctl.experiment.load import LoadedExperiment
from hilctl.experiment.sections.compensator import begin
from hilctl.lab.identify.data.records import SteadyLoop
from hilctl.loop.interlocks import AuxLimit, InterlockContext, InterlockSettings
from hilctl.models.base import HysteresisModel
from hilctl.run.assemble import assemble, axis_plan
from hilctl.run.unpaced import run_in_memory
from hilctl.signals.segment_metrics import SegmentMetrics
from hilctl.waveforms.build import Reference, build
from hilctl.waveforms.spec import AnyWaveform, Sine, Triangle

CYCLES = 4
"""Cycles of each trial at full amplitude; the first is not evaluated."""

STROKE = 0.98
"""Default share of the measured stroke in a trial."""

TIMED_SAMPLES = 20_000
_ROUNDS = 5
_SOFT_S = 0.2
_METRICS = ("peak_hysteresis_percent", "peak_error_percent", "rms_error_percent")
_LIMITED = int(Flag.RANGE_LIMITED | Flag.SLEW_LIMITED | Flag.INVALID)


@dataclass(frozen=True, slots=True)
class InverseTrial:
    """Metrics of a trial on the mean steady cycle, as in reports.

    ``limited_samples`` counts evaluated samples whose command the limiter changed.
    """

    label: str
    frequency_hz: float
    peak_hysteresis_percent: float | None
    peak_error_percent: float | None
    rms_error_percent: float | None
    limited_samples: int


def waveforms_of(
    waveform: AnyWaveform, frequencies_hz: Sequence[float] | None
) -> list[AnyWaveform]:
    """Return a waveform at each frequency, with the necessary duration.

    Raise InputError for another waveform with frequencies, and for a frequency that is not > 0.
    """
    if frequencies_hz is None:
        return [waveform]
    if not isinstance(waveform, Sine | Triangle):
        raise InputError(f"--frequencies is for sine and triangle only, not for {waveform.kind}")
    if not all(0.0 < f < float("inf") for f in frequencies_hz):
        raise InputError(f"--frequencies must be > 0: {list(frequencies_hz)}")
    soft_s = waveform.soft_start_s + waveform.soft_end_s
    return [
        waveform.model_copy(update={"frequency_hz": f, "duration_s": soft_s + CYCLES / f})
        for f in frequencies_hz
    ]


def full_stroke(loops: Sequence[SteadyLoop]) -> Sine:
    """Return a sine in um over nearly the stroke of the widest loop."""
    widest = max(loops, key=lambda loop: float(np.ptp(loop.displacement_um)))
    low, high = float(widest.displacement_um.min()), float(widest.displacement_um.max())
    return Sine(
        kind="sine",
        unit="um",
        amplitude=STROKE * 0.5 * (high - low),
        offset=0.5 * (high + low),
        frequency_hz=widest.frequency_hz,
        duration_s=2.0 * _SOFT_S + CYCLES / widest.frequency_hz,
        soft_start_s=_SOFT_S,
        soft_end_s=_SOFT_S,
    )


class TrialDevice:
    """A simulated device with the limits of its experiment, for trials.

    Raise InputError if it is not simulated, or a waveform is invalid or not periodic.
    """

    def __init__(self, loaded: LoadedExperiment, waveforms: Sequence[AnyWaveform]) -> None:
        info = loaded.device.info
        if not info.simulated:
            raise InputError(
                f"trials need a simulated device, not {info.name}: use 'hilctl run' for each model"
            )
        self._loaded = loaded
        rate_hz = loaded.config.sample_rate_hz
        self.references = tuple(build(waveform, rate_hz, loaded.folder) for waveform in waveforms)
        for reference in self.references:
            if reference.unit != "um" or reference.segments[0].period <= 0.0:
                label = reference.segments[0].label
                raise InputError(f"a trial needs a periodic waveform in um: {label}")

    @property
    def description(self) -> str:
        """Description of the device."""
        return self._loaded.device.info.description

    def run(self, model: HysteresisModel, reference: Reference) -> list[InverseTrial]:
        """Run the inverse of a model from rest, and evaluate each segment."""
        loaded = replace(self._loaded, model=model)
        begun = begin(model, reference.sample_rate_hz, reference.values)
        values = (reference.values, begun.input_um[:], begun.state)
        axis = replace(
            axis_plan(loaded, *values),
            # Evaluate inaccurate models, too, instead of stopping them.
            interlocks=InterlockContext(
                stroke_um=(-math.inf, math.inf),
                aux=tuple(AuxLimit(each) for each in loaded.device.info.aux),
            ),
            interlock_settings=InterlockSettings(),
            feedback=None,
        )
        plan = assemble(loaded, [axis], paced=False)
        outcome, [samples] = run_in_memory(plan, [loaded.device])
        if outcome.code == "fault":
            raise DeviceError(outcome.reason)
        return _judged(reference, samples.displacement_um, samples.flags)


def _judged(reference: Reference, displacement_um: F64, flags: U32) -> list[InverseTrial]:
    trials = []
    for segment in reference.segments:
        start, stop, cycles = segment.steady_cycles()
        if cycles == 0:
            raise InputError(f"{segment.label}: no steady cycle: use a longer waveform")
        metrics = SegmentMetrics(segment, averaged=True, compensated=True)
        signals = np.array((reference.values[start:stop], displacement_um[start:stop]))
        metrics.add(np.arange(start, stop), signals)
        found = metrics.metrics()
        trials.append(
            InverseTrial(
                label=segment.label,
                frequency_hz=reference.sample_rate_hz / segment.period,
                **{name: found.get(name) for name in _METRICS},
                limited_samples=int(np.count_nonzero(flags[start:stop] & _LIMITED)),
            )
        )
    return trials


def inverse_ns(
    model: HysteresisModel, loop: SteadyLoop, sample_rate_hz: float, clock: Callable[[], float]
) -> float:
    """Measure the time per sample of a model's inverse, in ns.

    The reference is a sine with the loop's stroke and frequency; the shortest of several rounds is
    free of other load.
    """
    low, high = float(loop.displacement_um.min()), float(loop.displacement_um.max())
    angle = 2.0 * np.pi * loop.frequency_hz / sample_rate_hz * np.arange(TIMED_SAMPLES)
    reference_um = 0.5 * (low + high) + 0.5 * (high - low) * np.sin(angle)
    operator = model.inverse(sample_rate_hz)
    out = np.empty_like(reference_um)
    operator.process(reference_um, out)
    times = []
    for _ in range(_ROUNDS):
        begin = clock()
        operator.process(reference_um, out)
        times.append(clock() - begin)
    return 1e9 * min(times) / TIMED_SAMPLES
