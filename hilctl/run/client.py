"""Runs in the background, from outside: find one, ask it, change, mark and stop it.

It imports nothing heavy: a stop must not wait for a compiler.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any

from hilctl.base.errors import InputError, RunError
from hilctl.run.control_socket import ask
from hilctl.run.protocol import InverseState, request
from hilctl.run.run_folder import RunFolder, facts_of, runs
from hilctl.run.stopping import request_stop

_POLL_S = 0.02
_SET_S = 30.0


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
