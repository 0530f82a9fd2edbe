"""LabJack T-series: several registers a message, and streaming from its own buffer.

profile.py     what a profile says of streaming
frames.py      Modbus function 76
stream.py      registers and messages of a stream
setup.py       an experiment's options, held against the profile; time of a block
session.py     one stream
device.py      the device, and its safe write
"""
