"""Calls of Linux that a process without rights may make, and errors that are told as such."""

import gc
import os

import pytest

from hilctl.machine import syscalls
from hilctl.machine.syscalls import LinuxProcess


@pytest.fixture
def process():
    return LinuxProcess()


def test_an_error_of_the_system_is_raised_with_its_number(process):
    """Closing a file that is not open: errno 9."""
    with pytest.raises(OSError, match="Bad file descriptor") as error:
        process._call("close", -1)
    assert error.value.errno == 9


def test_pinning_is_undone(process):
    before = os.sched_getaffinity(0)
    try:
        process.pin(min(before))
        assert os.sched_getaffinity(0) == {min(before)}
    finally:
        process.undo()
    assert os.sched_getaffinity(0) == before
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


def test_garbage_is_collected_no_more_and_again(process):
    try:
        process.freeze_gc()
        assert not gc.isenabled()
        assert gc.get_freeze_count() > 0
    finally:
        process.undo()
    assert gc.isenabled()


def test_idle_states_are_held_off_as_long_as_the_file_is_open(process, tmp_path, monkeypatch):
    """Four bytes, and the file stays open until the end."""
    held = tmp_path / "cpu_dma_latency"
    held.touch()
    monkeypatch.setattr(syscalls, "DMA_LATENCY", str(held))
    process.hold_dma_latency(20)
    descriptor = process._latency_file
    assert held.read_bytes() == b"\x14\0\0\0"
    assert os.fstat(descriptor).st_size == 4
    process.undo()
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(descriptor)


def test_memory_is_counted_in_bytes(process):
    """An interpreter maps more than a megabyte; the file counts in kB."""
    assert process.mapped_bytes() > 1 << 20
    assert process.mapped_bytes() % 1024 == 0


def test_an_ordinary_process_has_an_ordinary_policy(process):
    process.set_ordinary()
    assert process.policy() == os.SCHED_OTHER
