"""Types of a fit: what every way to identify a model takes and returns."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from hilctl.base.types import CommandUnit
from hilctl.identify.data.records import Record
from hilctl.identify.fit_data import FitData
from hilctl.identify.parallel import MapFunction, serial_map
from hilctl.identify.settings import FitSettings
from hilctl.models.base import HysteresisModel
from hilctl.models.mechanics import FurtherMode

LEAST_SLOPE = 0.01
"""Smallest slope that a model may have, of the mean slope of the data."""

OnProgress: TypeAlias = Callable[[float, str], None]
"""Called now and then with the part that is done (0 to 1) and what is being done."""


def ignore_progress(done: float, text: str) -> None:
    """Take a progress report and do nothing with it."""


@dataclass(frozen=True, slots=True)
class FitRequest:
    """Records to fit, and how.

    Attributes:
        records: At least one loop or history; steady loops only for what has dynamics.
        settings: The kind of model, and all other choices.
        unit: Unit of the command.
        source: Recordings or files that the data come from, for the provenance.
        run: Runs fits that do not depend on each other.
        progress: Called with what is being done.
        start: Where the search begins, see :class:`FitJob`.
        modes: Known further modes of the structure, for kinds that have them.
    """

    records: Sequence[Record]
    settings: FitSettings
    unit: CommandUnit = "A"
    source: Sequence[str] = ()
    run: MapFunction = serial_map
    progress: OnProgress = ignore_progress
    start: object | None = None
    modes: Sequence[FurtherMode] = ()


@dataclass(frozen=True, slots=True)
class FitJob:
    """Prepared data of one fit, and how it is made.

    Attributes:
        data: What the model is to describe.
        settings: The choices; only those of the kind count.
        run: Runs what does not depend on each other.
        progress: Called with what is being done.
        start: ``end`` of a fit of this kind to other data, or of another size, to go on from;
            kinds that have no use for it, and ends of others, are found from the beginning.
    """

    data: FitData
    settings: FitSettings
    run: MapFunction = serial_map
    progress: OnProgress = ignore_progress
    start: object | None = None

    @property
    def least(self) -> float:
        """Smallest slope that a model may have, in um per command unit."""
        return LEAST_SLOPE * self.data.gain


@dataclass(frozen=True, slots=True)
class StartOutcome:
    """One start of a search.

    Attributes:
        start: ``data`` for the rough values from the data, ``random 1`` and on for random ones,
            ``weights 1`` and on for those that follow from a linear problem.
        first_rms_percent: Error at the start, in percent of the largest peak-to-peak output,
            weighted as in the criterion.
        rms_percent: The same where the search ended.
        evaluations: Of the criterion, derivatives apart.
    """

    start: str
    first_rms_percent: float
    rms_percent: float
    evaluations: int


@dataclass(frozen=True, slots=True)
class FoundModel:
    """A model without provenance, and how it was identified.

    Attributes:
        model: The model.
        numbers: How many numbers were found for it.
        parameters: Parameters under their published names, in command units, um and s; empty for
            models that are nothing but a table of weights.
        starts: What became of each start of the search; empty where there was none.
        standard_errors: Of the parameters, by the same names; empty where a fit has none.
        at_bound: Parameters that stand on a bound: not found, but as far as they may go.
        end: Where the search ended, for one that goes on from there; None of kinds without.
    """

    model: HysteresisModel
    numbers: int
    parameters: dict[str, float] = field(default_factory=dict)
    starts: tuple[StartOutcome, ...] = ()
    standard_errors: dict[str, float] = field(default_factory=dict)
    at_bound: tuple[str, ...] = ()
    end: object | None = None
