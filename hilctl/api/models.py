"""Identify, refine, compare, load and export models."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path

from hilctl.api._types import PathLike, Paths, experiment_path, path_or_none, paths_of
from hilctl.base.errors import DataError, InputError
from hilctl.base.files import check_no_input, check_writable, write_text
from hilctl.base.formatting import shown_briefly
from hilctl.base.types import CommandUnit
from hilctl.base.yaml import Settings, texts_of
from hilctl.experiment.load import inputs_of
from hilctl.lab.comparison import compare as library
from hilctl.lab.comparison.compare import Comparison
from hilctl.lab.identify.data.data_files import load_records
from hilctl.lab.identify.data.records import SteadyLoop
from hilctl.lab.identify.fit_api import FitRequest, OnProgress
from hilctl.lab.identify.model_selection import choose_lag
from hilctl.lab.identify.parallel import MapFunction, workers
from hilctl.lab.identify.pipeline import (
    Identification,
    as_recorded,
    as_run,
    identify_records,
    settings_from,
)
from hilctl.lab.identify.refinement import Refinement, refine_records
from hilctl.lab.identify.settings import IdentifySettings
from hilctl.lab.model_export.model_export import check_rate, export_text
from hilctl.models.base import HysteresisModel, IdentifiedRange, Operator
from hilctl.models.model_file import dump_model
from hilctl.models.model_file import load_model as read_model
from hilctl.run.control.client import finish_dead_runs


def identify(
    files: Paths,
    output: PathLike | None = None,
    *,
    model: str = "auto",
    settings: Settings = (),
    validate: Paths = (),
    scheduler: str | None = None,
    overwrite: bool = False,
    on_progress: Callable[[float, str], None] = lambda done, text: None,
) -> Identification:
    """Identify a model's parameters from recordings or measured tables.

    Args:
        files: Recordings (MCAP) and text tables.
        output: Model file to write; not written if the verdict is "not a model".
        model: Kind of model, or ``auto`` for the kind with the smallest validation error.
        settings: Settings of the fit, see ``hilctl identify --settings``.
        validate: Files to validate the model with; default: parts of the other files.
        scheduler: ``none``, ``threads``, ``processes``, or a Dask scheduler address for independent
            fits; default: ``threads`` for ``auto``, otherwise ``none``.
        overwrite: Replace an existing model file.
        on_progress: Called with the fraction done (0 to 1) and the current step.

    Returns:
        The model, its errors (validation first) and verdict: good, usable, poor, or not a model.

    Raises:
        InputError: A file or a setting is invalid; nothing is written.
    """
    paths, others = paths_of(files), paths_of(validate)
    chosen = settings_from(model, texts_of(settings))
    if output is not None:
        check_writable(Path(output), overwrite=overwrite, inputs=[*paths, *others])
    with workers(scheduler or ("threads" if model == "auto" else "none")) as run:
        lag = chosen.table.lag_samples
        if chosen.table.find_lag:
            lag = choose_lag(
                lambda lag: load_records(paths, chosen, lag).records, chosen, run, on_progress
            )
        request, understood = _request(paths, others, chosen, lag, run, on_progress)
        found = identify_records(request)
    if chosen.table.find_lag:
        recorded, _ = _request(paths, others, chosen, 0, map, on_progress)
        found = as_recorded(found, recorded, lag)
    if not chosen.whole:
        found = _as_run(found, paths, chosen)
    if output is not None and found.verdict.grade != "not a model":
        write_text(Path(output), dump_model(found.fit.model), overwrite=overwrite)
    return replace(found, lag_samples=lag, understood=understood)


MOST_SAMPLES = 10_000_000
"""Maximum samples of recordings that are evaluated as a whole beside their loops."""


def _as_run(
    found: Identification, paths: Sequence[Path], settings: IdentifySettings
) -> Identification:
    """Return an identification with the verdict on whole recordings too, or a note why not."""
    recordings = [path for path in paths if path.suffix.lower() == ".mcap"]
    loops = [each for each in found.data if isinstance(each, SteadyLoop)]
    if not recordings or not loops:
        return found
    longest = max(loop.start_s * loop.sample_rate_hz for loop in loops)
    reason = "some loops are omitted" if settings.leave_out else ""
    if longest * len(recordings) > MOST_SAMPLES:
        reason = f"the recordings have more than {MOST_SAMPLES:,} samples"
    if not reason:
        whole = settings.model_copy(update={"whole": True})
        try:
            return as_run(found, load_records(recordings, whole, 0).records, settings)
        except DataError as error:
            reason = str(error)
    note = f"only steady cycles were evaluated, not the motion from rest to them: {reason}"
    verdict = replace(found.verdict, notes=(*found.verdict.notes, note))
    return replace(found, verdict=verdict)


def _request(
    paths: Sequence[Path],
    validate: Sequence[Path],
    settings: IdentifySettings,
    lag_samples: int,
    run: MapFunction,
    on_progress: OnProgress,
) -> tuple[FitRequest, tuple[str, ...]]:
    """Return a fit to files, and how their tables were read."""
    loaded, unit = load_records(paths, settings, lag_samples), settings.table.unit
    if loaded.unit and unit and loaded.unit != unit:
        raise InputError(f"the unit must be {loaded.unit}, that of the files (got {unit})")
    every = settings.model_copy(update={"leave_out": ()})
    held_out = load_records(validate, every, lag_samples).records
    request = FitRequest(
        loaded.records, settings, settings.unit(loaded.unit), [path.name for path in paths],
        run, on_progress, validate=held_out,
    )  # fmt: skip
    return request, tuple(loaded.understood)


@shown_briefly
@dataclass(frozen=True)
class LoadedModel:
    """A model at a sample rate.

    ``forward`` and ``inverse`` are streaming operators (:class:`hilctl.models.base.Operator`): a
    call processes the next block of a signal, ``state()`` and ``restore()`` copy the state, and
    ``reset()`` starts again from rest. Each output of ``inverse`` belongs to the reference
    ``inverse.preview`` samples before.

    Attributes:
        model: Parameters and provenance; ``model.to_mapping()`` returns them as plain values.
        sample_rate_hz: Samples per second.
        input_unit: Unit of the command, A or V.
        input_range: Lowest and highest command the model was identified on; None if unknown.
        output_range_um: Lowest and highest displacement.
        identified_range: Amplitudes, frequencies and speed of the data.
    """

    model: HysteresisModel
    sample_rate_hz: float
    input_unit: CommandUnit
    input_range: tuple[float, float] | None
    output_range_um: tuple[float, float] | None
    identified_range: IdentifiedRange | None

    @cached_property
    def forward(self) -> Operator:
        """Operator from command to displacement in um."""
        return self.model.forward(self.sample_rate_hz)

    @cached_property
    def inverse(self) -> Operator:
        """Operator from displacement in um to command.

        Raises:
            ModelError: The model has no inverse at this sample rate.
        """
        return self.model.inverse(self.sample_rate_hz)


def load_model(path: PathLike, sample_rate_hz: float) -> LoadedModel:
    """Read a model file.

    Args:
        path: Model file.
        sample_rate_hz: Samples per second of the signals.

    Raises:
        InputError: The file cannot be read, or the sample rate is not > 0.
        ConfigError: The model breaks a rule or has no inverse; all problems are listed.
    """
    check_rate(sample_rate_hz)
    model = read_model(Path(path))
    return LoadedModel(
        model=model,
        sample_rate_hz=sample_rate_hz,
        input_unit=model.input_unit,
        input_range=model.input_range,
        output_range_um=model.output_range_um,
        identified_range=model.provenance.identified_range,
    )


def export_model(
    model: PathLike,
    output: PathLike,
    sample_rate_hz: float,
    *,
    forward: bool = False,
    overwrite: bool = False,
) -> None:
    """Write the inverse of a model as one C or MATLAB function without dependencies.

    Args:
        model: Model file.
        output: File to write, ``.c`` or ``.m``; the function has its name.
        sample_rate_hz: Samples per second of the signals.
        forward: Write the model instead of its inverse.
        overwrite: Replace an existing file.

    Raises:
        InputError: A file cannot be read or written, or the name or the rate is invalid.
        ConfigError: The model breaks a rule; all problems are listed.
        ModelError: The model has no inverse at this sample rate.
    """
    file = Path(output)
    check_no_input(file, [Path(model)])
    text = export_text(read_model(Path(model)), file, sample_rate_hz, forward=forward)
    write_text(file, text, overwrite=overwrite)


def refine(
    model: PathLike,
    runs: Paths,
    output: PathLike | None = None,
    *,
    validate: Paths = (),
    overwrite: bool = False,
    on_progress: Callable[[float, str], None] = lambda done, text: None,
) -> Refinement:
    """Identify a model from recordings of runs; the file is written only if the model is better.

    The new model is identified as by :func:`identify` with ``whole=true``, without the old one.

    Args:
        model: Model file.
        runs: Recordings of compensated, learned or plain runs.
        output: Model file to write, if any.
        validate: Recordings to compare both models on; default: parts of the runs.
        overwrite: Replace an existing model file.
        on_progress: Called with the fraction done (0 to 1) and the current step.

    Raises:
        InputError: A file is invalid; nothing is written.
    """
    file, paths, others = Path(model), paths_of(runs), paths_of(validate)
    if output is not None:
        check_writable(Path(output), overwrite=overwrite, inputs=[file, *paths, *others])
    old, settings = read_model(file), settings_from("auto", ["whole=true"])
    with workers("threads") as run:
        request, _ = _request(paths, others, settings, 0, run, on_progress)
        found = refine_records(old, request)
    if output is not None and found.better:
        write_text(Path(output), dump_model(found.model), overwrite=overwrite)
    return found


def compare(
    recordings: Paths,
    models: Sequence[str] = (),
    *,
    experiment: PathLike | None = None,
    settings: Settings = (),
    frequencies_hz: Sequence[float] | None = None,
    points: int | None = None,
    html: PathLike | None = None,
    save: PathLike | None = None,
    overwrite: bool = False,
    on_progress: Callable[[float, str], None] = lambda done, text: None,
) -> Comparison:
    """Identify models of the literature on the same loops, and test their inverses.

    Args:
        recordings: Recordings of steady loops.
        models: Kinds of model, or model files; default: those of ``hilctl compare``.
        experiment: Experiment with device, limits and waveform of the tests; default: from the
            first recording.
        settings: Overrides of that experiment.
        frequencies_hz: Frequencies of the tests; default: the lowest, a middle and the highest one
            of the loops, for sines.
        points: Points per loop; default: 300.
        html: Page with table and plot to write, if any.
        save: Folder for the identified model files, if any.
        overwrite: Replace existing files.
        on_progress: Called with the fraction done (0 to 1) and the current step.

    Raises:
        InputError: A file or a model is invalid, or a file cannot be written.
    """
    inputs = [*paths_of(recordings), *map(Path, models)]
    if experiment is not None:
        inputs += inputs_of(experiment_path(experiment), texts_of(settings))
    if html is not None:
        check_writable(Path(html), overwrite=overwrite, inputs=inputs)
    if save is not None:
        kinds = models or library.compared_kinds()
        library.check_free(kinds, Path(save), overwrite=overwrite, inputs=inputs)
    finish_dead_runs()
    comparison = library.compare(
        paths_of(recordings),
        models,
        experiment=path_or_none(experiment),
        settings=texts_of(settings),
        frequencies_hz=frequencies_hz,
        points=library.POINTS if points is None else points,
        progress=on_progress,
    )
    if html is not None:
        from hilctl.lab.comparison.comparison_page import comparison_page  # it imports matplotlib

        write_text(Path(html), comparison_page(comparison), overwrite=True)
    if save is not None:
        created = datetime.now(UTC).isoformat(timespec="seconds")
        library.save_models(comparison, Path(save), created=created, overwrite=overwrite)
    return comparison
