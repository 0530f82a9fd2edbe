"""LabJack T-series: several registers a message, and streaming from its own buffer.

profile.py     what a profile says of streaming
frames.py      Modbus function 76
stream.py      registers and messages of a stream; timing.py  how long they take
setup.py       an experiment's options, held against the profile
session.py     one stream
safe_write.py  one attempt to write the safe value
device.py      the device
"""
