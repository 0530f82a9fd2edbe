"""A live run as messages for Foxglove, its server, and the layouts that name its fields."""

import asyncio
import base64
import json
import re
import struct
import sys
import threading
import time
import xml.etree.ElementTree as ET
from contextlib import contextmanager
from types import SimpleNamespace

import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from websockets.asyncio.client import connect

from hilctl.base.errors import InputError
from hilctl.base.events import Event
from hilctl.live.foxglove import (
    DIAGNOSTICS,
    DIAGNOSTICS_SCHEMA,
    MESSAGES,
    FoxgloveServer,
    LiveTopics,
)
from hilctl.live.run_reader import RunReader
from hilctl.recording.schema import TOPICS, message_class
from hilctl.run.shared.shared_page import PageField
from tests.unit.live.conftest import CONFIGS, active_axes, active_run, exchange, first

START_NS = 1_700_000_000_000_000_000


@pytest.fixture
def run(description, tmp_path):
    """Return a function that exchanges blocks, the reader of the run, and its messages."""
    with active_run(description, tmp_path, 512) as (folder, ring):
        feed = RunReader(folder)

        def after(now_s, blocks, **more):
            exchange(ring, blocks, keep=500, **more)
            feed.poll(now_s)

        yield ring, LiveTopics(feed, START_NS), after


def decoded(messages):
    found = {topic: [] for topic in MESSAGES}
    for each in messages:
        message = message_class(MESSAGES[each.topic])()
        message.ParseFromString(each.data)
        found[each.topic].append((each.time_ns, message))
    return found


def test_the_scope_has_each_bucket_once_and_every_spike(run):
    _, topics, after = run
    seen = []
    for blocks in (range(20), range(20, 34), range(34, 80)):
        after(1.0, blocks, spike_um=1e6 if 33 in blocks else 0.0)
        seen += topics.scope()
    found = decoded(seen)
    first = found["/scope"]
    assert [message.sample for _, message in first] == [42 * at for at in range(80 * 50 // 42)]
    for time_ns, message in first:
        assert time_ns == START_NS + message.sample * 20_000
        assert message.t_rel == pytest.approx(message.sample / 50e3)
        assert message.displacement_um == message.reference_um == message.sample
        assert message.current_a == message.wanted_a == message.sample / 10.0
    assert max(message.displacement_um for _, message in found["/scope_high"]) > 1e6
    assert max(message.displacement_um for _, message in found["/scope_low"]) < 4000
    assert [len(each) for each in found.values()] == [0, len(first), len(first), len(first)]


def test_overwritten_buckets_are_omitted(run):
    _, topics, after = run
    after(1.0, range(400))
    assert decoded(topics.scope())["/scope"][-1][1].sample == 42 * (400 * 50 // 42 - 1)
    after(1.1, range(400, 500))
    after(1.2, range(500, 900))
    newest = decoded(topics.scope(["/scope"]))["/scope"]
    assert len(newest) < 600
    assert newest[-1][1].sample == 42 * (900 * 50 // 42 - 1)


def test_events_are_those_of_the_recording(run):
    ring, topics, after = run
    ring.page.push_event(Event(5000, "warning", "late", "a tick", {"late_s": 0.5}))
    after(1.0, [])
    (time_ns, event), *more = decoded(topics.events())["/events"]
    assert not more
    assert (time_ns, event.sample) == (START_NS + 100_000_000, 5000)
    assert (event.level, event.code, event.text) == ("warning", "late", "a tick")
    assert dict(zip(event.value_names, event.values, strict=True)) == {"late_s": 0.5}
    assert not list(topics.events())


def test_diagnostics_have_the_form_expected_by_panels(run):
    _, topics, after = run
    after(1.0, range(100))
    topic, time_ns, data = topics.diagnostics(12_000_000_034)
    said = json.loads(data)
    assert (topic, time_ns) == (DIAGNOSTICS, 12_000_000_034)
    assert said["header"]["stamp"] == {"sec": 12, "nsec": 34}
    fields = DIAGNOSTICS_SCHEMA["properties"]["status"]["items"]["properties"]
    assert all(part.keys() == fields.keys() for part in said["status"])
    parts = {part["name"]: part for part in said["status"]}
    assert {"run", "figures", "lateness", "recording", "limit: command"} <= parts.keys()
    assert all(isinstance(each["value"], str) for part in said["status"] for each in part["values"])
    assert (parts["run"]["level"], parts["run"]["message"]) == (0, "running")
    # 499.9 A in the last sample; the limit is 7 A.
    assert parts["limit: command"]["level"] == 2


def fields_of(topic):
    name = {**TOPICS, **MESSAGES}[topic]
    return {field.name for field in message_class(name).DESCRIPTOR.fields}


def test_foxglove_layout_names_existing_fields():
    layout = json.loads((CONFIGS / "layouts" / "foxglove.json").read_text())
    panels = layout["configById"]
    paths = re.findall(r'"(/[a-z_]+)\.([a-z_0-9]+)', json.dumps(panels))
    assert len(paths) >= 8
    for topic, field in paths:
        assert field in fields_of(topic)
    topics = set(re.findall(r'"(/[a-z_]+)["\.]', json.dumps(panels)))
    assert topics <= {DIAGNOSTICS, *MESSAGES}
    # The layout shows a recording too.
    assert {"/scope", "/events"} <= topics & TOPICS.keys()
    shown = re.findall(r'"([A-Za-z]+![a-z]+)"', json.dumps(layout["layout"]))
    assert sorted(shown) == sorted(panels)


def test_plotjuggler_layout_names_existing_fields():
    tree = ET.parse(CONFIGS / "layouts" / "plotjuggler.xml")
    made = {snippet.get("name") for snippet in tree.iter("snippet")}
    sources = [each for snippet in tree.iter("snippet") for each in snippet.iter()]
    names = {each.text for each in sources if re.fullmatch("linked_source|v[0-9]+", each.tag)}
    for curve in tree.iter("curve"):
        pair = [curve.get("curve_x"), curve.get("curve_y")]
        names.update(pair if all(pair) else [curve.get("name")])
    for name in names - made:
        _, topic, field = name.split("/")
        assert field in fields_of(f"/{topic}")
        assert f"/{topic}" in TOPICS  # the layout opens a recording too
    assert len(names) > 6


def test_server_stops_with_clients_that_do_not_read(monkeypatch):
    monkeypatch.setattr("hilctl.live.foxglove._STOP_S", 0.01)
    server, go_on = FoxgloveServer(first, port=0), threading.Event()
    library, server._server = server._server, SimpleNamespace(stop=lambda: go_on.wait(60.0))
    server.run(lambda _: True)
    go_on.set()
    library.stop()


@contextmanager
def serving(description, tmp_path):
    """Serve a run that continues until the end; yield the address."""
    end, numbers = threading.Event(), iter(range(10**6))

    def over(_):
        exchange(ring, [next(numbers)], keep=8)
        return end.is_set()

    with active_run(description, tmp_path, 64) as (_, ring):
        ring.page.put(PageField.START_NS, time.monotonic_ns())
        server = FoxgloveServer(first, port=0)
        thread = threading.Thread(target=server.run, args=(over,))
        thread.start()
        try:
            yield server.url
        finally:
            end.set()
            thread.join()


async def seen(url, topics, wanted):
    """Return the channels by topic, and messages of some topics."""
    settings = {"subprotocols": ["foxglove.sdk.v1"], "proxy": None, "close_timeout": 0.2}
    async with connect(url, **settings) as connection:
        channels, found = {}, {topic: [] for topic in topics}
        async for raw in connection:
            if isinstance(raw, str):
                said = json.loads(raw)
                if said["op"] == "serverInfo":
                    assert said["capabilities"] == []  # read-only
                if said["op"] == "advertise":
                    channels |= {each["topic"]: each for each in said["channels"]}
                    chosen = [
                        {"id": n, "channelId": channels[t]["id"]} for n, t in enumerate(topics)
                    ]
                    ask = {"op": "subscribe", "subscriptions": chosen}
                    await connection.send(json.dumps(ask))
                continue
            kind, subscription, time_ns = struct.unpack_from("<BIQ", raw)
            assert kind == 1
            found[topics[subscription]].append((time_ns, raw[13:]))
            if all(len(each) >= wanted for each in found.values()):
                break
        return channels, found


def decode(channel, data):
    files = descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(channel["schema"]))
    pool = descriptor_pool.DescriptorPool()
    for each in files.file:
        pool.Add(each)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))
    return kind.FromString(data)


def test_client_decodes_all_topics(description, tmp_path, monkeypatch):
    monkeypatch.setattr("hilctl.live.foxglove._FRAME_S", 0.002)
    with serving(description, tmp_path) as url:
        topics = ["/scope", "/scope_low", "/diagnostics"]
        channels, found = asyncio.run(asyncio.wait_for(seen(url, topics, 2), 20.0))
    assert set(channels) == {"/scope", "/scope_low", "/scope_high", "/events", "/diagnostics"}
    times = [time_ns for time_ns, _ in found["/scope"]]
    assert times == sorted(times)
    assert abs(times[0] * 1e-9 - time.time()) < 60.0
    for _, data in found["/scope"]:
        message = decode(channels["/scope"], data)
        assert message.current_a == message.sample / 10.0
        assert message.displacement_um == message.sample
    assert decode(channels["/events"], b"").DESCRIPTOR.full_name == "hilctl.Event"
    diagnostics = channels["/diagnostics"]
    assert diagnostics["encoding"] == "json"
    assert diagnostics["schemaName"] == "diagnostic_msgs/DiagnosticArray"
    shown = json.loads(diagnostics["schema"])["properties"]
    assert json.loads(found["/diagnostics"][0][1]).keys() == shown.keys()


def test_end_of_a_run_is_not_published_during_the_next_run(description, tmp_path):
    """The next run may drive the output before its first sample."""
    server = FoxgloveServer(first, port=0)
    said = []
    channel = SimpleNamespace(
        has_sinks=lambda: True, log=lambda data, log_time: said.append(json.loads(data))
    )
    server._channels = {DIAGNOSTICS: channel} | dict.fromkeys(
        MESSAGES, SimpleNamespace(has_sinks=lambda: False)
    )

    def shown():
        said.clear()
        server._feeds._looked_s = float("-inf")
        server._show(0)
        return {status["hardware_id"] for each in said for status in each["status"]}

    try:
        with active_run(description, tmp_path) as (one, ring):
            ring.page.put(PageField.START_NS, 1)
            assert shown() == {one.card.name}
        server._feeds.feed(None).ended = True
        assert shown() == {one.card.name}
        with active_run(description, tmp_path) as (two, ring):
            assert shown() == set()
            ring.page.put(PageField.START_NS, 1)
            assert shown() == {two.card.name}
    finally:
        server.run(lambda _: True)


def test_axes_have_topics_of_their_own(description, tmp_path):
    server = FoxgloveServer(first, port=0)
    try:
        with active_axes(description, tmp_path) as (folder, rings):
            rings[0].page.put(PageField.START_NS, 1)
            server._feeds._looked_s = float("-inf")
            server._show(0)
            assert {*server._channels} >= {"/x/scope", "/y/scope", "/y/events", "/diagnostics"}
            hardware = [topics.diagnostics(0) for topics in server._topics]
            named = [json.loads(each.data)["status"][0]["hardware_id"] for each in hardware]
            assert named == [f"{folder.card.name} {axis}" for axis in "xy"]
    finally:
        server.run(lambda _: True)


def test_port_in_use_is_an_error():
    server = FoxgloveServer(first, port=0)
    try:
        with pytest.raises(InputError, match="in use"):
            FoxgloveServer(first, port=int(server.url.rpartition(":")[2]))
    finally:
        server.run(lambda _: True)


def test_missing_library_is_an_error(monkeypatch):
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(InputError, match="pip install"):
        FoxgloveServer(first, port=0)
