"""The server of Foxglove's protocol, with a client of it and a run's folder behind it."""

import asyncio
import base64
import json
import logging
import struct
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from websockets.asyncio.client import connect

from hilctl.base.errors import InputError, RunError
from hilctl.base.samples import BlockHeader
from hilctl.live.foxglove_server import FoxgloveServer
from hilctl.run.metadata import RunDescription
from hilctl.run.run_folder import run_folder
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import PageField, Phase
from hilctl.run.start import checked_experiment

DEMO = Path(__file__).parents[3] / "configs" / "demo.yaml"


def test_logs_of_hilctl_are_what_they_were():
    """The library sets a level and a handler for all logs, and their warnings would be lost."""
    root = logging.getLogger()
    before = root.level, root.handlers[:]
    FoxgloveServer(first, port=0).run(lambda server: True)
    assert (root.level, root.handlers) == before


def test_clients_that_do_not_read_do_not_keep_it_from_ending(monkeypatch):
    monkeypatch.setattr("hilctl.live.foxglove_server._STOP_S", 0.01)
    server, go_on = FoxgloveServer(first, port=0), threading.Event()
    library, server._server = server._server, SimpleNamespace(stop=lambda: go_on.wait(60.0))
    server.run(lambda server: True)
    assert not go_on.is_set()
    go_on.set()
    library.stop()


def first(runs):
    return runs[0] if runs else None


def exchange(ring, number):
    block = ring.claim()
    block.head[BlockHeader.FIRST_SAMPLE] = number * 50
    block.flags[:] = 0
    block.reference[:] = block.command[:] = block.wanted[:] = number
    ring.sending(block)
    block.displacement_um[:] = np.sin(number)
    ring.answered(block)


@contextmanager
def serving(tmp_path):
    """Serve a run that goes on until the end; yield the address."""
    over = threading.Event()
    with run_folder("demo", tmp_path / "a.mcap", 12.0) as (folder, _):
        RunDescription.of(checked_experiment(DEMO, [])).write(folder.description)
        ring = SampleRing.create(folder.ring, slots=64, block=50, state_size=1)
        ring.page.put(PageField.PHASE, Phase.RUNNING)
        ring.page.put(PageField.START_NS, time.monotonic_ns())
        server, numbers = FoxgloveServer(first, port=0), iter(range(10**6))

        def sleep(seconds):
            exchange(ring, next(numbers))
            if ring.pop() is not None:
                ring.release(keep=8)
            over.wait(0.002)

        server._sleep = sleep
        thread = threading.Thread(target=server.run, args=(lambda _: over.is_set(),))
        thread.start()
        try:
            yield server.url
        finally:
            over.set()
            thread.join()


async def seen(url, topics, wanted):
    """Return the channels by their topics, and the messages of some of them."""
    async with connect(url, subprotocols=["foxglove.sdk.v1"], proxy=None) as connection:
        channels, found = {}, {topic: [] for topic in topics}
        async for raw in connection:
            if isinstance(raw, str):
                said = json.loads(raw)
                if said["op"] == "serverInfo":
                    assert said["capabilities"] == []  # nothing can be changed from there
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
    """Decode by nothing but what the server has said of the channel."""
    files = descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(channel["schema"]))
    pool = descriptor_pool.DescriptorPool()
    for each in files.file:
        pool.Add(each)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))
    return kind.FromString(data)


def test_a_client_decodes_all_by_the_schemas_that_it_is_given(tmp_path):
    with serving(tmp_path) as url:
        topics = ["/scope", "/scope_low", "/diagnostics"]
        channels, found = asyncio.run(asyncio.wait_for(seen(url, topics, 2), 20.0))
    assert set(channels) == {"/scope", "/scope_low", "/scope_high", "/events", "/diagnostics"}
    times = [time_ns for time_ns, _ in found["/scope"]]
    assert times == sorted(times)
    assert abs(times[0] * 1e-9 - time.time()) < 60.0
    for _, data in found["/scope"]:
        message = decode(channels["/scope"], data)
        assert message.current_a == message.sample * 42 // 42 // 50
        assert message.displacement_um == pytest.approx(np.sin(message.current_a))
    assert decode(channels["/events"], b"").DESCRIPTOR.full_name == "hilctl.Event"
    diagnostics = channels["/diagnostics"]
    assert (diagnostics["encoding"], diagnostics["schemaName"]) == (
        "json",
        "diagnostic_msgs/DiagnosticArray",
    )
    shown = json.loads(diagnostics["schema"])["properties"]
    assert json.loads(found["/diagnostics"][0][1]).keys() == shown.keys()


def test_a_port_that_is_taken_is_said():
    server = FoxgloveServer(first, port=0)
    try:
        with pytest.raises(RunError, match=r"port [0-9]+ of 127.0.0.1: .*in use"):
            FoxgloveServer(first, port=int(server.url.rpartition(":")[2]))
    finally:
        server.run(lambda _: True)


def test_without_its_library_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(InputError, match=r"pip install 'hilctl\[foxglove\]'"):
        FoxgloveServer(first, port=0)
