"""The recording side of a run: claim the file, write batches, retry refused writes.

A thread takes samples out of the ring. They stay there until the file has them, so a disk that
stalls or refuses a write loses nothing while the ring has room, and delays no other thread.
"""

import errno
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np

from hilctl.base.errors import InputError
from hilctl.base.events import ADAPTED, Event
from hilctl.base.files import already_there, reason, sync_folder
from hilctl.base.samples import BlockBatch, BlockHeader, Samples
from hilctl.experiment.coil_heat import CoilHeat
from hilctl.experiment.correction import dump_correction
from hilctl.experiment.device_state import CoilState, DeviceState, write_device_state
from hilctl.experiment.preflight import CheckedExperiment
from hilctl.loop.plan import LoopOutcome
from hilctl.machine.process_usage import ProcessUsage
from hilctl.models.model_file import dump_model
from hilctl.recording.encoder import RecordingLayout
from hilctl.recording.metadata_keys import HEAT_FACT
from hilctl.recording.writer import OutputFile, RecordingWriter, RunFacts
from hilctl.run.metadata import EndFigures, end_facts, run_facts, usage_facts
from hilctl.run.ring import SampleRing
from hilctl.run.shared_page import PageField

_SAMPLES_BEFORE = 50
_SPARE = 20
_PATIENCE_S = 5.0
_RETRY_S = 0.05
_POLL_S = 0.05
_MOST_WAITING = 64
_KEPT = 8
"""One part in so many of the ring stays for watchers."""


class Recorder:
    """Records one run into one file.

    Nothing is lost by a write that fails: it stays in memory, and the next flush tries again.

    Args:
        checked: The experiment.
        path: File to record to.
        overwrite: Whether an existing file may be replaced.

    Raises:
        InputError: The file exists or can't be written.
    """

    def __init__(self, checked: CheckedExperiment, path: Path, *, overwrite: bool) -> None:
        self.path = path
        self.adapted: Mapping[str, float] = {}
        """Values of the newest event of adaptation."""
        self._failed = self._problem = ""
        self._next_sample = 0
        self._flushed = 0
        self._checked = checked
        self._writer: RecordingWriter | None = None
        self._unix_ns = steady_unix_ns()
        self._tail = RecentSamples(_SAMPLES_BEFORE)
        config = checked.loaded.config
        self._heat = CoilHeat(config.limits, config.sample_rate_hz, checked.heat_a2)
        self._run: RunFacts | None = None
        self._figures: EndFigures | None = None
        try:
            self._file = OutputFile(path, overwrite=overwrite, sync=config.recording.sync)
        except FileExistsError:
            raise already_there(path, "give another --output, or --overwrite") from None
        except OSError as error:
            raise self._unwritable(error) from None

    def _unwritable(self, error: OSError) -> InputError:
        return InputError(f"{self.path}: can't be written: {reason(error)}")

    def begin(self, start_unix_ns: int, set_up: Mapping[str, str], waveform_at: int = 0) -> None:
        """Write what is known before the first sample.

        Args:
            start_unix_ns: When it is due.
            set_up: How the loop's process was set up, see
                :func:`hilctl.machine.rt_setup.step_facts`.
            waveform_at: Index of the first sample of the waveform; a ramp comes before it.

        Raises:
            InputError: The file can't be written.
        """
        self._unix_ns = steady_unix_ns()
        try:
            # Before the file is opened for writing: that empties one which stood there.
            self._run = self._facts(start_unix_ns, set_up, waveform_at)
            self._writer = RecordingWriter(self._file.begin(), self._run)
        except OSError as error:
            raise self._unwritable(error) from None
        compensated = self._checked.loaded.model is not None
        self._figures = EndFigures(self._run.segments, compensated=compensated)
        # Before anything moves: the file may have been deleted since it was claimed.
        if not self.flush():
            raise InputError(self.error)

    def give_back(self) -> None:
        """Leave no file behind where there was none: the run does not start."""
        self._file.give_back()

    def note_device(self, coil: CoilState | None = None) -> None:
        """Note that this run is the last one of its device.

        Args:
            coil: How it left the coil; None while it is running.
        """
        assert self._run is not None
        facts, info = self._run.facts, self._checked.loaded.device.info
        path = self.path
        with suppress(OSError):  # the working folder is gone
            path = path.absolute()
        if info.holds:
            state = DeviceState(
                holds=list(info.holds),
                run_id=facts["run_id"],
                recording=str(path),
                started=datetime.fromisoformat(facts["started"]),
                coil=coil,
            )
            write_device_state(state)

    def batch(self, batch: BlockBatch) -> None:
        """Write a batch."""
        self._next_sample = int(batch.heads[-1, BlockHeader.FIRST_SAMPLE]) + batch.flags.shape[1]
        self._tail.add(batch)
        self._heat.follow(batch.samples())
        if self._begun.samples == 0:
            # The file says itself what is missing before its first sample.
            batch.heads[0, BlockHeader.DROPPED_BEFORE] = batch.heads[0, BlockHeader.FIRST_SAMPLE]
        self._write(partial(self._begun.batch, batch))
        self._gathered.add(batch.samples())

    def event(self, event: Event) -> None:
        """Write an event of the loop, with the samples that led to it."""
        if event.code == ADAPTED:
            self.adapted = event.values
        self._gathered.event(event)
        led_there = replace(event, before=self._tail.up_to(event.sample))
        self._write(partial(self._begun.event, led_there))

    @property
    def error(self) -> str:
        """Why the file cannot be written at present; empty if it can."""
        refused = self._file.stream.problem
        return self._failed or self._problem or (self._cannot(refused) if refused else "")

    def fail(self, why: str) -> None:
        """End the recording for good; the file stays as the last flush left it."""
        self._failed = self._failed or self._cannot(why)

    def _cannot(self, why: str | None) -> str:
        return f"{self.path}: can't be written: {why}"

    def flush(self) -> bool:
        """Hand all that was written to the kernel.

        Returns:
            Whether all of it is in the file. Otherwise it is kept for the next flush.
        """
        if self._failed:
            return False
        try:
            self._begun.flush()
            # Should a later write fail, no more than this is sure to be there.
            self._flushed = self._begun.samples
        except OSError as error:
            self._note_problem(error)
            return False
        if self._problem:
            text = f"written again, nothing is lost: {self._problem}"
            sample = max(0, self._next_sample - 1)
            event = Event(sample, "warning", "recording_retried", text, time_ns=self._unix_ns())
            self._write(partial(self._begun.event, event))
            self._problem = ""
        return True

    def _note_problem(self, error: OSError) -> None:
        if error.errno == errno.ESTALE:
            self._flushed = 0  # under its name nobody can read what is in it
        self._problem = self._problem or self._cannot(error.strerror)

    def finish(
        self, end: Mapping[str, str], ended_at: int, patience_s: float = _PATIENCE_S
    ) -> bool:
        """Write how the run ended, bring the file to the disk, and close it.

        Args:
            end: Facts of the end, with ``code`` and ``reason``.
            ended_at: Index after the last sample.
            patience_s: How long to retry while the disk refuses it.

        Returns:
            Whether the recording is complete and on the disk. Otherwise the file is as the last
            flush left it.
        """
        self._next_sample = max(self._next_sample, ended_at)
        self.flush()
        level = "info" if end["code"] == "completed" else "error"
        now_ns = self._unix_ns()
        facts = {**end, **self._gathered.facts(), "ended": iso_time(now_ns)}
        facts[HEAT_FACT] = repr(self._heat.heat_a2)
        event = Event(max(0, ended_at - 1), level, "run_ended", end["reason"], time_ns=now_ns)
        self._write(partial(self._begun.event, event))
        self._write(partial(self._begun.finish, facts, ended_at))
        until_s = time.monotonic() + patience_s
        while not (closed := self._closed()) and not self._failed and time.monotonic() < until_s:
            time.sleep(_RETRY_S)
        if closed:
            self._note_coil(end, now_ns)
        else:
            self._file.stream.abandon()
        return closed

    def _note_coil(self, end: Mapping[str, str], now_ns: int) -> None:
        coil = CoilState(
            ended=datetime.fromtimestamp(now_ns * 1e-9, tz=UTC),
            output_safe=end.get("output_safe") == "true",
            heat_a2=self._heat.heat_a2,
            thermal_time_constant_s=self._checked.loaded.config.limits.thermal_time_constant_s,
        )
        self.note_device(coil)

    def _closed(self) -> bool:
        """Close the finished file; return whether all of it is there."""
        if self._failed:
            return False
        try:
            self._file.stream.flush(sync=True)
            sync_folder(self.path.parent)
        except OSError as error:
            self._note_problem(error)
            return False
        with suppress(OSError):  # all of it is on the disk
            self._file.stream.close()
        self._problem = ""
        return True

    @property
    def samples(self) -> int:
        """Samples written; while the file cannot be written, those flushed before."""
        return self._flushed if self.error else self._begun.samples

    @property
    def next_sample(self) -> int:
        """Index after the last sample written or lost."""
        return self._next_sample

    @property
    def missing(self) -> int:
        """Samples known to be missing: counted in the recording, or not written to it yet."""
        return self._next_sample - self._flushed if self.error else self._begun.missing

    @property
    def _begun(self) -> RecordingWriter:
        assert self._writer is not None
        return self._writer

    @property
    def _gathered(self) -> EndFigures:
        assert self._figures is not None
        return self._figures

    def _write(self, write: Callable[[], None]) -> None:
        if not self._failed:
            write()

    def _facts(self, start_unix_ns: int, set_up: Mapping[str, str], waveform_at: int) -> RunFacts:
        loaded = self._checked.loaded
        config, info = loaded.config, loaded.device.info
        model_yaml = dump_model(loaded.model) if loaded.model else ""
        correction_yaml = dump_correction(loaded.correction) if loaded.correction else ""
        started = iso_time(start_unix_ns)
        facts = run_facts(self._checked, started, model_yaml, correction_yaml)
        return RunFacts(
            facts={**facts, **set_up},
            segments=tuple(each.shifted(waveform_at) for each in self._checked.reference.segments),
            experiment_yaml=loaded.yaml_text,
            model_yaml=model_yaml,
            correction_yaml=correction_yaml,
            layout=RecordingLayout(
                sample_rate_hz=config.sample_rate_hz,
                command_unit=info.command_unit,
                measures_command=info.measures_command,
                scope_rate_hz=config.recording.scope_rate_hz,
                start_unix_ns=start_unix_ns,
                records_input=self._checked.records_input,
                waveform_unit=self._checked.reference.unit,
            ),
        )


class RecentSamples:
    """Keeps at least the last samples, however they came.

    Args:
        samples: How many to record with an event.
    """

    def __init__(self, samples: int) -> None:
        self._samples = samples
        self._newest: Samples | None = None

    def add(self, batch: BlockBatch) -> None:
        """Take the newest samples of a batch; more of them than are asked for, for late events."""
        kept = _SPARE * self._samples
        blocks = -(-kept // batch.flags.shape[1])
        newest = batch.samples(slice(-blocks, None))
        if self._newest is not None:
            newest = self._newest.followed_by(newest)
        self._newest = newest.rows(slice(-kept, None))

    def up_to(self, sample: int) -> Samples | None:
        """Return the last samples up to and with ``sample``; None where none is left."""
        if self._newest is None:
            return None
        stop = int(np.searchsorted(self._newest.index, sample, side="right"))
        return self._newest.rows(slice(max(0, stop - self._samples), stop)) if stop else None


def steady_unix_ns() -> Callable[[], int]:
    """Return a clock of Unix time in ns that goes on from now, whatever the machine's is set to."""
    offset_ns = time.time_ns() - time.monotonic_ns()
    return lambda: time.monotonic_ns() + offset_ns


def iso_time(unix_ns: int) -> str:
    """Return a Unix time in ns as ISO 8601, UTC."""
    return datetime.fromtimestamp(unix_ns * 1e-9, tz=UTC).isoformat(timespec="milliseconds")


class RingRecorder:
    """Takes samples and events out of the ring, from the start signal to the end of the recording.

    Args:
        ring: Shared with the loop; nobody else takes anything out of it.
        recorder: Begun; nobody else writes to it.
        flush_s: Longest time that a sample stays out of the file.
    """

    def __init__(self, ring: SampleRing, recorder: Recorder, flush_s: float) -> None:
        self.recorder = recorder
        self.newest: BlockBatch | None = None
        """A copy of the newest block."""
        self._ring, self._flush_s = ring, flush_s
        self._events: deque[Event] = deque()
        self._of_loop: deque[Event] = deque()
        self._outcome: LoopOutcome | None = None
        self._lost_loop = False
        self._ending = threading.Event()
        self._released_s = time.monotonic()
        self._before = ProcessUsage.now()
        self._thread = threading.Thread(target=self._run, name="recorder")

    def start(self) -> None:
        """Begin to record."""
        self._before = ProcessUsage.now()
        self._released_s = time.monotonic()
        self._thread.start()

    def record_event(self, event: Event) -> None:
        """Record an event of the supervisor; returns at once."""
        self._events.append(event)

    def end(self, outcome: LoopOutcome, *, lost_loop: bool) -> None:
        """Let it take what is left, and close the recording; returns at once.

        Args:
            outcome: How the run ended; the output is safe as far as that can be had.
            lost_loop: Whether the loop could not say so itself: then nobody knows what became of
                the blocks that it had sent.
        """
        self._outcome, self._lost_loop = outcome, lost_loop
        self._ending.set()

    @property
    def takes_marks(self) -> bool:
        """Whether a mark will be in the file; no crowd of them waits for a disk that stands."""
        waiting = len(self._events) >= _MOST_WAITING
        return not (waiting or self._ending.is_set() or self.recorder.error)

    @property
    def finished(self) -> bool:
        """Whether the recording is closed."""
        return not self._thread.is_alive()

    def stalled_s(self) -> float:
        """Return for how long nothing in the ring has come to be safe in the file."""
        return time.monotonic() - self._released_s

    def _run(self) -> None:
        self._guarded(self.recorder.note_device)
        while not self._ending.wait(_POLL_S):
            self._guarded(self._work)
        self._guarded(self._finish)

    def _guarded(self, work: Callable[[], None]) -> None:
        """Do something; whatever goes wrong is an error of the recording, and not its silence."""
        try:
            work()
        except Exception as error:  # noqa: BLE001  what comes after is counted as lost
            self.recorder.fail(f"{type(error).__name__}: {error}")

    def _work(self) -> None:
        self._drain()
        if self.stalled_s() < self._flush_s:
            return
        # Room is given back only once the file has what stood there.
        if self.recorder.flush():
            self._ring.release(keep=self._ring.slots // _KEPT)
            self._released_s = time.monotonic()

    def _drain(self) -> bool:
        """Record what is there now; return whether there were samples."""
        page, recorder = self._ring.page, self.recorder
        took = False
        # Before the samples: whatever an event refers to stands in the ring by the time it is seen.
        self._of_loop.extend(page.pop_events())
        for batch in self._ring.batches():
            self.newest = batch.rows(slice(-1, None))
            recorder.batch(batch)
            took = True
        # After the samples: an event is recorded with those that led to it.
        while self._of_loop:
            recorder.event(self._of_loop.popleft())
        while self._events:
            event = self._events.popleft()
            recorder.event(event)
            page.leave_note(event)
        return took

    def _drain_all(self) -> None:
        while self._drain():
            pass

    def _finish(self) -> None:
        outcome, page, recorder = self._outcome, self._ring.page, self.recorder
        assert outcome is not None
        self._drain_all()
        while self._ring.skip_damaged():  # no more will come: take what stands behind them
            self._drain_all()
        if self._lost_loop:
            if (batch := self._ring.unanswered(recorder.next_sample)) is not None:
                recorder.batch(batch)
            ended_at = max(recorder.next_sample, page.get(PageField.ENDED_AT))
            outcome = replace(outcome, ended_at=ended_at)
        facts = end_facts(outcome, page.lateness(), page.get(PageField.EVENTS_LOST))
        facts |= usage_facts(page.usage(), ProcessUsage.now().since(self._before))
        recorder.finish(facts, outcome.ended_at)
