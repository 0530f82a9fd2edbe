"""Metadata of a run: for its recording, metrics of its end, and its description for watchers."""

import hashlib
import json
import math
import platform
import sys
import uuid
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from hilctl import __version__
from hilctl.base.axes import RUN_KEYS
from hilctl.base.device import AuxChannel, DeviceInfo
from hilctl.base.errors import RunError
from hilctl.base.events import CHANGES, Event
from hilctl.base.samples import COLUMNS, NO_WAVEFORM, Flag, Samples
from hilctl.base.segments import Segment
from hilctl.base.strict import StrictModel
from hilctl.base.yaml import dump
from hilctl.loop.pacer import Lateness
from hilctl.loop.safe_output import LoopOutcome
from hilctl.machine.diagnosis import machine_facts
from hilctl.machine.procfs import ProcessUsage
from hilctl.recording.metadata_keys import (
    AUX_FACT,
    AXES_FACT,
    AXIS_FACT,
    END_FIGURES,
    HEAT_FACT,
    HOLDS_FACT,
    LABELS_FACT,
    OVERRIDES_FACT,
    USAGE_FACT,
)
from hilctl.signals.segment_metrics import SegmentMetrics

if TYPE_CHECKING:
    from hilctl.experiment.load import LoadedExperiment
    from hilctl.experiment.preflight import CheckedExperiment

_LEFT_OUT = NO_WAVEFORM | Flag.SENSOR_INVALID


def run_facts(
    checked: "CheckedExperiment",
    started: str,
    model_yaml: str,
    correction_yaml: str = "",
    coupling_yaml: str = "",
    *,
    run_id: str = "",
    axes: Sequence[str] = (),
) -> dict[str, str]:
    """Return identity, versions, device and units as text; rates are in the layout.

    ``run_id`` is new if empty; ``axes`` are the names of all axes, without names if there is one.
    """
    loaded = checked.loaded
    config, info = loaded.config, loaded.device.info
    recorded = [column.field(info.command_unit) for column in COLUMNS.values()]
    facts = {
        "run_id": run_id or str(uuid.uuid4()),
        "name": config.name,
        "description": config.description,
        LABELS_FACT: json.dumps(config.labels, ensure_ascii=False),
        OVERRIDES_FACT: json.dumps(loaded.document.assignments, ensure_ascii=False),
        "started": started,
        "block": str(config.block),
        "waveform_samples": str(checked.forecast.samples),
        "compensator": getattr(loaded.model, "kind", "none"),
        "initial_state": checked.begun.begins,
        "initial_state_run_id": checked.begun.run_id,
        "experiment_sha256": experiment_sha256(loaded),
        "model_sha256": sha256_of(model_yaml),
        "correction_sha256": sha256_of(correction_yaml),
        "coupling_sha256": sha256_of(coupling_yaml),
        HEAT_FACT: repr(checked.heat_a2),
        "limits": config.limits.model_dump_json(exclude_none=True),
        "safe_value": repr(config.safe.value),
        "max_missed_share": repr(config.timing.max_missed_share),
        "units": json.dumps({"t_rel": "s"} | {each.name: each.unit for each in recorded}),
    }
    facts |= {
        f"waveform.{key}": str(value)
        for key, value in config.waveform
        if isinstance(value, str | int | float)
    }
    if loaded.axis:
        facts |= {AXIS_FACT: loaded.axis, AXES_FACT: json.dumps(list(axes))}
    return (
        facts
        | _software_facts()
        | machine_facts(Path(config.recording.folder))
        | _device_facts(info)
    )


def _software_facts() -> dict[str, str]:
    return {
        "hilctl": __version__,
        "python": sys.version.split()[0],
        "numpy": np.__version__,
        "numba": version("numba"),
        "host": platform.node(),
        "kernel": f"{platform.system()} {platform.release()} {platform.machine()}",
    }


def _device_facts(info: DeviceInfo) -> dict[str, str]:
    facts = {
        "device": info.name,
        "device_description": info.description,
        "simulated": str(info.simulated).lower(),
        "buffered": str(info.buffered).lower(),
        "fifo_depth": str(info.fifo_depth),
        "latency_blocks": str(info.latency_blocks),
        HOLDS_FACT: json.dumps(list(info.holds)),
    }
    if info.aux:
        facts[AUX_FACT] = json.dumps([asdict(each) for each in info.aux], ensure_ascii=False)
    facts |= {f"device.{key}": value for key, value in info.details.items()}
    return facts | {
        f"device.{name.removesuffix('.yaml')}_sha256": sha256_of(text)
        for name, text in info.files.items()
    }


def experiment_sha256(loaded: "LoadedExperiment") -> str:
    """Return the SHA-256 of an experiment without its labels and its device's timeout.

    It identifies completed runs, which neither of them changes.
    """
    data = {key: value for key, value in loaded.document.data.items() if key != LABELS_FACT}
    data["device"] = {key: value for key, value in data["device"].items() if key != "timeout_s"}
    return sha256_of(dump(data))


def sha256_of(text: str) -> str:
    """Return the SHA-256 of a text; empty for an empty text."""
    return hashlib.sha256(text.encode()).hexdigest() if text else ""


def end_facts(
    outcome: LoopOutcome, counters: Lateness, dropped: int = 0, lost_events: int = 0
) -> dict[str, str]:
    """Return the outcome of a run and its counters as text.

    ``dropped`` samples of the axis were exchanged but not recorded because its ring was full.
    """
    return {
        "code": outcome.code,
        "reason": outcome.reason,
        "output_safe": str(outcome.safe).lower(),
        "output_state": outcome.output,
        "late_ticks": str(counters.late_ticks),
        "skipped_ticks": str(counters.skipped_ticks),
        "worst_late_ns": str(counters.worst_ns),
        "worst_late_tick": str(counters.worst_tick),
        "longest_late_run": str(counters.longest_run),
        "mean_wake_ns": str(counters.mean_wake_ns),
        "dropped_in_ring": str(dropped),
        "lost_events": str(lost_events),
    }


def usage_facts(loop: ProcessUsage | None, supervisor: ProcessUsage) -> dict[str, str]:
    """Return the resource usage of a run as text."""
    known = {"loop": loop, "supervisor": supervisor}
    return {USAGE_FACT: json.dumps({name: asdict(each) for name, each in known.items() if each})}


class SettingRow(StrictModel):
    """A dotted key of the experiment; ``--set`` can change it if it is settable."""

    key: str
    value: str
    settable: bool


class LimitBounds(StrictModel):
    """Limits of limiter and interlocks; None: no limit."""

    command: list[float]
    slew_per_s: float
    stroke_um: list[float]
    rms_current_a: float | None
    thermal_time_constant_s: float | None
    heat_a2: float  # heat of the coil before the run, in A^2
    tracking_error_um: float | None  # difference of displacement and reference
    measured_deviation: float | None  # difference of command and measured command
    late_s: float


class AuxBounds(StrictModel):
    """An auxiliary channel and its limits; None: no limit."""

    name: str
    unit: str
    low: float | None
    high: float | None


class RunDescription(StrictModel):
    """Description of a run for watchers."""

    name: str
    text: str
    device: str
    simulated: bool
    sample_rate_hz: float
    block: int
    command_unit: str
    measures_command: bool
    waveform_unit: str
    compensator: str
    coupled: bool  # whether only all axes can be changed, because each depends on all references
    samples: int
    segments: list[Segment]  # from the waveform's first sample
    limits: LimitBounds
    aux: list[AuxBounds]
    settings: list[SettingRow]

    @classmethod
    def of(cls, checked: "CheckedExperiment") -> Self:
        """Return the description of a checked experiment."""
        loaded, reference = checked.loaded, checked.reference
        config, info = loaded.config, loaded.device.info
        data = loaded.document.data
        if loaded.axis:
            own = {key: data[key] for key in data if key not in RUN_KEYS}
            data = {key: data[key] for key in data if key in RUN_KEYS}
            data["axes"] = {loaded.axis: own}
        return cls(
            name=config.name,
            text=config.description,
            device=info.description,
            simulated=info.simulated,
            sample_rate_hz=config.sample_rate_hz,
            block=config.block,
            command_unit=info.command_unit,
            measures_command=info.measures_command,
            waveform_unit=reference.unit,
            compensator=str(getattr(loaded.model, "kind", "")),
            coupled=loaded.coupling is not None,
            samples=int(reference.values.size),
            segments=list(reference.segments),
            limits=_limits(checked),
            aux=[
                AuxBounds(
                    name=each.channel.name,
                    unit=each.channel.unit,
                    low=each.low if math.isfinite(each.low) else None,
                    high=each.high if math.isfinite(each.high) else None,
                )
                for each in loaded.rig.aux
            ],
            settings=setting_rows(data),
        )

    def segments_at(self, waveform_at: int) -> list[Segment]:
        """Return the segments of a run whose waveform begins at sample ``waveform_at``."""
        return [each.shifted(waveform_at) for each in self.segments]

    def write(self, path: Path) -> None:
        """Write the description as JSON."""
        try:
            path.write_text(self.model_dump_json(), encoding="utf-8")
        except OSError as error:
            raise RunError(f"{path}: no memory: {error.strerror}") from None

    @classmethod
    def read(cls, path: Path) -> Self:
        """Return the description that :meth:`write` wrote."""
        return cls.model_validate_json(path.read_bytes())


def _limits(checked: "CheckedExperiment") -> LimitBounds:
    config, interlocks = checked.loaded.config, checked.loaded.rig.interlocks
    limits = config.limits
    return LimitBounds(
        command=list(limits.command_range),
        slew_per_s=limits.slew_per_s,
        stroke_um=list(limits.stroke_um),
        rms_current_a=limits.rms_current_a,
        thermal_time_constant_s=limits.thermal_time_constant_s,
        heat_a2=checked.heat_a2,
        tracking_error_um=interlocks.tracking_error_um,
        measured_deviation=limits.measured_deviation,
        late_s=config.timing.max_late_s,
    )


def setting_rows(value: Any, key: str = "") -> list[SettingRow]:
    """Return the keys of an experiment in order; a sequence counts as one value."""
    if isinstance(value, dict):
        inner = (setting_rows(each, f"{key}.{name}".strip(".")) for name, each in value.items())
        return [row for rows in inner for row in rows]
    if not isinstance(value, tuple | list):
        return [SettingRow(key=key, value=str(value), settable=True)]
    parts = any(isinstance(each, dict | tuple) for each in value)
    text = f"{len(value)} entries" if parts else str(list(value))
    return [SettingRow(key=key, value=text, settable=not parts)]


class EndFigures:
    """Collect the metrics of a run."""

    def __init__(
        self, segments: Sequence[Segment], *, compensated: bool, aux: Sequence[AuxChannel] = ()
    ) -> None:
        self._segments = list(segments)
        self._compensated = compensated
        self._aux = aux
        self._aux_low, self._aux_high = np.full((2, len(aux)), np.nan)
        self._done: list[tuple[Segment, dict[str, float]]] = []
        self._changes: list[Event] = []
        self._current: SegmentMetrics | None = None

    def add(self, samples: Samples) -> None:
        """Add the next samples of the run."""
        if self._aux:
            self._aux_low = np.fmin(self._aux_low, np.fmin.reduce(samples.aux))
            self._aux_high = np.fmax(self._aux_high, np.fmax.reduce(samples.aux))
        index = samples.index[(samples.flags & NO_WAVEFORM) == 0]
        while self._segments and index.size and self._segments[0].steady_start <= index[-1]:
            segment = self._segments[0]
            start, stop, cycles = segment.steady_cycles()
            self._current = self._current or SegmentMetrics(
                segment, averaged=cycles > 0, compensated=self._compensated
            )
            part = samples.part(start, stop)
            part = part.rows((part.flags & _LEFT_OUT) == 0)
            loop_input = part.reference_um if self._compensated else part.command
            self._current.add(part.index, np.array((loop_input, part.displacement_um)))
            if index[-1] + 1 < segment.steady_stop:
                return
            self._done.append((segment, self._current.metrics()))
            self._current = None
            del self._segments[0]

    def event(self, event: Event) -> None:
        """Add an event of the run."""
        if event.code in CHANGES:
            self._changes.append(event)

    def facts(self) -> dict[str, str]:
        """Return the maximum of each metric over all segments, and the ranges of aux, as text."""
        judged = [figures for segment, figures in self._done if not self._tuned(segment)]
        known = {name: [each[name] for each in judged if name in each] for name in END_FIGURES}
        ends = {"min": self._aux_low.tolist(), "max": self._aux_high.tolist()}
        found = {name: repr(max(values)) for name, values in known.items() if values}
        return found | {
            f"{AUX_FACT}.{each.name}.{end}": repr(values[k])
            for k, each in enumerate(self._aux)
            for end, values in ends.items()
            if math.isfinite(values[k])
        }

    def _tuned(self, segment: Segment) -> bool:
        """Return whether a change of the reference affects the steady part of a segment."""
        changes = [each for each in self._changes if each.sample < segment.steady_stop]
        return bool(changes) and (
            changes[-1].sample + changes[-1].values["samples"] > segment.steady_start
        )
