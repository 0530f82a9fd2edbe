"""Devices that hilctl can drive: simulated rigs, and DACs over a serial line or Modbus.

``hilctl`` never imports this package; its registry loads a device by name. Modules here import only
``hilctl.base`` and ``hilctl.kernels``.

A protocol folder has the profiles, messages, session with a device, and wire to its output.
"""
