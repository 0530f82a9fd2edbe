"""Devices that hilctl can drive: simulated rigs, and DACs on a serial line or Modbus.

``hilctl`` never imports this package; its registry loads a device by name. Modules here see only
``hilctl.base`` and ``hilctl.kernels``.

contract.py       the contract of devices as pytest checks, for any package
device.py         the base of every device: range, sizes, rate, safe value, wording
wiring.py         an experiment's options: place, amplifier, sensor, reader, watchdog
starter.py        a device section to begin with
profile.py        profiles of commercial devices, by name or path; profiles/ has them
profile_parts.py  what all profiles have in common
wire/             transport of bytes, and how long it takes; independent of protocols
modbus/           Modbus TCP and RTU; labjack/ streams over it
text/             lines of text: SCPI, DCON and their like
board/            framed messages of microcontroller boards
serial/           the device that text/ and board/ stand behind
simulated/        simulated rigs
emulator/         the simulated rig behind the same wires

A protocol folder has ``profile``, its messages (``pdu``, ``frames``, ``lines``), ``session`` (one
conversation, and how long it takes), and either ``setup`` and ``device``, or ``wire`` for
``serial_dac``. A new protocol is such a folder whose ``LINK_KINDS`` name its profiles.
"""
