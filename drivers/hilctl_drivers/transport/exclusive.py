"""A serial port refused to other programs.

pyserial's lock is heeded only by programs that take one too; a shell, a terminal program or a
daemon that probes ports does not. The kernel refuses the port to all of them after TIOCEXCL, except
to privileged ones.

It keeps that as long as *any* descriptor of the port is open, also when the process that asked for
it was killed. Then the guardian must open the port to make the output safe, often without
privileges, and nobody is left to lift it. So it is asked for only where it ends with this process:

- on a real port that no other program has open, as far as this process can see;
- on a pseudo-terminal, which its far end keeps, only if this process could open it all the same.

A process that cannot be killed keeps its descriptor, and with it this and pyserial's lock: nothing
opens the port before it is gone, as without this.
"""

import os
from contextlib import suppress
from pathlib import Path

_PTY_MAJORS = range(136, 144)


def refuse_to_others(descriptor: int, path: str) -> bool:
    """Refuse an open port to other programs, where that ends with this process.

    Args:
        descriptor: The port.
        path: Its device file.

    Returns:
        Whether they are refused.
    """
    device = os.fstat(descriptor).st_rdev
    is_pty = os.major(device) in _PTY_MAJORS
    if not is_pty and others_have(device):
        return False
    if not _set(descriptor, on=True):
        return False
    if is_pty and not _can_open(path):
        _set(descriptor, on=False)
        return False
    return True


def admit_others(descriptor: int) -> None:
    """Undo :func:`refuse_to_others`."""
    _set(descriptor, on=False)


def others_have(device: int, processes: Path = Path("/proc")) -> bool:
    """Return whether another process has a device open, as far as this user can see.

    Args:
        device: Number of the device.
        processes: Where the kernel shows processes.
    """
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
