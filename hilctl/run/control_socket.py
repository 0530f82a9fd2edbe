"""The control socket of a run: one question a connection, one answer, both one line of JSON.

It is served between two looks at the ring, without waiting for anybody: a client that is slow,
silent or too long is cut off, and where there are too many, the one that has been silent longest.
What takes time to answer is answered later, while others are served.
"""

import json
import math
import os
import selectors
import socket
import struct
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

from hilctl.base.errors import InputError, RunError
from hilctl.base.private import private_folder
from hilctl.run.protocol import MAX_BYTES, VERSION, VERSION_KEY

_MAX_CLIENTS = 64
_BACKLOG = 256
_SILENT_S = 0.5
_LATER_S = 0.005
_ANSWER_BYTES = 65536
_LEAST_S = 0.01


class LaterAnswer(Protocol):
    """An answer that takes its time."""

    def answer(self) -> Mapping[str, Any] | None:
        """Return it; None where it is not there yet. An InputError becomes an answer in words."""
        ...


Answer = Callable[[bytes], Mapping[str, Any] | LaterAnswer]
"""Question in, answer out; an InputError becomes an answer in words."""


@dataclass(slots=True)
class _Client:
    connection: socket.socket
    until: float
    question: bytearray = field(default_factory=bytearray)
    later: LaterAnswer | None = None


class ControlServer:
    """Listens at a socket that only its owner may use.

    Args:
        path: Where; its folder must be private.
        answer: What to say.
        clock: Monotonic time in s.
    """

    def __init__(
        self, path: Path, answer: Answer, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._answer = answer
        self._clock = clock
        self._clients: dict[int, _Client] = {}
        self._path = path
        self._selector = selectors.DefaultSelector()
        self._listener = _listening(path)
        self._selector.register(self._listener, selectors.EVENT_READ)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        for client in list(self._clients.values()):
            self._drop(client)
        self._selector.close()
        self._listener.close()

    def serve(self, timeout_s: float) -> None:
        """Wait for something to do, at most that long, and do it."""
        if not self._path.exists():
            self._listen_again()
        until = self._clock() + timeout_s
        while True:
            later = [each for each in self._clients.values() if each.later is not None]
            left_s = max(0.0, until - self._clock())
            for key, _ in self._selector.select(min(left_s, _LATER_S) if later else left_s):
                if key.fileobj is self._listener:
                    self._accept()
                # One that was read may have made room for another of the same descriptor.
                elif (client := self._clients.get(key.fd)) is not None:
                    self._read(client)
            for client in later:
                self._answer_later(client)
            now = self._clock()
            for client in [each for each in self._clients.values() if now > each.until]:
                self._drop(client)
            if now >= until:
                return

    def _listen_again(self) -> None:
        """Listen at the same place after somebody has removed the socket or its folder."""
        folder = self._path.parent
        with suppress(OSError, RunError):  # if not now, perhaps the next time
            private_folder(private_folder(folder.parent) / folder.name)
            listener = _listening(self._path)
            self._selector.unregister(self._listener)
            self._listener.close()
            self._listener = listener
            self._selector.register(listener, selectors.EVENT_READ)

    def _accept(self) -> None:
        try:
            # All of them, up to what there is room for: a crowd must not fill the queue.
            for _ in range(_MAX_CLIENTS):
                self._welcome(self._listener.accept()[0])
        except BlockingIOError:
            return
        except OSError:  # there are no descriptors left: some come back
            self._drop_longest_silent()

    def _welcome(self, connection: socket.socket) -> None:
        if not _is_ours(connection):
            connection.close()
            return
        if len(self._clients) >= _MAX_CLIENTS:
            self._drop_longest_silent()
        connection.setblocking(False)
        client = _Client(connection, self._clock() + _SILENT_S)
        self._clients[connection.fileno()] = client
        self._selector.register(connection, selectors.EVENT_READ)
        # At once: what has been asked already can't be pushed out by those who come next.
        self._read(client)

    def _read(self, client: _Client) -> None:
        try:
            data = client.connection.recv(MAX_BYTES)
        except BlockingIOError:
            return
        except OSError:
            self._drop(client)
            return
        client.question += data
        line, end, _ = client.question.partition(b"\n")
        if len(line) > MAX_BYTES:
            self._reply(client, {"ok": False, "error": f"longer than {MAX_BYTES} bytes"})
        elif end or (line and not data):
            self._question(client, bytes(line))
        elif not data:
            self._drop(client)

    def _question(self, client: _Client, line: bytes) -> None:
        try:
            answer = self._answer(line)
        except InputError as error:
            self._reply(client, {"ok": False, "error": str(error)})
            return
        if isinstance(answer, Mapping):
            self._reply(client, {"ok": True, **answer})
            return
        # It has nothing more to say: that it has closed its side must not keep this one busy.
        self._selector.unregister(client.connection)
        client.later, client.until = answer, math.inf

    def _answer_later(self, client: _Client) -> None:
        assert client.later is not None
        try:
            answer = client.later.answer()
        except InputError as error:
            self._reply(client, {"ok": False, "error": str(error)})
            return
        if answer is not None:
            self._reply(client, {"ok": True, **answer})

    def _reply(self, client: _Client, answer: Mapping[str, Any]) -> None:
        said = json.dumps({VERSION_KEY: VERSION, **answer})
        with suppress(OSError):  # it did not wait, or can't take it: its loss
            client.connection.send(said.encode() + b"\n")
        self._drop(client)

    def _drop_longest_silent(self) -> None:
        silent = (each for each in self._clients.values() if each.later is None)
        if (longest := next(silent, None)) is not None:
            self._drop(longest)

    def _drop(self, client: _Client) -> None:
        del self._clients[client.connection.fileno()]
        if client.later is None:
            self._selector.unregister(client.connection)
        client.connection.close()


def _listening(path: Path) -> socket.socket:
    """Return a socket that listens at a path that only its owner may use.

    Raises:
        RunError: It can't.
    """
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    # Not chmod after bind: for that moment others could connect.
    before = os.umask(0o177)
    try:
        with _short(path) as short:
            listener.bind(short)
    except OSError as error:
        listener.close()
        raise RunError(f"{path}: can't listen: {error.strerror or error}") from None
    finally:
        os.umask(before)
    listener.listen(_BACKLOG)
    listener.setblocking(False)
    return listener


@contextmanager
def _short(path: Path) -> Iterator[str]:
    """Give a short name of a socket: the kernel takes no more than 107 bytes.

    Raises:
        OSError: Its folder can't be opened.
    """
    folder = os.open(path.parent, os.O_PATH | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{folder}/{path.name}"
    finally:
        os.close(folder)


def _is_ours(connection: socket.socket) -> bool:
    raw = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    user = struct.unpack("3i", raw)[1]
    return user in {0, os.getuid()}


def ask(
    path: Path,
    question: Mapping[str, Any],
    timeout_s: float = 5.0,
    clock: Callable[[], float] = time.monotonic,
) -> dict[str, Any]:
    """Ask a run something, again where a crowd has pushed the question out.

    Args:
        path: Its socket.
        question: What to ask; asked twice it must be the same as once.
        timeout_s: Longest wait.
        clock: Monotonic time in s.

    Returns:
        The answer.

    Raises:
        InputError: The run refuses; the text says why.
        RunError: There is nobody, or no answer, or one of another version.
    """
    until = clock() + timeout_s
    raw = json.dumps(question).encode() + b"\n"
    try:
        while not (said := _asked_once(path, raw, max(_LEAST_S, until - clock()))):
            if clock() >= until:
                raise TimeoutError("timed out among a crowd")
        answer = json.loads(said)
    except (OSError, ValueError) as error:
        raise RunError(f"the run at {path.parent.name} does not answer: {error}") from None
    spoken = answer.pop(VERSION_KEY, None) if isinstance(answer, dict) else None
    if spoken != VERSION:
        raise RunError(
            f"the run at {path.parent.name} speaks protocol {spoken}, this hilctl {VERSION}: use "
            "the hilctl that it was started with"
        )
    said_so: dict[str, Any] = answer
    if not said_so.pop("ok", False):
        raise InputError(str(said_so.get("error", "refused")))
    return said_so


def _asked_once(path: Path, raw: bytes, timeout_s: float) -> bytes:
    """Return what a run says to a question; nothing where it has cut the connection."""
    said = bytearray()
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(timeout_s)
        with _short(path) as short:
            connection.connect(short)
        if not _is_ours(connection):
            raise PermissionError("another user's process listens there")
        with suppress(ConnectionResetError, BrokenPipeError):
            connection.sendall(raw)
            while not said.endswith(b"\n") and (data := connection.recv(_ANSWER_BYTES)):
                said += data
    return bytes(said)
