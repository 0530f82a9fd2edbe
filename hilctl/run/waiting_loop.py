"""A loop's process that is started before its run is known: it imports while others check.

It has no device, and moves nothing, before it gets its job. Where none comes, it ends.

What starts it early imports this: nothing that takes time may be imported here.
"""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress

PLAIN, CHECKING = b"p", b"c"
"""First byte of a job: whether what it holds needs no checks in the loop's process."""
_MOST_LOCKS = 64
_GIVE_S = 5.0
_DEATH_S = 1.0
_ERRORS = 2
_WITH_ERRORS, _WITHOUT = b"e", b"-"
# No search for garbage among what is imported: it takes a tenth of the time, and finds none.
_START = (
    "import gc, importlib, sys; gc.disable(); sys.exit(importlib.import_module(sys.argv[1]).main())"
)


class WaitingLoop:
    """A loop's process that waits for its job."""

    def __init__(self) -> None:
        self._socket, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                # -P: what lies in the working folder is not to be imported.
                [sys.executable, "-P", "-c", _START, "hilctl.run.loop_process"],
                stdin=theirs.fileno(),
                # Before it has a job, what is wrong with it is not what is wrong with the run.
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # a Ctrl-C in the terminal is the supervisor's to handle
            )

    def give(self, job: bytes, inherits: Sequence[int]) -> "subprocess.Popen[bytes]":
        """Give it its job, and return it.

        Args:
            job: See :meth:`hilctl.run.job.Job.to_bytes`.
            inherits: Descriptors of locks that it is to hold.
        """
        self._socket.settimeout(_GIVE_S)
        # One that died is seen later, and so is one that hangs: it is killed when it does not
        # become ready.
        with self._socket, suppress(BrokenPipeError, ConnectionResetError, TimeoutError):
            errors = [_ERRORS] if _is_open(_ERRORS) else []
            first = _WITH_ERRORS if errors else _WITHOUT
            # With the first byte: the loop holds the locks before it can know what to do.
            socket.send_fds(self._socket, [first], [*errors, *inherits])
            self._socket.sendall(job)
            # Not by closing alone: a process that was forked meanwhile has this end too.
            self._socket.shutdown(socket.SHUT_WR)
        return self._process

    def discard(self) -> None:
        """Let it end, as there is no job for it."""
        self._socket.close()
        self._process.kill()  # it may still import, and holds nothing
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_DEATH_S)


def received_job(descriptor: int) -> bytes:
    """Return what :meth:`WaitingLoop.give` gave, in the loop's process; empty where none comes.

    This process's standard error is that of who gave it from then on, and descriptors that come
    with it stay open until this process ends.

    Args:
        descriptor: This end of the connection.
    """
    with socket.socket(fileno=descriptor) as connection, suppress(ConnectionResetError):
        first, descriptors, _, _ = socket.recv_fds(connection, 1, 1 + _MOST_LOCKS)
        if first == _WITH_ERRORS:
            os.dup2(descriptors[0], _ERRORS)
            os.close(descriptors[0])
        with connection.makefile("rb") as rest:
            return rest.read()
    return b""


def _is_open(descriptor: int) -> bool:
    try:
        os.fstat(descriptor)
    except OSError:
        return False
    return True


_ahead: list[WaitingLoop] = []


@contextmanager
def started_ahead() -> Iterator[None]:
    """Have one started for the next run of this process; it ends where no run takes it."""
    if not _ahead:
        _ahead.append(WaitingLoop())
    try:
        yield
    finally:
        while _ahead:
            _ahead.pop().discard()


def taken() -> WaitingLoop:
    """Return the one that was started ahead, which is its taker's now, or a new one."""
    return _ahead.pop() if _ahead else WaitingLoop()
