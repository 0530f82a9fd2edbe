"""Third-party Modbus servers, one per process: ``servers.py NAME tcp`` or ``NAME rtu DEVICE``.

Each serves 16 holding registers of unit 1 from address 0, all 0. It prints its TCP port or
``ready`` when it answers, and runs until it is killed.
"""

import asyncio
import logging
import sys
import threading

REGISTERS = 16
HOST = "127.0.0.1"
BAUD = 115_200


def say(text: object) -> None:
    print(text, flush=True)


def pymodbustcp(link: str, device: str) -> None:
    from pyModbusTCP.server import DataBank, ModbusServer

    del link, device  # TCP only
    bank = DataBank(coils_size=0, d_inputs_size=0, h_regs_size=REGISTERS, i_regs_size=0)
    server = ModbusServer(HOST, 0, no_block=True, data_bank=bank)
    server.start()
    say(server._service.server_address[1])
    threading.Event().wait()


def modbus_tk(link: str, device: str) -> None:
    import serial
    from modbus_tk import defines, modbus_rtu, modbus_tcp

    if link == "tcp":
        server = modbus_tcp.TcpServer(0, HOST)
    else:
        server = modbus_rtu.RtuServer(serial.Serial(device, BAUD))
    server.add_slave(1).add_block("all", defines.HOLDING_REGISTERS, 0, REGISTERS)
    if link == "tcp":
        server._do_init()  # the thread listens later, and the port is needed now
        say(server._sock.getsockname()[1])
        server._do_init = lambda: None
    server.start()
    if link == "rtu":
        say("ready")
    threading.Event().wait()


async def serve_pymodbus(link: str, device: str) -> None:
    from pymodbus.framer import FramerType
    from pymodbus.server import ModbusSerialServer, ModbusTcpServer
    from pymodbus.simulator import DataType, SimData, SimDevice

    data = SimData(0, count=REGISTERS, datatype=DataType.REGISTERS)
    served = SimDevice(1, simdata=[data])
    if link != "rtu":
        framer = FramerType.SOCKET if link == "tcp" else FramerType.RTU
        server = ModbusTcpServer(served, framer=framer, address=(HOST, 0))
        await server.serve_forever(background=True)
        say(server.transport.sockets[0].getsockname()[1])
    else:
        server = ModbusSerialServer(served, port=device, baudrate=BAUD)
        await server.serve_forever(background=True)
        say("ready")
    await asyncio.Event().wait()


def pymodbus(link: str, device: str) -> None:
    asyncio.run(serve_pymodbus(link, device))


def main() -> None:
    name, link, device = [*sys.argv[1:], ""][:3]
    logging.disable(logging.CRITICAL)
    {"pyModbusTCP": pymodbustcp, "modbus-tk": modbus_tk, "pymodbus": pymodbus}[name](link, device)


if __name__ == "__main__":
    main()
