"""Plan of a tick: the fewest requests that read some registers of a device and write others.

Registers that touch are read in one request, and so are those with only inputs of the profile in
between. Function 23 reads one such span and writes another one; function 76 (LabJack) takes any
number of both in one message.

Inputs are read before the outputs are written, so they do not show the new outputs yet; what
measures an output is read after that. Function 23 is an exception: the specification lets the
device write first, and its reply has both.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from operator import itemgetter
from typing import NamedTuple, TypeAlias

from hilctl_drivers.modbus import pdu as modbus
from hilctl_drivers.modbus.modbus_profile import ModbusInput, ModbusOutput, ModbusProfile
from hilctl_drivers.modbus.register_map import Register
from hilctl_drivers.transport.wire_time import WireTime

Call: TypeAlias = Callable[..., bytes]
"""Send a prepared request and return the register bytes or packed bits that it reads.

An argument replaces the bytes of its PDU from the first register to write on.
"""

_GAP_WORDS = 8
"""Registers that take as long on a serial line as another request does."""
_BITS = (modbus.READ_COILS, modbus.READ_DISCRETE)


class Span(NamedTuple):
    """Registers or bits that one request reads."""

    function: int
    address: int
    size: int

    @property
    def end(self) -> int:
        """Address behind it."""
        return self.address + self.size

    def holds(self, other: "Span") -> bool:
        """Return whether this one includes all of the other one."""
        inside = self.address <= other.address and other.end <= self.end
        return self.function == other.function and inside


class Request(NamedTuple):
    """A request of a tick."""

    pdu: bytes  # with zeros as data
    reads: tuple[Span, ...] = ()  # in the order of the reply
    writes: tuple[tuple[int, int], ...] = ()  # outputs by index, and place of their data in the PDU


@dataclass(frozen=True, slots=True)
class TickPlan:
    """The requests of a tick to one device, in their order.

    Attributes:
        outputs: The outputs to write.
        inputs: The inputs to read before that.
        measures: The inputs to read after it.
        aux: More inputs, of which those are read that need no request of their own.
        combine: Whether to use the profile's function for one transaction, as far as possible.
    """

    profile: ModbusProfile
    outputs: Sequence[ModbusOutput] = ()
    inputs: Sequence[ModbusInput] = ()
    measures: Sequence[ModbusInput] = ()
    aux: Sequence[ModbusInput] = ()
    combine: bool = False
    requests: tuple[Request, ...] = field(init=False)

    def __post_init__(self) -> None:
        combine = self.combine and self.inputs and self.outputs
        function, rows = self.profile.exchange if combine else "none", self._rows()
        if function == 76:
            requests = self._in_frames()
        elif function == 23 and len(rows) == 1:
            first, *others = self._spans((*self.inputs, *self.measures), self.aux)
            requests = [self._write(rows[0], first), *_reads(others)]
        else:
            requests = [
                *_reads(self._spans(self.inputs, self.aux)),
                *map(self._write, rows),
                *_reads(self._spans(self.measures)),
            ]
        if self.outputs and self.profile.error_register != "none":
            requests += _reads([self._span(self.profile.error_register)])
        object.__setattr__(self, "requests", (*requests,))

    @property
    def time(self) -> WireTime:
        """Time of the requests and their replies, one after the other, and of settling."""
        settle_s = max((each.settle_s for each in self.outputs), default=0.0)
        read = (*self.inputs, *self.measures)
        settle_s += max((each.settle_s for each in read), default=0.0)
        return requests_time(self.profile, [each.pdu for each in self.requests], settle_s)

    def place(self, register: Register) -> tuple[int, slice] | None:
        """Return the request that reads a register, and its bytes in the data; None without one."""
        wanted = self._span(register)
        for k, request in enumerate(self.requests):
            at = 0
            for span in request.reads:
                if span.holds(wanted):
                    first = at + 2 * (wanted.address - span.address)
                    return k, slice(first, first + 2 * register.words)
                at += 2 * span.size
        return None

    @property
    def combined(self) -> bool:
        """Whether a request writes and reads."""
        return any(each.reads and each.writes for each in self.requests)

    def covers(self, source: ModbusInput) -> bool:
        """Return whether it reads an input."""
        return all(self.place(each) for each in _registers([source]))

    def _in_frames(self) -> list[Request]:
        """Return one message of function 76, and requests for bits."""
        before = self._spans((*self.inputs, *self.aux), gap=0)
        after = self._spans(self.measures, gap=0)
        bits = [each for each in (*before, *after) if each.function in _BITS]
        pdu, writes = bytes((modbus.FEEDBACK,)), []
        for span in before:
            pdu += modbus.read_frame(*span[1:]) if span not in bits else b""
        for k, output in enumerate(self.outputs):
            writes.append((k, len(pdu) + modbus.FRAME_HEAD))
            address = self.profile.wire_address(output)
            pdu += modbus.write_frame(address, bytes(2 * output.words))
        for span in after:
            pdu += modbus.read_frame(*span[1:]) if span not in bits else b""
        reads = (each for each in (*before, *after) if each not in bits)
        return [Request(pdu, (*reads,), (*writes,)), *_reads(bits)]

    def _write(self, row: Sequence[int], read: Span | None = None) -> Request:
        """Return the request that writes touching outputs, and reads a span with function 23."""
        first = self.outputs[row[0]]
        sizes = [2 * self.outputs[k].words for k in row]
        address, data = self.profile.wire_address(first), bytes(sum(sizes))
        if read is not None:
            pdu = modbus.write_read_pdu(read.address, read.size, address, data)
        elif len(row) > 1:
            pdu = modbus.write_pdu(address, data)
        else:
            pdu = write_request(self.profile, first)
        places = accumulate(sizes[:-1], initial=len(pdu) - len(data))
        return Request(pdu, () if read is None else (read,), (*zip(row, places, strict=True),))

    def _rows(self) -> list[list[int]]:
        """Return the outputs that one request writes, by index: those that touch."""
        rows: list[list[int]] = []
        end, address = -1, self.profile.wire_address
        for k in sorted(range(len(self.outputs)), key=lambda k: address(self.outputs[k])):
            output = self.outputs[k]
            if address(output) == end and output.function == 16:
                rows[-1].append(k)
            else:
                rows.append([k])
            end = address(output) + output.words if output.function == 16 else -1
        return rows

    def _span(self, register: Register) -> Span:
        return Span(register.read_function, self.profile.wire_address(register), register.words)

    def _spans(
        self,
        inputs: Sequence[ModbusInput],
        aux: Sequence[ModbusInput] = (),
        gap: int = _GAP_WORDS,
    ) -> list[Span]:
        """Return what is read for ``inputs``, in their order, extended by ``aux`` beside it."""
        needed = [self._span(each) for each in _registers(inputs)]
        more = [self._span(each) for each in _registers(aux)]
        known = {
            (span.function, at)
            for span in map(self._span, self.profile.inputs.values())
            for at in range(span.address, span.end)
        }
        found: list[Span] = []
        for span in sorted({*needed, *more}):
            last = found[-1] if found else span
            between = range(last.end, span.address)
            if (
                found
                and span.function == last.function not in _BITS
                and len(between) <= gap
                and all((span.function, at) in known for at in between)
                and max(last.end, span.end) - last.address <= modbus.READ_MAX
            ):
                found[-1] = last._replace(size=max(last.end, span.end) - last.address)
            else:
                found.append(span)
        order = [next(each for each in found if each.holds(one)) for one in needed]
        return [*dict.fromkeys(order)]


class Tick:
    """A prepared plan.

    Args:
        plan: The plan.
        prepare: Returns the function that sends a request PDU.
        check: Raises DeviceError for an error in the bytes of the error register, if there is one.
    """

    def __init__(
        self,
        plan: TickPlan,
        prepare: Callable[[bytes], Call],
        check: Callable[[bytes], None] | None = None,
    ) -> None:
        self.plan, self._check = plan, check
        self._replies = [b""] * len(plan.requests)
        self._steps = [(prepare(each.pdu), _filler(plan, each)) for each in plan.requests]

    def run(self, data: Sequence[bytes] = ()) -> None:
        """Send the requests with the register bytes of each output, and keep the replies.

        Without ``data``, only the requests that write nothing.
        """
        replies = self._replies
        for k, (call, filled) in enumerate(self._steps):
            if filled is None:
                replies[k] = call()
            elif data:
                replies[k] = call(filled(data))
        if self._check is not None:
            self._check(replies[-1])

    def reader(self, source: ModbusInput) -> Callable[[], float]:
        """Return a function that returns an input by the last replies; NaN if it is invalid."""
        replies, (k, part) = self._replies, self._place(source)
        decode, validity = source.format.decode, source.validity
        if validity == "none":
            return lambda: decode(replies[k][part])
        bits, valid, (n, other) = validity.bits, validity.valid, self._place(validity)
        return lambda: decode(replies[k][part]) if bits(replies[n][other]) == valid else math.nan

    def _place(self, register: Register) -> tuple[int, slice]:
        place = self.plan.place(register)
        assert place is not None, "the plan reads it"
        return place


def _filler(plan: TickPlan, request: Request) -> Callable[[Sequence[bytes]], bytes] | None:
    """Return a function that returns the end of a request's PDU with the outputs' data in it."""
    if not request.writes:
        return None
    start = modbus.data_at(request.pdu)
    own = request.pdu[start:]
    (first, _), *others = request.writes
    if not others and len(own) == 2 * plan.outputs[first].words:
        return itemgetter(first)
    content = bytearray(own)
    parts = [
        (k, slice(at - start, at - start + 2 * plan.outputs[k].words)) for k, at in request.writes
    ]

    def filled(data: Sequence[bytes]) -> bytes:
        for k, part in parts:
            content[part] = data[k]
        return bytes(content)

    return filled


def requests_time(
    profile: ModbusProfile, requests: Sequence[bytes], settle_s: float = 0.0
) -> WireTime:
    """Return the time of request PDUs and their replies, one after the other."""
    what = "+".join(f"FC{pdu[0]:02d}" for pdu in requests)
    sent = sum(len(modbus.rtu_adu(1, pdu)) for pdu in requests)
    received = sum(modbus.reply_size(pdu) + 3 for pdu in requests)  # unit and CRC
    count = len(requests)
    return profile.wire_time(what, sent, received, 2 * count, count, settle_s)


def write_request(profile: ModbusProfile, register: Register, data: bytes = b"") -> bytes:
    """Return the PDU that writes a register; zeros without ``data``."""
    address = profile.wire_address(register)
    data = data or bytes(2 * register.words)
    if register.type == "bit":
        return modbus.coil_pdu(address, any(data))
    single = register.words == 1
    if isinstance(register, ModbusOutput):
        single = register.function == 6
    return (modbus.write_single_pdu if single else modbus.write_pdu)(address, data)


def read_request(profile: ModbusProfile, register: Register) -> bytes:
    """Return the PDU that reads a register."""
    address = profile.wire_address(register)
    return modbus.read_pdu(register.read_function, address, register.words)


def _reads(spans: Iterable[Span]) -> list[Request]:
    """Return the requests that read spans."""
    return [Request(modbus.read_pdu(*each), (each,)) for each in spans]


def _registers(inputs: Iterable[ModbusInput]) -> Iterator[Register]:
    """Yield what is read for inputs; a validity register last, so that it is not older."""
    for each in inputs:
        yield each
        if each.validity != "none":
            yield each.validity
