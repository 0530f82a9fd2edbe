"""Wire to a DAC and an ADC in registers, on Modbus TCP or RTU.

The profile describes the registers, the experiment their wiring. A sample is one transaction if the
device can read and write in one (function 23, or 76 on LabJack's), otherwise a read and a write;
another device, of any protocol, may have the input. Several outputs of one device are exchanged in
the same requests as far as their registers allow. No request is repeated, and on a link none
precedes the last reply.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, cast

import numpy as np

from hilctl.base.errors import DeviceError, UnconfirmedError
from hilctl.base.types import F64
from hilctl_drivers.dac_setup import AuxSource, DacSetup
from hilctl_drivers.modbus.modbus_profile import ModbusInput, ModbusOutput, ModbusProfile
from hilctl_drivers.modbus.modbus_session import ModbusSession
from hilctl_drivers.modbus.pdu import rtu_adu
from hilctl_drivers.modbus.register_watchdog import RegisterWatchdog
from hilctl_drivers.modbus.tick_plan import Tick, TickPlan, write_request
from hilctl_drivers.session import SensorReader
from hilctl_drivers.transport.links import NoAnswerError, RefusedError
from hilctl_drivers.transport.safe_exchange import check_read_back, try_out
from hilctl_drivers.transport.wire_time import RateLimit, WireTime
from hilctl_drivers.wire import JointWire, Wire


class RegisterWire(Wire):
    """A :class:`~hilctl_drivers.wire.Wire` to registers."""

    session: ModbusSession

    def __init__(self, setup: DacSetup, link: Any) -> None:
        super().__init__(setup, link)
        self.session = session = ModbusSession.on(setup.writer, link)
        self.target = target = cast(ModbusOutput, setup.output)
        self._profile: ModbusProfile = session.profile
        self.watchdog: RegisterWatchdog = RegisterWatchdog(setup, session)
        readback = target.readback_register
        if readback is None and target.function == 6 and setup.writer.framing == "rtu":
            # The correct reply equals the request, as does an echo on the line.
            self.unconfirmed = (
                "the device cannot confirm it: on a serial line the reply to function 6 may be an "
                "echo, and the output cannot be read back"
            )
        self.reads_output = readback is not None
        self._factors, self._encode = setup.chain.factors, target.format.encode
        self._position: Callable[[], float]
        self._aux: list[tuple[int, AuxSource, Callable[[], float]]] = []
        own = RegisterExchange([self])
        setup.check_timeout(own.time)
        self._own: JointWire = own
        self._tick: Tick

    def joint(self, wires: Sequence[Wire]) -> JointWire:
        """See :meth:`~hilctl_drivers.wire.Wire.joint`."""
        return RegisterExchange(cast("Sequence[RegisterWire]", wires))

    def rates(self, block: int) -> RateLimit:
        """See :meth:`~hilctl_drivers.wire.Wire.rates`."""
        return self._own.rates(block)

    def start(self, reader: SensorReader, sample_rate_hz: float, block: int) -> None:
        """See :meth:`~hilctl_drivers.wire.Wire.start`."""
        self._own.start([reader], sample_rate_hz, block)
        self.requests = self._own.requests

    def exchange(self, first_sample: int, command: F64, displacement_um: F64) -> None:
        """See :meth:`~hilctl_drivers.wire.Wire.exchange`."""
        if self.setup.reads_elsewhere:
            self._own.exchange(first_sample, (command,), (displacement_um,))
        else:  # which takes half the time
            self._tick.run((self.encoded(command),))
            self.take(None, displacement_um)

    def release(self) -> None:
        """Close the link and forget whether the device exchanges in one transaction."""
        self._own.release()
        super().release()

    def extra_aux(self, plan: TickPlan) -> list[int]:
        """Return the auxiliary channels that a plan does not read."""
        setup = self.setup
        return [
            k
            for k, each in enumerate(setup.aux)
            if each.holder is not setup.writer or not plan.covers(cast(ModbusInput, each.input))
        ]

    def bind(self, tick: Tick) -> None:
        """Take the readings from the replies of a tick."""
        setup, self._tick, self.aux_in_turn = self.setup, tick, self.extra_aux(tick.plan)
        if not setup.reads_elsewhere:
            self._position = tick.reader(cast(ModbusInput, setup.input))
        if setup.measure is not None:
            self.read_measured = tick.reader(setup.measure)
        self._aux = [
            (k, each, tick.reader(cast(ModbusInput, each.input)))
            for k, each in enumerate(setup.aux)
            if k not in self.aux_in_turn
        ]

    def encoded(self, command: F64) -> bytes:
        """Return the register bytes of a command."""
        gain, offset, _, _ = self._factors
        return self._encode((command.item() - offset) / gain)

    def take(self, reading: float | None, displacement_um: F64) -> None:
        """Fill in the displacement, from a reading of another device or else from the replies."""
        _, _, um_per_unit, offset_um = self._factors
        value = self._position() if reading is None else reading
        displacement_um[0] = value * um_per_unit + offset_um
        if self._aux:
            self.take_aux()

    def take_aux(self) -> None:
        """Fill in the auxiliary channels that are in the replies."""
        for k, source, read in self._aux:
            self.aux[k] = source.scaled(read())

    def read(self) -> float | None:
        """See :meth:`~hilctl_drivers.wire.Wire.read`."""
        return self.session.held(self.target)

    def look(self, reader: SensorReader) -> tuple[float, float | None]:
        """See :meth:`~hilctl_drivers.wire.Wire.look`; values show a wrong order of bytes."""
        options = self.setup.options
        reading, held = reader.read(), self.read()
        for name, value in ((options.input, reading), (options.output, held)):
            if value and abs(value) < np.finfo(np.float32).tiny:
                raise DeviceError(
                    f"{name} must be 0 or a normal number, got {value:.3g}: compare its order "
                    "(ABCD, CDAB, ...) and type in the profile with the device's manual"
                )
        if held is None or self.watchdog.tripped():
            return reading, None  # the register keeps the last command
        return reading, held

    def message(self, value: float) -> bytes:
        """See :meth:`~hilctl_drivers.wire.Wire.message`."""
        pdu = write_request(self._profile, self.target, self._encode(value))
        return rtu_adu(self.session.unit, pdu)

    def confirm(self, value: float) -> None:
        """See :meth:`~hilctl_drivers.wire.Wire.confirm`."""
        output, data = self.target, self._encode(value)
        self.watchdog.write_through(lambda: self._write(data))
        if self.unconfirmed:
            raise UnconfirmedError(f"the value was sent, but {self.unconfirmed}")
        found = self._read_back()
        if found is not None:
            tolerance = max(output.step, 1e-6 * (output.max - output.min))
            check_read_back(output, value, found, tolerance)

    def try_out_safe_value(self) -> None:
        """Write the held value with the message of the safe value, see :func:`try_out`."""
        output = self.target
        data = self.session.held_data(output)
        if data is not None:
            name = f"{self.setup.options.output}, register {output.address}"
            try_out(output, output.format.decode(data), lambda: self._write(data), f"to {name}")

    def _write(self, data: bytes) -> None:
        """Write the output's register bytes once."""
        self.session.write_bytes(self.target, data)

    def _read_back(self) -> float | None:
        """Return the value of the output after a safe value; None if unknown."""
        return self.read()


class RegisterExchange(JointWire):
    """The exchange of one or more outputs of a device."""

    def __init__(self, wires: Sequence[RegisterWire]) -> None:
        super().__init__(wires)
        self._registers = wires
        self._session = wires[0].session
        for wire in wires:
            wire.watchdog.joined = [each.watchdog for each in wires]
        # One transaction is tried at open. That moves an output that cannot be read back, so it is
        # not tried there.
        self._best = self._planned(combine=all(each.reads_output for each in wires))
        self._plan = self._best  # as far as is known; opening it shows
        self.tick: Tick
        self._elsewhere: list[tuple[int, SensorReader]] = []

    def _planned(self, *, combine: bool) -> TickPlan:
        setups = [each.setup for each in self._registers]
        aux = [(own, each) for own in setups for each in own.aux if each.holder is own.writer]
        return TickPlan(
            self._session.profile,
            [each.target for each in self._registers],
            [cast(ModbusInput, each.input) for each in setups if not each.reads_elsewhere],
            [each.measure for each in setups if each.measure is not None],
            [cast(ModbusInput, each.input) for _, each in aux],
            combine,
        )

    @property
    def time(self) -> WireTime:
        """Time of a sample on the wire."""
        wire = self._plan.time
        for k, each in enumerate(self._registers):
            wire = each.setup.after_reading(wire, each.extra_aux(self._plan), digital=k == 0)
        return wire

    def rates(self, block: int) -> RateLimit:
        """Return the rates with the present number of transactions."""
        setup = self._registers[0].setup
        return setup.rates(self.time.then(setup.feed_time))

    def start(self, readers: Sequence[SensorReader], sample_rate_hz: float, block: int) -> None:
        """See :meth:`~hilctl_drivers.wire.JointWire.start`.

        Only a test shows whether the device exchanges in one transaction, and so its highest rate.
        """
        wires = self._registers
        self.tick = self._tested()
        self._plan = self.tick.plan
        for wire in wires:
            wire.bind(self.tick)
            wire.take_aux()
            wire.try_out_safe_value()
        self._elsewhere = [
            (k, reader) for k, reader in enumerate(readers) if wires[k].setup.reads_elsewhere
        ]
        self.requests = len(self._plan.requests)
        self.requests += sum(_reads_elsewhere(wire.setup) for wire in wires)
        rates, n = self.rates(block), self.requests
        how = f"{n} transaction{'s' * (n > 1)} a sample"
        replace(rates, note=f"{how}; {rates.note}").check(sample_rate_hz)
        self.tick.run()  # the test of the safe value may have left an error

    def _tested(self) -> Tick:
        """Return the tick in one transaction, or else in several.

        The test of one transaction writes the present outputs again, which must be known.
        """
        session, combined = self._session, self._best
        usual = session.tick(self._planned(combine=False))
        usual.run()  # a missing address must show before the output moves
        if not combined.combined:
            return usual
        held = [data for each in self._registers if (data := session.held_data(each.target))]
        if len(held) < len(self._registers):
            return usual
        tick = session.tick(combined)
        try:
            tick.run(held)
        except NoAnswerError:  # some devices do not answer to an unknown function
            session.link.open()
        except RefusedError:
            pass
        else:
            return tick
        return usual

    def exchange(
        self, first_sample: int, commands: Sequence[F64], displacements_um: Sequence[F64]
    ) -> None:
        """See :meth:`~hilctl_drivers.wire.JointWire.exchange`."""
        wires = self._registers
        data = [wire.encoded(each) for wire, each in zip(wires, commands, strict=True)]
        readings: list[float | None] = [None] * len(wires)
        if self._elsewhere:
            exchange = partial(self.tick.run, data)
            for k, reader in self._elsewhere:
                exchange = partial(_read_while, readings, k, reader, exchange)
            exchange()
        else:
            self.tick.run(data)
        for wire, reading, displacement_um in zip(wires, readings, displacements_um, strict=True):
            wire.take(reading, displacement_um)

    def release(self) -> None:
        """Forget whether the device exchanges in one transaction."""
        self._plan = self._best


def _read_while(
    readings: list[float | None], k: int, reader: SensorReader, exchange: Callable[[], object]
) -> None:
    readings[k] = reader.read_while(exchange)


def _reads_elsewhere(setup: DacSetup) -> int:
    """Return the number of requests to another device that has the input."""
    if not setup.reads_elsewhere:
        return 0
    if not isinstance(setup.input, ModbusInput):
        return 1
    profile = cast(ModbusProfile, setup.reader.profile)
    return len(TickPlan(profile, inputs=[setup.input]).requests)
