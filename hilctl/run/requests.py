"""What a running supervisor may be asked: where it stands, to stop, to move the reference."""

import time
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError

from hilctl.base.errors import ConfigError, InputError
from hilctl.base.strict import Strict
from hilctl.experiment.check import Checked, check_tuned
from hilctl.run import shared_page as page
from hilctl.run.recorder import Recorder
from hilctl.run.ring import SampleRing
from hilctl.run.run_folder import RunFolder, facts_of


class StatusOrder(Strict):
    """Where does the run stand?"""

    command: Literal["status"]


class StopOrder(Strict):
    """End the run by its way out."""

    command: Literal["stop"]


class SetOrder(Strict):
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


_ORDERS: TypeAdapter[StatusOrder | StopOrder | SetOrder] = TypeAdapter(
    Annotated[StatusOrder | StopOrder | SetOrder, Field(discriminator="command")]
)


class Orders:
    """Answers what a run is asked.

    Args:
        checked: The experiment.
        folder: The run's folder.
        ring: Shared with the loop.
        recorder: What is being recorded.
    """

    def __init__(
        self, checked: Checked, folder: RunFolder, ring: SampleRing, recorder: Recorder
    ) -> None:
        self._checked = checked
        self._folder = folder
        self._ring = ring
        self._recorder = recorder
        self._tuning = (1.0, 0.0)
        self.stop = False
        """Whether the run was told to stop."""

    def answer(self, line: bytes) -> dict[str, Any]:
        """Return the answer to one line of JSON.

        Raises:
            InputError: It is no order, or can't be followed; nothing has changed.
        """
        try:
            order = _ORDERS.validate_json(line)
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False)[0]
            where = ".".join(str(part) for part in first["loc"]) or "message"
            raise InputError(f"{where}: {first['msg']}") from None
        if isinstance(order, SetOrder):
            return self._set(order)
        if isinstance(order, StopOrder):
            self.stop = True
        return self._status()

    def _status(self) -> dict[str, Any]:
        ring, config = self._ring, self._checked.loaded.config
        phase = page.Phase(ring.get(page.Field.PHASE)).name.lower()
        return {
            **facts_of(self._folder),
            "state": "stopping" if ring.get(page.Field.STOP) or self.stop else phase,
            "sample": ring.get(page.Field.NEXT_SAMPLE),
            "total_samples": self._checked.forecast.samples,
            "sample_rate_hz": config.sample_rate_hz,
            "recorded_samples": self._recorder.samples,
            "missing_samples": self._recorder.missing,
            "late_ticks": ring.get(page.Field.LATE_TICKS),
            "gain": self._tuning[0],
            "offset": self._tuning[1],
            "recording_error": self._recorder.error,
            "heartbeat_age_s": (time.monotonic_ns() - ring.get(page.Field.LOOP_BEAT_NS)) * 1e-9,
        }

    def _set(self, order: SetOrder) -> dict[str, Any]:
        ring = self._ring
        if order.gain is None and order.offset is None:
            raise InputError("set: gain or offset is required")
        if self.stop or ring.get(page.Field.STOP):
            raise InputError("set: the run is on its way to the safe value")
        if ring.get(page.Field.NEXT_SAMPLE) >= self._checked.forecast.samples:
            raise InputError("set: the waveform is over; the run is on its way to the safe value")
        if ring.get(page.Field.TUNE_WANTED) != ring.get(page.Field.TUNE_TAKEN):
            raise InputError("set: the change before has not been taken yet: try again")
        gain = self._tuning[0] if order.gain is None else order.gain
        offset = self._tuning[1] if order.offset is None else order.offset
        samples = max(1, round(order.over_s * self._checked.loaded.config.sample_rate_hz))
        try:
            check_tuned(self._checked, self._tuning, (gain, offset), samples)
        except ConfigError as error:
            lines = "; ".join(f"{each.rule}, got {each.value}" for each in error.problems)
            raise InputError(f"set: {lines}") from None
        ring.put_float(page.Field.TUNE_GAIN, gain)
        ring.put_float(page.Field.TUNE_OFFSET, offset)
        ring.put(page.Field.TUNE_SAMPLES, samples)
        ring.put(page.Field.TUNE_WANTED, ring.get(page.Field.TUNE_WANTED) + 1)
        self._tuning = (gain, offset)
        return {"gain": gain, "offset": offset, "over_s": order.over_s}
