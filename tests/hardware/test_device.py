"""The device contract on a real device: ``pytest --device EXPERIMENT.yaml tests/hardware``.

Check the experiment's limits first. The tests do this to the coil or the piezo:

- They open and close the experiment's device some fifteen times, at the experiment's sample rate.
- They output the safe value. The output should be there already, as before a run: otherwise it
  jumps.
- Three times, they ramp from the safe value a tenth of the way to the limit that is further off,
  hold that for a third of a second, and ramp back; once they step back, and twice where the device
  cannot be opened away from its safe value. Each command passes hilctl's own limiter, which is set
  to this tenth and to the speed of the experiment's ramp to the safe value. The displacement must
  stay within the experiment's stroke.
- Once, they request commands that are not finite or out of range. The driver must reject them
  before anything is sent. This test is the last one.
- At the end of each test, failed or not, they ramp to the safe value and close the device; if that
  fails, they output the safe value immediately.

No other program may use the device during the tests.
"""

from collections.abc import Iterator

import numpy as np
import pytest

from hilctl.base.device import WatchdogDevice
from hilctl.base.errors import DeviceError
from hilctl.experiment.load import LoadedExperiment, load_experiment
from hilctl.experiment.sections.safe import starting_output
from hilctl.loop.limiter import CommandLimits, Limiter
from hilctl.loop.pacer import SystemClock
from hilctl.run.probe import probe

SHARE = 0.1
HOLD_S = 0.3
HOLD_SAMPLES = 20
CLEARLY = 6.0


class RealDevice:
    """A real device with slow, small commands.

    Args:
        loaded: The experiment.
    """

    def __init__(self, loaded: LoadedExperiment) -> None:
        config, self.device = loaded.config, loaded.device
        info, limits = self.device.info, config.command_limits()
        self.safe = limits.safe
        low, high = max(limits.low, info.command_min), min(limits.high, info.command_max)
        further = high if high - self.safe >= self.safe - low else low
        self.target = self.safe + SHARE * (further - self.safe)
        gentle = CommandLimits(
            low=min(self.safe, self.target),
            high=max(self.safe, self.target),
            slew_per_s=limits.ramp_per_s,
            safe=self.safe,
            ramp_per_s=limits.ramp_per_s,
        )
        self.limiter = Limiter(gentle, 1.0 / config.sample_rate_hz)
        self.stroke_um = config.limits.stroke_um
        self._at_start = config.safe.at_start
        self._rate_hz, self._block = config.sample_rate_hz, config.block
        self._period_ns = round(1e9 * config.block / config.sample_rate_hz)
        self._clock = SystemClock()
        self._due_ns = 0
        self._sample = 0
        self._open = False
        self._was_open = False

    def open(self) -> None:
        """Open the device; the limiter starts at its output."""
        self.device.open(self._rate_hz, self._block)
        self._open = self._was_open = True
        self._sample = 0
        self.limiter.last = starting_output(self.device, self._at_start)
        if isinstance(self.device, WatchdogDevice):
            self.device.arm()

    def close(self) -> None:
        """Close the device without changing the output."""
        self._open = False
        self.device.close()

    def _exchange(self, command: np.ndarray) -> np.ndarray:
        """Output one block in real time; return the displacements in um."""
        info = self.device.info
        if not info.latency_blocks:  # otherwise exchange waits for the device's clock
            self._clock.sleep_until_ns(self._due_ns)
        # At least one period after the previous block: a burst would be a steeper ramp.
        self._due_ns = self._clock.now_ns() + self._period_ns
        displacement_um, measured = np.full(command.size, np.nan), np.full(command.size, np.nan)
        self.device.exchange(self._sample, command, displacement_um, measured)
        answered = self._sample >= info.latency_blocks * self._block
        self._sample += command.size
        if not answered:
            return displacement_um[:0]
        low_um, high_um = self.stroke_um
        assert ((displacement_um >= low_um) & (displacement_um <= high_um)).all(), displacement_um
        assert np.isfinite(measured).all() == info.measures_command
        return displacement_um

    def make_safe(self) -> None:
        """Output the safe value immediately; the limiter continues from it."""
        self.device.make_safe(self.safe)
        self.limiter.last = self.safe

    def ask(self, command: float) -> None:
        """Request a command without the limiter, which the driver must reject."""
        block = np.full(self._block, command)
        self.device.exchange(self._sample, block, np.empty(block.size), np.empty(block.size))

    def go(self, wanted: float) -> np.ndarray:
        """Ramp to a command and hold it; return the second half of the displacements, in um."""
        held = max(HOLD_SAMPLES, round(HOLD_S * self._rate_hz))
        held += self.device.info.latency_blocks * self._block
        command, flags = np.empty(self._block), np.zeros(self._block, dtype=np.uint32)
        seen: list[np.ndarray] = []
        while sum(part.size for part in seen) < held:
            self.limiter.limit(np.full(self._block, wanted), command, flags)
            part = self._exchange(command)
            if self.limiter.last == wanted:
                seen.append(part)
        return np.concatenate(seen)[held // 2 :]

    def look(self) -> np.ndarray:
        """Return the first displacement without a change of the output: float64[1], um."""
        command = np.full(self._block, self.limiter.last)
        while True:
            part = self._exchange(command)
            if part.size:
                return part[:1]

    def end(self) -> None:
        """Ramp to the safe value and close; output it immediately if that fails."""
        if not self._was_open:
            return
        command, flags = np.empty(self._block), np.zeros(self._block, dtype=np.uint32)
        try:
            if not self._open:
                self.open()
            reached = False
            while not reached:
                reached = self.limiter.ramp(command, flags)
                self._exchange(command)
            self.close()
        except (DeviceError, AssertionError):
            self.make_safe()
            raise


@pytest.fixture
def real(request) -> Iterator[RealDevice]:
    """The device of the experiment, closed."""
    made = RealDevice(load_experiment(request.config.getoption("--device")))
    yield made
    made.end()


def step_um(rest: np.ndarray, there: np.ndarray) -> float:
    """Return the distance of a move; fail if it is within the noise."""
    noise_um = float(np.sqrt(rest.var() / rest.size + there.var() / there.size))
    moved_um = float(abs(there.mean() - rest.mean()))
    assert moved_um > CLEARLY * noise_um, "nothing moved: is the amplifier on, the sensor wired?"
    return moved_um


def distance_um(first: np.ndarray, second: np.ndarray) -> float:
    """Return the distance between two signals."""
    return float(abs(first.mean() - second.mean()))


def test_answers_a_probe(request):
    """The check of ``hilctl devices probe`` passes twice in a row."""
    path = request.config.getoption("--device")
    first, second = probe(path, [])[""], probe(path, [])[""]
    assert first.details == second.details
    assert first.faults == second.faults == ()
    assert first.max_rate_hz >= load_experiment(path).config.sample_rate_hz


def test_small_move_is_seen_and_comes_back(real):
    """The displacement follows a tenth of the range above the noise, and most of it returns."""
    real.open()
    real.go(real.target)  # once before, because a loop closes only after the first cycle
    rest = real.go(real.safe)
    there = real.go(real.target)
    back = real.go(real.safe)
    assert distance_um(rest, back) < 0.5 * step_um(rest, there)


def test_opening_and_closing_move_nothing(real):
    """The output persists while the device is closed, opened and probed."""
    if real.device.info.simulated:
        pytest.skip("opening a simulated device puts it at rest")
    real.open()
    rest = real.go(real.safe)
    there = real.go(real.target)
    real.close()
    try:
        real.open()
    except DeviceError as refusal:
        real.make_safe()
        pytest.skip(f"it is opened at its safe value only: {refusal}")
    real.close()
    real.open()
    assert distance_um(real.look(), there) < 0.5 * step_um(rest, there)


def test_exchange_needs_an_open_device(real):
    """Commands before open and after close are rejected; closing twice is allowed."""
    command = np.full(1, real.safe)
    with pytest.raises(DeviceError):
        real.device.exchange(0, command, np.empty(1), np.empty(1))
    real.open()
    real.go(real.safe)
    real.close()
    real.device.close()
    with pytest.raises(DeviceError):
        real.device.exchange(0, command, np.empty(1), np.empty(1))


def test_make_safe_needs_no_open_device(real):
    """make_safe takes the output from a small command to the safe value."""
    real.open()
    rest = real.go(real.safe)
    there = real.go(real.target)
    real.close()
    real.make_safe()
    real.open()
    back = real.go(real.safe)
    assert distance_um(rest, back) < 0.5 * step_um(rest, there)


@pytest.mark.parametrize("bad", ["not a number", "infinite", "above", "below"])
def test_refuses_what_it_can_not_do(real, bad):
    """A non-finite or out-of-range command is rejected before anything is sent."""
    info = real.device.info
    beyond = 1e-3 * (info.command_max - info.command_min)
    command = {
        "not a number": np.nan,
        "infinite": np.inf,
        "above": info.command_max + beyond,
        "below": info.command_min - beyond,
    }[bad]
    real.open()
    rest = real.go(real.safe)
    with pytest.raises(DeviceError, match=info.name):
        real.ask(command)
    after = real.go(real.safe)
    spread_um = CLEARLY * (rest.std() + after.std()) + 1e-3 * np.ptp(real.stroke_um)
    assert distance_um(rest, after) < spread_um
