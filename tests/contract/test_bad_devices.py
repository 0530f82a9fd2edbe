"""Devices that each break one rule of the contract; the contract tests must detect every one."""

from collections import deque
from dataclasses import replace
from inspect import signature
from itertools import chain

import numpy as np
import pytest

from hilctl.base.device import DeviceInfo
from hilctl.base.errors import DeviceError
from hilctl.experiment.devices import BUILTIN
from hilctl_drivers import contract as CONTRACT  # noqa: N812

UM_PER_A = 10.0
HIGHEST_A = 5.0
NOISE = np.random.default_rng()
REFUSED = next(
    mark.args[1]
    for mark in CONTRACT.test_refuses_what_it_can_not_do.pytestmark
    if mark.name == "parametrize"
)


class Ideal:
    """A spring without mass that keeps the contract; its output persists."""

    info = DeviceInfo(
        name="modbus_dac",
        description="ideal spring",
        command_unit="A",
        command_min=-HIGHEST_A,
        command_max=HIGHEST_A,
        sensor_min_um=-100.0,
        sensor_max_um=100.0,
        max_rate_hz=20_000.0,
    )

    um_per_a = UM_PER_A
    due, openings, was_safe = 0, 0, False

    def __init__(self):
        self.current_a, self.is_open = 0.0, False

    def open(self, sample_rate_hz, block):
        if sample_rate_hz > self.info.max_rate_hz:
            raise self.error("too fast")
        self.is_open, self.was_safe, self.due = True, False, 0
        self.openings += 1

    def error(self, text):
        return DeviceError(f"{self.info.name}: {text}")

    def output(self):
        self.need_open()
        return self.current_a

    def need_open(self):
        if not self.is_open:
            raise self.error("not open")

    def refuse(self, command):
        low, high = self.info.command_min, self.info.command_max
        if not ((command >= low) & (command <= high)).all():
            raise self.error("out of range, nothing was sent")

    def exchange(self, first_sample, command, displacement_um, measured):
        self.need_open()
        self.refuse(command)
        for j, value in enumerate(command):
            displacement_um[j] = self.um_per_a * self.current_a
            self.current_a = float(value)
        self.due += command.size
        self.spoil(command, displacement_um, measured)

    def spoil(self, command, displacement_um, measured):
        """Change an answer; other devices override it."""

    def make_safe(self, command):
        self.current_a = command

    def close(self):
        self.is_open = False


class GoesToTheEndsOfItsSensor(Ideal):
    """A sensor that is at its lowest value at rest and at its highest at the test command."""

    info = replace(Ideal.info, sensor_min_um=0.0, sensor_max_um=0.5 * HIGHEST_A * UM_PER_A)


class DrivesOneWay(Ideal):
    """A unipolar output, like a power supply or a piezo amplifier."""

    info = replace(Ideal.info, command_min=0.0)


class KeepsJustThisRate(Ideal):
    info = replace(Ideal.info, max_rate_hz=CONTRACT.RATE_HZ)


class MovesLittle(Ideal):
    """Moves 1.5 um at the test command."""

    um_per_a = 0.6


class CountsItsSamples(Ideal):
    """Rejects a block that does not follow the previous one; the first has number 0."""

    def exchange(self, first_sample, command, displacement_um, measured):
        if first_sample != self.due:
            raise self.error("samples are missing")
        super().exchange(first_sample, command, displacement_um, measured)


class OpensOnlyWhenClosed(Ideal):
    def open(self, sample_rate_hz, block):
        if self.is_open:
            raise self.error("is open already")
        super().open(sample_rate_hz, block)


class MovesOnlyInTheEnd(Ideal):
    """Moves almost one block late."""

    def __init__(self):
        super().__init__()
        self.waiting_um = deque([0.0] * (CONTRACT.SAMPLES - 2))

    def spoil(self, command, displacement_um, measured):
        for j, value in enumerate(displacement_um):
            self.waiting_um.append(value)
            displacement_um[j] = self.waiting_um.popleft()


class Sluggish(Ideal):
    """Approaches the target by 5 % per sample: 1.3 um left after one block, 0.5 um after two."""

    um_per_a = 28.0
    reached_um = 0.0

    def spoil(self, command, displacement_um, measured):
        for j, value in enumerate(displacement_um):
            displacement_um[j] = self.reached_um = 0.95 * self.reached_um + 0.05 * value


class MovesAtOpen(Ideal):
    def open(self, sample_rate_hz, block):
        super().open(sample_rate_hz, block)
        self.current_a = 0.0


class BeginsAtRest(MovesAtOpen):
    """Starts at rest at each opening, like a simulated device."""

    info = replace(Ideal.info, name="simulated_piezo")


class DoesNothing(Ideal):
    def exchange(self, first_sample, command, displacement_um, measured):
        pass

    def make_safe(self, command):
        pass


class NeverMadeSafe(Ideal):
    def make_safe(self, command):
        pass


class SafeOnlyWhileOpen(Ideal):
    def make_safe(self, command):
        if self.is_open:
            self.current_a = command


class SafeOnceItWasOpen(Ideal):
    """make_safe cannot connect before the first opening."""

    def make_safe(self, command):
        if self.openings:
            self.current_a = command


class SafeUntilItIsClosed(Ideal):
    """make_safe cannot connect after closing."""

    def make_safe(self, command):
        if self.is_open or not self.openings:
            self.current_a = command


class SafeOnceItIsClosed(Ideal):
    """Applies the safe value only when it is closed."""

    def make_safe(self, command):
        if self.is_open:
            self.due_a = command
        else:
            self.current_a = command

    def close(self):
        self.current_a = vars(self).pop("due_a", self.current_a)
        super().close()


class SafeOnlyOnce(Ideal):
    """Applies the safe value only once per opening."""

    def make_safe(self, command):
        if self.is_open or not self.was_safe:
            self.current_a = command
        self.was_safe = not self.is_open


class SafeElsewhere(Ideal):
    """Applies zero instead of the safe value."""

    def make_safe(self, command):
        self.current_a = 0.0


class TakesTheFirstOfARamp(Ideal):
    """Ignores safe values after the first one of a ramp."""

    def make_safe(self, command):
        if not self.was_safe:
            self.current_a = command
        self.was_safe = self.is_open

    def close(self):
        super().close()
        self.was_safe = False


class ArmedWhileItIsClosed(Ideal):
    def arm(self):
        pass


class MovesWhenItIsArmed(Ideal):
    def arm(self):
        self.need_open()
        self.current_a = 1.0


class LiesAboutItsOutput(Ideal):
    """Reports the last request instead of the actual output."""

    def output(self):
        self.need_open()
        return 0.0


class DoesNotSayWhatItKnows(Ideal):
    def output(self):
        self.need_open()


class SaysItsOutputWhenClosed(Ideal):
    def output(self):
        return self.current_a


class MovesTooLittle(Ideal):
    """Moves 1 um at the test command, which is the tolerance of a reading."""

    um_per_a = 0.4


class PutsOutHalf(Ideal):
    """Applies half the command and reads accordingly, like a scale that is wrong twice."""

    um_per_a = 2.0 * UM_PER_A

    def spoil(self, command, displacement_um, measured):
        self.current_a *= 0.5


class MeasuresNothing(Ideal):
    """Claims to measure its current and does not."""

    info = replace(Ideal.info, measures_command=True)


class RefusesInNobodysName(Ideal):
    def refuse(self, command):
        try:
            super().refuse(command)
        except DeviceError:
            raise DeviceError("out of range") from None


class Clips(Ideal):
    def exchange(self, first_sample, command, displacement_um, measured):
        clipped = np.clip(np.nan_to_num(command), -HIGHEST_A, HIGHEST_A)
        super().exchange(first_sample, clipped, displacement_um, measured)


class ClipsWhatIsWritten(Ideal):
    """Clips commands in the caller's array instead of rejecting them."""

    def refuse(self, command):
        np.clip(np.nan_to_num(command, copy=False), -HIGHEST_A, HIGHEST_A, out=command)


class SendsTheGoodPart(Ideal):
    """Sends the samples before an invalid one."""

    def exchange(self, first_sample, command, displacement_um, measured):
        for j in range(command.size):
            part = slice(j, j + 1)
            super().exchange(first_sample + j, command[part], displacement_um[part], measured[part])


class SendsALittle(Ideal):
    """Sends part of a block that it rejects."""

    def refuse(self, command):
        self.current_a = 0.05
        super().refuse(command)


class Late(Ideal):
    """Returns the displacements of the previous block."""

    def __init__(self):
        super().__init__()
        self.before_um = 0.0

    def exchange(self, first_sample, command, displacement_um, measured):
        found = np.empty(command.size)
        super().exchange(first_sample, command, found, measured)
        displacement_um[:] = self.before_um
        self.before_um = found


class EarlyByAFifth(Ideal):
    """Reads its sensor while the command takes effect: 0.5 um of the test step."""

    def spoil(self, command, displacement_um, measured):
        displacement_um[0] += 0.02 * UM_PER_A * command[0]


class NeverFillsReadings(Ideal):
    def exchange(self, first_sample, command, displacement_um, measured):
        super().exchange(first_sample, command, np.empty(command.size), measured)


class FillsTheFirstReading(Ideal):
    def exchange(self, first_sample, command, displacement_um, measured):
        found = np.empty(command.size)
        super().exchange(first_sample, command, found, measured)
        displacement_um[0] = found[0]


class MovesALittleAtOpen(Ideal):
    def open(self, sample_rate_hz, block):
        super().open(sample_rate_hz, block)
        self.current_a -= 0.1


class MovesAtClose(Ideal):
    """Releases its output when the port is closed."""

    def close(self):
        if self.is_open:
            self.current_a = 0.0
        super().close()


class OpensOnce(Ideal):
    """Reopens without an error and does not work."""

    def open(self, sample_rate_hz, block):
        super().open(sample_rate_hz, block)
        self.is_open = self.openings == 1


class NeedsNoOpening(Ideal):
    def need_open(self):
        pass


class ClosesOnce(Ideal):
    def close(self):
        self.need_open()
        super().close()


class TakesAnyRate(Ideal):
    def open(self, sample_rate_hz, block):
        self.is_open = True


class TakesHalfAsFastAgain(Ideal):
    def open(self, sample_rate_hz, block):
        super().open(sample_rate_hz / 1.5, block)


def takes(name, seen):
    """Return a device that checks a changed command against its range."""
    return type(name, (Ideal,), {"refuse": lambda self, command: Ideal.refuse(self, seen(command))})


def says(**wrong):
    """Return a device with a wrong value in its info."""
    return type(f"Says_{'_'.join(wrong)}", (Ideal,), {"info": replace(Ideal.info, **wrong)})


def spoils(name, spoil):
    """Return a device whose exchange changes command, displacement or measured current."""
    return type(name, (Ideal,), {"spoil": lambda self, *arrays: spoil(*arrays)})


HasAnOffset = spoils("HasAnOffset", lambda command, um, measured: np.add(um, 0.3, um))
NeverMoves = spoils("NeverMoves", lambda command, um, measured: um.fill(0.0))


KEEPS_IT = (
    Ideal, GoesToTheEndsOfItsSensor, DrivesOneWay, KeepsJustThisRate, MovesLittle, CountsItsSamples,
    OpensOnlyWhenClosed, HasAnOffset, MovesOnlyInTheEnd, Sluggish, BeginsAtRest,
)  # fmt: skip
"""Each in another way."""
MUST_FAIL = {
    "exchanges_blocks": (
        DoesNothing, MovesTooLittle, NeverMoves, MeasuresNothing, NeverFillsReadings,
        FillsTheFirstReading,
        spoils("ReadsBeyondItsSensor", lambda command, um, measured: np.add(um, 100.0, um)),
        spoils("ReadsBelowItsSensor", lambda command, um, measured: np.add(um, -200.0, um)),
        spoils("FillsMeasured", lambda command, um, measured: np.copyto(measured, command)),
    ),
    "make_safe_works_open_or_closed": (
        DoesNothing, NeverMadeSafe, SafeOnlyWhileOpen, SafeOnceItWasOpen, SafeUntilItIsClosed,
        SafeOnceItIsClosed, SafeOnlyOnce, SafeElsewhere, PutsOutHalf, MovesAtClose,
    ),
    "each_value_of_a_ramp_is_put_out": (TakesTheFirstOfARamp,),
    "arming_moves_nothing_and_needs_an_open_device": (ArmedWhileItIsClosed, MovesWhenItIsArmed),
    "says_what_it_puts_out": (LiesAboutItsOutput, DoesNotSayWhatItKnows, SaysItsOutputWhenClosed),
    "refuses_what_it_can_not_do": (
        takes("NaN", lambda a: np.nan_to_num(a, nan=0.0, posinf=np.inf, neginf=-np.inf)),
        takes("Infinity", lambda a: np.where(a == np.inf, 0.0, a)),
        takes("MinusInfinity", lambda a: np.where(a == -np.inf, 0.0, a)),
        takes("More", lambda a: np.where(a > HIGHEST_A, a / 1.003, a)),
        takes("Less", lambda a: np.where(a < -HIGHEST_A, a / 1.003, a)),
        RefusesInNobodysName, Clips, ClipsWhatIsWritten, SendsTheGoodPart, SendsALittle,
    ),
    "takes_its_whole_range": (takes("LessThanItsRange", lambda a: a * 1.001),),
    "displacement_is_sampled_before_the_command_acts": (
        MovesTooLittle, NeverMoves, Late, EarlyByAFifth, NeverFillsReadings,
        spoils("Early", lambda command, um, measured: np.multiply(command, UM_PER_A, um)),
    ),
    "does_not_change_the_command": (
        spoils("WritesTheCommand", lambda command, um, measured: command.fill(0.0)),
    ),
    "opening_does_not_move_the_output": (MovesAtOpen, MovesALittleAtOpen, MovesAtClose),
    "use_before_open_and_after_close_is_refused": (OpensOnce, NeedsNoOpening, ClosesOnce),
    "rate_beyond_its_limit_is_refused": (TakesAnyRate, TakesHalfAsFastAgain),
    "says_what_it_is_before_it_is_opened": (
        says(name="another_dac"), says(description=""), says(command_unit="Ohm"),
        says(command_min=HIGHEST_A), says(sensor_min_um=100.0), says(max_rate_hz=0.0),
        says(fifo_depth=1), says(details={"serial_number": 17}),
    ),
    "two_of_a_kind_agree": (
        spoils("ByChance", lambda command, um, measured: np.add(um, 0.01 * NOISE.normal(), um)),
    ),
}  # fmt: skip
"""Devices that must fail each check."""


def failures(kind):
    """Return the names of the checks that a device fails."""

    def make(case=""):
        made = kind()
        return CONTRACT.DrivenDevice(
            made,
            CONTRACT.SAMPLES,
            CONTRACT.RATE_HZ,
            lambda: made.current_a,
            name=made.info.name if made.info.name in BUILTIN else Ideal.info.name,
            starts_at_rest=isinstance(made, BeginsAtRest),
        )

    found = set()
    for name, check in vars(CONTRACT).items():
        if not name.startswith("test_") or name.endswith("_left_out"):
            continue
        asked = signature(check).parameters
        for bad in REFUSED if "bad" in asked else [None]:
            given = {"driven": make(), "make": make, "case": "", "bad": bad}
            try:
                check(**{each: given[each] for each in asked})
            except (AssertionError, DeviceError, pytest.fail.Exception):
                found.add(name.removeprefix("test_"))
    return found


@pytest.mark.parametrize("kind", KEEPS_IT)
def test_a_device_that_keeps_the_contract_fails_nothing(kind):
    assert failures(kind) == set()


@pytest.mark.parametrize("kind", dict.fromkeys(chain(*MUST_FAIL.values())))
def test_a_device_that_breaks_the_contract_is_found_out(kind):
    assert failures(kind) >= {check for check, kinds in MUST_FAIL.items() if kind in kinds}


def test_each_check_finds_somebody_out():
    checks = {name.removeprefix("test_") for name in vars(CONTRACT) if name.startswith("test_")}
    assert {name for name in checks if not name.endswith("_left_out")} == MUST_FAIL.keys()
