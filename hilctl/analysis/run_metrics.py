"""Metrics of a run and of each of its segments.

A metric without meaning is None: an average without a period, an error without a reference.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from hilctl.base.formatting import finite, shown_briefly
from hilctl.base.types import CommandUnit
from hilctl.machine.procfs import ProcessUsage
from hilctl.recording.metadata_keys import LabelValue


@dataclass(frozen=True, slots=True)
class RunMetrics:
    """Metrics of the average cycle, except the raw ones.

    The loop is displacement against reference_um with a compensator, otherwise displacement against
    the command, without errors.

    Attributes:
        peak_hysteresis_percent: Largest output difference of a rising and a falling branch at one
            input, over the peak-to-peak displacement (figure 2.4).
        noise_floor_percent: Peak hysteresis that sensor noise alone would cause.
        loop_area: Area enclosed by the loop, in um times the input's unit.
        peak_to_peak_um: Peak-to-peak displacement.
        peak_error_percent: Largest displacement less reference, offset included, over the
            peak-to-peak reference; the raw error without a period.
        rms_error_percent: Its root mean square.
        peak_error_raw_percent: Peak error of all steady samples without averaging.
        rms_error_raw_percent: Its root mean square.
        sensor_noise_um: Estimated rms noise of a single displacement sample.
        steady_cycles: Evaluated whole cycles.
        steady_samples: Evaluated samples.
    """

    peak_hysteresis_percent: float | None
    noise_floor_percent: float | None
    loop_area: float | None
    peak_to_peak_um: float | None
    peak_error_percent: float | None
    rms_error_percent: float | None
    peak_error_raw_percent: float | None
    rms_error_raw_percent: float | None
    sensor_noise_um: float | None
    steady_cycles: int
    steady_samples: int


@dataclass(frozen=True, slots=True)
class SegmentReport(RunMetrics):
    """Metrics of one segment.

    Attributes:
        label: Its waveform.
        start_s: Time of its first sample since the start of the run.
        frequency_hz: Frequency of its period; None without one.
        samples: Recorded samples in it, soft start and end included.
    """

    label: str
    start_s: float
    frequency_hz: float | None
    samples: int


@shown_briefly
@dataclass(frozen=True, slots=True)
class RunReport(RunMetrics):
    """Metrics of a run.

    Each metric is the largest of all segments. The noise floor is that of the segment with the
    largest peak hysteresis, and the sensor noise that of all steady samples. Cycles and steady
    samples are summed; extremes include all recorded samples.

    Attributes:
        path: File that was read.
        reason: Why the run ended, or that the recording is truncated.
        complete: Whether its end is recorded, and its last sample is recorded or counted as
            dropped.
        samples: Samples of the waveform.
        ramp_samples: Samples of the ramps to the safe value, before and after it.
        recorded_samples: Both.
        dropped: Samples that were exchanged or due and are missing.
        skipped_ticks: Ticks skipped because one was too late; None if not recorded.
        deadline_misses: Text with the share of skipped ticks and its evaluation; empty if there are
            none or it is unknown.
        duration_s: Duration of the waveform.
        command_unit: ``A`` or ``V``, of ``command_min`` and ``command_max``.
        limited_samples: Samples of the waveform that the limiter changed.
        sensor_invalid_samples: Samples of the waveform with an invalid displacement.
        reading_age_max_s: Largest age of a reading; None unless the sensor sends unasked.
        lost_readings: Readings of such a sensor that did not arrive.
        late_ticks: Late ticks; None if not recorded.
        lateness_us: ``p50``, ``p90``, ``p99``, ``p99.9`` and ``max`` of the lateness of ticks;
            empty without ticks.
        lateness_by_minute: The same of each minute, with ``minute`` from 0 and its ``ticks``.
        exchange_us: The same for the duration of exchanges with the device.
        adapted: Final parameters of the adaptation, see :data:`hilctl.base.events.ADAPTED`; empty
            without adaptation.
        processes: Resource usage of ``loop`` and ``supervisor``; empty if not recorded.
        marks: Time since the start of the run, in s, and text of each mark.
    """

    path: str
    name: str
    labels: Mapping[str, LabelValue]
    device: str
    device_description: str
    simulated: bool
    reason: str
    complete: bool
    samples: int
    ramp_samples: int
    recorded_samples: int
    dropped: int
    skipped_ticks: int | None
    deadline_misses: str
    sample_rate_hz: float
    duration_s: float
    compensated: bool
    command_unit: CommandUnit
    loop_area_unit: str
    command_min: float | None
    command_max: float | None
    displacement_min_um: float | None
    displacement_max_um: float | None
    limited_samples: int
    sensor_invalid_samples: int
    reading_age_max_s: float | None
    lost_readings: int
    late_ticks: int | None
    lateness_us: dict[str, float]
    lateness_by_minute: list[dict[str, float]]
    exchange_us: dict[str, float]
    adapted: dict[str, float]
    processes: dict[str, ProcessUsage]
    marks: tuple[tuple[float, str], ...]
    segments: tuple[SegmentReport, ...]

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for JSON; numbers that are not finite become None."""
        mapping: dict[str, Any] = finite(asdict(self))
        return mapping
