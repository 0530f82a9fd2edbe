"""How long an exchange over Modbus takes, and feeding a watchdog where exchanges don't."""

from collections.abc import Sequence

from hilctl_drivers.modbus.modbus_profile import (
    ModbusInput,
    ModbusOutput,
    ModbusProfile,
    ModbusRtuLink,
)
from hilctl_drivers.modbus.pdu import (
    coil_pdu,
    feedback_pdu,
    read_pdu,
    reply_size,
    rtu_adu,
    write_pdu,
    write_read_pdu,
    write_single_pdu,
)
from hilctl_drivers.modbus.register_map import EnsureStep, ExpectStep, ModbusStep
from hilctl_drivers.profile_base import WaitStep
from hilctl_drivers.transport.wire_time import WireTime


def exchange_time(
    profile: ModbusProfile, output: str, sensor: str | None, *, one_transaction: bool = True
) -> WireTime:
    """Return what one exchange costs: write an output and read an input.

    Args:
        profile: The device; see :func:`hilctl_drivers.profile.with_link` for another baud or gap.
        output: Name of the output.
        sensor: Name of the input; None to write only.
        one_transaction: Whether the exchange in one transaction may be used, where there is one.

    Raises:
        KeyError: No such output or input.
    """
    written = profile.outputs[output]
    read = None if sensor is None else profile.inputs[sensor]
    requests = _requests(profile, written, read, one_transaction=one_transaction)
    settle_s = written.settle_s + (read.settle_s if read else 0.0)
    return requests_time(profile, requests, settle_s)


def read_time(profile: ModbusProfile, sensor: ModbusInput) -> WireTime:
    """Return what it costs to read an input."""
    pdu = read_pdu(sensor.read_function, profile.wire_address(sensor), sensor.words)
    return requests_time(profile, [pdu], sensor.settle_s)


def feed_time(profile: ModbusProfile) -> WireTime | None:
    """Return what it costs to feed the device's watchdog once; None where exchanges feed it.

    A step that writes only what differs counts as one that writes.
    """
    watchdog = profile.watchdog
    if watchdog == "none" or watchdog.kick != "strict":
        return None
    requests = [pdu for step in watchdog.feed for pdu in _step_requests(profile, step)]
    waits_s = [step.seconds for step in watchdog.feed if isinstance(step, WaitStep)]
    return requests_time(profile, requests).feeding(waits_s)


def arm_s(profile: ModbusProfile, output: str) -> float:
    """Return how long arming the device's watchdog takes at most, s; 0 without a watchdog."""
    watchdog = profile.watchdog
    if watchdog == "none":
        return 0.0
    steps = (*watchdog.unlock, *watchdog.safe.get(output, ()), *watchdog.arm)
    requests = [pdu for step in steps for pdu in _step_requests(profile, step)]
    waits_s = sum(step.seconds for step in steps if isinstance(step, WaitStep))
    return requests_time(profile, requests).answered_s + waits_s


def requests_time(
    profile: ModbusProfile, requests: Sequence[bytes], settle_s: float = 0.0
) -> WireTime:
    """Return what requests cost with their replies, one after the other.

    Args:
        profile: The device.
        requests: Their PDUs.
        settle_s: Time that the terminals take to settle.
    """
    what = "+".join(f"FC{pdu[0]:02d}" for pdu in requests)
    turnaround_s = len(requests) * profile.turnaround_s
    link = profile.link
    if not isinstance(link, ModbusRtuLink):
        return WireTime(f"{what} over TCP", 0.0, 0.0, 0, 0.0, turnaround_s, settle_s=settle_s)
    sent = sum(len(rtu_adu(1, pdu)) for pdu in requests)
    received = sum(reply_size(pdu) + 3 for pdu in requests)  # unit and CRC
    gaps = 2 * len(requests)
    return WireTime(
        f"{what} at {link.format}",
        sent * link.char_s,
        received * link.char_s,
        gaps,
        gaps * link.silence_s,
        turnaround_s,
        settle_s=settle_s,
    )


def _requests(
    profile: ModbusProfile,
    output: ModbusOutput,
    sensor: ModbusInput | None,
    *,
    one_transaction: bool,
) -> list[bytes]:
    at, data = profile.wire_address(output), bytes(2 * output.words)
    if sensor is not None:
        source = profile.wire_address(sensor)
        if one_transaction and profile.exchange == 23:
            return [write_read_pdu(source, sensor.words, at, data)]
        if one_transaction and profile.exchange == 76:
            return [feedback_pdu(at, data, source, sensor.words)]
    write = write_single_pdu(at, data) if output.function == 6 else write_pdu(at, data)
    if sensor is None:
        return [write]
    return [read_pdu(sensor.read_function, source, sensor.words), write]


def _step_requests(profile: ModbusProfile, step: ModbusStep) -> list[bytes]:
    """Return the requests of a step, with the longest that it may come to."""
    if isinstance(step, WaitStep):
        return []
    address, data = profile.wire_address(step), bytes(2 * step.words)
    read = read_pdu(step.read_function, address, step.words)
    if isinstance(step, ExpectStep):
        return [read]
    if step.type == "bit":
        write = coil_pdu(address, True)
    else:
        write = (write_single_pdu if step.words == 1 else write_pdu)(address, data)
    if isinstance(step, EnsureStep):
        return [read, write, read]
    return [write, read] if step.verify else [write]
