"""Readers of active runs: newest signals, metrics, limits and events of each, and frames of them.

The ring is mapped read-only and copied data are validated, so that the loop and the recorder are
not affected. Time is an argument.
"""

import json
import math
import os
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from hilctl.base.errors import InputError, RunError
from hilctl.base.events import Event
from hilctl.base.formatting import did_you_mean
from hilctl.base.segments import Segment
from hilctl.base.types import F64
from hilctl.live.live_metrics import (
    EDGES_US,
    Gauge,
    Headroom,
    LatenessCounts,
    LiveErrorSpectrum,
    RunningMetrics,
)
from hilctl.live.scope import ROW, SIGNALS, WINDOWS_S, Scope, Signal, Traces, traces_of
from hilctl.run.control.client import active_runs
from hilctl.run.metadata import RunDescription
from hilctl.run.run_folder import RunFolder
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import PageField, Phase

_EVENTS = 60
_LOOK_S = 0.5  # interval of checks of the run's locks and the disk
_SEARCH_S = 1.0  # interval of searches for runs


class RunReader:
    """Reader of one axis of an active run, by default the first one.

    Raise RunError if the run has ended, or cannot be read, and InputError if it has no such axis.
    """

    def __init__(self, folder: RunFolder, axis: str = "") -> None:
        self.folder = folder
        self.axes = [*folder.card.axes]
        """Names of the axes; empty if there is only one."""
        if axis and axis not in self.axes:
            known = did_you_mean(axis, self.axes) or "the run has one axis"
            raise InputError(f"{folder.card.name}: no axis is named {axis!r} ({known})")
        number = self.axes.index(axis) if axis else 0
        self.axis = self.axes[number] if self.axes else ""
        self.recording = folder.card.recordings[number]
        try:
            self.description = RunDescription.read(folder.description_of(number))
            self._ring = SampleRing(folder.ring_of(number), look_only=True)
            # The page of the run; that of the axis has its samples, events and changes.
            self._page = SampleRing(folder.ring, look_only=True).page
        except (OSError, ValueError) as error:
            raise RunError(f"{folder.card.name}: cannot read the run: {error}") from None
        aux = (Signal(each.name, each.name, each.unit) for each in self.description.aux)
        self.signals = (*SIGNALS, *aux)  # in the order of their rows
        self.scope = self._new_scope([])
        self._aux: list[float] = []
        self._waveform_at = -1
        self._metrics = RunningMetrics(self.description.sample_rate_hz, self.loop_input)
        self.spectrum = LiveErrorSpectrum(self.description.sample_rate_hz)
        self._lateness, self._headroom = LatenessCounts(), Headroom(self.description)
        self.events: list[Event] = []  # the newest ones, the oldest first
        self._events_seen = 0
        self.peak_error_um = math.nan
        """Largest error of single samples since the last reset."""
        self._reset_at = 0
        self.missed = 0  # samples not read: dropped by the run, or overwritten too early
        self.ended = False  # whether the run has ended and no data can follow
        self._disk: dict[str, int] | None = None
        self._next_block = max(0, self._ring.page.observe(PageField.HEAD) - 1)
        self._next_event = 0
        self._next_sample, self._next_note = -1, 0
        self._looked_s = -math.inf

    @property
    def loop_input(self) -> str:
        """Signal on the abscissa of the loop: the reference if there is one in um."""
        return "reference" if self.description.waveform_unit == "um" else "command"

    def poll(self, now_s: float) -> bool:
        """Read new data; return whether there were samples."""
        if now_s - self._looked_s >= _LOOK_S:
            self._looked_s = now_s
            # Checked first: an ended run writes no more data after this.
            self.ended = not self.folder.alive
            self._disk = _disk_room(self.recording)
        if self._page.observe(PageField.PHASE) < Phase.RUNNING:
            return False
        self._begin()
        batch, self._next_block = self._ring.look(self._next_block)
        events, self._next_event = self._ring.page.look_at_events(self._next_event)
        notes, self._next_note = self._ring.page.look_at_notes(self._next_note)
        self.events = (self.events + events + notes)[-_EVENTS:]
        self._events_seen += len(events) + len(notes)
        if not batch.heads.shape[0]:
            return False
        self._lateness.add(batch)
        self._take(traces_of(batch, self.description.waveform_unit))
        return True

    def _begin(self) -> None:
        """Read the first sample of the waveform, which is known once the loop runs."""
        if self._waveform_at < 0:
            self._waveform_at = self._ring.page.get(PageField.WAVEFORM_AT)
            segments = self.description.segments_at(self._waveform_at)
            self.scope = self._new_scope(segments)

    def _new_scope(self, segments: list[Segment]) -> Scope:
        rate_hz = self.description.sample_rate_hz
        return Scope(rate_hz, segments, self.loop_input, len(self.signals))

    def _take(self, traces: Traces) -> None:
        if self._next_sample < 0:
            self._reset_at = int(traces.index[0])
        else:
            self.missed += int(traces.index[-1]) + 1 - self._next_sample - traces.index.size
        self._next_sample = int(traces.index[-1]) + 1
        self.scope.add(traces)
        self._aux = traces.values[len(SIGNALS) :, -1].tolist()
        self._metrics.add(traces, self.scope.segment)
        self.spectrum.add(traces)
        self._headroom.add(traces)
        error_um = np.abs(traces.values[ROW["error"]])
        self.peak_error_um = float(np.fmax.reduce(error_um, initial=self.peak_error_um))

    def reset_peak(self) -> None:
        """Begin a new :attr:`peak_error_um`."""
        self.peak_error_um, self._reset_at = math.nan, max(self._next_sample, 0)

    def events_since(self, seen: int) -> tuple[list[Event], int]:
        """Return the events after the first ``seen``, and the number of all events."""
        new = min(self._events_seen - seen, len(self.events))
        return self.events[len(self.events) - new :], self._events_seen

    @property
    def start_ns(self) -> int:
        """Monotonic time of sample 0 in ns; 0 while unknown."""
        return self._page.get(PageField.START_NS)

    @property
    def state(self) -> str:
        """State of the run in one word."""
        outcome = self._page.outcome()
        if outcome is not None:
            return outcome.code
        if self.ended:
            return "ended"
        return self._page.state()

    @property
    def inverse(self) -> str | None:
        """State of the inverse after the last change, ``in`` or ``out``; None without one."""
        if not self.description.compensator:
            return None
        page = self._ring.page
        changed = page.get(PageField.TUNE_NUMBER)
        return "out" if changed and not page.get_float(PageField.TUNE_INVERSE_SHARE) else "in"

    def status(self) -> dict[str, Any]:
        """Return everything except the traces, as plain values for JSON."""
        page, rate_hz = self._ring.page, self.description.sample_rate_hz
        outcome, tuned = self._page.outcome(), page.get(PageField.TUNE_NUMBER)
        late = self._lateness.percentiles_us()
        killed = "no outcome from the loop: see the report" if self.ended else ""
        ring_used = (page.get(PageField.HEAD) - page.get(PageField.TAIL)) / self._ring.slots
        gauges = self._headroom.gauges(late.get("max", 0.0) * 1e-6)
        gauges.append(Gauge("ring", ring_used, 100.0 * ring_used, 100.0, "%"))
        return {
            "run": self.folder.card.name,
            "axis": self.axis,
            "axes": self.axes,
            "recording": str(self.recording),
            "state": self.state,
            "reason": outcome.reason if outcome else killed,
            "safe": outcome.safe if outcome else None,
            "ended": self.ended,
            "t_s": max(self._next_sample, 0) / rate_hz,
            "total_s": (self.description.samples + max(self._waveform_at, 0)) / rate_hz,
            "segment": self.scope.segment.label if self.scope.segment else "",
            "figures": self._metrics.newest,
            "peak_error": {"um": self.peak_error_um, "since_s": self._reset_at / rate_hz},
            "aux": [
                {"name": each.name, "unit": each.unit, "value": value}
                for each, value in zip(self.description.aux, self._aux, strict=False)
            ],
            "gain": page.get_float(PageField.TUNE_GAIN) if tuned else 1.0,
            "offset": page.get_float(PageField.TUNE_OFFSET) if tuned else 0.0,
            "inverse": self.inverse,
            "missed_samples": self.missed,
            "late_ticks": self._page.get(PageField.LATE_TICKS),
            "lateness_us": late,
            "lateness_edges_us": EDGES_US.tolist(),
            "lateness_counts": self._lateness.counts.tolist(),
            "gauges": [{**asdict(each), "level": each.level} for each in gauges],
            "ring_used": ring_used,
            "disk": self._disk,
            "events": [_plain_event(each, rate_hz) for each in self.events],
        }


def _plain_event(event: Event, rate_hz: float) -> dict[str, Any]:
    fields = {name: getattr(event, name) for name in ("level", "code", "text")}
    return {"t_s": event.sample / rate_hz, **fields, "values": dict(event.values)}


def _disk_room(recording: Path) -> dict[str, int] | None:
    """Return free space and size of a recording; None if they are unknown."""
    try:
        disk, size = os.statvfs(recording.parent), recording.stat().st_size
    except OSError:
        return None
    return {"free_bytes": disk.f_bavail * disk.f_frsize, "recorded_bytes": size}


class RunList:
    """Readers of the axes of active runs, created when the run is first requested.

    ``chosen`` returns the run to show if none is named.
    """

    def __init__(self, chosen: Callable[[list[RunFolder]], RunFolder | None]) -> None:
        self.runs: list[RunFolder] = []
        self._chosen = chosen
        self._feeds: dict[str, list[RunReader]] = {}
        self._main = ""
        self._looked_s = float("-inf")

    def __iter__(self) -> Iterator[RunReader]:
        """Iterate over the readers of all requested runs."""
        return chain.from_iterable(self._feeds.values())

    def update(self, now_s: float, shown: Iterable[str | None] = ()) -> None:
        """Update the list of active runs once per second; remove ended runs that are not shown.

        In ``shown``, None is the main run.
        """
        if now_s - self._looked_s < _SEARCH_S:
            return
        self._looked_s, self.runs = now_s, active_runs()
        kept = {self._main, *(feed.folder.card.name for name in shown for feed in self.axes(name))}
        self._feeds = {
            name: feeds for name, feeds in self._feeds.items() if not feeds[0].ended or name in kept
        }

    def feed(self, name: str | None, axis: str | None = None) -> RunReader | None:
        """Return the reader of an axis of a run, or of its first one if it has no such axis."""
        feeds = self.axes(name)
        return next((each for each in feeds if each.axis == axis), feeds[0] if feeds else None)

    def axes(self, name: str | None) -> list[RunReader]:
        """Return the readers of a run that is active, or was when first requested."""
        if name is None:
            name = self._main = self._main_run()
        if name in self._feeds:
            return self._feeds[name]
        found = next((run for run in self.runs if run.card.name == name), None)
        if found is not None:
            with suppress(RunError):  # the run is just being started or removed
                self._feeds[name] = [RunReader(found, axis) for axis in found.card.axes or [""]]
        return self._feeds.get(name, [])

    def _main_run(self) -> str:
        """Return the default run; an ended run remains until there is another."""
        if self._main in self._feeds and not self._feeds[self._main][0].ended:
            return self._main
        chosen = self._chosen(self.runs)
        return self._main if chosen is None else chosen.card.name


ScopeMode: TypeAlias = Literal["roll", "cycle"]


def nearest_window_s(wanted_s: float) -> float:
    """Return the value of :data:`hilctl.live.scope.WINDOWS_S` with the nearest ratio."""
    return min(WINDOWS_S, key=lambda each: max(each / wanted_s, wanted_s / each))


NO_PATH = np.empty((4, 0))


_POSITIONS = [ROW["reference"], ROW["displacement"]]


def path_of(scopes: Sequence[Scope], window_s: float, rate_hz: float) -> F64:
    """Return the newest ``window_s`` of two axes of a run, the oldest samples first.

    Rows are reference and displacement of the first axis, then of the second one: float64[4, n].
    All are of the same samples.
    """
    traces = [each.densest(window_s) for each in scopes]
    newest = min(each.newest for each in traces)
    count = max(2, math.ceil(window_s * rate_hz / traces[0].width))
    windows = [each.window(newest - count + 1, count) for each in traces]
    return np.concatenate([each.first[_POSITIONS] for each in windows])


def frame_of(scope: Scope, mode: ScopeMode, window_s: float, path: F64 = NO_PATH) -> bytes:
    """Return the current frame of a page; without a cycle, mode ``cycle`` rolls.

    The length of a rolling window is one of :data:`hilctl.live.scope.WINDOWS_S`; ``path`` is that
    of two axes, see :func:`path_of`. A frame is::

        uint32 little endian   size of the JSON in bytes, with spaces up to a multiple of 4
        JSON                   ``mode``, ``n`` buckets, number of ``signals``, ``loop`` points of
                               the loops, ``cycle`` points per cycle, ``path`` points of the path
        float32 little endian  t_s[n], low[signals, n], high[signals, n], input[loop], output[loop],
                               path[4, path]
    """
    cycles = scope.triggered() if mode == "cycle" else None
    window, loops = cycles or scope.rolling(window_s), scope.loops()
    facts = {
        "mode": "cycle" if cycles else "roll",
        "n": window.t_s.size,
        "signals": window.buckets.low.shape[0],
        "loop": loops.shape[1],
        "cycle": scope.points_a_cycle(),
        "path": path.shape[1],
    }
    header = json.dumps(facts).encode()
    header += b" " * (-len(header) % 4)
    parts = (window.t_s, window.buckets.low, window.buckets.high, loops, path)
    values = np.concatenate([np.ravel(part) for part in parts]).astype("<f4")
    return struct.pack("<I", len(header)) + header + values.tobytes()


@dataclass(frozen=True, slots=True)
class RunFrame:
    """State of a run at one time."""

    status: dict[str, Any]  # metrics, limits, lateness; see :meth:`RunReader.status`
    events: list[Event]  # events since the previous frame
    t_s: F64  # float64[n], start of each bucket of samples; 0 for the newest
    low: dict[str, F64]  # minimum of each bucket by signal, float64[n]; NaN if there is no value
    high: dict[str, F64]  # maximum of each bucket by signal


def frames_of(
    feed: RunReader,
    every_s: float,
    window_s: float,
    clock: Callable[[], float],
    sleep: Callable[[float], None],
) -> Iterator[RunFrame]:
    """Yield frames of a run until it ends; the last follows its end.

    A late frame delays the following ones. The available window that is nearest to ``window_s`` is
    used. The clock is monotonic time in s.
    """
    window_s, seen = nearest_window_s(window_s), 0
    while True:
        began_s = clock()
        feed.poll(began_s)
        ended = feed.ended
        events, seen = feed.events_since(seen)
        window = feed.scope.rolling(window_s)
        low, high = (
            {signal.name: values[row] for row, signal in enumerate(feed.signals)}
            for values in (window.buckets.low, window.buckets.high)
        )
        yield RunFrame(feed.status(), events, window.t_s, low, high)
        if ended:
            return
        sleep(max(0.0, began_s + every_s - clock()))
