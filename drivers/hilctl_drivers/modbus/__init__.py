"""DACs over Modbus TCP and RTU, one sample per exchange.

modbus_profile.py     profiles, including streaming; register_map.py has registers and steps
modbus_dac.py         the device
modbus_device.py      its base: host watchdog and safe value
modbus_session.py     session, exchange times, prepared requests
pdu.py                messages
"""
