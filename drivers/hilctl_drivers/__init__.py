"""Devices that hilctl can drive: simulated rigs, and DACs on a serial line or Modbus.

``hilctl`` never imports this package; its registry loads a device by name. Modules here see only
``hilctl.ports``, ``hilctl.errors``, ``hilctl.arrays`` and ``hilctl.kernels``.
"""
