"""Recordings: what is written is read back, by our reader and by independent ones."""

import io
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra.numpy import arrays
from hypothesis.strategies import floats

from hilctl.base.errors import DataError
from hilctl.base.events import Event
from hilctl.base.samples import COLUMNS, BlockHeader
from hilctl.recording.reader import read
from tests.unit.recording.conftest import same_samples, written


def test_everything_comes_back(recorded, make):
    path, batches = recorded
    back = read(path)
    same_samples(back.samples, make.samples(batches))
    assert back.samples.index.tolist() == [*range(1700), *range(1900, 2050)]
    assert back.dropped == 200
    for name in ("first_sample", "deadline_ns", "late_ns", "exchange_ns"):
        heads = np.concatenate([b.heads[:, BlockHeader[name.upper()]] for b in batches])
        assert np.array_equal(getattr(back.ticks, name), heads), name
    assert back.events == (make.ended,)
    assert back.segments == (make.segment,)
    assert (back.experiment_yaml, back.model_yaml) == ("name: x\n", "model: y\n")
    assert back.end["recorded_samples"] == "1850"
    assert back.end["missing_samples"] == "200"
    assert back.compensated


@pytest.mark.parametrize("unit", ["A", "V"])
@pytest.mark.parametrize("measures", [True, False])
@pytest.mark.parametrize("own_input", [True, False])
@settings(max_examples=10, deadline=None)
@given(values=arrays(np.float64, (3, len(COLUMNS), 50), elements=floats()))
def test_what_is_written_is_read(make, unit, measures, own_input, values):
    one = make.batch(0, 3)
    one.columns[:] = values
    written = one.samples()
    stop = Event(20, "error", "stroke", "text", before=written.part(10, 21))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        with path.open("wb") as stream:
            make.write(
                stream, [one], unit=unit, measures=measures, own_input=own_input, events=[stop]
            )
        back = read(path)
    expected = replace(
        written,
        measured=written.measured if measures else np.empty(0),
        input_um=written.input_um if own_input else written.reference_um,
    )
    same_samples(back.samples, expected)
    same_samples(back.events[0].before, expected.part(10, 21))


def test_samples_lost_at_the_very_end_are_counted(tmp_path, make):
    path = written(tmp_path / "run.mcap", [make.batch(0, 4)], ended_at=350)
    assert read(path).dropped == 150


def test_cut_short_file_gives_what_it_holds(tmp_path, make):
    path = tmp_path / "run.mcap"
    batches = [make.batch(200 * i, 4, seed=i) for i in range(10)]
    stream = io.BytesIO()
    make.write(stream, batches)
    whole = stream.getvalue()
    path.write_bytes(whole)
    full = read(path).samples
    sizes = set()
    for end in range(len(whole) - 1, 2000, -997):
        path.write_bytes(whole[:end])
        part = read(path)
        n = part.samples.index.size
        sizes.add(n)
        assert np.array_equal(part.samples.command, full.command[:n])
        assert not part.end or end > whole.index(b"hilctl.end")
    assert sizes >= {200, 1000, 2000}


@pytest.mark.parametrize("content", [b"", b"hello", bytes(5000), b"\x89MCAP0\r\n", b"\xff" * 99])
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"x\.mcap"):
        read(path)
    with pytest.raises(DataError, match="no such file"):
        read(tmp_path / "y.mcap")
