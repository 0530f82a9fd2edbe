"""Runs that fail or are delayed while they start: nothing moves and nothing is left behind."""

import os
import signal
import time
from unittest.mock import Mock

import pytest
import yaml

from hilctl.base.errors import RunError
from hilctl.recording.reader import read
from hilctl.run import supervisor as module
from hilctl.run.recorder import Recorder
from hilctl.run.run_folder import runs
from hilctl.run.start import checked_run
from hilctl.run.supervisor import Supervisor
from tests.fakes import children_of, held_devices
from tests.faults.conftest import EXPERIMENT, simulated, sine

SHORT = simulated("start", 1000, sine(5.0, 0.5), block=10)


@pytest.fixture
def start(tmp_path):
    """Return a function that runs an experiment in this process."""

    def run(experiment):
        path = tmp_path / "experiment.yaml"
        path.write_text(yaml.safe_dump(experiment), encoding="utf-8")
        checked = checked_run(path, ())
        output = tmp_path / "run.mcap"
        return Supervisor(checked, output, overwrite=False, on_progress=lambda _: None).run()

    yield run
    assert runs() == []


def assert_nothing_is_left(folder, processes):
    assert [path.name for path in folder.glob("*.mcap*")] == []
    assert children_of(os.getpid()) == processes


@pytest.mark.parametrize("step", [
    "recorders_of", "ControlServer", "LoopProcess", "GuardianProcess", "Recorder.begin", "favoured",
    "RingRecorder.start",
])  # fmt: skip
def test_failed_start_leaves_nothing(device, start, tmp_path, monkeypatch, step):
    processes = children_of(os.getpid())
    failed = Mock(side_effect=OSError(24, "Too many open files"))
    monkeypatch.setattr(f"hilctl.run.supervisor.{step}", failed)
    with pytest.raises((RunError, OSError), match="open files"):
        start({**EXPERIMENT, "device": device.section})
    assert_nothing_is_left(tmp_path, processes)
    assert device.has_not_moved()
    with held_devices([f"tcp:{device.section['host']}:{device.section['tcp_port']}"]):
        pass


def test_guardian_that_is_not_ready_is_not_awaited(device, start, tmp_path, monkeypatch):
    processes = children_of(os.getpid())
    monkeypatch.setattr(module, "_GUARDIAN_READY_S", 0.0)
    monkeypatch.setattr(module.SafetyMonitor, "ready", lambda safety: False)
    with pytest.raises(RunError, match="guardian"):
        start({**EXPERIMENT, "device": device.section})
    assert_nothing_is_left(tmp_path, processes)


@pytest.mark.parametrize("simulated_device", [True, False])
def test_refused_real_time_is_reported(device, start, monkeypatch, caplog, simulated_device):
    """Except for a simulated device, which does not need it."""
    read_text = module.SharedPage.read_text

    def refused(page, slot):
        return (
            '[{}, [{}], ["fifo: x"]]' if slot is module.PageSlot.SET_UP else read_text(page, slot)
        )

    monkeypatch.setattr(module.SharedPage, "read_text", refused)
    monkeypatch.setattr(module, "favoured", Mock(side_effect=OSError(24, "stopped by the test")))
    with pytest.raises(RunError):
        start(SHORT if simulated_device else {**EXPERIMENT, "device": device.section})
    assert ("fifo: x" in caplog.text) != simulated_device


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_before_the_start_is_obeyed(start, tmp_path, monkeypatch, number):
    processes, begin = children_of(os.getpid()), Recorder.begin

    def interrupted(recorder, *facts):
        begin(recorder, *facts)
        os.kill(os.getpid(), number)

    monkeypatch.setattr(Recorder, "begin", interrupted)
    before = signal.getsignal(number)
    with pytest.raises(RunError, match="stopped"):
        start(SHORT)
    assert_nothing_is_left(tmp_path, processes)
    assert signal.getsignal(number) == before


@pytest.fixture
def slow_disk(monkeypatch):
    """Delay the first bytes of recordings; return the delays, and the written starts in s."""
    delays_s, starts_s, begin = [], [], Recorder.begin

    def slow(recorder, start_unix_ns, *facts):
        starts_s.append(start_unix_ns * 1e-9)
        begin(recorder, start_unix_ns, *facts)
        time.sleep(delays_s.pop(0) if delays_s else 0.0)

    monkeypatch.setattr(Recorder, "begin", slow)
    return delays_s, starts_s


def test_slow_disk_delays_the_start(start, slow_disk):
    """The start is written again with a later time, so that the first tick is on time."""
    delays_s, starts_s = slow_disk
    delays_s.append(0.3)
    recording = read(start(SHORT).path)
    assert len(starts_s) == 2
    assert starts_s[1] - starts_s[0] > 3 * 0.3
    assert float(recording.run["start_unix_ns"]) * 1e-9 == pytest.approx(starts_s[1])


def test_disk_that_becomes_slower_ends_the_start(start, slow_disk, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_START_TRIES", 2)
    processes = children_of(os.getpid())
    slow_disk[0].extend([0.1, 1.0])
    with pytest.raises(RunError, match=r"took 1(\.\d+)? s"):
        start(SHORT)
    assert_nothing_is_left(tmp_path, processes)
