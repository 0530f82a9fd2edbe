"""Devices that hilctl can drive: simulated rigs, and DACs on a serial line or Modbus.

``hilctl`` never imports this package; its registry loads a device by name. Modules here see only
``hilctl.base.device``, ``hilctl.base.errors``, ``hilctl.base.arrays`` and ``hilctl.kernels``.

    terfenol*, piezo, plant             physics of the simulated actuators
    simulated*                          they as devices
    profile*, profiles/                 what commercial devices speak, and models of it
    checks, framing, splitters          bytes and payloads: CRCs, COBS and length-prefixed frames
    ascii_lines                         SCPI and DCON lines
    registers, modbus_frames            values and registers, Modbus requests and replies
    modbus_transactions                 the same, prepared once for the loop
    wire_errors, *_time                 what can go wrong on a wire, and how long it takes
    links, tcp_link, serial_link        bytes over TCP and serial ports, with deadlines
    signal_chain                        amplifier and sensor: ampere and um to volts and back
    modbus_*                            Modbus TCP and RTU devices
    ascii_*, serial_*, board_*          SCPI, DCON and framed serial devices, single and streaming
    emulator/                           the simulated rig behind the same wires
"""
