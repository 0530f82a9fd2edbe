"""Identity of a serial port: the device to which its path first led.

A path such as ``/dev/ttyUSB0``, or a link, leads to another device once the first is unplugged. A
process that retries the safe value must not send it there.
"""

import os
from contextlib import suppress
from pathlib import Path
from weakref import finalize

from hilctl_drivers.transport.links import LostError

PTY_MAJORS = range(136, 144)


class PortIdentity:
    """The device to which a port's path led when the device first existed.

    A USB adapter is known by :func:`usb_adapter`, any other port by its device number. The number
    of a closed pseudo-terminal is used again, so its file is kept too. Owner, mode and times, which
    change while the device stays, do not count.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self.known = ""
        """The device; empty before one existed."""
        self._pty = -1
        with suppress(OSError):
            self.device_file()

    def device_file(self) -> str:
        """Return the device file that the path leads to.

        Raises:
            OSError: There is none.
            LostError: It leads to a different device than the first time.
        """
        file = os.path.realpath(self._path)
        device = Path(file).stat().st_rdev
        found = usb_adapter(device) or f"device {os.major(device)}:{os.minor(device)}"
        if not self.known:
            if os.major(device) in PTY_MAJORS:
                # Not opened for use. Its count of links becomes 0 when the pseudo-terminal ends.
                self._pty = os.open(file, os.O_PATH)
                finalize(self, os.close, self._pty)
            self.known = found
        ended = self._pty >= 0 and not os.fstat(self._pty).st_nlink
        if ended or found != self.known:
            raise LostError(
                f"another device is at this port now ({found} instead of {self.known}"
                f"{', which has ended' if ended else ''}): "
                "name the port by its link in /dev/serial/by-id, which stays with the device"
            )
        return file


def usb_adapter(device: int, sysfs: Path = Path("/sys")) -> str:
    """Return the identity of the USB adapter that has a device number; empty if there is none.

    It begins with ``usb:``, vendor, product and serial number, or with ``socket:`` and its USB port
    if it has no number. An adapter with several ports adds the port.
    """
    number = f"{os.major(device)}:{os.minor(device)}"
    port = (sysfs / "dev" / "char" / number / "device").resolve()
    adapter = next((each for each in port.parents if (each / "idVendor").exists()), None)
    if adapter is None:
        return ""
    vendor, product, serial = (
        _text(adapter / name) for name in ("idVendor", "idProduct", "serial")
    )
    interface = port.relative_to(adapter).parts[0].rpartition(":")[2]
    which = "-".join(filter(None, (interface, _text(port / "port_number"))))
    place = f"usb:{vendor}:{product}:{serial}" if serial else f"socket:{adapter.name}"
    return f"{place}:{which}"


def adapter_of(path: str) -> str:
    """Return the identity of the USB adapter of a port now; empty if there is none."""
    with suppress(OSError):
        return usb_adapter(Path(path).stat().st_rdev)
    return ""


def _text(attribute: Path) -> str:
    """Return an attribute; empty if the device has none, OSError if it cannot be read now."""
    if not attribute.exists():
        return ""
    return attribute.read_text(encoding="utf-8", errors="replace").strip()
