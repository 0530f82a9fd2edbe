"""Base classes of simulated actuators and of models of magnetostrictive rods."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hilctl.base.types import F64
from hilctl.kernels.jit import kernel

CHUNK = 4096  # samples per kernel call; bounds the scratch memory
_DRAWN = 256


class SensorNoise:
    """Noise of a sensor's readings, independent of the division into blocks."""

    def __init__(self, std_um: float, seed: int) -> None:
        self._std_um, self._seed = std_um, seed
        self._values = np.empty(CHUNK + _DRAWN)
        self.reset()

    def reset(self) -> None:
        """Restart with the first value."""
        self._generator = np.random.Generator(np.random.PCG64(self._seed))
        self._at = self._stop = 0

    def draw(self, samples: int) -> F64:
        """Return the noise of the next samples, at most ``CHUNK``; valid until the next call."""
        if self._at + samples > self._stop:
            self._draw_more(samples)
        at, self._at = self._at, self._at + samples
        return self._values[at : self._at]

    def _draw_more(self, samples: int) -> None:
        # Some hundreds together: a call for every short block takes longer than the drawing.
        left = self._stop - self._at
        self._values[:left] = self._values[self._at : self._stop]
        self._at, self._stop = 0, max(samples, _DRAWN)
        new = self._values[left : self._stop]
        self._generator.standard_normal(out=new)
        new *= self._std_um


@kernel()
def read_sensor(
    signal_um: F64, noise_um: F64, displacement_um: F64, sensor: tuple[float, float]
) -> None:
    """Fill ``displacement_um`` with readings; ``sensor`` is one ADC code and the range, in um."""
    adc_code, sensor_range = sensor
    for j in range(signal_um.size):
        reading = np.rint((signal_um[j] + noise_um[j]) / adc_code) * adc_code
        displacement_um[j] = min(sensor_range, max(-sensor_range, reading))


class Plant(ABC):
    """A simulated actuator with its amplifier and sensor, advanced sample by sample.

    A reading is taken at the instant its command is output and cannot show that command's effect;
    the DAC then holds the command for one sample period. The readings, including noise, have the
    same bits for any division into blocks.
    """

    def __init__(
        self, noise_um: float, seed: int, sensor: tuple[float, float], chunk: int = CHUNK
    ) -> None:
        """Create the sensor: noise, rms, one ADC code and the range, in um.

        A kernel call takes up to ``chunk`` samples, at most ``CHUNK``.
        """
        self._noise = SensorNoise(noise_um, seed)
        self._drawn = np.empty(0)  # noise of the samples that are not read yet
        self._sensor = sensor
        self.chunk = chunk
        self._arrays = np.empty((4, chunk))
        self._block = tuple(self._arrays)

    def reset(self) -> None:
        """Return to rest and restart the noise."""
        self._noise.reset()
        self._rest()

    def step(self, command: F64, displacement_um: F64, measured: F64) -> None:
        """Output a block of commands and read the sensors before each.

        Args:
            command: float64[n], finite and within the DAC's range; not checked here.
            displacement_um: float64[n], filled with the displacement from rest.
            measured: float64[n], filled with the command as it was at each reading.
        """
        for start in range(0, command.size, self.chunk):
            part = slice(start, start + self.chunk)
            self.read(self.sense(command[part], measured[part]), displacement_um[part])

    def sense(self, command: F64, measured: F64) -> F64:
        """Do :meth:`step` for one chunk without the readings, which :meth:`read` takes.

        Return the sensor's signal in um, float64[n], without noise; valid until the next call.
        """
        # Copies: kernels take contiguous arrays only.
        held, signal_um, _, driven = self._block
        if held.size != command.size:  # the views are kept: blocks usually have one length
            self._block = held, signal_um, _, driven = tuple(self._arrays[:, : command.size])
        held[:] = command
        self._drawn = self._noise.draw(command.size)
        self._advance(held, self._drawn, signal_um, driven)
        measured[:] = driven
        return signal_um

    def read(self, signal_um: F64, displacement_um: F64) -> None:
        """Read the signal of the last chunk with its noise, in whole codes within the range."""
        read_um = self._block[2]
        read_sensor(signal_um, self._drawn, read_um, self._sensor)
        displacement_um[:] = read_um

    def warm_up(self) -> None:
        """Advance by one sample and return to rest, so that all kernels are compiled."""
        self.reset()
        self.hold(1, 0.0)
        self.reset()

    def hold(self, n_samples: int, command: float) -> None:
        """Let ``n_samples`` sample periods pass with the output at ``command``."""
        for start in range(0, n_samples, CHUNK):
            held = np.full(min(CHUNK, n_samples - start), command)
            self.step(held, *np.empty((2, held.size)))

    @abstractmethod
    def _rest(self) -> None:
        """Reset the state to rest."""

    @abstractmethod
    def _advance(self, command: F64, noise_um: F64, signal_um: F64, measured: F64) -> None:
        """Do :meth:`sense` for one chunk; all arrays are contiguous.

        Growth that passes no structure is added to the noise of its readings.
        """


@dataclass(frozen=True, slots=True)
class Coil:
    """The field at the surface, ``factor_per_m * current + bias_a_per_m``, in steps."""

    factor_per_m: float
    bias_a_per_m: float
    step_s: float


class Rods:
    """Rods in a coil: current in, displacement without structure or load out.

    Attributes:
        rest: Sets the state after the bias alone and returns its displacement in um; to be called
            first.
        state: Array that the kernel updates.
    """

    def __init__(
        self, rest: Callable[[], float], kernel: Callable[..., object], state: F64, *more: object
    ) -> None:
        """Store the kernel of :meth:`follow` and its further arguments."""
        self.rest, self.state = rest, state
        self._kernel, self._arguments = kernel, (state, *more)

    def follow(self, halves_a: F64, free_um: F64) -> None:
        """Advance step by step.

        Args:
            halves_a: float64[2n + 1], current at the start of the first step, then at the middle
                and the end of each.
            free_um: float64[n], filled with the free displacement at the end of each step.
        """
        self._kernel(halves_a, free_um, *self._arguments)


class RodParameters(ABC):
    """Constants of one physics of the rods."""

    __slots__ = ()

    @abstractmethod
    def rods(self, coil: Coil) -> Rods:
        """Return such rods in a coil."""

    @abstractmethod
    def varied(self, lag: float, pinning: float, strain: float) -> "RodParameters":
        """Return rods that differ by these factors on lag, width of the loops and stroke."""
