"""A DAC and an ADC on a serial line or a TCP stream as one device: ``serial_dac``.

The profile names the protocol: lines of text (SCPI, GCS, DCON, GEN), frames of fixed bytes, a
board's frames sample by sample, or through its FIFO. Except for a FIFO, a tick is one request and
its reply, or two if writing and reading are separate. No request is sent before the last reply
has come, and the line is drained after a timeout.
"""

from abc import abstractmethod
from pkgutil import resolve_name
from typing import ClassVar

from hilctl.base.device import DeviceInfo, DeviceOptions
from hilctl.base.errors import InputError
from hilctl_drivers.dac_setup import DacSetup, WiredDac
from hilctl_drivers.signal_chain import DacOptions, FifoBlocks, Measure
from hilctl_drivers.transport.safe_exchange import check_read_back
from hilctl_drivers.transport.stream_link import StreamLink

_PROMPT_S = 0.2
"""A longer delay of the safe value is mentioned in ``safe_note``."""


class SerialOptions(DacOptions):
    """Options of ``serial_dac``."""

    measure: Measure = None
    fifo_blocks: FifoBlocks = 8


class SerialDac(WiredDac):
    """A :class:`~hilctl_drivers.dac_setup.WiredDac` on a serial line or a TCP stream.

    ``SerialDac(options)`` makes the subclass that the profile names as its driver.
    """

    Options: ClassVar[type[DeviceOptions]] = SerialOptions
    _link: StreamLink
    block_max = 1  # samples of one exchange
    fifo_depth = 0  # samples; 0 without a FIFO
    measures = False  # whether exchanges fill ``measured``
    longest_message_s = 0.0  # longest delay of the safe value by a running exchange
    arm_s = 0.0  # longest time to arm the watchdog
    unconfirmed = ""  # why a written value cannot be confirmed; empty if it can

    def __new__(cls, options: SerialOptions) -> "SerialDac":
        """Return an instance of the profile's driver."""
        profile = options.profile.profile
        driver = profile.driver
        if not driver:
            name, kind = options.profile.name, profile.DEVICE
            raise InputError(f"profile {name} is one for kind: {kind}, not serial_dac")
        made: SerialDac = object.__new__(resolve_name(driver) if cls is SerialDac else cls)
        return made

    def __init__(self, options: SerialOptions) -> None:
        """Describe the device; nothing is sent before :meth:`open`.

        Raises:
            InputError: The profile cannot be used, or the options do not fit it.
        """
        self._options = options
        self._setup = setup = DacSetup.of(options)
        self._chain = setup.chain
        self._link = setup.writer.stream()
        self._prepare()
        action = f"write {options.output}, read {options.input}"
        super().__init__(setup, self._describe(), action, self._link)

    @abstractmethod
    def _prepare(self) -> None:
        """Set the attributes of the class; raise InputError if an option is not supported."""

    def _describe(self) -> DeviceInfo:
        options, streams = self._options, self.fifo_depth > 0
        details = {}
        if streams:
            details["fifo_depth"] = f"{self.fifo_depth} samples"
            details["fifo_level"] = f"{options.fifo_blocks} blocks"
        return self._setup.info(
            "serial_dac",
            self._rates(self.block_max),
            buffered=streams,
            fifo_depth=self.fifo_depth,
            latency_blocks=options.fifo_blocks if streams else 0,
            measures_command=self.measures,
            arm_s=0.0 if options.watchdog == "none" else self.arm_s,
            safe_note="; ".join(filter(None, (self._late_note(), self.unconfirmed))),
            confirms=not self.unconfirmed,
            details=details,
        )

    def _late_note(self) -> str:
        if self.longest_message_s <= _PROMPT_S:
            return ""
        timeout_s = self._options.watchdog_timeout_s
        behind = "no watchdog of the device stands behind it"
        if timeout_s is not None:
            behind = f"the device's watchdog acts after {timeout_s:g} s"
        return f"a message takes up to {self.longest_message_s:.2g} s on this line; {behind}"

    def _longest_block(self) -> tuple[int, str]:
        return self.block_max, ""

    def _check_read_back(self, wanted: float, found: float) -> None:
        """Reject a read-back that differs from the written value by more than two steps."""
        output = self._setup.output
        check_read_back(output, wanted, found, 2.0 * output.step)
