"""The host watchdog of an emulated device, driven by the registers that the profile names."""

from hilctl_drivers.emulator.registers import Words
from hilctl_drivers.modbus.channels import EnsureStep, ModbusStep, WriteStep
from hilctl_drivers.modbus.profile import ModbusWatchdog

Target = tuple[Words, list[int] | None]
"""A value and the words that trigger something; None stands for any words but zeros."""


class EmulatedWatchdog:
    """Trips when the host has been silent for the timeout.

    It is armed by the last of the profile's arm steps and disarmed by the last of the disarm steps,
    as they are written; so it starts as a new device would, disarmed.

    Args:
        profile: What the profile says of it.
        words: Looks up the value that a step writes.
    """

    def __init__(self, profile: ModbusWatchdog, words: dict[int, Words]) -> None:
        self._profile = profile
        self._arm = _last(profile.arm, words)
        self._disarm = _last(profile.disarm, words)
        self._clear = _last(profile.clear, words)
        self._feed = _last(profile.feed, words)
        self._timeout = next(
            (words[id(s)] for s in profile.arm if getattr(s, "value", "") == "timeout"), None
        )
        self._fed_ns = 0
        self.armed = False
        self.tripped = False

    @property
    def timeout_s(self) -> float:
        """What the timeout register says, in s; the profile's shortest where it has none."""
        if self._timeout is None:
            return self._profile.min_s
        register = self._timeout.register
        raw = (self._timeout.value - register.offset) / register.scale
        return raw * self._profile.unit_s

    @property
    def due_ns(self) -> int | None:
        """When it will trip if nothing comes, or None."""
        if not self.armed or self.tripped:
            return None
        return self._fed_ns + round(self.timeout_s * 1e9)

    def request(self, now_ns: int) -> None:
        """Note that a request has come."""
        if self._profile.kick == "any":
            self._fed(now_ns)

    def written(self, target: Words, now_ns: int) -> None:
        """Note that a value was written."""
        if self._profile.kick == "write" or _hit(self._feed, target):
            self._fed(now_ns)
        if _hit(self._disarm, target):
            self.armed = False
        if self._arm is not None and self._arm[0] is target:  # any other value there stops it
            self.armed = _hit(self._arm, target) and self.timeout_s > 0.0
            self._fed_ns = now_ns
        if _hit(self._clear, target):
            self.tripped = False
            self._fed_ns = now_ns

    def _fed(self, now_ns: int) -> None:
        self._fed_ns = now_ns
        if not self._profile.clear:  # nothing else could end the trip
            self.tripped = False


def _last(steps: tuple[ModbusStep, ...], words: dict[int, Words]) -> Target | None:
    """Return what the last writing step writes."""
    for step in reversed(steps):
        if isinstance(step, WriteStep | EnsureStep):
            found = words[id(step)]
            if isinstance(step.value, str):
                return found, None
            return found, Words(step).encoded(step.value)
    return None


def _hit(trigger: Target | None, target: Words) -> bool:
    if trigger is None or trigger[0] is not target:
        return False
    return any(target.words) if trigger[1] is None else target.words == trigger[1]
