"""One device is one lock, whatever it is called."""

import os
import pty
import socket
import threading
from pathlib import Path

import pytest

from hilctl_drivers.transport import resource_names
from hilctl_drivers.transport.resource_names import held_address, held_port


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


@pytest.mark.parametrize(
    ("host", "name"),
    [
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
    ],
)
def test_an_address_has_one_name_however_it_is_written(monkeypatch, host, name):
    """Without anybody being asked."""
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
    """The name is held all the same; a second question does not wait again."""
    answered = threading.Event()
    asked = []

    def getaddrinfo(name, *args, **kwargs):
        asked.append(name)
        answered.wait(60.0)
        raise socket.gaierror(-3, "Temporary failure in name resolution")

    monkeypatch.setattr(socket, "getaddrinfo", getaddrinfo)
    monkeypatch.setattr(resource_names, "_LOOKUP_S", 0.01)
    for _ in range(2):
        assert held_address("dac.lab", 502) == ("tcp:dac.lab:502",)
    assert asked == ["dac.lab"]
    answered.set()


def test_links_to_a_port_are_the_port(tmp_path):
    """As those under /dev/serial/by-id; also one that leads to nothing yet, or is gone."""
    (tmp_path / "ttyUSB0").touch()
    for name, target in (("usb-adapter", "ttyUSB0"), ("gone", "ttyUSB1")):
        (tmp_path / name).symlink_to(target)
        link, port = f"serial:{tmp_path / name}", f"serial:{tmp_path.resolve()}/{target}"
        assert held_port(str(tmp_path / name)) == (link, port)
        (tmp_path / name).unlink()
        assert link in held_port(str(tmp_path / name))


def test_a_port_is_known_by_its_number_too(monkeypatch):
    """So that another file of the same device is the same port."""
    master, slave = pty.openpty()
    try:
        path = os.ttyname(slave)
        rdev = Path(path).stat().st_rdev
        number = f"tty:{os.major(rdev)}:{os.minor(rdev)}"
        assert held_port(path) == (f"serial:{path}", number)
        assert number in held_port(f"/proc/self/root{path}")
    finally:
        os.close(slave)
        os.close(master)
