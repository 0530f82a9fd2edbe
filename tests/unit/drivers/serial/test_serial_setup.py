"""A device on a serial line: which profiles, whose line, and what it holds."""

import pytest

from hilctl.base.errors import InputError
from hilctl_drivers.serial.serial_setup import SerialOptions, SerialSetup
from hilctl_drivers.transport.resource_names import held_port

TWO_LINES = {
    "profile": "icp_m7024_dcon", "serial_port": "/dev/x", "output": "AO0", "input": "AI101",
    "reader": {"profile": "agilent_34970a", "serial_port": "/dev/y"},
    "amplifier": {"gain_a_per_v": 1.0}, "sensor": {"um_per_v": 12.5}, "watchdog": "none",
}  # fmt: skip
BOARD = {**TWO_LINES, "profile": "cobs_board", "output": "DAC", "input": "ADC", "reader": None}


def setup_of(**options):
    return SerialSetup.of(SerialOptions.model_validate(options))


def test_a_board_reads_itself():
    setup = setup_of(**BOARD)
    assert not setup.reads_elsewhere
    assert setup.holds == held_port("/dev/x")
    assert setup.title == "serial_dac cobs_board at /dev/x"
    link = setup.link()
    assert setup.reader_link(link) is link
    assert "reader_vendor" not in setup.details()


def test_profiles_of_another_kind_are_refused():
    with pytest.raises(InputError, match="labjack_t7 is one for kind: modbus_dac, not serial_dac"):
        setup_of(**{**BOARD, "profile": "labjack_t7", "output": "DAC0", "input": "AIN0"})


def test_a_channel_that_is_not_there_is_said_with_those_that_are():
    with pytest.raises(InputError, match="DAC"):
        setup_of(**{**BOARD, "output": "AO7"})


def test_a_line_is_set_as_asked_only_where_the_device_can_be():
    dcon = {**TWO_LINES, "baud": 115200}
    assert setup_of(**dcon).profile.link.baud == 115200
    with pytest.raises(InputError, match="baud"):
        setup_of(**{**dcon, "baud": 300})
