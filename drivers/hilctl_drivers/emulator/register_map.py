"""Which registers an emulated Modbus device has, and what stands in them at first."""

from hilctl_drivers.emulator.memory import Memory, Words
from hilctl_drivers.modbus.channels import ExpectStep, ModbusStep, Register, RegisterStep
from hilctl_drivers.modbus.profile import ModbusOutput, ModbusProfile


class RegisterMap:
    """All registers that a profile names: channels, settings, watchdog and self-test.

    What a profile expects to find is there from the start.

    Args:
        profile: What the device is.
    """

    def __init__(self, profile: ModbusProfile) -> None:
        self._profile = profile
        self.memory = Memory()
        self.outputs = {name: self._place_output(each) for name, each in profile.outputs.items()}
        self.inputs = {
            name: self._place(each, read=True, write=False) for name, each in profile.inputs.items()
        }
        self.steps: dict[int, Words] = {}
        """Value that a step, or the trip flag, stands for; by ``id``."""
        self._place_rest()

    def _areas(self, register: Register) -> tuple[str, ...]:
        """Return the areas in which a register is seen.

        LabJack makes no difference between functions 3 and 4, and function 23 reads inputs too.
        """
        if register.area in {"coil", "discrete"} or self._profile.exchange == "none":
            return (register.area,)
        return ("holding", "input")

    def _place(self, register: Register, *, read: bool, write: bool) -> Words:
        words = Words(register)
        address = self._profile.wire_address(register)
        first = self.memory.place(words, register.area, address, read=read, write=write)
        for area in self._areas(register):
            self.memory.place(first, area, address, read=read, write=False)
        return first

    def _place_output(self, output: ModbusOutput) -> Words:
        words = self._place(output, read=output.readback == "same", write=True)
        readback = output.readback_register
        if readback is not None and readback is not output:
            address = self._profile.wire_address(readback)
            for area in {readback.area, *self._areas(readback)}:
                self.memory.place(words, area, address, write=False)
        return words

    def _place_rest(self) -> None:
        """Place what the profile's steps touch, and the self-test."""
        profile = self._profile
        self._place_steps((*profile.init, *profile.close))
        if profile.selftest != "none":
            self._place(profile.selftest, read=True, write=False).value = profile.selftest.expect
        if profile.watchdog == "none":
            return
        for steps in profile.watchdog.steps().values():
            self._place_steps(steps)
        flag = profile.watchdog.tripped
        if flag != "none":
            self.steps[id(flag)] = self._place(flag, read=True, write=False)

    def _place_steps(self, steps: tuple[ModbusStep, ...]) -> None:
        for step in steps:
            if isinstance(step, RegisterStep):
                words = self._place(step, read=True, write=not isinstance(step, ExpectStep))
                self.steps[id(step)] = words
                if isinstance(step, ExpectStep) and isinstance(step.value, float):
                    words.words[:] = Words(step).encoded(step.value)
