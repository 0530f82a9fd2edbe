"""What the identify command was asked for."""

from dataclasses import dataclass, replace
from typing import Literal, TypeVar

from hilctl.base.device import CommandUnit
from hilctl.base.errors import InputError
from hilctl.identify.files import TableOptions
from hilctl.identify.settings import Core, Kind, Lag, Layout, Settings, WeightBy, Weights

Value = TypeVar("Value")


@dataclass(frozen=True, slots=True)
class Request(TableOptions):
    """What the command line asked for; None stands for the published choice.

    Attributes:
        plays: Play operators; ``auto`` to have loops that are not fitted decide.
        scheduler: Where independent fits run, see :func:`hilctl.identify.workers.workers`.
    """

    kind: Kind = "integrated"
    points: int | None = None
    seed: int = 1
    plays: int | Literal["auto"] | None = None
    deadbands: int | None = None
    weights: Weights | None = None
    layout: Layout = "even"
    weight_by: WeightBy | None = None
    offset: bool = False
    creep: bool = False
    starts: int | None = None
    peak_goal_percent: float | None = None
    hysteresis: Core | None = None
    lines: int | None = None
    lag: Lag | None = None
    structure: bool | None = None
    delay: bool | None = None
    unit: CommandUnit | None = None
    scheduler: str = "none"

    def settings(self, recorded: CommandUnit | None) -> Settings:
        """Return the choices of the fit, given the unit of the recordings.

        Raises:
            InputError: The unit is not known, or not what was recorded; choices contradict.
        """
        if recorded and self.unit and recorded != self.unit:
            raise InputError(f"--unit must be {recorded}, that of the recordings: {self.unit}")
        if self.plays == "auto" and self.deadbands is not None:
            raise InputError(
                "--plays auto finds the number of deadbands too: leave --deadbands out"
            )
        published = Settings.published(self.kind)
        plays = None if self.plays == "auto" else self.plays
        return replace(
            published,
            plays=_given(plays, published.plays),
            deadbands_a_side=_given(self.deadbands, published.deadbands_a_side),
            weights=_given(self.weights, published.weights),
            layout=self.layout,
            weight_by=_given(self.weight_by, published.weight_by),
            output_offset=self.offset or published.output_offset,
            creep=self.creep,
            starts=_given(self.starts, published.starts),
            peak_goal_percent=self.peak_goal_percent,
            hysteresis=_given(self.hysteresis, published.hysteresis),
            lines=_given(self.lines, published.lines),
            lag=_given(self.lag, published.lag),
            structure=_given(self.structure, published.structure),
            delay=_given(self.delay, published.delay),
            input_unit=_given(recorded or self.unit, published.input_unit),
        )


def _given(asked: Value | None, published: Value) -> Value:
    return published if asked is None else asked
