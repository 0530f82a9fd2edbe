"""An emulated Modbus device: a profile's registers in front of the simulated rig."""

from collections.abc import Sequence

from hilctl.base.types import F64
from hilctl_drivers.emulator.labjack_stream import LabJackStream
from hilctl_drivers.emulator.registers import RegisterMap, Words
from hilctl_drivers.emulator.rig import Bench, EmulatedDevice, WatchdogTimer
from hilctl_drivers.emulator.wire import RejectedRequest
from hilctl_drivers.modbus.modbus_profile import ModbusProfile, ModbusWatchdog
from hilctl_drivers.modbus.register_map import EnsureStep, ModbusStep, RegisterStep, WriteStep

Target = tuple[Words, bytes | None]
"""A value and the words that trigger an action; None means any words except zeros."""


class EmulatedWatchdog(WatchdogTimer):
    """Watchdog that trips when the host has been silent for the timeout.

    The last arm step of the profile arms it and the last disarm step disarms it when written, so it
    starts disarmed, as a new device does. ``words`` has the value of each step, by its ``id``.
    """

    def __init__(self, profile: ModbusWatchdog, words: dict[int, Words]) -> None:
        super().__init__()
        self._profile = profile
        self._arm = _last(profile.arm, words)
        self._disarm = _last(profile.disarm, words)
        self._clear = _last(profile.clear, words)
        self._feed = _last(profile.feed, words)
        self._timeout = next(
            (words[id(s)] for s in profile.arm if getattr(s, "value", "") == "timeout"), None
        )
        self.armed = False

    @property
    def timeout_s(self) -> float:
        """Value of the timeout register, s; the profile's shortest if it has none."""
        if self._timeout is None:
            return self._profile.min_s
        register = self._timeout.register
        raw = (self._timeout.value - register.offset) / register.scale
        return raw * self._profile.unit_s

    @property
    def due_ns(self) -> int | None:
        """See :attr:`WatchdogTimer.due_ns`; the timeout is in a register."""
        self.timeout_ns = round(self.timeout_s * 1e9) if self.armed else 0
        return super().due_ns

    def request(self, now_ns: int) -> None:
        """Note a request."""
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
            self.fed_ns = now_ns
        if _hit(self._clear, target):
            self.tripped = False
            self.fed_ns = now_ns

    def _fed(self, now_ns: int) -> None:
        self.fed_ns = now_ns
        if not self._profile.clear:  # nothing else could end the trip
            self.tripped = False


def _last(steps: tuple[ModbusStep, ...], words: dict[int, Words]) -> Target | None:
    """Return the write of the last step that writes."""
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
    return any(target.data) if trigger[1] is None else target.data == trigger[1]


class EmulatedModbus(EmulatedDevice):
    """The device: its registers, and the effects of writing them.

    It powers up as the profile says, or at ``command``; otherwise with its rigs at 0.
    """

    profile: ModbusProfile

    def __init__(self, profile: ModbusProfile, bench: Bench, command: float | None = None) -> None:
        super().__init__(profile, bench)
        self.memory = RegisterMap(profile)
        self._steps = self.memory.steps
        self._outputs, self._inputs = self.memory.outputs, self.memory.inputs
        watchdog, streaming = profile.watchdog, profile.streaming
        self._watchdog = None if watchdog == "none" else EmulatedWatchdog(watchdog, self._steps)
        if self._watchdog is not None:
            self._timer = self._watchdog
        self.overlay: LabJackStream | None = None  # registers of a stream, before all others
        if streaming != "none":
            self.overlay = LabJackStream(profile, streaming, bench, on_played=self._played)
        self._power_up(command)

    def _power_up(self, command: float | None) -> None:
        for name, words in self._outputs.items():
            value = self.profile.outputs[name].power_up
            if name in self._driven:
                driven = self._driven[name]
                if value is None or command is not None:
                    value = driven.wiring.output(command or 0.0)
                driven.rig.put_out(driven.wiring.command(value), 0)
            if value is not None:
                words.value = value

    def _advance(self) -> None:
        if self.overlay is not None:
            self.overlay.tick(self._now_ns)
        super()._advance()

    def _played(self, name: str, first: int, command: F64, now_ns: int) -> None:
        self._driven[name].rig.put_out(float(command[-1]), now_ns)
        self._outputs[name].value = self._log_played(name, first, command, now_ns)

    def request(self, now_ns: int) -> None:
        """Note that a request has come; before it is executed."""
        self.tick(now_ns)
        if self._watchdog is not None:
            self._watchdog.request(self._now_ns)

    def read(self, areas: Sequence[str], address: int, count: int) -> bytes:
        """Return register words; raise RejectedRequest if not all exist."""
        if self.overlay is not None and self.overlay.has(address):
            return self.overlay.read(address, count)
        self._measure()
        return self.memory.read(areas, address, count)

    def written(self, area: str, address: int, count: int) -> set[str]:
        """Return the outputs with a register among those of a write."""
        outputs = self.profile.outputs.items()
        found = {name: (each.area, self.profile.wire_address(each)) for name, each in outputs}
        return {
            name for name, (of, at) in found.items() if of == area and 0 <= at - address < count
        }

    def write(self, area: str, address: int, data: bytes) -> None:
        """Write all register words, or raise RejectedRequest and write none."""
        if self.overlay is not None and self.overlay.has(address):
            self.overlay.write(address, data)
            return
        targets = self.memory.targets(area, address, data)
        before = [words.data for words, _ in targets]
        for words, wanted in targets:
            words.data = wanted
        try:
            for words, _ in targets:
                self._check(words)
        except RejectedRequest:
            for (words, _), old in zip(targets, before, strict=True):
                words.data = old
            register = self.profile.error_register
            if register == "none":
                raise
            self._steps[id(register)].set_bits(register.mask, register.mask)
            return
        tripped = self.tripped
        for words, _ in targets:
            self._act(words)
        if tripped and not self.tripped:
            self._resume()

    def _check(self, words: Words) -> None:
        for name, each in self._outputs.items():
            if each is words:
                channel = self.profile.outputs[name]
                low, high = channel.limits
                margin = 0.5 * channel.step + 1e-6 * (high - low)
                if not low - margin <= words.value <= high + margin:
                    raise RejectedRequest(3)
                watchdog = self.profile.watchdog
                if self.tripped and watchdog != "none" and watchdog.refuses_while_tripped:
                    raise RejectedRequest(4)

    def _act(self, words: Words) -> None:
        if self._watchdog is not None:
            self._watchdog.written(words, self._now_ns)
        for name, each in self._outputs.items():
            # If a step clears the trip, the terminals keep their values until then.
            if each is words and not (self.tripped and self._holds_trip):
                self._put_out(name, "write", self._now_ns)
        for name, output in self.profile.digital_outputs.items():
            if self._steps[id(output)] is words:
                self._log.event(self._now_ns, "digital", output=name, value=words.value)

    @property
    def _holds_trip(self) -> bool:
        """Whether a trip is kept until a step clears it, and registers keep their commands."""
        return self.profile.watchdog != "none" and bool(self.profile.watchdog.clear)

    def _resume(self) -> None:
        """Output the content of the registers, as a device may after its trip is cleared."""
        # A device that refuses commands until then waits for the next command.
        watchdog = self.profile.watchdog
        if watchdog != "none" and not watchdog.refuses_while_tripped:
            for name in self._outputs:
                self._put_out(name, "cleared", self._now_ns)

    def _put_out(self, name: str, event: str, now_ns: int) -> None:
        self._set_terminal(name, self._outputs[name].value, event, now_ns)

    def _trip(self, due_ns: int) -> None:
        watchdog = self.profile.watchdog
        assert watchdog != "none"
        if self.overlay is not None:
            self.overlay.stop(due_ns)
        for name, words in self._outputs.items():
            channel = self.profile.outputs[name]
            value: float | None = min(max(0.0, channel.min), channel.max)
            if watchdog.on_trip == "safe":
                value = self._safe_value(name, watchdog.safe.get(name) or watchdog.arm)
            if value is None or watchdog.on_trip in {"hold", "unknown"}:
                continue
            if not self._holds_trip:
                words.value = value
            self._set_terminal(name, value, "watchdog", due_ns)

    def _safe_value(self, name: str, steps: tuple[ModbusStep, ...]) -> float | None:
        """Return the content of the safe-value register; None if it was not enabled."""
        channel = self.profile.outputs[name]
        found: float | None = None
        for step in steps:
            if not isinstance(step, RegisterStep):
                continue
            words = self._steps[id(step)]
            if step.value == "safe":
                scaled = {"scale": channel.scale, "offset": channel.offset}
                view = Words(step.model_copy(update=scaled))
                view.data = words.data
                found = view.value
            elif isinstance(step.value, float) and words.data != Words(step).encoded(step.value):
                return None
        return found

    def _measure(self) -> None:
        for name, source in self.profile.inputs.items():
            self._inputs[name].value = self._reading(name, source)
        for name in self._shown:
            validity = self.profile.inputs[name].validity
            if validity != "none":
                bits = validity.valid ^ (validity.mask * self._is_invalid)
                self._steps[id(validity)].set_bits(validity.mask, bits)
        for digital in self.profile.digital_inputs.values():
            self._steps[id(digital)].value = float(self.digital_input)
        watchdog = self.profile.watchdog
        if watchdog != "none" and watchdog.tripped != "none":
            flag = watchdog.tripped
            self._steps[id(flag)].set_bits(flag.mask, flag.mask * self.tripped)
