"""Sessions with devices, and the reader of the sensor.

The device with the output reads the sensor, or another device of any protocol, which has its own
link or shares the line or connection of the output.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from pkgutil import resolve_name
from typing import Any, ClassVar, Self, cast

from hilctl.base.errors import DeviceError
from hilctl_drivers.endpoint import Endpoint
from hilctl_drivers.profile_base import Range
from hilctl_drivers.transport.links import ErrorPrefix, Link
from hilctl_drivers.transport.stream_link import StreamLink
from hilctl_drivers.transport.wire_time import WireTime


class Session(ABC):
    """A link to one device, with one request at a time; each protocol has its session."""

    AGES: ClassVar[bool] = False
    """Whether the device sends unsolicited samples, so that its readings have an age."""
    READS_ANY: ClassVar[bool] = True
    """Whether it can read any input of the device in a separate request."""
    age_s = math.nan
    """Age of the last reading, if it has one."""
    lost = 0
    """Number of readings since :meth:`start` that did not arrive, if they are counted."""
    link: Link

    @classmethod
    @abstractmethod
    def on(cls, device: Endpoint, link: Any) -> Self:
        """Return a session with the device."""

    @staticmethod
    def new_link(device: Endpoint) -> Any:
        """Return a link to the device, with ``open`` and ``close``."""
        return device.link()

    @staticmethod
    @abstractmethod
    def read_time(profile: Any, source: Any) -> WireTime:
        """Return the time of reading an input."""

    @staticmethod
    def request(device: Endpoint, source: Any) -> bytes:
        """Return the first request of a reading; empty if its bytes differ from time to time."""
        return b""

    @abstractmethod
    def identify(self) -> None:
        """Raise DeviceError if it is another device."""

    def old_errors(self) -> list[str]:
        """Read and clear the errors of earlier sessions."""
        return []

    def check_errors(self) -> None:  # noqa: B027  most devices answer each command
        """Raise RefusedError for an error of earlier commands without a reply."""

    def set_up(self) -> None:  # noqa: B027  not all profiles have steps
        """Run the init steps."""

    def finish(self) -> None:  # noqa: B027
        """Run the close steps."""

    def start(self) -> None:  # noqa: B027  most devices send nothing unasked
        """Discard what has arrived before the first exchange."""

    @abstractmethod
    def input_reader(self, source: Any) -> Callable[[], float]:
        """Return a function that returns the value of an input, in its unit; NaN if invalid."""

    def set_digital(self, output: Any, high: bool) -> None:
        """Set a digital output."""
        raise DeviceError("there is no digital output")

    def is_high(self, source: Any) -> bool:
        """Return whether a digital input is high."""
        raise DeviceError("there is no digital input")


class SteppedSession(Session):
    """A session that runs the steps of its profile; the static methods return times on the line."""

    profile: Any

    @staticmethod
    @abstractmethod
    def digital_time(profile: Any, output: Any) -> WireTime:
        """Return the time of setting a digital output."""

    @staticmethod
    @abstractmethod
    def steps_time(profile: Any, steps: Any) -> WireTime:
        """Return the longest time of steps; a step that may write counts as one that does."""

    @classmethod
    def feed_time(cls, profile: Any) -> WireTime | None:
        """Return the time to feed the device's watchdog once; None if exchanges feed it."""
        watchdog = profile.watchdog
        if watchdog == "none" or watchdog.kick != "strict":
            return None
        return cls.steps_time(profile, watchdog.feed).named("to feed the watchdog")

    @classmethod
    def arm_s(cls, profile: Any, output: str) -> float:
        """Return the longest time to arm the device's watchdog, s; 0 without a watchdog."""
        watchdog = profile.watchdog
        if watchdog == "none":
            return 0.0
        steps = (*getattr(watchdog, "unlock", ()), *watchdog.arming(output))
        return cls.steps_time(profile, steps).answered_s

    @abstractmethod
    def run(self, steps: Any) -> None:
        """Execute steps; raise DeviceError if one fails."""

    def set_up(self) -> None:
        """Run the init steps."""
        self.run(self.profile.init)

    def finish(self) -> None:
        """Run the close steps."""
        self.run(self.profile.close)


def session_class(device: Endpoint) -> type[Session]:
    """Return the class of sessions in the protocol of a device."""
    return cast("type[Session]", resolve_name(device.profile.SESSION))


class SensorReader:
    """Reader of an input.

    A device other than the one with the output is named in errors, and connected, set up and
    finished here.

    Args:
        device: The device.
        source: The input.
        link: Link to the device with the output, which it uses if ``own`` is false.
        name: Name of another device in messages; empty if it has the output too.
        own: Whether it has a link of its own.
    """

    def __init__(
        self, device: Endpoint, source: Range, link: Link, name: str = "", *, own: bool = False
    ) -> None:
        self._name = name
        self._own = session_class(device).new_link(device) if own else None
        self.link: Link = self._own or link
        self.session: Session = session_class(device).on(device, self.link)
        self._read = self.session.input_reader(source)
        self._request = self.session.request(device, source) if own else b""

    def open(self) -> None:
        """Connect and identify the device."""
        if self._name:
            with ErrorPrefix(self._name):
                if self._own is not None:
                    self._own.open()
                self.session.identify()

    def begin(self) -> None:
        """Run the init steps, and read once: a wrong input must show before the output moves."""
        if self._name:
            with ErrorPrefix(self._name):
                self.session.set_up()
                self._read()

    def read(self) -> float:
        """Return the value of the input in its unit."""
        with ErrorPrefix(self._name):
            return self._read()

    def read_while(self, write: Callable[[], object]) -> float:
        """Return :meth:`read`, and write the output.

        On a link of its own, the device answers while ``write`` waits for another one. Otherwise
        the reading comes first.
        """
        if not self._request:
            found = self.read()
            write()
            return found
        with ErrorPrefix(self._name):
            cast(StreamLink, self.link).begin(self._request)
        write()
        return self.read()

    def end(self) -> None:
        """Run the close steps."""
        if self._name:
            with ErrorPrefix(self._name):
                self.session.finish()

    def release(self) -> None:
        """Close its own link."""
        if self._own is not None:
            self._own.close()
