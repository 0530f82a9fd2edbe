"""A process that works changes of a running reference out, so that nobody else waits for it.

It is forked from the supervisor before that holds a lock, a recording or a thread: so it has the
checked experiment with all of its samples and compiled kernels, at no cost of time or memory. It
reads the ring, and writes nothing.
"""

import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from copy import copy
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import Self

from hilctl.base.arrays import F64
from hilctl.base.errors import ConfigError, InputError, Problem
from hilctl.experiment.check import Checked
from hilctl.experiment.tuned import InputPeaks, RunPosition, TunedForecast, tuned_forecast
from hilctl.loop.host import StraightLine, Tuning
from hilctl.loop.tuning import Tuner
from hilctl.run.ring import SampleRing
from hilctl.run.shared_page import Field
from hilctl.run.stopping import HANG_UP, JOB_CONTROL, STOP_SIGNAL

_NICE = 5
_BUDGET_S = 0.3
_LONGEST_S = 20.0
_STILL_S = 10.0
_PAUSE_S = 0.002
_DEATH_S = 1.0
SUPERVISORS = (signal.SIGINT, signal.SIGTERM, HANG_UP, STOP_SIGNAL, *JOB_CONTROL)
"""Signals that may be sent to all of a run's processes, and are the supervisor's to follow."""


@dataclass(frozen=True, slots=True)
class WantedChange:
    """A change that is to be worked out.

    Attributes:
        ring: File of the run's ring.
        gain: Gain that the reference is to have.
        offset: Offset that it is to have.
        inverse_share: Part of the inverse that the command is to have.
        samples: Samples that the change takes.
        lead_s: Time from now to its first sample, for working it out.
        tuner: Gain, offset and inverse at the sample ``tuner_at``, and what moved them then.
        tuner_at: That sample.
        heat_a2: Highest running mean square of the coil current that the run can have come to.
    """

    ring: str
    gain: float
    offset: float
    inverse_share: float
    samples: int
    lead_s: float
    tuner: Tuner
    tuner_at: int
    heat_a2: float


class ChangeWorker:
    """The process, seen from the supervisor.

    Args:
        checked: The experiment.
        clock: Monotonic time in s.
    """

    def __init__(self, checked: Checked, clock: Callable[[], float] = time.monotonic) -> None:
        # Forked on purpose: a fresh process would take seconds to import and compile the same.
        fork = multiprocessing.get_context("fork")
        self._connection, theirs = fork.Pipe()
        self._process = fork.Process(
            target=_work, args=(theirs, self._connection, checked), daemon=True
        )
        # Held back until it ignores them: one that comes in between would end it.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, SUPERVISORS)
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()
        self._clock = clock
        self._asked_s = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._process.kill()  # it holds nothing
        self._process.join(_DEATH_S)
        self._connection.close()

    def begin(self, wanted: WantedChange) -> None:
        """Have a change worked out, once the one before is.

        Raises:
            InputError: The process is gone.
        """
        self._asked_s = self._clock()
        try:
            self._connection.send(wanted)
        except OSError:
            raise InputError(_GONE) from None

    def result(self) -> TunedForecast | None:
        """Return what came of it; None while it is being worked out.

        Raises:
            InputError: It can't be followed; the text says why.
        """
        try:
            if not self._connection.poll():
                if self._clock() - self._asked_s > _LONGEST_S:
                    self._process.kill()
                    raise InputError(f"was not worked out within {_LONGEST_S:g} s")
                return None
            found: TunedForecast | str = self._connection.recv()
        except (EOFError, OSError):
            raise InputError(_GONE) from None
        if isinstance(found, str):
            raise InputError(found)
        return found


_GONE = "can't be worked out any more: the process that did so is gone"


def _work(connection: Connection, supervisors: Connection, checked: Checked) -> None:
    """Work changes out until the supervisor is gone."""
    supervisors.close()  # else the end of its side would never show
    for number in SUPERVISORS:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SUPERVISORS)
    with suppress(OSError):
        os.nice(_NICE)
    peaks = InputPeaks(checked.begun.input_um)
    with suppress(EOFError, OSError):
        while True:
            wanted: WantedChange = connection.recv()
            connection.send(answer_to(wanted, checked, peaks))


def answer_to(
    wanted: WantedChange,
    checked: Checked,
    peaks: InputPeaks,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> TunedForecast | str:
    """Work one change out, from where the run stands in its ring.

    Args:
        wanted: The change.
        checked: The experiment.
        peaks: Of the compensator's input.
        clock: Monotonic time in s.
        sleep: Lets that many s pass.

    Returns:
        What comes of it, or why it can't be followed.
    """
    config = checked.loaded.config
    try:
        ring = SampleRing(Path(wanted.ring))
        sample, state = _newest(ring, wanted.tuner_at, clock, sleep)
        until = clock() + _BUDGET_S
        tuner = copy(wanted.tuner)
        tuner.pass_over(sample - wanted.tuner_at)
        lead = max(1, round(wanted.lead_s * config.sample_rate_hz))
        earliest = max(sample, ring.page.get(Field.NEXT_SAMPLE) + config.block) + lead
        begins_at = -(-earliest // config.block) * config.block
        if begins_at >= checked.forecast.samples:
            return "the waveform is over before the change could begin"
        tuning = Tuning(
            wanted.gain,
            wanted.offset,
            wanted.samples,
            begins_at,
            wanted.inverse_share,
            checked.forecast.line or StraightLine(),
        )
        position = RunPosition(sample, state, tuner, wanted.heat_a2)
        return tuned_forecast(checked, peaks, position, tuning, lambda: clock() < until)
    except ConfigError as error:
        return "; ".join(_in_short(problem) for problem in error.problems)
    except (InputError, OSError, ValueError) as error:
        return str(error)


def _newest(
    ring: SampleRing, at_least: int, clock: Callable[[], float], sleep: Callable[[float], None]
) -> tuple[int, F64 | None]:
    """Return the newest sample that the memory is known of, and the memory: float64[s]."""
    until = clock() + _STILL_S
    while clock() < until:
        newest = ring.newest_state()
        if newest is None and at_least == 0 and not ring.page.observe(Field.HEAD):
            return 0, None
        # Blocks may be on their way for a while: the change before must be among those seen.
        if newest is not None and newest[0] >= at_least:
            return newest[0], newest[1][:-1]
        sleep(_PAUSE_S)
    raise InputError("the loop does not go on: try again")


def _in_short(problem: Problem) -> str:
    """Return a problem without its place in the file: that stands as it was written."""
    return f"{problem.rule}, got {problem.value}"
