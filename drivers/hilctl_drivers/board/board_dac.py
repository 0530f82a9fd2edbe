"""``serial_dac`` for microcontroller boards: single samples, or blocks through the board's FIFO.

A board with a FIFO answers a block when it has output all but ``prefill`` of the queued samples,
and returns their readings. Its clock therefore sets the pace, and the readings of a block come
``fifo_blocks`` exchanges after it. Between two exchanges the FIFO holds that many blocks: so long
may this machine stall. The board outputs the first sample when that many blocks are queued.
"""

from dataclasses import replace

import numpy as np

from hilctl.base.errors import DeviceError, InputError
from hilctl.base.types import F64
from hilctl_drivers.board.board_profile import FrameProfile
from hilctl_drivers.board.board_session import BoardFacts, BoardSession, Readings
from hilctl_drivers.board.frames import exchange_sizes, state_sizes, watchdog_sizes
from hilctl_drivers.dac_setup import DacSetup, SensorReader
from hilctl_drivers.device import check_fifo, check_next
from hilctl_drivers.profile_base import Range
from hilctl_drivers.transport.framing import binary_framing
from hilctl_drivers.transport.links import Link, WatchdogTrippedError
from hilctl_drivers.transport.safe_exchange import try_out
from hilctl_drivers.transport.wire_time import RateLimit, WireTime
from hilctl_drivers.wired_dac import SerialDac

_USB_BITS_PER_S = {True: 19 * 64 * 8e3, False: 13 * 512 * 8 * 8e3}
"""Bulk payload of full-speed (1 ms) and high-speed (125 us) frames (USB 2.0, tables 5-9, 5-10)."""
_FIRST_MAX = 2**32


def exchange_time(profile: FrameProfile, block: int = 1) -> WireTime:
    """Return the time of an exchange of ``block`` samples, more than one for a stream only.

    Outputs of a stream settle while the next messages pass.
    """
    stream = profile.exchange == "stream"
    wire = _wire_time(profile, exchange_sizes(block, _value_bytes(profile), stream=stream))
    what = f"{block} {'sample' if block == 1 else 'samples'} in {profile.link.framing} frames"
    settle = 0.0 if stream else settle_s(profile)
    return replace(wire, what=f"{what} {wire.what}", samples=block, settle_s=settle)


def settle_s(profile: FrameProfile) -> float:
    """Return the time that output and input take to settle, s."""
    channels = (*profile.outputs.values(), *profile.inputs.values())
    return sum(channel.settle_s for channel in channels)


def _value_bytes(profile: FrameProfile) -> int:
    return next(iter(profile.outputs.values())).format.size


def _wire_time(profile: FrameProfile, sizes: tuple[int, int]) -> WireTime:
    """Return the time of a message and its reply, with the line as text."""
    link = profile.link
    byte_s, gaps, gaps_s, line = link.char_s, 0, 0.0, link.medium
    if link.usb:
        full_speed = link.usb_frame_s >= 1e-3
        byte_s, gaps, gaps_s = 8.0 / _USB_BITS_PER_S[full_speed], 1, link.usb_frame_s
        line = f"over {'full' if full_speed else 'high'}-speed USB"
    framing = binary_framing(link.framing, link.crc, link.payload_max)
    request_s, reply_s = (framing.wire_size(size) * byte_s for size in sizes)
    return WireTime(line, request_s, reply_s, gaps, gaps_s, profile.turnaround_s)


class BoardReader(SensorReader):
    """A :class:`~hilctl_drivers.dac_setup.SensorReader` for boards, by STATE."""

    READS_ANY = False

    def __init__(self, setup: DacSetup, link: Link) -> None:
        super().__init__(setup, link)
        profile = setup.reader.profile
        assert isinstance(profile, FrameProfile)
        self._session = BoardSession(profile, self.link)

    @staticmethod
    def time(profile: FrameProfile, source: Range) -> WireTime:
        """See :meth:`~hilctl_drivers.dac_setup.SensorReader.time`."""
        values = (*profile.outputs.values(), *profile.inputs.values())
        wire = _wire_time(profile, state_sizes(sum(each.format.size for each in values)))
        return replace(wire, what=f"STATE {wire.what}", settle_s=source.settle_s)

    def _identify(self) -> None:
        self._session.facts()

    def _read(self) -> float:
        return self._session.known_state().reading


class BoardDac(SerialDac):
    """A :class:`~hilctl_drivers.wired_dac.SerialDac` with binary frames."""

    def _prepare(self) -> None:
        setup, profile = self._setup, self._setup.writer.profile
        assert isinstance(profile, FrameProfile)
        self._profile = profile
        self._session = BoardSession(profile, self._link)
        if setup.reads_elsewhere:
            self._reader = setup.reader_on(self._link)
        self._safe = setup.chain.output(self._options.safe_command)
        self.reads_output = profile.protocol != "hilctl-1"
        self.arm_s = _wire_time(profile, watchdog_sizes(_value_bytes(profile))).answered_s

    def _rates(self, block: int) -> RateLimit:
        streaming = self._profile.streaming
        lowest_hz = 0.0 if streaming == "none" else streaming.rate_min_hz
        wire = self._setup.after_reading(exchange_time(self._profile, block))
        return self._setup.rates(wire, lowest_hz, settle_s(self._profile))

    def _held(self) -> float | None:
        state = self._session.state()
        return None if state is None else state.output

    def _look(self) -> tuple[float, float | None]:
        self._connect()
        state = self._session.known_state()
        reading = state.reading
        if self._reader is not None:
            self._reader.open()
            reading = self._reader.read()
        return self._chain.displacement_um(reading), self._chain.command(state.output)

    def _tripped(self) -> bool:
        return self._session.known_state().tripped

    def _send(self, value: float) -> None:
        self._link.send_now(self._session.safe_frame(value))

    def _confirm(self, value: float) -> None:
        try:
            self._session.put_out(value)
        except WatchdogTrippedError:
            self._set_watchdog(self._options.watchdog_timeout_s)
            self._session.put_out(value)
        state = self._session.state()
        if state is not None:
            self._check_read_back(value, state.output)

    def _connect(self, extra_s: float = 0.0) -> BoardFacts:
        """Connect and check that it is a board that this profile describes."""
        self._link = self._setup.writer.stream(extra_s)
        self._session = BoardSession(self._profile, self._link)
        self._link.open()
        facts = self._session.facts()
        low, high = self._setup.output.limits
        slack = 1e-6 * (high - low)
        if low < facts.low - slack or high > facts.high + slack:
            raise DeviceError(
                f"{facts.name} puts out {facts.low:g} to {facts.high:g}, "
                f"the profile says {low:g} to {high:g}"
            )
        return facts

    def _arm_watchdog(self) -> None:
        self._set_watchdog(self._options.watchdog_timeout_s)

    def _try_out_safe_value(self) -> None:
        """Set the output to what it holds by SAFE, or to the safe value after a trip."""
        state = self._session.state()
        self._set_watchdog(None)  # which ends a trip of an earlier run
        if state is None:
            return
        # At once: a board that comes back to a command from before must not keep it.
        value = self._safe if state.tripped else state.output
        put_out = self._session.put_out
        try_out(self._setup.output, value, lambda: put_out(value), "by SAFE")

    def _set_watchdog(self, timeout_s: float | None) -> None:
        """Set the watchdog if the board has one, which clears a trip; None disarms it."""
        if self._profile.watchdog != "none":
            self._session.set_watchdog(timeout_s or 0.0, self._safe)


class BoardSingle(BoardDac):
    """A board that takes one sample per message, paced by this machine."""

    def _open(self, sample_rate_hz: float, block: int) -> None:
        self._plan_feeding(sample_rate_hz)
        self._connect()
        if self._reader is not None:
            self._reader.open()
            self._reader.begin()
        self._try_out_safe_value()
        self.transactions = 1 if self._reader is None else 2

    def _exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        # First the reading, which must not show yet what the command does.
        read = None if self._reader is None else self._reader.read()
        found = self._session.exchange(self._chain.output(command))
        if found.values.size != 1:
            raise DeviceError(f"{found.values.size} readings came for one sample")
        self._chain.fill_um(found.values if read is None else np.array([read]), displacement_um)

    def _close(self) -> None:
        self._set_watchdog(None)
        if self._reader is not None:
            self._reader.end()


class BoardStream(BoardDac):
    """A board that plays blocks from its FIFO."""

    def _prepare(self) -> None:
        super()._prepare()
        if self._reader is not None:
            raise InputError("reader must be omitted: a board with a FIFO samples its own input")
        streaming = self._profile.streaming
        assert streaming != "none"
        self.block_max, self.fifo_depth = streaming.block_max, streaming.fifo_depth
        self._latency_blocks = self._options.fifo_blocks
        self._samples = 0
        self._next_sample = 0
        self.fifo_level_min = 0
        """Lowest level that an answer has reported since the output began to move."""

    def _open(self, sample_rate_hz: float, block: int) -> None:
        check_fifo(block, self._latency_blocks, self.fifo_depth)
        self._plan_feeding(sample_rate_hz / block)
        facts = self._connect(extra_s=block / sample_rate_hz)
        self._check_board(facts, sample_rate_hz, block)
        self._try_out_safe_value()  # before the clock, which SAFE stops
        prefill = self._latency_blocks * block
        self._session.set_clock(sample_rate_hz, prefill)
        self._samples = block
        self._next_sample = 0
        self.fifo_level_min = prefill
        self.transactions = 1

    def _exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        """Queue a block and wait for the readings of the one that it pushes out."""
        check_next(first_sample, self._next_sample)
        found = self._session.stream(first_sample, self._chain.output(command))
        self._check_answer(found, first_sample)
        self._next_sample += command.size
        if found.values.size:
            self._chain.fill_um(found.values, displacement_um)
            self.fifo_level_min = min(self.fifo_level_min, found.fifo_level)

    def _close(self) -> None:
        """Stop the clock and disarm; the output holds its last value."""
        # The clock first: an output that moves must not be without its watchdog.
        self._session.set_clock(0.0, 0)
        self._set_watchdog(None)

    def _check_board(self, facts: BoardFacts, sample_rate_hz: float, block: int) -> None:
        """Check rate and block against the limits that the board itself reports."""
        if sample_rate_hz > facts.rate_max_hz * (1.0 + 1e-6):
            rule = f"sample rate must be <= {facts.rate_max_hz:g} Hz, says {facts.name}"
            raise DeviceError(f"{rule}, got {sample_rate_hz:g}")
        if block > facts.block_max:
            raise DeviceError(f"block must be 1 to {facts.block_max} samples, got {block}")
        check_fifo(block, self._latency_blocks, facts.fifo_depth)

    def _check_answer(self, found: Readings, first_sample: int) -> None:
        if found.underruns:
            played = first_sample - self._latency_blocks * self._samples
            raise DeviceError(
                f"underrun: the FIFO of the board was empty for {found.underruns} sample periods, "
                f"about sample {max(0, played)}; its FIFO kept {self._latency_blocks} blocks of "
                f"{self._samples}: this machine or the line was slower than that; raise "
                "device.fifo_blocks"
            )
        answered = first_sample - self._latency_blocks * self._samples
        want = self._samples if answered >= 0 else 0
        if found.values.size != want or (want and found.first != answered % _FIRST_MAX):
            raise DeviceError(
                f"readings must be {want} from sample {max(0, answered)} on, got "
                f"{found.values.size} from {found.first}"
            )
        if not np.isfinite(found.values).all():
            raise DeviceError("the board sent readings that are not numbers")
