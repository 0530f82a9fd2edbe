"""Serve the control socket of a run.

A connection carries one request and one answer, each one line of JSON. Each client has a thread of
its own, so an answer may take its time. Clients that send nothing are dropped after half a second.
"""

import json
import logging
import os
import socketserver
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

from hilctl.base.errors import InputError, RunError
from hilctl.base.private_dirs import private_folder
from hilctl.run.control.client import MAX_BYTES, VERSION, VERSION_KEY, is_same_user, short_path

_log = logging.getLogger(__name__)

_MAX_CLIENTS = 64
_BACKLOG = 256
_REQUEST_S = 0.5
_POLL_S = 0.05

Answer = Callable[[bytes], Mapping[str, Any]]
"""Answer a request; an InputError becomes a refusal. It is called from several threads."""


class ControlServer:
    """Serve a socket that only its owner may use."""

    def __init__(self, path: Path, answer: Answer, request_s: float = _REQUEST_S) -> None:
        self._path, self._answer, self._request_s = path, answer, request_s
        self._server = _Server(path, answer, request_s)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="control", daemon=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self._closing.set()
        if self._thread.ident is not None:
            self._thread.join()
        self._server.server_close()

    def start(self) -> None:
        """Start to answer; earlier requests have waited."""
        self._thread.start()

    def _serve(self) -> None:
        while not self._closing.is_set():
            self._restore_socket()
            self._server.handle_request()

    def _restore_socket(self) -> None:
        """Listen again at the same path if the socket or its folder was removed."""
        folder = self._path.parent
        with suppress(OSError, RunError):  # retried at the next poll
            if self._path.exists():
                return
            private_folder(private_folder(folder.parent) / folder.name)
            server = _Server(self._path, self._answer, self._request_s)
            self._server.server_close()
            self._server = server


class _Server(socketserver.ThreadingUnixStreamServer):
    daemon_threads = True
    request_queue_size = _BACKLOG
    timeout = _POLL_S

    def __init__(self, path: Path, answer: Answer, request_s: float) -> None:
        self.answer, self.request_s = answer, request_s
        self._path = path
        self._free = threading.BoundedSemaphore(_MAX_CLIENTS)
        try:
            super().__init__(str(path), _Handler)
        except OSError as error:
            raise RunError(f"{path}: can't listen: {error.strerror or error}") from None

    def server_bind(self) -> None:
        # Not chmod after bind: for that moment others could connect.
        before = os.umask(0o177)
        try:
            with short_path(self._path) as short:
                self.socket.bind(short)
        finally:
            os.umask(before)

    def verify_request(self, request: Any, client_address: Any) -> bool:
        return is_same_user(request)

    def process_request(self, request: Any, client_address: Any) -> None:
        self._free.acquire()  # other clients wait in the queue of the socket
        try:
            super().process_request(request, client_address)
        except RuntimeError:  # the thread cannot be started
            self._free.release()
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        _log.exception("a control request failed")


class _Handler(socketserver.BaseRequestHandler):
    server: _Server

    def handle(self) -> None:
        with suppress(OSError):  # a client that is slow or has left gets no answer
            if (line := self._read_line()) is not None:
                self.request.settimeout(self.server.request_s)
                self.request.sendall(self._answer(line))

    def _read_line(self) -> bytes | None:
        """Return the request; None if the client has sent nothing."""
        deadline = time.monotonic() + self.server.request_s
        read = bytearray()
        while b"\n" not in read and len(read) <= MAX_BYTES:
            left_s = deadline - time.monotonic()
            if left_s <= 0.0:
                raise TimeoutError
            self.request.settimeout(left_s)
            if not (data := self.request.recv(MAX_BYTES)):
                break
            read += data
        return bytes(read).partition(b"\n")[0] if read else None

    def _answer(self, line: bytes) -> bytes:
        answer: dict[str, Any] = {"ok": False, "error": f"longer than {MAX_BYTES} bytes"}
        if len(line) <= MAX_BYTES:
            try:
                answer = {"ok": True, **self.server.answer(line)}
            except InputError as error:
                answer = {"ok": False, "error": str(error)}
        return json.dumps({VERSION_KEY: VERSION, **answer}).encode() + b"\n"
