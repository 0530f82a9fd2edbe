"""Programs that are started once a run is over, with its result on their standard input.

The output is safe by then, the recording closed and the device let go: nothing that they do, or
don't, changes any of it. What became of them is part of the result, and stands beside the
recording, in ``RUN.on_end.json``: a file that is closed is not opened again for it.
"""

import json
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from types import FrameType
from typing import IO

from hilctl.base.errors import DataError, InputError
from hilctl.base.files import write_text
from hilctl.base.finite_json import finite_json
from hilctl.base.printable import printable
from hilctl.experiment.end_commands import found_program
from hilctl.experiment.load import LoadedExperiment
from hilctl.experiment.parts import EndCommand
from hilctl.recording.ends import read_ends
from hilctl.recording.facts import END_FIGURES
from hilctl.run.result import EndCommandResult, RunResult
from hilctl.run.stopping import HANG_UP

_SAID = 300
_SIGNALS = (signal.SIGTERM, HANG_UP)
SUFFIX = ".on_end.json"
"""Of the file beside a recording that says what became of the programs."""


def with_end_commands(
    result: RunResult, loaded: LoadedExperiment, clock: Callable[[], float] = time.monotonic
) -> RunResult:
    """Start what the experiment names, one after another; return the result with their ends.

    Args:
        result: How the run ended.
        loaded: Its experiment.
        clock: Monotonic time in s.
    """
    commands = loaded.config.on_end
    if not commands:
        return result
    text = finite_json(end_mapping(result, loaded.config.name))
    ended: list[EndCommandResult] = []
    with _interruptible():
        try:
            for each in commands:
                ended.append(_run(each, text, loaded.folder, clock))  # noqa: PERF401  kept as far as it came
        except KeyboardInterrupt:
            rest = commands[len(ended) :]
            ended += [EndCommandResult(each.command, None, 0.0, "interrupted") for each in rest]
    return _noted(replace(result, on_end=tuple(ended)))


def end_mapping(result: RunResult, experiment: str) -> dict[str, object]:
    """Return what the programs are given: the run's end, and the figures of its recording."""
    mapping = {"experiment": experiment, "late_ticks": result.late_ticks, **result.to_mapping()}
    del mapping["on_end"]
    with suppress(DataError):  # of a recording that was cut short there are none
        end = read_ends(result.path).end
        mapping["figures"] = {name: float(end[name]) for name in END_FIGURES if name in end}
    return mapping


def _run(
    wanted: EndCommand, text: str, folder: Path, clock: Callable[[], float]
) -> EndCommandResult:
    began_s = clock()
    name, *arguments = wanted.command
    program = found_program(name, folder)
    if program is None:
        return EndCommandResult(wanted.command, None, 0.0, "it is not there any more")
    try:
        with tempfile.TemporaryFile() as said:
            code, error = _ended([program, *arguments], text, wanted.timeout_s, said)
            if code and not error:
                error = _last_line(said)
    except OSError as failure:
        error, code = failure.strerror or str(failure), None
    return EndCommandResult(wanted.command, code, clock() - began_s, error)


def _ended(command: Sequence[str], text: str, timeout_s: float, said: IO[bytes]) -> tuple[int, str]:
    """Return the exit code of a program, and what was wrong beside it."""
    # A session of its own: what it starts is ended with it, and Ctrl-C is not meant for it.
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=said, stderr=said, start_new_session=True
    ) as process:
        error = ""
        try:
            process.communicate(text.encode(), timeout=timeout_s)
        except subprocess.TimeoutExpired:
            error = f"killed after {timeout_s:g} s"
        finally:
            # Only where it goes on: the number of one that has ended may be another's by now.
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                # Not left to Popen, which waits no longer than a moment after Ctrl-C.
                process.wait()
    return process.returncode, error


def _last_line(said: IO[bytes]) -> str:
    said.seek(max(0, said.seek(0, os.SEEK_END) - _SAID))
    lines = said.read().decode(errors="replace").strip().splitlines()
    return printable(lines[-1]) if lines else "it said nothing"


def _noted(result: RunResult) -> RunResult:
    """Let a file beside the recording say what became of them; where it can't, they say so."""
    path = result.path.with_name(result.path.stem + SUFFIX)
    mapping = {"recording": result.path.name, "on_end": [asdict(each) for each in result.on_end]}
    try:
        write_text(path, json.dumps(mapping, indent=2) + "\n", overwrite=True)
    except (InputError, OSError) as error:
        *before, last = result.on_end
        note = f"{last.error}; {error}" if last.error else str(error)
        return replace(result, on_end=(*before, replace(last, error=note)))
    return result


@contextmanager
def _interruptible() -> Iterator[None]:
    """Have signals end the wait for a program, and not this process before it has its result."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in _SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
