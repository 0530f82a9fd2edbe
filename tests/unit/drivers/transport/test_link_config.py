"""Serial lines as profiles have them."""

import pytest

from hilctl_drivers.profile import load_profile


def test_lines_are_set_as_their_profiles_say():
    """Baud, characters, silence and levels; a line of text keeps its gap between commands."""
    settings = load_profile("tdk_lambda_gen").link.settings
    assert (settings.baud, settings.parity, settings.gap_s) == (9600, "N", 0.005)
    assert load_profile("adam_4024").link.settings.gap_s == pytest.approx(35 / 9600)
    assert load_profile("cobs_board").link.settings.dtr is True
