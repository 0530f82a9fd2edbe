"""Field numbers stay, and an independent reader finds the schema in the file."""

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from hilctl.recording import schema


def test_field_numbers_stay():
    numbers = {
        message.name: {field.number: field.name for field in message.field}
        for message in schema.file_descriptor().message_type
    }
    assert {name: " ".join(each.values()) for name, each in numbers.items()} == {
        "SampleBlock": "tick0 n dropped t_rel reference_um wanted_a current_a displacement_um "
        "flags measured_a wanted_v drive_v measured_v state previous_command input_um "
        "reading_age_s reading_um aux",
        "TickBlock": "first_sample deadline_ns late_ns exchange_ns",
        "Sample": "sample t_rel reference_um wanted_a current_a displacement_um flags wanted_v "
        "drive_v",
        "Event": "sample level code text before_sample before_reference_um before_wanted_a "
        "before_current_a before_displacement_um before_flags before_wanted_v before_drive_v "
        "value_names values before_measured_a before_measured_v before_input_um "
        "before_reading_age_s before_reading_um",
    }
    assert list(numbers["SampleBlock"]) == list(range(1, 20))
    assert list(numbers["Sample"]) == list(range(1, 10))
    assert list(numbers["Event"]) == list(range(1, 20))


def test_independent_reader_agrees(recorded, make):
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
