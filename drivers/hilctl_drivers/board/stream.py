"""A microcontroller board with a sample clock and a FIFO of its own, fed block by block.

The board answers a block when all but ``prefill`` of the samples queued so far have been put out,
and gives back the readings of those. So its clock is the pace; a block's readings come
``fifo_blocks`` exchanges after it; and between two exchanges the FIFO holds that many blocks, which
is how long this machine may stall. The first sample is put out once that many are there.
"""

import numpy as np

from hilctl.base.arrays import F64
from hilctl.base.errors import DeviceError
from hilctl_drivers.board.profile import FrameProfile, FrameStreaming
from hilctl_drivers.board.session import BoardFacts, Readings
from hilctl_drivers.board.wire import BoardWire
from hilctl_drivers.feed_time import check_feeds
from hilctl_drivers.serial.setup import SerialSetup

_FIRST_MAX = 2**32


class BoardStream(BoardWire):
    """A :class:`~hilctl_drivers.board.wire.Wire` to a board that plays blocks from its FIFO.

    Args:
        setup: What the experiment says of it.
        profile: What the board is.
        streaming: What its FIFO is.
    """

    def __init__(
        self, setup: SerialSetup, profile: FrameProfile, streaming: FrameStreaming
    ) -> None:
        super().__init__(setup, profile)
        self._streaming = streaming
        self._latency_blocks = setup.options.fifo_blocks
        self._block = 0
        self._next_sample = 0
        self.fifo_level_min = 0
        """Lowest level that an answer has told of since the output began to move."""

    def open(self, sample_rate_hz: float, block: int) -> None:
        """See :meth:`~hilctl_drivers.board.wire.Wire.open`; starts no clock yet."""
        self._check(sample_rate_hz, block, self._streaming.fifo_depth, self._streaming.block_max)
        check_feeds(self._setup.watchdog_timeout_s, sample_rate_hz / block)
        facts = self._connect(self._setup.link(extra_s=block / sample_rate_hz))
        self._check_board(facts, sample_rate_hz, block)
        self._arm()
        prefill = self._latency_blocks * block
        self._session.set_clock(sample_rate_hz, prefill)
        self._block = block
        self._next_sample = 0
        self.fifo_level_min = prefill

    def exchange(self, first_sample: int, output: F64, reading: F64, measured: F64) -> None:
        """Queue a block and wait for the readings of the one that it pushes out.

        Raises:
            DeviceError: No good answer in time; samples that don't follow the last ones; the board
                ran out of samples.
        """
        del measured
        if first_sample != self._next_sample:
            rule = f"samples must follow one another, {self._next_sample} is next"
            raise DeviceError(f"{rule}, got {first_sample}: open again to start at 0")
        found = self._session.stream(first_sample, output)
        self._check_answer(found, first_sample)
        self._next_sample += output.size
        if found.values.size:
            reading[:] = found.values
            self.fifo_level_min = min(self.fifo_level_min, found.fifo_level)

    def close(self) -> None:
        """Stop the clock, disarm, and let go of the port; the output holds its last value."""
        try:
            self._session.set_clock(0.0, 0)
            self._disarm()
        finally:
            self.release()

    def _check(self, sample_rate_hz: float, block: int, depth: int, block_max: int) -> None:
        if sample_rate_hz < self._streaming.rate_min_hz:
            rule = f"sample rate must be >= {self._streaming.rate_min_hz:g} Hz"
            raise DeviceError(f"{rule}, got {sample_rate_hz:g}")
        if not 1 <= block <= block_max:
            raise DeviceError(f"block must be 1 to {block_max} samples, got {block}")
        need = (self._latency_blocks + 1) * block
        if need > depth:
            most = depth // block - 1
            rule = f"fifo_blocks + 1 blocks must fit into the FIFO, {depth} samples"
            hint = f"at most {most} with this block" if most else "take smaller blocks"
            raise DeviceError(f"{rule}, got {need} ({hint})")

    def _check_board(self, facts: BoardFacts, sample_rate_hz: float, block: int) -> None:
        """Hold what is wanted against what the board itself says, which may be less."""
        if sample_rate_hz > facts.rate_max_hz * (1.0 + 1e-6):
            rule = f"sample rate must be <= {facts.rate_max_hz:g} Hz, says {facts.name}"
            raise DeviceError(f"{rule}, got {sample_rate_hz:g}")
        self._check(sample_rate_hz, block, facts.fifo_depth, facts.block_max)

    def _check_answer(self, found: Readings, first_sample: int) -> None:
        if found.underruns:
            played = first_sample - self._latency_blocks * self._block
            raise DeviceError(
                f"underrun: the board had nothing to put out for {found.underruns} sample periods, "
                f"about sample {max(0, played)}; its FIFO kept {self._latency_blocks} blocks of "
                f"{self._block}: this machine or the line was slower than that"
            )
        answered = first_sample - self._latency_blocks * self._block
        want = self._block if answered >= 0 else 0
        if found.values.size != want or (want and found.first != answered % _FIRST_MAX):
            raise DeviceError(
                f"readings must be {want} from sample {max(0, answered)} on, got "
                f"{found.values.size} from {found.first}"
            )
        if not np.isfinite(found.values).all():
            raise DeviceError("the board sent readings that are not numbers")
