"""Runs in the background: start one, and come back once it runs."""

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hilctl.base.errors import InputError, RunError
from hilctl.run.architecture import require_real_time_machine
from hilctl.run.run_folder import RunFolder, runs
from hilctl.run.start import checked_experiment, output_of

_POLL_S = 0.05
_START_S = 180.0


@dataclass(frozen=True, slots=True)
class Detached:
    """A run that goes on by itself.

    Attributes:
        run: Its folder.
        log: What it prints.
    """

    run: RunFolder
    log: Path


def start_detached(
    experiment: Path, settings: Sequence[str], output: Path | None, flags: Sequence[str]
) -> Detached:
    """Start a run in the background, and come back once it runs.

    Args:
        experiment: Experiment file.
        settings: ``key=value`` texts over it.
        output: Recording to write; a name in the experiment's folder where None.
        flags: Further arguments of ``hilctl run``.

    Raises:
        InputError: It can't be used; nothing has moved.
        RunError: It ended before it ran; the text is what it said.
    """
    require_real_time_machine()
    checked = checked_experiment(experiment, settings)
    output = output_of(checked, output)
    log = free_log(output)
    command = [sys.executable, "-P", "-m", "hilctl", "run", str(experiment), *flags]
    command += ["--output", str(output)]
    command += [word for setting in settings for word in ("--set", setting)]
    try:
        with log.open("xb") as stream:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=stream,
                start_new_session=True,  # neither Ctrl-C nor the terminal's end are meant for it
            )
    except OSError as error:
        raise InputError(f"{log}: can't be written: {error.strerror}") from None
    return Detached(_await_running(process, log), log)


def free_log(output: Path) -> Path:
    """Return the log of a run into ``output``: beside it, and no file that is there already."""
    log, number = output.with_suffix(".log"), 2
    while os.path.lexists(log):  # a link that leads nowhere is there too
        log = output.with_suffix(f".{number}.log")
        number += 1
    return log


def _await_running(process: "subprocess.Popen[bytes]", log: Path) -> RunFolder:
    deadline = time.monotonic() + _START_S
    while process.poll() is None:
        for run in runs():
            if run.card.supervisor == process.pid and run.socket.exists():
                return run
        if time.monotonic() > deadline:
            process.terminate()
            raise RunError(f"the run did not start within {_START_S:g} s: see {log}")
        time.sleep(_POLL_S)
    said = log.read_text(encoding="utf-8", errors="replace").strip()
    if process.returncode == 0:
        raise RunError(f"the run was over at once: see {log}")
    text = said.replace("hilctl: ", "") or f"the run ended with exit code {process.returncode}"
    raise InputError(text) if process.returncode == 2 else RunError(text)
