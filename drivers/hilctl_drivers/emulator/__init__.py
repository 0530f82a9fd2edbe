"""Emulated devices: the simulated rig behind real TCP connections and ptys.

emulate_command.py    the command ``hilctl emulate``
options.py            options and injected faults
factory.py            devices, rig and ports of one emulator
server.py             one thread that serves all connections
wire.py               requests and replies on a serial line; modbus_wire.py for Modbus
modbus_device.py      a Modbus device with its watchdog; registers.py, labjack_stream.py
text_device.py        a device with a text protocol
board_device.py       a microcontroller board
rig.py                the rig, its wiring, FIFO and watchdog timer, and the log of its output
"""
