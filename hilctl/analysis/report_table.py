"""Report as rows of text."""

from hilctl.analysis.run_metrics import RunReport, SegmentReport
from hilctl.base.events import adapted_text
from hilctl.base.formatting import MISSING, printable, quantity
from hilctl.machine.procfs import ProcessUsage

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
        ("limited samples", f"{report.limited_samples:,}"),
        ("invalid readings", f"{report.sensor_invalid_samples:,}"),
        *([("reading age", _age(report))] if report.reading_age_max_s is not None else []),
        ("ticks", f"{_count(report.late_ticks)} late, {_count(report.skipped_ticks)} skipped"),
        *([("timing", report.deadline_misses)] if report.deadline_misses else []),
        *([("adapted", adapted_text(report.adapted))] if report.adapted else []),
        *(("mark", f"{at_s:.6g} s: {printable(text)}") for at_s, text in report.marks),
        ("lateness", _percentiles(report.lateness_us)),
        ("exchange", _percentiles(report.exchange_us)),
        *((f"{name} process", usage_text(each)) for name, each in report.processes.items()),
    ]


def _age(report: RunReport) -> str:
    oldest = quantity(report.reading_age_max_s or 0.0, "s")
    return f"at most {oldest}; {report.lost_readings:,} readings lost"


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
    counts = ("steady cycles", report.steady_cycles), ("evaluated samples", report.steady_samples)
    return [*known, *((name, f"{count:,}") for name, count in counts if count)]


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


def _percentiles(figures: dict[str, float]) -> str:
    if not any(figures.values()):  # of a run that did not keep real time
        return MISSING
    return ", ".join(f"{name} {quantity(value, 'us')}" for name, value in figures.items())
