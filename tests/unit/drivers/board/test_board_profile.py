"""Profiles of boards: the edge of a channel's type. ``test_profile.py`` breaks all their rules."""

import pytest
from pydantic import ValidationError

from hilctl_drivers.board.board_profile import FrameChannel


def test_range_is_inside_the_type():
    dac = {"type": "int16", "unit": "V", "scale": 0.001, "min": -32.768}
    assert FrameChannel(**dac, max=32.7674).format.size == 2
    with pytest.raises(ValidationError, match="int16 holds"):
        FrameChannel(**dac, max=32.768)
