"""Fields of the recording messages: their units, and what other readers make of them."""

from dataclasses import replace

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from hilctl.base.events import Event
from hilctl.base.samples import BlockBatch, BlockHeader
from hilctl.recording.encoder import MessageMaker, RecordingLayout
from hilctl.recording.reader import read
from tests.unit.recording.conftest import same_samples, written


def test_blocks_of_one_sample_are_the_same_message(make):
    whole = make.batch(0, 1)
    size = whole.flags.shape[1]
    heads = np.repeat(whole.heads, size, axis=0)
    heads[:, BlockHeader.FIRST_SAMPLE], heads[:, BlockHeader.SAMPLES] = np.arange(size), 1
    columns = np.ascontiguousarray(whole.columns[0].T[:, :, np.newaxis])
    whole = replace(whole, aux=np.empty((1, 0)))
    states, aux = np.repeat(whole.states, size, axis=0), np.empty((size, 0))
    ones = BlockBatch(heads, states, columns, whole.flags.T.copy(), aux)
    layout = RecordingLayout(50_000.0, "A", True, 1000.0, 1_800_000_000 * 10**9, True)
    block, other = (next(iter(MessageMaker(layout).batch(each))) for each in (whole, ones))
    assert block.topic == "/samples"
    assert block == other


@pytest.mark.parametrize("unit", ["A", "V"])
def test_reference_that_is_no_displacement_is_not_recorded(tmp_path, make, unit):
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


def test_scope_is_on_a_grid_of_its_own(recorded):
    path, _ = recorded
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        picked = [d.sample for *_, d in reader.iter_decoded_messages(topics=["/scope"])]
    assert picked == [*range(0, 1700, 50), *range(1900, 2050, 50)]


def test_voltage_devices_have_voltage_fields(tmp_path, make):
    one = make.batch(0, 2)
    path = written(tmp_path / "run.mcap", [one], unit="V", measures=False, own_input=False)
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        decoded = next(d for *_, d in reader.iter_decoded_messages(topics=["/samples"]))
    assert len(decoded.drive_v) == 2 * make.block
    assert len(decoded.current_a) == len(decoded.measured_a) == len(decoded.measured_v) == 0
    back = read(path)
    assert back.command_unit == "V"
    assert np.array_equal(back.samples.command, one.samples().command)
