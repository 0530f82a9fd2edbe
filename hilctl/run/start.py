"""From an experiment file to a finished run: in real time or not, or in another process.

A run in the background is ``hilctl run`` in its own session. A program with threads, such as a
notebook, runs in a separate process: the supervisor handles signals, which only a main thread may
do, and starts processes, whose priority other threads must not affect. Progress and result come
back through a pipe.
"""

import logging
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, BinaryIO, Self, TypeAlias

from hilctl import OWN_ENVIRONMENT
from hilctl.base.errors import DataError, HilctlError, InputError, RunError
from hilctl.base.files import check_no_input, make_folder
from hilctl.base.subprocesses import python_command
from hilctl.experiment.load import LoadedExperiment, input_files, load_axes, load_experiment
from hilctl.experiment.preflight import CheckedExperiment, CheckedRun, check, check_axes
from hilctl.experiment.sections.correction import dump_correction
from hilctl.experiment.sections.coupling import coupling_sha256
from hilctl.machine.reserve import RESERVE
from hilctl.models.model_file import dump_model
from hilctl.recording.run_summary import read_ends
from hilctl.run.control.client import HANG_UP, ask, finish_dead_runs, request
from hilctl.run.metadata import experiment_sha256, sha256_of
from hilctl.run.result import Progress, RunResult, recordings_of
from hilctl.run.run_folder import RunFolder, require_linux, runs
from hilctl.run.unpaced import run_unpaced

_log = logging.getLogger(__name__)

OnPart: TypeAlias = Callable[[float], None]  # called with the completed part of a run, 0 to 1


def checked_experiment(
    path: Path, settings: Sequence[str], heat_a2: float = 0.0
) -> CheckedExperiment:
    """Load an experiment and check it; raise InputError with all problems.

    ``settings`` are ``key=value`` texts that override the file; ``heat_a2`` is the minimum heat of
    the coil, in A^2. A killed run of a device is recovered first, so that its final state counts.
    """
    loaded = load_experiment(path, settings)
    if loaded.device.info.holds:
        finish_dead_runs()
    return check(loaded, heat_a2)


def checked_run(path: Path, settings: Sequence[str], heat_a2: float = 0.0) -> CheckedRun:
    """Load an experiment with one axis or several and check it, see :func:`checked_experiment`."""
    loaded = load_axes(path, settings)
    if any(each.device.info.holds for each in loaded):
        finish_dead_runs()
    return check_axes(loaded, heat_a2)


def output_of(run: CheckedRun, output: Path | None) -> Path:
    """Return the recording to write: ``output``, or a new name in the folder of recordings.

    Those of several axes are named after it, see :func:`recordings_of`. Raise InputError if the
    folder cannot be created, or a recording is an input of the run or not an ``.mcap`` file.
    """
    if output is not None:
        for path in recordings_of(run.names, output).values():
            for loaded in (each.loaded for each in run.axes):
                # A recording may be an input: of a waveform, or of the initial state.
                check_no_input(path, input_files(loaded.document, loaded.folder / "experiment"))
        if output.suffix.lower() != ".mcap":
            rule = "a recording is an MCAP file: choose a name that ends with .mcap"
            raise InputError(f"{output}: {rule} (hilctl export writes samples as tables)")
        return output
    folder = Path(run.config.recording.folder)
    make_folder(folder)
    return default_output(run.config.name, folder, time.localtime(), run.names)


def start_run(
    path: Path,
    settings: Sequence[str],
    output: Path | None,
    overwrite: bool,
    on_progress: Callable[[Progress], None],
    heat_a2: float = 0.0,
    take_over: bool = False,
) -> RunResult:
    """Run an experiment file to its end; in a separate process if this program has threads.

    With ``take_over`` a device is used although another user's process has it.
    Raise InputError or RunError if the run cannot start: nothing has moved, and no file is left.
    """
    require_linux()
    if has_threads():
        return run_in_own_process(
            (path, settings, output, overwrite, heat_a2, take_over), on_progress
        )
    from hilctl.run.supervisor import Supervisor  # Linux only

    run = checked_run(path, settings, heat_a2)
    # A real device has hysteresis memory: log the assumed initial state.
    for checked in run.axes:
        if checked.begun.begins and checked.loaded.device.info.holds:
            _log.warning("the compensator begins %s", checked.begun.begins)
    output = output_of(run, output)
    return Supervisor(
        run, output, overwrite=overwrite, take_over=take_over, on_progress=on_progress
    ).run()


def default_output(
    name: str, folder: Path, now: time.struct_time, axes: Sequence[str] = ("",)
) -> Path:
    """Return the default file name of a recording: ``folder/name-date-time.mcap``."""
    return unused(folder / f"{name}-{time.strftime('%Y%m%d-%H%M%S', now)}.mcap", "-", axes)


def unused(path: Path, mark: str, axes: Sequence[str] = ("",)) -> Path:
    """Return a path, with ``mark`` and a number after its stem if it exists for one of the axes."""
    found, number = path, 2
    # Also true of a broken link.
    while any(map(os.path.lexists, recordings_of(axes, found).values())):
        found = path.with_stem(f"{path.stem}{mark}{number}")
        number += 1
    return found


def paced(
    path: Path,
    settings: Sequence[str],
    output: Path,
    on_part: OnPart = lambda _: None,
    *,
    overwrite: bool = True,
    heat_a2: float = 0.0,
) -> RunResult:
    """Run in real time into a file; see :func:`start_run`."""

    def show(progress: Progress) -> None:
        on_part(progress.samples / max(progress.total, 1))

    return start_run(path, settings, output, overwrite, show, heat_a2)


def unpaced(
    path: Path,
    settings: Sequence[str],
    output: Path,
    on_part: OnPart = lambda _: None,
    *,
    overwrite: bool = True,
    heat_a2: float = 0.0,
) -> RunResult:
    """Run a simulated device without real time into a file."""
    return run_unpaced(checked_run(path, settings, heat_a2), output, overwrite=overwrite)


@dataclass(frozen=True, slots=True)
class RunKey:
    """SHA-256 of a run's experiment, model, correction and coupling; empty without one."""

    experiment: str
    model: str = ""
    correction: str = ""
    coupling: str = ""

    @classmethod
    def of(cls, loaded: LoadedExperiment) -> Self:
        """Return the key of an experiment."""
        model = dump_model(loaded.model) if loaded.model else ""
        correction = dump_correction(loaded.correction) if loaded.correction else ""
        digests = sha256_of(model), sha256_of(correction), coupling_sha256(loaded.coupling) or ""
        return cls(experiment_sha256(loaded), *digests)

    @classmethod
    def of_facts(cls, run: Mapping[str, str]) -> Self:
        """Return the key of a recorded run from its metadata."""
        kinds = ("experiment", "model", "correction", "coupling")
        return cls(*(run.get(f"{kind}_sha256", "") for kind in kinds))


def completed_key(path: Path) -> RunKey | None:
    """Return the key of a recording; None unless its run was completed."""
    try:
        ends = read_ends(path)
    except DataError:
        return None
    return RunKey.of_facts(ends.run) if ends.end.get("code") == "completed" else None


Given = tuple[Path, Sequence[str], Path | None, bool, float, bool]
"""Experiment file, settings, recording, whether it may be replaced, heat of the coil, whether
other users' processes are ignored."""

_START = (
    # Until the supervisor handles signals: nothing has moved.
    "import signal, sys; signal.signal(signal.SIGINT, signal.SIG_DFL)\n"
    "from hilctl.run.start import main; main(int(sys.argv[1]))"
)
_FORWARDED = (signal.SIGINT, signal.SIGTERM, HANG_UP)


def has_threads() -> bool:
    """Return whether this program has other threads, or the caller is not its main one."""
    main = threading.main_thread()
    others = {*threading.enumerate()} - {main, *RESERVE.threads}
    return bool(others) or threading.current_thread() is not main


def run_in_own_process(given: Given, on_progress: Callable[[Progress], None]) -> RunResult:
    """Run an experiment in a separate process; return the result. The run stops with this process.

    Raise the run's HilctlError, RunError if its process ended without a result, and
    KeyboardInterrupt if it was interrupted before anything moved.
    """
    read_end, write_end = os.pipe()
    with os.fdopen(read_end, "rb") as answers:
        try:
            process = subprocess.Popen(
                python_command("-c", _START, str(write_end)),
                stdin=subprocess.PIPE,
                env=OWN_ENVIRONMENT | os.environ,
                pass_fds=(write_end,),
                start_new_session=True,  # Ctrl-C is forwarded once
            )
        finally:
            os.close(write_end)
        with process, _forwarded(process):
            assert process.stdin is not None
            with suppress(BrokenPipeError), process.stdin:  # it has ended
                pickle.dump(given, process.stdin)
            answer = _answer(answers, on_progress)
    if isinstance(answer, HilctlError):
        raise answer
    if process.returncode == -signal.SIGINT:
        raise KeyboardInterrupt
    if answer is None:
        raise RunError(
            f"the process of the run ended with code {process.returncode} and without a result: "
            "check the output, and the recording with hilctl list"
        )
    return answer


def _answer(
    answers: BinaryIO, on_progress: Callable[[Progress], None]
) -> RunResult | HilctlError | None:
    """Pass progress on until the result arrives; return it, or None without one."""
    while True:
        try:
            answer: Progress | RunResult | HilctlError = pickle.load(answers)  # noqa: S301  our own
        except (EOFError, pickle.UnpicklingError):
            return None
        if not isinstance(answer, Progress):
            return answer
        try:
            on_progress(answer)
        except Exception:  # noqa: BLE001  an error of the display must not end the run
            _log.exception("progress is no longer reported")
            on_progress = lambda _: None  # noqa: E731


@contextmanager
def _forwarded(process: "subprocess.Popen[bytes]") -> Iterator[None]:
    """Forward stop signals to the process if this is the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def forward(number: int, frame: FrameType | None) -> None:
        process.send_signal(number)

    before = {number: signal.signal(number, forward) for number in _FORWARDED}
    try:
        yield
    finally:
        for number, handler in before.items():
            if handler is not None:  # None: not set by Python
                signal.signal(number, handler)


def main(descriptor: int) -> None:
    """Run the job from standard input; write progress and result to a descriptor."""
    given: Given = pickle.load(sys.stdin.buffer)  # noqa: S301  from the parent process
    lock = threading.Lock()
    with os.fdopen(descriptor, "wb") as answers:

        def send(answer: Any) -> None:
            with lock:
                pickle.dump(answer, answers)
                answers.flush()

        def show(progress: Progress) -> None:
            try:
                send(progress)
            except OSError:  # the parent process has ended
                os.kill(os.getpid(), signal.SIGTERM)

        file, settings, output, overwrite, heat_a2, take_over = given
        try:
            send(start_run(file, settings, output, overwrite, show, heat_a2, take_over))
        except HilctlError as error:
            send(error)


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
    run = checked_run(experiment, settings)
    output = output_of(run, output)
    log = unused(output.with_suffix(".log"), ".")
    command = python_command("-m", "hilctl", "run", str(experiment), *flags)
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
    recording = next(iter(recordings_of(run.names, output).values()))
    return Detached(_await_running(process, log), recording, log)


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
