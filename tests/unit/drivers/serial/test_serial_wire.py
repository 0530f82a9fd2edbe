"""What stands behind ``serial_dac`` unless a protocol says otherwise: one sample, no queue."""

import pytest

from hilctl.base.errors import InputError
from hilctl_drivers.serial.serial_wire import SerialOptions, SerialSetup, SerialWire
from hilctl_drivers.transport.resource_names import held_port


def test_a_protocol_must_do_all_of_it():
    """One that forgot to make the output safe can't be made."""
    names = {"rates", "open", "arm", "output", "look", "exchange", "close", "release"}
    names |= {"_send", "_put_out"}
    assert SerialWire.__abstractmethods__ == names

    class Forgetful(SerialWire):
        rates = open = arm = output = look = exchange = _send = close = release = None

    with pytest.raises(TypeError, match="_put_out"):
        Forgetful(None)


def test_one_sample_without_a_queue_is_the_least():
    assert (SerialWire.block_max, SerialWire.fifo_depth, SerialWire.measures) == (1, 0, False)


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
