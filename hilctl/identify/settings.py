"""How a model is fitted: the published choices, and what may be chosen instead."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

from hilctl.base.device import CommandUnit
from hilctl.base.errors import InputError

Kind: TypeAlias = Literal["ppi", "rdpi", "integrated", "staged"]
Weights: TypeAlias = Literal["exponential", "free"]
Layout: TypeAlias = Literal["even", "midpoint"]
WeightBy: TypeAlias = Literal["equal", "hysteresis"]
Core: TypeAlias = Literal["integrated", "preisach"]
Lag: TypeAlias = Literal["growth", "plain", "none"]


@dataclass(frozen=True, slots=True)
class Settings:
    """Choices of an identification; :meth:`published` gives those of the dissertation.

    Attributes:
        plays: Number n of play operators.
        deadbands_a_side: k deadband operators on each side of 0, 2 k + 1 in all; integrated only.
        weights: ``exponential`` for weights that fall as alpha e^(-beta i) (3.26, 6.19-6.23), or
            ``free`` for weights found one by one.
        layout: ``even`` for thresholds r_i = alpha i (3.25, 6.18), or ``midpoint`` for
            r_i = alpha (i - 1/2).
        weight_by: ``equal`` for the sum of squares as it stands (6.24), or ``hysteresis`` to
            weight each loop by its peak hysteresis (5.14).
        output_offset: Whether to fit a constant displacement too; the published models have none.
        starts: Starting points of the search.
        least_slope: Smallest slope that the model may have anywhere, relative to the data's mean
            slope; more than 0, because the inverse has its reciprocal.
        peak_goal_percent: Where given, samples with a larger error, in percent of the largest
            peak-to-peak output, gain weight after the fit until there are none, or no round
            helps any more. The published criterion has no such step.
        hysteresis: Staged only: ``integrated`` for plays and deadbands, whose inverse is analytic,
            or ``preisach`` for a Preisach triangle in their place, once the stages are known.
        lines: Lines of the triangle, and cells of the longest.
        lag: Staged only: the field lag, ``growth`` for one that grows with its distance,
            ``plain`` for one that doesn't, or ``none``; then thresholds grow with the rate.
        structure: Staged only: whether there is a second-order structure.
        delay: Staged only: whether there is a transport delay.
        creep: PPI and RDPI only: whether each record has a displacement of its own,
            c + d ln(1 + t / 0.1 s), beside the model: a sensor's zero and creep.
        input_unit: Unit of the command.
    """

    plays: int
    deadbands_a_side: int = 0
    weights: Weights = "exponential"
    layout: Layout = "even"
    weight_by: WeightBy = "equal"
    output_offset: bool = False
    starts: int = 6
    least_slope: float = 0.01
    peak_goal_percent: float | None = None
    hysteresis: Core = "integrated"
    lines: int = 28
    lag: Lag = "none"
    structure: bool = False
    delay: bool = False
    creep: bool = False
    input_unit: CommandUnit = "A"

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            InputError: One is out of range.
        """
        for name, value, low in (
            ("plays", self.plays, 1),
            ("deadbands_a_side", self.deadbands_a_side, 0),
            ("starts", self.starts, 1),
            ("lines", self.lines, 2),
        ):
            if value < low:
                raise InputError(f"{name} must be at least {low}: {value}")
        if not 0.0 < self.least_slope < 1.0:
            raise InputError(f"least_slope must be > 0 and < 1: {self.least_slope!r}")
        if self.peak_goal_percent is not None and not self.peak_goal_percent > 0.0:
            raise InputError(f"peak_goal_percent must be > 0: {self.peak_goal_percent!r}")

    @classmethod
    def published(cls, kind: Kind) -> "Settings":
        """Return the published choices: sections 3.4.2 (PPI), 5.3 (RDPI) and 6.4 (integrated).

        Nothing is published for staged models; these choices met their figures on the simulated
        rig.
        """
        if kind == "staged":
            return cls(
                plays=20,
                deadbands_a_side=12,
                weights="free",
                output_offset=True,
                starts=4,
                lag="growth",
                structure=True,
                delay=True,
            )
        if kind == "ppi":
            return cls(plays=10, input_unit="V")
        if kind == "rdpi":
            return cls(plays=4, weights="free", weight_by="hysteresis")
        return cls(plays=12, deadbands_a_side=8)
