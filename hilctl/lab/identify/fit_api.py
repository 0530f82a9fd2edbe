"""Types of a fit: its request, its job, and its result."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from hilctl.base.types import CommandUnit
from hilctl.lab.identify.data.records import Record
from hilctl.lab.identify.fit_data import FitData
from hilctl.lab.identify.parallel import MapFunction
from hilctl.lab.identify.settings import FitSettings
from hilctl.models.base import HysteresisModel
from hilctl.models.linear_stages import Compliance, FirstMode, FurtherMode

LEAST_SLOPE = 0.01  # smallest slope that a model may have, of the mean slope of the data

OnProgress: TypeAlias = Callable[[float, str], None]
"""Progress callback: completed part (0 to 1) and current step."""


def ignore_progress(done: float, text: str) -> None:
    """Ignore a progress report."""


Structure: TypeAlias = FirstMode | bool
"""First mode of the structure: measured, to be identified (True), or none (False)."""


@dataclass(frozen=True, slots=True)
class FitRequest:
    """Records to fit, and settings."""

    records: Sequence[Record]
    settings: FitSettings
    unit: CommandUnit = "A"
    source: Sequence[str] = ()  # names of recordings or files, for the provenance
    run: MapFunction = map
    progress: OnProgress = ignore_progress
    start: object | None = None  # start of the search, see :class:`FitJob`
    structure: FirstMode | None = None  # measured first mode, near which histories are fitted
    modes: Sequence[FurtherMode] = ()  # known further modes, for kinds that have them
    validate: Sequence[Record] = ()  # held out if no part of the others can be


@dataclass(frozen=True, slots=True)
class FitJob:
    """Prepared data and settings of a fit that continues from ``start``, another fit's end."""

    data: FitData
    settings: FitSettings
    run: MapFunction = map
    progress: OnProgress = ignore_progress
    start: object | None = None
    structure: Structure = True

    @property
    def compliance(self) -> Compliance | None:
        """Compliance of a measured structure by displacement; None if it does not depend on it."""
        return self.structure.compliance if isinstance(self.structure, FirstMode) else None

    @property
    def least(self) -> float:
        """Smallest slope that a model may have, in um per command unit."""
        return LEAST_SLOPE * self.data.gain


@dataclass(frozen=True, slots=True)
class StartOutcome:
    """One start of a search."""

    start: str  # ``data``, ``random N``, or ``weights N`` for a linear solution
    rms_percent: float  # weighted error at its end, in percent of the largest peak-to-peak


@dataclass(frozen=True)
class FoundModel:
    """A model without provenance, and how it was identified."""

    model: HysteresisModel
    numbers: int
    # by published name, in command units, um and s; empty for tables
    parameters: dict[str, float] = field(default_factory=dict)
    starts: tuple[StartOutcome, ...] = ()
    standard_errors: dict[str, float] = field(default_factory=dict)  # of the parameters, if known
    at_bound: tuple[str, ...] = ()
    end: object | None = None  # end of the search, from which another fit can start
