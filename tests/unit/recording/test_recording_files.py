"""Recovery and the files around it: nothing is destroyed, nothing is touched without need."""

import errno
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from mcap.reader import make_reader

from hilctl.base import private_dirs as locks
from hilctl.base.errors import DataError, InputError
from hilctl.base.events import Event
from hilctl.base.samples import BlockHeader
from hilctl.recording.reader import RecordingStream, read
from hilctl.recording.recording_files import is_being_recorded, lock
from hilctl.recording.recover import recover_recording
from hilctl.recording.writer import OutputFile
from tests.commands import hilctl
from tests.unit.recording.conftest import same_samples, same_ticks, written


@pytest.fixture
def batches(make):
    return [make.batch(1000 * i, 20, seed=i) for i in range(5)]


@pytest.fixture
def torn(make, batches, tmp_path):
    """A recording that was killed while it wrote its fourth chunk."""
    path = written(tmp_path / "run.mcap", batches[:3], finish=False)
    path.write_bytes(path.read_bytes() + b"\x06\x00")
    return path


def state(folder):
    return {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in folder.iterdir()}


def test_original_bytes_are_kept(torn):
    bytes_before = torn.read_bytes()
    assert recover_recording(torn).original == torn.with_name("run.mcap.torn")
    torn.write_bytes(bytes_before[:-3000])
    assert recover_recording(torn).original == torn.with_name("run.mcap.torn2")
    assert torn.with_name("run.mcap.torn").read_bytes() == bytes_before
    assert torn.with_name("run.mcap.torn2").read_bytes() == bytes_before[:-3000]
    assert len(list(torn.parent.iterdir())) == 3


@pytest.mark.parametrize("extra", [0, 3])
def test_intact_file_is_not_changed(torn, batches, extra):
    recover_recording(torn)
    before = state(torn.parent)
    recovered = recover_recording(torn, batches[:extra])
    assert recovered.sound
    assert recovered.samples == 3000
    assert state(torn.parent) == before


def test_output_option_keeps_the_original(torn):
    before = torn.read_bytes()
    output = torn.with_name("whole.mcap")
    recovered = recover_recording(torn, output=output)
    assert (recovered.path, recovered.original) == (output, torn)
    assert torn.read_bytes() == before
    assert read(output).samples.index.size == 3000
    whole = output.read_bytes()
    with pytest.raises(InputError, match="exists already"):
        recover_recording(torn, output=output)
    assert output.read_bytes() == whole
    assert len(list(torn.parent.iterdir())) == 2


def test_a_full_disk_changes_nothing(torn, monkeypatch):
    import hilctl.recording.recording_files as module

    before = state(torn.parent)
    monkeypatch.setattr(
        module.os, "fsync", Mock(side_effect=OSError(28, "No space left on device"))
    )
    with pytest.raises(InputError, match="No space"):
        recover_recording(torn)
    assert state(torn.parent) == before


def test_without_hard_links_the_old_file_is_renamed(torn, monkeypatch):
    import hilctl.recording.recording_files as module

    before = torn.read_bytes()
    monkeypatch.setattr(
        module.Path, "hardlink_to", Mock(side_effect=OSError(1, "Operation not permitted"))
    )
    assert recover_recording(torn).original.read_bytes() == before
    assert read(torn).samples.index.size == 3000


def test_permissions_and_links_are_kept(torn):
    torn.chmod(0o640)
    link = torn.with_name("latest.mcap")
    link.symlink_to(torn.name)
    recover_recording(link)
    assert link.is_symlink()
    assert read(link).end["code"] == "recovered"
    assert torn.stat().st_mode & 0o777 == 0o640


def test_reading_warns_and_writes_nothing(torn, caplog):
    before = state(torn.parent)
    torn.parent.chmod(0o555)
    samples = read(torn).samples
    torn.parent.chmod(0o755)
    assert samples.index.size == 3000
    assert state(torn.parent) == before
    (line,) = caplog.messages
    assert str(torn) in line
    assert "3000 samples" in line
    stream = RecordingStream(torn)
    assert len([*stream, *stream]) == 2
    assert caplog.messages == [line] * 2  # once per stream
    caplog.clear()
    recover_recording(torn)
    read(torn)
    assert not caplog.messages


def test_torn_and_recovered_files_read_the_same(torn):
    before = read(torn)
    recover_recording(torn)
    after = read(torn)
    same_samples(before.samples, after.samples)
    same_ticks(before.ticks, after.ticks)
    assert [each.sample for each in before.starts] == [each.sample for each in after.starts]
    assert (before.end, after.end["code"]) == ({}, "recovered")
    assert "unknown" in after.end["reason"]


def test_a_gap_in_a_torn_file_is_counted(make, tmp_path):
    path = written(
        tmp_path / "run.mcap", [make.batch(0, 4), make.batch(350, 4, dropped=150)], finish=False
    )
    assert read(path).dropped == 150


def test_a_recording_in_progress_is_refused(torn, caplog):
    whole = torn.read_bytes()
    claimed = OutputFile(torn, overwrite=True)
    with pytest.raises(InputError, match="is recording"):
        recover_recording(torn)
    with pytest.raises(OSError, match="is recording"):
        OutputFile(torn, overwrite=True)
    read(torn)
    assert "being recorded" in caplog.text
    claimed.give_back()
    assert torn.read_bytes() == whole
    assert not recover_recording(torn).sound


def test_absent_and_other_files_are_refused(tmp_path):
    path = tmp_path / "x.mcap"
    with pytest.raises(DataError, match=r"x\.mcap"):
        recover_recording(path)
    path.write_bytes(b"\xff" * 99)
    with pytest.raises(DataError, match=r"x\.mcap"):
        recover_recording(path)
    assert state(tmp_path).keys() == {"x.mcap"}


def test_batches_of_the_ring_complete_the_file(torn, batches, make):
    killed = {"code": "fault", "reason": "killed"}
    tuned = Event(3100, "info", "tuned", "gain to 2", {"samples": 20.0})
    recovered = recover_recording(torn, batches[2:], killed, events=[tuned])
    assert (recovered.samples, recovered.added_samples) == (5000, 2000)
    assert recovered.missing_samples == 0
    back = read(torn)
    assert back.samples.index.tolist() == list(range(5000))
    same_samples(back.samples, make.samples(batches))
    late_ns = np.concatenate([b.heads[:, BlockHeader.LATE_NS] for b in batches])
    assert back.ticks.late_ns.tolist() == late_ns.tolist()
    assert (back.end["code"], back.end["reason"]) == ("fault", "killed")
    assert [start.sample for start in back.starts] == [0]
    due_ns = make.start_ns + 3100 * 20_000
    assert back.events[-2] == replace(tuned, time_ns=due_ns)
    assert "2000 samples added" in back.events[-1].text
    with torn.open("rb") as stream:
        numbers = {}
        for _, channel, message in make_reader(stream).iter_messages(log_time_order=False):
            numbers.setdefault(channel.topic, []).append(message.sequence)
    assert all(each == list(range(len(each))) for each in numbers.values())


def test_overlapping_batches_and_gaps(torn, batches, make):
    straddling = make.batch(2500, 20, seed=9)
    late = batches[4].rows(slice(4, 20))
    recovered = recover_recording(torn, [straddling, late], ended_at=6000)
    assert (recovered.samples, recovered.added_samples) == (4300, 1300)
    back = read(torn)
    assert back.samples.index.tolist() == [*range(3500), *range(4200, 5000)]
    assert recovered.missing_samples == back.dropped == 1700
    assert [start.sample for start in back.starts] == [0, 4200]
    assert back.starts[1].state.tolist() == late.states[0, :-1].tolist()
    assert back.end["recorded_samples"] == "4300"


def test_recovery_from_batches_only(batches, tmp_path):
    path = written(tmp_path / "run.mcap", [], finish=False)
    recovered = recover_recording(path, batches)
    assert recovered.added_samples == read(path).samples.index.size == 5000


@pytest.mark.slow
def test_recover_command(torn):
    reported = hilctl("export", torn, torn.with_name("run.csv"))
    assert reported.stderr.startswith(f"hilctl: {torn}: ")
    assert "'hilctl recover'" in reported.stderr.splitlines()[0]
    first = hilctl("recover", torn)
    assert first.stderr == ""
    assert f"original file: {torn}.torn" in first.stdout
    second = hilctl("recover", torn)
    assert second.stdout.startswith(f"{torn}: ")
    assert "intact" in second.stdout


def test_recording_has_one_writer(tmp_path):
    path = tmp_path / "run.mcap"
    with path.open("xb") as writer, path.open("rb") as reader:
        lock(writer)
        assert is_being_recorded(reader)
        with pytest.raises(BlockingIOError, match="is recording"):
            lock(reader, shared=True)
        assert reader.closed


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.ENOTSUP, errno.EIO])
def test_a_file_system_without_locks_is_no_error(tmp_path, monkeypatch, code):
    monkeypatch.setattr(locks.fcntl, "flock", Mock(side_effect=OSError(code, "refused")))
    with (tmp_path / "run.mcap").open("xb") as writer:
        if code == errno.EIO:  # any other error is one
            with pytest.raises(OSError, match="refused"):
                lock(writer)
            return
        lock(writer)
        assert not is_being_recorded(writer)
