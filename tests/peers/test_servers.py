"""The Modbus driver with third-party servers, over TCP and over connected ptys.

pymodbus's client reads back outputs and writes inputs, independently of the driver.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.device import joined
from hilctl.base.errors import DeviceError
from hilctl_drivers.dac import ModbusDac, ModbusOptions
from tests.peers.conftest import read_line, running, serial_cable

HERE = Path(__file__).parent
BAUD = 115_200
RATE_HZ = 10.0
SHORT_S = 0.5
HANG_S = 20.0
PROFILE = """\
vendor: somebody else
model: a server with 16 holding registers
source: [tests/peers]
verified: "yes"
link: {link}
address_base: 0
exchange: 23
turnaround_s: 0.0
max_rate_hz: 1000.0
outputs:
  FLOAT: {{address: 0, type: float32, unit: V, min: -10.0, max: 10.0}}
  SWAPPED: {{address: 2, type: float32, order: CDAB, unit: V, min: -10.0, max: 10.0}}
  INT:
    {{address: 4, type: int16, scale: 0.0005, offset: 1.0, unit: V, min: -10.0, max: 10.0,
      function: 6}}
  GONE: {{address: 100, type: float32, unit: V, min: -10.0, max: 10.0}}
inputs:
  FLOAT: {{address: 8, type: float32, unit: V, min: -10.0, max: 10.0}}
  SWAPPED: {{address: 10, type: float32, order: CDAB, unit: V, min: -10.0, max: 10.0}}
  INT: {{address: 12, type: int16, scale: 0.0005, offset: 1.0, unit: V, min: -10.0, max: 10.0}}
  ECHO: {{address: 0, type: float32, unit: V, min: -10.0, max: 10.0}}
  GONE: {{address: 100, type: float32, unit: V, min: -10.0, max: 10.0}}
watchdog: none
"""
OUTPUT_AT = {"FLOAT": 0, "SWAPPED": 2, "INT": 4}
INPUT_AT = {"FLOAT": 8, "SWAPPED": 10, "INT": 12}


@dataclass(frozen=True)
class Server:
    """A third-party server.

    Attributes:
        writes_and_reads: Whether it supports function 23.
        reads_first: Whether its function 23 reads before it writes, contrary to the standard
            (section 6.17).
        no_such_register: Error of a read past its end.
    """

    name: str
    link: str
    writes_and_reads: bool = True
    reads_first: bool = False
    no_such_register: str = r"exception 2 \(illegal data address\)"
    timeout_s: float = 2.0


SERVERS = {
    f"{server.name} {server.link}": server
    for server in (
        Server("libmodbus", "tcp"),
        Server("libmodbus", "rtu"),
        Server("pyModbusTCP", "tcp"),
        Server("modbus-tk", "tcp", reads_first=True),
        Server("modbus-tk", "rtu", reads_first=True),
        Server("pymodbus", "tcp"),
        Server("pymodbus", "rtu"),
        Server("pymodbus", "rtu_tcp"),
        Server("modbus-serial", "tcp", writes_and_reads=False),
        Server(  # does not answer function 23 and later requests
            "jsmodbus",
            "tcp",
            writes_and_reads=False,
            no_such_register="reply must",
            timeout_s=SHORT_S,
        ),
    )
}
MODULES = {"pyModbusTCP": "pyModbusTCP", "modbus-tk": "modbus_tk", "pymodbus": "pymodbus"}


class Served:
    """A running server; ``where`` are the options of the driver for its address."""

    def __init__(
        self, server: Server, process: subprocess.Popen, where: dict, folder: Path
    ) -> None:
        self.server = server
        self.process = process
        self._where = where
        self._profile = folder / "profile.yaml"
        link = f"{{kind: {server.link}}}"
        if server.link == "rtu":
            link = f"{{kind: rtu, baud: {BAUD}}}"
        self._profile.write_text(PROFILE.format(link=link), encoding="utf-8")

    def device(self, output: str = "FLOAT", sensor: str = "FLOAT", **more) -> ModbusDac:
        """Return a device on this server: 2 A/V and 1 A at 0 V, 12.5 um/V and -4 um at 0 V."""
        options = {
            "profile": str(self._profile),
            "output": output,
            "input": sensor,
            "timeout_s": self.server.timeout_s,
            "amplifier": {"gain_a_per_v": 2.0, "offset_a": 1.0},
            "sensor": {"um_per_v": 12.5, "offset_um": -4.0},
            "watchdog": "none",
            **self._where,
            **more,
        }
        return ModbusDac(ModbusOptions.model_validate(options))

    @contextmanager
    def client(self):
        """Yield pymodbus's client; over a serial cable the driver must be closed."""
        from pymodbus.client import ModbusSerialClient, ModbusTcpClient
        from pymodbus.framer import FramerType

        if self.server.link != "rtu":
            framer = FramerType.SOCKET if self.server.link == "tcp" else FramerType.RTU
            where = self._where
            made = ModbusTcpClient(where["host"], port=where["tcp_port"], framer=framer)
        else:
            made = ModbusSerialClient(self._where["serial_port"], baudrate=BAUD)
        assert made.connect()
        try:
            yield made
        finally:
            made.close()

    def put(self, kind: str, volts: float) -> None:
        with self.client() as client:
            if kind == "INT":
                words = client.convert_to_registers(
                    round((volts - 1.0) / 0.0005), client.DATATYPE.INT16
                )
            else:
                words = client.convert_to_registers(volts, client.DATATYPE.FLOAT32, order(kind))
            assert not client.write_registers(INPUT_AT[kind], words).isError()

    def get(self, kind: str) -> float:
        with self.client() as client:
            count = 1 if kind == "INT" else 2
            reply = client.read_holding_registers(OUTPUT_AT[kind], count=count)
            assert not reply.isError()
            if kind == "INT":
                raw = client.convert_from_registers(reply.registers, client.DATATYPE.INT16)
                return raw * 0.0005 + 1.0
            return client.convert_from_registers(
                reply.registers, client.DATATYPE.FLOAT32, order(kind)
            )


def order(kind: str) -> str:
    return "little" if kind == "SWAPPED" else "big"


@pytest.fixture(scope="module")
def start(programs, tmp_path_factory) -> Callable:
    """Return the context manager that runs a server."""

    @contextmanager
    def started(server: Server) -> Iterator[Served]:
        folder = tmp_path_factory.mktemp(server.name)
        with ExitStack() as stack:
            fds: tuple[int, ...] = ()
            where: dict = {}
            words = [server.link]
            if server.link == "rtu":
                near, far = stack.enter_context(serial_cable(folder))
                where = {"serial_port": near}
                words = [server.link, far]
            if server.name == "libmodbus":
                command = [programs.libmodbus_server()]
                if server.link == "rtu":
                    fds = (os.open(words[1], os.O_RDWR | os.O_NOCTTY),)
                    stack.callback(os.close, fds[0])
                    words = [server.link, str(fds[0])]
            elif server.name in MODULES:
                programs.module(MODULES[server.name])
                command = [sys.executable, str(HERE / "servers.py"), server.name]
            else:
                node = programs.node_package(server.name)
                command, words = [node, str(HERE / "servers.cjs"), server.name], []
            process = stack.enter_context(running([*command, *words], fds))
            said = read_line(process)
            if server.link != "rtu":
                where = {"host": "127.0.0.1", "tcp_port": int(said)}
            yield Served(server, process, where, folder)

    return started


@pytest.fixture(scope="module", params=SERVERS)
def served(request, start) -> Iterator[Served]:
    """A running server, each of them in turn."""
    with start(SERVERS[request.param]) as made:
        yield made


def exchange(device: ModbusDac, *commands: float) -> list[float]:
    """Exchange single samples; return the measured displacements in um."""
    measured = []
    for k, command in enumerate(commands):
        displacement_um = np.full(1, np.nan)
        device.exchange(k, np.array([command]), displacement_um, np.empty(1))
        measured.append(displacement_um.item())
    return measured


@pytest.mark.parametrize("kind", ["FLOAT", "SWAPPED", "INT"])
def test_values_come_back_right(served, kind):
    """The server's registers agree with commands and measurements."""
    device = served.device(kind, kind)
    for volts, command in ((-7.5, 3.5), (4.125, -11.0), (9.9995, 20.5)):
        served.put(kind, volts)
        device.open(RATE_HZ, 1)
        measured = exchange(device, 0.0, 7.0, command)
        device.close()
        assert measured == pytest.approx([12.5 * volts - 4.0] * 3, rel=1e-6)
        assert served.get(kind) == pytest.approx((command - 1.0) / 2.0, rel=1e-6)


def test_finds_out_whether_a_sample_is_one_transaction(served):
    """Function 23 is used if the server supports it, otherwise a write and a read."""
    device = served.device()
    device.open(RATE_HZ, 1)
    found = device.transactions == 1
    device.close()
    assert found == served.server.writes_and_reads


def test_opening_does_not_move_the_output(served):
    """Probing the server does not change the output."""
    device = served.device()
    device.open(RATE_HZ, 1)
    exchange(device, 8.0)
    device.close()
    device.open(RATE_HZ, 1)
    device.close()
    assert served.get("FLOAT") == 3.5


def test_reads_after_it_writes(served):
    """With an input at the output's address, function 23 returns this sample's command.

    Without function 23, hilctl reads before it writes.
    """
    device = served.device("FLOAT", "ECHO")
    device.open(RATE_HZ, 1)
    commands = [1.0, 3.0, -5.0, 7.0]
    volts = [(command - 1.0) / 2.0 for command in commands]
    measured = exchange(device, *commands)
    device.close()
    shown = [(value + 4.0) / 12.5 for value in measured]
    if served.server.reads_first or not served.server.writes_and_reads:
        assert shown[1:] == pytest.approx(volts[:-1])
    else:
        assert shown == pytest.approx(volts)


@pytest.mark.parametrize(("output", "sensor"), [("GONE", "FLOAT"), ("FLOAT", "GONE")])
def test_says_in_words_that_a_register_is_missing(served, output, sensor):
    """A wrong address raises an error that names the exception, by the first sample."""
    device = served.device(output, sensor)
    with pytest.raises(DeviceError, match=served.server.no_such_register):
        device.open(RATE_HZ, 1)
    device.close()


def test_make_safe_works_open_or_closed(served):
    """make_safe sets the output with or without a connection."""
    device = served.device("INT", "INT")
    device.open(RATE_HZ, 1)
    exchange(device, 9.0)
    device.make_safe(1.0)
    assert served.get("INT") == pytest.approx(0.0, abs=1e-12)
    device.make_safe(3.0)
    assert served.get("INT") == pytest.approx(1.0)


@pytest.mark.parametrize("name", [name for name in SERVERS if name.endswith("rtu")])
def test_only_its_own_unit_answers(start, name):
    """A missing unit does not answer; afterwards the right one still does."""
    with start(SERVERS[name]) as served:
        with pytest.raises(DeviceError, match=r"no answer|exception"):
            served.device(unit_id=9, timeout_s=SHORT_S).open(RATE_HZ, 1)
        device = served.device()
        device.open(RATE_HZ, 1)
        exchange(device, 4.0)
        device.close()
        assert served.get("FLOAT") == 1.5


@pytest.mark.parametrize("name", ["libmodbus tcp", "libmodbus rtu", "pymodbus rtu_tcp"])
def test_death_of_the_server_is_an_error_within_the_time_out(start, name):
    """A server that dies between two samples is an error within one timeout."""
    with start(SERVERS[name]) as served:
        device = served.device(timeout_s=SHORT_S)
        device.open(RATE_HZ, 1)
        exchange(device, 3.0)
        served.process.kill()
        served.process.wait()
        before_s = time.monotonic()
        with pytest.raises(DeviceError, match=r"connection|no answer"):
            exchange(device, 3.0)
        with pytest.raises(DeviceError, match="not open"):
            exchange(device, 3.0)
        with pytest.raises(DeviceError, match="make safe"):
            device.make_safe(0.0)
        assert time.monotonic() - before_s < HANG_S


def test_outputs_exchanged_at_once_are_those_exchanged_one_by_one(served):
    """Two outputs in one exchange leave the registers, and return the readings, of two devices."""
    kinds, volts, commands = ("SWAPPED", "FLOAT"), (-7.5, 4.125), (3.5, -11.0)
    for kind, value in zip(kinds, volts, strict=True):
        served.put(kind, value)
    alone = []
    for kind, command in zip(kinds, commands, strict=True):
        device = served.device(kind, kind)
        device.open(RATE_HZ, 1)
        alone += exchange(device, command)
        device.close()
    held = [served.get(kind) for kind in kinds]
    devices = {kind: served.device(kind, kind) for kind in kinds}
    joint = joined(devices)[kinds]
    joint.open(RATE_HZ, 1)
    found = np.full((3, 2, 1), np.nan)
    for values in ((0.0, 0.0), commands):
        found[0, :, 0] = values
        joint.exchange(0, [*found[0]], [*found[1]], [*found[2]])
    requests = {device.info.details["transactions"] for device in devices.values()}
    joint.close()
    assert requests == {"1" if served.server.writes_and_reads else "2"}
    assert found[1, :, 0].tolist() == alone
    assert [served.get(kind) for kind in kinds] == held
    assert held == pytest.approx([(each - 1.0) / 2.0 for each in commands])
