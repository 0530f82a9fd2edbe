"""The control socket of a run: one question a connection, one answer, both one line of JSON.

It is served between two looks at the ring, without waiting for anybody: a client that is slow,
silent or too long is cut off.
"""

import json
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
from typing import Any, Self

from hilctl.base.errors import InputError, RunError

MAX_BYTES = 4096
"""Longest question."""
_MAX_CLIENTS = 8
_CLIENT_S = 1.0
_ANSWER_BYTES = 65536

Answer = Callable[[bytes], Mapping[str, Any]]
"""Question in, answer out; an InputError becomes an answer in words."""


@dataclass(slots=True)
class _Client:
    connection: socket.socket
    until: float
    question: bytearray = field(default_factory=bytearray)


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
        self._selector = selectors.DefaultSelector()
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        # Not chmod after bind: for that moment others could connect.
        before = os.umask(0o177)
        try:
            with _short(path) as short:
                self._listener.bind(short)
        except OSError as error:
            self._listener.close()
            raise RunError(f"{path}: can't listen: {error.strerror or error}") from None
        finally:
            os.umask(before)
        self._listener.listen(_MAX_CLIENTS)
        self._listener.setblocking(False)
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
        until = self._clock() + timeout_s
        while True:
            left_s = until - self._clock()
            for key, _ in self._selector.select(max(0.0, left_s)):
                if key.fileobj is self._listener:
                    self._accept()
                else:
                    self._read(self._clients[key.fd])
            now = self._clock()
            for client in [each for each in self._clients.values() if now > each.until]:
                self._drop(client)
            if now >= until:
                return

    def _accept(self) -> None:
        with suppress(OSError):  # it went away again, or there are no descriptors left
            connection, _ = self._listener.accept()
            if len(self._clients) >= _MAX_CLIENTS or not _is_ours(connection):
                connection.close()
                return
            connection.setblocking(False)
            client = _Client(connection, self._clock() + _CLIENT_S)
            self._clients[connection.fileno()] = client
            self._selector.register(connection, selectors.EVENT_READ)

    def _read(self, client: _Client) -> None:
        try:
            data = client.connection.recv(MAX_BYTES)
        except OSError:
            self._drop(client)
            return
        client.question += data
        line, end, _ = client.question.partition(b"\n")
        if len(line) > MAX_BYTES:
            self._reply(client, {"ok": False, "error": f"longer than {MAX_BYTES} bytes"})
        elif end or (line and not data):
            self._reply(client, self._answered(bytes(line)))
        elif not data:
            self._drop(client)

    def _answered(self, line: bytes) -> Mapping[str, Any]:
        try:
            return {"ok": True, **self._answer(line)}
        except InputError as error:
            return {"ok": False, "error": str(error)}

    def _reply(self, client: _Client, answer: Mapping[str, Any]) -> None:
        with suppress(OSError):  # it did not wait, or can't take it: its loss
            client.connection.send(json.dumps(answer).encode() + b"\n")
        self._drop(client)

    def _drop(self, client: _Client) -> None:
        del self._clients[client.connection.fileno()]
        self._selector.unregister(client.connection)
        client.connection.close()


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


def ask(path: Path, question: Mapping[str, Any], timeout_s: float = 5.0) -> dict[str, Any]:
    """Ask a run something.

    Args:
        path: Its socket.
        question: What to ask.
        timeout_s: Longest wait.

    Returns:
        The answer.

    Raises:
        InputError: The run refuses; the text says why.
        RunError: There is nobody, or no answer.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(timeout_s)
        try:
            with _short(path) as short:
                connection.connect(short)
            connection.sendall(json.dumps(question).encode() + b"\n")
            raw = bytearray()
            while not raw.endswith(b"\n") and (data := connection.recv(_ANSWER_BYTES)):
                raw += data
            answer = json.loads(raw)
        except (OSError, ValueError) as error:
            raise RunError(f"the run at {path.parent.name} does not answer: {error}") from None
    if not isinstance(answer, dict) or not answer.pop("ok", False):
        raise InputError(str(answer.get("error", "refused")) if isinstance(answer, dict) else "?")
    return answer
