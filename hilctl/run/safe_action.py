"""Putting the output at its safe value in the place of a loop that can't."""

from collections.abc import Callable
from threading import Thread

from hilctl.base.device import Device
from hilctl.base.errors import DeviceError
from hilctl.run.shared_page import MadeSafe


class SafeAction:
    """Makes a device safe in a thread of its own, so that whoever started it can go on.

    Args:
        device: Not open; it opens a connection of its own.
        value: The safe value, in the device's command unit.
        hung: Whether the loop had to be killed for it.
        prepare: Called in that thread first.
    """

    def __init__(
        self,
        device: Device,
        value: float,
        *,
        hung: bool,
        prepare: Callable[[], object] = lambda: None,
    ) -> None:
        self._device, self._value, self._hung = device, value, hung
        self._prepare = prepare
        self._made_safe: MadeSafe | None = None
        # A daemon: a device that keeps it for ever must not keep the process from ending.
        self._thread = Thread(target=self._make_safe, name="make safe", daemon=True)
        self._thread.start()

    def _make_safe(self) -> None:
        error = ""
        try:
            self._prepare()
            self._device.make_safe(self._value)
        except DeviceError as raised:
            error = str(raised)
        except Exception as raised:  # noqa: BLE001  no error may pass for a confirmed output
            error = f"{type(raised).__name__}: {raised}"
        self._made_safe = MadeSafe(self._hung, error)

    def result(self, wait_s: float = 0.0) -> MadeSafe | None:
        """Return what came of it; None where it still goes on after ``wait_s``."""
        self._thread.join(wait_s)
        return self._made_safe
