"""Serve a live run to Foxglove, Lichtblick and PlotJuggler with Foxglove's protocol, on loopback.

`/scope` and `/events` have the schemas of a recording, so that one layout opens both. `/scope` has
the first sample of each bucket; `/scope_low` and `/scope_high` have the minimum and maximum of each
signal per bucket, so that every spike is visible. `/diagnostics` has the state and the limits.

In a run of several axes the topics are those of each axis, such as `/x/scope`, and `/diagnostics`.

Clients are read-only. The library checks neither the user nor the origin of a request, so every
user and every web page on this computer can read the run while the server is active. It is
therefore started on request only.
"""

import json
import logging
import threading
import time
from collections.abc import Callable, Collection, Iterator
from itertools import repeat
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from hilctl.base.errors import InputError
from hilctl.base.samples import COLUMNS
from hilctl.base.types import F64
from hilctl.live.run_reader import RunList, RunReader
from hilctl.live.scope import ROW
from hilctl.live.server import listeners
from hilctl.recording import schema
from hilctl.recording.codec import encode_scope
from hilctl.recording.encoder import Encoded, MessageMaker, RecordingLayout
from hilctl.run.run_folder import RunFolder

if TYPE_CHECKING:
    from foxglove import Channel, Context
    from foxglove.websocket import WebSocketServer

PORT = 8765
"""Default port of the applications."""
_FRAME_S = 1.0 / 30.0
_STATUS_FRAMES = 15
_STOP_S = 1.0
_BACKLOG = 4096  # messages for one client, about a second of them; the oldest are dropped
SCOPE_TOPICS: dict[str, Literal["first", "low", "high"]] = {
    "/scope": "first",
    "/scope_low": "low",
    "/scope_high": "high",
}
"""Topics of samples, and the value of each bucket that they contain."""
MESSAGES = {
    "/events": schema.TOPICS["/events"],
    **dict.fromkeys(SCOPE_TOPICS, schema.TOPICS["/scope"]),
}
"""Protobuf message of each topic, of package ``hilctl``."""
DIAGNOSTICS = "/diagnostics"
_TEXT, _WHOLE = {"type": "string"}, {"type": "integer"}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


def _list(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


_STAMP, _PAIRS = _object(sec=_WHOLE, nsec=_WHOLE), _list(_object(key=_TEXT, value=_TEXT))
_STATUS = _object(level=_WHOLE, name=_TEXT, message=_TEXT, hardware_id=_TEXT, values=_PAIRS)
DIAGNOSTICS_SCHEMA = {
    "title": "diagnostic_msgs/DiagnosticArray",  # name expected by the panels
    **_object(header=_object(stamp=_STAMP, frame_id=_TEXT), status=_list(_STATUS)),
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
    """The messages of one axis of a run, with the Unix time of its sample 0."""

    def __init__(self, feed: RunReader, start_unix_ns: int) -> None:
        self.axis = feed.axis
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
        """Yield the messages of some topics for the completed buckets, the oldest first.

        Buckets that were overwritten before the call are omitted.
        """
        first, width, buckets = self._feed.scope.whole_buckets(_WINDOW_S, self._next_bucket)
        self._next_bucket = first + buckets.first.shape[1]
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
    run = " ".join(filter(None, (status["run"], status["axis"])))
    failed = status["state"] == "fault" or status["safe"] is False
    keys = ("t_s", "total_s", "segment", "gain", "offset", "inverse", "recording")
    late = {f"{name}_us": value for name, value in status["lateness_us"].items()}
    missed = {"missed_samples": status["missed_samples"]}
    state = " ".join(filter(None, (status["state"], status["reason"])))
    parts: list[tuple[str, str, str, dict[str, Any]]] = [
        ("run", "error" if failed else "info", state, {key: status[key] for key in keys}),
        ("figures", "info", "newest cycles", status["figures"]),
        ("auxiliary", "info", "", {each["name"]: each["value"] for each in status["aux"]}),
        ("lateness", "info", "", {**late, "late_ticks": status["late_ticks"]}),
        ("recording", "info", "", {**missed, **(status["disk"] or {})}),
    ]
    for gauge in status["gauges"]:
        values = {key: gauge[key] for key in ("value", "limit", "unit")}
        used = f"{100.0 * gauge['used']:.1f} % used"
        parts.append((f"limit: {gauge['name']}", gauge["level"], used, values))
    return [
        {
            "level": _LEVELS[level],
            "name": name,
            "message": message,
            "hardware_id": run,
            "values": [{"key": key, "value": _text(value)} for key, value in values.items()],
        }
        for name, level, message, values in parts
    ]


def _text(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


class FoxgloveServer:
    """Serves the active run on a port, 0 for any.

    Raise InputError if the library is not installed, or the port is not available.
    """

    def __init__(self, chosen: Callable[[list[RunFolder]], RunFolder | None], port: int) -> None:
        self._feeds = RunList(chosen)
        self._shown: RunReader | None = None
        self._topics: list[LiveTopics] = []
        self._context, self._server = _started(port)
        self._channels = _channels(self._context, "")

    @property
    def url(self) -> str:
        """Address for the applications."""
        return f"ws://127.0.0.1:{self._server.port}"

    def run(self, over: Callable[[RunList], bool]) -> None:
        """Serve until ``over`` returns true."""
        number = 0
        try:
            while not over(self._feeds):
                began_s = time.monotonic()
                self._show(number)
                number += 1
                time.sleep(max(_FRAME_S / 4.0, began_s + _FRAME_S - time.monotonic()))
        finally:
            # In a thread: the library waits for clients that do not read.
            stopping = threading.Thread(target=self._server.stop, daemon=True)
            stopping.start()
            stopping.join(_STOP_S)

    def _show(self, number: int) -> None:
        now_s = time.monotonic()
        self._feeds.update(now_s)
        feed = self._feeds.feed(None)
        if feed is not self._shown:
            if self._shown is not None:
                self._server.clear_session()  # discards client data of another run
            self._shown, self._topics = feed, []
        if feed is None:
            return
        feeds = self._feeds.axes(None)
        for each in feeds:
            each.poll(now_s)
        if not self._topics:
            if not feed.start_ns:
                return
            start_unix_ns = time.time_ns() - round(now_s * 1e9) + feed.start_ns
            self._topics = [LiveTopics(each, start_unix_ns) for each in feeds]
            for axis in feed.axes:
                if schema.topic_of(axis, "/events") not in self._channels:
                    self._channels |= _channels(self._context, axis)
        for topics in self._topics:
            self._publish(topics, diagnoses=number % _STATUS_FRAMES == 0)

    def _publish(self, topics: LiveTopics, *, diagnoses: bool) -> None:
        """Send the new messages of an axis."""
        channels = {
            topic: self._channels[schema.topic_of(topics.axis, topic)] for topic in MESSAGES
        }
        channels[DIAGNOSTICS] = self._channels[DIAGNOSTICS]
        wanted = [topic for topic in SCOPE_TOPICS if channels[topic].has_sinks()]
        messages = [*topics.scope(wanted), *topics.events()]
        if diagnoses:
            messages.append(topics.diagnostics(time.time_ns()))
        for message in messages:
            channels[message.topic].log(message.data, log_time=message.time_ns)


def _started(port: int) -> tuple["Context", "WebSocketServer"]:
    """Return the context, without which the server loses its channels, and the server."""
    try:
        import foxglove
    except ImportError:
        raise InputError(
            "--foxglove: its library is not installed: pip install 'hilctl[foxglove]'"
        ) from None
    for listener in listeners(port):  # the library's error names no remedy
        listener.close()
    root = logging.getLogger()
    level, handlers = root.level, root.handlers[:]
    foxglove.set_log_level("ERROR")  # discards messages on invalid requests; changes all logs
    root.setLevel(level)
    root.handlers[:] = handlers
    context = foxglove.Context()
    try:
        # No capabilities: clients can only subscribe.
        server = foxglove.start_server(
            name="hilctl", host="127.0.0.1", port=port,
            context=context, message_backlog_size=_BACKLOG,
        )  # fmt: skip
    except RuntimeError as error:
        raise InputError(f"--port {port}: {error}") from None
    return context, server


def _channels(context: "Context", axis: str) -> dict[str, "Channel"]:
    """Return new channels of the topics of an axis; those without an axis are of a whole run."""
    import foxglove

    channels = {}
    if not axis:
        channels[DIAGNOSTICS] = foxglove.Channel(
            DIAGNOSTICS, schema=DIAGNOSTICS_SCHEMA, context=context
        )
    for topic, name in MESSAGES.items():
        form = foxglove.Schema(
            name=f"hilctl.{name}", encoding="protobuf", data=schema.descriptor_set()
        )
        named = schema.topic_of(axis, topic)
        channels[named] = foxglove.Channel(
            named, schema=form, message_encoding="protobuf", context=context
        )
    return channels
