"""Bytes there and back; knows no protocol.

links.py          the contract; tcp.py and serial_port.py keep it
line_settings.py  baud, parity and framing of a line
framing.py        COBS and length frames; splitters.py cuts them out of a stream; crc.py checks
errors.py         what can go wrong
"""
