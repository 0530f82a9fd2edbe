"""A stretch by the index: what a walk over the whole file gives, without reading the rest."""

import io
import struct

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.base.samples import COLUMNS
from hilctl.recording import reader
from hilctl.recording.index import places_of
from hilctl.recording.reader import read
from hilctl.recording.recording import TICK_COLUMNS
from hilctl.recording.time_range import TimeRange


@pytest.fixture
def recorded(tmp_path, make):
    """Forty chunks of 200 samples, 4 ms each, a gap of 20 ms in the middle."""
    path = tmp_path / "run.mcap"
    batches = [
        make.batch(200 * k + (1000 if k >= 20 else 0), 4, dropped=1000 if k == 20 else 0, seed=k)
        for k in range(40)
    ]
    with path.open("wb") as stream:
        make.write(stream, batches, events=[make.ended])
    return path


STRETCHES = [
    TimeRange(0.0, 0.004), TimeRange(0.00399, 0.00401), TimeRange(0.0301, 0.0302),
    TimeRange(None, 0.02),
    TimeRange(0.1, None), TimeRange(0.07, 0.11), TimeRange(0.016, 0.02),
]  # fmt: skip


@pytest.mark.parametrize("stretch", STRETCHES, ids=str)
def test_the_index_gives_what_a_walk_gives(monkeypatch, recorded, stretch):
    """Samples, ticks, starts, events and facts of both ends."""
    found = read(recorded, stretch)
    monkeypatch.setattr(reader, "places_of", lambda stream, stretch: None)
    whole = read(recorded, stretch)
    for name in ("index", *COLUMNS, "flags"):
        assert getattr(found.samples, name).tobytes() == getattr(whole.samples, name).tobytes()
    for name in TICK_COLUMNS:
        assert getattr(found.ticks, name).tolist() == getattr(whole.ticks, name).tolist()
    assert [start.sample for start in found.starts] == [start.sample for start in whole.starts]
    names = ("run", "end", "segments", "events", "dropped", "experiment_yaml", "model_yaml")
    assert all(getattr(found, name) == getattr(whole, name) for name in names)


def test_the_rest_is_not_read(recorded):
    """Of forty chunks, those with the samples, their neighbours, and those with events."""
    with recorded.open("rb") as stream:
        everything = places_of(stream, TimeRange(None, None))
        few = places_of(stream, TimeRange(0.05, 0.0501))
    assert len(everything) > 40
    assert len(few) < 12
    assert set(few) < set(everything)


def test_damage_elsewhere_is_not_seen_and_damage_within_is_told(recorded, caplog):
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
    assert "damaged record at byte" in caplog.text


@pytest.mark.parametrize("change", ["cut", "crc", "footer", "magic", "far"])
def test_without_a_sound_index_the_file_is_walked_through(recorded, change):
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


def test_a_stretch_without_samples_is_refused(recorded):
    with pytest.raises(DataError, match="holds no sample from 5 s to its end"):
        read(recorded, TimeRange(5.0, None))
