"""Modbus requests built once and sent many times: the loop's hot path.

A transaction keeps its whole request and the beginning of its good reply as bytes. A tick patches
transaction id and data, and compares. Only a reply that differs goes the long way through
:mod:`hilctl_drivers.modbus_frames`, which says what is wrong with it.
"""

import struct
from collections.abc import Callable
from typing import Protocol

from hilctl_drivers.checks import Bytes, crc16_modbus, crc16_modbus_words
from hilctl_drivers.modbus_frames import (
    FEEDBACK,
    PDU_MAX,
    TCP_HEAD,
    WRITE_READ,
    WRITE_REGISTER,
    WRITE_REGISTERS,
    reply_data,
    reply_layout,
    rtu_adu,
    rtu_pdu,
    tcp_adu,
    tcp_pdu,
)
from hilctl_drivers.wire_errors import BadRequest, Incomplete

_TCP_SHORTEST = TCP_HEAD + 2
_RTU_SHORTEST = 5
_set_transaction = struct.Struct(">H").pack_into
_tcp_start = struct.Struct(">HHH").unpack_from
_set_crc = struct.Struct("<H").pack_into


class Transaction(Protocol):
    """A prepared request and the check of its reply."""

    @property
    def size(self) -> int:
        """Bytes of the request."""
        ...

    @property
    def reply_size(self) -> int:
        """Bytes of a good reply."""
        ...

    def request(self, data: bytes = b"") -> bytearray:
        """Return the next request; the buffer is reused by the next call.

        Args:
            data: Register bytes to write, as many as the PDU was prepared with; empty for those
                of the last call.

        Raises:
            BadRequest: Another length.
        """
        ...

    def reply(self, adu: Bytes) -> bytes:
        """Check the reply to the last request and return the register bytes read.

        Raises:
            Incomplete: More bytes belong to it; see :meth:`missing`.
            Corrupt: A check or the structure is wrong.
            Mismatch: Not the answer to the last request.
            Refused: An exception reply.
        """
        ...

    def missing(self, received: Bytes) -> int:
        """Return how many more bytes to wait for; 0 where the reply is ready to be checked.

        The first bytes tell a good reply from an exception reply, which is shorter.
        """
        ...


def _data_span(pdu: bytes) -> tuple[int, int]:
    """Return where the data to write stands in a request PDU: first and past the last byte."""
    function = pdu[0]
    if function == WRITE_REGISTER:
        return 3, 5
    if function == WRITE_REGISTERS:
        return 6, len(pdu)
    if function == WRITE_READ:
        return 10, len(pdu)
    if function == FEEDBACK:
        return 5, len(pdu) - 4
    return len(pdu), len(pdu)


def _words(size: int) -> Callable[[Bytes, int], tuple[int, ...]]:
    """Return what takes ``size`` bytes from an offset on as little-endian words."""
    return struct.Struct(f"<{size // 2}H").unpack_from


class _Prepared:
    """A request buffer and the bytes that its good reply begins with."""

    def __init__(self, adu: bytes, pdu: bytes, start: int) -> None:
        """Take the request, its PDU, and where in the request the PDU begins."""
        first, last = _data_span(pdu)
        head, data_size = reply_layout(pdu)
        self._buffer = bytearray(adu)
        self._first, self._last = start + first, start + last
        self._data_size = last - first
        # The reply to a single write echoes all of the request.
        self._echo = pdu[0] == WRITE_REGISTER
        self._head = bytearray(adu[:start] + head)
        self._head_size = len(self._head)
        self._size = self._head_size + data_size

    def _put(self, data: bytes) -> None:
        """Put ``data`` into the request; raise BadRequest where it does not fit exactly."""
        if len(data) != self._data_size:
            raise BadRequest(f"request was prepared for {self._data_size} bytes, got {len(data)}")
        self._buffer[self._first : self._last] = data
        if self._echo:
            self._head[self._head_size - 2 :] = data


class TcpTransaction(_Prepared):
    """A prepared Modbus TCP :class:`Transaction`; each request has the next transaction id."""

    def __init__(self, unit: int, pdu: bytes, transaction: int = 0) -> None:
        """Prepare ``pdu`` for ``unit``; the first request's id is ``transaction`` + 1.

        Raises:
            BadRequest: Unit outside 0 to 255, transaction outside 0 to 65535, or an unknown PDU.
        """
        super().__init__(tcp_adu(transaction, unit, pdu), pdu, TCP_HEAD)
        self._unit = unit
        self._transaction = transaction
        self._head[4:6] = (self._size - 6).to_bytes(2, "big")

    @property
    def size(self) -> int:
        """Bytes of the request."""
        return len(self._buffer)

    @property
    def reply_size(self) -> int:
        """Bytes of a good reply."""
        return self._size

    def request(self, data: bytes = b"") -> bytearray:
        """See :meth:`Transaction.request`."""
        self._transaction = transaction = (self._transaction + 1) & 0xFFFF
        if data:
            self._put(data)
        _set_transaction(self._buffer, 0, transaction)
        _set_transaction(self._head, 0, transaction)
        return self._buffer

    def reply(self, adu: Bytes) -> bytes:
        """See :meth:`Transaction.reply`."""
        if len(adu) == self._size and adu[: self._head_size] == self._head:
            return bytes(adu[self._head_size :])
        pdu = tcp_pdu(adu, self._transaction, self._unit)
        return reply_data(bytes(self._buffer[TCP_HEAD:]), pdu)

    def missing(self, received: Bytes) -> int:
        """See :meth:`Transaction.missing`."""
        count = len(received)
        if count < _TCP_SHORTEST:
            return _TCP_SHORTEST - count
        _, protocol, length = _tcp_start(received)
        # Nonsense is ready to be refused; its length is not worth waiting for.
        if protocol or length > PDU_MAX + 1:
            return 0
        return max(0, int(length) + 6 - count)


class RtuTransaction(_Prepared):
    """A prepared Modbus RTU :class:`Transaction`; there is no id to tell a late reply by."""

    def __init__(self, unit: int, pdu: bytes) -> None:
        """Prepare ``pdu`` for ``unit``.

        Raises:
            BadRequest: Unit outside 1 to 255, or an unknown PDU.
        """
        super().__init__(rtu_adu(unit, pdu), pdu, 1)
        self._unit = unit
        self._crc_at = len(self._buffer) - 2
        # CRCs of what never changes: all before the data.
        self._request_crc = crc16_modbus(self._buffer[: self._first])
        self._reply_crc = crc16_modbus(self._head)
        self._request_words = _words(self._crc_at - self._first)
        self._size += 2
        self._reply_words = _words(self._size - self._head_size)
        self._in_words = (self._size - self._head_size) % 2 == 0  # bits may not be

    @property
    def size(self) -> int:
        """Bytes of the request."""
        return len(self._buffer)

    @property
    def reply_size(self) -> int:
        """Bytes of a good reply."""
        return self._size

    def request(self, data: bytes = b"") -> bytearray:
        """See :meth:`Transaction.request`."""
        if data:
            self._put(data)
            words = self._request_words(self._buffer, self._first)
            crc = crc16_modbus_words(words, self._request_crc)
            _set_crc(self._buffer, self._crc_at, crc)
            if self._echo:
                self._reply_crc = crc16_modbus(self._head)
        return self._buffer

    def reply(self, adu: Bytes) -> bytes:
        """See :meth:`Transaction.reply`."""
        if (
            self._in_words
            and len(adu) == self._size
            and adu[: self._head_size] == self._head
            and not crc16_modbus_words(self._reply_words(adu, self._head_size), self._reply_crc)
        ):
            return bytes(adu[self._head_size : -2])
        missing = self.missing(adu)
        if missing:
            raise Incomplete(f"{missing} more bytes belong to the reply")
        return reply_data(bytes(self._buffer[1:-2]), rtu_pdu(adu, self._unit))

    def missing(self, received: Bytes) -> int:
        """See :meth:`Transaction.missing`."""
        count = len(received)
        if count < _RTU_SHORTEST:
            return _RTU_SHORTEST - count
        return 0 if received[1] & 0x80 else max(0, self._size - count)
