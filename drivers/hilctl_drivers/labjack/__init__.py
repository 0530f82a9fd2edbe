"""LabJack T-series: several registers per message, and streaming from its own buffer.

stream.py   Modbus function 76, and the registers and messages of a stream
session.py  one stream
device.py   options checked against the profile, the device, and its safe write
"""
