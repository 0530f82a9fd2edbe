"""What a device holds alone, as :attr:`hilctl.base.device.DeviceInfo.holds` has it.

One device is one lock, whatever it is called. So each place has all the names that another
experiment could know it by: a port its path, the file that its links lead to and the number that
the kernel knows it by, a host its name and its addresses.
"""

import ipaddress
import os
import socket
import stat
from contextlib import suppress
from functools import cache
from pathlib import Path
from threading import Thread

_LOOKUP_S = 1.0
"""Longest wait for a name server: a check of an experiment must not hang on it."""
_LOOPBACK = "127.0.0.1"


def held_port(path: str) -> tuple[str, ...]:
    """Return the names of a serial port; one that is not there has that of its file alone."""
    real = Path(path).resolve()
    # The path as it was given too: a link of udev is gone with its device, and what still waits
    # for that must be found.
    names = [f"serial:{Path(path).absolute()}", f"serial:{real}"]
    with suppress(OSError):
        status = real.stat()
        if stat.S_ISCHR(status.st_mode):
            names.append(f"tty:{os.major(status.st_rdev)}:{os.minor(status.st_rdev)}")
    return tuple(dict.fromkeys(names))


def held_address(host: str, port: int) -> tuple[str, ...]:
    """Return the names of a TCP port: by host name, and by each address that the name stands for.

    Where a name server does not answer in time only the name is left.
    """
    address = _literal(host)
    if address is not None:
        return (_named(address, port),)
    name = host.lower().rstrip(".")
    found = [_named(each, port) for each in _addresses(name)]
    return tuple(dict.fromkeys((f"tcp:{name}:{port}", *found)))


def _literal(host: str) -> str | None:
    """Return an address that was written as one, in its shortest form; None for a name."""
    try:
        return str(ipaddress.ip_address(host))
    except ValueError:
        pass
    try:  # what connecting takes too: 127.1, 0x7f.1, 2130706433
        return socket.inet_ntoa(socket.inet_aton(host)) if host.strip() == host else None
    except OSError:
        return None


@cache
def _addresses(name: str) -> tuple[str, ...]:
    found: list[str] = []

    def ask() -> None:
        try:
            answers = socket.getaddrinfo(name, None, type=socket.SOCK_STREAM)
        except (OSError, UnicodeError):
            return
        found.extend(str(answer[4][0]) for answer in answers)

    # The resolver has no time-out of its own; it is left behind where it takes too long.
    thread = Thread(target=ask, daemon=True)
    thread.start()
    thread.join(_LOOKUP_S)
    return tuple(found)


def _named(text: str, port: int) -> str:
    address = ipaddress.ip_address(text)
    if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None:
        address = address.ipv4_mapped
    # A port of this machine is one whichever of its loopback addresses leads there.
    if address.is_loopback or address.is_unspecified:
        address = ipaddress.ip_address(_LOOPBACK)
    return f"tcp:[{address}]:{port}" if address.version == 6 else f"tcp:{address}:{port}"
