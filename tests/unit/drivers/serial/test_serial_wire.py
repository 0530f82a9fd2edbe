"""What stands behind ``serial_dac`` unless a protocol says otherwise: one sample, no queue."""

import pytest

from hilctl_drivers.serial.serial_wire import SerialWire


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
