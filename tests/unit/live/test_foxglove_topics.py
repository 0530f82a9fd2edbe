"""A live run as messages for Foxglove, and the layouts that name their fields."""

import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.events import Event
from hilctl.base.samples import BlockHeader
from hilctl.live.foxglove_topics import DIAGNOSTICS, DIAGNOSTICS_SCHEMA, MESSAGES, LiveTopics
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


@pytest.fixture
def run(tmp_path):
    """A run's folder, and its ring as the loop has it; 50 kHz, so a bucket is 42 samples."""
    with run_folder("demo", tmp_path / "a.mcap", 12.0) as (folder, _):
        RunDescription.of(checked_experiment(CONFIGS / "demo.yaml", [])).write(folder.description)
        ring = SampleRing.create(folder.ring, slots=512, block=BLOCK, state_size=1)
        ring.page.put(PageField.PHASE, Phase.RUNNING)
        yield folder, ring


def exchange(ring, blocks, spike=None):
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
            ring.release(keep=500)


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


def test_what_was_not_asked_for_in_time_is_left_out(run):
    """The newest count: who looks on late must not get the old first."""
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


def test_diagnostics_have_the_form_that_the_panels_know(run):
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
    # 499.9 A in the last sample, where 7 are allowed.
    assert parts["limit: command"]["level"] == 2


def fields_of(topic):
    """Return the fields of a topic that there is, live or in a recording."""
    name = {**TOPICS, **MESSAGES}[topic]
    return {field.name for field in message_class(name).DESCRIPTOR.fields}


def test_layouts_for_foxglove_name_what_there_is():
    layout = json.loads((CONFIGS / "layouts" / "foxglove.json").read_text())
    panels = layout["configById"]
    paths = re.findall(r'"(/[a-z_]+)\.([a-z_0-9]+)', json.dumps(panels))
    assert len(paths) >= 8
    for topic, field in paths:
        assert field in fields_of(topic)
    topics = set(re.findall(r'"(/[a-z_]+)["\.]', json.dumps(panels)))
    assert topics <= {DIAGNOSTICS, *MESSAGES}
    # Of a recording it shows as much as there is: the page is not to be empty.
    assert {"/scope", "/events"} <= topics & TOPICS.keys()
    shown = re.findall(r'"([A-Za-z]+![a-z]+)"', json.dumps(layout["layout"]))
    assert sorted(shown) == sorted(panels)


def test_the_layout_for_plotjuggler_names_what_there_is():
    tree = ET.parse(CONFIGS / "layouts" / "plotjuggler.xml")
    made = {snippet.get("name") for snippet in tree.iter("snippet")}
    names = {text for snippet in tree.iter("snippet") for text in sources(snippet)}
    for curve in tree.iter("curve"):
        pair = [curve.get("curve_x"), curve.get("curve_y")]
        names.update(pair if all(pair) else [curve.get("name")])
    for name in names - made:
        _, topic, field = name.split("/")
        assert field in fields_of(f"/{topic}")
        assert f"/{topic}" in TOPICS  # so that it opens a recording too
    assert len(names) > 6


def sources(snippet):
    """Return the series that a computed one is made of."""
    return [each.text for each in snippet.iter() if re.fullmatch("linked_source|v[0-9]+", each.tag)]
