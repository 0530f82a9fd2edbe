"""The recorder of a run whose disk refuses writes: every sample is recorded or counted, once."""

import errno
import os
import shutil
import threading
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from mcap.writer import MCAP0_MAGIC

from hilctl.base.errors import InputError
from hilctl.base.events import Event
from hilctl.base.samples import BlockBatch, BlockHeader
from hilctl.experiment.state_files import MachineTime, last_runs
from hilctl.loop.safe_output import LoopOutcome
from hilctl.recording.reader import read
from hilctl.recording.run_summary import read_ends
from hilctl.recording.writer import OutputFile, PendingFile
from hilctl.run import recorder
from hilctl.run.recorder import RecentSamples, Recorder, RingRecorder
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import PageField
from hilctl.run.start import checked_experiment
from tests.fakes import FailingFile

EXPERIMENT = Path(__file__).parents[3] / "configs" / "demo.yaml"
BLOCK = 10
END = {"code": "completed", "reason": "waveform completed"}


def batch(first, blocks, dropped=0):
    """Return consecutive blocks, the first after a gap of ``dropped`` samples."""
    made = BlockBatch.empty(blocks, BLOCK, 3)
    made.heads[:, BlockHeader.FIRST_SAMPLE] = first + BLOCK * np.arange(blocks)
    made.heads[:, BlockHeader.SAMPLES] = BLOCK
    made.heads[0, BlockHeader.DROPPED_BEFORE] = dropped
    made.columns[:] = np.random.default_rng(first).normal(size=made.columns.shape)
    return made


@pytest.fixture(scope="module")
def checked():
    """A checked experiment."""
    return checked_experiment(EXPERIMENT, [])


@pytest.fixture
def begun(checked, monkeypatch, tmp_path):
    disks = []

    class Output(OutputFile):
        def __init__(self, path, **options):
            super().__init__(path, **options)
            self.stream.close()
            disks.append(FailingFile(path))
            self.stream = PendingFile(disks[-1])

    monkeypatch.setattr(recorder, "OutputFile", Output)
    made = Recorder(checked, tmp_path / "run.mcap", overwrite=False)
    made.begin(10**18, {})
    yield made, disks[0]
    disks[0].close()


@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC])
def test_a_refused_write_loses_neither_samples_nor_events(begun, number):
    made, disk = begun
    made.batch(batch(0, 20))
    assert made.flush()
    disk.write_errors = [number]
    made.batch(batch(200, 20))
    made.event(Event(399, "error", "stroke", "beyond its limit"))
    assert not made.flush()
    assert os.strerror(number) in made.error
    assert (made.samples, made.missing, made.next_sample) == (200, 200, 400)
    made.batch(batch(400, 20))
    assert made.flush()
    assert (made.error, made.samples, made.missing) == ("", 600, 0)
    assert made.finish(END, 600)
    recording = read(made.path)
    assert np.array_equal(recording.samples.index, np.arange(600))
    assert [each.code for each in recording.events] == ["stroke", "recording_retried", "run_ended"]
    assert recording.dropped == 0


def test_recording_is_complete_if_the_disk_has_room_at_the_end(begun, monkeypatch):
    made, disk = begun
    made.batch(batch(0, 20))
    made.flush()
    disk.room = disk.tell() + 100
    monkeypatch.setattr(recorder.time, "sleep", lambda _: setattr(disk, "room", 10**9))
    made.batch(batch(200, 20))
    assert made.finish(END, 400)
    assert (made.error, made.samples, made.missing) == ("", 400, 0)
    recording = read(made.path)
    assert recording.samples.index.size == 400
    assert recording.end["code"] == "completed"


def test_a_recording_counts_as_complete_once_it_is_on_the_disk(begun, monkeypatch):
    made, _ = begun
    synced = []

    def fsync(descriptor):
        path = Path(f"/proc/self/fd/{descriptor}").readlink()
        synced.append((path, made.path.read_bytes().endswith(MCAP0_MAGIC)))

    monkeypatch.setattr(os, "fsync", fsync)
    made.batch(batch(0, 20))
    made.flush()
    assert synced == []
    assert made.finish(END, 200)
    assert synced == [(made.path, True), (made.path.parent, True)]


def test_failed_sync_at_the_end_is_an_error(begun, monkeypatch):
    made, _ = begun

    monkeypatch.setattr(os, "fsync", Mock(side_effect=OSError(errno.EIO, os.strerror(errno.EIO))))
    made.batch(batch(0, 20))
    made.flush()
    assert not made.finish(END, 200, patience_s=0.0)
    assert "Input/output" in made.error


def test_the_state_of_the_device_names_the_run_and_how_it_ended(checked, tmp_path):
    """From its start: the state must not be that of the run before if this one is killed."""
    device = checked.loaded.device
    info = replace(device.info, holds=("tcp:10.0.0.5:502",), output="7:DAC1")
    real = SimpleNamespace(info=info)
    checked = replace(checked, heat_a2=4.0, loaded=replace(checked.loaded, device=real))
    made = Recorder(checked, tmp_path / "run.mcap", overwrite=False)
    made.begin(10**18, {})
    made.note_device()
    while not last_runs(real.info):
        pass
    (begun,) = (run.state for run in last_runs(real.info))
    run_id = read_ends(made.path).run["run_id"]
    assert (begun.run_id, begun.recording, begun.coil) == (run_id, str(made.path), None)
    assert begun.started.timestamp() == 1e9
    assert begun.boot_s > MachineTime.now().boot_s  # when it ends at the latest
    made.batch(batch(0, 20))
    assert made.finish({**END, "output_safe": "true"}, 200)
    (ended,), facts = (run.state for run in last_runs(real.info)), read(made.path).end
    assert (ended.boot, ended.output) == (MachineTime.now().boot, "7:DAC1")
    assert ended.boot_s <= MachineTime.now().boot_s
    assert ended.run_id == run_id
    assert ended.coil.output_safe
    assert ended.coil.heat_a2 == float(facts["coil_heat_a2"])
    assert (
        abs(ended.coil.ended.timestamp() - datetime.fromisoformat(facts["ended"]).timestamp())
        < 2e-3
    )


def test_a_state_whose_disk_hangs_delays_no_recording(checked, tmp_path, monkeypatch, caplog):
    """Both writes of the state wait, in order, for a network folder that is gone."""
    released, written = threading.Event(), []

    def write(state):
        released.wait(60.0)
        written.append(state.coil is not None)

    monkeypatch.setattr(recorder, "write_state", write)
    info = replace(checked.loaded.device.info, holds=("tcp:10.0.0.5:502",))
    loaded = replace(checked.loaded, device=SimpleNamespace(info=info))
    made = Recorder(replace(checked, loaded=loaded), tmp_path / "run.mcap", overwrite=False)
    made.begin(10**18, {})
    made.note_device()
    made.batch(batch(0, 20))
    assert made.finish({**END, "output_safe": "true"}, 200, patience_s=0.01)
    assert (read(made.path).end["code"], written) == (END["code"], [])
    assert "hangs" in caplog.messages[-1]
    released.set()
    made.await_noted(60.0)
    assert written == [False, True]


def test_a_bug_ends_the_recording_as_it_was_flushed(begun):
    made, _ = begun
    made.batch(batch(0, 20))
    made.flush()
    made.batch(batch(200, 20))
    made.fail("ZeroDivisionError: a bug")
    assert not made.flush()
    assert not made.finish(END, 400)
    assert (made.samples, made.missing) == (200, 200)
    assert read(made.path).samples.index.size == 200


def numbered(first, blocks, block):
    """Return blocks in which every value of a sample is its index."""
    made = BlockBatch.empty(blocks, block, 1)
    made.heads[:, BlockHeader.FIRST_SAMPLE] = first + block * np.arange(blocks)
    numbers = first + np.arange(blocks * block).reshape(blocks, block)
    made.columns[:] = numbers[:, None, :]
    made.flags[:] = numbers
    return made


@pytest.mark.parametrize("block", [1, 7, 4000])
def test_recent_samples_end_at_the_requested_one(block):
    tail = RecentSamples(50)
    for start in range(0, 40 * block, 4 * block):
        tail.add(numbered(start, 4, block))
    last = 40 * block - 1
    for sample in (last, last - min(3, last)):
        found = tail.up_to(sample)
        first = max(0, sample - 49)
        assert found.index.tolist() == list(range(first, sample + 1))
        assert found.command.tolist() == found.index.tolist()
        assert found.flags.tolist() == found.index.tolist()


def test_no_recent_samples_before_the_first_one():
    tail = RecentSamples(50)
    assert tail.up_to(10) is None
    tail.add(numbered(100, 1, 5))
    assert tail.up_to(99) is None
    assert tail.up_to(102).index.tolist() == [100, 101, 102]


@pytest.fixture
def on_a_disk(checked, tmp_path):
    """A recorder in a folder that can be removed."""
    folder = tmp_path / "disk"
    folder.mkdir()
    return Recorder(checked, folder / "run.mcap", overwrite=False)


def test_recording_is_complete_if_its_folder_returns(on_a_disk):
    folder = on_a_disk.path.parent
    on_a_disk.begin(10**18, {})
    on_a_disk.batch(batch(0, 20))
    folder.rename(away := folder.with_name("away"))
    assert not on_a_disk.flush()
    away.rename(folder)
    assert on_a_disk.finish(END, 200)
    recording = read(on_a_disk.path)
    assert recording.samples.index.size == 200
    assert [event.code for event in recording.events] == ["recording_retried", "run_ended"]
    assert (on_a_disk.error, on_a_disk.missing) == ("", 0)


@pytest.mark.parametrize("refused", [[], [errno.ENOSPC]], ids=["at once", "after a retry"])
def test_a_postponed_start_is_in_the_file(begun, refused):
    made, disk = begun
    disk.write_errors = refused
    made.postpone(1_500_000_000)
    made.batch(batch(0, 20))
    assert made.finish(END, 200)
    recording = read(made.path)
    assert datetime.fromisoformat(recording.run["started"]).timestamp() == 1e9 + 1.5
    assert np.array_equal(recording.samples.index, np.arange(200))
    assert recording.run["run_id"] == made._run.facts["run_id"]


def test_a_recording_that_is_deleted_before_the_start_is_refused(on_a_disk):
    shutil.rmtree(on_a_disk.path.parent)
    with pytest.raises(InputError, match="deleted"):
        on_a_disk.begin(10**18, {})
    on_a_disk.discard()


ENDED = LoopOutcome("completed", "waveform completed", 8, "confirmed")


class RecorderDouble:
    """Records its arguments; a flush waits for ``disk``."""

    def __init__(self):
        self.firsts, self.events, self.finished, self.errors = [], [], None, []
        self.postponed = []
        self.disk = threading.Event()
        self.disk.set()
        self.broken = self.refused = False

    @property
    def next_sample(self):
        return self.firsts[-1] + 1 if self.firsts else 0

    def batch(self, batch):
        if self.broken:
            raise ZeroDivisionError("a bug")
        self.firsts += batch.heads[:, BlockHeader.FIRST_SAMPLE].tolist()

    def event(self, event):
        self.events.append(event.code)

    def postpone(self, later_ns):
        self.postponed.append((later_ns, len(self.firsts)))

    def note_device(self):
        self.noted = len(self.firsts)

    def flush(self):
        assert self.disk.wait(30.0)
        return not self.refused

    def fail(self, why):
        self.errors.append(why)

    def finish(self, facts, ended_at):
        self.finished = (facts["reason"], ended_at)
        self.facts = facts


@pytest.fixture
def ring(tmp_path):
    return SampleRing.create(tmp_path / "ring", slots=8, block=1, state_size=1)


@pytest.fixture
def recording(ring):
    """A recording of a ring that is not started: the test calls each step."""
    return RingRecorder([ring], [RecorderDouble()], flush_s=0.0)


def exchange(ring, count, *, answered=True):
    for _ in range(count):
        block = ring.claim()
        block.head[BlockHeader.FIRST_SAMPLE] = block.number
        ring.sending(block)
        if answered:
            ring.answered(block)


def test_a_loop_lost_in_its_first_exchange_leaves_its_later_start(ring, recording):
    recording._axes[0].begin(100)
    ring.page.put(PageField.START_NS, 130)
    exchange(ring, 1, answered=False)
    recording.end(ENDED, lost_loop=True)
    recording._finish()
    assert recording.recorders[0].postponed == [(30, 0)]
    assert recording.recorders[0].firsts == [0]


def test_fast_loop_does_not_delay_flushes(ring, recording):
    exchange(ring, 1)
    flushed = []
    batch, flush = recording.recorders[0].batch, recording.recorders[0].flush

    def slow(taken):
        batch(taken)
        exchange(ring, len(taken.heads))

    recording.recorders[0].batch = slow
    recording.recorders[0].flush = lambda: (
        flushed.append(recording.recorders[0].next_sample) or flush()
    )
    for _ in range(4):
        recording._work()
    assert flushed == sorted(set(flushed))
    assert len(flushed) == 4
    recording.recorders[0].batch = batch
    recording.end(ENDED, lost_loop=False)
    recording._finish()
    numbers = recording.recorders[0].firsts
    assert numbers == list(range(len(numbers)))
    assert ring.pop() is None


def test_an_event_of_the_loop_never_comes_before_its_samples(ring, recording, monkeypatch):
    batches, recorder, went_on = ring.batches, recording.recorders[0], []

    def batches_and_go_on():
        yield from batches()
        if not went_on:
            went_on.append(True)
            exchange(ring, 1)
            ring.page.push_event(Event(0, "error", "stroke", ""))

    monkeypatch.setattr(ring, "batches", batches_and_go_on)
    recording._drain()
    assert (recorder.firsts, recorder.events) == ([], [])
    recording._drain()
    assert (recorder.firsts[:1], recorder.events) == ([0], ["stroke"])


def test_sent_blocks_of_a_dead_loop_are_recorded_as_unanswered(ring, recording):
    exchange(ring, 4)
    exchange(ring, 2, answered=False)
    ring._area.heads[1, BlockHeader.SEQUENCE] = 77
    recording.end(LoopOutcome("fault", "it died", 0, "confirmed"), lost_loop=True)
    recording._finish()
    assert recording.recorders[0].firsts == [0, 2, 3, 4, 5]
    assert recording.recorders[0].finished == ("it died", 6)


def test_error_of_the_recorder_thread_is_reported_and_the_recording_ended(ring, recording):
    exchange(ring, 2)
    recording.recorders[0].broken = True
    recording._work()
    assert recording.recorders[0].errors == ["ZeroDivisionError: a bug"]
    recording.recorders[0].broken = False
    recording.end(ENDED, lost_loop=False)
    recording.start(0)
    recording._thread.join(30.0)
    assert recording.finished
    assert recording.recorders[0].finished == ("waveform completed", 8)


def test_each_axis_counts_its_own_dropped_samples(ring, tmp_path):
    other = SampleRing.create(tmp_path / "ring-1", slots=2, block=1, state_size=1)
    recording = RingRecorder([ring, other], [RecorderDouble(), RecorderDouble()], flush_s=0.0)
    exchange(ring, 5)
    exchange(other, 2)
    other.answered(other.claim())
    recording.end(ENDED, lost_loop=False)
    recording._finish()
    assert [each.facts["dropped_in_ring"] for each in recording.recorders] == ["0", "1"]


def test_marks_are_accepted_while_they_can_be_recorded(ring, recording):
    exchange(ring, 1)
    recording.recorders[0].error = ""
    assert recording.takes_marks
    for _ in range(64):
        recording.record_event(Event(0, "info", "mark", "tapped"))
    assert not recording.takes_marks
    recording._drain()
    assert recording.takes_marks
    recording.recorders[0].error = "no room"
    assert not recording.takes_marks
    recording.recorders[0].error = ""
    recording.end(ENDED, lost_loop=False)
    assert not recording.takes_marks
