"""The usual tick as a whole: one compiled call before its exchange, one after.

A tick is usual where nothing is asked of the run, nothing learns from the answers, there is room,
and none is skipped. What a tick writes into the ring and its page is written by these calls too, in
the same order; where a tick turns out to be another one, only the heartbeat has been written.
"""

from hilctl.base.device import Clock, Device
from hilctl.kernels import tick
from hilctl.kernels.jit import entry
from hilctl.loop.block import Block
from hilctl.loop.composed import Composed
from hilctl.loop.host import Direct
from hilctl.loop.interlocks import Trip
from hilctl.loop.pacer import Pacer


class UsualTicks:
    """A run's usual ticks.

    Args:
        composed: The run's.
        direct: Its host's.
        device: Its device, whose answers come with the exchange that they belong to.
        clock: Time.
    """

    def __init__(self, composed: Composed, direct: Direct, device: Device, clock: Clock) -> None:
        composed.stands_in(direct.area)
        self._composed, self._direct = composed, direct
        self._table, self._numbers = composed.table, direct.numbers
        self._device, self._clock = device, clock
        self._begin, self._end = entry(tick.begin_tick), entry(tick.end_tick)

    def begin(self, pacer: Pacer, first_sample: int, start: int, start_ns: int) -> int:
        """Bring the next block up to its exchange; see :func:`hilctl.kernels.tick.begin_tick`.

        Args:
            pacer: It has woken for this tick.
            first_sample: Of the block in the run.
            start: The same in the waveform.
            start_ns: When the run's first tick was due.

        Returns:
            Index of the first wish that is not finite, or -1; ``ASKED`` in a tick that is not
            usual.
        """
        if pacer.too_late() or not self._direct.supervised():
            return tick.ASKED
        deadline_ns, late_ns = pacer.deadline_ns, pacer.late_ns
        return self._begin(
            self._table,
            self._numbers,
            first_sample,
            start,
            deadline_ns - start_ns,
            late_ns,
            deadline_ns + late_ns,
            pacer.counters.late_ticks,
        )

    def exchange(self, first_sample: int) -> int:
        """Exchange the block, judge it, and hand it over where no interlock trips.

        Returns:
            Index of the first sample at which one does, or -1.

        Raises:
            DeviceError: The device can't be driven.
        """
        composed, now_ns = self._composed, self._clock.now_ns
        before_ns = now_ns()
        self._device.exchange(
            first_sample, composed.command, composed.displacement_um, composed.measured
        )
        return self._end(self._table, self._numbers, now_ns() - before_ns)

    def trip(self, block: Block, tripped: int) -> Trip | None:
        """Say what tripped at a sample of the newest block, which is not handed over."""
        # The limiter's command before the block is the one before it that was put out.
        return self._composed.trip(block, tripped, block.state.item(-1))

    def newest(self) -> Block:
        """Return the block that was sent last."""
        return self._direct.newest()
