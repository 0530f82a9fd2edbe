"""Requests to a running supervisor: status, changes of the reference, marks."""

import time
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, TypeAdapter, ValidationError

from hilctl.base.errors import InputError
from hilctl.base.events import MARK, Event
from hilctl.base.strict import StrictModel
from hilctl.experiment.preflight import CheckedExperiment
from hilctl.run.control.changes import Changes
from hilctl.run.control.client import MAX_MARK
from hilctl.run.recorder import RingRecorder
from hilctl.run.run_folder import RunFolder, facts_of
from hilctl.run.shared.shared_page import PageField as Number
from hilctl.run.shared.shared_page import Phase, SharedPage


class StatusRequest(StrictModel):
    """Return the status of the run."""

    command: Literal["status"]


class SetRequest(StrictModel):
    """Ramp gain or offset, or replace the inverse by a line (``out``); None: unchanged."""

    command: Literal["set"]
    gain: Annotated[float, Field(ge=-1e6, le=1e6)] | None = None
    offset: Annotated[float, Field(ge=-1e6, le=1e6)] | None = None
    inverse: Literal["in", "out"] | None = None
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
        checked: CheckedExperiment,
        folder: RunFolder,
        page: SharedPage,
        recording: RingRecorder,
    ) -> None:
        self._checked = checked
        self._folder = folder
        self._page = page
        self._recording, self._recorder = recording, recording.recorder
        self._changes = Changes(checked, page)

    def answer(self, line: bytes) -> Mapping[str, Any]:
        """Answer one line of JSON, from any thread; a change waits for the previous one."""
        try:
            request = REQUESTS.validate_json(line)
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False)[0]
            where = ".".join(str(part) for part in first["loc"]) or "message"
            raise InputError(f"{where}: {first['msg']}") from None
        if isinstance(request, StatusRequest):
            return self._status()
        if isinstance(request, MarkRequest):
            return self._mark(request.text)
        return self._changes.make(request.gain, request.offset, request.over_s, request.inverse)

    def _mark(self, text: str) -> dict[str, Any]:
        if not self._recording.takes_marks:
            raise InputError("mark: the recording accepts none now, or has ended")
        page = self._page
        sample = page.get(Number.WAVEFORM_AT) + page.get(Number.NEXT_SAMPLE)
        self._recording.record_event(Event(sample, "info", MARK, text))
        return {"sample": sample, "text": text}

    def _status(self) -> dict[str, Any]:
        page, config = self._page, self._checked.loaded.config
        phase = Phase(page.get(Number.PHASE)).name.lower()
        return {
            **facts_of(self._folder),
            "state": "stopping" if page.get(Number.STOP) else phase,
            "sample": page.get(Number.NEXT_SAMPLE),
            "total_samples": self._checked.forecast.samples,
            "sample_rate_hz": config.sample_rate_hz,
            "recorded_samples": self._recorder.samples,
            "missing_samples": self._recorder.missing,
            "late_ticks": page.get(Number.LATE_TICKS),
            "gain": self._changes.gain,
            "offset": self._changes.offset,
            "inverse": self._changes.inverse,
            "recording_error": self._recorder.error,
            "heartbeat_age_s": (time.monotonic_ns() - page.get(Number.LOOP_HEARTBEAT_NS)) * 1e-9,
        }
