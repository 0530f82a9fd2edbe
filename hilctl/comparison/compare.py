"""Models found on the same loops, judged on them, and tried before the same device."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from hilctl.base.errors import InputError
from hilctl.base.yaml.document import Document
from hilctl.comparison.catalogue import CATALOGUE, entry
from hilctl.comparison.data import Fitted, Frame, read_loops
from hilctl.comparison.judging import ModelError, inverse_ns, model_error
from hilctl.comparison.trials import Bench, Trial, full_stroke, waveforms_of
from hilctl.experiment.load import LoadedExperiment, load_experiment, resolve
from hilctl.identify.data import Loop
from hilctl.models.base import HysteresisModel
from hilctl.models.files import load_model
from hilctl.recording.data import Recording
from hilctl.recording.reader import read

Progress: TypeAlias = Callable[[float, str], None]
"""Called with the part that is done (0 to 1) and what is being done."""

FREQUENCIES_HZ = (10.0, 100.0, 200.0)
POINTS = 300
_FILES = (".yaml", ".yml")


@dataclass(frozen=True, slots=True)
class Request:
    """What to compare.

    Attributes:
        recordings: Recordings that hold the loops.
        models: Names of the catalogue, or model files; all of the catalogue where empty.
        experiment: Experiment that gives device, limits and waveform of the trials; where None,
            device and limits are those of the first recording and the waveform is a sine over
            nearly the whole stroke.
        settings: ``key=value`` texts over the experiment.
        frequencies_hz: Frequencies of the trials; where None, 10, 100 and 200 Hz for a sine or a
            triangle, otherwise the waveform as it is.
        points: Points a loop.
    """

    recordings: Sequence[Path]
    models: Sequence[str] = ()
    experiment: Path | None = None
    settings: Sequence[str] = ()
    frequencies_hz: Sequence[float] | None = None
    points: int = POINTS


@dataclass(frozen=True, slots=True)
class Row:
    """One model of the comparison.

    Attributes:
        name: Name in the catalogue, or of the model file.
        title: What it is, for people.
        model: The model.
        parameters: Numbers that were found for it; None for a model file.
        identify_s: Time that took; None for a model file.
        error: How far it is from the loops.
        inverse_ns: Time that one sample of its inverse takes.
        trials: What came of its inverse before the device; none without a simulated device.
    """

    name: str
    title: str
    model: HysteresisModel
    parameters: int | None
    identify_s: float | None
    error: ModelError
    inverse_ns: float
    trials: tuple[Trial, ...]

    @property
    def compensated_percent(self) -> float | None:
        """Largest compensated error of all trials, in percent of the stroke; None without any."""
        errors = [trial.peak_error_percent for trial in self.trials]
        known = [error for error in errors if error is not None]
        return max(known) if known else None


@dataclass(frozen=True, slots=True)
class Comparison:
    """All rows, and what they stand on.

    Attributes:
        sources: Names of the recordings.
        device: Device of the trials; empty where there were none.
        loops: The measured loops.
        rows: One for each model, in the order asked for.
    """

    sources: tuple[str, ...]
    device: str
    loops: tuple[Loop, ...]
    rows: tuple[Row, ...]

    def to_mapping(self) -> dict[str, Any]:
        """Return all of it as plain mappings, lists and numbers, for JSON."""
        return {
            "sources": list(self.sources),
            "device": self.device or None,
            "loops": [loop.label for loop in self.loops],
            "models": [_row_mapping(row) for row in self.rows],
        }


def _row_mapping(row: Row) -> dict[str, Any]:
    loops = [
        {
            "label": loop.label,
            "frequency_hz": loop.frequency_hz,
            "peak_to_peak_um": loop.peak_to_peak_um,
            "peak_percent": loop.peak_percent,
            "rms_percent": loop.rms_percent,
        }
        for loop in row.error.loops
    ]
    trials = [{key: getattr(trial, key) for key in Trial.__slots__} for trial in row.trials]
    return {
        "name": row.name,
        "title": row.title,
        "parameters": row.parameters,
        "identify_s": row.identify_s,
        "inverse_ns": row.inverse_ns,
        "peak_percent": row.error.peak_percent,
        "rms_percent": row.error.rms_percent,
        "compensated_peak_percent": row.compensated_percent,
        "loops": loops,
        "compensated": trials,
        "model": {"kind": getattr(row.model, "kind"), **row.model.to_mapping()},  # noqa: B009
    }


def compare(request: Request, clock: Callable[[], float], progress: Progress) -> Comparison:
    """Find each model on the loops, judge it on them, and try its inverse before the device.

    Args:
        request: What to compare.
        clock: Time in s, for what is measured.
        progress: Told of what is being done.

    Raises:
        InputError: Something asked for can't be used.
    """
    names = tuple(request.models) or tuple(CATALOGUE)
    for name in names:
        if not name.endswith(_FILES):
            entry(name)
    recordings = [read(path) for path in request.recordings]
    loops, unit = read_loops(recordings, request.points)
    frame = Frame(loops, unit)
    bench = _bench(request, recordings[0], frame)
    rows: list[Row] = []
    for i, name in enumerate(names):

        def tell(part: float, text: str, i: int = i, name: str = name) -> None:
            progress((i + part) / len(names), f"{name}: {text}")

        rows.append(_row(name, frame, recordings[0].sample_rate_hz, bench, clock, tell))
    progress(1.0, "done")
    sources = tuple(path.name for path in request.recordings)
    return Comparison(sources, bench.device if bench else "", frame.loops, tuple(rows))


def _row(
    name: str,
    frame: Frame,
    rate_hz: float,
    bench: Bench | None,
    clock: Callable[[], float],
    tell: Progress,
) -> Row:
    tell(0.0, "identified")
    begin = clock()
    from_file = name.endswith(_FILES)
    found = Fitted(load_model(Path(name)), 0) if from_file else entry(name).fit(frame)
    identify_s = clock() - begin
    model = found.model
    if model.input_unit != frame.unit:
        raise InputError(f"{name}: must take commands in {frame.unit}, as the loops do")
    tell(0.4, "judged")
    error = model_error(model, frame.loops)
    fastest = max(frame.loops, key=lambda loop: loop.frequency_hz)
    took_ns = inverse_ns(model, fastest, rate_hz, clock)
    return Row(
        name=Path(name).name if from_file else name,
        title="model file" if from_file else entry(name).title,
        model=model,
        parameters=None if from_file else found.parameters,
        identify_s=None if from_file else identify_s,
        error=error,
        inverse_ns=took_ns,
        trials=tuple(_trials(bench, model, tell)) if bench else (),
    )


def _trials(bench: Bench, model: HysteresisModel, tell: Progress) -> Iterator[Trial]:
    for k, reference in enumerate(bench.references):
        tell(0.5 + 0.5 * k / len(bench.references), f"tried, {reference.segments[0].label}")
        yield from bench.try_out(model, reference)


def _bench(request: Request, recording: Recording, frame: Frame) -> Bench | None:
    """Return where inverses are tried; None where the recording's own device is a real one."""
    frequencies = request.frequencies_hz
    if request.experiment is not None:
        loaded = load_experiment(request.experiment, request.settings)
        waveform = loaded.config.waveform
        if frequencies is None and waveform.kind in ("sine", "triangle"):
            frequencies = FREQUENCIES_HZ
        return Bench(loaded, waveforms_of(waveform, frequencies), loaded.folder)
    recorded = _recorded(recording, request.settings)
    if recorded is None:
        return None
    waveforms = waveforms_of(full_stroke(frame.loops), frequencies or FREQUENCIES_HZ)
    return Bench(recorded, waveforms, recorded.folder)


def _recorded(recording: Recording, settings: Sequence[str]) -> LoadedExperiment | None:
    """Return device and limits that a recording was made with; None of a real device.

    Its waveform and its compensator, whose file may be elsewhere, are of no use here.
    """
    if not recording.experiment_yaml or recording.run.get("simulated") == "false":
        return None
    document = Document(f"{recording.path} (experiment)", recording.experiment_yaml)
    hold = f"{{kind: hold, unit: {recording.command_unit}, level: 0.0, duration_s: 1.0}}"
    plain = ("compensator=none", f"waveform={hold}")
    return resolve(document, recording.path.parent, (*plain, *settings))
