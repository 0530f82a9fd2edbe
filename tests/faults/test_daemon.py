"""Runs in the background: status, set and stop by other processes, and invalid requests."""

import json
import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
import yaml

from hilctl.analysis.replay import replay
from hilctl.recording.reader import read
from hilctl.run.run_folder import runs
from tests import commands
from tests.faults.conftest import T7, simulated, sine

EXPERIMENT = simulated(  # longer than all tests of it take on a busy machine
    "background", 5000, sine(5.0, duration_s=600.0), block=25
)
STOPPED = "stopped by hilctl stop"


def hilctl(*words, code=0):
    """Run a command; return its JSON, or its error text if it must fail."""
    if code:
        return commands.hilctl(*words, code=code).stderr
    return json.loads(commands.hilctl(*words, "--json").stdout)


def written(folder, **changes):
    """Write the experiment with changes; return its path."""
    path = folder / "experiment.yaml"
    path.write_text(yaml.safe_dump({**EXPERIMENT, **changes}), encoding="utf-8")
    return path


def start(folder):
    """Start a run in the background; return its recording."""
    started = hilctl("run", written(folder), "--output", folder / "run.mcap", "--detach")
    return Path(started["recording"])


def stop_all():
    for run in runs():
        if run.supervised:
            hilctl("stop", "--run", run.card.name)


@pytest.fixture
def background(tmp_path):
    """A run in the background; the test may end it, or leave that to the fixture."""
    yield start(tmp_path)
    stop_all()


@pytest.fixture(scope="module")
def long_run(tmp_path_factory):
    """A run in the background for all tests that must leave it undisturbed."""
    recording = start(tmp_path_factory.mktemp("long_run"))
    await_state("running")
    yield recording
    stop_all()


@pytest.fixture
def going(long_run, module_runs, monkeypatch):
    """The recording of the long run, which commands of this test find."""
    monkeypatch.setenv("HILCTL_RUNS", str(module_runs))
    return long_run


def await_state(state, timeout_s=240.0):
    deadline = time.monotonic() + timeout_s
    while True:
        found = hilctl("status")["runs"]
        if found and found[0]["state"] == state:
            return found[0]
        assert time.monotonic() < deadline, found
        time.sleep(0.05)


def test_background_run_is_seen_changed_and_stopped(background):
    """From start to end by commands: the gain moves without a bump, and stop ramps down."""
    (status,) = hilctl("status")["runs"]
    assert status["state"] == "running"  # when --detach returns
    assert status["recording"] == str(background)
    assert status["gain"] == 1.0
    assert hilctl("set", "gain=0.5", "--over", "0.4")["gain"] == 0.5
    time.sleep(1.0)
    refused = hilctl("set", "gain=2.0", code=2)
    assert "got -8 to 8 A" in refused
    assert hilctl("stop")["ended"]
    assert hilctl("status")["runs"] == []
    recording = read(background)
    assert recording.end["reason"] == STOPPED
    assert [event.code for event in recording.events] == ["tuned", "run_ended"]
    assert replay(recording).identical
    samples = recording.samples
    assert np.array_equal(samples.index, np.arange(samples.index.size))
    at = recording.events[0].sample
    settled = samples.command[at + 2000 : at + 4000]
    assert np.abs(settled).max() == pytest.approx(2.0, rel=1e-3)
    steepest = 4.0 * 2.0 * np.pi * 5.0 / 5000.0 + 4.0 * 0.5 / 2000.0
    assert np.abs(np.diff(samples.command[at - 1000 : at + 4000])).max() <= steepest


def test_bad_messages_change_nothing(going):
    """Garbage, unknown commands and wrong types are refused with a message."""
    (run,) = runs()
    for raw, words in {
        b"not json\n": "invalid JSON",
        b"{}\n": "command",
        b'{"command": "explode"}\n': "must be one of",
        b'{"command": "set", "gain": "1"}\n': "must be a number",
        b'{"command": "set", "gain": NaN}\n': "must be a finite number",
        b'{"command": "set", "gain": 0.5, "extra": 1}\n': "unknown key",
        b'{"command": "set"}\n': "gain, offset or inverse is required",
        b'{"command": "set", "gain": 0.5, "over_s": 0.0}\n': "must be > 0",
        b"[" * 5000: "longer than",
        b"\xff\xfe\n": "invalid JSON",
    }.items():
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
            client.connect(str(run.socket))
            client.settimeout(10.0)
            client.sendall(raw)
            answer = json.loads(client.recv(65536))
        assert answer["ok"] is False
        assert words in answer["error"], (raw, answer)
    status = await_state("running")
    assert (status["gain"], status["offset"], status["missing_samples"]) == (1.0, 0.0, 0)


SEEDS = (
    b'{"command": "status"}',
    b'{"command": "set", "gain": 9e9, "over_s": 2.0}',
    b'{"command": "explode", "why": [1, {"a": null}, "\xc3\xa4"]}',
)


def mangled(chance):
    """Return a message: noise, or a request with a few bytes changed, removed or inserted."""
    if chance.random() < 0.2:
        return chance.randbytes(chance.randrange(1, 6000))
    raw = bytearray(chance.choice(SEEDS))
    for _ in range(chance.randrange(6)):
        at = chance.randrange(len(raw))
        raw[at : at + chance.randrange(3)] = chance.randbytes(chance.randrange(3))
        raw = raw or bytearray(b"?")
    return bytes(raw) + chance.choice([b"\n", b"", b"\n\n{", b"\0\n"])


def say(socket_path, raw):
    """Send bytes to a run; return its answer, empty if it closed the connection."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.settimeout(10.0)
        client.connect(str(socket_path))
        try:
            client.sendall(raw)
            client.shutdown(socket.SHUT_WR)
            return client.recv(65536)
        except (BrokenPipeError, ConnectionResetError):
            return b""


def test_hundreds_of_mangled_messages_do_not_disturb_a_run(going):
    """Each is answered or disconnected, silent clients too; no sample is lost."""
    (run,) = runs()
    before, chance = hilctl("status")["runs"][0], random.Random(7)
    answers = [say(run.socket, mangled(chance)) for _ in range(400)]
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as silent:
        silent.connect(str(run.socket))
        silent.settimeout(10.0)
        assert silent.recv(1) == b""
    said = [json.loads(answer) for answer in answers if answer]
    assert len(said) > 300
    assert {answer["ok"] for answer in said} == {True, False}
    after = await_state("running")
    assert after["missing_samples"] == 0
    ticks = (after["sample"] - before["sample"]) / EXPERIMENT["block"]
    assert ticks > 100
    assert after["late_ticks"] - before["late_ticks"] < 0.5 * ticks  # a busy machine is late too


@contextmanager
def crowd(socket_path, size):
    """Keep a number of silent clients connected; each reconnects when it is disconnected."""
    over = threading.Event()

    def stay():
        while not over.is_set():
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
                client.settimeout(0.1)
                with suppress(OSError):
                    client.connect(str(socket_path))
                    client.recv(1)

    threads = [threading.Thread(target=stay) for _ in range(size)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        over.set()
        for thread in threads:
            thread.join()


def test_requests_work_with_many_clients(going):
    """Status and set are answered, and no sample is lost."""
    (run,) = runs()
    before = await_state("running")
    with crowd(run.socket, 100):
        for _ in range(5):
            assert hilctl("status")["runs"][0]["state"] == "running"
        assert hilctl("set", "gain=1.0", "--over", "0.1")["gain"] == 1.0
    after = await_state("running")
    assert after["missing_samples"] == 0
    assert after["recorded_samples"] > before["recorded_samples"]


def test_two_simultaneous_changes_are_both_applied(going):
    """The second begins after the loop has taken the first, and the result has both."""
    commands = [["set", "gain=0.5", "--over", "0.5"], ["set", "offset=0.5", "--over", "0.1"]]
    await_state("running")
    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(lambda words: hilctl(*words), commands)
    assert first["begins_at_sample"] != second["begins_at_sample"]
    last = max(first, second, key=lambda each: each["begins_at_sample"])
    assert (last["gain"], last["offset"]) == (0.5, 0.5)
    assert hilctl("set", "gain=1.0", "offset=0.0", "--over", "0.1")["gain"] == 1.0
    after = await_state("running")
    assert (after["gain"], after["offset"], after["missing_samples"]) == (1.0, 0.0, 0)


def test_stop_works_with_many_clients(background):
    """The supervisor is stopped by a signal, which no client can block."""
    await_state("running")
    (run,) = runs()
    with crowd(run.socket, 200):
        (stopped,) = hilctl("stop", "--all")["runs"]
    assert stopped["ended"]
    assert read(background).end["reason"] == STOPPED


def test_second_run_into_the_same_recording_is_refused(going):
    """The recording of an active run cannot be used by another."""
    path = going.parent / "experiment.yaml"
    text = hilctl("run", path, "--output", going, "--overwrite", code=2)
    assert "is recording" in text


def test_detached_run_of_an_invalid_experiment_is_refused(tmp_path):
    """It is refused as in the foreground, and no file is left."""
    path = written(tmp_path, sample_rate_hz=-1)
    text = hilctl("run", path, "--output", tmp_path / "run.mcap", "--detach", code=2)
    assert "sample_rate_hz" in text
    assert sorted(each.name for each in tmp_path.iterdir()) == ["experiment.yaml"]


def test_detached_run_that_does_not_start_reports_the_same_error(tmp_path):
    """A device that does not answer: the error and exit code of the foreground, no recording."""
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        port = closed.getsockname()[1]
    section = {**T7, "host": "127.0.0.1", "tcp_port": port}
    path = written(tmp_path, device=section, sample_rate_hz=100, block=1)
    words = ["run", path, "--output", tmp_path / "run.mcap"]
    foreground = hilctl(*words, code=3)
    background = hilctl(*words, "--detach", code=3)
    assert "connection refused" in foreground
    assert background.splitlines()[-1] == foreground.splitlines()[-1]
    assert not (tmp_path / "run.mcap").exists()
    assert hilctl("status")["runs"] == []


def test_short_run_may_have_ended_when_detach_returns(tmp_path):
    path = written(tmp_path, waveform=sine(5.0, 0.2, soft_start_s=0.0))
    output = tmp_path / "run.mcap"
    output.touch()
    done = hilctl("run", path, "--output", output, "--detach", "--overwrite", "--take-over")
    assert done["recording"] == str(output)


def test_a_run_that_is_killed_while_it_starts_leaves_nothing(tmp_path):
    """The next command reports it in one line, later ones do not."""
    command = [sys.executable, "-m", "hilctl", "run", str(written(tmp_path))]
    with subprocess.Popen([*command, "--output", str(tmp_path / "run.mcap")]) as process:
        deadline = time.monotonic() + 120.0
        while not (found := runs()):
            assert time.monotonic() < deadline
            time.sleep(0.001)
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        for number in (process.pid, *map(int, children)):
            with suppress(ProcessLookupError):
                os.kill(number, signal.SIGKILL)
    said = [commands.hilctl("status").stderr.splitlines() for _ in range(2)]
    assert [len(lines) for lines in said] == [1, 0]
    assert found[0].card.name in said[0][0]
    assert not (tmp_path / "run.mcap").exists()


def test_without_a_run_there_is_nothing_to_stop():
    for words in (["stop"], ["set", "gain=1"]):
        assert hilctl(*words, code=2).count("\n") == 1


def test_short_stop_of_the_supervisor_loses_nothing(going):
    """The ring stores the samples meanwhile."""
    status = await_state("running")
    (run,) = runs()
    for number, wait_s in ((signal.SIGSTOP, 0.3), (signal.SIGCONT, 0.2)):
        subprocess.run(["kill", f"-{number.value}", str(run.card.supervisor)], check=True)
        time.sleep(wait_s)
    after = await_state("running")
    assert after["recorded_samples"] > status["sample"]
    assert after["missing_samples"] == 0


def test_long_run_is_complete_after_all_requests(going):
    """It ends by its safe ramp, has every sample, and replays."""
    await_state("running")
    assert hilctl("stop")["ended"]
    recording = read(going)
    assert recording.dropped == 0
    assert np.array_equal(recording.samples.index, np.arange(recording.samples.index.size))
    assert recording.end["reason"] == STOPPED
    assert replay(recording).identical
