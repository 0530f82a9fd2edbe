"""Base of Modbus devices: session, host watchdog, and safe value."""

from collections.abc import Callable
from contextlib import suppress

import numpy as np

from hilctl.base.errors import DeviceError, InputError, UnconfirmedError
from hilctl_drivers.modbus.modbus_profile import ModbusOutput, ModbusProfile, ModbusWatchdog
from hilctl_drivers.modbus.modbus_session import (
    ModbusSession,
    exchange_time,
    read_time,
    write_request,
)
from hilctl_drivers.modbus.pdu import rtu_adu
from hilctl_drivers.modbus.register_map import ModbusStep, RegisterStep
from hilctl_drivers.signal_chain import DacOptions
from hilctl_drivers.transport.links import Link, RefusedError
from hilctl_drivers.transport.safe_exchange import check_read_back, try_out
from hilctl_drivers.transport.stream_link import StreamLink
from hilctl_drivers.transport.wire_time import WireTime
from hilctl_drivers.wired_dac import SteppedDac


class ModbusDevice(SteppedDac):
    """Session, watchdog and safe value of ``modbus_dac`` and ``modbus_stream``."""

    _profile: ModbusProfile
    _target: ModbusOutput
    _writer: ModbusSession

    def __init__(self, options: DacOptions, link: Link | None = None) -> None:
        profile = options.profile.profile
        if not isinstance(profile, ModbusProfile):
            name = options.profile.name
            raise InputError(f"profile {name} is one for kind: {profile.DEVICE}, not Modbus")
        super().__init__(options, link)

    def _prepare(self) -> None:
        super()._prepare()
        setup = self._setup
        readback = self._target.readback_register
        if readback is None and self._target.function == 6 and setup.writer.framing == "rtu":
            # The correct reply equals the request, and is what a line that echoes gives.
            self.unconfirmed = (
                "the device cannot confirm it: on a serial line the reply to function 6 may be an "
                "echo, and the output cannot be read back"
            )
        # One transaction is tried at open. That moves an output that cannot be read back, so it is
        # not tried there.
        self._may_combine = (
            self._profile.exchange != "none" and readback is not None and not setup.reads_elsewhere
        )
        self.reads_output = readback is not None
        setup.check_timeout(self._wire(self._may_combine))

    def _wire(self, one_transaction: bool) -> WireTime:
        """Return the time of a sample on the wire."""
        setup, profile = self._setup, self._profile
        own = None if setup.reads_elsewhere else setup.options.input
        wire = exchange_time(profile, setup.options.output, own, one_transaction=one_transaction)
        if setup.measure is not None:
            wire = wire.then(read_time(profile, setup.measure).named("to measure the output"))
        return setup.after_reading(wire)

    def _arm_watchdog(self) -> None:
        has = self._profile.watchdog
        if has == "none":
            return
        steps = self._bound(has.arming(self._options.output))
        if self._writer.would_change(steps):
            self._writer.run(self._bound(has.unlock))
        self._writer.run(steps)

    def _run(self, name: str) -> None:
        self._writer.run(self._bound(getattr(self._profile.watchdog, name, ())))

    def _bound(self, steps: tuple[ModbusStep, ...]) -> tuple[ModbusStep, ...]:
        """Return steps with the experiment's timeout and safe value in them; none without one."""
        has, wanted = self._profile.watchdog, self._options.watchdog
        if has == "none" or wanted == "none":
            return ()
        safe = self._chain.output(wanted.safe_command)
        return has.bound(steps, self._target, wanted.timeout_s, safe)

    def _end_trip(self) -> None:
        """End a trip with the output unchanged; raise DeviceError if a step fails."""
        has, output = self._profile.watchdog, self._target
        if has == "none" or not has.clear or not self._is_tripped(has):
            return
        if has.on_trip == "hold":
            self._clear(has)
            return
        value = self._trip_value(has)
        if value is None:
            raise DeviceError(
                "its watchdog has tripped, and where that has put the output is not known: "
                "'hilctl safe' puts it at the safe value and clears the trip"
            )
        data = output.format.encode(value)
        self._write_through(lambda: self._writer.write_bytes(output, data))

    def _is_tripped(self, has: ModbusWatchdog) -> bool:
        output, session = self._target, self._writer
        if has.tripped != "none":
            return session.is_set(has.tripped)
        held = session.held_data(output) if has.refuses_while_tripped else None
        try:  # what it holds already moves nothing
            if held is not None:
                session.write_bytes(output, held)
        except RefusedError:
            return True
        return False

    def _trip_value(self, has: ModbusWatchdog) -> float | None:
        """Return what a tripped device outputs, in the output's unit; None if not known."""
        output, wanted = self._target, self._options.watchdog
        for step in has.safe.get(self._options.output, ()):
            if isinstance(step, RegisterStep) and step.value == "safe":
                scaled = step.model_copy(update={"scale": output.scale, "offset": output.offset})
                return scaled.format.decode(self._writer.read_bytes(scaled))
        if has.on_trip in {"zero", "reset"}:
            return 0.0
        if wanted == "none" or has.on_trip not in {"safe", "stored"}:
            return None
        return float(self._chain.output(wanted.safe_command))

    def _clear(self, has: ModbusWatchdog) -> None:
        self._writer.run(self._bound(has.clear) or has.clear)

    def _write_through(self, put: Callable[[], None]) -> None:
        """Write the output by ``put``, even if the watchdog has tripped.

        Before the trip is cleared, so that no stale command takes effect then; and after it, for a
        device that refuses or ignores writes until then.
        """
        has = self._profile.watchdog
        if has == "none" or not has.clear:
            put()
            return
        with suppress(RefusedError):
            put()
            if has.tripped == "none" or not self._writer.is_set(has.tripped):
                return
        self._clear(has)
        put()

    def _held(self) -> float | None:
        return self._writer.held(self._target)

    def _look(self) -> tuple[float, float | None]:
        setup = self._setup
        self._connect()
        reading, held = self._reader.read(), self._held()
        for name, value in ((setup.options.input, reading), (setup.options.output, held)):
            if value and abs(value) < np.finfo(np.float32).tiny:
                raise DeviceError(
                    f"{name} must be 0 or a normal number, got {value:.3g}: compare its order "
                    "(ABCD, CDAB, ...) and type in the profile with the device's manual"
                )
        displacement_um = setup.chain.displacement_um(reading)
        if held is None or self._tripped():
            return displacement_um, None  # the register keeps the last command
        return displacement_um, setup.chain.command(held)

    def _tripped(self) -> bool:
        watchdog = self._profile.watchdog
        flag = "none" if watchdog == "none" else watchdog.tripped
        return flag != "none" and self._writer.is_set(flag)

    def _send(self, value: float) -> None:
        assert isinstance(self._link, StreamLink)
        output = self._target
        pdu = write_request(self._writer.profile, output, output.format.encode(value))
        self._link.send_now(rtu_adu(self._writer.unit, pdu))

    def _confirm(self, value: float) -> None:
        output = self._target
        data = output.format.encode(value)
        self._write_through(lambda: self._write(data))
        if self.unconfirmed:
            raise UnconfirmedError(f"the value was sent, but {self.unconfirmed}")
        found = self._read_back()
        if found is not None:
            tolerance = max(output.step, 1e-6 * (output.max - output.min))
            check_read_back(output, value, found, tolerance)

    def _try_out_safe_value(self) -> None:
        """Write the held value with the message of the safe value, see :func:`try_out`."""
        output = self._target
        data = self._writer.held_data(output)
        if data is not None:
            name = f"{self._setup.options.output}, register {output.address}"
            try_out(output, output.format.decode(data), lambda: self._write(data), f"to {name}")

    def _write(self, data: bytes) -> None:
        """Write the output's register bytes once."""
        self._writer.write_bytes(self._target, data)

    def _read_back(self) -> float | None:
        """Return the value of the output after a safe value; None if it cannot be known."""
        return self._held()
