"""Calls of Linux that a process without rights may make, and errors that are told as such."""

import errno
import gc
import os
from pathlib import Path

import pytest

from hilctl.machine import syscalls
from hilctl.machine.syscalls import LinuxProcess


@pytest.fixture
def process():
    before = os.sched_getaffinity(0)
    yield LinuxProcess()
    os.sched_setaffinity(0, before)
    gc.unfreeze()
    gc.enable()


def test_system_error_has_its_number(process):
    with pytest.raises(OSError, match="descriptor") as error:
        process._call("close", -1)
    assert error.value.errno == errno.EBADF


def test_a_pinned_process_has_one_cpu(process):
    cpu = min(os.sched_getaffinity(0))
    process.pin(cpu)
    assert os.sched_getaffinity(0) == {cpu}


def test_garbage_collection_is_disabled(process):
    process.freeze_gc()
    assert not gc.isenabled()
    assert gc.get_freeze_count() > 0


def test_idle_states_are_prevented_while_the_file_is_open(process, tmp_path, monkeypatch):
    held = tmp_path / "cpu_dma_latency"
    held.touch()
    monkeypatch.setattr(syscalls, "DMA_LATENCY", str(held))
    process.hold_dma_latency(20)
    assert held.read_bytes() == b"\x14\0\0\0"
    (opened,) = [fd for fd in Path("/proc/self/fd").iterdir() if fd.resolve() == held]
    os.close(int(opened.name))


def test_memory_is_counted_in_bytes(process):
    assert process.mapped_bytes() > 1 << 20
    assert process.mapped_bytes() % 1024 == 0


def test_an_ordinary_process_has_an_ordinary_policy(process):
    process.set_ordinary()
    assert process.policy() == os.SCHED_OTHER
