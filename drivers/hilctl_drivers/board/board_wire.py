"""Wire to microcontroller boards: single samples, or blocks through the board's FIFO.

A board with a FIFO answers a block when it has output all but ``prefill`` of the queued samples,
and returns their readings. Its clock therefore sets the pace, and the readings of a block come
``fifo_blocks`` exchanges after it. Between two exchanges the FIFO holds that many blocks, the
longest stall of this machine. The board outputs the first sample when that many blocks are queued.
"""

from functools import partial
from typing import cast

import numpy as np

from hilctl.base.errors import DeviceError, InputError
from hilctl.base.types import F64
from hilctl_drivers.board.board_profile import FrameProfile
from hilctl_drivers.board.board_session import (
    BoardFacts,
    BoardSession,
    Readings,
    exchange_time,
    settle_s,
    watchdog_time,
)
from hilctl_drivers.dac_setup import DacSetup
from hilctl_drivers.device import check_fifo, check_next, largest_block
from hilctl_drivers.session import SensorReader
from hilctl_drivers.transport.links import WatchdogTrippedError
from hilctl_drivers.transport.safe_exchange import check_read_back, try_out
from hilctl_drivers.transport.stream_link import StreamLink
from hilctl_drivers.transport.wire_time import RateLimit
from hilctl_drivers.wire import HostWatchdog, Wire

_FIRST_MAX = 2**32


class BoardWatchdog(HostWatchdog):
    """The watchdog of a board, if any; every message feeds it, and setting it ends a trip."""

    def __init__(self, setup: DacSetup, session: BoardSession) -> None:
        self._session = session
        self._timeout_s = setup.options.watchdog_timeout_s or 0.0
        self.safe = setup.chain.output(setup.options.safe_command)
        """Output after a trip."""
        self._profile = cast(FrameProfile, setup.writer.profile)
        self.arm_s = watchdog_time(self._profile).answered_s

    def recover(self) -> None:
        """Do nothing: a board that has tripped is disarmed once its output has been read."""

    def arm(self) -> None:
        """See :meth:`~hilctl_drivers.wire.HostWatchdog.arm`."""
        self._set(self._timeout_s)

    def disarm(self) -> None:
        """See :meth:`~hilctl_drivers.wire.HostWatchdog.disarm`."""
        self._set(0.0)

    def tripped(self) -> bool:
        """See :meth:`~hilctl_drivers.wire.HostWatchdog.tripped`."""
        return self._session.known_state().tripped

    def _set(self, timeout_s: float) -> None:
        if self._profile.watchdog != "none":
            self._session.set_watchdog(timeout_s, self.safe)


class BoardWire(Wire):
    """A :class:`~hilctl_drivers.wire.Wire` with binary frames."""

    session: BoardSession

    def __init__(self, setup: DacSetup, link: StreamLink) -> None:
        super().__init__(setup, link)
        self._profile = profile = cast(FrameProfile, setup.writer.profile)
        self.session = BoardSession(profile, link)
        self.watchdog: BoardWatchdog = BoardWatchdog(setup, self.session)
        self.reads_output = profile.protocol != "hilctl-1"
        self._facts: BoardFacts | None = None
        self._fifo_blocks = getattr(setup.options, "fifo_blocks", 0)
        self._block = self._next_sample = 0
        self.fifo_level_min = 0
        """Lowest FIFO level in a reply since the output began to move."""
        streaming = profile.streaming
        if streaming == "none":
            return
        if setup.reads_elsewhere:
            raise InputError("reader must be omitted: a board with a FIFO samples its own input")
        self.block_max, self.fifo_depth = streaming.block_max, streaming.fifo_depth
        fitting, note = largest_block(self._fifo_blocks, self.fifo_depth)
        if fitting < self.block_max:
            self.block_max, self.block_note = fitting, note

    def rates(self, block: int) -> RateLimit:
        """See :meth:`~hilctl_drivers.wire.Wire.rates`."""
        streaming = self._profile.streaming
        lowest_hz = 0.0 if streaming == "none" else streaming.rate_min_hz
        wire = self.setup.after_reading(exchange_time(self._profile, block))
        return self.setup.rates(wire, lowest_hz, settle_s(self._profile))

    def open(self, block_s: float = 0.0) -> list[str]:
        """Connect and check that the board matches this profile."""
        self.link.set_timeout(self.setup.writer.timeout_s + block_s)
        with self.opened():
            self.session.restart()
            self._facts = facts = self.session.facts()
        low, high = self.setup.output.limits
        slack = 1e-6 * (high - low)
        if low < facts.low - slack or high > facts.high + slack:
            raise DeviceError(
                f"{facts.name} outputs {facts.low:g} to {facts.high:g}, "
                f"the profile says {low:g} to {high:g}"
            )
        return []

    def start(self, reader: SensorReader, sample_rate_hz: float, block: int) -> None:
        """See :meth:`~hilctl_drivers.wire.Wire.start`."""
        if self.fifo_depth:
            self._check_board(sample_rate_hz, block)
        self._try_out_safe_value()  # before the clock, which SAFE stops
        if self.fifo_depth:
            self.fifo_level_min = prefill = self._fifo_blocks * block
            self.session.set_clock(sample_rate_hz, prefill)
            self._block, self._next_sample = block, 0
        self._reader = reader if self.setup.reads_elsewhere else None
        self.requests = 1 if self._reader is None else 2

    def exchange(self, first_sample: int, command: F64, displacement_um: F64) -> None:
        """See :meth:`~hilctl_drivers.wire.Wire.exchange`."""
        values = self.setup.chain.output(command)
        if self.fifo_depth:
            readings = self._queue(first_sample, values)
        else:
            exchange = partial(self.session.exchange, values)
            reader = self._reader
            if reader is None:
                readings = exchange().values
            else:
                readings = np.array([reader.read_while(exchange)])
            if readings.size != 1:
                raise DeviceError(f"{readings.size} readings received for one sample")
        if readings.size:
            self.setup.chain.fill_um(readings, displacement_um)

    def _queue(self, first_sample: int, values: F64) -> F64:
        """Queue a block and wait for the readings of the block that leaves the FIFO."""
        check_next(first_sample, self._next_sample)
        found = self.session.stream(first_sample, values)
        self._check_answer(found, first_sample)
        self._next_sample += values.size
        if found.values.size:
            self.fifo_level_min = min(self.fifo_level_min, found.fifo_level)
        return found.values

    def read(self) -> float | None:
        """See :meth:`~hilctl_drivers.wire.Wire.read`."""
        state = self.session.state()
        return None if state is None else state.output

    def look(self, reader: SensorReader) -> tuple[float, float | None]:
        """See :meth:`~hilctl_drivers.wire.Wire.look`."""
        state = self.session.known_state()
        return reader.read() if self.setup.reads_elsewhere else state.reading, state.output

    def message(self, value: float) -> bytes:
        """See :meth:`~hilctl_drivers.wire.Wire.message`."""
        return self.session.safe_frame(value)

    def confirm(self, value: float) -> None:
        """See :meth:`~hilctl_drivers.wire.Wire.confirm`."""
        try:
            self.session.put_out(value)
        except WatchdogTrippedError:
            self.watchdog.arm()
            self.session.put_out(value)
        found, output = self.read(), self.setup.output
        if found is not None:
            check_read_back(output, value, found, 2.0 * output.step)

    def disarm(self) -> None:
        """Stop the clock and disarm; the output holds its last value."""
        # The clock first: an output that moves must not be without its watchdog.
        if self.fifo_depth:
            self.session.set_clock(0.0, 0)
        self.watchdog.disarm()

    def _try_out_safe_value(self) -> None:
        """Set the output to what it holds by SAFE, or to the safe value after a trip."""
        state = self.session.state()
        self.watchdog.disarm()  # which ends a trip of an earlier run
        if state is None:
            return
        # Immediately: a board that returns to an earlier command must not keep it.
        value = self.watchdog.safe if state.tripped else state.output
        put_out = self.session.put_out
        try_out(self.setup.output, value, lambda: put_out(value), "by SAFE")

    def _check_board(self, sample_rate_hz: float, block: int) -> None:
        """Check rate and block against the limits that the board itself reports."""
        facts = self._facts
        assert facts is not None
        if sample_rate_hz > facts.rate_max_hz * (1.0 + 1e-6):
            rule = f"sample rate must be <= {facts.rate_max_hz:g} Hz, says {facts.name}"
            raise DeviceError(f"{rule}, got {sample_rate_hz:g}")
        if block > facts.block_max:
            raise DeviceError(f"block must be 1 to {facts.block_max} samples, got {block}")
        check_fifo(block, self._fifo_blocks, facts.fifo_depth)

    def _check_answer(self, found: Readings, first_sample: int) -> None:
        answered = first_sample - self._fifo_blocks * self._block
        if found.underruns:
            raise DeviceError(
                f"underrun: the FIFO of the board was empty for {found.underruns} sample periods, "
                f"about sample {max(0, answered)}; its FIFO kept {self._fifo_blocks} blocks of "
                f"{self._block}: this machine or the line was slower than that; raise "
                "device.fifo_blocks"
            )
        want = self._block if answered >= 0 else 0
        if found.values.size != want or (want and found.first != answered % _FIRST_MAX):
            raise DeviceError(
                f"readings must be {want} from sample {max(0, answered)} on, got "
                f"{found.values.size} from {found.first}"
            )
        if not np.isfinite(found.values).all():
            raise DeviceError("the board sent readings that are not numbers")
