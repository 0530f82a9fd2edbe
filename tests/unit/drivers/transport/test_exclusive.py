"""A port refused to other programs, wherever the kernel forgets that with this process."""

import array
import fcntl
import os
import pty
import tty
from pathlib import Path

import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.transport import exclusive
from hilctl_drivers.transport import serial_port as serial_link
from hilctl_drivers.transport.links import LostError
from hilctl_drivers.transport.serial_port import SerialLink, SerialSettings

TIOCGEXCL = 0x80045440
TIMEOUT_S = 0.05


@pytest.fixture
def line():
    """Yield the far end of a pty, a descriptor of the near end and its device file."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    yield master, slave, os.ttyname(slave)
    os.close(slave)
    os.close(master)


def is_refused(descriptor):
    found = array.array("i", [0])
    fcntl.ioctl(descriptor, TIOCGEXCL, found)
    return found[0] != 0


@pytest.mark.parametrize("may_open", [True, False])
def test_a_pty_is_refused_only_by_who_could_open_it_again(line, monkeypatch, may_open):
    """Its far end keeps what is asked for: a guardian without privileges would be refused too."""
    _, slave, path = line
    monkeypatch.setattr(exclusive, "_can_open", lambda path: may_open)
    assert exclusive.refuse_to_others(slave, path) is may_open
    assert is_refused(slave) is may_open
    exclusive.admit_others(slave)
    assert not is_refused(slave)


@pytest.mark.parametrize("others", [True, False])
def test_a_real_port_is_refused_only_if_no_other_program_has_it(line, monkeypatch, others):
    """Its descriptor would keep what is asked for when this process is killed."""
    _, slave, path = line
    monkeypatch.setattr(exclusive, "_PTY_MAJORS", ())
    monkeypatch.setattr(exclusive, "others_have", lambda device: others)
    assert exclusive.refuse_to_others(slave, path) is not others
    assert is_refused(slave) is not others
    exclusive.admit_others(slave)


def test_other_processes_are_seen_by_what_they_have_open(tmp_path):
    device = Path(os.devnull).stat().st_rdev
    mine, other = tmp_path / str(os.getpid()) / "fd", tmp_path / "1" / "fd"
    for folder in (mine, other):
        folder.mkdir(parents=True)
    (mine / "3").symlink_to(os.devnull)
    (other / "3").symlink_to("/nowhere")
    assert not exclusive.others_have(device, tmp_path)
    (other / "4").symlink_to(os.devnull)
    assert exclusive.others_have(device, tmp_path)


def test_a_link_is_exclusive_while_it_is_open(line, monkeypatch):
    """Not one that is opened for the safe value: nothing may outlive a process that is killed."""
    _, slave, path = line
    monkeypatch.setattr(exclusive, "_can_open", lambda path: True)
    link = SerialLink(path, SerialSettings(), TIMEOUT_S)
    for boot in (True, False):
        link.open(boot=boot)
        assert is_refused(slave) is boot
        link.close()
        assert not is_refused(slave)


def test_bytes_that_another_program_took_are_no_lost_port(line, monkeypatch):
    """The cause is named, and the port stays open for the safe value."""
    master, _, path = line
    link = SerialLink(path, SerialSettings(), TIMEOUT_S)
    link.open()
    link.drain()
    monkeypatch.setattr(serial_link, "read", lambda fd, size: b"")

    def missing(got):
        os.write(master, b"x")
        return 1

    with pytest.raises(DeviceError, match="another program reads this port") as caught:
        link.transact(b"?", missing)
    assert not isinstance(caught.value, LostError)
    assert link.is_open
    link.close()
