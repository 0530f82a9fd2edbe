"""Registers and messages of a LabJack's stream, against LabJack's own tables."""

import struct

import numpy as np
import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.labjack import stream
from hilctl_drivers.modbus.modbus_session import ModbusSession
from hilctl_drivers.modbus.pdu import feedback_pdu, read_frame, reply_size, write_frame
from hilctl_drivers.profile import load_profile
from hilctl_drivers.transport.links import MismatchError, RefusedError
from tests.fakes import AnsweringLink

DOCUMENTED = {
    "SCANRATE_HZ": 4002, "NUM_ADDRESSES": 4004, "SETTLING_US": 4008, "RESOLUTION_INDEX": 4010,
    "BUFFER_SIZE_BYTES": 4012, "AUTO_TARGET": 4016, "DATATYPE": 4018, "NUM_SCANS": 4020,
    "OUT_TARGET": 4040, "OUT_ALLOCATE_BYTES": 4050, "OUT_LOOP_NUM_VALUES": 4060,
    "OUT_SET_LOOP": 4070, "OUT_BUFFER_STATUS": 4080, "OUT_ENABLE": 4090, "SCANLIST_ADDRESS": 4100,
    "OUT_BUFFER_F32": 4400, "DATA_CR": 4500, "STREAM_OUT0": 4800, "ENABLE": 4990,
    "FLASH_READ_POINTER": 61810, "FLASH_READ": 61812,
}  # fmt: skip
"""Of stream-out 0, as in LabJack's ljm_constants.json."""


def words(*values):
    return struct.pack(f">{len(values)}H", *values)


def test_addresses_are_the_documented_ones():
    assert {name: getattr(stream, name) for name in DOCUMENTED} == DOCUMENTED


def test_values_go_into_the_buffer_and_are_taken_into_use():
    """Big-endian floats at 4400, then 1 at 4070."""
    pdu = feedback_pdu(*stream.value_frames(np.array([[1.0, 2.5]])))
    assert pdu == bytes.fromhex("4c 01 1130 04 3f800000 40200000 01 0fe6 02 00000001")


@pytest.mark.parametrize(("outputs", "values", "samples", "rest"), [
    (1, 58, 120, 0), (2, 27, 118, 0), (4, 11, 114, 8),
])  # fmt: skip
def test_a_message_is_as_long_as_it_may_be(outputs, values, samples, rest):
    """58 values and 120 readings fill a message of 253 bytes."""
    assert (stream.values_max(outputs), stream.samples_max(outputs)) == (values, samples)
    frames = [*stream.read_frames(outputs), *stream.value_frames(np.zeros((outputs, values)))]
    pdu = feedback_pdu(*frames)
    assert (len(pdu), reply_size(pdu)) == (253 - rest, 253)


def test_data_tell_readings_and_backlog():
    data = words(3, 40, 0, 0, 100, 200, 300) + bytes(20)
    raw, backlog = stream.stream_data(data)
    assert raw.tolist() == [100, 200, 300]
    assert backlog == 20


@pytest.mark.parametrize(("head", "text"), [
    ((0, 0, 2940, 0), "full: it drops scans"),
    ((1, 0, 2941, 77, 0xFFFF), "77 scans were dropped"),
    ((0, 0, 2942, 0), "scans overlap"),
    ((0, 0, 2943, 0), "more scans were dropped than it can count"),
    ((0, 0, 2944, 0), "stopped after a number of scans"),
    ((0, 0, 2605, 0), "stream status 2605"),
    ((2, 0, 0, 0, 5, 0xFFFF), "scans are missing"),
])  # fmt: skip
def test_a_stream_that_lost_something_is_an_error_in_words(head, text):
    """Every status but 0 ends the stream, and so does the mark of a dropped scan."""
    with pytest.raises(DeviceError, match=text):
        stream.stream_data(words(*head) + bytes(240))


def test_more_samples_than_asked_for_are_no_answer():
    with pytest.raises(MismatchError, match=r"121 samples .* 120"):
        stream.stream_data(words(121, 0, 0, 0) + bytes(240))


def test_t7_readings_have_a_slope_on_each_side_of_the_centre():
    """LabJack's nominal constants: 33523 is 0 V, 65535 is about 10.11 V and 0 about -10.59 V."""
    data = struct.pack(">4f", 0.000315805780, -0.000315805800, 33523.0, -10.586956522)
    volts = stream.InputCalibration.decode("two_slopes", data).volts(
        np.array([0, 33522, 33523, 33524, 65535], dtype=np.uint16)
    )
    expected = [-10.586758, -0.0003158058, 0.0, 0.0003158058, 10.109575]
    assert volts == pytest.approx(expected, rel=1e-5, abs=1e-12)


def test_t4_readings_lie_on_a_line():
    """volts = raw * slope + offset, with the nominal constants of AIN0."""
    data = struct.pack(">2f", 3.235316e-04, -10.532965)
    made = stream.InputCalibration.decode("line", data)
    volts = made.volts(np.array([0, 32768, 65535], dtype=np.uint16))
    assert volts == pytest.approx([-10.532965, 0.0685186, 10.669679], rel=1e-5)


@pytest.mark.parametrize("numbers", [(0.0, 0.0), (float("nan"), 0.0), (-1e-4, 0.0)])
def test_constants_that_are_none_are_refused(numbers):
    """An erased flash must not turn readings into displacements."""
    with pytest.raises(DeviceError, match="calibration constants"):
        stream.InputCalibration.decode("line", struct.pack(">2f", *numbers))


@pytest.mark.parametrize(
    ("form", "channel", "span"),
    [("two_slopes", 3, (0x3C4000, 16)), ("line", 0, (0x3C4000, 8)), ("line", 3, (0x3C4018, 8))],
)
def test_constants_stand_where_the_flash_map_says(form, channel, span):
    """The T7's high-speed set at gain 1 is shared; the T4 has a pair for each input."""
    assert stream.calibration_span(form, 0x3C4000, channel) == span


def answered(pdu, transaction=None, unit=1):
    """Return a link whose device answers with a PDU."""

    def answer(request):
        first = request[:2] if transaction is None else transaction.to_bytes(2, "big")
        return first + b"\0\0" + (len(pdu) + 1).to_bytes(2, "big") + bytes([unit]) + pdu

    return AnsweringLink(answer)


def session(link):
    return ModbusSession(load_profile("labjack_t7"), link, 1, framing="tcp")


def test_the_whole_message_is_modbus_tcp():
    link = answered(bytes.fromhex("4c 3f800000"))
    feedback = session(link).feedback
    assert feedback(read_frame(0, 2)) == [bytes.fromhex("3f800000")]
    assert link.request == bytes.fromhex("0001 0000 0006 01 4c 00 0000 02")
    feedback(read_frame(0, 2))
    assert link.request[:2] == b"\x00\x02"


def test_each_read_frame_gets_its_words():
    link = answered(bytes.fromhex("4c 0011 22334455"))
    frames = [read_frame(55110, 1), write_frame(1000, bytes(4)), read_frame(55120, 2)]
    assert session(link).feedback(*frames) == [bytes.fromhex("0011"), bytes.fromhex("22334455")]


@pytest.mark.parametrize(("link", "error", "text"), [
    (answered(bytes.fromhex("cc 02")), RefusedError, "exception 2 .illegal data address"),
    (answered(bytes.fromhex("03 02 0000")), MismatchError, "answered with 3"),
    (answered(bytes.fromhex("4c 0000")), MismatchError, "must have 5 bytes, got 3"),
    (answered(bytes.fromhex("4c 00000000"), transaction=9), MismatchError, "transaction must be 1"),
    (answered(bytes.fromhex("4c 00000000"), unit=2), MismatchError, "unit must be 1, got 2"),
])  # fmt: skip
def test_an_answer_to_something_else_is_an_error(link, error, text):
    with pytest.raises(error, match=text):
        session(link).feedback(read_frame(0, 2))
