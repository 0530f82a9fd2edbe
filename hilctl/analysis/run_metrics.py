"""Metrics of a run and of each of its segments, and their rows of text.

A metric that does not apply is None: an average without a period, an error without a reference.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from hilctl.base.events import adapted_text
from hilctl.base.formatting import MISSING, finite, printable, quantity, shown_briefly
from hilctl.base.types import CommandUnit
from hilctl.machine.procfs import ProcessUsage
from hilctl.recording.metadata_keys import LabelValue


@dataclass(frozen=True, slots=True)
class RunMetrics:
    """Metrics of the average cycle, except the raw ones.

    The loop is displacement over reference_um with a compensator, otherwise displacement over the
    command, without errors.

    Attributes:
        peak_hysteresis_percent: Largest output difference of a rising and a falling branch at one
            input, over the peak-to-peak displacement (figure 2.4).
        noise_floor_percent: Peak hysteresis that sensor noise alone would cause.
        loop_area: Area enclosed by the loop, in um times the input's unit.
        peak_error_percent: Largest displacement less reference, offset included, over the
            peak-to-peak reference; the raw error without a period.
        rms_error_percent: Root mean square of the same difference, over the same.
        peak_error_raw_percent: Peak error of all steady samples without averaging.
        rms_error_raw_percent: Their root mean square error.
        sensor_noise_um: Estimated rms noise of a single displacement sample.
        steady_cycles: Evaluated whole cycles.
        steady_samples: Evaluated samples.
        settled: Whether no evaluated cycle is the first at full amplitude, whose hysteresis depends
            on the motion before it.
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
    settled: bool


@dataclass(frozen=True, slots=True)
class SegmentReport(RunMetrics):
    """Metrics of one segment.

    Attributes:
        start_s: Time of its first sample since the start of the run.
        frequency_hz: Frequency of its period; None without one.
        samples: Recorded samples in it, soft start and end included.
    """

    label: str
    start_s: float
    frequency_hz: float | None
    samples: int


@dataclass(frozen=True, slots=True)
class AuxReport:
    """An auxiliary channel over all recorded samples; None without a reading."""

    unit: str
    meaning: str
    mean: float | None
    min: float | None
    max: float | None


@shown_briefly
@dataclass(frozen=True, slots=True)
class RunReport(RunMetrics):
    """Metrics of a run.

    Each metric is the largest of all segments, except the noise floor, which belongs to the segment
    with the largest peak hysteresis, and the sensor noise, which is the rms over all steady
    samples. Cycles and steady samples are summed; extremes include all recorded samples.

    Attributes:
        reason: Why the run ended, or that the recording is truncated.
        complete: Whether its end is recorded, and its last sample is recorded or counted as
            dropped.
        samples: Samples of the waveform.
        ramp_samples: Samples of the ramps to the safe value, before and after it.
        recorded_samples: Samples of the waveform and of the ramps.
        dropped: Samples that were exchanged or due but are not recorded.
        skipped_ticks: Ticks skipped because one was too late; None if not recorded.
        deadline_misses: Text with the share of skipped ticks and its evaluation; empty if there are
            none or it is unknown.
        duration_s: Duration of the waveform.
        command_unit: ``A`` or ``V``, of ``command_min`` and ``command_max``.
        limited_samples: Samples of the waveform that the limiter changed.
        sensor_invalid_samples: Samples of the waveform whose displacement is invalid or
            outside the stroke limits.
        reading_age_max_s: Largest age of a reading; None unless the sensor sends unasked.
        lost_readings: Readings of such a sensor that did not arrive.
        zero_um: Zero of the sensor, subtracted from its readings; None without one.
        aux: Auxiliary channels by name.
        late_ticks: Late ticks; None if not recorded.
        lateness_us: ``p50``, ``p90``, ``p99``, ``p99.9`` and ``max`` of the lateness of ticks;
            empty without ticks.
        lateness_by_minute: The same percentiles per minute, with ``minute`` from 0 and ``ticks``.
        exchange_us: The same percentiles of the duration of exchanges with the device.
        busy_us: The same percentiles of the time from the deadline of a tick to the end of its
            exchange; the rest of its period is left.
        tick_us: Mean time that a tick takes to ``wake``, ``compute`` and ``exchange``; it waits for
            the rest of its period. Empty if not recorded.
        period_us: Time from one tick to the next; None without two ticks.
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
    zero_um: float | None
    aux: Mapping[str, AuxReport]
    late_ticks: int | None
    lateness_us: dict[str, float]
    lateness_by_minute: list[dict[str, float]]
    exchange_us: dict[str, float]
    busy_us: dict[str, float]
    tick_us: dict[str, float]
    period_us: float | None
    adapted: dict[str, float]
    processes: dict[str, ProcessUsage]
    marks: tuple[tuple[float, str], ...]
    segments: tuple[SegmentReport, ...]

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for JSON; numbers that are not finite become None."""
        mapping: dict[str, Any] = finite(asdict(self))
        return mapping


SIMULATED = "simulated: no hardware was driven"


def number(value: float | None, unit: str = "") -> str:
    """Return a number with four significant digits and its unit; a dash if None."""
    return quantity(value, unit, 4)


def run_rows(report: RunReport) -> list[tuple[str, str]]:
    """Return name and value of the run, its samples, timing and end."""
    simulated = f" ({SIMULATED})" if report.simulated else ""
    loop_input = "reference" if report.compensated else "command (no compensator)"
    reason = printable(report.reason) or MISSING
    labels = ", ".join(f"{key} {value}" for key, value in report.labels.items())
    zero = f"{quantity(report.zero_um, 'um', 4)} subtracted from the readings"
    oldest = quantity(report.reading_age_max_s, "s")
    age = f"at most {oldest}; {report.lost_readings:,} readings lost"
    return [
        *([("labels", printable(labels))] if labels else []),
        ("device", f"{printable(report.device) or MISSING}{simulated}"),
        ("device description", printable(report.device_description) or MISSING),
        ("ended", f"{reason}{'' if report.complete else ' (NOT complete)'}"),
        ("samples", f"{report.samples:,} of the waveform, {report.ramp_samples:,} of ramps"),
        ("missing samples", f"{report.dropped:,}"),
        ("rate, length", f"{report.sample_rate_hz:g} Hz, {quantity(report.duration_s, 's', 4)}"),
        ("loop", f"displacement against {loop_input}"),
        ("command", _range(report.command_min, report.command_max, report.command_unit)),
        ("displacement", _range(report.displacement_min_um, report.displacement_max_um, "um")),
        *((name, _aux(each)) for name, each in report.aux.items()),
        ("limited samples", f"{report.limited_samples:,}"),
        ("rejected readings", f"{report.sensor_invalid_samples:,}"),
        *([("sensor zero", zero)] if report.zero_um is not None else []),
        *([("reading age", age)] if report.reading_age_max_s is not None else []),
        ("ticks", f"{_count(report.late_ticks)} late, {_count(report.skipped_ticks)} skipped"),
        *([("timing", report.deadline_misses)] if report.deadline_misses else []),
        *([("adapted", adapted_text(report.adapted))] if report.adapted else []),
        *(("mark", f"{at_s:.6g} s: {printable(text)}") for at_s, text in report.marks),
        ("lateness", _percentiles(report.lateness_us)),
        ("exchange", _percentiles(report.exchange_us)),
        ("busy", _busy(report.busy_us, report.period_us)),
        ("mean tick", _percentiles(report.tick_us)),
        *((f"{name} process", usage_text(each)) for name, each in report.processes.items()),
    ]


def _aux(found: AuxReport) -> str:
    mean = f", mean {number(found.mean, found.unit)}" if found.mean is not None else ""
    meaning = f" ({found.meaning})" if found.meaning else ""
    return printable(f"{_range(found.min, found.max, found.unit)}{mean}{meaning}")


def usage_text(usage: ProcessUsage) -> str:
    """Return the resource usage of a process as text."""
    megabytes = f"{usage.resident_bytes / 1e6:.0f} MB"
    faults = f"{usage.minor_faults + usage.major_faults:,} page faults"
    return (
        f"{megabytes}, {quantity(usage.cpu_ns * 1e-9, 's')} of CPU, {faults}, "
        f"{usage.major_faults:,} from a disk; {usage.involuntary_switches:,} involuntary switches"
    )


def quality_rows(report: RunReport) -> list[tuple[str, str]]:
    """Return name and value of the metrics that the run has."""
    floor = f" (noise floor {number(report.noise_floor_percent, '%')})"
    raw = f" peak, {number(report.rms_error_raw_percent, '%')} rms"
    rows = [
        ("peak hysteresis", report.peak_hysteresis_percent, "%", floor),
        ("loop area", report.loop_area, report.loop_area_unit, ""),
        ("peak-to-peak", report.peak_to_peak_um, "um", ""),
        ("peak error", report.peak_error_percent, "%", ""),
        ("rms error", report.rms_error_percent, "%", ""),
        ("error, single samples", report.peak_error_raw_percent, "%", raw),
        ("sensor noise", report.sensor_noise_um, "um", " rms"),
    ]
    known = [(name, number(v, unit) + more) for name, v, unit, more in rows if v is not None]
    first = "" if report.settled else " (the first depends on earlier motion: record more cycles)"
    counts = (
        ("steady cycles", report.steady_cycles, first),
        ("evaluated samples", report.steady_samples, ""),
    )
    return [*known, *((name, f"{count:,}{more}") for name, count, more in counts if count)]


def segment_table(report: RunReport) -> tuple[list[str], list[list[str]]]:
    """Return headings and rows of all segments, without empty columns."""
    rows = [_segment_row(segment) for segment in report.segments]
    filled = [name for name in rows[0] if {row[name] for row in rows} != {MISSING}] if rows else []
    return filled, [[row[name] for name in filled] for row in rows]


def _segment_row(segment: SegmentReport) -> dict[str, str]:
    hz = segment.frequency_hz
    return {
        "segment": printable(segment.label),
        "start s": f"{segment.start_s:g}",
        "freq. Hz": MISSING if hz is None else f"{hz:g}",
        "cycles": str(segment.steady_cycles),
        "p-p µm": number(segment.peak_to_peak_um),
        "peak hyst. %": number(segment.peak_hysteresis_percent),
        "floor %": number(segment.noise_floor_percent),
        "peak err. %": number(segment.peak_error_percent),
        "rms err. %": number(segment.rms_error_percent),
        "loop area": number(segment.loop_area),
    }


def _range(low: float | None, high: float | None, unit: str) -> str:
    return MISSING if low is None else f"{number(low, unit)} to {number(high, unit)}"


def _count(value: int | None) -> str:
    return MISSING if value is None else f"{value:,}"


def _busy(figures: dict[str, float], period_us: float | None) -> str:
    text = _percentiles(figures)
    return text if text == MISSING else f"{text}, of {quantity(period_us, 'us')} per tick"


def _percentiles(figures: dict[str, float]) -> str:
    if not any(figures.values()):  # of a run that did not keep real time
        return MISSING
    return ", ".join(f"{name} {quantity(value, 'us')}" for name, value in figures.items())
