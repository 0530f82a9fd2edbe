"""A DAC and an ADC on a serial line or a TCP stream as one device: ``serial_dac``.

The profile names the protocol: lines of text (SCPI, GCS, DCON, GEN), frames of fixed bytes, a
board's frames sample by sample, or through its FIFO. Except for a FIFO, a tick is one request and
its reply, or two if writing and reading are separate. No request is sent before the last reply
has come, and the line is drained after a timeout.
"""

from pkgutil import resolve_name
from typing import ClassVar

from hilctl.base.device import DeviceOptions
from hilctl.base.errors import InputError
from hilctl_drivers.dac_setup import WiredDac
from hilctl_drivers.signal_chain import DacOptions, FifoBlocks, Measure
from hilctl_drivers.transport.safe_exchange import check_read_back
from hilctl_drivers.transport.stream_link import StreamLink


class SerialOptions(DacOptions):
    """Options of ``serial_dac``."""

    measure: Measure = None
    fifo_blocks: FifoBlocks = 8


class SerialDac(WiredDac):
    """A :class:`~hilctl_drivers.dac_setup.WiredDac` on a serial line or a TCP stream.

    ``SerialDac(options)`` makes the subclass that the profile names as its driver.
    """

    Options: ClassVar[type[DeviceOptions]] = SerialOptions
    KIND = "serial_dac"
    _link: StreamLink

    def __new__(cls, options: SerialOptions) -> "SerialDac":
        """Return an instance of the profile's driver."""
        profile = options.profile.profile
        driver = profile.driver
        if not driver:
            name, kind = options.profile.name, profile.DEVICE
            raise InputError(f"profile {name} is one for kind: {kind}, not serial_dac")
        made: SerialDac = object.__new__(resolve_name(driver) if cls is SerialDac else cls)
        return made

    def _check_read_back(self, wanted: float, found: float) -> None:
        """Reject a read-back that differs from the written value by more than two steps."""
        output = self._setup.output
        check_read_back(output, wanted, found, 2.0 * output.step)
