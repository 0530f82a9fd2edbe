"""Files of the last run of each output: names, users, boots and clocks, damaged and newer files."""

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from hilctl.experiment import state_files
from hilctl.experiment.state_files import (
    CoilState,
    DeviceState,
    LastRun,
    MachineTime,
    last_runs,
    state_of_run,
    write_state,
)
from tests.fakes import DESCRIBED

AT = datetime(2026, 1, 1, tzinfo=UTC)
PLACE = ("tcp:10.0.0.5:502", "tcp:dac.lab:502")
USB = ("usb:0403:6001:A1", "tty:188:0", "serial:/dev/ttyUSB0")
NOW = MachineTime(unix_s=AT.timestamp(), boot_s=5000.0, boot="this boot")
HOUR_S = 3600.0
YEAR_S = 366 * 24 * HOUR_S


def state_of(*names, output="1:100", run_id="one", **more):
    values = {
        "holds": [*names], "output": output, "run_id": run_id, "recording": "/runs/one.mcap",
        "started": AT, "boot": NOW.boot, "boot_s": NOW.boot_s,
        "coil": CoilState(
            ended=AT, output_safe=True, heat_a2=4.25, thermal_time_constant_s=20.0),
    }  # fmt: skip
    return DeviceState(**values | more)


def info_of(*names, output="1:100"):
    return replace(DESCRIBED, holds=names, identity=names, output=output)


def runs_of(*names, **more):
    return [run.state.run_id if run.state else None for run in last_runs(info_of(*names, **more))]


@pytest.fixture
def shared(tmp_path, monkeypatch):
    """Keep states where all users of a machine do."""
    monkeypatch.delenv("XDG_STATE_HOME")
    monkeypatch.setattr(state_files, "_SHARED", tmp_path)
    return tmp_path


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "state" / "hilctl" / "devices"


def test_what_was_written_is_read(folder, caplog):
    assert last_runs(info_of(*PLACE)) == []
    write_state(state_of(*PLACE))
    (run,) = last_runs(info_of(*PLACE))
    assert run.state == state_of(*PLACE)
    write_state(state_of(*PLACE, run_id="two", coil=None))
    assert runs_of(*PLACE) == ["two"]
    assert (state_of_run("two").run_id, state_of_run("one")) == ("two", None)
    assert len([*folder.iterdir()]) == 1
    assert caplog.messages == []


@pytest.mark.parametrize(("written", "asked", "same"), [
    (("tcp:127.0.0.1:502", "tcp:localhost:502"), ("tcp:127.0.0.1:502",), True),
    (("tcp:127.0.0.1:502",), ("tcp:127.0.0.1:502", "tcp:localhost:502"), True),
    (PLACE, ("tcp:10.0.0.6:502",), False),
    (USB, ("usb:0403:6001:A1", "tty:188:1", "serial:/dev/ttyUSB1"), True),
    (USB, (*USB, "serial:/dev/serial/by-id/A1"), True),
    (USB, ("tty:188:0", "serial:/dev/ttyUSB0"), True),  # without /sys, as in some containers
    (USB, ("usb:0403:6001:B2", "tty:188:0", "serial:/dev/ttyUSB0"), False),
])  # fmt: skip
def test_one_device_has_many_names(folder, written, asked, same):
    write_state(state_of(*written))
    assert runs_of(*asked) == (["one"] if same else [])


def test_outputs_of_one_device_have_a_state_each(folder):
    write_state(state_of(*PLACE, output="1:100"))
    write_state(state_of(*PLACE, output="1:102", run_id="two"))
    assert runs_of(*PLACE, output="1:100") == ["one"]
    assert runs_of(*PLACE, output="1:102") == ["two"]
    # Of a device that names no output, and by an older version.
    assert sorted(runs_of(*PLACE, output="")) == ["one", "two"]
    write_state(state_of("tcp:10.0.0.6:502", output=""))
    assert runs_of("tcp:10.0.0.6:502", output="1:100") == ["one"]


def test_a_device_without_names_has_no_state(folder):
    write_state(state_of(*PLACE))
    assert last_runs(info_of()) == []
    others = replace(DESCRIBED, holds=PLACE)  # of another package, with neither key
    assert len(last_runs(others)) == 1


@pytest.mark.parametrize("content", [
    b"", b"{", b"[]", b"\xff", b'{"holds": 1}', b"4.25 NaN", b"4.25 -1.0", b'"started" "begun"',
    b" " * (1 << 17),
])  # fmt: skip
def test_a_damaged_file_is_an_unknown_run(folder, content):
    write_state(state_of(*PLACE))
    (path,) = folder.iterdir()
    if content[:1] in {b"4", b'"'}:
        content = path.read_bytes().replace(*content.split())
    path.write_bytes(content)
    os.utime(path, (AT.timestamp(), AT.timestamp()))
    unknown = [LastRun(path, AT.timestamp(), None)]
    assert last_runs(info_of(*PLACE)) == unknown
    assert last_runs(info_of(*PLACE[::-1])) == unknown
    assert last_runs(info_of(*PLACE, output="1:102")) == []
    assert last_runs(info_of("tcp:10.0.0.6:502")) == []


def test_keys_of_a_newer_version_are_ignored(folder):
    write_state(state_of(*PLACE))
    (path,) = folder.iterdir()
    saved = json.loads(path.read_text())
    saved["ambient_c"] = saved["coil"]["ambient_c"] = 21.5
    path.write_text(json.dumps(saved))
    assert last_runs(info_of(*PLACE))[0].state == state_of(*PLACE)
    del saved["coil"]["heat_a2"]  # renamed, for instance
    path.write_text(json.dumps(saved))
    assert runs_of(*PLACE) == [None]


def test_a_file_that_cannot_be_written_is_unknown_and_not_the_one_before(
    folder, caplog, monkeypatch
):
    write_state(state_of(*PLACE))

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("hilctl.base.files.os.fsync", full)
    write_state(state_of(*PLACE, run_id="two"))
    assert runs_of(*PLACE) == [None]
    assert len(caplog.messages) == 1


def test_links_and_pipes_are_not_followed(folder, tmp_path):
    write_state(state_of(*PLACE))
    (path,) = folder.iterdir()
    path.rename(tmp_path / "elsewhere.json")
    path.symlink_to(tmp_path / "elsewhere.json")
    assert runs_of(*PLACE) == [None]
    path.unlink()
    os.mkfifo(path)
    assert runs_of(*PLACE) == [None]


def test_the_home_folder_does_not_matter(shared, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", "relative")
    monkeypatch.setenv("HOME", "/home/one")
    write_state(state_of(*PLACE))
    write_state(state_of(*PLACE, output="1:102"))
    (own,) = shared.iterdir()
    assert own.name.startswith(f"hilctl-{os.geteuid()}-")
    monkeypatch.setenv("HOME", "/root")
    assert runs_of(*PLACE) == ["one"]


@pytest.mark.parametrize("umask", [0o077, 0o000])
def test_others_read_a_file_and_cannot_write_it(shared, umask):
    before = os.umask(umask)
    try:
        write_state(state_of(*PLACE))
    finally:
        os.umask(before)
    (own,) = shared.iterdir()
    (path,) = own.iterdir()
    assert (own.stat().st_mode & 0o777, path.stat().st_mode & 0o777) == (0o755, 0o644)


def test_a_folder_that_another_user_could_write_is_not_one_s_own(shared, tmp_path):
    theirs, link = shared / "hilctl-0-aaaa", shared / "hilctl-0-bbbb"
    theirs.mkdir()
    theirs.chmod(0o777)
    (tmp_path / "elsewhere").mkdir()
    link.symlink_to(tmp_path / "elsewhere")
    write_state(state_of(*PLACE))
    assert [*theirs.iterdir()] == [*(tmp_path / "elsewhere").iterdir()] == []
    assert runs_of(*PLACE) == ["one"]


AS_OTHER = """
import os, sys
from pathlib import Path
from hilctl.experiment import state_files
from tests.unit.experiment.test_state_files import PLACE, runs_of, state_of, write_state
os.setgid(65534), os.setuid(65534)
state_files._SHARED = Path(sys.argv[1])
print(*runs_of(*PLACE))
write_state(state_of(*PLACE, run_id="theirs"))
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root to become another user")
def test_the_runs_of_all_users_are_read(monkeypatch):
    monkeypatch.delenv("XDG_STATE_HOME")
    root = Path(__file__).parents[3]
    with tempfile.TemporaryDirectory() as place:
        monkeypatch.setattr(state_files, "_SHARED", Path(place))
        Path(place).chmod(0o1777)
        write_state(state_of(*PLACE))
        command = [sys.executable, "-c", AS_OTHER, place]
        said = subprocess.run(command, cwd=root, check=True, capture_output=True, text=True)
        assert said.stdout.split() == ["one"]
        assert sorted(runs_of(*PLACE)) == ["one", "theirs"]


class TestTime:
    """The time since a run is never longer than is certain."""

    def since(self, now, **more):
        return LastRun(Path("x.json"), AT.timestamp(), state_of(*PLACE, **more)).since_s(now)

    @pytest.mark.parametrize("set_s", [600.0, HOUR_S, -YEAR_S, 0.0])
    def test_a_clock_that_is_set_changes_nothing_in_a_boot(self, set_s):
        now = replace(NOW, unix_s=NOW.unix_s + 10.0 + set_s, boot_s=NOW.boot_s + 10.0)
        assert self.since(now) == 10.0

    def test_an_end_that_is_still_to_come(self):
        assert self.since(NOW, boot_s=NOW.boot_s + 7.0, coil=None) == 0.0

    @pytest.mark.parametrize(("passed_s", "up_s", "since_s"), [
        (HOUR_S, 100.0, 100.0),  # off for an hour, or a clock that was set: the boot is certain
        (HOUR_S, 2.0 * HOUR_S, HOUR_S),
        (-YEAR_S, 100.0, 0.0),
    ])  # fmt: skip
    def test_another_boot(self, passed_s, up_s, since_s):
        now = MachineTime(NOW.unix_s + passed_s, up_s, "next boot")
        assert self.since(now) == since_s
        assert self.since(now, boot="") == since_s
        assert self.since(replace(now, boot="")) == since_s
        assert LastRun(Path("x.json"), AT.timestamp(), None).since_s(now) == since_s

    def test_runs_of_this_boot_are_the_latest(self):
        def run(**more):
            return LastRun(Path("x.json"), 0.0, state_of(*PLACE, **more))

        ahead = AT + timedelta(days=400)  # by a clock that was wrong before the boot
        coil = state_of(*PLACE).coil
        runs = [
            run(run_id="4", boot_s=200.0),
            run(run_id="2", boot="other", coil=coil.model_copy(update={"ended": ahead})),
            run(run_id="3", boot_s=100.0),
            run(run_id="1", boot="other", coil=None),
        ]
        runs = sorted(runs, key=lambda each: each.order(NOW))
        assert [each.state.run_id for each in runs] == ["1", "2", "3", "4"]

    def test_now(self):
        one, two = MachineTime.now(), MachineTime.now()
        assert one.boot == two.boot != ""
        assert one.boot_s <= two.boot_s
