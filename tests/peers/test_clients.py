"""Third-party clients with the emulated device, over TCP and over a pty.

They must read the rig's displacement and set its current. The scale factors are computed by hand,
independently of the profile's code.
"""

import ctypes
import re
import struct
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from hilctl_drivers.emulator.factory import Emulator
from hilctl_drivers.emulator.options import EmulatorOptions
from hilctl_drivers.simulated.devices import TerfenolOptions
from tests.fakes import ManualClock, emulated, one_rig

BAUD = 115_200


class RefusedError(Exception):
    """The device rejected a request, in the client's words."""


class Client:
    """A client; all but mbpoll have function 23."""

    can_write_and_read = True

    def read_float(self, address: int, *, low_word_first: bool) -> float:
        words = self.read(address, 2)
        if low_word_first:
            words.reverse()
        return struct.unpack(">f", struct.pack(">HH", *words))[0]


class Mbpoll(Client):
    """The program mbpoll (C, libmodbus)."""

    can_write_and_read = False

    def __init__(self, programs, where: dict) -> None:
        self._words = [programs.program("mbpoll"), "-0", "-1", "-q", "-a", "1", "-o", "5"]
        if "port" in where:
            self._words += ["-m", "tcp", "-p", str(where["port"])]
        else:
            self._words += ["-m", "rtu", "-b", str(BAUD), "-P", "none"]
        self._target = where.get("host") or where["serial_port"]

    def _run(self, *options: str, values: tuple[str, ...] = ()) -> str:
        given = ["--", *values] if values else []
        done = subprocess.run(
            [*self._words, *options, self._target, *given], capture_output=True, text=True
        )
        if done.returncode:
            raise RefusedError(done.stderr)
        return done.stdout

    def read(self, address: int, count: int) -> list[int]:
        out = self._run("-t", "4:hex", "-r", str(address), "-c", str(count))
        found = re.findall(r"^\[\d+\]:\s+0x([0-9A-F]{4})", out, re.MULTILINE)
        return [int(word, 16) for word in found]

    def read_float(self, address: int, *, low_word_first: bool) -> float:
        order = () if low_word_first else ("-B",)
        out = self._run("-t", "4:float", *order, "-r", str(address), "-c", "1")
        return float(re.search(r"^\[\d+\]:\s+(\S+)", out, re.MULTILINE)[1])

    def write(self, address: int, words: list[int]) -> None:
        values = tuple(str(word) for word in words)
        self._run("-t", "4", "-r", str(address), values=values)

    def close(self) -> None:
        """Do nothing: each run opens its own connection."""


class Libmodbus(Client):
    """libmodbus through ctypes."""

    def __init__(self, programs, where: dict) -> None:
        self._code = code = ctypes.CDLL(programs.libmodbus(), use_errno=True)
        for make in (code.modbus_new_tcp, code.modbus_new_rtu):
            make.restype = ctypes.c_void_p
        code.modbus_strerror.restype = ctypes.c_char_p
        if "port" in where:
            made = code.modbus_new_tcp(where["host"].encode(), where["port"])
        else:
            line = (BAUD, ctypes.c_char(b"N"), 8, 1)
            made = code.modbus_new_rtu(where["serial_port"].encode(), *line)
        self._context = ctypes.c_void_p(made)
        self._check(code.modbus_set_slave(self._context, 1))
        self._check(code.modbus_set_response_timeout(self._context, 5, 0))
        self._check(code.modbus_connect(self._context))

    def _check(self, result: int) -> None:
        if result < 0:
            raise RefusedError(self._code.modbus_strerror(ctypes.get_errno()).decode())

    def read(self, address: int, count: int) -> list[int]:
        words = (ctypes.c_uint16 * count)()
        self._check(self._code.modbus_read_registers(self._context, address, count, words))
        return list(words)

    def write(self, address: int, words: list[int]) -> None:
        array = (ctypes.c_uint16 * len(words))(*words)
        call = self._code.modbus_write_registers
        self._check(call(self._context, address, len(words), array))

    def write_and_read(self, at: int, words: list[int], address: int, count: int) -> list[int]:
        array, read = (ctypes.c_uint16 * len(words))(*words), (ctypes.c_uint16 * count)()
        call = self._code.modbus_write_and_read_registers
        self._check(call(self._context, at, len(words), array, address, count, read))
        return list(read)

    def close(self) -> None:
        self._code.modbus_close(self._context)
        self._code.modbus_free(self._context)


class Pymodbus(Client):
    """pymodbus's synchronous clients."""

    def __init__(self, programs, where: dict) -> None:
        programs.module("pymodbus")
        from pymodbus.client import ModbusSerialClient, ModbusTcpClient

        if "port" in where:
            self._client = ModbusTcpClient(where["host"], port=where["port"])
        else:
            self._client = ModbusSerialClient(where["serial_port"], baudrate=BAUD)
        assert self._client.connect()

    def _check(self, reply) -> list[int]:
        if reply.isError():
            raise RefusedError(str(reply))
        return reply.registers

    def read(self, address: int, count: int) -> list[int]:
        return self._check(self._client.read_holding_registers(address, count=count))

    def write(self, address: int, words: list[int]) -> None:
        self._check(self._client.write_registers(address, words))

    def write_and_read(self, at: int, words: list[int], address: int, count: int) -> list[int]:
        return self._check(
            self._client.readwrite_registers(
                read_address=address, read_count=count, write_address=at, values=words
            )
        )

    def close(self) -> None:
        self._client.close()


class PyModbusTcp(Client):
    """pyModbusTCP's client, TCP only."""

    def __init__(self, programs, where: dict) -> None:
        programs.module("pyModbusTCP")
        from pyModbusTCP.client import ModbusClient

        self._client = ModbusClient(where["host"], where["port"], timeout=5.0)
        assert self._client.open()

    def _check(self, reply):
        if not reply:
            raise RefusedError(self._client.last_except_as_full_txt)
        return reply

    def read(self, address: int, count: int) -> list[int]:
        return self._check(self._client.read_holding_registers(address, count))

    def write(self, address: int, words: list[int]) -> None:
        self._check(self._client.write_multiple_registers(address, words))

    def write_and_read(self, at: int, words: list[int], address: int, count: int) -> list[int]:
        return self._check(self._client.write_read_multiple_registers(at, words, address, count))

    def close(self) -> None:
        self._client.close()


class ModbusTk(Client):
    """modbus-tk's masters."""

    def __init__(self, programs, where: dict) -> None:
        programs.module("modbus_tk")
        import serial
        from modbus_tk import modbus_rtu, modbus_tcp

        self._port = None
        if "port" in where:
            self._master = modbus_tcp.TcpMaster(where["host"], where["port"])
        else:
            self._port = serial.Serial(where["serial_port"], BAUD)
            self._master = modbus_rtu.RtuMaster(self._port)
        self._master.set_timeout(5.0)

    def _ask(self, function: int, address: int, **more):
        from modbus_tk.modbus import ModbusError

        names = {1: "Illegal function", 2: "Illegal data address", 3: "Illegal data value"}
        try:
            return self._master.execute(1, function, address, **more)
        except ModbusError as error:
            raise RefusedError(names[error.get_exception_code()]) from None

    def read(self, address: int, count: int) -> list[int]:
        return list(self._ask(3, address, quantity_of_x=count))

    def write(self, address: int, words: list[int]) -> None:
        self._ask(16, address, output_value=words)

    def write_and_read(self, at: int, words: list[int], address: int, count: int) -> list[int]:
        more = {"quantity_of_x": count, "output_value": words}
        return list(self._ask(23, address, write_starting_address_fc23=at, **more))

    def close(self) -> None:
        self._master.close()


class Emulated:
    """An emulated device with access to its time and physics."""

    def __init__(self, emulator: Emulator, clock: ManualClock) -> None:
        self.emulator = emulator
        self._clock = clock
        self.rig = emulator.rigs[0].rig
        host, _, port = emulator.address.partition(":")
        self.where = {"host": host, "port": int(port)} if port else {"serial_port": host}

    def settle(self) -> None:
        """Wait until the rig is at rest."""
        self._clock.now_ns += 500_000_000


@pytest.fixture
def emulate() -> Iterator[Callable[[str], Emulated]]:
    """Return a function that starts the emulated device of a profile."""
    with ExitStack() as stack:

        def start(profile: str) -> Emulated:
            clock = ManualClock()
            options = EmulatorOptions(
                profile, rigs=one_rig(actuator=TerfenolOptions(noise=False)), command=0.0
            )
            return Emulated(stack.enter_context(emulated(options, clock)), clock)

        yield start


@pytest.fixture
def connect(programs) -> Iterator[Callable]:
    """Return a function that connects a client to an emulated device."""
    made: list = []

    def to(client: type, served: Emulated):
        made.append(client(programs, served.where))
        return made[-1]

    yield to
    for client in made:
        client.close()


MODULE = str(Path(__file__).parents[1] / "data" / "milliampere_module.yaml")
ON_TCP = pytest.mark.parametrize("kind", [Mbpoll, Libmodbus, Pymodbus, PyModbusTcp, ModbusTk])
ON_SERIAL = pytest.mark.parametrize("kind", [Mbpoll, Libmodbus, Pymodbus, ModbusTk])


def signed(raw: int) -> int:
    return raw - 0x10000 * (raw > 0x7FFF)


@ON_TCP
def test_floats_over_tcp(emulate, connect, kind):
    """A LabJack's DAC0 has 4 A/V about 2.5 V, and AIN0 has 12.5 um/V."""
    served = emulate("labjack_t7")
    client = connect(kind, served)
    seen = []
    for volts in (3.75, 1.0):
        client.write(1000, list(struct.unpack(">HH", struct.pack(">f", volts))))
        assert served.rig.command == pytest.approx(4.0 * (volts - 2.5))
        served.settle()
        seen.append(client.read_float(0, low_word_first=False))
        assert 12.5 * seen[-1] == pytest.approx(served.rig.displacement_um, rel=1e-5)
        assert client.read_float(1000, low_word_first=False) == volts
    assert seen[0] - seen[1] > 2.0


@ON_TCP
def test_sixteen_bits_over_tcp(emulate, connect, kind):
    """A WAGO's words are signed, 10 V / 32767; function 23 writes and reads in one transaction."""
    served = emulate("wago_750")
    client = connect(kind, served)
    for raw in (0x2000, 0xE000):
        current_a = signed(raw) * 10.0 / 32767
        if client.can_write_and_read:
            client.write_and_read(0, [raw], 0, 1)
        else:
            client.write(0, [raw])
        assert served.rig.command == pytest.approx(current_a)
        assert client.read(0x200, 1) == [raw]
        served.settle()
        (shown,) = client.read(0, 1)
        shown_um = signed(shown) * 125.0 / 32767
        assert shown_um == pytest.approx(served.rig.displacement_um, abs=0.5 * 125.0 / 32767)
        assert (shown_um > 5.0) == (raw == 0x2000)


@ON_SERIAL
def test_registers_over_a_serial_line(emulate, connect, kind):
    """A module's mA and swapped floats are correct with RTU framing, CRC and unit id."""
    served = emulate(MODULE)
    client = connect(kind, served)
    for raw in (8000, 0x10000 - 12_000):
        current_a = signed(raw) * 1e-3 * 0.5
        if client.can_write_and_read:
            client.write_and_read(100, [raw], 200, 2)
        else:
            client.write(100, [raw])
        assert served.rig.command == pytest.approx(current_a)
        served.settle()
        volts = client.read_float(200, low_word_first=True)
        assert 12.5 * volts == pytest.approx(served.rig.displacement_um, rel=1e-5)
        assert abs(volts) > 0.5
        assert client.read(100, 1) == [raw]


@ON_TCP
def test_refusals_are_understood(emulate, connect, kind):
    """Each client reports the device's rejection, and the output does not change."""
    served = emulate("labjack_t7")
    client = connect(kind, served)
    with pytest.raises(RefusedError, match=r"(?i)address|exception_code=2"):
        client.read(9000, 2)
    with pytest.raises(RefusedError, match=r"(?i)value|exception_code=3"):
        client.write(1000, list(struct.unpack(">HH", struct.pack(">f", 5.5))))
    if client.can_write_and_read:
        with pytest.raises(RefusedError, match=r"(?i)function|exception_code=1"):
            client.write_and_read(1000, [0, 0], 0, 2)
    assert served.rig.command == 0.0
