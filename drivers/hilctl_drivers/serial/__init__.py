"""DACs on serial lines, whatever they speak.

setup.py       an experiment's options, held against the profile
wire.py        what a protocol must do: text/wire.py and board/wire.py do it
last_write.py  the safe value, until it is confirmed
device.py      the device
"""
