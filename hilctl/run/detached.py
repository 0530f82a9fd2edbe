"""Start a run in the background."""

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hilctl.base.errors import HilctlError, InputError, RunError
from hilctl.run.control.client import ask, request
from hilctl.run.run_folder import RunFolder, require_linux, runs
from hilctl.run.start import checked_experiment, output_of

_POLL_S = 0.05
_ANSWER_S = 0.5
_START_S = 180.0


@dataclass(frozen=True, slots=True)
class Detached:
    """A run in the background; ``run`` is None if it has completed already."""

    run: RunFolder | None
    recording: Path
    log: Path


def start_detached(
    experiment: Path, settings: Sequence[str], output: Path | None, flags: Sequence[str]
) -> Detached:
    """Start ``hilctl run`` in the background; return once its loop runs, or raise its error."""
    require_linux()
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
                start_new_session=True,  # unaffected by Ctrl-C and the end of the terminal
            )
    except OSError as error:
        raise InputError(f"{log}: cannot write: {error.strerror}") from None
    return Detached(_await_running(process, log), output, log)


def free_log(output: Path) -> Path:
    """Return the log file of a run into ``output``: beside it, and not an existing file."""
    log, number = output.with_suffix(".log"), 2
    while os.path.lexists(log):  # also true of a broken link
        log = output.with_suffix(f".{number}.log")
        number += 1
    return log


def _await_running(process: "subprocess.Popen[bytes]", log: Path) -> RunFolder | None:
    deadline = time.monotonic() + _START_S
    while process.poll() is None:
        for run in runs():
            if run.card.supervisor == process.pid and _has_started(run):
                return run
        if time.monotonic() > deadline:
            process.terminate()
            raise RunError(f"the run did not start within {_START_S:g} s: see {log}")
        time.sleep(_POLL_S)
    if process.returncode == 0:
        return None
    said = log.read_text(encoding="utf-8", errors="replace").strip()
    text = said.replace("hilctl: ", "") or f"the run ended with exit code {process.returncode}"
    raise InputError(text) if process.returncode == 2 else RunError(text)


def _has_started(run: RunFolder) -> bool:
    try:
        # The socket exists before the device is open, but answers only after the start.
        state = ask(run.socket, request("status"), timeout_s=_ANSWER_S)["state"]
    except HilctlError:
        return False
    return state not in {"starting", "ready"}
