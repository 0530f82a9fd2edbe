"""DACs over Modbus TCP and RTU, sample by sample.

profile.py       what a profile says of one; channels.py  its registers and steps
pdu.py           requests and replies as bytes; registers.py  numbers in registers
transactions.py  requests prepared once and sent many times; session.py  one conversation
timing.py        how long an exchange takes
setup.py         an experiment's options, held against the profile
watchdog.py      the module's host watchdog
safe_write.py    one attempt to write the safe value
look.py          input and output of a device that is only read
device.py        the device, and the one that reads the sensor where it is another
"""

LINK_KINDS = dict.fromkeys(("tcp", "rtu"), f"{__name__}.modbus_profile:ModbusProfile")
"""What a profile's ``link.kind`` says of it: where the class of such profiles stands."""
