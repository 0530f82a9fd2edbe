"""Exclusive use of a device: exclusive access to a port, and names of locks.

Only programs that use pyserial's lock respect it; a shell or a daemon that probes ports does not.
After TIOCEXCL the kernel refuses the port to all unprivileged programs. It does so as long as *any*
descriptor of the port is open, even if this process was killed. Then the guardian must open the
port to make the output safe, often without privileges. So TIOCEXCL is set only if it ends with this
process:

- on a real port that no other program has open, as far as this process can see;
- on a pseudo-terminal, which its far end keeps, only if this process could open it all the same.

Between experiments one device is one lock, see :attr:`hilctl.base.device.DeviceInfo.holds`.
Therefore each address has all names that another experiment could use: a port its path, the target
of its links and its device number, a host its name and its addresses.
"""

import ipaddress
import os
import socket
import stat
from contextlib import suppress
from functools import cache
from pathlib import Path
from threading import Thread

from hilctl_drivers.transport.port_identity import PTY_MAJORS


def refuse_to_others(descriptor: int, path: str) -> bool:
    """Refuse an open port to other programs if that ends with this process; return whether it does.

    ``path`` is its device file.
    """
    device = os.fstat(descriptor).st_rdev
    is_pty = os.major(device) in PTY_MAJORS
    if not is_pty and others_have(device):
        return False
    if not _set(descriptor, on=True):
        return False
    if is_pty and not _can_open(path):
        admit_others(descriptor)
        return False
    return True


def admit_others(descriptor: int) -> None:
    """Undo :func:`refuse_to_others`."""
    _set(descriptor, on=False)


def others_have(device: int, processes: Path = Path("/proc")) -> bool:
    """Return whether another process has a device open, as far as this user can see."""
    for folder in processes.glob("[0-9]*/fd"):
        if folder.parent.name == str(os.getpid()):
            continue
        with suppress(OSError):  # it ended, or is another user's
            for each in folder.iterdir():
                with suppress(OSError):
                    # By its name first: to ask for a file may wait for a network that is gone.
                    if str(each.readlink()).startswith("/dev/") and each.stat().st_rdev == device:
                        return True
    return False


def _set(descriptor: int, *, on: bool) -> bool:
    from fcntl import ioctl
    from termios import TIOCEXCL, TIOCNXCL

    try:
        ioctl(descriptor, TIOCEXCL if on else TIOCNXCL)
    except OSError:
        return False
    return True


def _can_open(path: str) -> bool:
    try:
        os.close(os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK))
    except OSError:
        return False
    return True


_LOOKUP_S = 1.0
"""Longest wait for a name server: a check of an experiment must not hang on it."""
_LOOPBACK = "127.0.0.1"


def held_port(path: str) -> tuple[str, ...]:
    """Return the names of a serial port; a missing port has only the name of its file."""
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
    """Return the names of a TCP port: by host name, and by each of its addresses.

    Without an answer of the name server in time, only the host name is left.
    """
    address = _literal(host)
    if address is not None:
        return (_named(address, port),)
    name = host.lower().rstrip(".")
    found: list[str] = []
    with suppress(LookupError):
        found = [_named(each, port) for each in _addresses(name)]
    return tuple(dict.fromkeys((f"tcp:{name}:{port}", *found)))


def _literal(host: str) -> str | None:
    """Return an address in its shortest form; None for a name."""
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

    # The resolver has no timeout of its own; it is left behind where it takes too long.
    thread = Thread(target=ask, daemon=True)
    thread.start()
    thread.join(_LOOKUP_S)
    if not found:
        raise LookupError(name)  # not cached, unlike an answer
    return tuple(found)


def _named(text: str, port: int) -> str:
    address = ipaddress.ip_address(text)
    if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None:
        address = address.ipv4_mapped
    # A port of this machine is one whichever of its loopback addresses leads there.
    if address.is_loopback or address.is_unspecified:
        address = ipaddress.ip_address(_LOOPBACK)
    return f"tcp:[{address}]:{port}" if address.version == 6 else f"tcp:{address}:{port}"
