"""A DAC and an ADC on a serial line as one device: ``serial_dac``.

The profile says what is spoken: lines of text (SCPI, DCON, GEN), binary frames sample by sample, or
binary frames through a board's FIFO. On lines and single frames a tick is one request and its
reply, or two where writing and reading are separate; nothing is sent before the last reply has
come, and after a time-out the line is drained before the next request.
"""

from typing import ClassVar, cast

import numpy as np

from hilctl.base.device import DeviceInfo, DeviceOptions
from hilctl.base.types import F64
from hilctl_drivers.device import DacDevice
from hilctl_drivers.profile import named_class
from hilctl_drivers.serial.serial_wire import SerialOptions, SerialSetup, SerialWire
from hilctl_drivers.transport.wire_time import RateLimit

_PROMPT_S = 0.2
"""A safe value that is there within it needs no word."""


class SerialDac(DacDevice):
    """A :class:`~hilctl.base.device.Device` on a serial line."""

    Options: ClassVar[type[DeviceOptions]] = SerialOptions

    def __init__(self, options: SerialOptions) -> None:
        """Describe the device; nothing is sent before :meth:`open`.

        Raises:
            InputError: The profile can't be used, or options don't go with it.
        """
        setup = SerialSetup.of(options)
        wire = cast(SerialWire, named_class(setup.profile.WIRE)(setup))
        action = f"write {options.output}, read {options.input}"
        super().__init__(_info(setup, wire), setup.title, action, options.output)
        chain = setup.chain
        self._chain = chain
        self._offset = chain.output(0.0)
        self._slope = chain.output(1.0) - self._offset
        self._gain, self._offset_command, self._um, self._offset_um = chain.factors
        self._wire = wire
        self._reading = np.zeros(1)
        self._measured = np.zeros(1)
        self._answered = 0

    @property
    def wire(self) -> SerialWire:
        """How it is talked to, for tests and diagnosis."""
        return self._wire

    def _longest_block(self) -> tuple[int, str]:
        return self._wire.block_max, ""

    def _rates(self, block: int) -> RateLimit:
        return self._wire.rates(block)

    def _open(self, sample_rate_hz: float, block: int) -> None:
        self._wire.open(sample_rate_hz, block)
        self._reading = np.zeros(block)
        self._measured = np.zeros(block)
        self._answered = -self._info.latency_blocks

    def _arm(self) -> None:
        self._wire.arm()

    def _output(self) -> float | None:
        value = self._wire.output()
        return None if value is None else self._chain.command(value)

    def _look(self) -> tuple[float, float | None]:
        reading, value = self._wire.look()
        output = None if value is None else self._chain.command(value)
        return self._chain.displacement_um(reading), output

    def _exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        output = command * self._slope + self._offset
        self._wire.exchange(first_sample, output, self._reading, self._measured)
        self._answered += 1
        if self._answered > 0:
            np.multiply(self._reading, self._um, out=displacement_um)
            displacement_um += self._offset_um
        if self._info.measures_command:
            np.multiply(self._measured, self._gain, out=measured)
            measured += self._offset_command

    def _abandon(self) -> None:
        """Keep the port: opening it anew could reset a board before its output is safe."""
        self._wire.doubt()

    def _put_out(self, command: float) -> None:
        self._wire.put_out(self._chain.output(command))

    def _close(self) -> None:
        self._wire.close()

    def _release(self) -> None:
        self._wire.release()


def _info(setup: SerialSetup, wire: SerialWire) -> DeviceInfo:
    options, streams = setup.options, wire.fifo_depth > 0
    details = setup.details()
    if streams:
        details["fifo_depth"] = f"{wire.fifo_depth} samples"
        details["fifo_level"] = f"{options.fifo_blocks} blocks"
    return setup.chain.info(
        "serial_dac",
        options,
        wire.rates(wire.block_max),
        description=f"{setup.profile.title} at {options.serial_port}: "
        f"{options.output}, {options.input}",
        buffered=streams,
        fifo_depth=wire.fifo_depth,
        latency_blocks=options.fifo_blocks if streams else 0,
        measures_command=wire.measures,
        holds=setup.holds,
        arm_s=0.0 if options.watchdog == "none" else wire.arm_s,
        safe_note="; ".join(filter(None, (_late_note(setup, wire), wire.unconfirmed))),
        confirms=not wire.unconfirmed,
        details=details,
    )


def _late_note(setup: SerialSetup, wire: SerialWire) -> str:
    longest_s = wire.longest_message_s
    if longest_s <= _PROMPT_S:
        return ""
    timeout_s = setup.options.watchdog_timeout_s
    behind = (
        "no watchdog of the device stands behind it"
        if timeout_s is None
        else f"the device's watchdog acts after {timeout_s:g} s"
    )
    return f"a message takes up to {longest_s:.2g} s on this line; {behind}"
