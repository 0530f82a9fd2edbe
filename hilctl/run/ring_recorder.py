"""From the ring into the recording, in a thread of its own: only it waits for the disk.

Samples stay in the ring until the file has them. So a disk that stands still or refuses a write
costs nothing as long as the ring has room, and nobody who watches over the coil waits for it.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace

from hilctl.base.events import Event
from hilctl.base.samples import Batch
from hilctl.loop.plan import Outcome
from hilctl.machine.usage import ProcessUsage
from hilctl.run.metadata import end_facts, usage_facts
from hilctl.run.recorder import Recorder
from hilctl.run.ring import SampleRing
from hilctl.run.shared_page import Field

_POLL_S = 0.05
_MOST_WAITING = 64
_KEPT = 8
"""One part in so many of the ring stays for those who look on."""


class RingRecorder:
    """Takes samples and events out of the ring, from the start signal to the end of the recording.

    Args:
        ring: Shared with the loop; nobody else takes anything out of it.
        recorder: Begun; nobody else writes to it.
        flush_s: Longest time that a sample stays out of the file.
    """

    def __init__(self, ring: SampleRing, recorder: Recorder, flush_s: float) -> None:
        self.recorder = recorder
        self.newest: Batch | None = None
        """A copy of the newest block."""
        self._ring, self._flush_s = ring, flush_s
        self._events: deque[Event] = deque()
        self._of_loop: deque[Event] = deque()
        self._outcome: Outcome | None = None
        self._lost_loop = False
        self._ending = threading.Event()
        self._released_s = time.monotonic()
        self._before = ProcessUsage.now()
        self._thread = threading.Thread(target=self._run, name="recorder")

    def start(self) -> None:
        """Begin to record."""
        self._before = ProcessUsage.now()
        self._released_s = time.monotonic()
        self._thread.start()

    def record_event(self, event: Event) -> None:
        """Record an event of the supervisor; returns at once."""
        self._events.append(event)

    def end(self, outcome: Outcome, *, lost_loop: bool) -> None:
        """Let it take what is left, and close the recording; returns at once.

        Args:
            outcome: How the run ended; the output is safe as far as that can be had.
            lost_loop: Whether the loop could not say so itself: then nobody knows what became of
                the blocks that it had sent.
        """
        self._outcome, self._lost_loop = outcome, lost_loop
        self._ending.set()

    @property
    def takes_marks(self) -> bool:
        """Whether a mark will be in the file; no crowd of them waits for a disk that stands."""
        waiting = len(self._events) >= _MOST_WAITING
        return not (waiting or self._ending.is_set() or self.recorder.error)

    @property
    def finished(self) -> bool:
        """Whether the recording is closed."""
        return not self._thread.is_alive()

    def stalled_s(self) -> float:
        """Return for how long nothing in the ring has come to be safe in the file."""
        return time.monotonic() - self._released_s

    def _run(self) -> None:
        self._guarded(self.recorder.note_device)
        while not self._ending.wait(_POLL_S):
            self._guarded(self._work)
        self._guarded(self._finish)

    def _guarded(self, work: Callable[[], None]) -> None:
        """Do something; whatever goes wrong is an error of the recording, and not its silence."""
        try:
            work()
        except Exception as error:  # noqa: BLE001  what comes after is counted as lost
            self.recorder.fail(f"{type(error).__name__}: {error}")

    def _work(self) -> None:
        self._drain()
        if self.stalled_s() < self._flush_s:
            return
        # Room is given back only once the file has what stood there.
        if self.recorder.flush():
            self._ring.release(keep=self._ring.slots // _KEPT)
            self._released_s = time.monotonic()

    def _drain(self) -> bool:
        """Record what is there now; return whether there were samples."""
        page, recorder = self._ring.page, self.recorder
        took = False
        # Before the samples: whatever an event refers to stands in the ring by the time it is seen.
        self._of_loop.extend(page.pop_events())
        for batch in self._ring.batches():
            self.newest = batch.rows(slice(-1, None))
            recorder.batch(batch)
            took = True
        # After the samples: an event is recorded with those that led to it.
        while self._of_loop:
            recorder.event(self._of_loop.popleft())
        while self._events:
            event = self._events.popleft()
            recorder.event(event)
            page.leave_note(event)
        return took

    def _drain_all(self) -> None:
        while self._drain():
            pass

    def _finish(self) -> None:
        outcome, page, recorder = self._outcome, self._ring.page, self.recorder
        assert outcome is not None
        self._drain_all()
        while self._ring.skip_damaged():  # no more will come: take what stands behind them
            self._drain_all()
        if self._lost_loop:
            if (batch := self._ring.unanswered(recorder.next_sample)) is not None:
                recorder.batch(batch)
            ended_at = max(recorder.next_sample, page.get(Field.ENDED_AT))
            outcome = replace(outcome, ended_at=ended_at)
        facts = end_facts(outcome, page.lateness(), page.get(Field.EVENTS_LOST))
        facts |= usage_facts(page.usage(), ProcessUsage.now().since(self._before))
        recorder.finish(facts, outcome.ended_at)
