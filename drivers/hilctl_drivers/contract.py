"""The device contract as pytest tests, for devices of any package.

The tests send commands up to both ends of the device's range, so use them only with a simulated
device or an emulator. In a test file of the package::

    import pytest
    from hilctl_drivers.contract import *
    from my_package.amplifier import MyAmplifier

    @pytest.fixture
    def new_device():
        return lambda: MyAmplifier(MyAmplifier.Options())
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import ArrayLike

from hilctl.base.device import Device, WatchdogDevice
from hilctl.base.errors import DeviceError
from hilctl.base.types import F64

RATE_HZ = 10_000.0
SAMPLES = 20
STEP = 0.01
"""Of the coarsest converter, in the command's unit."""


@dataclass
class DrivenDevice:
    """A device with its parameters for the tests.

    ``stands`` returns its output as a command, if possible from the emulated device or the
    simulated plant; None if unknown.
    """

    device: Device  # not yet open
    block: int  # samples it takes in one exchange
    rate_hz: float  # a sample rate that it can keep
    stands: Callable[[], float | None]
    pass_time: Callable[[], None] = lambda: None  # called before each exchange
    exchanged: int = 0  # samples since it was opened
    name: str = ""  # its registry name; empty if it has none yet
    starts_at_rest: bool = False  # whether opening it starts anew, as a simulation does
    must_be_at_rest: bool = False  # whether opening is refused unless its output is 0
    reads_back: bool | None = True  # whether it can read its output back; None if either is allowed

    def open(self) -> None:
        """Open and arm the device, as a run does; the next sample is the first."""
        self.device.open(self.rate_hz, self.block)
        if isinstance(self.device, WatchdogDevice):
            self.device.arm()
        self.exchanged = 0

    def exchange(self, command: ArrayLike) -> tuple[F64, F64]:
        """Exchange any number of samples, a block at a time; the next ones follow them."""
        sent = np.asarray(command, dtype=np.float64)
        displacement_um, measured = np.full(sent.size, np.nan), np.full(sent.size, np.nan)
        for start in range(0, sent.size, self.block):
            part = slice(start, start + self.block)
            self.pass_time()
            self.device.exchange(self.exchanged, sent[part], displacement_um[part], measured[part])
            self.exchanged += self.block
        return displacement_um, measured

    def assert_stands(self, command: float) -> None:
        """Fail unless the output is at a command, if the output is known."""
        stands = self.stands()
        assert stands is None or stands == pytest.approx(command, abs=STEP)

    @property
    def middle(self) -> float:
        """A command well inside the range and different from the resting one."""
        info = self.device.info
        return 0.5 * (info.command_max + max(0.0, info.command_min))


def driven_device(device: Device) -> DrivenDevice:
    """Return a device to check; its output is the one that it reports."""
    rate_hz = min(RATE_HZ, device.info.max_rate_hz)

    def stands() -> float | None:
        try:
            return device.output()
        except DeviceError:  # it is not open, and keeps its output while it is not
            device.open(rate_hz, SAMPLES)
            current = device.output()
            device.close()
            return current

    return DrivenDevice(device, SAMPLES, rate_hz, stands, reads_back=None)


@pytest.fixture
def new_device() -> Callable[[], Device]:
    """Return a factory of the device under test, not yet open; each test file defines its own."""
    raise NotImplementedError("define a fixture new_device that returns a function")


@pytest.fixture
def make(new_device: Callable[[], Device]) -> Iterator[Callable[[str], DrivenDevice]]:
    """Return a function that makes the device under test; all are closed afterwards."""
    made: list[DrivenDevice] = []

    def of(_case: str) -> DrivenDevice:
        made.append(driven_device(new_device()))
        return made[-1]

    yield of
    for driven in made:
        driven.device.close()


@pytest.fixture
def case() -> str:
    """Return which device is under test; there is only one."""
    return ""


@pytest.fixture
def driven(make: Callable[[str], DrivenDevice], case: str) -> DrivenDevice:
    """Return a device that was not opened yet."""
    return make(case)


def test_says_what_it_is_before_it_is_opened(driven: DrivenDevice) -> None:
    """Info is complete and plausible without a connection."""
    info = driven.device.info
    assert info.name
    assert not driven.name or info.name == driven.name
    assert info.description
    assert info.command_unit in {"A", "V"}
    assert info.command_min < info.command_max
    assert info.sensor_min_um < info.sensor_max_um
    assert info.max_rate_hz >= driven.rate_hz
    assert info.buffered == (info.fifo_depth > 0)
    assert all(isinstance(text, str) for text in info.details.values())


def test_exchanges_blocks(driven: DrivenDevice) -> None:
    """Every displacement is filled with a number in the sensor's range, and commands move it."""
    driven.open()
    info = driven.device.info
    rest, _ = driven.exchange(np.zeros(SAMPLES))
    driven.exchange(np.linspace(0.0, driven.middle, SAMPLES))
    moved, measured = driven.exchange(np.full(SAMPLES, driven.middle))
    for values in (rest, moved):  # false for NaN
        assert (values >= info.sensor_min_um).all()
        assert (values <= info.sensor_max_um).all()
    assert moved.max() > rest.max() + 1.0
    assert np.isfinite(measured).all() == info.measures_command


def test_displacement_is_sampled_before_the_command_acts(driven: DrivenDevice) -> None:
    """The first sample after a jump still shows the rest; a later one does not."""
    driven.open()
    rest, _ = driven.exchange(np.zeros(SAMPLES))
    moved, _ = driven.exchange(np.full(SAMPLES, driven.middle))
    assert abs(moved[0] - rest.mean()) < 0.5
    assert moved[-1] > rest.mean() + 1.0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, "above", "below"])
def test_refuses_what_it_can_not_do(driven: DrivenDevice, bad: float | str) -> None:
    """A block with a value that is not finite or out of range is refused; nothing is sent."""
    driven.open()
    info = driven.device.info
    beyond = 0.001 * (info.command_max - info.command_min)
    value = {"above": info.command_max + beyond, "below": info.command_min - beyond}
    command = np.full(driven.block, driven.middle)
    command[driven.block // 2] = value.get(bad, bad) if isinstance(bad, str) else bad
    with pytest.raises(DeviceError, match=info.name):
        driven.exchange(command)
    after, _ = driven.exchange(np.zeros(SAMPLES))
    assert np.abs(after).max() < 0.5


def test_takes_its_whole_range(driven: DrivenDevice) -> None:
    """Both ends of the stated range are accepted."""
    driven.open()
    for value in (driven.device.info.command_min, driven.device.info.command_max):
        driven.exchange(np.full(SAMPLES, value))


def test_does_not_change_the_command(driven: DrivenDevice) -> None:
    """The command array is read, never written."""
    driven.open()
    command = np.linspace(0.0, driven.middle, SAMPLES)
    before = command.copy()
    driven.exchange(command)
    assert np.array_equal(command, before)


def test_use_before_open_and_after_close_is_refused(driven: DrivenDevice) -> None:
    """Exchange needs an open device; closing twice is fine, and opening again too."""
    with pytest.raises(DeviceError):
        driven.exchange(np.zeros(SAMPLES))
    driven.open()
    driven.device.close()
    driven.device.close()
    with pytest.raises(DeviceError):
        driven.exchange(np.zeros(SAMPLES))
    driven.open()
    driven.exchange(np.zeros(SAMPLES))


def test_opening_does_not_move_the_output(driven: DrivenDevice) -> None:
    """The output stays through closing and opening; simulated devices start at rest."""
    driven.open()
    driven.exchange(np.full(SAMPLES, driven.middle))
    held, _ = driven.exchange(np.full(SAMPLES, driven.middle))
    driven.device.close()
    driven.open()
    first, _ = driven.exchange(np.zeros(driven.block))
    expected = 0.0 if driven.starts_at_rest else held[-1]
    assert first[0] == pytest.approx(expected, abs=0.5)


def test_rate_beyond_its_limit_is_refused(driven: DrivenDevice) -> None:
    """A sample rate that it cannot keep is refused at open."""
    with pytest.raises(DeviceError):
        driven.device.open(driven.device.info.max_rate_hz * 1.01, driven.block)


def test_make_safe_works_open_or_closed(driven: DrivenDevice) -> None:
    """The safe value needs no open connection; the output afterwards decides."""
    safe = 0.5 * driven.middle
    driven.device.make_safe(safe)
    driven.assert_stands(safe)
    driven.device.make_safe(0.0)
    driven.assert_stands(0.0)
    driven.open()
    driven.exchange(np.full(SAMPLES, driven.middle))
    # Else it would be safe by itself; behind a FIFO, what was sent is still to come.
    stands = driven.stands()
    assert stands is None or stands > safe + STEP or driven.device.info.latency_blocks
    driven.device.make_safe(safe)
    driven.assert_stands(safe)
    driven.device.close()
    driven.assert_stands(safe)
    driven.device.make_safe(0.0)
    driven.assert_stands(0.0)


def test_each_value_of_a_ramp_is_put_out(driven: DrivenDevice) -> None:
    """Safe values may follow one another, and each is confirmed by itself."""
    driven.open()
    driven.exchange(np.full(SAMPLES, driven.middle))
    for share in (0.5, 0.25, 0.0):
        driven.device.make_safe(share * driven.middle)
        driven.assert_stands(share * driven.middle)


def test_arming_moves_nothing_and_needs_an_open_device(driven: DrivenDevice) -> None:
    """A device without a watchdog has nothing to arm."""
    if not isinstance(driven.device, WatchdogDevice):
        return
    with pytest.raises(DeviceError):
        driven.device.arm()
    at_rest = driven.must_be_at_rest or driven.starts_at_rest
    held = 0.0 if at_rest else 0.5 * driven.middle
    driven.device.make_safe(held)
    driven.open()
    driven.assert_stands(held)
    driven.device.close()
    with pytest.raises(DeviceError):
        driven.device.arm()


def test_says_what_it_puts_out(driven: DrivenDevice) -> None:
    """After opening, a device reports its output, or that the output is unknown."""
    with pytest.raises(DeviceError):
        driven.device.output()
    driven.open()
    driven.exchange(np.full(SAMPLES, 0.0 if driven.must_be_at_rest else driven.middle))
    driven.device.close()
    driven.open()
    found = driven.device.output()
    assert driven.reads_back in {None, found is not None}
    if found is not None:
        driven.assert_stands(found)


def test_two_of_a_kind_agree(
    driven: DrivenDevice, make: Callable[[str], DrivenDevice], case: str
) -> None:
    """A second device with the same options gives the same bits, so runs are reproducible."""
    other = make(case)
    command = np.linspace(0.0, driven.middle, SAMPLES)
    driven.open()
    first, _ = driven.exchange(command)
    other.open()
    second, _ = other.exchange(command)
    assert np.array_equal(first, second)
