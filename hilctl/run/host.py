"""The loop's host: the ring for its blocks, and the supervisor behind the ring's page."""

import os

from hilctl.base.device import Clock
from hilctl.loop.host import StraightLine, Tuning
from hilctl.run.ring import SampleRing
from hilctl.run.shared_page import Field, Phase, Stop

# Plain numbers: looking up an enumeration's member takes longer than writing it.
_HEARTBEAT_NS, _NEXT_SAMPLE = int(Field.LOOP_HEARTBEAT_NS), int(Field.NEXT_SAMPLE)
_LATE_TICKS, _STOP = int(Field.LATE_TICKS), int(Field.STOP)
_SUPERVISOR_HEARTBEAT_NS = int(Field.SUPERVISOR_HEARTBEAT_NS)
_TUNE_WANTED, _TUNE_TAKEN = int(Field.TUNE_WANTED), int(Field.TUNE_TAKEN)
_TUNE_BEGINS_AT = int(Field.TUNE_BEGINS_AT)


class RingHost:
    """See :class:`hilctl.loop.host.Host`.

    Args:
        ring: Shared with the supervisor.
        clock: Time.
        supervisor: The supervisor's process number.
        silence_s: Longest that it may be silent.
    """

    def __init__(self, ring: SampleRing, clock: Clock, supervisor: int, silence_s: float) -> None:
        ring.prepare_blocks()
        self.clock = clock
        self.claim, self.sending, self.answered = ring.claim, ring.sending, ring.answered
        self.record_event = ring.page.push_event
        self.writing_safe = ring.page.note_safe_write
        self._page = ring.page
        self._numbers = ring.page.numbers
        self._supervisor = supervisor
        self._silence_ns = silence_s * 1e9

    def heartbeat(self, next_sample: int, late_ticks: int) -> str:
        """Write the loop's heartbeat; return why the run should end, or an empty text."""
        numbers = self._numbers
        now_ns = self.clock.now_ns()
        numbers[_HEARTBEAT_NS] = now_ns
        numbers[_NEXT_SAMPLE] = next_sample
        numbers[_LATE_TICKS] = late_ticks
        if numbers[_STOP]:
            return Stop(numbers[_STOP]).reason
        if not self.supervised():
            return "stopped because the supervisor died"
        if now_ns - numbers[_SUPERVISOR_HEARTBEAT_NS] > self._silence_ns:
            return f"stopped because the supervisor was silent for {self._silence_ns * 1e-9:g} s"
        return ""

    def closing(self) -> None:
        """Say that the loop is over, and that the device may take its time."""
        self._numbers[_HEARTBEAT_NS] = self.clock.now_ns()
        self._page.publish(Field.PHASE, Phase.CLOSING)

    def tuning(self) -> Tuning | None:
        """Return a change of the reference that is wanted, new, and due to begin."""
        numbers, page = self._numbers, self._page
        if numbers[_TUNE_WANTED] == numbers[_TUNE_TAKEN]:
            return None
        wanted = page.observe(Field.TUNE_WANTED)
        if numbers[_NEXT_SAMPLE] < numbers[_TUNE_BEGINS_AT]:
            return None
        tuning = Tuning(
            page.get_float(Field.TUNE_GAIN),
            page.get_float(Field.TUNE_OFFSET),
            page.get(Field.TUNE_SAMPLES),
            page.get(Field.TUNE_BEGINS_AT),
            page.get_float(Field.TUNE_INVERSE_SHARE),
            StraightLine(*map(page.get_float, (Field.TUNE_LINE_SLOPE, Field.TUNE_LINE_AT_ZERO))),
        )
        # Taken only once it has been read: the supervisor may write the next one from here on.
        page.publish(Field.TUNE_TAKEN, wanted)
        return tuning

    def supervised(self) -> bool:
        """Return whether the supervisor is still there."""
        return os.getppid() == self._supervisor
