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
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from hilctl.base.errors import DataError
from hilctl.base.events import Event
from hilctl.base.samples import COLUMNS, Head
from hilctl.recording import schema
from hilctl.recording.reader import read


def same_samples(found, expected):
    """Compare bytes, so that NaN equals NaN and -0.0 does not equal 0.0."""
    for name in ("index", *COLUMNS, "flags"):
        one, other = getattr(found, name), getattr(expected, name)
        assert (one.dtype, one.tobytes()) == (other.dtype, other.tobytes()), name


@pytest.fixture
def recorded(tmp_path, make):
    """A finished recording of three batches with a gap before the last."""
    batches = [
        make.batch(0, 4),
        make.batch(200, 30, seed=1),
        make.batch(1900, 3, dropped=200, seed=2),
    ]
    path = tmp_path / "run.mcap"
    with path.open("wb") as stream:
        make.write(stream, batches)
    return path, batches


def test_everything_comes_back(recorded, make):
    """Samples, ticks, events, facts, segments and attachments are read back as written."""
    path, batches = recorded
    back = read(path)
    same_samples(back.samples, make.samples(batches))
    assert back.samples.index.tolist() == [*range(1700), *range(1900, 2050)]
    assert back.dropped == 200
    for name in ("first_sample", "deadline_ns", "late_ns", "exchange_ns"):
        heads = np.concatenate([b.heads[:, Head[name.upper()]] for b in batches])
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
    """Bit for bit; what is left out is empty, but for an input that is the reference."""
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


@pytest.mark.parametrize("unit", ["A", "V"])
def test_reference_that_is_no_displacement_is_not_recorded(tmp_path, make, unit):
    """Where the waveform is a command, the columns in um say that there is none."""
    path, one = tmp_path / "run.mcap", make.batch(0, 3)
    trip = Event(20, "error", "late", "text", before=one.samples().part(10, 21))
    with path.open("wb") as stream:
        make.write(stream, [one], unit=unit, own_input=False, waveform_unit=unit, events=[trip])
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        scope = [d.reference_um for *_, d in reader.iter_decoded_messages(topics=["/scope"])]
    assert len(scope) == 3
    assert np.isnan(scope).all()
    back, nothing = read(path), np.full(150, np.nan)
    expected = replace(one.samples(), reference_um=nothing, input_um=nothing)
    same_samples(back.samples, expected)
    same_samples(back.events[0].before, expected.part(10, 21))


def test_field_numbers_stay():
    """Files that exist are read by these numbers; a new column takes new ones."""
    numbers = {
        message.name: {field.number: field.name for field in message.field}
        for message in schema.file_descriptor().message_type
    }
    assert {name: " ".join(each.values()) for name, each in numbers.items()} == {
        "SampleBlock": "tick0 n dropped t_rel reference_um wanted_a current_a displacement_um "
        "flags measured_a wanted_v drive_v measured_v state previous_command input_um",
        "TickBlock": "first_sample deadline_ns late_ns exchange_ns",
        "Sample": "sample t_rel reference_um wanted_a current_a displacement_um flags wanted_v "
        "drive_v",
        "Event": "sample level code text before_sample before_reference_um before_wanted_a "
        "before_current_a before_displacement_um before_flags before_wanted_v before_drive_v "
        "value_names values before_measured_a before_measured_v before_input_um",
    }
    assert list(numbers["SampleBlock"]) == list(range(1, 17))
    assert list(numbers["Sample"]) == list(range(1, 10))
    assert list(numbers["Event"]) == list(range(1, 18))


def test_event_has_its_numbers_and_its_time(tmp_path, make):
    """Values come back by name; an event of the loop has the time of its sample."""
    path = tmp_path / "run.mcap"
    values = {"gain": 1.5, "offset": -0.1, "samples": 250.0}
    with path.open("wb") as stream:
        make.write(stream, [], events=[Event(100, "info", "tuned", "text", values)])
    due_ns = make.start_ns + 100 * 20_000
    tuned = Event(100, "info", "tuned", "text", values, time_ns=due_ns)
    assert read(path).events == (tuned, make.ended)


def test_samples_lost_at_the_very_end_are_counted(tmp_path, make):
    """Where no later block can tell of a loss, the end does."""
    path = tmp_path / "run.mcap"
    with path.open("wb") as stream:
        make.write(stream, [make.batch(0, 4)], ended_at=350)
    assert read(path).dropped == 150


def test_replay_can_start_first_and_after_each_gap(recorded):
    """The compensator's memory stands with the first block and with the one after a gap."""
    path, batches = recorded
    starts = read(path).starts
    assert [start.sample for start in starts] == [0, 1900]
    assert starts[1].state.tolist() == batches[2].states[0, :-1].tolist()
    assert starts[1].previous_command == batches[2].states[0, -1]


def test_independent_reader_agrees(recorded, make):
    """The stock MCAP reader, indexed and with CRCs, decodes the same by the file's own schema."""
    path, batches = recorded
    counts, samples = {}, []
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        header = reader.get_header()
        names = [m.name for m in reader.iter_metadata()]
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
            assert schema.name.startswith("hilctl.")
            assert message.sequence == counts[channel.topic] - 1
            if channel.topic == "/samples":
                assert message.log_time == make.start_ns + decoded.tick0 * 20_000
                assert decoded.n == len(decoded.t_rel) == len(decoded.current_a)
                assert decoded.t_rel[0] == pytest.approx(decoded.tick0 / make.rate_hz)
                samples += list(decoded.displacement_um)
    assert header.library.startswith("hilctl ")
    assert names == ["hilctl.run", "hilctl.end"]
    assert samples == [x for b in batches for x in b.samples().displacement_um.tolist()]
    assert counts["/ticks"] == 3
    assert counts["/scope"] == 37  # every 50th of 1850 samples, the grid of absolute indices


def test_scope_is_on_a_grid_of_its_own(recorded):
    """Decimated samples are the ones whose index is a multiple of the stride, gap or not."""
    path, _ = recorded
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        picked = [d.sample for *_, d in reader.iter_decoded_messages(topics=["/scope"])]
    assert picked == [*range(0, 1700, 50), *range(1900, 2050, 50)]


def test_voltage_devices_have_voltage_fields(tmp_path, make):
    """Volts are recorded in fields that say V, and no ampere field is filled."""
    path = tmp_path / "run.mcap"
    one = make.batch(0, 2)
    with path.open("wb") as stream:
        make.write(stream, [one], unit="V", measures=False, own_input=False)
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        decoded = next(d for *_, d in reader.iter_decoded_messages(topics=["/samples"]))
    assert len(decoded.drive_v) == 2 * make.block
    assert len(decoded.current_a) == len(decoded.measured_a) == len(decoded.measured_v) == 0
    back = read(path)
    assert back.command_unit == "V"
    assert np.array_equal(back.samples.command, one.samples().command)


def test_cut_short_file_gives_what_it_holds(tmp_path, make):
    """A file cut anywhere after its start is read as far as it goes, and never wrongly."""
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
    """What is not a recording is refused with the file's name."""
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"x\.mcap"):
        read(path)
    with pytest.raises(DataError, match="no such file"):
        read(tmp_path / "y.mcap")
