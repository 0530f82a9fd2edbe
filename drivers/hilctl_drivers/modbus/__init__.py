"""DACs over Modbus TCP and RTU, sample by sample.

profile.py       what a profile says of one; channels.py, steps.py its parts
pdu.py           requests and replies as bytes; registers.py  numbers in registers
transactions.py  one request and its reply; session.py  one conversation
options.py       an experiment's options; peer.py  who they name; setup.py  held against the profile
pair.py          the module with the output and the one with the input
watchdog.py      the module's host watchdog
device.py        the device
"""
