"""Page of a run: result, figures, tables, provenance and events."""

import json
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from typing import Any

import numpy as np

from hilctl.analysis import run_metrics
from hilctl.analysis.report import worst_segment
from hilctl.analysis.run_metrics import RunReport
from hilctl.base.errors import ConfigError
from hilctl.base.events import Event
from hilctl.base.formatting import MISSING, printable, quantity, significant, unit_text
from hilctl.experiment.sections.correction import parse_correction
from hilctl.lab.pages import html
from hilctl.lab.pages.figure_layout import FigureSpec
from hilctl.lab.run_report import plots
from hilctl.models.base import HysteresisModel
from hilctl.models.model_file import parse_model
from hilctl.recording.metadata_keys import OVERRIDES_FACT
from hilctl.recording.recording import Recording

_MOST_EVENTS = 200
_MOST_FAULTS = 3
_LARGEST = 1e100
_FAULT = "fault"
_WAVEFORM = "waveform."
_NOT_SHOWN = {"waveform.kind", "waveform.unit"}
_USUAL = {"0.0", "None", ""}


def page(recording: Recording, report: RunReport, before: Recording | None = None) -> str:
    """Return the page of a run as HTML; ``before`` is the same motion without a compensator."""
    return html.document(report.name or "run", run_body(recording, report, before))


@np.errstate(over="ignore", invalid="ignore")  # of readings near the largest number
def run_body(recording: Recording, report: RunReport, before: Recording | None = None) -> list[str]:
    """Return the body of the page of a run, in HTML."""
    terms = ["average cycle"] if report.steady_cycles else []
    if report.peak_hysteresis_percent is not None:
        terms += ["peak hysteresis", "noise floor", "loop area"]
    if report.peak_error_percent is not None:
        terms += ["peak and rms error", "harmonics of the error"]
    samples = [
        (name, value)
        for name, value in run_metrics.run_rows(report)
        if name not in {"labels", "device", "device description"}
        and value != MISSING
        # The end of an incomplete run is above.
        and (report.complete or name != "ended")
    ]
    terms += [name for name, _ in samples if name in {"lateness", "busy", "mean tick"}]
    return [
        html.paragraph(report.path, "file"),
        *_end(recording, report),
        html.paragraph(headline(report), "headline"),
        html.paragraph(f"The device is {run_metrics.SIMULATED}.", "note")
        if report.simulated
        else "",
        *_figures(recording, report, before),
        '<div class="side">',
        html.rows("Results", results) if (results := run_metrics.quality_rows(report)) else "",
        html.rows("Samples and timing", samples),
        html.rows("Run", provenance_rows(recording)),
        "</div>",
        *_segments(report),
        *_events(recording.events),
        html.definitions(*terms),
        html.details("Experiment", recording.experiment_yaml) if recording.experiment_yaml else "",
        html.details("Model", recording.model_yaml) if recording.model_yaml else "",
        *(html.details(name, text) for name, text in sorted(recording.device_files.items())),
    ]


def headline(report: RunReport) -> str:
    """Return the result of a run in one line."""
    parts = []
    if report.peak_hysteresis_percent is not None:
        floor = quantity(report.noise_floor_percent, "%")
        text = quantity(report.peak_hysteresis_percent, "%")
        parts.append(f"peak hysteresis {text} (noise floor {floor})")
    if report.peak_error_percent is not None:
        rms = quantity(report.rms_error_percent, "%")
        parts.append(f"peak error {quantity(report.peak_error_percent, '%')}, rms {rms}")
    if report.peak_to_peak_um is not None:
        parts.append(f"peak-to-peak {quantity(report.peak_to_peak_um, 'um')}")
    if report.deadline_misses:
        parts.append(report.deadline_misses)
    found = "; ".join(parts) or "no steady samples were recorded"
    return f"{found[0].upper()}{found[1:]}."


def _end(recording: Recording, report: RunReport) -> Iterator[str]:
    """Yield how a run ended, and its errors if it is not complete."""
    if _is_fault(recording):
        same = (
            e.sample for e in recording.events if e.level == "error" and e.text == report.reason
        )
        at_s = next(same, report.samples) / recording.sample_rate_hz
        text = f"Ended by a fault at {quantity(at_s, 's', 4)}: {report.reason}."
        yield html.paragraph(text, "bad")
    elif not report.complete:
        yield html.paragraph(f"The run is not complete: {report.reason}.", "bad")
    errors = {
        event.text: f"{quantity(event.sample / recording.sample_rate_hz, 's', 4)}: {event.text}"
        for event in recording.events
        if event.level == "error" and event.text != report.reason
    }
    for text in list(errors.values())[-_MOST_FAULTS:]:
        yield html.paragraph(text, "bad")
    if recording.end.get("output_safe") == "false":
        yield html.paragraph("The output was NOT confirmed to be safe at the end.", "bad")


def _figures(recording: Recording, report: RunReport, before: Recording | None) -> Iterator[str]:
    if not _drawable(recording):
        yield html.paragraph("No figure is drawn: readings are near the largest number.")
        return
    sheets = run_sheets(recording, report)
    if before and (both := plots.before_and_after(before, recording)):
        sheets.insert(0, both)
    yield html.figures(sheets)


def run_sheets(recording: Recording, report: RunReport) -> list[FigureSpec]:
    """Return the applicable figures of a run."""
    if not _drawable(recording):
        return []
    focus = worst_segment(report.segments)
    found = (
        None if _is_fault(recording) else plots.hysteresis_loop(recording, focus),
        plots.step_response(recording, focus),
        plots.response(recording, focus),
        plots.steady_cycles(recording, focus),
        plots.error(recording, focus),
        plots.spectrum(recording, focus),
        plots.time_history(recording),
        plots.auxiliary(recording),
        plots.lateness(recording),
    )
    return [sheet for sheet in found if sheet is not None]


def _is_fault(recording: Recording) -> bool:
    return recording.end.get("code") == _FAULT


def _drawable(recording: Recording) -> bool:
    """Return whether matplotlib can scale axes for all signals; it fails near 1e308."""
    samples = recording.samples
    signals = (samples.displacement_um, samples.reference_um, samples.command, samples.aux)
    return not any(np.any(np.abs(signal) > _LARGEST) for signal in signals)


def _segments(report: RunReport) -> list[str]:
    if len(report.segments) < 2:
        return []
    note = html.paragraph("The results above are the worst of these.")
    headings, rows = run_metrics.segment_table(report)
    return ["<h2>By segment</h2>", note, html.grid(headings, rows)]


def _events(events: Sequence[Event]) -> list[str]:
    if not events:
        return []
    rows = [(str(e.sample), e.level, e.code, e.text) for e in events[-_MOST_EVENTS:]]
    left_out = len(events) - len(rows)
    note = [html.paragraph(f"The first {left_out} are omitted.")] if left_out else []
    return ["<h2>Events</h2>", *note, html.grid(("sample", "level", "code", "text"), rows)]


def provenance_rows(recording: Recording) -> list[tuple[str, str]]:
    """Return name and value of the origin of a run: date, labels, device, waveform, model."""
    return [(name, printable(value)) for name, value in _rows(recording) if value]


def _rows(recording: Recording) -> Iterator[tuple[str, str]]:
    run = recording.run
    yield "date", _date(run.get("started", ""))
    for key, value in recording.labels.items():
        yield key, str(value)
    simulated = f" ({run_metrics.SIMULATED})" if run.get("simulated") == "true" else ""
    yield "device", f"{run.get('device', '')}{simulated}"
    yield "device description", run.get("device_description", "")
    yield "computer", ", ".join(filter(None, (run.get("host", ""), run.get("kernel", ""))))
    yield "hilctl", run.get("hilctl", "")
    segments = recording.segments
    more = f" and {len(segments) - 1} more" if len(segments) > 1 else ""
    yield "waveform", f"{segments[0].label}{more}" if segments else ""
    yield "waveform settings", _settings(recording)
    yield "limits", _listed(run.get("limits", ""))
    yield "overrides", _listed(run.get(OVERRIDES_FACT, ""))
    yield from _model(recording)


def _date(started: str) -> str:
    try:
        return datetime.fromisoformat(started).strftime("%Y-%m-%d %H:%M:%S %Z").strip()
    except ValueError:
        return started


def _settings(recording: Recording) -> str:
    found = {
        key.removeprefix(_WAVEFORM): text
        for key, text in recording.run.items()
        if key.startswith(_WAVEFORM) and key not in _NOT_SHOWN and text not in _USUAL
    }
    unit = unit_text(recording.run.get("waveform.unit", ""))
    shown = [f"{key} {text}" for key, text in found.items()]
    return ", ".join([*shown, *([f"unit {unit}"] if unit else [])])


def _listed(text: str) -> str:
    """Return the members of a mapping or list in JSON; any other text as it is."""
    try:
        found = json.loads(text)
    except ValueError:
        return text
    if isinstance(found, dict):
        found = list(_members(found))
    return ", ".join(map(str, found)) if isinstance(found, list) else text


def _members(found: Mapping[str, Any], above: str = "") -> Iterator[str]:
    for key, value in found.items():
        if isinstance(value, dict):
            yield from _members(value, f"{above}{key}.")
        else:
            yield f"{above}{key} {value}"


def _model(recording: Recording) -> Iterator[tuple[str, str]]:
    kind = recording.run.get("compensator", "none")
    if kind == "none":
        yield "compensator", "none: the waveform is the command"
        return
    yield "compensator", f"inverse of a model of kind {kind}"
    if recording.correction_yaml:
        yield "correction", "learned, added to the reference"
        name = f"{recording.path}: correction.yaml"
        for label, text in parse_correction(name, recording.correction_yaml).residual.items():
            yield f"given up for {label}", text
    if recording.coupling_yaml:
        yield "coupling", "crosstalk of the other axes, removed from the reference"
    try:
        model = parse_model(f"{recording.path}: model.yaml", recording.model_yaml)
    except ConfigError:  # of another version
        yield "model", "not readable by this version"
        return
    provenance = model.provenance
    yield "model source", ", ".join(provenance.source)
    yield "model created", _date(provenance.created or "")
    yield "model error", model_error(model)


def model_error(model: HysteresisModel) -> str:
    """Return the error of a model by stroke, or that of whole records if unknown."""
    if by_stroke := model.provenance.errors_by_stroke:
        parts = [f"{quantity(percent, '%')} at {stroke}" for stroke, percent in by_stroke.items()]
        return f"{', '.join(parts)}; exceeded at a tenth of places and frequencies"
    errors = model.provenance.errors_percent
    for prefix, of in (("held_out_", "on held-out data"),
                       ("", "on the data of the fit (no validation data)")):  # fmt: skip
        peak, rms = errors.get(f"{prefix}peak"), errors.get(f"{prefix}rms")
        if peak is not None:
            also = f", {significant(rms)} % rms" if rms is not None else ""
            return f"{quantity(peak, '%')} peak{also}, {of}"
    return "unknown"
