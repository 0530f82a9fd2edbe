"""Transport of bytes; independent of any protocol.

links.py          the contract of a link, and what can go wrong with a message
tcp.py            a TCP connection; serial_port.py  a serial port
exclusive.py      one device, one user: names of locks, and a port closed to other programs
safe_exchange.py  one attempt to write a safe value
timing.py         how long an exchange takes, and the highest rate that leaves
framing.py        COBS and length frames, and messages cut out of a stream; crc.py  checks
"""
