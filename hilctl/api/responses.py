"""Responses and spectra of measured runs."""

from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import TypeVar

from hilctl.api._types import PathLike, Paths, paths_of
from hilctl.api.recordings import RecordedRun, read
from hilctl.base.errors import DataError, InputError
from hilctl.base.files import check_writable
from hilctl.experiment.sections.open_loop import write_response
from hilctl.lab.response.bode import write_responses
from hilctl.lab.response.feedback_design import (
    FeedbackDesign,
    design_feedback,
    write_design,
)
from hilctl.lab.response.frequency_response import (
    FrequencyResponse,
    Signals,
    frequency_response,
)
from hilctl.lab.response.segment_spectrum import SegmentSpectrum, spectra, write_spectra
from hilctl.lab.response.step_response import SETTLED_PERCENT, StepResponse
from hilctl.lab.response.step_response import step_response as measured_step

Result = TypeVar("Result")


def frf(
    runs: Paths,
    html: PathLike | None = None,
    *,
    signals: Signals | None = None,
    overwrite: bool = False,
) -> tuple[FrequencyResponse, ...]:
    """Return the frequency response of each run, and write their page with a Bode plot.

    The last multisine, random or chirp segment is evaluated; without one, all sines together.

    Args:
        runs: Recordings.
        html: Page to write, if any.
        signals: Input and output: ``command-displacement``, ``reference-displacement`` (default
            with a compensator) or ``command-measured``.
        overwrite: Replace an existing page.

    Raises:
        InputError: A file does not exist, the signals are not recorded, or the page cannot be
            written.
        DataError: A file is not a recording, or has no frequency response above the noise.
    """
    if html is not None:
        check_writable(Path(html), overwrite=overwrite)
    found = _of_each(runs, lambda run: frequency_response(read(run).recording, signals))
    if html is not None:
        write_responses(found, Path(html))
    return tuple(found)


def spectrum(
    runs: Paths,
    html: PathLike | None = None,
    *,
    from_s: float | None = None,
    to_s: float | None = None,
    overwrite: bool = False,
) -> tuple[SegmentSpectrum, ...]:
    """Return the spectrum of each segment at rest and of each sine, and write their page.

    A segment is at rest if it is a hold, or if its command is constant in the time range.

    Args:
        runs: Recordings.
        html: Page to write, if any.
        from_s: Start of the time range to evaluate.
        to_s: End of the time range.
        overwrite: Replace an existing page.

    Raises:
        InputError: A file does not exist, or the page cannot be written.
        DataError: A file is not a recording, or has neither a sine nor a part at rest.
    """
    if html is not None:
        check_writable(Path(html), overwrite=overwrite)
    each = _of_each(runs, lambda run: spectra(read(run, from_s=from_s, to_s=to_s).recording))
    found = tuple(chain.from_iterable(each))
    if html is not None:
        write_spectra(found, Path(html))
    return found


def _of_each(runs: Paths, evaluate: Callable[[Path], Result]) -> list[Result]:
    """Return the results of all runs; raise one error with all problems."""
    found, problems = [], []
    for run in paths_of(runs):
        try:
            found.append(evaluate(run))
        except (InputError, DataError) as error:
            problems.append(error)
    if len(problems) > 1:
        raise InputError("\n".join(map(str, problems)))
    if problems:
        raise problems[0]
    return found


def step(run: RecordedRun | PathLike, *, band_percent: float = SETTLED_PERCENT) -> StepResponse:
    """Return the response to the largest step of a run's last step segment.

    Args:
        run: Recording in memory, or a file.
        band_percent: Band for the settling time, in percent of the step's height.

    Raises:
        InputError: The file does not exist.
        DataError: The file is not a recording, or has no step with a displacement.
    """
    recorded = run if isinstance(run, RecordedRun) else read(run)
    return measured_step(recorded.recording, band_percent)


def tune(
    run: RecordedRun | PathLike,
    output: PathLike | None = None,
    html: PathLike | None = None,
    *,
    overwrite: bool = False,
) -> FeedbackDesign:
    """Return a feedback with gain and phase margin for a run's response through its compensator.

    Args:
        run: Recording in memory, or a file: a multisine, random, chirp, or sines in sequence, with
            or without feedback.
        output: File for the measured response, which ``feedback.response`` of an experiment names.
        html: Page with a Bode plot to write, if any.
        overwrite: Replace existing files.

    Raises:
        InputError: The file does not exist, the run has no compensator, its response ends too
            early, or a file cannot be written.
        DataError: The file is not a recording, or has no frequency response above the noise.
    """
    for each in (output, html):
        if each is not None:
            check_writable(Path(each), overwrite=overwrite)
    recorded = run if isinstance(run, RecordedRun) else read(run)
    named = None if output is None else str(Path(output).resolve())
    design = design_feedback(recorded.recording, named)
    if output is not None:
        write_response(Path(output), design.response, overwrite=overwrite)
    if html is not None:
        write_design(design, Path(html))
    return design
