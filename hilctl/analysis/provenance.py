"""Where a recording comes from: when, by whom, with what, and what was wanted; rows for people."""

import json
from collections.abc import Iterator
from datetime import datetime

from hilctl.base.errors import ConfigError
from hilctl.base.formatting import printable, quantity, significant
from hilctl.models.base import HysteresisModel
from hilctl.models.model_file import parse_model
from hilctl.recording.metadata_keys import OVERRIDES_FACT
from hilctl.recording.recording import Recording

FAULT = "fault"
_WAVEFORM = "waveform."
_NOT_SHOWN = {"waveform.kind", "waveform.unit"}
_USUAL = {"0.0", "None", ""}


def provenance_rows(recording: Recording) -> list[tuple[str, str]]:
    """Return name and value of what a run was: date, labels, device, waveform, settings, model."""
    return [(name, printable(value)) for name, value in _rows(recording) if value]


def _rows(recording: Recording) -> Iterator[tuple[str, str]]:
    run = recording.run
    yield "date", _date(run.get("started", ""))
    for key, value in recording.labels.items():
        yield key, str(value)
    simulated = " (simulated: no hardware was driven)" if run.get("simulated") == "true" else ""
    yield "device", f"{run.get('device', '')}{simulated}"
    yield "device is", run.get("device_description", "")
    computer = ", ".join(filter(None, (run.get("host", ""), run.get("kernel", ""))))
    yield "computer", computer
    yield "hilctl", run.get("hilctl", "")
    segments = recording.segments
    more = f" and {len(segments) - 1} more" if len(segments) > 1 else ""
    yield "waveform", f"{segments[0].label}{more}" if segments else ""
    yield "its settings", _settings(recording)
    yield "limits", _limits(run.get("limits", ""))
    yield "overrides", _overrides(run.get(OVERRIDES_FACT, ""))
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
    unit = recording.run.get("waveform.unit", "")
    shown = [f"{key} {text}" for key, text in found.items()]
    return ", ".join([*shown, *([f"unit {unit}"] if unit else [])])


def _limits(text: str) -> str:
    try:
        limits = json.loads(text or "{}")
    except ValueError:
        return text
    if not isinstance(limits, dict):
        return text
    return ", ".join(f"{key} {value}" for key, value in limits.items())


def _overrides(text: str) -> str:
    try:
        settings = json.loads(text or "[]")
    except ValueError:
        return text
    return ", ".join(map(str, settings)) if isinstance(settings, list) else text


def _model(recording: Recording) -> Iterator[tuple[str, str]]:
    kind = recording.run.get("compensator", "none")
    if kind == "none":
        yield "compensator", "none: the waveform goes straight to the actuator"
        return
    yield "compensator", f"inverse of a model of kind {kind}"
    if recording.correction_yaml:
        yield "correction", "learned, and added to the reference"
    try:
        model = parse_model(f"{recording.path}: model.yaml", recording.model_yaml)
    except ConfigError:  # of another version
        yield "model", "can't be read by this version"
        return
    provenance = model.provenance
    yield "model from", ", ".join(provenance.source)
    yield "model made", _date(provenance.created or "")
    yield "model error", model_error(model)


def model_error(model: HysteresisModel) -> str:
    """Return how far a model is from data: from those that its fit did not see, where known."""
    errors = model.provenance.errors_percent
    for prefix, of in (("held_out_", "on held-out data"),
                       ("", "on the data of the fit; on others it is not known")):  # fmt: skip
        peak, rms = errors.get(f"{prefix}peak"), errors.get(f"{prefix}rms")
        if peak is not None:
            also = f", {significant(rms)} % rms" if rms is not None else ""
            return f"{quantity(peak, '%')} peak{also}, {of}"
    return "not known"
