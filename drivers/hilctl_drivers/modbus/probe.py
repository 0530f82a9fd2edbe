"""Reading a Modbus device without changing anything: what ``devices probe`` does."""

from hilctl_drivers.modbus.config import ModbusSetup
from hilctl_drivers.transport.links import naming


def look(setup: ModbusSetup) -> tuple[float, float | None]:
    """Connect, read input and output register, and let go.

    Args:
        setup: What the experiment says of the device.

    Returns:
        Displacement in um, and the output in the command's unit: None where it can't be read, or
        the register holds a command from before a trip of the watchdog.

    Raises:
        DeviceError: It can't be reached, is another device, or gives no good answer.
    """
    writer = setup.writer.session()
    reader, name = writer, ""
    if setup.reads_elsewhere:
        reader = setup.reader.session(writer.link if setup.shares_link else None)
        name = f"reader {setup.reader.name}, unit {setup.reader.unit} at {setup.reader.place}"
    try:
        writer.link.open()
        writer.check_selftest()
        with naming(name):
            if reader.link is not writer.link:
                reader.link.open()
            if reader is not writer:
                reader.check_selftest()
            found = setup.input.format.decode(reader.read_bytes(setup.input))
        displacement_um = setup.chain.displacement_um(found)
        register, watchdog = setup.output.readback_register, setup.writer.profile.watchdog
        if register is None:
            return displacement_um, None
        if watchdog != "none" and watchdog.tripped != "none" and writer.is_set(watchdog.tripped):
            return displacement_um, None
        held = register.format.decode(writer.read_bytes(register))
        return displacement_um, setup.chain.command(held)
    finally:
        writer.link.close()
        reader.link.close()
