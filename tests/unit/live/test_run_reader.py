"""Readers of active runs."""

import json
import struct
from types import SimpleNamespace

import numpy as np
import pytest

from hilctl.base.errors import InputError, RunError
from hilctl.base.events import Event
from hilctl.base.segments import Segment
from hilctl.live.run_reader import (
    RunList,
    RunReader,
    frame_of,
    frames_of,
    nearest_window_s,
    path_of,
)
from hilctl.live.scope import ROW, SIGNALS, Buckets, Scope, ScopeWindow
from hilctl.loop.safe_output import LoopOutcome
from hilctl.run.metadata import RunDescription
from hilctl.run.run_folder import run_folder
from hilctl.run.shared.shared_page import PageField, Stop
from hilctl.run.start import checked_experiment, checked_run
from tests.fakes import SteppingClock
from tests.unit.live.conftest import (
    BLOCK,
    CONFIGS,
    active_axes,
    active_run,
    begun,
    exchange,
    first,
    traces,
)


@pytest.fixture
def run(description, tmp_path):
    """An active run: its reader and its ring."""
    with active_run(description, tmp_path, 128) as (folder, ring):
        ring.page.put(PageField.WAVEFORM_AT, 100)
        yield RunReader(folder), ring


def test_auxiliary_channels(tmp_path):
    settings = ["device.temperatures={}", "limits.aux={coil_c: 18, rod_c: [4, 14]}"]
    description = RunDescription.of(checked_experiment(CONFIGS / "demo.yaml", settings))
    with active_run(description, tmp_path, 16) as (folder, ring):
        feed = RunReader(folder)
        exchange(ring, range(10))
        feed.poll(1.0)
        status, frame = feed.status(), next(frames_of(feed, 1.0, 0.02, lambda: 0.0, print))
    found = [(each["name"], each["unit"], each["value"]) for each in status["aux"]]
    assert found == [("coil_c", "°C", 9.0), ("rod_c", "°C", 9.0)]
    used = {each["name"]: each["used"] for each in status["gauges"]}
    assert (used["coil_c"], used["rod_c"]) == pytest.approx((0.5, 1.8))
    assert np.nanmax(frame.high["coil_c"]) == 9.0


def test_samples_are_read_without_consuming_them(run):
    feed, ring = run
    exchange(ring, range(80), spike_um=9.0)
    assert feed.poll(1.0)
    assert not feed.poll(1.03)
    assert ring.page.get(PageField.TAIL) == 0
    high = feed.scope.rolling(2.0).buckets.high[ROW["error"]]
    assert np.nanmax(high) == pytest.approx(9.0)
    assert feed.status()["t_s"] == 80 * BLOCK / 50000.0
    assert feed.scope.segment.start == 100


def test_overwritten_samples_are_counted(run):
    feed, ring = run
    exchange(ring, range(2))
    feed.poll(1.0)
    exchange(ring, range(2, 60))
    ring.pop()
    ring.release(keep=10)
    feed.poll(1.03)
    assert feed.missed == 48 * BLOCK


def test_events_are_read_once_in_order(run):
    feed, ring = run
    for number in range(40):
        ring.page.push_event(Event(number, "info", f"e{number}", ""))
    ring.page.leave_note(Event(50, "info", "mark", "tapped"))
    feed.poll(1.0)
    feed.poll(1.1)
    assert [event.code for event in feed.events] == [*(f"e{n}" for n in range(32)), "mark"]


def test_status_is_json(run):
    feed, ring = run
    exchange(ring, range(100))
    feed.poll(1.0)
    status = json.loads(json.dumps(feed.status(), allow_nan=False))
    assert (status["state"], status["gain"], status["missed_samples"]) == ("running", 1.0, 0)
    assert {gauge["name"] for gauge in status["gauges"]} >= {"command", "slew", "displacement"}
    assert sum(status["lateness_counts"]) == 100
    ring.page.put(PageField.STOP, Stop.REQUEST)
    assert feed.state == "stopping"
    ring.page.leave_outcome(LoopOutcome("stopped", "by hilctl stop", 5000, "confirmed"))
    assert feed.status()["reason"] == "by hilctl stop"
    assert feed.state == "stopped"


def test_end_of_a_run_keeps_its_data(description, tmp_path):
    with active_run(description, tmp_path) as (folder, ring):
        feed = RunReader(folder)
        exchange(ring, range(3))
        feed.poll(1.0)
        assert not feed.ended
    feed.poll(2.0)
    assert (feed.ended, feed.state) == (True, "ended")
    assert feed.status()["t_s"] == 3 * BLOCK / 50000.0


def test_unreadable_run_is_an_error(tmp_path):
    with (
        run_folder("demo", {"": tmp_path / "a.mcap"}, 12.0) as (folder, _),
        pytest.raises(RunError),
    ):
        RunReader(folder)


def test_state_of_the_inverse(run):
    feed, ring = run
    assert feed.inverse == "in"
    ring.page.put(PageField.TUNE_NUMBER, 1)
    assert feed.status()["inverse"] == "out"
    ring.page.put_float(PageField.TUNE_INVERSE_SHARE, 1.0)
    assert feed.inverse == "in"
    feed.description = feed.description.model_copy(update={"compensator": ""})
    assert feed.inverse is None


def test_events_since(run):
    (feed, ring), seen = run, 0
    for number in range(100):
        ring.page.leave_note(Event(number, "info", "mark", ""))
        feed.poll(float(number))
        events, seen = feed.events_since(seen)
        assert [event.sample for event in events] == [number]
    assert seen == 100
    assert [event.sample for event in feed.events_since(10)[0]] == list(range(40, 100))
    assert feed.events_since(100) == ([], 100)


def test_run_is_listed_until_it_has_ended_and_is_not_shown(description, tmp_path):
    feeds = RunList(first)
    feeds.update(0.0)
    assert feeds.feed(None) is None
    with run_folder("demo", {"": tmp_path / "a.mcap"}, 12.0) as (folder, _):
        begun(folder, description)
        feeds.update(0.5)
        assert feeds.feed(None) is None  # runs are looked for once a second
        feeds.update(1.0)
        feed = feeds.feed(folder.card.name)
        assert feed is feeds.feed(None)
        assert list(feeds) == [feed]
    feed.poll(1.0)
    assert feed.ended
    feeds.update(2.0, [None])
    assert list(feeds) == [feed]  # the main run stays until there is another
    with run_folder("other", {"": tmp_path / "b.mcap"}, 12.0) as (folder, _):
        begun(folder, description)
        feeds.update(3.0)
        assert feeds.feed(None) is feeds.feed(folder.card.name)
        feeds.update(4.0)
        assert [each.folder for each in feeds] == [folder]


def test_starting_run_is_read_again(description, tmp_path):
    feeds = RunList(first)
    with run_folder("demo", {"": tmp_path / "a.mcap"}, 12.0) as (folder, _):
        feeds.update(0.0)
        assert feeds.feed(None) is None
        begun(folder, description)
        assert feeds.feed(None).folder == folder


@pytest.fixture
def scope():
    made = Scope(1000.0, [Segment("sine", 0, 9000, 0, 9000, 50.0)], "reference")
    made.add(traces(0, **dict.fromkeys(ROW.keys() - {"measured"}, np.arange(600.0))))
    return made


def decoded(frame):
    (size,) = struct.unpack_from("<I", frame)
    header = json.loads(frame[4 : 4 + size])
    values = np.frombuffer(frame, "<f4", offset=4 + size)
    n, rows = header["n"], header["signals"] * header["n"]
    low, high = values[n : n + rows], values[n + rows : n + 2 * rows]
    end = n + 2 * rows
    loops = values[end : end + 2 * header["loop"]].reshape(2, header["loop"])
    assert values.size == end + loops.size + 4 * header["path"]
    return header, values[:n], low.reshape(-1, n), high.reshape(-1, n), loops


def test_a_frame_holds_the_window_and_the_loops(scope):
    frame = frame_of(scope, "cycle", 2.0)
    header, t_s, low, high, loops = decoded(frame)
    assert header == {"mode": "cycle", "n": 100, "signals": 6, "loop": 300, "cycle": 50, "path": 0}
    assert t_s == pytest.approx(np.arange(100) / 1000.0)
    assert low[ROW["error"]].tolist() == high[ROW["error"]].tolist() == list(range(500, 600))
    assert np.isnan(low[ROW["measured"]]).all()
    assert loops[0].tolist() == list(range(300, 600))
    assert len(frame) % 4 == 0


def test_frame_without_a_cycle_rolls(scope):
    header, t_s, *_ = decoded(frame_of(scope, "roll", 0.1))
    assert (header["mode"], t_s[-1], t_s.size) == ("roll", 0.0, 100)
    empty = Scope(1000.0, [], "reference")
    assert decoded(frame_of(empty, "cycle", 0.1))[0]["mode"] == "roll"


def test_nearest_window():
    assert [nearest_window_s(wanted_s) for wanted_s in (2, 1e9, 1e-9, 3)] == [2, 600, 0.02, 2]


@pytest.fixture
def feed():
    """A run that ends at its fourth poll, with one event per poll."""
    values = np.arange(3.0 * len(SIGNALS)).reshape(len(SIGNALS), 3)
    looked = []
    made = SimpleNamespace(ended=False, looked=looked, windows=[], signals=SIGNALS)

    def poll(now_s):
        looked.append(now_s)
        made.ended = len(looked) == 4

    def rolling(window_s):
        made.windows.append(window_s)
        return ScopeWindow(np.array([-2.0, -1.0, 0.0]), Buckets(values, values + 1.0, values))

    made.poll, made.scope = poll, SimpleNamespace(rolling=rolling)

    def events_since(seen):
        return [Event(k, "info", "mark", "") for k in range(seen, len(looked))], len(looked)

    made.status, made.events_since = lambda: {"t_s": looked[-1]}, events_since
    return made


def test_frames_keep_their_interval_until_the_run_ends(feed):
    clock, slept = SteppingClock(), []

    def sleep(seconds):
        slept.append(seconds)
        clock.now += seconds

    frames = []
    for frame in frames_of(feed, 0.25, 0.4, clock, sleep):
        frames.append(frame)
        clock.now += 0.1 if len(frames) != 2 else 1.0
    assert feed.looked == pytest.approx([0.0, 0.25, 1.25, 1.5])
    assert slept == pytest.approx([0.15, 0.0, 0.15])
    assert [[event.sample for event in frame.events] for frame in frames] == [[0], [1], [2], [3]]
    assert {*feed.windows} == {0.5}
    assert frames[0].low["displacement"].tolist() == [3.0, 4.0, 5.0]
    assert frames[0].high["displacement"].tolist() == [4.0, 5.0, 6.0]


def test_a_reader_has_the_samples_of_its_axis_and_the_state_of_the_run(description, tmp_path):
    with active_axes(description, tmp_path) as (folder, (x, y)):
        feed = RunReader(folder, "y")
        y.page.put(PageField.TUNE_NUMBER, 1)
        y.page.put_float(PageField.TUNE_GAIN, 0.5)
        y.page.push_event(Event(7, "info", "tuned", "of y"))
        x.page.put(PageField.LATE_TICKS, 3)
        x.page.put(PageField.START_NS, 12)
        exchange(y, range(4), spike_um=5.0)
        feed.poll(1.0)
        status = feed.status()
        assert (status["axis"], status["axes"]) == ("y", ["x", "y"])
        assert status["recording"] == str(tmp_path / "a.y.mcap")
        assert (status["gain"], status["late_ticks"], feed.start_ns) == (0.5, 3, 12)
        assert [event.text for event in feed.events] == ["of y"]
        assert status["t_s"] == pytest.approx(200 / 50e3)
        assert RunReader(folder).axis == "x"
        with pytest.raises(InputError, match=r"'z'.*x, y"):
            RunReader(folder, "z")


def test_keys_of_an_axis_are_those_that_set_it():
    run = checked_run(CONFIGS / "stage_xy.yaml", ["axes.y.waveform.amplitude=20"])
    rows = {row.key: row.value for row in RunDescription.of(run.axes[1]).settings}
    assert rows["sample_rate_hz"] == "50000"
    assert rows["axes.y.waveform.amplitude"] == "20"
    assert rows["axes.y.device.seed"] == "2"
    assert not {"device.seed", "axes.y.sample_rate_hz"} & rows.keys()


def test_a_list_has_a_reader_per_axis(description, tmp_path):
    feeds = RunList(first)
    with active_axes(description, tmp_path) as (folder, _):
        feeds.update(0.0)
        assert [each.axis for each in feeds.axes(None)] == ["x", "y"]
        assert [*feeds] == feeds.axes(folder.card.name)
        wanted = [feeds.feed(None, axis).axis for axis in ("y", "x", "z", None)]
        assert wanted == ["y", "x", "x", "x"]


def test_a_path_is_of_the_same_samples(description, tmp_path):
    with active_axes(description, tmp_path, 512) as (folder, rings):
        feeds = [RunReader(folder, axis) for axis in "xy"]
        for ring, feed, blocks in zip(rings, feeds, (400, 380), strict=True):
            exchange(ring, range(blocks))
            feed.poll(1.0)
        path = path_of([each.scope for each in feeds], 0.5, 50e3)
        assert np.array_equal(path[:2], path[2:], equal_nan=True)
        newest = path[:, ~np.isnan(path[0])]
        assert 380 * 50 - 20 < newest[0, -1] <= 380 * 50
        assert set(np.diff(newest[0])) == {9.0}  # 0.1 s in 600 buckets
        header, *_ = decoded(frame_of(feeds[0].scope, "roll", 0.5, path))
        assert header["path"] == path.shape[1]


def test_peak_error_is_that_since_the_last_reset(run):
    feed, ring = run
    exchange(ring, range(4), spike_um=5.0)
    feed.poll(1.0)
    assert feed.status()["peak_error"] == {"um": 5.0, "since_s": 0.0}
    feed.reset_peak()
    exchange(ring, range(4, 6), spike_um=-2.0)
    feed.poll(2.0)
    assert feed.status()["peak_error"] == {"um": 2.0, "since_s": 200 / 50e3}
