"""Requests to a running supervisor: its socket; status, changes of the reference, marks.

A connection carries one request and one answer, each one line of JSON. Each client has a thread of
its own, so an answer may take its time. Clients that send nothing are dropped after half a second.

A change of gain, offset or inverse is checked by a bound on the amplitude. It waits until the loop
has taken the previous one, so none is overwritten.
"""

import json
import logging
import math
import os
import socketserver
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, TypeAdapter, ValidationError

from hilctl.base.errors import InputError, RunError
from hilctl.base.events import MARK, Event
from hilctl.base.formatting import did_you_mean
from hilctl.base.private_dirs import private_folder
from hilctl.base.strict import HALF_CHARACTER, StrictModel, first_problem, without_halves
from hilctl.experiment.preflight import CheckedExperiment, CheckedRun
from hilctl.kernels.interlock import apart_block
from hilctl.loop.compensator import Compensator
from hilctl.loop.interlocks import in_samples
from hilctl.run.control.client import (
    MAX_BYTES,
    MAX_MARK,
    VERSION,
    VERSION_KEY,
    InverseState,
    is_same_user,
    short_path,
)
from hilctl.run.recorder import RingRecorder
from hilctl.run.run_folder import RunFolder, facts_of
from hilctl.run.shared.shared_page import PageField, SharedPage

_log = logging.getLogger(__name__)

_MAX_CLIENTS = 64
_BACKLOG = 256
_REQUEST_S = 0.5
_ACCEPT_S = 0.05

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
    timeout = _ACCEPT_S

    def __init__(self, path: Path, answer: Answer, request_s: float) -> None:
        self.answer, self.request_s = answer, request_s
        self._path = path
        self._free = threading.BoundedSemaphore(_MAX_CLIENTS)
        try:
            super().__init__(str(path), _Handler)
        except OSError as error:
            raise RunError(f"{path}: cannot listen: {error.strerror or error}") from None

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


_MOST_WAITING = 16
_WAIT_S = 20.0  # longest wait for the previous change; a client waits longer for its answer
_POLL_S = 0.005
_LEAD_S = 0.05  # time from the answer to the first sample of a change
_ROUNDING = 1e-9  # relative; a run at its slew limit still accepts an offset
_TOGETHER = "coupling: the axes are decoupled for equal changes: change all of them, without a name"
_ONE_AXIS = "the run has one axis: change it without the name {!r}"
_CHUNK = 1_000_000
_CYCLE = 2000  # samples per cycle of the sine from which the command range is computed


@dataclass(frozen=True, slots=True)
class ReferenceState:
    """Gain, offset and inverse of an axis after its last change; None without an inverse."""

    gain: float
    offset: float
    inverse: InverseState | None

    @property
    def inverse_share(self) -> float:
        """Share of the inverse in the command; the line has the rest."""
        return 0.0 if self.inverse == "out" else 1.0


class Changes:
    """Changes of one run, requested from several threads.

    Args:
        run: The run.
        pages: The page of each axis; that of the first one is the page of the run.
    """

    def __init__(
        self,
        run: CheckedRun,
        pages: Sequence[SharedPage],
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._axes = dict(zip(run.names, zip(run.axes, pages, strict=True), strict=True))
        self._states = {
            name: ReferenceState(1.0, 0.0, "in" if each.loaded.model else None)
            for name, (each, _) in self._axes.items()
        }
        self._run, self._page = run, pages[0]
        self._clock, self._sleep = clock, sleep
        self._lock = threading.Lock()
        self._places = threading.BoundedSemaphore(_MOST_WAITING)

    def references(self, axes: Iterable[str] | None = None) -> dict[str, Any]:
        """Return the final values of the only axis, or those of axes under ``references``.

        ``axes`` None is all.
        """
        values = {name: asdict(self._states[name]) for name in axes or self._states}
        return values.get("", {"references": values})

    def make(self, wanted: "SetRequest") -> dict[str, Any]:
        """Make a change when the loop has taken the previous one."""
        changes = self._changes_of(wanted)
        if not self._places.acquire(blocking=False):
            raise InputError(f"set: {_MOST_WAITING} changes are waiting already: try again")
        try:
            until = self._clock() + _WAIT_S
            while True:
                with self._lock:
                    if why := self._too_late():
                        raise InputError(f"set: {why}")
                    # The loop must have taken the previous change, which is overwritten.
                    page = self._page
                    if page.get(PageField.TUNE_WANTED) == page.observe(PageField.TUNE_TAKEN):
                        return self._make(changes, wanted.over_s)
                if self._clock() >= until:
                    raise InputError("set: the loop has not taken the previous change: try again")
                self._sleep(_POLL_S)
        finally:
            self._places.release()

    def _too_late(self) -> str:
        """Return why no change is possible, or an empty text."""
        if self._page.get(PageField.STOP):
            return "the run is in its safe ramp"
        if self._page.get(PageField.NEXT_SAMPLE) >= self._run.first.forecast.samples:
            return "the waveform has ended; the run is in its safe ramp"
        return ""

    def _changes_of(self, wanted: "SetRequest") -> dict[str, dict[str, Any]]:
        """Return the new values of each axis that changes; raise InputError if it cannot."""
        names = [*self._axes]
        if unknown := [name for name in wanted.axes if name not in names]:
            known = f"no axis is named {unknown[0]!r} ({did_you_mean(unknown[0], names)})"
            raise InputError(f"set: {known if names[0] else _ONE_AXIS.format(unknown[0])}")
        if wanted.axes and self._run.coupled:
            raise InputError(f"set: {_TOGETHER}")
        common = wanted.model_dump(include={*ReferenceChange.model_fields}, exclude_none=True)
        own = {name: each.model_dump(exclude_none=True) for name, each in wanted.axes.items()}
        changes = {name: common | own.get(name, {}) for name in names}
        changes = {name: values for name, values in changes.items() if values}
        if not changes:
            raise InputError("set: gain, offset or inverse is required")
        _refuse(
            {
                name: fade_refusal(self._axes[name][0], values["inverse"])
                for name, values in changes.items()
                if "inverse" in values
            }
        )
        return changes

    def _make(self, changes: Mapping[str, Mapping[str, Any]], over_s: float) -> dict[str, Any]:
        """Write the changes of some axes to their pages; return the answer."""
        states = {name: replace(self._states[name], **each) for name, each in changes.items()}
        _refuse({name: self._bound_refusal(name, state) for name, state in states.items()})
        _refuse({"": self._apart_refusal(self._states | states)})
        page, config = self._page, self._run.config
        lead = max(1, round(_LEAD_S * config.sample_rate_hz))
        blocks = math.ceil((page.get(PageField.NEXT_SAMPLE) + lead) / config.block) + 1
        begins_at = blocks * config.block
        if begins_at >= self._run.first.forecast.samples:
            raise InputError("set: the waveform ends before the change could begin")
        number = page.get(PageField.TUNE_WANTED) + 1
        for name, state in states.items():
            checked, own = self._axes[name]
            own.put_float(PageField.TUNE_GAIN, state.gain)
            own.put_float(PageField.TUNE_OFFSET, state.offset)
            own.put_float(PageField.TUNE_INVERSE_SHARE, state.inverse_share)
            if line := checked.forecast.line:
                own.put_float(PageField.TUNE_LINE_SLOPE, line.slope)
                own.put_float(PageField.TUNE_LINE_AT_ZERO, line.at_zero)
            own.put(PageField.TUNE_SAMPLES, max(1, round(over_s * config.sample_rate_hz)))
            own.put(PageField.TUNE_NUMBER, number)
        page.put(PageField.TUNE_BEGINS_AT, begins_at)
        # Last, and once for all axes: the loop reads the numbers above when the count changes.
        page.publish(PageField.TUNE_WANTED, number)
        self._states |= states
        return {**self.references(states), "over_s": over_s, "begins_at_sample": begins_at}

    def _bound_refusal(self, name: str, state: ReferenceState) -> str:
        """Return why the reference of an axis cannot change to a state, or an empty text."""
        bypassed = min(state.inverse_share, self._states[name].inverse_share) < 1.0
        return bound_refusal(self._axes[name][0], state.gain, state.offset, bypassed=bypassed)

    def _apart_refusal(self, states: Mapping[str, ReferenceState]) -> str:
        """Return why references in these states would trip ``apart``, or an empty text."""
        run, apart = self._run, self._run.config.apart
        if apart is None:
            return ""
        pair = [(self._axes[name][0].reference, states[name]) for name in apart.axes]
        if any(reference.unit != "um" for reference, _ in pair):
            return ""
        samples = in_samples(apart.for_s, run.config.sample_rate_hz)
        counted = np.zeros(1)
        for start in range(0, pair[0][0].values.size, _CHUNK):
            part = slice(start, start + _CHUNK)
            one, other = (each.gain * of.values[part] + each.offset for of, each in pair)
            flags = np.zeros(one.size, np.uint32)
            if apart_block(apart.um, samples, counted, one, other, flags, flags) >= 0:
                names = " and ".join(apart.axes)
                return f"the references of {names} would be more than {apart.um:g} µm apart (apart)"
        return ""


def _refuse(reasons: Mapping[str, str]) -> None:
    """Raise InputError with the reasons of all axes by name, if there are some."""
    found = [f"{name}: {why}" if name else why for name, why in reasons.items() if why]
    if found:
        raise InputError(f"set: {'; '.join(found)}")


def fade_refusal(checked: CheckedExperiment, wanted: str) -> str:
    """Return why the inverse cannot be bypassed (``out``) or enabled (``in``), or an empty text."""
    if checked.loaded.model is None:
        return "inverse: the experiment has no compensator, so there is no inverse to bypass"
    if checked.forecast.line is None:
        return "inverse: the reference is constant: there is no line through its ends"
    if wanted == "out" and checked.loaded.config.limits.tracking_error_um is not None:
        return (
            "inverse: limits.tracking_error_um would end the run, because the displacement leaves "
            "its reference without the inverse: remove that limit from the experiment first"
        )
    return ""


def bound_refusal(checked: CheckedExperiment, gain: float, offset: float, *, bypassed: bool) -> str:
    """Return why a changed reference would exceed the limits, or an empty text."""
    # The whole waveform counts; the interlock enforces the heat.
    low, high = sorted(gain * end + offset for end in checked.reference.span)
    commands = [*command_range(checked, low, high, gain)]
    if bypassed and (line := checked.forecast.line):
        commands += [line.slope * end + line.at_zero for end in (low, high)]
    bound = replace(
        checked.forecast,
        command_min=float(np.min(commands)),  # keeps a NaN, where min() would not
        command_max=float(np.max(commands)),
        slew_per_s=_slew_per_s(checked, min(commands), max(commands)),
        voltage_v=_voltage_v(checked, min(commands), max(commands)),
        budget_used_s=None,
    )
    problems = checked.bound_problems(low, high, bound)
    return "; ".join(f"{problem.rule}, got {problem.value}" for problem in problems)


def command_range(
    checked: CheckedExperiment, low: float, high: float, gain: float
) -> tuple[float, float]:
    """Return the lowest and highest command for a reference from ``low`` to ``high``.

    They are those of a sine over this range, plus the difference between the checked run and a sine
    over the run's range, which is due to rate and history, times the gain.
    """
    found, known = _sine_commands(checked, low, high), _checked_range(checked)
    sine = _sine_commands(checked, *checked.reference.span)
    more = [gain * (known[end] - sine[end]) for end in (0, 1)]
    if gain < 0.0:
        more.reverse()
    return found[0] + more[0], found[1] + more[1]


def _checked_range(checked: CheckedExperiment) -> tuple[float, float]:
    """Return the lowest and highest command of the checked waveform."""
    line, span = checked.forecast.line, checked.reference.span
    if line is None:  # no model: the commands are the reference; or a constant reference
        return _sine_commands(checked, *span)
    ends = [line.slope * end + line.at_zero for end in span]
    return min(ends), max(ends)


def _slew_per_s(checked: CheckedExperiment, low: float, high: float) -> float:
    """Return the fastest change of commands from ``low`` to ``high``, which grows with the range.

    It is 0, for unknown, if the fastest one of the checked run is before the waveform or the step
    to its first command.
    """
    forecast, before = checked.forecast, _checked_range(checked)
    if forecast.fastest_at_s <= forecast.before_s:
        return 0.0
    grown = (high - low) / max(before[1] - before[0], 1e-300)
    return forecast.slew_per_s * (1.0 - _ROUNDING) * grown


def _voltage_v(checked: CheckedExperiment, low: float, high: float) -> float | None:
    """Return the amplifier's voltage for commands from ``low`` to ``high``; None if unknown.

    The part of the checked voltage that the resistance does not explain grows with the range.
    """
    amplifier, forecast = checked.loaded.config.amplifier, checked.forecast
    if amplifier is None or forecast.voltage_v is None or forecast.voltage_at_s < forecast.before_s:
        return None
    before = _checked_range(checked)
    held_v = amplifier.resistance_ohm * max(abs(low), abs(high))
    more_v = forecast.voltage_v - amplifier.resistance_ohm * max(map(abs, before))
    return held_v + more_v * (high - low) / max(before[1] - before[0], 1e-300)


def _sine_commands(checked: CheckedExperiment, low: float, high: float) -> tuple[float, float]:
    """Return the lowest and highest command in the second cycle of a sine from rest."""
    phase = np.arange(2 * _CYCLE) * (2.0 * np.pi / _CYCLE)
    values = 0.5 * (low + high) + 0.5 * (high - low) * np.sin(phase)
    values = np.clip(values, low, high)  # rounding must not leave a limit
    compensator = Compensator(checked.loaded.model, checked.loaded.config.sample_rate_hz)
    commands = np.empty_like(values)
    with np.errstate(over="ignore", invalid="ignore"):  # values that are not finite are refused
        compensator.process(values, commands)
    return float(commands[_CYCLE:].min()), float(commands[_CYCLE:].max())


class StatusRequest(StrictModel):
    """Return the status of the run."""

    command: Literal["status"]


class ReferenceChange(StrictModel):
    """Ramp gain or offset, or replace the inverse by a line (``out``); None: unchanged."""

    gain: Annotated[float, Field(ge=-1e6, le=1e6)] | None = None
    offset: Annotated[float, Field(ge=-1e6, le=1e6)] | None = None
    inverse: InverseState | None = None


class SetRequest(ReferenceChange):
    """A change of all axes, and of some by name, whose own values come first."""

    command: Literal["set"]
    axes: dict[str, ReferenceChange] = Field(default_factory=dict)
    over_s: Annotated[float, Field(gt=0.0, le=3600.0)] = 1.0


def _one_line(text: str) -> str:
    if not text.strip() or not text.isprintable():
        raise ValueError("must be one line of printable text")
    return text


class MarkRequest(StrictModel):
    """Set a mark at the present sample."""

    command: Literal["mark"]
    text: Annotated[str, Field(max_length=MAX_MARK), AfterValidator(_one_line)]


REQUESTS: TypeAdapter[StatusRequest | SetRequest | MarkRequest] = TypeAdapter(
    Annotated[StatusRequest | SetRequest | MarkRequest, Field(discriminator="command")]
)
"""Validator of requests, selected by ``command``."""


class Requests:
    """Answer the requests to a run."""

    def __init__(
        self,
        run: CheckedRun,
        folder: RunFolder,
        pages: Sequence[SharedPage],
        recording: RingRecorder,
    ) -> None:
        self._run = run
        self._folder = folder
        self._page = pages[0]
        self._recording = recording
        self._changes = Changes(run, pages)

    def answer(self, line: bytes) -> Mapping[str, Any]:
        """Answer one line of JSON, from any thread; a change waits for the previous one."""
        text = line.decode("latin-1")  # an escape is ASCII
        if without_halves(text) != text:
            raise InputError(f"message: {HALF_CHARACTER}")
        try:
            request = REQUESTS.validate_json(line)
        except ValidationError as error:
            raise InputError(first_problem(error)) from None
        if isinstance(request, StatusRequest):
            return self._status()
        if isinstance(request, MarkRequest):
            return self._mark(request.text)
        return self._changes.make(request)

    def _mark(self, text: str) -> dict[str, Any]:
        if not self._recording.takes_marks:
            raise InputError("mark: the recording accepts none now, or has ended")
        page = self._page
        sample = page.get(PageField.WAVEFORM_AT) + page.get(PageField.NEXT_SAMPLE)
        self._recording.record_event(Event(sample, "info", MARK, text))
        return {"sample": sample, "text": text}

    def _status(self) -> dict[str, Any]:
        page, config = self._page, self._run.config
        return {
            **facts_of(self._folder),
            "state": page.state(),
            "sample": page.get(PageField.NEXT_SAMPLE),
            "total_samples": self._run.first.forecast.samples,
            "sample_rate_hz": config.sample_rate_hz,
            "recorded_samples": self._recording.recorders[0].samples,
            "missing_samples": sum(each.missing for each in self._recording.recorders),
            "late_ticks": page.get(PageField.LATE_TICKS),
            **self._changes.references(),
            "recording_error": self._recording.error,
            "heartbeat_age_s": (time.monotonic_ns() - page.get(PageField.LOOP_HEARTBEAT_NS)) * 1e-9,
        }
