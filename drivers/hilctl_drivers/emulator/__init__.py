"""The simulated rig behind real wires: emulated devices, register by register.

What a driver sees over TCP or a pty is what the profile's device would show; short of the magnet,
all of a run is real.

command.py         ``hilctl emulate``
options.py         what to emulate; faults.py  what goes wrong
setup.py           devices, rig and ports put together
wired.py           what to emulate for an experiment
server.py          one thread that answers, over connections.py
wire.py            requests out of bytes, replies into bytes: modbus_wire.py, serial_wire.py
modbus_device.py   a device of registers.py, with its watchdog
labjack_stream.py  the streams of a LabJack
text_device.py     a device that speaks lines of text
board_device.py    a microcontroller board
fifo.py            values put out by the device's own sample clock
rig.py             the rig, what is wired between, and a log of what was put out
"""
