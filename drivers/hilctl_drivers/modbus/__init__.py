"""DACs over Modbus TCP and RTU, sample by sample.

profile.py       profiles of such devices, streaming included
registers.py     registers and steps in a profile, and numbers in registers
pdu.py           requests and replies as bytes
transactions.py  requests that are prepared once and sent many times
session.py       one conversation, and how long an exchange takes
setup.py         an experiment's options, checked against the profile
watchdog.py      the host watchdog, and one attempt to write the safe value, tripped or not
device.py        the device, and the one that reads the sensor if it is another
"""

LINK_KINDS = dict.fromkeys(("tcp", "rtu"), f"{__name__}.modbus_profile:ModbusProfile")
"""What a profile's ``link.kind`` says of it: where the class of such profiles stands."""
