"""Recordings: what is written is read back, by our reader and by independent ones."""

import io

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from hilctl.base.errors import DataError
from hilctl.recording.data import Event
from hilctl.recording.reader import read


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
    expected = np.concatenate([b.columns.transpose(1, 0, 2).reshape(6, -1) for b in batches], 1)
    samples = back.samples
    columns = [samples.reference_um, samples.wanted, samples.command]
    columns += [samples.displacement_um, samples.measured, samples.input_um]
    for column, values in zip(columns, expected, strict=True):
        assert np.array_equal(column, values)
    assert samples.flags.tolist() == np.concatenate([b.flags.ravel() for b in batches]).tolist()
    assert samples.index.tolist() == [*range(1700), *range(1900, 2050)]
    assert back.dropped == 200
    assert back.ticks.late_ns.tolist() == np.concatenate([b.heads[:, 5] for b in batches]).tolist()
    assert back.events == (Event(make.start_ns + 5, 17, "info", "run_ended", "waveform completed"),)
    assert back.segments == (make.segment,)
    assert (back.experiment_yaml, back.model_yaml) == ("name: x\n", "model: y\n")
    assert back.end["recorded_samples"] == "1850"
    assert back.end["missing_samples"] == "200"
    assert back.compensated


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
    assert samples == [x for b in batches for x in b.columns[:, 3].ravel().tolist()]
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
    assert np.array_equal(back.samples.command, one.columns[:, 2].ravel())
    assert back.samples.measured.size == back.samples.input_um.size == 0


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
        assert not part.end or end > len(whole) - 5000
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
