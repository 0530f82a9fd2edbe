"""Registers and messages of a LabJack T4's or T7's stream.

The stream is read in command-response mode (ljm_constants.json; T-Series Datasheet 3.2.3
Stream-Out, 3.2.4 Low-Level Stream, 20.0.0 and 20.0.1 calibration constants). A scan reads the input
and then outputs the next value; stream-out addresses return no data. If ``LOOP_NUM_VALUES`` is 1,
an output that has no new value repeats its last one.

A read of ``DATA_CR`` returns four words: number of samples, bytes left in the device's buffer,
status, and its argument. Then follow the samples of 16 bits, and padding up to the requested words.
"""

import struct
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from hilctl.base.errors import DeviceError
from hilctl.base.types import F64
from hilctl_drivers.modbus.modbus_profile import BYTES_A_SAMPLE
from hilctl_drivers.modbus.pdu import FRAME_HEAD, PDU_MAX, read_frame, write_frame
from hilctl_drivers.transport.links import MismatchError

SCANRATE_HZ: Final = 4002
NUM_ADDRESSES: Final = 4004
SETTLING_US: Final = 4008
RESOLUTION_INDEX: Final = 4010
BUFFER_SIZE_BYTES: Final = 4012
AUTO_TARGET: Final = 4016
DATATYPE: Final = 4018
NUM_SCANS: Final = 4020
OUT_TARGET: Final = 4040
OUT_ALLOCATE_BYTES: Final = 4050
OUT_LOOP_NUM_VALUES: Final = 4060
OUT_SET_LOOP: Final = 4070
OUT_BUFFER_STATUS: Final = 4080
OUT_ENABLE: Final = 4090
SCANLIST_ADDRESS: Final = 4100
OUT_BUFFER_F32: Final = 4400
DATA_CR: Final = 4500
STREAM_OUT0: Final = 4800
ENABLE: Final = 4990
FLASH_READ_POINTER: Final = 61810
FLASH_READ: Final = 61812

COMMAND_RESPONSE: Final = 16
"""``AUTO_TARGET``: data are fetched by reading ``DATA_CR``."""
USE_AT_ONCE: Final = 1
"""``OUT_SET_LOOP``: new values follow those that are still to be output."""
MISSING: Final = 0xFFFF
"""Reading that marks dropped scans; the first input of a scan list never has it."""

DATA_HEAD: Final = struct.Struct(">HHHH")
"""samples, backlog in bytes, status, argument of the status."""
_FLOAT_BYTES = 4
_U32_WORDS = 2


def values_max(outputs: int = 1) -> int:
    """Return the values per output that one message brings."""
    # It reads data and the state of each buffer, and then writes values and takes them into use.
    frames = 1 + 3 * outputs
    room = PDU_MAX - 1 - frames * FRAME_HEAD - outputs * 2 * _U32_WORDS
    return room // (outputs * _FLOAT_BYTES)


def samples_max(outputs: int = 1) -> int:
    """Return the samples that one message fetches."""
    return (PDU_MAX - 1 - outputs * 2 * _U32_WORDS - DATA_HEAD.size) // 2


STATUS: Final = {
    2940: "its buffer of readings was full: it drops scans",
    2941: "its buffer of readings was full: {} scans were dropped",
    2942: "scans overlap: the rate is too fast for these inputs and settings",
    2943: "its buffer of readings was full: more scans were dropped than it can count",
    2944: "it stopped after a number of scans",
}


u32 = struct.Struct(">I").pack
f32 = struct.Struct(">f").pack
"""Register bytes of a number."""


def read_frames(outputs: int = 1) -> tuple[bytes, ...]:
    """Return the first frames of each message of a run: the state before its own values."""
    states = (read_frame(OUT_BUFFER_STATUS + 2 * k, _U32_WORDS) for k in range(outputs))
    return read_frame(DATA_CR, DATA_HEAD.size // 2 + samples_max(outputs)), *states


def value_frames(values: F64) -> list[bytes]:
    """Return the frames that queue float64[outputs, n], n at most :func:`values_max`."""
    frames = []
    for k, each in enumerate(values.astype(">f4")):
        frames.append(write_frame(OUT_BUFFER_F32 + 2 * k, each.tobytes()))
        frames.append(write_frame(OUT_SET_LOOP + 2 * k, u32(USE_AT_ONCE)))
    return frames


def stream_data(data: bytes) -> tuple[npt.NDArray[np.uint16], int]:
    """Return the content of ``DATA_CR``, or raise DeviceError if scans were lost.

    Returns:
        uint16[n], readings of the oldest scans; readings left in the device.
    """
    count, backlog_bytes, status, more = DATA_HEAD.unpack_from(data)
    if status:
        text = STATUS.get(status, "stream status {}")
        raise DeviceError(text.format(more if status in STATUS else status))
    room = (len(data) - DATA_HEAD.size) // 2
    if count > room:
        raise MismatchError(f"{count} samples in a reply with room for {room}")
    raw = np.frombuffer(data, ">u2", count, DATA_HEAD.size).astype(np.uint16)
    if (raw == MISSING).any():
        raise DeviceError("scans are missing from the stream")
    return raw, backlog_bytes // BYTES_A_SAMPLE


@dataclass(frozen=True, slots=True)
class InputCalibration:
    """Conversion of raw readings of one input to volts."""

    center: float  # raw reading at ``offset_v``
    positive_v: float  # volts of a step above it
    # Volts of a step below it, with its sign: readings below are ``(center - raw) * negative_v``.
    negative_v: float
    offset_v: float = 0.0  # volts at the centre

    @classmethod
    def decode(cls, form: Literal["two_slopes", "line"], data: bytes) -> "InputCalibration":
        """Return the constants in flash, or raise DeviceError if they cannot be valid."""
        if form == "two_slopes":
            positive, negative, center, _ = struct.unpack(">4f", data)
            found = cls(center, positive, negative)
        else:
            slope, offset = struct.unpack(">2f", data)
            found = cls(0.0, slope, -slope, offset)
        numbers = (found.center, found.positive_v, found.negative_v, found.offset_v)
        if not np.isfinite(numbers).all() or found.positive_v <= 0.0 or found.negative_v >= 0.0:
            raise DeviceError(f"calibration constants in flash are invalid: {data.hex(' ')}")
        return found

    def volts(self, raw: npt.NDArray[np.uint16]) -> F64:
        """Return uint16[n] readings as float64[n], V."""
        steps = raw.astype(np.float64) - self.center
        slopes = np.where(steps < 0.0, -self.negative_v, self.positive_v)
        volts: F64 = steps * slopes + self.offset_v
        return volts


def calibration_span(
    form: Literal["two_slopes", "line"], address: int, channel: int
) -> tuple[int, int]:
    """Return flash address and bytes of an input's constants; all start at ``address``.

    ``two_slopes`` are those of the high-speed converter at gain 1.
    """
    return (address, 16) if form == "two_slopes" else (address + 8 * channel, 8)
