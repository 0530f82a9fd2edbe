"""Transport of bytes, independent of any protocol.

links.py           contract of a link, and its errors
stream_link.py     one exchange at a time on bytes without framing
serial_port.py     serial port
tcp.py             TCP connections
resource_names.py  names of locks: one device, one user
safe_exchange.py   one attempt to write a safe value
wire_time.py       duration of an exchange and the highest sample rate
framing.py         COBS and length-prefixed frames; crc.py has the checks
"""
