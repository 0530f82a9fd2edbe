"""DACs on serial lines, whatever they speak.

setup.py   an experiment's options, held against the profile
wire.py    what a protocol must do: text/wire.py and board/wire.py do it
device.py  the device
"""
