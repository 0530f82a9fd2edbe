"""DACs on serial lines, whatever their protocol.

wire.py    an experiment's options, and what a protocol must implement: text/wire.py, board/wire.py
device.py  the device
"""
