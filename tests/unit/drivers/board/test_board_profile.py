"""Profiles of boards: channels that fit their type, and streams that fit their messages."""

from typing import Any

import pytest
from pydantic import ValidationError

from hilctl_drivers.board.board_profile import FrameChannel, FrameProfile
from hilctl_drivers.profile import load_profile


def changed(name: str, **changes: Any) -> FrameProfile:
    """Return a shipped profile with other values, all rules asked again."""
    plain = load_profile(name).model_dump()
    for key, value in changes.items():
        part, _, rest = key.partition("__")
        if rest:
            plain[part] = {**plain[part], rest: value}
        else:
            plain[part] = value
    return FrameProfile.model_validate(plain)


def test_shipped_boards_are_sound():
    assert changed("cobs_board").exchange == "single"
    assert changed("cobs_board_fifo").exchange == "stream"


@pytest.mark.parametrize(
    ("name", "changes", "said"),
    [
        ("cobs_board", {"exchange": "stream"}, "streaming and exchange: stream go together"),
        ("cobs_board_fifo", {"streaming": "none"}, "streaming and exchange: stream go together"),
        ("cobs_board_fifo", {"streaming__fifo_depth": 2}, "block_max must be <= streaming.fifo"),
        ("cobs_board_fifo", {"link__payload_max": 64}, "samples need .* link.payload_max is 64"),
    ],
)
def test_what_does_not_go_together_is_refused(name, changes, said):
    with pytest.raises(ValidationError, match=said):
        changed(name, **changes)


def test_range_is_inside_the_type():
    """Half a code more is rounded to the last one; a whole code more is refused."""
    dac = {"type": "int16", "unit": "V", "scale": 0.001, "min": -32.768}
    assert FrameChannel(**dac, max=32.7674).format.size == 2
    with pytest.raises(ValidationError, match="int16 holds"):
        FrameChannel(**dac, max=32.768)
