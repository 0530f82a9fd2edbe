"""Text devices behind ``serial_dac``: what measures the output, and what a watchdog costs.

Exchanges over a line are in ``tests/unit/drivers/test_dac.py``.
"""

from pathlib import Path

import pytest

from hilctl.base.errors import InputError
from hilctl_drivers.ascii.ascii_session import AsciiSession
from hilctl_drivers.dac import SerialDac, SerialOptions
from hilctl_drivers.profile import load_profile

DCON = str(Path(__file__).parents[3] / "data" / "dcon_module.yaml")
OPTIONS = {
    "profile": DCON, "serial_port": "/dev/x", "output": "AO0", "input": "AI0",
    "amplifier": {"gain_a_per_v": 1.0}, "sensor": {"um_per_v": 12.5}, "watchdog": "none",
}  # fmt: skip


def device(**options):
    return SerialDac(SerialOptions.model_validate({**OPTIONS, **options}))


def test_what_measures_the_output_is_an_input_that_says_so():
    assert not device().info.measures_command
    with pytest.raises(InputError, match=r"measure.*'AI0'"):
        device(measure="AI0")


def test_a_strict_watchdog_slows_the_loop():
    bare, fed = device().info, device(watchdog={"timeout_s": 1.0}).info
    feed_s = AsciiSession.feed_time(load_profile(DCON)).total_s
    assert 1.0 / fed.max_rate_hz - 1.0 / bare.max_rate_hz == pytest.approx(feed_s)
    assert "feed the watchdog" in fed.rate_note
    assert "to feed" not in bare.rate_note
