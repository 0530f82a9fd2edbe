"""Prepared Modbus requests: built once and sent in every tick.

A transaction keeps the constant part of its request and of its good reply. A tick adds transaction
id, data and CRC, and compares. Only a reply that differs is parsed by
:mod:`hilctl_drivers.modbus.pdu`, which raises the error.
"""

import struct
from abc import ABC, abstractmethod
from typing import cast

from hilctl_drivers.modbus.pdu import (
    FEEDBACK,
    TCP_HEAD,
    WRITE_READ,
    WRITE_REGISTER,
    WRITE_REGISTERS,
    reply_data,
    reply_layout,
    rtu_adu,
    rtu_pdu,
    tcp_adu,
    tcp_missing,
    tcp_pdu,
)
from hilctl_drivers.transport.crc import MODBUS_WORDS, Bytes, crc16_modbus
from hilctl_drivers.transport.links import BadRequestError, CorruptError, IncompleteError

_RTU_SHORTEST = 5


_DATA_AT = {WRITE_REGISTER: 3, WRITE_REGISTERS: 6, WRITE_READ: 10, FEEDBACK: 9}
"""Start of the data to write, which are the end of the request PDU, by function."""


class Transaction(ABC):
    """A prepared request and the check of its reply; what is the same in all is kept."""

    def __init__(self, adu: bytes, pdu: bytes, start: int) -> None:
        """Take the first request, its PDU, and where in the request the PDU begins."""
        first = _DATA_AT.get(pdu[0], len(pdu))
        head, read_size = reply_layout(pdu)
        self._last = adu
        self._data = pdu[first:]
        self._data_size = len(self._data)
        self._before = adu[: start + first]
        # The reply to a single write echoes all of the request.
        self._echo = pdu[0] == WRITE_REGISTER
        self._head = adu[:start] + head
        self._read_size = read_size
        self.reply_size = len(self._head) + read_size
        """Bytes of a good reply."""

    @abstractmethod
    def request(self, data: bytes = b"") -> bytes:
        """Return the next request; without ``data`` it writes those of the last call."""

    @abstractmethod
    def reply(self, adu: Bytes) -> bytes:
        """Return the register bytes in the reply to the last request, or raise FrameError."""

    @abstractmethod
    def missing(self, received: Bytes) -> int:
        """Return the number of missing bytes; 0 if the reply is complete."""

    def _bad_size(self, data: bytes) -> BadRequestError:
        return BadRequestError(f"request was prepared for {self._data_size} bytes, got {len(data)}")


class TcpTransaction(Transaction):
    """A prepared Modbus TCP :class:`Transaction`; each request has the next transaction id."""

    def __init__(self, unit: int, pdu: bytes, transaction: int = 0) -> None:
        """Prepare ``pdu`` for ``unit``; the first request's id is ``transaction`` + 1."""
        super().__init__(tcp_adu(transaction, unit, pdu), pdu, TCP_HEAD)
        self._unit = unit
        self._transaction = transaction
        self._before = self._before[2:]
        length = (self.reply_size - 6).to_bytes(2, "big")
        self._head = self._head[2:4] + length + self._head[6:]
        self._join = struct.Struct(f">H{len(self._before)}s{self._data_size}s").pack
        self._split = struct.Struct(f">H{len(self._head)}s{self._read_size}s").unpack

    def request(self, data: bytes = b"") -> bytes:
        """See :meth:`Transaction.request`."""
        if data:
            if len(data) != self._data_size:
                raise self._bad_size(data)
            self._data = data
            if self._echo:
                self._head = self._head[:-2] + data
        self._transaction = transaction = (self._transaction + 1) & 0xFFFF
        self._last = made = self._join(transaction, self._before, self._data)
        return made

    def reply(self, adu: Bytes) -> bytes:
        """See :meth:`Transaction.reply`."""
        if len(adu) == self.reply_size:
            transaction, head, read = self._split(adu)
            if transaction == self._transaction and head == self._head:
                return cast(bytes, read)
        pdu = tcp_pdu(adu, self._transaction, self._unit)
        return reply_data(self._last[TCP_HEAD:], pdu)

    def missing(self, received: Bytes) -> int:
        """See :meth:`Transaction.missing`."""
        return tcp_missing(received)


class RtuTransaction(Transaction):
    """A prepared Modbus RTU :class:`Transaction`; there is no id to tell a late reply by.

    CRCs of what never changes are computed once; the rest is taken two bytes at a time.
    """

    def __init__(self, unit: int, pdu: bytes) -> None:
        """Prepare ``pdu`` for ``unit``."""
        super().__init__(rtu_adu(unit, pdu), pdu, 1)
        self._unit = unit
        self.reply_size += 2
        self._before_crc = crc16_modbus(self._before)
        self._head_crc = crc16_modbus(self._head)
        self._join = struct.Struct(f"<{len(self._before)}s{self._data_size}sH").pack
        self._split = struct.Struct(f"<{len(self._head)}s{self._read_size}sH").unpack
        self._written_words = struct.Struct(f"<{self._data_size // 2}H").unpack
        self._read_words = struct.Struct(f"<{self._read_size // 2}H").unpack
        self._in_words = self._read_size % 2 == 0  # bits may not be

    def request(self, data: bytes = b"") -> bytes:
        """See :meth:`Transaction.request`."""
        if not data:
            return self._last
        if len(data) != self._data_size:
            raise self._bad_size(data)
        table, crc = MODBUS_WORDS, self._before_crc
        for word in self._written_words(data):
            crc = table[crc ^ word]
        if self._echo:
            self._head = self._head[:-2] + data
            self._head_crc = crc16_modbus(self._head)
        self._last = made = self._join(self._before, data, crc)
        return made

    def reply(self, adu: Bytes) -> bytes:
        """See :meth:`Transaction.reply`."""
        if len(adu) == self.reply_size and self._in_words:
            head, read, sent = self._split(adu)
            if head == self._head:
                table, crc = MODBUS_WORDS, self._head_crc
                for word in self._read_words(read):
                    crc = table[crc ^ word]
                if crc == sent:
                    return cast(bytes, read)
        if adu[: len(self._last)] == self._last and not self._echo:
            raise CorruptError(
                "the request came back before the reply: the adapter echoes, or receives what it "
                "sends; switch its local echo off"
            )
        missing = self.missing(adu)
        if missing:
            raise IncompleteError(f"{missing} more bytes belong to the reply")
        return reply_data(self._last[1:-2], rtu_pdu(adu, self._unit))

    def missing(self, received: Bytes) -> int:
        """See :meth:`Transaction.missing`."""
        count = len(received)
        if count < _RTU_SHORTEST:
            return _RTU_SHORTEST - count
        return 0 if received[1] & 0x80 else max(0, self.reply_size - count)
