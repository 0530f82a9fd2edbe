"""The simulated rig behind real wires: emulated devices, register by register.

What a driver sees over TCP or a pty is what the profile's device would show; except for the magnet,
the complete path of a run is real.

command.py         ``hilctl emulate``, for a profile or an experiment
options.py         what to emulate, and which faults to inject
setup.py           devices, rig and ports put together
server.py          one thread that answers, over connections and ptys
wire.py            requests out of bytes, replies into bytes, on a serial line; modbus_wire.py
modbus_device.py   a device of registers.py, with its watchdog
labjack_stream.py  the streams of a LabJack
text_device.py     a device that speaks lines of text
board_device.py    a microcontroller board
rig.py             the rig, in real time or by a sample clock, its wiring, and a log of its output
"""
