"""A run seen from outside, through its folder."""

import json
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import RunError
from hilctl.base.events import Event
from hilctl.base.samples import BlockBatch, BlockHeader
from hilctl.live.run_reader import EDGES_US, LatenessCounts, LiveErrorSpectrum, RunReader
from hilctl.live.signals import ROW, SIGNALS, Traces
from hilctl.loop.safe_output import LoopOutcome
from hilctl.run.metadata import RunDescription
from hilctl.run.run_folder import run_folder
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import PageField, Phase, Stop
from hilctl.run.start import checked_experiment

DEMO = Path(__file__).parents[3] / "configs" / "demo.yaml"
BLOCK = 50


@pytest.fixture(scope="module")
def description():
    return RunDescription.of(checked_experiment(DEMO, []))


@pytest.fixture
def run(description, tmp_path):
    """A run's folder, and its ring as the loop has it."""
    with run_folder("demo", tmp_path / "a.mcap", 12.0) as (folder, _):
        description.write(folder.description)
        ring = SampleRing.create(folder.ring, slots=128, block=BLOCK, state_size=1)
        ring.page.put(PageField.WAVEFORM_AT, 100)
        ring.page.put(PageField.PHASE, Phase.RUNNING)
        yield folder, ring


def exchange(ring, blocks, spike=None):
    for number in blocks:
        block = ring.claim()
        index = number * BLOCK + np.arange(BLOCK)
        block.head[BlockHeader.FIRST_SAMPLE] = index[0]
        block.head[BlockHeader.LATE_NS] = 20_000
        block.flags[:] = 0
        block.reference[:] = block.input_um[:] = 40.0 * np.sin(2 * np.pi * (index - 100) / 1000.0)
        block.command[:] = block.wanted[:] = block.reference / 10.0
        ring.sending(block)
        block.displacement_um[:] = block.reference
        if number == spike:
            block.displacement_um[7] += 9.0
        ring.answered(block)


def test_what_the_loop_leaves_is_seen_and_nothing_is_taken(run):
    folder, ring = run
    feed = RunReader(folder)
    exchange(ring, range(80), spike=71)
    assert feed.poll(1.0)
    assert not feed.poll(1.03)
    assert ring.page.get(PageField.TAIL) == 0
    high = feed.scope.rolling(2.0).buckets.high[ROW["error"]]
    assert np.nanmax(high) == pytest.approx(9.0)
    assert feed.status()["t_s"] == 80 * BLOCK / 50000.0
    assert feed.scope.segment.start == 100


def test_what_is_gone_before_it_is_looked_at_is_counted(run):
    folder, ring = run
    feed = RunReader(folder)
    exchange(ring, range(2))
    feed.poll(1.0)
    exchange(ring, range(2, 60))
    ring.pop()
    ring.release(keep=10)
    feed.poll(1.03)
    assert feed.missed == 48 * BLOCK


def test_events_come_once_and_in_order(run):
    folder, ring = run
    feed = RunReader(folder)
    for number in range(40):
        ring.page.push_event(Event(number, "info", f"e{number}", ""))
    ring.page.leave_note(Event(50, "info", "mark", "tapped"))
    feed.poll(1.0)
    feed.poll(1.1)
    assert [event.code for event in feed.events] == [
        *(f"e{number}" for number in range(32)),
        "mark",
    ]


def test_status_is_json_and_says_where_the_run_stands(run):
    folder, ring = run
    feed = RunReader(folder)
    exchange(ring, range(100))
    feed.poll(1.0)
    status = json.loads(json.dumps(feed.status(), allow_nan=False))
    assert (status["state"], status["gain"], status["missed_samples"]) == ("running", 1.0, 0)
    assert {gauge["name"] for gauge in status["gauges"]} >= {"command", "slew", "displacement"}
    assert sum(status["lateness_counts"]) == 100
    ring.page.put(PageField.STOP, Stop.REQUEST)
    assert feed.state == "stopping"
    ring.page.leave_outcome(LoopOutcome("stopped", "by hilctl stop", 5000, "confirmed", 0))
    assert feed.status()["reason"] == "by hilctl stop"
    assert feed.state == "stopped"


def test_the_end_of_a_run_is_noticed_and_what_was_seen_stays(description, tmp_path):
    with run_folder("demo", tmp_path / "a.mcap", 12.0) as (folder, _):
        description.write(folder.description)
        ring = SampleRing.create(folder.ring, slots=16, block=BLOCK, state_size=1)
        ring.page.put(PageField.PHASE, Phase.RUNNING)
        feed = RunReader(folder)
        exchange(ring, range(3))
        feed.poll(1.0)
        assert not feed.ended
    feed.poll(2.0)
    assert (feed.ended, feed.state) == (True, "ended")
    assert feed.status()["t_s"] == 3 * BLOCK / 50000.0


def test_a_run_that_can_not_be_looked_at_is_said(tmp_path):
    with run_folder("demo", tmp_path / "a.mcap", 12.0) as (folder, _), pytest.raises(RunError):
        RunReader(folder)


def test_where_the_inverse_is_led_is_said(run):
    folder, ring = run
    feed = RunReader(folder)
    assert feed.inverse == "in"
    ring.page.put(PageField.TUNE_WANTED, 1)
    assert feed.status()["inverse"] == "out"
    ring.page.put_float(PageField.TUNE_INVERSE_SHARE, 1.0)
    assert feed.inverse == "in"
    feed.description = feed.description.model_copy(update={"compensator": ""})
    assert feed.inverse is None


def test_events_since_those_that_were_seen(run):
    """Each once, however many there have been; the oldest are not kept."""
    folder, ring = run
    feed, seen = RunReader(folder), 0
    for number in range(100):
        ring.page.leave_note(Event(number, "info", "mark", ""))
        feed.poll(float(number))
        events, seen = feed.events_since(seen)
        assert [event.sample for event in events] == [number]
    assert seen == 100
    assert [event.sample for event in feed.events_since(10)[0]] == list(range(40, 100))
    assert feed.events_since(100) == ([], 100)


def test_every_tick_is_counted_once_whatever_its_lateness():
    counts = LatenessCounts()
    assert counts.percentiles_us() == {}
    batch = BlockBatch.empty(5, 1, 1)
    batch.heads[:, BlockHeader.LATE_NS] = (-5, 0, 30_000, 30_000, 9_000_000_000)
    counts.add(batch)
    assert counts.counts.sum() == 5
    assert counts.counts[-1] == 1
    assert counts.counts[np.searchsorted(EDGES_US, 30.0) - 1] == 2
    assert counts.percentiles_us()["p50"] == 30.0
    assert counts.percentiles_us()["max"] == 9e6


def error(error_um, start=0):
    values = np.zeros((len(SIGNALS), error_um.size))
    values[ROW["error"]] = error_um
    index = np.arange(start, start + error_um.size)
    return Traces(index, values, np.zeros(error_um.size, dtype=np.uint32))


def test_a_line_is_as_high_as_its_sine_and_stands_at_its_frequency():
    spectrum = LiveErrorSpectrum(50000.0)
    t_s = np.arange(16384) / 50000.0
    spectrum.add(error(5.0 + 0.3 * np.sin(2 * np.pi * 1000.0 * t_s)))
    hz, um = spectrum.points()
    assert um.max() == pytest.approx(0.3, rel=0.1)
    assert hz[um.argmax()] == pytest.approx(1000.0, rel=0.05)


def test_no_points_before_there_are_samples_and_a_gap_begins_anew():
    spectrum = LiveErrorSpectrum(1000.0)
    assert spectrum.points()[0].size == 0
    spectrum.add(error(np.zeros(300)))
    assert spectrum.points()[0].size > 0
    spectrum.add(error(np.array([np.nan, 1.0])))
    assert spectrum.points()[0].size == 0
