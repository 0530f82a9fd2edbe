"""What can be named in a device section."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from hilctl.base.errors import InputError
from hilctl.experiment import inventory as module
from hilctl.experiment.inventory import describe, inventory


def test_devices_profiles_and_ports_are_listed(monkeypatch):
    """Shipped profiles by path; ports in order, with what the system calls them."""
    ports = [SimpleNamespace(device="/dev/ttyX1", description="b")]
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: ports)
    found = inventory().to_mapping()
    assert "modbus_dac" in found["devices"]
    assert Path(found["profiles"]["labjack_t7"]).is_file()
    assert list(found["profiles"]) == sorted(found["profiles"])
    assert found["serial_ports"] == ({"path": "/dev/ttyX1", "description": "b"},)


@pytest.mark.parametrize("place", ["no_such_package:shipped", "hilctl_drivers.profile:no_such"])
def test_drivers_that_are_not_there_are_said(monkeypatch, place):
    monkeypatch.setattr(module, "SHIPPED_PROFILES", place)
    with pytest.raises(InputError, match="the shipped profiles can't be listed"):
        inventory()


def test_a_device_is_described_by_its_options():
    options = {option.name: option for option in describe("modbus_dac").options}
    assert options["profile"].default is None
    assert options["timeout_s"].default == "0.1"
    assert options["host"].default == ""
    assert "longest wait" in options["timeout_s"].description


def test_a_profile_is_described_as_it_stands():
    found = describe("labjack_t7")
    assert found.profile["model"] == "T7"
    assert any("0 to 5 V only" in note for note in found.profile["notes"])
    assert found.to_mapping()["options"] == ()


def test_a_name_that_is_neither_gets_a_hint():
    with pytest.raises(InputError, match=r"no device or profile 'labjak_t7'.*'labjack_t7'"):
        describe("labjak_t7")
