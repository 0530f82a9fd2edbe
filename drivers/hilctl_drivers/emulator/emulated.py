"""An emulated Modbus device: a profile's registers in front of the simulated rig."""

from collections.abc import Sequence
from dataclasses import dataclass

from hilctl.errors import InputError
from hilctl_drivers.emulator.memory import Memory, NoSuchRegister, Words
from hilctl_drivers.emulator.rig import Rig
from hilctl_drivers.emulator.watchdog import HostWatchdog
from hilctl_drivers.emulator.write_log import WriteLog
from hilctl_drivers.profile_modbus import (
    ExpectStep,
    ModbusInput,
    ModbusOutput,
    ModbusProfile,
    ModbusStep,
    RegisterStep,
)
from hilctl_drivers.profile_parts import Range, Register
from hilctl_drivers.terfenol import TerfenolParameters


class Declined(Exception):  # noqa: N818  a reply, not a mistake
    """The device refuses a request.

    Attributes:
        code: Modbus exception code.
    """

    def __init__(self, code: int) -> None:
        super().__init__(f"exception {code}")
        self.code = code


@dataclass(frozen=True, slots=True)
class Wiring:
    """What stands between the device's terminals and the rig.

    Attributes:
        gain_a: Amplifier, A for one unit of the output.
        offset_a: Current at 0 of the output.
        sensor_um: Sensor, um for one unit of the input.
        offset_um: Displacement at 0 of the input.
    """

    gain_a: float
    offset_a: float
    sensor_um: float
    offset_um: float

    @classmethod
    def spread(cls, output: Range, sensor: Range) -> "Wiring":
        """Return a wiring that spreads the rig's ranges over those of the two channels.

        An output in A drives the coil itself.
        """
        rig = TerfenolParameters()
        gain_a, offset_a = _spread(output, rig.dac_range_a)
        if output.unit == "A":
            gain_a, offset_a = 1.0, 0.0
        return cls(gain_a, offset_a, *_spread(sensor, rig.sensor_range_um))


def _spread(channel: Range, reach: float) -> tuple[float, float]:
    gain = 2.0 * reach / (channel.max - channel.min)
    return gain, -0.5 * gain * (channel.max + channel.min)


class EmulatedDevice:
    """The device: what its registers hold, and what writing them does.

    It starts with the output where the rig is at 0 A, as if its power-on value had been set so.

    Args:
        profile: What it is.
        rig: What it drives.
        log: Where writes go.
        output: Output that drives the rig.
        sensor: Input that shows the displacement.
        wiring: Amplifier and sensor between; spread over the channels' ranges where None.
    """

    def __init__(
        self,
        profile: ModbusProfile,
        rig: Rig,
        log: WriteLog,
        output: str,
        sensor: str,
        wiring: Wiring | None = None,
    ) -> None:
        self.profile = profile
        self._rig = rig
        self._log = log
        self._output, self._sensor = output, sensor
        self.memory = Memory()
        self._steps: dict[int, Words] = {}
        self._outputs = {name: self._place_output(each) for name, each in profile.outputs.items()}
        self._inputs = {name: self._place_input(each) for name, each in profile.inputs.items()}
        if output not in self._outputs or sensor not in self._inputs:
            names = (
                f"outputs {', '.join(self._outputs)}; inputs {', '.join(self._inputs) or 'none'}"
            )
            raise InputError(f"{profile.title} has no {output} and {sensor}: {names}")
        self.wiring = wiring or Wiring.spread(profile.outputs[output], profile.inputs[sensor])
        self._watchdog = self._place_rest()
        self._now_ns = 0
        self._outputs[output].value = -self.wiring.offset_a / self.wiring.gain_a

    def tick(self, now_ns: int) -> None:
        """Let time pass; the watchdog may trip on the way."""
        due_ns = self._watchdog.due_ns if self._watchdog else None
        if self._watchdog is not None and due_ns is not None and due_ns <= now_ns:
            self._watchdog.tripped = True
            self._trip(due_ns)
        self._now_ns = max(self._now_ns, now_ns)
        self._rig.advance(self._now_ns)

    def request(self, now_ns: int) -> None:
        """Note that a request has come; before it is carried out."""
        self.tick(now_ns)
        if self._watchdog is not None:
            self._watchdog.request(self._now_ns)

    def read(self, areas: Sequence[str], address: int, count: int) -> list[int]:
        """Return register words.

        Raises:
            Declined: Not all of them exist.
        """
        self._measure()
        try:
            return self.memory.read(areas, address, count)
        except NoSuchRegister:
            raise Declined(2) from None

    def write(self, area: str, address: int, values: Sequence[int]) -> None:
        """Write register words; all of them or none.

        Raises:
            Declined: Not all of them can be written, a value is beyond its channel's range, or the
                watchdog has tripped and the device wants that cleared first.
        """
        try:
            targets = self.memory.targets(area, address, values)
        except NoSuchRegister:
            raise Declined(2) from None
        before = [list(words.words) for words, _ in targets]
        for words, wanted in targets:
            words.words[:] = wanted
        try:
            for words, _ in targets:
                self._check(words)
        except Declined:
            for (words, _), old in zip(targets, before, strict=True):
                words.words[:] = old
            raise
        for words, _ in targets:
            self._act(words)

    def _check(self, words: Words) -> None:
        for name, each in self._outputs.items():
            if each is words:
                channel = self.profile.outputs[name]
                low, high = channel.limits
                margin = 0.5 * channel.step + 1e-6 * (high - low)
                if not low - margin <= words.value <= high + margin:
                    raise Declined(3)
                watchdog = self.profile.watchdog
                if self.tripped and watchdog != "none" and watchdog.refuses_while_tripped:
                    raise Declined(4)

    def _act(self, words: Words) -> None:
        if self._watchdog is not None:
            self._watchdog.written(words, self._now_ns)
        for name, each in self._outputs.items():
            if each is words:
                self._put_out(name, "write", self._now_ns)

    @property
    def tripped(self) -> bool:
        """Whether the host watchdog has tripped."""
        return self._watchdog is not None and self._watchdog.tripped

    def _put_out(self, name: str, event: str, now_ns: int) -> None:
        value = self._outputs[name].value
        more: dict[str, float] = {}
        if name == self._output:
            self._rig.put_out(self.wiring.gain_a * value + self.wiring.offset_a, now_ns)
            more["current_a"] = self._rig.current_a
        unit = self.profile.outputs[name].unit
        self._log.event(now_ns, event, output=name, value=value, unit=unit, **more)

    def _trip(self, due_ns: int) -> None:
        watchdog = self.profile.watchdog
        assert watchdog != "none"
        for name, words in self._outputs.items():
            channel = self.profile.outputs[name]
            value: float | None = min(max(0.0, channel.min), channel.max)
            if watchdog.on_trip == "safe" and watchdog.safe:
                value = self._safe_value(name, watchdog.safe.get(name, ()))
            if value is None or watchdog.on_trip in {"hold", "unknown"}:
                continue
            words.value = value
            self._put_out(name, "watchdog", due_ns)

    def _safe_value(self, name: str, steps: tuple[ModbusStep, ...]) -> float | None:
        """Return what the safe-value register holds; None where it was not switched on."""
        channel = self.profile.outputs[name]
        found: float | None = None
        for step in steps:
            if not isinstance(step, RegisterStep):
                continue
            words = self._steps[id(step)]
            if step.value == "safe":
                scaled = {"scale": channel.scale, "offset": channel.offset}
                view = Words(step.model_copy(update=scaled))
                view.words = words.words
                found = view.value
            elif isinstance(step.value, float) and words.words != Words(step).encoded(step.value):
                return None
        return found

    def _measure(self) -> None:
        channel = self.profile.inputs[self._sensor]
        at_terminal = (self._rig.displacement_um - self.wiring.offset_um) / self.wiring.sensor_um
        low, high = channel.limits
        self._inputs[self._sensor].value = min(max(at_terminal, low), high)  # as an ADC does
        watchdog = self.profile.watchdog
        if watchdog != "none" and watchdog.tripped != "none":
            self._steps[id(watchdog.tripped)].words[-1] = watchdog.tripped.mask * self.tripped

    def _areas(self, register: Register) -> tuple[str, ...]:
        """Return the areas in which a register is seen.

        LabJack makes no difference between functions 3 and 4, and function 23 reads inputs too.
        """
        if register.area in {"coil", "discrete"} or self.profile.exchange == "none":
            return (register.area,)
        return ("holding", "input")

    def _place(self, register: Register, *, read: bool, write: bool) -> Words:
        words = Words(register)
        address = self.profile.wire_address(register)
        first = self.memory.place(words, register.area, address, read=read, write=write)
        for area in self._areas(register):
            self.memory.place(first, area, address, read=read, write=False)
        return first

    def _place_output(self, output: ModbusOutput) -> Words:
        words = self._place(output, read=output.readback == "same", write=True)
        readback = output.readback_register
        if readback is not None and readback is not output:
            address = self.profile.wire_address(readback)
            for area in {readback.area, *self._areas(readback)}:
                self.memory.place(words, area, address, write=False)
        return words

    def _place_input(self, channel: ModbusInput) -> Words:
        return self._place(channel, read=True, write=False)

    def _place_rest(self) -> HostWatchdog | None:
        """Place what the profile's steps touch; return the watchdog."""
        profile = self.profile
        self._place_steps((*profile.init, *profile.close))
        if profile.selftest != "none":
            self._place(profile.selftest, read=True, write=False).value = profile.selftest.expect
        if profile.watchdog == "none":
            return None
        watchdog = profile.watchdog
        for steps in watchdog.steps().values():
            self._place_steps(steps)
        if watchdog.tripped != "none":
            flag = watchdog.tripped
            self._steps[id(flag)] = self._place(flag, read=True, write=False)
        return HostWatchdog(watchdog, self._steps)

    def _place_steps(self, steps: tuple[ModbusStep, ...]) -> None:
        for step in steps:
            if isinstance(step, RegisterStep):
                words = self._place(step, read=True, write=not isinstance(step, ExpectStep))
                self._steps[id(step)] = words
                if isinstance(step, ExpectStep) and isinstance(step.value, float):
                    words.words[:] = Words(step).encoded(step.value)
