"""What every physics of the magnetostrictive rods is to the actuator around them."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

from hilctl.base.types import F64

ROD_LENGTH_M = 0.1206  # two rods of 60.3 mm, section 3.3.1 (chapter 2) of the dissertation
ROD_RADIUS_M = 6.15e-3
VACUUM_PERMEABILITY = 1.25663706212e-6


@dataclass(frozen=True, slots=True)
class Coil:
    """The field at the rods' surface, ``factor_per_m * current + bias_a_per_m``, and its steps.

    Attributes:
        factor_per_m: Field of one ampere.
        bias_a_per_m: Field without a command.
        step_s: Length of a step.
    """

    factor_per_m: float
    bias_a_per_m: float
    step_s: float


class Rods(ABC):
    """Rods in a coil: current in, displacement without structure or load out."""

    @abstractmethod
    def rest(self) -> float:
        """Go to the state in which only the bias has ever been there; return its displacement."""

    @abstractmethod
    def follow(self, halves_a: F64, free_um: F64) -> None:
        """Advance step by step.

        Args:
            halves_a: float64[2n + 1], current at the start of the first step, then at the middle
                and the end of each.
            free_um: float64[n], filled with the free displacement at the end of each step.
        """


class RodParameters(ABC):
    """Constants of one physics of the rods."""

    __slots__ = ()

    @abstractmethod
    def rods(self, coil: Coil) -> Rods:
        """Return such rods in a coil; they are to be put to rest before anything else."""

    @abstractmethod
    def varied(self, lag: float, pinning: float, strain: float) -> "RodParameters":
        """Return rods that differ by these factors on lag, width of the loops and stroke."""
