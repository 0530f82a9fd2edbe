"""Profiles of sensors that send unasked: header fields. ``test_profile.py`` breaks other rules."""

import pytest
from pydantic import ValidationError

from hilctl_drivers.sensor_stream.stream_profile import StreamHeader


@pytest.mark.parametrize(
    "changes",
    [
        {"begin": "MEASURED"},
        {"frames": {"at": 3, "type": "uint16"}},
        {"counter": {"at": 1, "type": "uint32"}},
        {"frame_size": {"at": -1, "type": "uint16"}},
        {"counter": {"at": 0, "type": "int32"}},
    ],
)
def test_fields_are_in_the_header(changes):
    header = {"begin": "MEAS", "size": 4, "frame_size": 4}
    assert StreamHeader.model_validate(header).frames == 1
    with pytest.raises(ValidationError):
        StreamHeader.model_validate({**header, **changes})
