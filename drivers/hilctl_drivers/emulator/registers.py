"""Registers of an emulated Modbus device: addresses, contents, and access."""

from collections.abc import Sequence
from typing import TypeAlias

from hilctl_drivers.emulator.wire import RejectedRequest
from hilctl_drivers.modbus.modbus_profile import ModbusOutput, ModbusProfile
from hilctl_drivers.modbus.register_map import (
    DigitalRegister,
    ExpectStep,
    ModbusSelftest,
    Register,
    RegisterStep,
    StatusRegister,
)

_NO_SUCH_ADDRESS = 2


class Words:
    """The words of one value, shared by all addresses that show it; a bit is a word of 0 or 1."""

    def __init__(self, register: Register) -> None:
        self.register = register
        self._format = None if register.type == "bit" else register.format
        self.data = bytes(2 * register.words)

    def encoded(self, value: float) -> bytes:
        """Return the words that encode ``value``, as bytes."""
        return bytes((0, value != 0.0)) if self._format is None else self._format.encode(value)

    def set_bits(self, mask: int, bits: int) -> None:
        """Replace the bits of a mask."""
        raw = int.from_bytes(self.data, "big") & ~mask | bits
        self.data = raw.to_bytes(len(self.data), "big")

    @property
    def value(self) -> float:
        """The value that the words encode."""
        return float(self.data[1]) if self._format is None else self._format.decode(self.data)

    @value.setter
    def value(self, value: float) -> None:
        self.data = self.encoded(value)


_Map: TypeAlias = dict[tuple[str, int], tuple[Words, int]]
"""From area and wire address to a value and the index of its word there."""


def _find(places: _Map, areas: Sequence[str], address: int) -> tuple[Words, int]:
    for area in areas:
        if (area, address) in places:
            return places[area, address]
    raise RejectedRequest(_NO_SUCH_ADDRESS)


class RegisterMap:
    """Registers that a profile names, with the values it expects; ``steps`` is by their ``id``.

    Reads and writes have separate maps, because couplers use an address for different things.
    """

    def __init__(self, profile: ModbusProfile) -> None:
        self._profile = profile
        self._readable: _Map = {}
        self._writable: _Map = {}
        self.outputs = {name: self._place_output(each) for name, each in profile.outputs.items()}
        self.inputs = {
            name: self._place(each, write=False) for name, each in profile.inputs.items()
        }
        self.steps: dict[int, Words] = {}
        self._place_rest()

    def read(self, areas: Sequence[str], address: int, count: int) -> bytes:
        """Return words as read, each from the first area that contains it."""
        found = (_find(self._readable, areas, address + k) for k in range(count))
        return b"".join(words.data[2 * k : 2 * k + 2] for words, k in found)

    def written(self, area: str, address: int, count: int) -> bytes:
        """Return words as they were last written."""
        found = (_find(self._writable, [area], address + k) for k in range(count))
        return b"".join(words.data[2 * k : 2 * k + 2] for words, k in found)

    def targets(self, area: str, address: int, data: bytes) -> list[tuple[Words, bytes]]:
        """Return the values that a write would change, with their new words; never part of one."""
        found: list[tuple[Words, bytes]] = []
        while data:
            words, k = _find(self._writable, [area], address)
            size = len(words.data)
            if k or size > len(data):
                raise RejectedRequest(_NO_SUCH_ADDRESS)
            found.append((words, data[:size]))
            address, data = address + size // 2, data[size:]
        return found

    def _share(
        self, words: Words, area: str, address: int, *, read: bool = True, write: bool = True
    ) -> Words:
        """Put a value at a wire address unless one exists there; return the value there."""
        maps = [self._readable] * read + [self._writable] * write
        there = next((each[area, address] for each in maps if (area, address) in each), None)
        found = words if there is None else there[0]
        for each in maps:
            for k in range(len(found.data) // 2):
                each.setdefault((area, address + k), (found, k))
        return found

    def _areas(self, register: Register) -> tuple[str, ...]:
        """Return the areas of a register: LabJack does not tell functions 3 and 4 apart."""
        if register.area in {"coil", "discrete"} or self._profile.exchange == "none":
            return (register.area,)
        return ("holding", "input")

    def _place(self, register: Register, *, read: bool = True, write: bool = True) -> Words:
        address = self._profile.wire_address(register)
        first = self._share(Words(register), register.area, address, read=read, write=write)
        for area in self._areas(register):
            self._share(first, area, address, read=read, write=False)
        return first

    def _place_output(self, output: ModbusOutput) -> Words:
        words = self._place(output, read=output.readback == "same")
        readback = output.readback_register
        if readback is not None and readback is not output:
            address = self._profile.wire_address(readback)
            for area in {readback.area, *self._areas(readback)}:
                self._share(words, area, address, write=False)
        return words

    def _place_rest(self) -> None:
        """Place self-test, status, digital channels, and what the profile's steps touch."""
        watchdog = self._profile.watchdog
        flag = None if watchdog == "none" else watchdog.tripped
        for _, register in self._profile.registers():
            if isinstance(register, RegisterStep):
                words = self._place(register, write=not isinstance(register, ExpectStep))
                if isinstance(register, ExpectStep) and isinstance(register.value, float):
                    words.data = Words(register).encoded(register.value)
            elif isinstance(register, ModbusSelftest):
                words = self._place(register, write=False)
                words.value = register.expect
            elif isinstance(register, StatusRegister):
                words = self._place(register, write=register is not flag)
            elif isinstance(register, DigitalRegister):
                words = self._place(register)
            else:
                continue
            self.steps[id(register)] = words
