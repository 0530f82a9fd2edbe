"""Client of a running supervisor: find runs, query, change, mark and stop them, recover dead ones.

``docs/reference/protocol.md`` describes the requests; ``run/control/requests.py`` validates them.
Importing this module is fast: a stop must not wait for a compiler.
"""

import json
import logging
import os
import signal
import socket
import struct
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal, TypeAlias

from hilctl.base.errors import InputError, RunError
from hilctl.run.run_folder import RunFolder, facts_of, runs

_log = logging.getLogger(__name__)

VERSION = 1  # version of the protocol; it changes with the meaning of a message, not with a new key
VERSION_KEY = "protocol"  # key of the version in every answer
Command: TypeAlias = Literal["status", "set", "mark"]
InverseState: TypeAlias = Literal["in", "out"]

MAX_BYTES = 4096  # longest request in bytes
MAX_MARK = 200  # longest mark in characters

# Windows lacks these signals; it has no runs, but imports this module.
STOP_SIGNAL: signal.Signals = getattr(signal, "SIGUSR1", signal.SIGTERM)
"""Signal of ``hilctl stop`` to a supervisor: no other client and no full socket can delay it."""
HANG_UP: signal.Signals = getattr(signal, "SIGHUP", signal.SIGTERM)
"""Signal to a process when its terminal closes."""
JOB_CONTROL: tuple[signal.Signals, ...] = tuple(
    getattr(signal, name) for name in ("SIGTSTP", "SIGTTIN", "SIGTTOU") if hasattr(signal, name)
)
"""Signals by which a terminal suspends a process; a suspended supervisor could not stop."""

_POLL_S = 0.02
_SET_S = 30.0
_LEAST_S = 0.01
_ANSWER_BYTES = 65536


def request(command: Command, **values: Any) -> dict[str, Any]:
    """Return a request; values that are None are omitted."""
    given = {key: value for key, value in values.items() if value is not None}
    return {"command": command, **given}


@contextmanager
def short_path(path: Path) -> Iterator[str]:
    """Provide a short path of a socket: the kernel accepts at most 107 bytes."""
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


def ask(
    path: Path,
    question: Mapping[str, Any],
    timeout_s: float = 5.0,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> dict[str, Any]:
    """Send a request to a run; return the answer.

    If the connection is dropped it is sent again, which must have the effect of one request.

    Raises:
        InputError: The run refuses the request.
        RunError: The run does not answer, or uses another protocol version.
    """
    until = clock() + timeout_s
    raw = json.dumps(question).encode() + b"\n"
    try:
        while not (said := _asked_once(path, raw, max(_LEAST_S, until - clock()))):
            if clock() >= until:
                raise TimeoutError("timed out among other clients")
            sleep(_LEAST_S)
        answer = json.loads(said)
    except (OSError, ValueError) as error:
        raise RunError(f"the run at {path.parent.name} does not answer: {error}") from None
    version = answer.pop(VERSION_KEY, None) if isinstance(answer, dict) else None
    if version != VERSION:
        raise RunError(
            f"the run at {path.parent.name} speaks protocol {version}, this hilctl {VERSION}: use "
            "the hilctl that it was started with"
        )
    values: dict[str, Any] = answer
    if not values.pop("ok", False):
        raise InputError(str(values.get("error", "refused")))
    return values


def _asked_once(path: Path, raw: bytes, timeout_s: float) -> bytes:
    """Return the answer of a run; empty if the connection is dropped or the queue is full."""
    said = bytearray()
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(timeout_s)
        with short_path(path) as short:
            try:
                connection.connect(short)
            except BlockingIOError:
                return b""
        if not is_same_user(connection):
            raise PermissionError("another user's process listens there")
        with suppress(ConnectionResetError, BrokenPipeError):
            connection.sendall(raw)
            while not said.endswith(b"\n") and (data := connection.recv(_ANSWER_BYTES)):
                said += data
    return bytes(said)


def active_runs() -> list[RunFolder]:
    """Return the runs of this user with a live supervisor, oldest first."""
    return [run for run in runs() if run.supervised]


def find_run(name: str | None) -> RunFolder:
    """Return a run by a unique beginning of its name, or the only run; raise InputError if none."""
    active = active_runs()
    if name:  # a guardian is only chosen by name
        active += [run for run in runs() if not run.supervised and _guardian_status(run)]
    chosen = [run for run in active if run.card.name.startswith(name or "")]
    exact = [run for run in chosen if run.card.name == name]
    if len(exact or chosen) == 1:
        return (exact or chosen)[0]
    if not active:
        raise InputError("no run is active")
    known = ", ".join(run.card.name for run in active)
    if not chosen:
        raise InputError(f"no run is named {name!r} (active: {known})")
    raise InputError(f"several runs match: select one with --run (active: {known})")


def status_of(run: RunFolder) -> dict[str, Any]:
    """Return the status of a run, also without a supervisor."""
    if run.supervised:
        try:
            return ask(run.socket, request("status"))
        except (RunError, InputError) as error:
            return {**facts_of(run), "state": "not answering", "error": str(error)}
    if run.alive:
        state = {"state": "ramping down without its supervisor"}
    elif run.recorded:
        why = (
            "all its processes ended before the output was safe. hilctl safe EXPERIMENT sets the "
            f"safe value; hilctl recover --dismiss {run.card.name} forgets the run"
        )
        state = {"state": "dead", "output_state": "unknown", "error": why}
    else:
        state = {"state": "dead"}
    return {**facts_of(run), **state, **_guardian_status(run)}


def _guardian_status(run: RunFolder) -> dict[str, Any]:
    """Return the status of a guardian after its run; empty if it does not act."""
    if not run.alive:
        return {}
    from hilctl.loop.safe_output import describe  # a stop must not wait for NumPy
    from hilctl.run.shared.ring import safe_result_of

    result = safe_result_of(run)
    if result is None:
        return {}
    known = {"output_state": result.output, "error": describe(result.output, result.error)}
    return {"state": "setting the safe value", **known}


def request_stop(run: RunFolder) -> bool:
    """Stop a run by its safe ramp; return whether a process received the request.

    A guardian that is active after its run is ended immediately. Raise RunError if the kernel
    refuses.
    """
    try:
        process = os.pidfd_open(run.card.supervisor)
        try:
            # Checked after opening it: while the lock is held, the number is not reused.
            if run.supervised:
                signal.pidfd_send_signal(process, STOP_SIGNAL)
                return True
        finally:
            os.close(process)
    except ProcessLookupError:
        pass
    except OSError as error:
        raise RunError(f"{run.card.name}: cannot be stopped: {error.strerror}") from None
    if not run.alive:
        return False
    from hilctl.run.processes import signal_guardian  # a stop must not wait for NumPy

    return signal_guardian(run, signal.SIGTERM)


def stop_runs(
    chosen: Sequence[RunFolder],
    wait_s: float,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> list[dict[str, Any]]:
    """Stop runs by their safe ramps, all at the same time.

    Return the card of each run with ``ended``, and ``error``: why the request failed, or empty.
    """
    refused = [_refusal(run) for run in chosen]
    deadline = clock() + wait_s
    while any(run.alive for run in chosen) and clock() < deadline:
        sleep(_POLL_S)
    return [
        {**facts_of(run), "ended": not run.alive, "error": error}
        for run, error in zip(chosen, refused, strict=True)
    ]


def _refusal(run: RunFolder) -> str:
    try:
        # Without a supervisor the loop ramps down by itself.
        return "" if request_stop(run) or not run.alive else "its supervisor is gone"
    except RunError as error:
        return str(error)


def set_run(
    run: RunFolder,
    *,
    gain: float | None = None,
    offset: float | None = None,
    inverse: InverseState | None = None,
    axes: Mapping[str, Mapping[str, Any]] | None = None,
    over_s: float = 1.0,
) -> dict[str, Any]:
    """Change gain or offset of a running reference, or bypass its inverse; None: unchanged.

    The inverse ``out`` is replaced by a straight line. The change takes ``over_s``. It is that of
    all axes; ``axes`` has other values of axes by name. All begin with the same sample.

    Raises:
        InputError: The run refuses the change.
        RunError: It does not answer.
    """
    wanted = request("set", gain=gain, offset=offset, inverse=inverse, axes=axes, over_s=over_s)
    return ask(run.socket, wanted, timeout_s=_SET_S)


def mark_run(run: RunFolder, text: str) -> dict[str, Any]:
    """Set a mark at the present sample of a run; raise InputError if the run refuses it."""
    return ask(run.socket, request("mark", text=text))


def assigned(assignments: Sequence[str]) -> dict[str, Any]:
    """Return the arguments of :func:`set_run` from texts; raise InputError for invalid ones."""
    wanted: dict[str, Any] = {}
    axes: dict[str, dict[str, Any]] = {}
    for text in assignments:
        name, equals, value = text.partition("=")
        axis, _, key = name.rpartition(".")
        if key not in {"gain", "offset", "inverse"} or not equals:
            rule = f"must be gain=NUMBER, offset=NUMBER or inverse=in|out: {text!r}"
            raise InputError(f"{rule} (of one axis: x.gain=NUMBER)")
        values = axes.setdefault(axis, {}) if axis else wanted
        if key in values:
            raise InputError(f"{name} is given twice: {text!r}")
        if key == "inverse" and value not in {"in", "out"}:
            raise InputError(f"{name} must be in or out: {value!r}")
        try:
            values[key] = value if key == "inverse" else float(value.replace("_", " "))
        except ValueError:
            raise InputError(f"{name} must be a number: {value!r}") from None
    return wanted | {"axes": axes} if axes else wanted


def finish_dead_runs() -> None:
    """Recover the samples of dead runs, and log the result of each."""
    if all(run.supervised or (run.recorded and run.alive) for run in runs()):
        return
    from hilctl.run.recovery import recover_dead_runs  # its imports take a second

    for run in recover_dead_runs():
        if not run.started:
            _log.warning("%s had died before its start: %s", run.name, run.text)
            continue
        _log.warning("%s was not recorded to its end: %s", run.name, run.text)
        if run.kept:
            _log.warning(
                "its samples are kept in %s; the next command tries again. "
                "hilctl recover --dismiss %s discards them",
                run.kept,
                run.name,
            )
        else:
            _log.warning("recovered into %s", run.recording)
