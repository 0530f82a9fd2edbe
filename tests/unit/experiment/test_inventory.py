"""What can be named in a device section."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from hilctl.base.errors import InputError
from hilctl.experiment import inventory as module
from hilctl.experiment.inventory import inventory


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
