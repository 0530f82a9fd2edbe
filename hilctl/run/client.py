"""Runs in the background: start one, find it, send it a request, stop it."""

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hilctl.base.errors import InputError, RunError
from hilctl.run.control_socket import ask
from hilctl.run.run_folder import RunFolder, facts_of, runs
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
    checked = checked_experiment(experiment, settings)
    output = output_of(checked, output)
    log = free_log(output)
    command = [sys.executable, "-P", "-m", "hilctl.cli", "run", str(experiment), *flags]
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


def find_run(name: str | None) -> RunFolder:
    """Return the run that is meant.

    Args:
        name: Its name, or the beginning of it; may be left out where there is one run only.

    Raises:
        InputError: There is none, or more than one.
    """
    going = [run for run in runs() if run.supervised]
    chosen = [run for run in going if run.card.name.startswith(name or "")]
    exact = [run for run in chosen if run.card.name == name]
    if len(exact or chosen) == 1:
        return (exact or chosen)[0]
    known = ", ".join(run.card.name for run in going) or "none"
    if not chosen:
        what = f"no run is named {name!r}" if name else "no run is going on"
        raise InputError(f"{what} (going on: {known})")
    raise InputError(f"more than one run is meant, say which with --run (going on: {known})")


def status_of(run: RunFolder) -> dict[str, Any]:
    """Return where a run stands, also where nobody answers for it any more."""
    if run.supervised:
        try:
            return ask(run.socket, {"command": "status"})
        except (RunError, InputError) as error:
            return {**facts_of(run), "state": "not answering", "error": str(error)}
    state = "ramping down without its supervisor" if run.alive else "dead"
    return {**facts_of(run), "state": state}


def stop_run(run: RunFolder, wait_s: float) -> dict[str, Any]:
    """Request a run to end by its safe ramp.

    Args:
        run: The run.
        wait_s: How long to wait for its end.

    Returns:
        Its last status, with ``ended``: whether it is over.

    Raises:
        RunError: It does not answer.
    """
    answer = ask(run.socket, {"command": "stop"})
    deadline = time.monotonic() + wait_s
    while (going := run.alive) and time.monotonic() < deadline:
        time.sleep(_POLL_S)
    return {**answer, "ended": not going}


def set_run(run: RunFolder, assignments: Sequence[str], over_s: float) -> dict[str, Any]:
    """Move a running reference.

    Args:
        run: The run.
        assignments: ``gain=0.5``, ``offset=2.0``.
        over_s: Time that the change takes.

    Raises:
        InputError: No such parameter, or the run refuses it; nothing has changed.
        RunError: It does not answer.
    """
    wanted: dict[str, float] = {}
    for text in assignments:
        key, equals, value = text.partition("=")
        if key not in {"gain", "offset"} or not equals:
            raise InputError(f"must be gain=NUMBER or offset=NUMBER: {text!r}")
        try:
            wanted[key] = float(value)
        except ValueError:
            raise InputError(f"{key} must be a number: {value!r}") from None
    return ask(run.socket, {"command": "set", **wanted, "over_s": over_s}, timeout_s=30.0)
