"""A live run as messages for Foxglove, its server, and the layouts that name its fields."""

import asyncio
import base64
import json
import logging
import re
import struct
import sys
import threading
import time
import xml.etree.ElementTree as ET
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from websockets.asyncio.client import connect

from hilctl.base.errors import InputError, RunError
from hilctl.base.events import Event
from hilctl.base.samples import BlockHeader
from hilctl.live.foxglove import (
    DIAGNOSTICS,
    DIAGNOSTICS_SCHEMA,
    MESSAGES,
    FoxgloveServer,
    LiveTopics,
)
from hilctl.live.run_reader import RunReader
from hilctl.recording.schema import TOPICS, message_class
from hilctl.run.metadata import RunDescription
from hilctl.run.run_folder import run_folder
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import PageField, Phase
from hilctl.run.start import checked_experiment

CONFIGS = Path(__file__).parents[3] / "configs"
BLOCK = 50
START_NS = 1_700_000_000_000_000_000


@contextmanager
def active_run(place, slots):
    """Yield the folder and the ring of a run at 50 kHz, so that a bucket is 42 samples."""
    with run_folder("demo", place / "a.mcap", 12.0) as (folder, _):
        RunDescription.of(checked_experiment(CONFIGS / "demo.yaml", [])).write(folder.description)
        ring = SampleRing.create(folder.ring, slots=slots, block=BLOCK, state_size=1)
        ring.page.put(PageField.PHASE, Phase.RUNNING)
        yield folder, ring


@pytest.fixture
def run(tmp_path):
    with active_run(tmp_path, 512) as made:
        yield made


def exchange(ring, blocks, spike=None, keep=500):
    for number in blocks:
        block = ring.claim()
        index = number * BLOCK + np.arange(BLOCK)
        block.head[BlockHeader.FIRST_SAMPLE] = index[0]
        block.flags[:] = 0
        block.reference[:] = block.input_um[:] = index
        block.command[:] = block.wanted[:] = index / 10.0
        ring.sending(block)
        block.displacement_um[:] = index
        if number == spike:
            block.displacement_um[7] += 1e6
        ring.answered(block)
        while ring.pop() is not None:
            ring.release(keep=keep)


def decoded(messages):
    found = {topic: [] for topic in MESSAGES}
    for each in messages:
        message = message_class(MESSAGES[each.topic])()
        message.ParseFromString(each.data)
        found[each.topic].append((each.time_ns, message))
    return found


def test_the_scope_has_each_bucket_once_and_every_spike(run):
    folder, ring = run
    feed = RunReader(folder)
    topics, seen = LiveTopics(feed, START_NS), []
    for blocks in (range(20), range(20, 21), range(21, 80)):
        exchange(ring, blocks, spike=33)
        feed.poll(1.0)
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
    folder, ring = run
    feed = RunReader(folder)
    topics = LiveTopics(feed, START_NS)
    exchange(ring, range(400))
    feed.poll(1.0)
    newest = decoded(topics.scope())["/scope"]
    assert newest[-1][1].sample == 42 * (400 * 50 // 42 - 1)
    exchange(ring, range(400, 500))
    feed.poll(1.1)
    exchange(ring, range(500, 900))
    feed.poll(1.2)
    newest = decoded(topics.scope(["/scope"]))["/scope"]
    assert len(newest) < 600
    assert newest[-1][1].sample == 42 * (900 * 50 // 42 - 1)


def test_events_are_those_of_the_recording(run):
    folder, ring = run
    feed = RunReader(folder)
    topics = LiveTopics(feed, START_NS)
    ring.page.push_event(Event(5000, "warning", "late", "a tick", {"late_s": 0.5}))
    feed.poll(1.0)
    (time_ns, event), *more = decoded(topics.events())["/events"]
    assert not more
    assert (time_ns, event.sample) == (START_NS + 100_000_000, 5000)
    assert (event.level, event.code, event.text) == ("warning", "late", "a tick")
    assert dict(zip(event.value_names, event.values, strict=True)) == {"late_s": 0.5}
    assert not list(topics.events())


def test_diagnostics_have_the_form_expected_by_panels(run):
    folder, ring = run
    feed = RunReader(folder)
    exchange(ring, range(100))
    feed.poll(1.0)
    topic, time_ns, data = LiveTopics(feed, START_NS).diagnostics(12_000_000_034)
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
    """Return the fields of a topic, live or in a recording."""
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
    names = {text for snippet in tree.iter("snippet") for text in sources(snippet)}
    for curve in tree.iter("curve"):
        pair = [curve.get("curve_x"), curve.get("curve_y")]
        names.update(pair if all(pair) else [curve.get("name")])
    for name in names - made:
        _, topic, field = name.split("/")
        assert field in fields_of(f"/{topic}")
        assert f"/{topic}" in TOPICS  # the layout opens a recording too
    assert len(names) > 6


def sources(snippet):
    """Return the sources of a computed series."""
    return [each.text for each in snippet.iter() if re.fullmatch("linked_source|v[0-9]+", each.tag)]


def test_log_settings_are_restored():
    root = logging.getLogger()
    before = root.level, root.handlers[:]
    FoxgloveServer(first, port=0).run(lambda server: True)
    assert (root.level, root.handlers) == before


def test_server_stops_with_clients_that_do_not_read(monkeypatch):
    monkeypatch.setattr("hilctl.live.foxglove._STOP_S", 0.01)
    server, go_on = FoxgloveServer(first, port=0), threading.Event()
    library, server._server = server._server, SimpleNamespace(stop=lambda: go_on.wait(60.0))
    server.run(lambda server: True)
    assert not go_on.is_set()
    go_on.set()
    library.stop()


def first(runs):
    return runs[0] if runs else None


@contextmanager
def serving(tmp_path):
    """Serve a run that continues until the end; yield the address."""
    end, numbers = threading.Event(), iter(range(10**6))

    def over(_):
        exchange(ring, [next(numbers)], keep=8)
        return end.is_set()

    with active_run(tmp_path, 64) as (_, ring):
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
    async with connect(url, subprotocols=["foxglove.sdk.v1"], proxy=None) as connection:
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
    """Decode with the schema of the channel."""
    files = descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(channel["schema"]))
    pool = descriptor_pool.DescriptorPool()
    for each in files.file:
        pool.Add(each)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))
    return kind.FromString(data)


def test_client_decodes_all_topics_with_the_advertised_schemas(tmp_path, monkeypatch):
    monkeypatch.setattr("hilctl.live.foxglove._FRAME_S", 0.002)
    with serving(tmp_path) as url:
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
    assert (diagnostics["encoding"], diagnostics["schemaName"]) == (
        "json",
        "diagnostic_msgs/DiagnosticArray",
    )
    shown = json.loads(diagnostics["schema"])["properties"]
    assert json.loads(found["/diagnostics"][0][1]).keys() == shown.keys()


def test_port_in_use_is_an_error():
    server = FoxgloveServer(first, port=0)
    try:
        with pytest.raises(RunError, match="in use"):
            FoxgloveServer(first, port=int(server.url.rpartition(":")[2]))
    finally:
        server.run(lambda _: True)


def test_missing_library_is_an_error(monkeypatch):
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(InputError, match="pip install"):
        FoxgloveServer(first, port=0)
