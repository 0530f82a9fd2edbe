"""Requests to a running supervisor: its status, to stop, to move the reference."""

import time
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError

from hilctl.base.errors import ConfigError, InputError
from hilctl.base.strict import Strict
from hilctl.experiment.check import Checked, check_tuned
from hilctl.run.recorder import Recorder
from hilctl.run.run_folder import RunFolder, facts_of
from hilctl.run.shared_page import Field as Number
from hilctl.run.shared_page import Phase, SharedPage


class StatusRequest(Strict):
    """Where does the run stand?"""

    command: Literal["status"]


class StopRequest(Strict):
    """End the run by its safe ramp."""

    command: Literal["stop"]


class SetRequest(Strict):
    """Move the reference's gain or offset over a ramp.

    Attributes:
        gain: Factor of the reference; left as it is where None.
        offset: Added to the reference, in the waveform's unit; left as it is where None.
        over_s: Time that the change takes.
    """

    command: Literal["set"]
    gain: float | None = None
    offset: float | None = None
    over_s: Annotated[float, Field(gt=0.0, le=3600.0)] = 1.0


_REQUESTS: TypeAdapter[StatusRequest | StopRequest | SetRequest] = TypeAdapter(
    Annotated[StatusRequest | StopRequest | SetRequest, Field(discriminator="command")]
)


class Requests:
    """Answers the requests to a run.

    Args:
        checked: The experiment.
        folder: The run's folder.
        page: Shared with the loop.
        recorder: What is being recorded.
    """

    def __init__(
        self, checked: Checked, folder: RunFolder, page: SharedPage, recorder: Recorder
    ) -> None:
        self._checked = checked
        self._folder = folder
        self._page = page
        self._recorder = recorder
        self._tuning = (1.0, 0.0)
        self.stop = False
        """Whether a stop was requested."""

    def answer(self, line: bytes) -> dict[str, Any]:
        """Return the answer to one line of JSON.

        Raises:
            InputError: It is no request, or can't be followed; nothing has changed.
        """
        try:
            request = _REQUESTS.validate_json(line)
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False)[0]
            where = ".".join(str(part) for part in first["loc"]) or "message"
            raise InputError(f"{where}: {first['msg']}") from None
        if isinstance(request, SetRequest):
            return self._set(request)
        if isinstance(request, StopRequest):
            self.stop = True
        return self._status()

    def _status(self) -> dict[str, Any]:
        page, config = self._page, self._checked.loaded.config
        phase = Phase(page.get(Number.PHASE)).name.lower()
        return {
            **facts_of(self._folder),
            "state": "stopping" if page.get(Number.STOP) or self.stop else phase,
            "sample": page.get(Number.NEXT_SAMPLE),
            "total_samples": self._checked.forecast.samples,
            "sample_rate_hz": config.sample_rate_hz,
            "recorded_samples": self._recorder.samples,
            "missing_samples": self._recorder.missing,
            "late_ticks": page.get(Number.LATE_TICKS),
            "gain": self._tuning[0],
            "offset": self._tuning[1],
            "recording_error": self._recorder.error,
            "heartbeat_age_s": (time.monotonic_ns() - page.get(Number.LOOP_HEARTBEAT_NS)) * 1e-9,
        }

    def _set(self, request: SetRequest) -> dict[str, Any]:
        page = self._page
        if request.gain is None and request.offset is None:
            raise InputError("set: gain or offset is required")
        if self.stop or page.get(Number.STOP):
            raise InputError("set: the run is on its way to the safe value")
        if page.get(Number.NEXT_SAMPLE) >= self._checked.forecast.samples:
            raise InputError("set: the waveform is over; the run is on its way to the safe value")
        # Only after the loop has taken it may the change before be written over.
        if page.get(Number.TUNE_WANTED) != page.get(Number.TUNE_TAKEN):
            raise InputError("set: the change before has not been taken yet: try again")
        gain = self._tuning[0] if request.gain is None else request.gain
        offset = self._tuning[1] if request.offset is None else request.offset
        samples = max(1, round(request.over_s * self._checked.loaded.config.sample_rate_hz))
        try:
            check_tuned(self._checked, self._tuning, (gain, offset), samples)
        except ConfigError as error:
            lines = "; ".join(f"{each.rule}, got {each.value}" for each in error.problems)
            raise InputError(f"set: {lines}") from None
        page.put_float(Number.TUNE_GAIN, gain)
        page.put_float(Number.TUNE_OFFSET, offset)
        page.put(Number.TUNE_SAMPLES, samples)
        # Last: the loop reads the three numbers above as soon as it sees a new count.
        page.put(Number.TUNE_WANTED, page.get(Number.TUNE_WANTED) + 1)
        self._tuning = (gain, offset)
        return {"gain": gain, "offset": offset, "over_s": request.over_s}
