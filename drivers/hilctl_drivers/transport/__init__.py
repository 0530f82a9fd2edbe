"""Bytes there and back; knows no protocol.

links.py          the contract of a link, and errors; tcp.py and serial_port.py are links
exclusive.py      a serial port refused to other programs
safe_exchange.py  one attempt to put a safe value on a serial line
held.py           the names by which one device is one lock
line_settings.py  baud and parity of a line, as a profile has them
timing.py         how long an exchange takes, and the rate that leaves
framing.py        COBS and length frames; splitters.py cuts them out of a stream; crc.py checks
"""
