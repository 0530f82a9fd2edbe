"""The recorder: from the ring into the recording, with retries of refused writes.

A thread consumes the ring. Samples stay there until the file contains them, so a disk that stalls
or refuses writes loses nothing while the ring has room, and delays no other thread.
"""

import errno
import logging
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from queue import SimpleQueue

import numpy as np

from hilctl.base.errors import InputError
from hilctl.base.events import ADAPTED, Event
from hilctl.base.files import already_there, reason, sync_folder
from hilctl.base.samples import BlockBatch, BlockHeader, Samples
from hilctl.experiment.coil_heat import CoilHeat
from hilctl.experiment.preflight import CheckedExperiment, CheckedRun
from hilctl.experiment.sections.correction import dump_correction
from hilctl.experiment.sections.coupling import dump_coupling
from hilctl.experiment.state_files import CoilState, DeviceState, MachineTime, names_of, write_state
from hilctl.loop.safe_output import LoopOutcome
from hilctl.machine.procfs import ProcessUsage
from hilctl.models.model_file import dump_model
from hilctl.recording.encoder import RecordingLayout
from hilctl.recording.metadata_keys import HEAT_FACT
from hilctl.recording.writer import OutputFile, RecordingWriter, RunFacts
from hilctl.run.metadata import EndFigures, end_facts, run_facts, usage_facts
from hilctl.run.result import AxisResult
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import PageField, SharedPage

_log = logging.getLogger(__name__)

_SAMPLES_BEFORE = 50
_SPARE = 20
_PATIENCE_S = 5.0
_RETRY_S = 0.05
_POLL_S = 0.05
_MOST_WAITING = 64
_KEPT = 8  # 1/8 of the ring stays readable for watchers


class Recorder:
    """Record one axis of a run into one file; the next flush repeats a failed write.

    ``run_id`` and ``axes`` are those of the run, see :func:`hilctl.run.metadata.run_facts`.
    """

    def __init__(
        self,
        checked: CheckedExperiment,
        path: Path,
        *,
        overwrite: bool,
        run_id: str = "",
        axes: Sequence[str] = (),
    ) -> None:
        self.path = path
        self._run_id, self._axes = run_id, axes
        self.adapted: Mapping[str, float] = {}
        """Values of the last event of adaptation."""
        self._failed = self._problem = ""
        self._states: SimpleQueue[DeviceState | None] = SimpleQueue()
        # Its disk may hang; that of the recording must not wait for it. One thread, because a new
        # one at the end of the run could lack memory.
        self._noting = threading.Thread(target=self._write_states, name="device state", daemon=True)
        self.next_sample = self._flushed = 0
        self._checked = checked
        self._unix_ns = steady_unix_ns()
        self._tail = RecentSamples(_SAMPLES_BEFORE)
        config = checked.loaded.config
        self._heat = CoilHeat(config.limits, config.sample_rate_hz, checked.heat_a2)
        # Set by `begin`.
        self._run: RunFacts
        self._writer: RecordingWriter
        self._figures: EndFigures
        try:
            self._file = OutputFile(path, overwrite=overwrite, sync=config.recording.sync)
        except FileExistsError:
            raise already_there(path, "choose another output, or overwrite") from None
        except OSError as error:
            raise InputError(self._cannot(reason(error))) from None

    def begin(self, start_unix_ns: int, set_up: Mapping[str, str], waveform_at: int = 0) -> None:
        """Write the metadata that precedes the first sample."""
        self._unix_ns = steady_unix_ns()
        try:
            # Before the file is opened for writing, which truncates an existing one.
            self._run = self._facts(start_unix_ns, set_up, waveform_at)
            self._write_start()
        except OSError as error:
            raise InputError(self._cannot(reason(error))) from None
        compensated = self._checked.loaded.model is not None
        aux = self._checked.loaded.device.info.aux
        self._figures = EndFigures(self._run.segments, compensated=compensated, aux=aux)
        # Before anything moves: the file may have been deleted.
        if not self.flush():
            raise InputError(self.error)

    def _write_start(self) -> None:
        self._writer = RecordingWriter(self._file.begin(), self._run)

    def postpone(self, later_ns: int) -> None:
        """Write the metadata again, before the first sample: the run began that much later."""
        run, layout = self._run, self._run.layout
        start_unix_ns = layout.start_unix_ns + later_ns
        self._run = replace(
            run,
            facts={**run.facts, "started": iso_time(start_unix_ns)},
            layout=replace(layout, start_unix_ns=start_unix_ns),
        )
        try:
            self._write_start()
        except OSError as error:
            self._note_problem(error)

    def discard(self) -> None:
        """Remove the file if the run does not start; an existing one stays as it was."""
        self._file.give_back()

    def note_device(self, coil: CoilState | None = None) -> None:
        """Start to write the device state, with the coil at the end: this is its last run."""
        facts, info = self._run.facts, self._checked.loaded.device.info
        path, now = self.path, MachineTime.now()
        with suppress(OSError):  # the working folder was removed
            path = path.absolute()
        if not (names := names_of(info)):
            return
        state = DeviceState(
            holds=list(names),
            output=info.output,
            run_id=facts["run_id"],
            recording=str(path),
            started=datetime.fromisoformat(facts["started"]),
            boot=now.boot,
            boot_s=now.boot_s + (self._longest_s() if coil is None else 0.0),
            coil=coil,
        )
        self._states.put(state)
        if self._noting.ident is None:
            self._noting.start()

    def _write_states(self) -> None:
        with suppress(MemoryError):  # the state of the start remains: it is unknown
            while (state := self._states.get()) is not None:
                write_state(state)

    def await_noted(self, timeout_s: float = _PATIENCE_S) -> None:
        """Wait until the last device state is written, or warn that it cannot be."""
        self._states.put(None)
        if self._noting.is_alive():
            self._noting.join(timeout_s)
            if self._noting.is_alive():
                _log.warning("the state of the device is not written yet: its disk hangs")

    def _longest_s(self) -> float:
        """Return the longest time that the run can last."""
        config, forecast = self._checked.loaded.config, self._checked.forecast
        awaited_s = config.trigger.timeout_s if config.trigger else 0.0
        return forecast.before_s + forecast.duration_s + 2.0 * config.safe.ramp_s + awaited_s

    def batch(self, batch: BlockBatch) -> None:
        """Write a batch."""
        self.next_sample = int(batch.heads[-1, BlockHeader.FIRST_SAMPLE]) + batch.flags.shape[1]
        self._tail.add(batch)
        self._heat.follow(batch.samples())
        if self._writer.samples == 0:
            # The file counts samples that are missing before its first one.
            batch.heads[0, BlockHeader.DROPPED_BEFORE] = batch.heads[0, BlockHeader.FIRST_SAMPLE]
        self._write(partial(self._writer.batch, batch))
        self._figures.add(batch.samples())

    def event(self, event: Event) -> None:
        """Write an event with the samples before it."""
        if event.code == ADAPTED:
            self.adapted = event.values
        self._figures.event(event)
        led_there = replace(event, before=self._tail.up_to(event.sample))
        self._write(partial(self._writer.event, led_there))

    @property
    def error(self) -> str:
        """Why the file cannot be written now; may be empty."""
        refused = self._file.stream.problem
        return self._failed or self._problem or (self._cannot(refused) if refused else "")

    def fail(self, why: str) -> None:
        """End the recording; the file stays as of the last flush."""
        self._failed = self._failed or self._cannot(why)

    def _cannot(self, why: str | None) -> str:
        return f"{self.path}: cannot be written: {why}"

    def flush(self) -> bool:
        """Pass all pending data to the kernel; return whether the file contains all of it."""
        if self._failed:
            return False
        try:
            self._writer.flush()
            # If a later write fails, only these are certain.
            self._flushed = self._writer.samples
        except OSError as error:
            self._note_problem(error)
            return False
        if self._problem:
            text = f"write repeated, nothing is lost: {self._problem}"
            sample = max(0, self.next_sample - 1)
            event = Event(sample, "warning", "recording_retried", text, time_ns=self._unix_ns())
            self._write(partial(self._writer.event, event))
            self._problem = ""
        return True

    def _note_problem(self, error: OSError) -> None:
        if error.errno == errno.ESTALE:
            self._flushed = 0  # the file is not readable by its name
        self._problem = self._problem or self._cannot(error.strerror)

    def finish(
        self, end: Mapping[str, str], ended_at: int, patience_s: float = _PATIENCE_S
    ) -> bool:
        """Write the end of the run, sync and close the file; return whether it is on the disk."""
        self.next_sample = max(self.next_sample, ended_at)
        self.flush()
        level = "info" if end["code"] == "completed" else "error"
        now_ns = self._unix_ns()
        facts = {**end, **self._figures.facts(), "ended": iso_time(now_ns)}
        facts[HEAT_FACT] = repr(self._heat.heat_a2)
        event = Event(max(0, ended_at - 1), level, "run_ended", end["reason"], time_ns=now_ns)
        self._write(partial(self._writer.event, event))
        self._write(partial(self._writer.finish, facts, ended_at))
        until_s = time.monotonic() + patience_s
        while not (closed := self._closed()) and not self._failed and time.monotonic() < until_s:
            time.sleep(_RETRY_S)
        if closed:
            limits = self._checked.loaded.config.limits
            coil = CoilState(
                ended=datetime.fromtimestamp(now_ns * 1e-9, tz=UTC),
                output_safe=end.get("output_safe") == "true",
                heat_a2=self._heat.heat_a2,
                thermal_time_constant_s=limits.thermal_time_constant_s,
            )
            self.note_device(coil)
        else:
            self._file.stream.abandon()
        self.await_noted(patience_s)
        return closed

    def _closed(self) -> bool:
        """Close the finished file; return whether it is complete."""
        if self._failed:
            return False
        try:
            self._file.stream.flush(sync=True)
            sync_folder(self.path.parent)
        except OSError as error:
            self._note_problem(error)
            return False
        with suppress(OSError):  # already on the disk
            self._file.stream.close()
        self._problem = ""
        return True

    @property
    def samples(self) -> int:
        """Samples written; after an error, samples flushed before it."""
        return self._flushed if self.error else self._writer.samples

    @property
    def missing(self) -> int:
        """Missing samples: counted in the recording, or not written yet."""
        return self.next_sample - self._flushed if self.error else self._writer.missing

    def _write(self, write: Callable[[], None]) -> None:
        if not self._failed:
            write()

    def _facts(self, start_unix_ns: int, set_up: Mapping[str, str], waveform_at: int) -> RunFacts:
        loaded = self._checked.loaded
        config, info = loaded.config, loaded.device.info
        model_yaml = dump_model(loaded.model) if loaded.model else ""
        correction_yaml = dump_correction(loaded.correction) if loaded.correction else ""
        started = iso_time(start_unix_ns)
        coupling_yaml = dump_coupling(loaded.coupling) if loaded.coupling else ""
        texts = started, model_yaml, correction_yaml, coupling_yaml
        facts = run_facts(self._checked, *texts, run_id=self._run_id, axes=self._axes)
        return RunFacts(
            facts={**facts, **set_up},
            segments=tuple(each.shifted(waveform_at) for each in self._checked.reference.segments),
            experiment_yaml=loaded.yaml_text,
            model_yaml=model_yaml,
            correction_yaml=correction_yaml,
            coupling_yaml=coupling_yaml,
            device_files=info.files,
            layout=RecordingLayout(
                sample_rate_hz=config.sample_rate_hz,
                command_unit=info.command_unit,
                measures_command=info.measures_command,
                scope_rate_hz=config.recording.scope_rate_hz,
                start_unix_ns=start_unix_ns,
                records_input=self._checked.records_input,
                waveform_unit=self._checked.reference.unit,
                ages_readings=info.ages_readings,
                corrects_readings=info.corrects_readings,
            ),
        )


def recorders_of(
    run: CheckedRun, recordings: Mapping[str, Path], *, overwrite: bool
) -> list[Recorder]:
    """Return a recorder per axis; raise InputError if a file cannot be written: then none is."""
    run_id = str(uuid.uuid4())
    made: list[Recorder] = []
    try:
        for checked, path in zip(run.axes, recordings.values(), strict=True):
            made.append(Recorder(checked, path, overwrite=overwrite, run_id=run_id, axes=run.names))
    except BaseException:
        discard_all(made)
        raise
    return made


def discard_all(recorders: Sequence[Recorder]) -> None:
    """Remove the files of a run that does not start."""
    for recorder in recorders:
        recorder.discard()


def result_of(recorder: Recorder) -> AxisResult:
    """Return what a recorder has recorded."""
    return AxisResult(recorder.path, recorder.samples, recorder.missing, recorder.adapted)


class RecentSamples:
    """The last samples of a run."""

    def __init__(self, samples: int) -> None:
        self._samples = samples
        self._newest: Samples | None = None

    def add(self, batch: BlockBatch) -> None:
        """Add a batch; some more samples are kept, for late events."""
        kept = _SPARE * self._samples
        blocks = -(-kept // batch.flags.shape[1])
        newest = batch.samples(slice(-blocks, None))
        if self._newest is not None:
            newest = self._newest.followed_by(newest)
        self._newest = newest.rows(slice(-kept, None))

    def up_to(self, sample: int) -> Samples | None:
        """Return the last samples up to and including ``sample``; None if none is left."""
        if self._newest is None:
            return None
        stop = int(np.searchsorted(self._newest.index, sample, side="right"))
        return self._newest.rows(slice(max(0, stop - self._samples), stop)) if stop else None


def steady_unix_ns() -> Callable[[], int]:
    """Return a clock of Unix time in ns that ignores later changes of the system time."""
    offset_ns = time.time_ns() - time.monotonic_ns()
    return lambda: time.monotonic_ns() + offset_ns


def iso_time(unix_ns: int) -> str:
    """Return a Unix time in ns as ISO 8601, UTC."""
    return datetime.fromtimestamp(unix_ns * 1e-9, tz=UTC).isoformat(timespec="milliseconds")


class AxisRecording:
    """The ring of one axis, and its recorder.

    Args:
        page: Page of the run.
    """

    def __init__(self, ring: SampleRing, recorder: Recorder, page: SharedPage) -> None:
        self.recorder = recorder
        self.newest: BlockBatch | None = None
        """A copy of the newest block."""
        self.events: deque[Event] = deque()
        """Events of the supervisor."""
        self._ring, self._page = ring, page
        self._of_loop: deque[Event] = deque()
        self._start_ns = 0

    def begin(self, start_ns: int) -> None:
        """Note the monotonic start of the run."""
        self._start_ns = start_ns

    def guarded(self, work: Callable[[], object]) -> bool:
        """Call a function; return whether it succeeds. Its error is one of the recording."""
        try:
            return work() is not False
        except Exception as error:  # noqa: BLE001  later samples are counted as missing
            self.recorder.fail(f"{type(error).__name__}: {error}")
            return False

    def release(self) -> bool:
        """Flush the file, and release the ring; return whether the file has all samples."""
        if not self.recorder.flush():
            return False
        self._ring.release(keep=self._ring.slots // _KEPT)
        return True

    def drain(self, *, ending: bool) -> bool:
        """Record all new samples and events; return whether there were samples."""
        page, recorder = self._ring.page, self.recorder
        took = False
        # Before the samples: the ring then contains the samples that an event refers to.
        self._of_loop.extend(page.pop_events())
        for batch in self._ring.batches():
            self.newest = batch.rows(slice(-1, None))
            self._record(batch)
            took = True
        # Before the first sample the start may still be postponed, which writes the file again.
        if self.newest is None and not ending:
            return took
        # After the samples: an event is recorded with the samples before it.
        while self._of_loop:
            recorder.event(self._of_loop.popleft())
        while self.events:
            event = self.events.popleft()
            recorder.event(event)
            page.leave_note(event)
        return took

    def finish(self, outcome: LoopOutcome, before: ProcessUsage, *, lost_loop: bool) -> None:
        """Drain the ring, and close the recording with the outcome of the run.

        ``before`` is the usage of this process at the start of the run.
        """
        page, recorder = self._ring.page, self.recorder
        self._drain_all()
        while self._ring.skip_damaged():
            self._drain_all()
        if lost_loop:
            if (batch := self._ring.unanswered(recorder.next_sample)) is not None:
                self._record(batch)
            ended_at = max(recorder.next_sample, page.get(PageField.ENDED_AT))
            outcome = replace(outcome, ended_at=ended_at)
        facts = end_facts(outcome, self._page.lateness(), *page.losses())
        facts |= usage_facts(self._page.usage(), ProcessUsage.now().since(before))
        recorder.finish(facts, outcome.ended_at)

    def _record(self, batch: BlockBatch) -> None:
        """Record a batch, after the time of a start that was postponed."""
        if (later_ns := self._page.get(PageField.START_NS) - self._start_ns) > 0:
            self.recorder.postpone(later_ns)
            self._start_ns += later_ns
        self.recorder.batch(batch)

    def _drain_all(self) -> None:
        while self.drain(ending=True):
            pass


class RingRecorder:
    """Thread that consumes the rings of a run until the end of its recordings.

    It is their only consumer. The first ring has the page of the run.
    """

    def __init__(
        self, rings: Sequence[SampleRing], recorders: Sequence[Recorder], flush_s: float
    ) -> None:
        self.recorders = recorders
        self._page, self._flush_s = rings[0].page, flush_s
        self._axes = [
            AxisRecording(*each, self._page) for each in zip(rings, recorders, strict=True)
        ]
        self._outcome: LoopOutcome | None = None
        self._lost_loop = False
        self._ending = threading.Event()
        self._released_s = time.monotonic()
        self._before = ProcessUsage.now()
        self._thread = threading.Thread(target=self._run, name="recorder")

    def start(self, start_ns: int) -> None:
        """Start the thread, for a run that begins at a monotonic time."""
        for axis in self._axes:
            axis.begin(start_ns)
        self._before = ProcessUsage.now()
        self._released_s = time.monotonic()
        self._thread.start()

    def record_event(self, event: Event) -> None:
        """Queue an event of the supervisor."""
        for axis in self._axes:
            axis.events.append(event)

    def end(self, outcome: LoopOutcome, *, lost_loop: bool) -> None:
        """Let the thread drain the rings and close the recordings."""
        self._outcome, self._lost_loop = outcome, lost_loop
        self._ending.set()

    @property
    def newest(self) -> BlockBatch | None:
        """A copy of the newest block of the first axis."""
        return self._axes[0].newest

    @property
    def error(self) -> str:
        """Why a file cannot be written now; may be empty."""
        return next(filter(None, (each.error for each in self.recorders)), "")

    @property
    def takes_marks(self) -> bool:
        """Whether marks are accepted: few events are waiting, and the files are writable."""
        waiting = any(len(each.events) >= _MOST_WAITING for each in self._axes)
        return not (waiting or self._ending.is_set() or self.error)

    @property
    def finished(self) -> bool:
        """Whether the recordings are closed."""
        return not self._thread.is_alive()

    def stalled_s(self) -> float:
        """Return the time since all rings were last released."""
        return time.monotonic() - self._released_s

    def _run(self) -> None:
        for axis in self._axes:
            axis.guarded(axis.recorder.note_device)
        while not self._ending.wait(_POLL_S):
            self._work()
        self._finish()

    def _drain(self) -> None:
        for axis in self._axes:
            axis.guarded(partial(axis.drain, ending=self._ending.is_set()))

    def _finish(self) -> None:
        outcome = self._outcome
        assert outcome is not None
        for axis in self._axes:
            axis.guarded(partial(axis.finish, outcome, self._before, lost_loop=self._lost_loop))

    def _work(self) -> None:
        self._drain()
        if self.stalled_s() < self._flush_s:
            return
        # Released only after the files contain the samples.
        released = [axis.guarded(axis.release) for axis in self._axes]
        if all(released):
            self._released_s = time.monotonic()
