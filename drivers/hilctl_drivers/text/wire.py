"""A device that speaks lines of text, sample by sample; its sensor may stand behind another one."""

from collections.abc import Iterator
from contextlib import contextmanager

from hilctl.base.arrays import F64
from hilctl.base.errors import DeviceError
from hilctl_drivers.feed_time import check_feeds
from hilctl_drivers.serial.setup import SerialSetup
from hilctl_drivers.text.lines import parse_number
from hilctl_drivers.text.profile import AsciiInput, AsciiOutput, AsciiProfile
from hilctl_drivers.text.session import AsciiSession
from hilctl_drivers.wire.errors import WatchdogTripped
from hilctl_drivers.wire.links import LostError


class AsciiWire:
    """A :class:`~hilctl_drivers.board.wire.Wire` of lines.

    Args:
        setup: What the experiment says of it.
        profile: What the device is.
    """

    def __init__(self, setup: SerialSetup, profile: AsciiProfile) -> None:
        assert isinstance(setup.output, AsciiOutput)
        assert isinstance(setup.input, AsciiInput)
        self._setup = setup
        self._profile = profile
        self._output, self._input = setup.output, setup.input
        self._measure = setup.measure
        self._link = setup.link()
        self._writer = AsciiSession(profile, self._link, setup.address)
        self._reader_link = self._link
        self._reader = self._writer
        if setup.reader is not None:
            if setup.options.reader_port is not None:
                self._reader_link = setup.reader_link()
            self._reader = AsciiSession(setup.reader, self._reader_link, setup.reader_address)
        self._feed_every = 0
        self._ticks = 0

    def open(self, sample_rate_hz: float, block: int) -> None:
        """See :meth:`~hilctl_drivers.board.wire.Wire.open`."""
        if block != 1:
            raise DeviceError(f"block must be 1 on a line of text, got {block}")
        feed_every = check_feeds(self._setup.watchdog_timeout_s, sample_rate_hz)
        self._open_links()
        writer, watchdog = self._writer, self._profile.watchdog
        writer.check_selftest()
        self._clear_trip()
        writer.run(self._profile.init)
        if self._setup.reader is not None:
            with self._reader_named():
                self._reader.check_selftest()
                self._reader.run(self._setup.reader.init)
        self._feed_every = 0
        if watchdog != "none" and self._setup.options.watchdog != "none":
            self._run("safe")
            self._run("arm")
            self._feed_every = feed_every if watchdog.kick == "strict" else 0
        writer.check_errors()
        self._ticks = 0

    def exchange(self, first_sample: int, output: F64, reading: F64, measured: F64) -> None:
        """See :meth:`~hilctl_drivers.board.wire.Wire.exchange`."""
        del first_sample
        value = output.item() + 0.0  # makes 0.0 of -0.0
        combined = self._profile.exchange
        if combined != "none" and self._is_combined:
            text = self._writer.text(combined.write, value=value)
            found = parse_number(self._writer.ask(text, combined.pattern)[1])
        else:
            # First the reading, which must not show yet what the command does.
            found = self._read()
            self._write(value)
        reading[0] = found * self._input.scale + self._input.offset
        if self._measure is not None:
            found = self._writer.number(self._measure)
            measured[0] = found * self._measure.scale + self._measure.offset
        self._feed()

    def put_out(self, value: float) -> None:
        """See :meth:`~hilctl_drivers.board.wire.Wire.put_out`."""
        try:
            self._put_out(value)
        except LostError:
            self._link.open()  # a replugged adapter is a new port
            self._put_out(value)
        except DeviceError:
            self._put_out(value)  # a late or damaged answer must not cost the safe value

    def close(self) -> None:
        """See :meth:`~hilctl_drivers.board.wire.Wire.close`."""
        try:
            if self._profile.watchdog != "none" and self._setup.options.watchdog != "none":
                self._run("disarm")
            self._writer.run(self._profile.close)
            self._writer.check_errors()
        finally:
            self.release()

    def release(self) -> None:
        """See :meth:`~hilctl_drivers.board.wire.Wire.release`."""
        self._link.close()
        self._reader_link.close()

    @property
    def _is_combined(self) -> bool:
        combined, options = self._profile.exchange, self._setup.options
        if combined == "none" or self._setup.reader is not None:
            return False
        return (combined.output, combined.input) == (options.output, options.input)

    def _open_links(self) -> None:
        self._link.open()
        if self._reader_link is not self._link:
            with self._reader_named():
                self._reader_link.open()

    def _read(self) -> float:
        try:
            return self._reader.number(self._input)
        except DeviceError as error:
            raise self._named(error) from None

    @contextmanager
    def _reader_named(self) -> Iterator[None]:
        try:
            yield
        except DeviceError as error:
            raise self._named(error) from None

    def _named(self, error: DeviceError) -> DeviceError:
        """Return an error that says that the reader made it, where it is another device."""
        if self._setup.reader is None:
            return error
        reader, options = self._setup.reader, self._setup.options
        where = options.reader_port or f"address {self._setup.reader_address}"
        return DeviceError(f"reader {reader.title} at {where}: {error}")

    def _write(self, value: float) -> None:
        text = self._writer.text(self._output.write, value=value)
        self._writer.command(text, self._output.reply)

    def _put_out(self, value: float) -> None:
        """Write a value and make sure that it stands, where the device can tell."""
        try:
            self._write(value)
        except WatchdogTripped:
            self._clear_trip()
            self._write(value)
        readback = self._output.readback
        if readback == "none":
            self._writer.check_errors()
        else:
            found = self._writer.number(readback)
            step = 2.0 * (self._output.resolution or 1e-3 * (self._output.max - self._output.min))
            if not abs(found - value) <= step:
                raise DeviceError(f"{value:g} {self._output.unit} was written, {found:g} stands")

    def _clear_trip(self) -> None:
        """Clear a trip; the output stays where the watchdog has put it."""
        watchdog = self._profile.watchdog
        if watchdog == "none" or not watchdog.clear:
            return
        if watchdog.tripped == "none" or self._writer.tripped():
            self._run("clear")

    def _run(self, name: str) -> None:
        """Run the watchdog's steps of that name."""
        watchdog = self._profile.watchdog
        if watchdog == "none":
            return
        steps = getattr(watchdog, name)
        if name == "safe":
            steps = steps.get(self._setup.options.output, ())
        timeout_s = self._setup.watchdog_timeout_s
        counts = watchdog.counts(watchdog.min_s if timeout_s is None else timeout_s)
        self._writer.run(steps, timeout=counts, safe=self._setup.safe_output)

    def _feed(self) -> None:
        """Feed a watchdog that exchanges don't feed; three times in its timeout."""
        if not self._feed_every:
            return
        self._ticks += 1
        if self._ticks % self._feed_every == 0:
            self._run("feed")
