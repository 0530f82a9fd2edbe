"""Compare models: identify and evaluate them on the same loops, try them on the same device."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hilctl.base.errors import InputError
from hilctl.base.files import already_there, check_no_input, exists, make_folder, write_text
from hilctl.base.formatting import shown_briefly
from hilctl.base.yaml import Document
from hilctl.experiment.load import LoadedExperiment, load_experiment, resolve
from hilctl.lab.comparison.simulated_trials import (
    InverseTrial,
    TrialDevice,
    full_stroke,
    inverse_ns,
    waveforms_of,
)
from hilctl.lab.identify.data.cycles import loops_from_pieces
from hilctl.lab.identify.data.records import SteadyLoop
from hilctl.lab.identify.evaluation import Evaluation, judge
from hilctl.lab.identify.fit_api import FitRequest, OnProgress, ignore_progress
from hilctl.lab.identify.fit_data import FitData
from hilctl.lab.identify.fit_model import FittedModel, fit_model
from hilctl.lab.identify.registry import all_fits, fit_named
from hilctl.lab.identify.settings import FitSettings
from hilctl.models.base import HysteresisModel
from hilctl.models.model_file import dump_model, load_model
from hilctl.recording.reader import read
from hilctl.recording.recording import Recording

POINTS = 300
_FILES = (".yaml", ".yml")


def compared_kinds() -> tuple[str, ...]:
    """Return the kinds that are compared by default, the reference first."""
    return tuple(name for name, fit in all_fits().items() if fit.compared is not None)


@dataclass(frozen=True, slots=True)
class ComparedModel:
    """One model of the comparison."""

    name: str
    title: str
    model: HysteresisModel
    numbers: int | None  # number of identified parameters; None for a model file
    identify_s: float | None  # duration of the identification; None for a model file
    error: Evaluation
    inverse_ns: float  # time per sample of its inverse
    trials: tuple[InverseTrial, ...]  # of its inverse; none without a simulated device

    @property
    def compensated_percent(self) -> float | None:
        """Largest compensated error of all trials, in percent of the stroke, or None."""
        errors = [trial.peak_error_percent for trial in self.trials]
        known = [error for error in errors if error is not None]
        return max(known) if known else None


@shown_briefly
@dataclass(frozen=True, slots=True)
class Comparison:
    """A comparison and its data.

    Attributes:
        device: Device of the trials; empty without trials.
    """

    sources: tuple[str, ...]
    device: str
    loops: tuple[SteadyLoop, ...]
    rows: tuple[ComparedModel, ...]

    def to_mapping(self) -> dict[str, Any]:
        """Return plain mappings, lists and numbers for JSON."""
        return {
            "sources": list(self.sources),
            "device": self.device or None,
            "loops": [loop.label for loop in self.loops],
            "models": [_row_mapping(self.loops, row) for row in self.rows],
        }


def _row_mapping(loops: Sequence[SteadyLoop], row: ComparedModel) -> dict[str, Any]:
    errors = zip(loops, row.error.errors, strict=True)
    return {
        "name": row.name,
        "title": row.title,
        "numbers": row.numbers,
        "identify_s": row.identify_s,
        "inverse_ns": row.inverse_ns,
        "peak_percent": row.error.peak_percent,
        "rms_percent": row.error.rms_percent,
        "compensated_peak_percent": row.compensated_percent,
        "loops": [{"frequency_hz": loop.frequency_hz, **asdict(error)} for loop, error in errors],
        "compensated": [asdict(trial) for trial in row.trials],
        "model": row.model.to_mapping(),
    }


def compare(
    recordings: Sequence[Path],
    models: Sequence[str] = (),  # empty for compared_kinds()
    *,
    experiment: Path | None = None,
    settings: Sequence[str] = (),
    frequencies_hz: Sequence[float] | None = None,
    points: int = POINTS,
    clock: Callable[[], float] = time.perf_counter,
    progress: OnProgress = ignore_progress,
) -> Comparison:
    """Identify each model on the loops, evaluate it, and try its inverse on the device.

    The arguments are those of :func:`hilctl.api.compare`. Without an experiment, a trial is a sine
    over nearly the complete stroke. Without frequencies, a waveform other than sine and triangle
    is unchanged. The clock returns the time in s.
    """
    names = tuple(models) or compared_kinds()
    for name in names:
        if not name.endswith(_FILES):
            fit_named(name)
    recorded = [read(path) for path in recordings]
    units = {recording.command_unit for recording in recorded}
    if len(units) != 1:
        raise InputError("recordings in A and in V cannot be combined")
    loops = [loop for recording in recorded for loop in loops_from_pieces([recording], points)]
    data = FitData(loops, units.pop())
    sources = tuple(path.name for path in recordings)
    device = _device(experiment, settings, frequencies_hz, recorded[0], data)
    rows: list[ComparedModel] = []
    for i, name in enumerate(names):

        def tell(part: float, text: str, i: int = i, name: str = name) -> None:
            progress((i + part) / len(names), f"{name}: {text}")

        rows.append(_row(name, data, sources, recorded[0].sample_rate_hz, device, clock, tell))
    progress(1.0, "done")
    return Comparison(sources, device.description if device else "", data.loops, tuple(rows))


def _row(
    name: str,
    data: FitData,
    sources: Sequence[str],
    rate_hz: float,
    device: TrialDevice | None,
    clock: Callable[[], float],
    tell: OnProgress,
) -> ComparedModel:
    tell(0.0, "identify")
    found: FittedModel | None = None
    begin = clock()
    if name.endswith(_FILES):
        model, title = load_model(Path(name)), "model file"
        if model.input_unit != data.unit:
            raise InputError(f"{name}: must have commands in {data.unit}, the unit of the loops")
    else:
        known = fit_named(name)
        settings = FitSettings(kind=name, **(known.compared or {}))
        found = fit_model(FitRequest(data.records, settings, unit=data.unit, source=sources))
        model, title = found.model, known.title
    elapsed_s = clock() - begin
    tell(0.4, "evaluate")
    fastest = max(data.loops, key=lambda loop: loop.frequency_hz)
    return ComparedModel(
        name=name if found else Path(name).name,
        title=title,
        model=model,
        numbers=found.numbers if found else None,
        identify_s=elapsed_s if found else None,
        error=found or judge(model, data),
        inverse_ns=inverse_ns(model, fastest, rate_hz, clock),
        trials=tuple(_trials(device, model, tell)) if device else (),
    )


def _trials(
    device: TrialDevice, model: HysteresisModel, tell: OnProgress
) -> Iterator[InverseTrial]:
    for k, reference in enumerate(device.references):
        tell(0.5 + 0.5 * k / len(device.references), f"try {reference.segments[0].label}")
        yield from device.run(model, reference)


def _device(
    experiment: Path | None,
    settings: Sequence[str],
    frequencies: Sequence[float] | None,
    recording: Recording,
    data: FitData,
) -> TrialDevice | None:
    """Return the device of the trials; None if the recording has a real device."""
    if experiment is not None:
        loaded = load_experiment(experiment, settings)
        waveform = loaded.config.waveform
        if frequencies is None and waveform.kind in ("sine", "triangle"):
            frequencies = _frequencies_hz(data.loops)
        return TrialDevice(loaded, waveforms_of(waveform, frequencies))
    recorded = _recorded(recording, settings)
    if recorded is None:
        return None
    waveforms = waveforms_of(full_stroke(data.loops), frequencies or _frequencies_hz(data.loops))
    return TrialDevice(recorded, waveforms)


def _frequencies_hz(loops: Sequence[SteadyLoop]) -> list[float]:
    """Return the lowest, the middle and the highest frequency of loops, without duplicates."""
    known = sorted({float(f"{loop.frequency_hz:.4g}") for loop in loops})
    return sorted({known[0], known[len(known) // 2], known[-1]})


def _recorded(recording: Recording, settings: Sequence[str]) -> LoadedExperiment | None:
    """Return the experiment of a recording without its compensator; None for a real device."""
    if not recording.experiment_yaml or recording.run.get("simulated") == "false":
        return None
    document = Document(f"{recording.path} (experiment)", recording.experiment_yaml)
    hold = f"{{kind: hold, unit: {recording.command_unit}, level: 0.0, duration_s: 1.0}}"
    # The timing may have keys of earlier releases.
    plain = ("compensator=none", "feedback=null", "timing={}", f"waveform={hold}")
    return resolve(document, recording.path.parent, (*plain, *settings))


def check_free(
    names: Sequence[str], folder: Path, *, overwrite: bool, inputs: Sequence[Path] = ()
) -> None:
    """Raise InputError if a folder contains a file of one of these models, unless ``overwrite``.

    Input files are never replaced.
    """
    paths = [folder / f"{name}.yaml" for name in names]
    for path in paths:
        check_no_input(path, inputs)
    taken = [path for path in paths if exists(path)]
    if taken and not overwrite:
        raise already_there(taken[0], "choose another folder to save, or overwrite")


def save_models(comparison: Comparison, folder: Path, *, created: str, overwrite: bool) -> None:
    """Write each identified model to ``folder/NAME.yaml``.

    Models from files are skipped; ``created`` is an ISO 8601 date and time in UTC, for the
    provenance. Raise InputError if a file exists, and write nothing, or if the folder is not
    writable.
    """
    rows = [row for row in comparison.rows if row.identify_s is not None]
    check_free([row.name for row in rows], folder, overwrite=overwrite)
    make_folder(folder)
    for row in rows:
        provenance = row.model.provenance.model_copy(update={"created": created})
        model = row.model.model_copy(update={"provenance": provenance})
        write_text(folder / f"{row.name}.yaml", dump_model(model), overwrite=overwrite)


def headings(comparison: Comparison) -> list[str]:
    """Return the names of the columns."""
    trials = max((row.trials for row in comparison.rows), key=len, default=())
    names = [f"{trial.frequency_hz:.4g} Hz" for trial in trials]
    return ["model", "par.", "fit s", "ns", "peak %", *names]


def table_rows(comparison: Comparison) -> Iterator[list[str]]:
    """Return the texts of each row, in the requested order."""
    for row in comparison.rows:
        figures = [
            row.name,
            "-" if row.numbers is None else str(row.numbers),
            "-" if row.identify_s is None else f"{row.identify_s:.2f}",
            f"{row.inverse_ns:.0f}",
            f"{row.error.peak_percent:.2f}",
        ]
        yield [*figures, *(_trial_text(trial) for trial in row.trials)]


def _trial_text(trial: InverseTrial) -> str:
    if trial.peak_error_percent is None:
        return "-"
    return f"{trial.peak_error_percent:.2f}{'*' if trial.limited_samples else ''}"


def notes(comparison: Comparison) -> list[str]:
    """Return the notes of the table."""
    found = [
        "par.: identified parameters; fit s: duration; ns: inverse per sample",
        "peak %: model error on all loops, in percent of the largest peak-to-peak",
    ]
    if not comparison.device:
        return [*found, "compensated errors: not available, because the device is not simulated"]
    found.append(
        "Hz: largest compensated error at that frequency, in percent of the stroke; "
        f"{comparison.device}"
    )
    limited = any(trial.limited_samples for row in comparison.rows for trial in row.trials)
    return [*found, "*: the limiter changed evaluated commands"] if limited else found
