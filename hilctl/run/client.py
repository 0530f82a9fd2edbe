"""Find, query, change, mark and stop runs from outside.

It imports nothing heavy: a stop must not wait for a compiler.
"""

import json
import os
import signal
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from hilctl.base.errors import InputError, RunError
from hilctl.run.protocol import (
    STOP_SIGNAL,
    VERSION,
    VERSION_KEY,
    InverseState,
    is_same_user,
    request,
    short_path,
)
from hilctl.run.run_folder import RunFolder, facts_of, runs

_POLL_S = 0.02
_SET_S = 30.0
_LEAST_S = 0.01
_ANSWER_BYTES = 65536


def ask(
    path: Path,
    question: Mapping[str, Any],
    timeout_s: float = 5.0,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> dict[str, Any]:
    """Send a request to a run, again if it was dropped before its answer.

    Args:
        path: Socket of the run.
        question: The request; sent twice it must have the effect of one.
        timeout_s: Longest wait.
        clock: Monotonic time in s.
        sleep: Waits for that many s.

    Returns:
        The answer.

    Raises:
        InputError: The run refuses; the text says why.
        RunError: The run is gone, does not answer, or has another version of the protocol.
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
    """Return the answer of a run; nothing if it has dropped the client or its queue is full."""
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


def going_on() -> list[RunFolder]:
    """Return the runs of this user whose supervisor lives, the oldest first."""
    return [run for run in runs() if run.supervised]


def find_run(name: str | None) -> RunFolder:
    """Return the run that is meant.

    Args:
        name: Its name, or the beginning of it; may be left out where there is one run only.

    Raises:
        InputError: There is none, or more than one.
    """
    going = going_on()
    if name:  # never by chance: who ends a guardian says which one
        going += [run for run in runs() if not run.supervised and _guardian_status(run)]
    chosen = [run for run in going if run.card.name.startswith(name or "")]
    exact = [run for run in chosen if run.card.name == name]
    if len(exact or chosen) == 1:
        return (exact or chosen)[0]
    if not going:
        raise InputError("no run is going on")
    known = ", ".join(run.card.name for run in going)
    if not chosen:
        raise InputError(f"no run is named {name!r} (going on: {known})")
    raise InputError(f"more than one run is meant, say which with --run (going on: {known})")


def status_of(run: RunFolder) -> dict[str, Any]:
    """Return where a run stands, also where nobody answers for it any more."""
    if run.supervised:
        try:
            return ask(run.socket, request("status"))
        except (RunError, InputError) as error:
            return {**facts_of(run), "state": "not answering", "error": str(error)}
    state = "ramping down without its supervisor" if run.alive else "dead"
    return {**facts_of(run), "state": state, **_guardian_status(run)}


def _guardian_status(run: RunFolder) -> dict[str, Any]:
    """Return how far the guardian of a run that has ended is; empty if it does not act."""
    if not run.alive:
        return {}
    # Imported here: a stop must not wait for numpy.
    from hilctl.loop.safe_output import describe
    from hilctl.run.ring import safe_result_of

    result = safe_result_of(run)
    if result is None:
        return {}
    known = {"output_state": result.output, "error": describe(result.output, result.error)}
    return {"state": "setting the safe value", **known}


def request_stop(run: RunFolder) -> bool:
    """Stop a run by its safe ramp; return whether a process received the request.

    A guardian that is still active after the end of a run is ended immediately.

    Raises:
        RunError: The kernel refuses.
    """
    try:
        process = os.pidfd_open(run.card.supervisor)
        try:
            # After the process was opened: while its lock is held the number can't be another's.
            if run.supervised:
                signal.pidfd_send_signal(process, STOP_SIGNAL)
                return True
        finally:
            os.close(process)
    except ProcessLookupError:
        pass
    except OSError as error:
        raise RunError(f"{run.card.name}: can't be stopped: {error.strerror}") from None
    return _end_guardian(run)


def _end_guardian(run: RunFolder) -> bool:
    if not run.alive:
        return False
    # Imported here: a stop must not wait for numpy.
    from hilctl.run.guardian_process import signal_guardian

    return signal_guardian(run, signal.SIGTERM)


def stop_runs(
    chosen: Sequence[RunFolder],
    wait_s: float,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> list[dict[str, Any]]:
    """Request runs to end by their safe ramps, all of them before any is waited for.

    Args:
        chosen: The runs.
        wait_s: How long to wait for the end of all.
        clock: Monotonic time in s.
        sleep: Lets that many s pass.

    Returns:
        Of each run what it says of itself, with ``ended``: whether it is over, and ``error``: why
        it could not be requested, or an empty text.
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
        # Without a supervisor its loop ramps down by itself.
        return "" if request_stop(run) or not run.alive else "its supervisor is gone"
    except RunError as error:
        return str(error)


def set_run(
    run: RunFolder,
    *,
    gain: float | None = None,
    offset: float | None = None,
    inverse: InverseState | None = None,
    over_s: float = 1.0,
) -> dict[str, Any]:
    """Move a running reference, or take the inverse out and in; what is None stays.

    Args:
        run: The run.
        gain: Factor of the reference.
        offset: Added to it, in the waveform's unit.
        inverse: Whether the inverse is to be in, or a straight line in its place.
        over_s: Time that the change takes.

    Raises:
        InputError: The run refuses it; nothing has changed.
        RunError: It does not answer.
    """
    wanted = request("set", gain=gain, offset=offset, inverse=inverse, over_s=over_s)
    return ask(run.socket, wanted, timeout_s=_SET_S)


def mark_run(run: RunFolder, text: str) -> dict[str, Any]:
    """Set a mark at the present sample of a run.

    Raises:
        InputError: The run refuses it.
        RunError: It does not answer.
    """
    return ask(run.socket, request("mark", text=text))


def assigned(assignments: Sequence[str]) -> dict[str, Any]:
    """Return what :func:`set_run` is to set, from ``gain=0.5``, ``offset=2.0``, ``inverse=out``.

    Raises:
        InputError: There is no such parameter.
    """
    wanted: dict[str, Any] = {}
    for text in assignments:
        key, equals, value = text.partition("=")
        if key not in {"gain", "offset", "inverse"} or not equals:
            raise InputError(f"must be gain=NUMBER, offset=NUMBER or inverse=in|out: {text!r}")
        if key == "inverse" and value not in {"in", "out"}:
            raise InputError(f"inverse must be in or out: {value!r}")
        try:
            wanted[key] = value if key == "inverse" else float(value)
        except ValueError:
            raise InputError(f"{key} must be a number: {value!r}") from None
    return wanted
