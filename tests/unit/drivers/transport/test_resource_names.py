"""A port refused to other programs, wherever the kernel forgets that with this process."""

import array
import fcntl
import os
import socket
import threading
from pathlib import Path

import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.transport import resource_names, stream_link
from hilctl_drivers.transport.links import LostError
from hilctl_drivers.transport.resource_names import held_address, held_port
from hilctl_drivers.transport.serial_port import SerialLink
from tests.unit.drivers.transport.conftest import QUICK_S, line_settings, serial

TIOCGEXCL = 0x80045440


@pytest.fixture
def port(line):
    """Yield a descriptor of a line's near end and its device file."""
    _, path = line
    descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY)
    yield descriptor, path
    os.close(descriptor)


def is_refused(descriptor):
    found = array.array("i", [0])
    fcntl.ioctl(descriptor, TIOCGEXCL, found)
    return found[0] != 0


@pytest.mark.parametrize("may_open", [True, False])
def test_a_pty_is_refused_only_by_who_could_open_it_again(port, monkeypatch, may_open):
    """Its far end keeps what is asked for: a guardian without privileges would be refused too."""
    slave, path = port
    monkeypatch.setattr(resource_names, "_can_open", lambda path: may_open)
    assert resource_names.refuse_to_others(slave, path) is may_open
    assert is_refused(slave) is may_open
    resource_names.admit_others(slave)
    assert not is_refused(slave)


@pytest.mark.parametrize("others", [True, False])
def test_a_real_port_is_refused_only_if_no_other_program_has_it(port, monkeypatch, others):
    """Its descriptor would keep what is asked for when this process is killed."""
    slave, path = port
    monkeypatch.setattr(resource_names, "PTY_MAJORS", ())
    monkeypatch.setattr(resource_names, "others_have", lambda device: others)
    assert resource_names.refuse_to_others(slave, path) is not others
    assert is_refused(slave) is not others
    resource_names.admit_others(slave)


def test_other_processes_are_seen_by_what_they_have_open(tmp_path):
    device = Path(os.devnull).stat().st_rdev
    mine, other = tmp_path / str(os.getpid()) / "fd", tmp_path / "1" / "fd"
    for folder in (mine, other):
        folder.mkdir(parents=True)
    (mine / "3").symlink_to(os.devnull)
    (other / "3").symlink_to("/nowhere")
    assert not resource_names.others_have(device, tmp_path)
    (other / "4").symlink_to(os.devnull)
    assert resource_names.others_have(device, tmp_path)


def test_a_link_is_exclusive_while_it_is_open(port, monkeypatch):
    """Not one that is opened for the safe value: nothing may outlive a process that is killed."""
    slave, path = port
    monkeypatch.setattr(resource_names, "_can_open", lambda path: True)
    link = SerialLink(path, line_settings(), QUICK_S)
    for boot in (True, False):
        link.open(boot=boot)
        assert is_refused(slave) is boot
        link.close()
        assert not is_refused(slave)


def test_bytes_that_another_program_took_are_no_lost_port(line, monkeypatch):
    master, path = line
    link = serial(path, QUICK_S)
    monkeypatch.setattr(stream_link, "read", lambda fd, size: b"")

    def missing(got):
        os.write(master, b"x")
        return 1

    with pytest.raises(DeviceError, match="another program") as caught:
        link.transact(b"?", missing)
    assert not isinstance(caught.value, LostError)
    assert link.is_open
    link.close()


@pytest.fixture
def names(monkeypatch):
    """Return a dict of what the name server knows, instead of asking one."""
    known: dict[str, list[str]] = {}

    def getaddrinfo(name, *args, **kwargs):
        if name not in known:
            raise socket.gaierror(-2, "Name or service not known")
        return [(2, 1, 6, "", (address, 0)) for address in known[name]]

    monkeypatch.setattr(socket, "getaddrinfo", getaddrinfo)
    resource_names._addresses.cache_clear()
    yield known
    resource_names._addresses.cache_clear()


@pytest.mark.parametrize(("host", "name"), [
    ("10.0.0.5", "tcp:10.0.0.5:502"),
    ("::ffff:10.0.0.5", "tcp:10.0.0.5:502"),
    ("::ffff:a00:5", "tcp:10.0.0.5:502"),
    ("10.5", "tcp:10.0.0.5:502"),
    ("167772165", "tcp:10.0.0.5:502"),
    ("127.1", "tcp:127.0.0.1:502"),
    ("127.0.1.1", "tcp:127.0.0.1:502"),
    ("0.0.0.0", "tcp:127.0.0.1:502"),
    ("::1", "tcp:127.0.0.1:502"),
    ("::ffff:127.0.0.1", "tcp:127.0.0.1:502"),
    ("fe80:0:0::0001", "tcp:[fe80::1]:502"),
])  # fmt: skip
def test_an_address_has_one_name_however_it_is_written(monkeypatch, host, name):
    monkeypatch.setattr(socket, "getaddrinfo", lambda *args, **kwargs: 1 / 0)
    assert held_address(host, 502) == (name,)


def test_a_host_is_held_by_its_name_and_all_of_its_addresses(names):
    names["dac.lab"] = ["10.0.0.5", "10.0.0.6", "10.0.0.5", "fe80::1"]
    names["localhost"] = ["::1", "127.0.0.1"]
    assert held_address("DAC.lab.", 502) == (
        "tcp:dac.lab:502", "tcp:10.0.0.5:502", "tcp:10.0.0.6:502", "tcp:[fe80::1]:502",
    )  # fmt: skip
    assert set(held_address("localhost", 502)) & set(held_address("127.0.0.1", 502))
    assert held_address("unknown.lab", 502) == ("tcp:unknown.lab:502",)


def test_a_name_server_that_is_silent_is_not_waited_for(names, monkeypatch):
    answered = threading.Event()
    asked = []

    def getaddrinfo(name, *args, **kwargs):
        asked.append(name)
        answered.wait(60.0)
        raise socket.gaierror(-3, "Temporary failure in name resolution")

    monkeypatch.setattr(socket, "getaddrinfo", getaddrinfo)
    monkeypatch.setattr(resource_names, "_LOOKUP_S", 0.01)
    assert held_address("dac.lab", 502) == ("tcp:dac.lab:502",)
    assert asked == ["dac.lab"]
    answered.set()


def test_a_missing_answer_is_not_kept_and_an_answer_is(names):
    assert held_address("dac.lab", 502) == ("tcp:dac.lab:502",)
    names["dac.lab"] = ["10.0.0.5"]
    assert held_address("dac.lab", 502) == ("tcp:dac.lab:502", "tcp:10.0.0.5:502")
    del names["dac.lab"]
    assert held_address("dac.lab", 502) == ("tcp:dac.lab:502", "tcp:10.0.0.5:502")


def test_links_to_a_port_are_the_port(tmp_path):
    (tmp_path / "ttyUSB0").touch()
    for name, target in (("usb-adapter", "ttyUSB0"), ("gone", "ttyUSB1")):
        (tmp_path / name).symlink_to(target)
        link, port = f"serial:{tmp_path / name}", f"serial:{tmp_path.resolve()}/{target}"
        assert held_port(str(tmp_path / name)) == (link, port)
        (tmp_path / name).unlink()
        assert link in held_port(str(tmp_path / name))


def test_a_port_is_known_by_its_number_too(line):
    _, path = line
    rdev = Path(path).stat().st_rdev
    number = f"tty:{os.major(rdev)}:{os.minor(rdev)}"
    assert held_port(path) == (f"serial:{path}", number)
    assert number in held_port(f"/proc/self/root{path}")
