"""A live run, seen from outside: its newest signals, figures, limits and events.

The ring is mapped so that nothing can be written to it, and what is copied is looked at again: the
loop and the recorder go on as if nobody were there. Time is an argument.
"""

import math
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hilctl.base.errors import RunError
from hilctl.base.events import Event
from hilctl.desk.figures import FigureValues, RunningFigures
from hilctl.desk.headroom import Gauge, Headroom
from hilctl.desk.lateness import EDGES_US, LatenessCounts
from hilctl.desk.scope import Scope
from hilctl.desk.signals import Traces, traces_of
from hilctl.desk.spectrum import ErrorSpectrum
from hilctl.run.metadata import RunDescription
from hilctl.run.ring import SampleRing
from hilctl.run.run_folder import RunFolder
from hilctl.run.shared_page import Field, Phase

_EVENTS = 60
_LOOK_S = 0.5  # so often the run's locks and the disk are looked at


@dataclass(frozen=True, slots=True)
class DiskRoom:
    """The disk that the recording goes to.

    Attributes:
        free_bytes: Left on it.
        recorded_bytes: Size of the recording.
    """

    free_bytes: int
    recorded_bytes: int


class RunFeed:
    """One run as it goes on.

    Args:
        folder: Its folder.

    Attributes:
        description: What it says of itself.
        scope: Its windows and loops.
        spectrum: Of its error.
        events: Its newest events, the oldest first.
        missed: Samples that were not seen: dropped by the run, or gone before they were looked at.
        ended: Whether the run is over, so that nothing more will come.

    Raises:
        RunError: It has ended, or is not one that can be looked at.
    """

    def __init__(self, folder: RunFolder) -> None:
        self.folder = folder
        try:
            self.description = RunDescription.read(folder.description)
            self._ring = SampleRing(folder.ring, look_only=True)
        except (OSError, ValueError) as error:
            raise RunError(f"{folder.card.name}: can't be looked at: {error}") from None
        self._page = self._ring.page
        self.scope = Scope(self.description.sample_rate_hz, [], self.loop_input)
        self._waveform_at = -1
        self._figures = RunningFigures(self.description.sample_rate_hz, self.loop_input)
        self.spectrum = ErrorSpectrum(self.description.sample_rate_hz)
        self._lateness, self._headroom = LatenessCounts(), Headroom(self.description)
        self.events: list[Event] = []
        self._events_seen = 0
        self.missed = 0
        self.ended = False
        self._disk: DiskRoom | None = None
        self._next_block, self._next_event = max(0, self._page.observe(Field.HEAD) - 1), 0
        self._next_sample, self._next_note = -1, 0
        self._looked_s = -math.inf

    @property
    def loop_input(self) -> str:
        """Signal on the loop's abscissa: the reference where there is one in um."""
        return "reference" if self.description.waveform_unit == "um" else "command"

    def poll(self, now_s: float) -> bool:
        """Take what is new.

        Args:
            now_s: Monotonic time.

        Returns:
            Whether there were samples.
        """
        if now_s - self._looked_s >= _LOOK_S:
            self._looked_s = now_s
            # Asked first: of a run that is over, nothing can come after that.
            self.ended = not self.folder.alive
            self._disk = _disk_room(Path(self.folder.card.recording))
        if self._page.observe(Field.PHASE) < Phase.RUNNING:
            return False
        self._begin()
        batch, self._next_block = self._ring.look(self._next_block)
        events, self._next_event = self._page.look_at_events(self._next_event)
        notes, self._next_note = self._page.look_at_notes(self._next_note)
        self.events = (self.events + events + notes)[-_EVENTS:]
        self._events_seen += len(events) + len(notes)
        if not batch.heads.shape[0]:
            return False
        self._lateness.add(batch)
        self._take(traces_of(batch, self.description.waveform_unit))
        return True

    def _begin(self) -> None:
        """Learn where the waveform begins, which the loop knows once it runs."""
        if self._waveform_at < 0:
            self._waveform_at = self._page.get(Field.WAVEFORM_AT)
            segments = self.description.segments_at(self._waveform_at)
            self.scope = Scope(self.description.sample_rate_hz, segments, self.loop_input)

    def _take(self, traces: Traces) -> None:
        if self._next_sample >= 0:
            self.missed += int(traces.index[-1]) + 1 - self._next_sample - traces.index.size
        self._next_sample = int(traces.index[-1]) + 1
        self.scope.add(traces)
        self._figures.add(traces, self.scope.segment)
        self.spectrum.add(traces)
        self._headroom.add(traces)

    def events_since(self, seen: int) -> tuple[list[Event], int]:
        """Return the events after the first ``seen`` of all, and how many there have been."""
        new = min(self._events_seen - seen, len(self.events))
        return self.events[len(self.events) - new :], self._events_seen

    @property
    def start_ns(self) -> int:
        """When sample 0 was due, monotonic time in ns; 0 before that is known."""
        return self._page.get(Field.START_NS)

    @property
    def state(self) -> str:
        """Where the run stands, in a word."""
        outcome = self._page.outcome()
        if outcome is not None:
            return outcome.code
        if self.ended:
            return "ended"
        if self._page.get(Field.STOP):
            return "stopping"
        return Phase(self._page.get(Field.PHASE)).name.lower()

    @property
    def figures(self) -> FigureValues:
        """Running figures of quality by name with unit; empty before the first whole cycle."""
        return self._figures.newest

    @property
    def inverse(self) -> str | None:
        """Where the last change leads the inverse, ``in`` or ``out``; None without one."""
        if not self.description.compensator:
            return None
        changed = self._page.get(Field.TUNE_WANTED)
        return "out" if changed and not self._page.get_float(Field.TUNE_INVERSE_SHARE) else "in"

    def status(self) -> dict[str, Any]:
        """Return all that is not a trace, as plain values for JSON."""
        page, rate_hz = self._page, self.description.sample_rate_hz
        outcome = page.outcome()
        late = self._lateness.percentiles_us()
        ring_used = (page.get(Field.HEAD) - page.get(Field.TAIL)) / self._ring.slots
        gauges = self._headroom.gauges(late.get("max", 0.0) * 1e-6)
        gauges.append(Gauge("ring", ring_used, 100.0 * ring_used, 100.0, "%"))
        return {
            "run": self.folder.card.name,
            "recording": self.folder.card.recording,
            "state": self.state,
            "reason": outcome.reason if outcome else "",
            "safe": outcome.safe if outcome else None,
            "ended": self.ended,
            "t_s": max(self._next_sample, 0) / rate_hz,
            "total_s": (self.description.samples + max(self._waveform_at, 0)) / rate_hz,
            "segment": self.scope.segment.label if self.scope.segment else "",
            "figures": self.figures,
            "gain": page.get_float(Field.TUNE_GAIN) if page.get(Field.TUNE_WANTED) else 1.0,
            "offset": page.get_float(Field.TUNE_OFFSET) if page.get(Field.TUNE_WANTED) else 0.0,
            "inverse": self.inverse,
            "missed_samples": self.missed,
            "late_ticks": page.get(Field.LATE_TICKS),
            "lateness_us": late,
            "lateness_edges_us": EDGES_US.tolist(),
            "lateness_counts": self._lateness.counts.tolist(),
            "gauges": [{**asdict(each), "level": each.level} for each in gauges],
            "ring_used": ring_used,
            "disk": asdict(self._disk) if self._disk else None,
            "events": [_plain_event(each, rate_hz) for each in self.events],
        }


def _plain_event(event: Event, rate_hz: float) -> dict[str, Any]:
    return {
        "t_s": event.sample / rate_hz,
        "level": event.level,
        "code": event.code,
        "text": event.text,
        "values": dict(event.values),
    }


def _disk_room(recording: Path) -> DiskRoom | None:
    """Return the room there is for a recording; None where the disk does not say."""
    try:
        disk = os.statvfs(recording.parent)
        return DiskRoom(disk.f_bavail * disk.f_frsize, recording.stat().st_size)
    except OSError:
        return None
