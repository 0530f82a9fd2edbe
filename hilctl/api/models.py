"""Identify, refine and compare models."""

import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path

from hilctl.api.given import PathLike, Paths, Settings, path_or_none, paths_of, texts_of
from hilctl.base.files import check_writable
from hilctl.comparison import compare as library
from hilctl.comparison.compare import Comparison
from hilctl.experiment.load import inputs_of
from hilctl.identify.pipeline import Identification, identify_files, settings_from
from hilctl.identify.refine.refinement import Refinement, refine_files
from hilctl.run.dead_runs import finish_dead_runs


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
) -> "Identification":
    """Identify a model's parameters from recordings or measured tables.

    Args:
        files: Recordings (MCAP) and text tables.
        output: Model file to write; what is no model of these data is not written.
        model: Its kind, or ``auto``: what is best on data that no fit saw.
        settings: Of the fit, see ``hilctl identify --settings``.
        validate: Files to judge the model on; parts of the others where there are none.
        scheduler: Where independent fits run: ``none``, ``threads``, ``processes``, or a Dask
            address. Left out, the candidates of ``auto`` over threads, as their kernels leave the
            interpreter to each other, and others one after the other.
        overwrite: Whether a model file of that name may be replaced.
        on_progress: Called with how much is done, from 0 to 1, and what is being done.

    Returns:
        The model, its errors (held out first) and its verdict: good, usable, or not a model.

    Raises:
        InputError: A file or a setting can't be used; nothing is written.
    """
    return identify_files(
        paths_of(files),
        settings_from(model, texts_of(settings)),
        path_or_none(output),
        paths_of(validate),
        scheduler or ("threads" if model == "auto" else "none"),
        overwrite=overwrite,
        progress=on_progress,
    )


def refine(
    model: PathLike,
    runs: Paths,
    output: PathLike | None = None,
    *,
    validate: Paths = (),
    overwrite: bool = False,
    on_progress: Callable[[float, str], None] = lambda done, text: None,
) -> "Refinement":
    """Improve a model from recordings of runs; it is written only where it has become better.

    Args:
        model: Model file.
        runs: Recordings of compensated, learned or plain runs.
        output: Model file to write; None for none.
        validate: Recordings to judge it on; each run in turn where there are none.
        overwrite: Whether a model file of that name may be replaced.
        on_progress: Called with how much is done, from 0 to 1, and what is being done.

    Raises:
        InputError: A file can't be used; nothing is written.
    """
    return refine_files(
        Path(model),
        paths_of(runs),
        path_or_none(output),
        paths_of(validate),
        overwrite=overwrite,
        progress=on_progress,
    )


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
) -> "Comparison":
    """Identify models of the literature on the same loops, and try their inverses.

    Args:
        recordings: Recordings of steady loops.
        models: Kinds of model, or model files; those of ``hilctl compare`` where empty.
        experiment: Experiment that gives device, limits and waveform of the trials; from the first
            recording where None.
        settings: Over that experiment.
        frequencies_hz: Of the trials; 10, 100 and 200 Hz for sines where None.
        points: Points a loop; 300 where None.
        html: Page with table and figure to write; None for none.
        save: Folder for a model file of each that was identified; None for none.
        overwrite: Whether files of these names may be replaced.
        on_progress: Called with how much is done, from 0 to 1, and what is being done.

    Raises:
        InputError: A file or a model can't be used, or a file can't be written.
    """
    inputs = [*paths_of(recordings), *map(Path, models)]
    if experiment is not None:
        inputs += inputs_of(Path(experiment), texts_of(settings))
    if html is not None:
        check_writable(Path(html), overwrite=overwrite, inputs=inputs)
    if save is not None:
        kinds = models or list(library.COMPARED)
        library.check_free(kinds, Path(save), overwrite=overwrite, inputs=inputs)
    finish_dead_runs()

    request = library.ComparisonRequest(
        recordings=paths_of(recordings),
        models=models,
        experiment=path_or_none(experiment),
        settings=texts_of(settings),
        frequencies_hz=frequencies_hz,
        points=library.POINTS if points is None else points,
    )
    comparison = library.compare(request, time.perf_counter, on_progress)
    if html is not None:
        from hilctl.comparison.comparison_page import write_comparison  # it imports matplotlib

        write_comparison(comparison, Path(html))
    if save is not None:
        created = datetime.now(UTC).isoformat(timespec="seconds")
        library.save_models(comparison, Path(save), created=created, overwrite=overwrite)
    return comparison
