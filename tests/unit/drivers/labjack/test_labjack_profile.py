"""What a profile may say of streaming."""

import pytest

from hilctl.base.errors import ConfigError
from hilctl_drivers.profile import parse_profile, shipped_profiles


@pytest.fixture
def text():
    return shipped_profiles()["labjack_t7"].read_text(encoding="utf-8")


def test_rate_and_depth_follow_from_the_device_s_own_figures(text):
    """Two channels share the sample rate; a sample takes two bytes."""
    streaming = parse_profile(text, "here").streaming
    assert (streaming.fifo_depth, streaming.rate_max_hz) == (8192, 50_000.0)


@pytest.mark.parametrize(
    ("old", "new", "rule"),
    [
        ("buffer_bytes: 16384", "buffer_bytes: 16000", "buffer_bytes must be a power of 2"),
        ("buffer_bytes: 16384", "buffer_bytes: 16", "buffer_bytes"),
        ("outputs: [DAC0, DAC1]", "outputs: [DAC0, DAC7]", "streaming.outputs must be outputs"),
        ("inputs: [AIN0, ", "inputs: [AIN9, ", "streaming.inputs must be inputs"),
        ("kind: labjack\n", "kind: other\n", "kind"),
        ("calibration: two_slopes", "calibration: none", "calibration"),
    ],
)
def test_rules_are_told(text, old, new, rule):
    """Each broken rule names its key."""
    assert old in text
    with pytest.raises(ConfigError, match=rule):
        parse_profile(text.replace(old, new), "here")
