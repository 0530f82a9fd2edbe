"""The protocol of a running supervisor: its requests, its socket, and the signal that stops it.

``docs/reference/protocol.md`` describes it. Importing this module is cheap: clients must not wait
for a compiler. ``run/requests.py`` checks the requests.
"""

import os
import signal
import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, TypeAlias

VERSION = 1
"""Version of the protocol; it rises if a message changes its meaning, not for one more key."""
VERSION_KEY = "protocol"
"""Key of the version in every answer."""

Command: TypeAlias = Literal["status", "set", "mark"]
InverseState: TypeAlias = Literal["in", "out"]

MAX_BYTES = 4096
"""Longest request."""
MAX_MARK = 200
"""Characters of the longest mark."""

# Windows has none of them, and no runs; recordings are read there with the same modules.
STOP_SIGNAL: signal.Signals = getattr(signal, "SIGUSR1", signal.SIGTERM)
"""Signal of ``hilctl stop`` to a supervisor: no other client and no full socket can delay it."""
HANG_UP: signal.Signals = getattr(signal, "SIGHUP", signal.SIGTERM)
"""Signal to a process when its terminal closes."""
JOB_CONTROL: tuple[signal.Signals, ...] = tuple(
    getattr(signal, name) for name in ("SIGTSTP", "SIGTTIN", "SIGTTOU") if hasattr(signal, name)
)
"""Signals by which a terminal suspends a process; a suspended supervisor could not stop."""


def request(command: Command, **values: Any) -> dict[str, Any]:
    """Return a request; values that are None are left out."""
    given = {key: value for key, value in values.items() if value is not None}
    return {"command": command, **given}


@contextmanager
def short_path(path: Path) -> Iterator[str]:
    """Provide a short path of a socket: the kernel accepts at most 107 bytes.

    Raises:
        OSError: The folder of the socket cannot be opened.
    """
    folder = os.open(path.parent, os.O_PATH | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{folder}/{path.name}"
    finally:
        os.close(folder)


def is_same_user(connection: socket.socket) -> bool:
    """Return whether the process at the other end belongs to this user or to root."""
    raw = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    user = struct.unpack("3i", raw)[1]
    return user in {0, os.getuid()}
