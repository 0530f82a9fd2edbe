"""Changes of gain, offset and inverse on their way to the loop, one after another.

Each is worked out from where the loop stands, and only once the loop has taken the one before: so
the second follows the first, and none is written over. Nothing here waits.
"""

from collections import deque
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from hilctl.base.errors import InputError
from hilctl.experiment.check import Checked
from hilctl.experiment.straight import fade_refusal
from hilctl.experiment.tuned import TunedForecast
from hilctl.loop.host import Tuning
from hilctl.loop.tuning import Tuner
from hilctl.run.change_worker import WantedChange
from hilctl.run.run_folder import RunFolder
from hilctl.run.shared_page import Field, SharedPage

_SHARES: dict[str | None, float] = {"in": 1.0, "out": 0.0}
_MOST_WAITING = 16
_LEAD_S = 0.5
_TRIES = 3


class WorksOut(Protocol):
    """What works changes out; see :class:`hilctl.run.change_worker.ChangeWorker`."""

    def begin(self, wanted: WantedChange) -> None:
        """Have a change worked out."""
        ...

    def result(self) -> TunedForecast | None:
        """Return what came of it; None while it is being worked out."""
        ...


@dataclass(slots=True)
class RequestedChange:
    """A change that somebody waits for.

    Attributes:
        gain: Factor of the reference; left as it is where None.
        offset: Added to the reference; left as it is where None.
        over_s: Time that the change takes.
        inverse: Whether the inverse is to be ``in`` or ``out``; left as it is where None.
    """

    gain: float | None
    offset: float | None
    over_s: float
    inverse: Literal["in", "out"] | None = None
    tries: int = 0
    _answer: Mapping[str, Any] | None = None
    _refusal: str = ""

    def answer(self) -> Mapping[str, Any] | None:
        """Return the answer; None while there is none.

        Raises:
            InputError: It is refused; nothing has changed.
        """
        if self._refusal:
            raise InputError(f"set: {self._refusal}")
        return self._answer

    def accept(self, answer: Mapping[str, Any]) -> None:
        """Let it have been done."""
        self._answer = answer

    def refuse(self, why: str) -> None:
        """Let it have been refused."""
        self._refusal = why


class Changes:
    """The changes of one run.

    Args:
        checked: The experiment.
        folder: The run's folder, with its ring.
        page: Shared with the loop.
        worker: Works them out.

    Attributes:
        gain: Factor of the reference that the last change has led to, or leads to.
        offset: What is added to it, likewise.
    """

    def __init__(
        self, checked: Checked, folder: RunFolder, page: SharedPage, worker: WorksOut
    ) -> None:
        self.gain, self.offset, self._inverse_share = 1.0, 0.0, 1.0
        self._checked, self._folder, self._page = checked, folder, page
        self._worker = worker
        self._waiting: deque[RequestedChange] = deque()
        self._current: RequestedChange | None = None
        # What the loop's own tuner does, by the samples at which it took the changes.
        self._tuner, self._tuner_at = Tuner(), 0
        self._placed: Tuning | None = None
        self._heat_a2 = (checked.forecast.heating_rms_a or 0.0) ** 2

    @property
    def inverse(self) -> str | None:
        """Where the last change leads the inverse, ``in`` or ``out``; None where there is none."""
        if self._checked.loaded.model is None:
            return None
        return "in" if self._inverse_share else "out"

    def add(self, change: RequestedChange) -> None:
        """Let a change wait for its turn.

        Raises:
            InputError: It can't have one.
        """
        if change.gain is None and change.offset is None and change.inverse is None:
            raise InputError("set: gain, offset or inverse is required")
        if change.inverse is not None:
            checked = self._checked
            if why := fade_refusal(checked.loaded, checked.forecast.line, change.inverse):
                raise InputError(f"set: inverse: {why}")
        if why := self._too_late():
            raise InputError(f"set: {why}")
        if len(self._waiting) >= _MOST_WAITING:
            raise InputError(f"set: {_MOST_WAITING} changes are waiting already: try again")
        self._waiting.append(change)

    def attend(self) -> None:
        """Go on with what can go on; to be called often."""
        if why := self._too_late():
            self._refuse_all(why)
            return
        page = self._page
        # Only after the loop has taken it may the change before be written over.
        if page.get(Field.TUNE_WANTED) != page.observe(Field.TUNE_TAKEN):
            return
        self._note_taken()
        if self._current is None and self._waiting:
            self._current = self._waiting.popleft()
            self._work_out(self._current)
        elif self._current is not None:
            self._conclude(self._current)

    def _too_late(self) -> str:
        """Return why no change can be made any more, or an empty text."""
        if self._page.get(Field.STOP):
            return "the run is on its way to the safe value"
        if self._page.get(Field.NEXT_SAMPLE) >= self._checked.forecast.samples:
            return "the waveform is over; the run is on its way to the safe value"
        return ""

    def _refuse_all(self, why: str) -> None:
        for change in (*self._waiting, *filter(None, [self._current])):
            change.refuse(why)
        self._waiting.clear()
        self._current = None

    def _note_taken(self) -> None:
        if self._placed is not None:
            taken_at = self._page.get(Field.TUNE_TAKEN_AT)
            self._tuner.pass_over(taken_at - self._tuner_at)
            self._tuner.move(self._placed)
            self._tuner_at, self._placed = taken_at, None

    def _work_out(self, change: RequestedChange) -> None:
        rate_hz = self._checked.loaded.config.sample_rate_hz
        wanted = WantedChange(
            ring=str(self._folder.ring),
            gain=self.gain if change.gain is None else change.gain,
            offset=self.offset if change.offset is None else change.offset,
            inverse_share=_SHARES.get(change.inverse, self._inverse_share),
            samples=max(1, round(change.over_s * rate_hz)),
            lead_s=_LEAD_S * 2**change.tries,
            tuner=copy(self._tuner),
            tuner_at=self._tuner_at,
            heat_a2=self._heat_a2,
        )
        change.tries += 1
        try:
            self._worker.begin(wanted)
        except InputError as error:
            self._give_up(change, str(error))

    def _conclude(self, change: RequestedChange) -> None:
        try:
            found = self._worker.result()
        except InputError as error:
            self._give_up(change, str(error))
            return
        if found is None:
            return
        next_sample = self._page.get(Field.NEXT_SAMPLE) + self._checked.loaded.config.block
        if next_sample <= found.tuning.begins_at:
            self._place(found)
            change.accept(_answer(change, found, self.inverse))
            self._current = None
        elif change.tries < _TRIES:  # the loop has gone by: what was worked out no longer holds
            self._work_out(change)
        else:
            self._give_up(change, "this machine is too busy to work it out in time: try again")

    def _give_up(self, change: RequestedChange, why: str) -> None:
        change.refuse(why)
        self._current = None

    def _place(self, found: TunedForecast) -> None:
        page, tuning = self._page, found.tuning
        page.put_float(Field.TUNE_GAIN, tuning.gain)
        page.put_float(Field.TUNE_OFFSET, tuning.offset)
        page.put_float(Field.TUNE_INVERSE_SHARE, tuning.inverse_share)
        page.put_float(Field.TUNE_LINE_SLOPE, tuning.line.slope)
        page.put_float(Field.TUNE_LINE_AT_ZERO, tuning.line.at_zero)
        page.put(Field.TUNE_SAMPLES, tuning.samples)
        page.put(Field.TUNE_BEGINS_AT, tuning.begins_at)
        # Last: the loop reads the numbers above as soon as it sees a new count.
        page.publish(Field.TUNE_WANTED, page.get(Field.TUNE_WANTED) + 1)
        self.gain, self.offset, self._placed = tuning.gain, tuning.offset, tuning
        self._inverse_share = tuning.inverse_share
        self._heat_a2 = max(self._heat_a2, found.heat_a2)


def _answer(change: RequestedChange, found: TunedForecast, inverse: str | None) -> dict[str, Any]:
    return {
        "gain": found.tuning.gain,
        "offset": found.tuning.offset,
        "inverse": inverse,
        "over_s": change.over_s,
        "begins_at_sample": found.tuning.begins_at,
        "checked_s": found.checked_s,
        "checked_to_the_end": found.to_the_end,
    }
