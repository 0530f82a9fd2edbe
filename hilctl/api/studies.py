"""Studies of your own: generators that yield experiments and receive their runs."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from hilctl.api._types import PathLike
from hilctl.lab.studies.study import (
    StepFaultError,
    StepStoppedError,
    Study,
    StudyHost,
    StudyRun,
    StudyStep,
    run_study,
)
from hilctl.lab.studies.study_folder import prepared
from hilctl.run.control.client import finish_dead_runs

__all__ = ["StepFaultError", "StepStoppedError", "StudyRun", "StudyStep", "study"]

_T = TypeVar("_T")


def study(
    steps: Study[_T],
    folder: PathLike,
    *,
    fast: bool = False,
    on_progress: Callable[[float, str], None] = lambda done, text: None,
    on_note: Callable[[str], None] = lambda text: None,
) -> _T:
    """Run a study of your own: a generator that yields experiments and receives their runs.

    ``run = yield api.StudyStep(experiment, settings)`` runs an experiment; ``run.path`` is its
    recording. The coil cools before each run. A run that a stall ended is repeated. A step whose
    experiment has a completed recording in the folder is not run again, so a stopped study resumes.

    Args:
        steps: The generator.
        folder: Folder for the recordings.
        fast: Simulate without waiting; simulated devices only.
        on_progress: Called with the completed fraction of the run (0 to 1) and the current step.
        on_note: Called with a note on each repaired recording.

    Returns:
        The value that the generator returns.

    Raises:
        InputError: An experiment is invalid, or the folder is in use; nothing has moved.
        StepFaultError: A run ended by a fault.
        StepStoppedError: A signal stopped a run; no further step runs.
        RunError: A run could not start, or its experiment is invalid, after an earlier run.
    """
    finish_dead_runs()
    host = StudyHost.of(fast=fast, on_progress=on_progress, on_note=on_note)
    with prepared(Path(folder), host.sleep_s, host.on_note):
        return run_study(steps, Path(folder), host)
