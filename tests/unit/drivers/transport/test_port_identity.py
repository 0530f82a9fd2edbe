"""The device behind a serial port: what distinguishes it, and what does not."""

import os
import pty
import tty
from pathlib import Path

import pytest

from hilctl_drivers.transport.links import LostError
from hilctl_drivers.transport.port_identity import PortIdentity, usb_adapter
from hilctl_drivers.transport.serial_port import SerialLink
from tests.unit.drivers.transport.conftest import QUICK_S, line_settings


class Pty:
    """A pseudo-terminal that can end."""

    def __init__(self):
        self._ends = pty.openpty()
        tty.setraw(self._ends[1])
        self.path = os.ttyname(self._ends[1])

    def end(self):
        for each in self._ends:
            os.close(each)
        self._ends = ()


@pytest.fixture
def new_pty():
    """Return a function that makes pseudo-terminals."""
    made = []

    def make():
        made.append(Pty())
        return made[-1]

    yield make
    for each in made:
        each.end()


@pytest.fixture
def link(tmp_path):
    """Return a function that leads a link to a device file, and returns the link's path."""

    def lead(path):
        (tmp_path / "new").symlink_to(path)
        return str((tmp_path / "new").rename(tmp_path / "port"))

    return lead


def test_owner_mode_and_times_are_no_identity(new_pty):
    """After a plug-in udev sets owner and mode, and each exchange sets times."""
    path = new_pty().path
    identity = PortIdentity(path)
    Path(path).chmod(0o666)
    os.chown(path, os.geteuid(), os.getegid())
    os.utime(path, (1.0, 1.0))
    assert identity.device_file() == path


def test_link_to_another_device_is_refused(new_pty, link):
    first, other = new_pty(), new_pty()
    port = SerialLink(link(first.path), line_settings(), QUICK_S)
    link(other.path)
    with pytest.raises(LostError, match="another device"):
        port.open()
    link(first.path)
    port.open(boot=False)
    port.close()


def test_new_pty_with_the_number_of_an_ended_one_is_refused(new_pty):
    first = new_pty()
    identity = PortIdentity(first.path)
    first.end()
    with pytest.raises(FileNotFoundError):
        identity.device_file()
    assert new_pty().path == first.path
    with pytest.raises(LostError, match="another device"):
        identity.device_file()


def test_device_that_comes_later_is_the_first(new_pty, link, tmp_path):
    port = PortIdentity(str(tmp_path / "port"))
    first, other = new_pty(), new_pty()
    link(first.path)
    assert port.device_file() == first.path
    link(other.path)
    with pytest.raises(LostError, match="another device"):
        port.device_file()


def test_process_that_starts_later_takes_the_identity_of_the_first(new_pty, link, tmp_path):
    """A guardian that is started while the device is gone must not accept what comes next."""
    first, other = new_pty(), new_pty()
    known = PortIdentity(first.path).known
    port = PortIdentity(str(tmp_path / "port"))
    port.known = known
    link(other.path)
    with pytest.raises(LostError, match="another device"):
        port.device_file()
    link(first.path)
    assert port.device_file() == first.path


USB = {"idVendor": "0403", "idProduct": "6001", "serial": "A1"}


@pytest.fixture
def plugged(tmp_path):
    """Return a function that returns the identity of an adapter, as the kernel describes it."""

    def identity(socket="1-1.2", interface="1.0", tty="ttyUSB0", port_number="0", **changes):
        adapter = tmp_path / "devices" / "pci0" / "usb1" / socket
        port = adapter / f"{socket}:{interface}" / tty
        port.mkdir(parents=True)
        for name, text in {**USB, **changes}.items():
            if text:
                (adapter / name).write_text(f"{text}\n")
        (port / "port_number").write_text(f"{port_number}\n")
        number = tmp_path / "dev" / "char" / "188:0"
        number.mkdir(parents=True)
        (number / "device").symlink_to(port)
        found = usb_adapter(os.makedev(188, 0), tmp_path)
        (number / "device").unlink()
        number.rmdir()
        adapter.rename(tmp_path / f"unplugged {len(list(tmp_path.iterdir()))}")
        return found

    return identity


@pytest.mark.parametrize(
    ("then", "now", "same"),
    [
        ({}, {}, True),
        ({}, {"socket": "2-4", "tty": "ttyUSB3"}, True),
        ({}, {"serial": "B2"}, False),
        ({}, {"serial": None}, False),
        ({}, {"idProduct": "6010"}, False),
        ({}, {"interface": "1.1"}, False),  # another port of an adapter with several
        ({}, {"port_number": "1"}, False),
        ({"serial": None}, {"serial": None, "tty": "ttyUSB3"}, True),
        ({"serial": None}, {"serial": None, "socket": "2-4"}, False),
    ],
)
def test_usb_adapter_is_known_by_its_number_or_its_socket(plugged, then, now, same):
    assert (plugged(**then) == plugged(**now)) is same


def test_other_ports_are_no_usb_adapters(tmp_path):
    assert usb_adapter(os.makedev(4, 64), tmp_path) == ""
