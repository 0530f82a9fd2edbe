"""A time range of a run: the same as a part of the whole, with less memory."""

import io
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilctl.analysis.report import summarize
from hilctl.base.errors import DataError
from hilctl.base.segments import Segment
from hilctl.recording import reader
from hilctl.recording.mcap_records import ReadBudget
from hilctl.recording.reader import read
from hilctl.recording.time_range import TimeRange, places_of
from tests.unit.recording.conftest import same_samples, same_ticks, written

GOLDEN = Path(__file__).parents[3] / "recordings" / "golden" / "terfenol_compensated.mcap"


@pytest.mark.parametrize(("from_s", "to_s", "first", "last"), [
    (None, None, 0, 6149),
    (0.01, None, 500, 6149),
    (None, 0.01, 0, 499),
    (0.00101, 0.00201, 51, 100),
    (0.03, 99.0, 1500, 6149),
    (-5.0, 1 / 50_000, 0, 0),
    (-1e308, 1e308, 0, 6149),
])  # fmt: skip
def test_range_is_cut_at_the_times_of_the_samples(from_s, to_s, first, last):
    part = read(GOLDEN, TimeRange(from_s, to_s))
    assert (part.samples.index[0], part.samples.index[-1]) == (first, last)
    assert {values.size for values in part.samples.columns().values()} <= {0, last + 1 - first}
    ticks = part.ticks.first_sample
    assert ticks.size == part.ticks.late_ns.size
    assert ((ticks >= first) & (ticks <= last)).all()
    whole = read(GOLDEN).samples.part(first, last + 1)
    assert part.samples.displacement_um.tobytes() == whole.displacement_um.tobytes()


@pytest.mark.parametrize(
    ("from_s", "to_s"), [(0.02, 0.01), (5.0, None), (None, -1e308), (1e308, None), (np.nan, None)]
)
def test_no_sample_between_the_times_is_an_error(from_s, to_s):
    with pytest.raises(DataError, match=r"sample|finite"):
        read(GOLDEN, TimeRange(from_s, to_s))


def test_blocks_outside_the_range_are_not_kept(monkeypatch):
    kept = []

    class Counting(ReadBudget):
        def keep(self, size):
            kept.append(size)
            super().keep(size)

    monkeypatch.setattr("hilctl.recording.recovery_scan.ReadBudget", Counting)
    read(GOLDEN)
    whole = sum(kept)
    del kept[:]
    read(GOLDEN, TimeRange(0.05, 0.06))
    assert sum(kept) < whole / 4


def test_figures_of_a_stretch_are_those_of_its_steady_cycles():
    whole, part = read(GOLDEN), read(GOLDEN, TimeRange(0.05, 0.0951))
    (one,) = part.segments
    assert (one.start, one.steady_start, one.steady_stop, one.stop) == (0, 2500, 4755, 4755)
    report = summarize(part)
    by_hand = replace(whole, segments=(replace(whole.segments[0], steady_stop=4755),))
    assert report.peak_hysteresis_percent == summarize(by_hand).peak_hysteresis_percent
    assert report.complete
    assert (report.dropped, report.skipped_ticks) == (0, None)
    assert report.reason == summarize(whole).reason


def test_segments_are_cut_and_keep_their_phase():
    segments = tuple(
        Segment(str(k), start, start + 1000, start + 100, start + 900, 100.0)
        for k, start in enumerate(range(0, 4000, 1000))
    )
    recording = replace(read(GOLDEN), segments=segments)
    cut = TimeRange(0.0205, 0.041).cut(recording).segments  # samples 1025 to 2049
    assert [(s.start, s.steady_start, s.steady_stop, s.stop) for s in cut] == [
        (1000, 1100, 1900, 2000),
        (2000, 2050, 2050, 2050),
    ]


def test_gaps_count_within_it_only():
    recording = read(GOLDEN)
    gap = recording.samples.rows(
        (recording.samples.index < 1000) | (recording.samples.index > 1009)
    )
    recording = replace(recording, samples=gap)
    assert TimeRange(0.01, 0.03).cut(recording).dropped == 10
    assert TimeRange(0.03, 0.04).cut(recording).dropped == 0
    assert str(TimeRange(None, 0.5)) == "its start to 0.5 s"


@pytest.fixture
def recorded(tmp_path, make):
    """Forty chunks of 200 samples, 4 ms each, a gap of 20 ms in the middle."""
    batches = [
        make.batch(200 * k + (1000 if k >= 20 else 0), 4, dropped=1000 if k == 20 else 0, seed=k)
        for k in range(40)
    ]
    return written(tmp_path / "run.mcap", batches, events=[make.ended])


STRETCHES = [
    TimeRange(0.0, 0.004), TimeRange(0.00399, 0.00401), TimeRange(0.0301, 0.0302),
    TimeRange(None, 0.02),
    TimeRange(0.1, None), TimeRange(0.07, 0.11), TimeRange(0.016, 0.02),
]  # fmt: skip


@pytest.mark.parametrize("stretch", STRETCHES, ids=str)
def test_index_and_scan_give_the_same(monkeypatch, recorded, stretch):
    found = read(recorded, stretch)
    monkeypatch.setattr(reader, "places_of", lambda stream, stretch: None)
    whole = read(recorded, stretch)
    same_samples(found.samples, whole.samples)
    same_ticks(found.ticks, whole.ticks)
    assert [start.sample for start in found.starts] == [start.sample for start in whole.starts]
    names = ("run", "end", "segments", "events", "dropped", "experiment_yaml", "model_yaml")
    assert all(getattr(found, name) == getattr(whole, name) for name in names)


def test_bytes_outside_the_range_are_not_read(recorded):
    with recorded.open("rb") as stream:
        everything = places_of(stream, TimeRange(None, None))
        few = places_of(stream, TimeRange(0.05, 0.0501))
    assert len(everything) > 40
    assert len(few) < 12
    assert set(few) < set(everything)


def test_damage_is_reported_within_the_range_only(recorded, caplog):
    data = bytearray(recorded.read_bytes())
    with recorded.open("rb") as stream:
        at = places_of(stream, TimeRange(None, None))
        within = places_of(stream, TimeRange(0.05, 0.0501))
    elsewhere = next(place for place in at[5:] if place not in within)
    data[elsewhere + 300] ^= 1
    recorded.write_bytes(data)
    assert read(recorded, TimeRange(0.05, 0.0501)).samples.index.tolist() == list(range(2500, 2505))
    assert not caplog.records
    data[within[5] + 300] ^= 1
    recorded.write_bytes(data)
    read(recorded, TimeRange(0.04, 0.07))
    assert "damaged record" in caplog.text


@pytest.mark.parametrize("change", ["cut", "crc", "footer", "magic", "far"])
def test_file_without_an_intact_index_is_scanned(recorded, change):
    data = bytearray(recorded.read_bytes())
    if change == "cut":
        del data[-50:]
    elif change == "crc":
        data[-200] ^= 1
    elif change == "magic":
        data[-1] ^= 1
    elif change == "far":
        data[-28:-20] = struct.pack("<Q", 2**62)
    else:
        data[-37] = 0x77
    assert places_of(io.BytesIO(bytes(data)), TimeRange(0.05, 0.06)) is None
    assert places_of(io.BytesIO(bytes(data[:20])), TimeRange(0.05, 0.06)) is None
    expected = read(recorded, TimeRange(0.05, 0.06)).samples.index
    recorded.write_bytes(data)
    assert np.array_equal(read(recorded, TimeRange(0.05, 0.06)).samples.index, expected)


def test_range_without_samples_is_refused(recorded):
    with pytest.raises(DataError, match="from 5 s"):
        read(recorded, TimeRange(5.0, None))
