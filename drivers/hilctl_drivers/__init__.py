"""Devices that hilctl can drive: simulated rigs, and DACs over a serial line or Modbus.

``hilctl`` never imports this package; its registry loads a device by name. Modules here import only
``hilctl.base`` and ``hilctl.kernels``.

device.py, wired_dac.py     bases of devices
signal_chain.py             options of every DAC: address, amplifier, sensor, reader, watchdog
endpoint.py, dac_setup.py   addresses and links; output and reader of the sensor as one device
profile.py, profile_base.py profiles of commercial devices; the files are in profiles/
template.py                 device section of a new experiment
contract.py                 the device contract as tests, for any package
transport/                  links, framing, wire time
modbus/  labjack/           Modbus TCP and RTU, and LabJack streaming
ascii/  board/              text or fixed frames, and boards, for ``serial_dac``
sensor_stream/              sensors that send unasked
simulated/  emulator/       simulated rigs, and the same rigs behind real wires

A protocol folder holds profiles, messages, a session and a device.
"""
