"""The last run of a device: kept by the device alone, and never an older one for the last."""

from datetime import UTC, datetime

import pytest

from hilctl.experiment.device_state import (
    CoilState,
    DeviceState,
    read_device_state,
    write_device_state,
)

AT = datetime(2026, 1, 1, tzinfo=UTC)
HOLDS = ("tcp:10.0.0.5:502", "serial:/dev/ttyUSB0")
STATE = DeviceState(
    holds=[*HOLDS], run_id="one", recording="/runs/one.mcap", started=AT,
    coil=CoilState(ended=AT, output_safe=True, heat_a2=4.25, thermal_time_constant_s=20.0),
)  # fmt: skip


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "state" / "hilctl" / "devices"


def test_what_was_written_is_read(folder, caplog):
    assert read_device_state(HOLDS) is None
    write_device_state(STATE)
    assert read_device_state(HOLDS) == STATE
    assert read_device_state(HOLDS[:1]) is None
    later = STATE.model_copy(update={"run_id": "two", "coil": None})
    write_device_state(later)
    assert read_device_state(HOLDS) == later
    assert len([*folder.iterdir()]) == 1
    assert caplog.messages == []


def test_a_device_that_holds_nothing_has_no_state(folder):
    write_device_state(STATE.model_copy(update={"holds": []}))
    assert read_device_state(()) is None
    assert not folder.exists()


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[]", b"\xff", b'{"holds": 1}', b"heat NaN", b"heat -1"]
)
def test_a_damaged_state_is_none_and_a_warning(folder, caplog, content):
    write_device_state(STATE)
    (path,) = folder.iterdir()
    if content.startswith(b"heat"):
        content = path.read_bytes().replace(b"4.25", content.split()[1])
    path.write_bytes(content)
    assert read_device_state(HOLDS) is None
    (said,) = caplog.messages
    assert str(path) in said
    assert "\n" not in said


def test_where_it_can_not_be_written_no_older_one_is_left(folder, caplog, monkeypatch):
    """An older one would be taken for the last."""
    write_device_state(STATE)

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("hilctl.base.files.os.fsync", full)
    write_device_state(STATE.model_copy(update={"run_id": "two"}))
    assert read_device_state(HOLDS) is None
    assert len(caplog.messages) == 1
    assert [*folder.iterdir()] == []


@pytest.mark.parametrize("given", ["", "relative"])
def test_without_a_folder_of_its_own_it_is_in_the_home(tmp_path, monkeypatch, given):
    """A relative folder is to be ignored, says the standard."""
    monkeypatch.setenv("XDG_STATE_HOME", given)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    write_device_state(STATE)
    assert len([*(tmp_path / "home/.local/state/hilctl/devices").iterdir()]) == 1
