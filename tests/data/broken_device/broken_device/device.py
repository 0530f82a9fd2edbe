"""A device that fails, exits or does not return in one of its methods."""

import sys
from typing import Any, ClassVar

from hilctl.base import Device, DeviceInfo, DeviceOptions


def fail(how: str) -> None:
    if how == "raises":
        raise RuntimeError("no licence")
    if how == "exits":
        sys.exit(0)
    while True:
        pass


class BrokenOptions(DeviceOptions):
    at: str = ""
    how: str = "raises"


class Broken(Device):
    Options: ClassVar[type[DeviceOptions]] = BrokenOptions

    def __init__(self, options: BrokenOptions) -> None:
        self._options = options
        self._fail_at("init")

    def _fail_at(self, name: str) -> None:
        if self._options.at == name:
            fail(self._options.how)

    @property
    def info(self) -> DeviceInfo:
        self._fail_at("info")
        return DeviceInfo("broken", "broken", "V", 0.0, 10.0, -1.0, 11.0, 1e4, simulated=True)

    def check_rate(self, *_: Any) -> None:
        self._fail_at("check_rate")

    def open(self, *_: Any) -> None:
        self._fail_at("open")

    def output(self) -> float:
        self._fail_at("output")
        return 0.0

    def exchange(
        self, first_sample: int, command: Any, displacement_um: Any, measured: Any
    ) -> None:
        if first_sample >= 20:
            self._fail_at("exchange")
        displacement_um[:] = command

    def make_safe(self, command: float) -> None:
        self._fail_at("make_safe")

    def close(self) -> None:
        self._fail_at("close")
