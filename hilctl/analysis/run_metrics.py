"""What a report holds: plain figures of a run and of each of its segments.

None stands where a figure has no meaning: an average where nothing repeats, an error without a
reference displacement.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from hilctl.base.types import CommandUnit
from hilctl.machine.procfs import ProcessUsage
from hilctl.recording.metadata_keys import LabelValue


@dataclass(frozen=True, slots=True)
class RunMetrics:
    """Figures of quality; all but the raw ones are of the average cycle.

    The loop is displacement against reference_um where a compensator stood before the actuator,
    otherwise displacement against the command, and then there are no errors.

    Attributes:
        peak_hysteresis_percent: Largest output difference of a rising and a falling branch at one
            input, over the peak-to-peak displacement (figure 2.4).
        noise_floor_percent: What sensor noise alone would make of that figure.
        loop_area: Area enclosed by the loop, in um times the input's unit.
        peak_to_peak_um: Peak-to-peak displacement.
        peak_error_percent: Largest displacement less reference, offset included, over the
            peak-to-peak displacement. Where nothing repeats it is the raw figure.
        rms_error_percent: Its root mean square.
        peak_error_raw_percent: The same of all steady samples without averaging.
        rms_error_raw_percent: Its root mean square.
        sensor_noise_um: Estimated rms noise of a single displacement sample.
        steady_cycles: Whole cycles judged.
        steady_samples: Samples judged.
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
    """Figures of one segment.

    Attributes:
        label: What ran there.
        start_s: Time of its first sample since the start of the run.
        frequency_hz: Of its period; None where it does not repeat.
        samples: Recorded samples in it, soft start and end included.
    """

    label: str
    start_s: float
    frequency_hz: float | None
    samples: int


@dataclass(frozen=True, slots=True)
class RunReport(RunMetrics):
    """Figures of a whole run.

    Figures of quality are the worst, that is the largest, of all segments. The noise floor is that
    of the segment with the largest peak hysteresis, and the sensor noise that of all steady
    samples. Cycles and steady samples are summed; extremes are of everything recorded.

    Attributes:
        path: File that was read.
        name: Name of the experiment.
        labels: What the run is found by.
        device: Name of the device.
        simulated: Whether that is a simulation.
        reason: Why the run ended, or that its record is cut short.
        complete: Whether it has a record of its end, and the last sample of its last segment or as
            many samples counted as dropped as are lacking there.
        samples: Samples of the waveform.
        ramp_samples: Samples of the ramps to the safe value, before and after it.
        recorded_samples: Both.
        dropped: Samples that were exchanged or due and are missing.
        skipped_ticks: Ticks left out because one was too late; None where the record of the end
            does not say.
        sample_rate_hz: Samples a second.
        duration_s: From the first to after the last sample of the waveform.
        compensated: Whether a compensator stood before the actuator.
        command_unit: ``A`` or ``V``.
        loop_area_unit: Unit of ``loop_area``.
        command_min: Lowest command put out, in ``command_unit``.
        command_max: Highest command put out.
        displacement_min_um: Lowest displacement measured.
        displacement_max_um: Highest displacement measured.
        limited_samples: Samples of the waveform that the limiter changed.
        sensor_invalid_samples: Samples of the waveform whose displacement could not be trusted.
        deadline_misses: How many ticks were skipped of all, for people, and whether the timing was
            kept; empty where none was, or where that is not known.
        late_ticks: Ticks that woke late, as counted by the run; where its record does not say,
            those later than half a tick period. None where neither is known.
        lateness_us: ``p50``, ``p90``, ``p99``, ``p99.9`` and ``max`` of how late ticks woke; empty
            without ticks.
        lateness_by_minute: The same of each minute, with ``minute`` from 0 and its ``ticks``.
        adapted: What adaptation made of the model by the end, by name, see
            :data:`hilctl.base.events.ADAPTED`; empty without it.
        processes: What ``loop`` and ``supervisor`` took of the machine while the run went on, by
            name; empty where its record does not say.
        marks: Time since the start of the run, in s, and text of each mark.
        exchange_us: The same of how long exchanges with the device took.
        segments: Figures of each segment.
    """

    path: str
    name: str
    labels: Mapping[str, LabelValue]
    device: str
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
    late_ticks: int | None
    lateness_us: dict[str, float]
    lateness_by_minute: list[dict[str, float]]
    exchange_us: dict[str, float]
    adapted: dict[str, float]
    processes: dict[str, ProcessUsage]
    marks: tuple[tuple[float, str], ...]
    segments: tuple[SegmentReport, ...]

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for JSON; a number that is not finite becomes None."""
        mapping: dict[str, Any] = _plain(asdict(self))
        return mapping


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
