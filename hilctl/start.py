"""From an experiment file to a finished run: load, check, run."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path

from hilctl.errors import InputError
from hilctl.experiment import load_experiment
from hilctl.preflight import Checked, check
from hilctl.supervisor import Progress, RunResult, Supervisor, default_output


def checked_experiment(path: Path, settings: Sequence[str]) -> Checked:
    """Load an experiment and hold it against device, model and limits.

    Raises:
        InputError: It can't be used; all problems are listed.
    """
    return check(load_experiment(path, settings))


def start_run(
    path: Path,
    settings: Sequence[str],
    output: Path | None,
    overwrite: bool,
    on_progress: Callable[[Progress], None],
) -> RunResult:
    """Run an experiment file to its end.

    Args:
        path: Experiment file.
        settings: ``key=value`` texts over it.
        output: Recording to write; a name in the experiment's folder where None.
        overwrite: Whether an existing recording may be replaced.
        on_progress: Called with each batch of samples.

    Raises:
        InputError: Nothing has moved, and no file is left.
        RunError: The device could not be opened; nothing has moved, and no file is left.
    """
    checked = checked_experiment(path, settings)
    if output is None:
        folder = Path(checked.loaded.config.recording.folder)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: can't be made: {error.strerror}") from None
        output = default_output(checked.loaded.config.name, folder, time.localtime())
    return Supervisor(checked, output, overwrite=overwrite, on_progress=on_progress).run()
