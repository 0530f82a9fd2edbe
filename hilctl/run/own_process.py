"""A run in a separate process, for programs with threads, such as notebooks.

The supervisor handles signals, which only a main thread may do, and starts processes, whose
priority other threads must not affect. Progress and result come back through a pipe.
"""

import logging
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any, BinaryIO

from hilctl.base.errors import HilctlError, RunError
from hilctl.run.control.client import HANG_UP
from hilctl.run.result import Progress, RunResult

_log = logging.getLogger(__name__)

Given = tuple[Path, Sequence[str], Path | None, bool, float]
"""Experiment file, settings, recording, whether it may be replaced, and heat of the coil."""

_START = (
    # Until the supervisor handles signals: nothing has moved.
    "import signal, sys; signal.signal(signal.SIGINT, signal.SIG_DFL)\n"
    "from hilctl.run.own_process import main; main(int(sys.argv[1]))"
)
_FORWARDED = (signal.SIGINT, signal.SIGTERM, HANG_UP)


def has_threads() -> bool:
    """Return whether this program has other threads, or the caller is not its main one."""
    here = threading.current_thread()
    return threading.active_count() > 1 or here is not threading.main_thread()


def run_in_own_process(given: Given, on_progress: Callable[[Progress], None]) -> RunResult:
    """Run an experiment in a separate process; return the result. The run stops with this process.

    Raises:
        HilctlError: Error of the run.
        RunError: Its process ended without a result.
        KeyboardInterrupt: It was interrupted before anything moved.
    """
    read_end, write_end = os.pipe()
    with os.fdopen(read_end, "rb") as answers:
        try:
            process = subprocess.Popen(
                # -P: import nothing from the working folder.
                [sys.executable, "-P", "-c", _START, str(write_end)],
                stdin=subprocess.PIPE,
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
            on_progress = _ignore


def _ignore(_progress: Progress) -> None:
    pass


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
    from hilctl.run.start import start_run

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

        file, settings, output, overwrite, heat_a2 = given
        try:
            send(start_run(file, settings, output, overwrite, show, heat_a2))
        except HilctlError as error:
            send(error)
