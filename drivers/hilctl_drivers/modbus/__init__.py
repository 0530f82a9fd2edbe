"""DACs over Modbus TCP and RTU, one sample per exchange."""
