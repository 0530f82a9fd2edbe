"""Encode a live run for Foxglove: the topics of its recording, and diagnostics.

`/scope` and `/events` have the schemas of a recording, so that one layout opens both. `/scope` has
the first sample of each bucket, like the loops of the page; `/scope_low` and `/scope_high` have the
minimum and maximum of each signal per bucket, so that every spike is visible.
"""

import json
from collections.abc import Collection, Iterator
from itertools import repeat
from typing import Any, Literal

import numpy as np

from hilctl.base.samples import COLUMNS
from hilctl.base.types import F64
from hilctl.live.run_reader import RunReader
from hilctl.live.signals import ROW
from hilctl.recording.codec import encode_scope
from hilctl.recording.encoder import Encoded, MessageMaker, RecordingLayout
from hilctl.recording.schema import TOPICS

SCOPE_TOPICS: dict[str, Literal["first", "low", "high"]] = {
    "/scope": "first",
    "/scope_low": "low",
    "/scope_high": "high",
}
"""Topics of samples, and what each has of a bucket."""
MESSAGES = {"/events": TOPICS["/events"], **dict.fromkeys(SCOPE_TOPICS, TOPICS["/scope"])}
"""Message of each topic that a recording has too, or one like it; all are of package ``hilctl``."""
DIAGNOSTICS = "/diagnostics"
DIAGNOSTICS_SCHEMA: dict[str, Any] = {
    "title": "diagnostic_msgs/DiagnosticArray",  # name expected by the panels
    "type": "object",
    "properties": {
        "header": {
            "type": "object",
            "properties": {
                "stamp": {
                    "type": "object",
                    "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
                },
                "frame_id": {"type": "string"},
            },
        },
        "status": {
            "type": "array",
            "items": {
                "type": "object",
                "properties": {
                    "level": {"type": "integer"},
                    "name": {"type": "string"},
                    "message": {"type": "string"},
                    "hardware_id": {"type": "string"},
                    "values": {
                        "type": "array",
                        "items": {
                            "type": "object",
                            "properties": {"key": {"type": "string"}, "value": {"type": "string"}},
                        },
                    },
                },
            },
        },
    },
}
"""Schema of ``/diagnostics``, which is JSON."""
_WINDOW_S = 0.5  # buckets of 1/1200 s, similar to /scope of a recording
_LEVELS = {"info": 0, "warning": 1, "error": 2}
_COLUMNS = {
    "reference_um": "reference",
    "wanted": "wanted",
    "command": "command",
    "displacement_um": "displacement",
}  # columns of a recording's /scope and their signals


class LiveTopics:
    """The messages of one run.

    Args:
        feed: Reader of the run.
        start_unix_ns: Unix time of sample 0.
    """

    def __init__(self, feed: RunReader, start_unix_ns: int) -> None:
        self._feed, about = feed, feed.description
        self._layout = RecordingLayout(
            sample_rate_hz=about.sample_rate_hz,
            command_unit="V" if about.command_unit == "V" else "A",
            measures_command=about.measures_command,
            scope_rate_hz=about.sample_rate_hz,
            start_unix_ns=start_unix_ns,
            waveform_unit=about.waveform_unit,
        )
        self._maker = MessageMaker(self._layout)
        self._next_bucket = self._seen_events = 0
        fields = {name: COLUMNS[name].field(self._layout.command_unit) for name in _COLUMNS}
        self._rows = {fields[name].name: ROW[signal] for name, signal in _COLUMNS.items()}

    def scope(self, wanted: Collection[str] = SCOPE_TOPICS) -> Iterator[Encoded]:
        """Yield the messages of completed buckets, the oldest first.

        Buckets that were overwritten before the call are omitted.

        Args:
            wanted: Topics with subscribers.
        """
        first, buckets = self._feed.scope.whole_buckets(_WINDOW_S, self._next_bucket)
        count, width = buckets.first.shape[1], self._feed.scope.bucket_samples(_WINDOW_S)
        self._next_bucket = first + count
        for topic in wanted:
            values: F64 = getattr(buckets, SCOPE_TOPICS[topic])[list(self._rows.values())]
            at = np.flatnonzero(~np.isnan(values).all(axis=0))
            samples = (first + at) * width
            columns = dict(zip(self._rows, values[:, at], strict=True))
            columns["t_rel"] = samples / self._layout.sample_rate_hz
            messages = encode_scope(samples, np.zeros(at.size, dtype=np.uint32), columns)
            times_ns = self._layout.times_ns(samples).tolist()
            yield from map(Encoded, repeat(topic), times_ns, messages)

    def events(self) -> Iterator[Encoded]:
        """Yield the messages of the events since the last call."""
        events, self._seen_events = self._feed.events_since(self._seen_events)
        yield from map(self._maker.event, events)

    def diagnostics(self, now_unix_ns: int) -> Encoded:
        """Return the state of the run and its use of each limit."""
        status = self._feed.status()
        seconds, nanoseconds = divmod(now_unix_ns, 10**9)
        stamp = {"sec": seconds, "nsec": nanoseconds}
        found = {"header": {"stamp": stamp, "frame_id": ""}, "status": _statuses(status)}
        return Encoded(DIAGNOSTICS, now_unix_ns, json.dumps(found).encode())


def _statuses(status: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the parts of ``/diagnostics`` from :meth:`hilctl.live.run_reader.RunReader.status`."""
    run, failed = status["run"], status["state"] == "fault" or status["safe"] is False
    told = ("t_s", "total_s", "segment", "gain", "offset", "inverse", "recording")
    late = {f"{name}_us": value for name, value in status["lateness_us"].items()}
    kept = {"missed_samples": status["missed_samples"]}
    state = " ".join(filter(None, (status["state"], status["reason"])))
    return [
        _part(run, "run", "error" if failed else "info", state, {key: status[key] for key in told}),
        _part(run, "figures", "info", "newest cycles", status["figures"]),
        _part(run, "lateness", "info", "", {**late, "late_ticks": status["late_ticks"]}),
        _part(run, "recording", "info", "", {**kept, **(status["disk"] or {})}),
        *(
            _part(
                run,
                f"limit: {gauge['name']}",
                gauge["level"],
                f"{100.0 * gauge['used']:.1f} % used",
                {"value": gauge["value"], "limit": gauge["limit"], "unit": gauge["unit"]},
            )
            for gauge in status["gauges"]
        ),
    ]


def _part(
    run: str, name: str, level: str, message: str, values: dict[str, object]
) -> dict[str, Any]:
    pairs = [{"key": key, "value": _text(value)} for key, value in values.items()]
    return {
        "level": _LEVELS[level],
        "name": name,
        "message": message,
        "hardware_id": run,
        "values": pairs,
    }


def _text(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
