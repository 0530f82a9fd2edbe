"""How each kind of model is identified: its fit, found by the name of ``--model``."""

from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass, field
from typing import TYPE_CHECKING, Any

from hilctl.base.strict import StrictModel
from hilctl.base.types import CommandUnit
from hilctl.models.kinds import FITS, known, load

if TYPE_CHECKING:
    from hilctl.lab.identify.fit_api import FitJob, FoundModel

ANY = "steady loops, or whole histories"
HISTORIES = "whole histories"
LOOPS = "steady loops"

SEARCH_SETTINGS = ("plays", "weight_by", "offset", "starts")
"""Settings of a fit that searches the thresholds of plays."""
STAGE_SETTINGS = ("creep_stage", "modes", "structure")
"""Settings of a fit with linear stages."""


@dataclass(frozen=True, slots=True)
class Fit:
    """A fit of one kind of model.

    Attributes:
        title: Equations of the model.
        found_by: Method.
        data: Records that it takes, in words.
        fit: Returns the model; raises DataError if the data are not suitable.
        takes: Names of its settings, except those of all kinds.
        published: Defaults of settings that differ from the usual ones.
        own: Further settings, of another package; their names are ``own.NAME``.
        compared: Settings for ``hilctl compare``; None if it is compared by name only.
        unit: Unit of commands in a table that has none.
        whole: Whether it needs whole histories, for the state of rest or large loops.
        has_lag: Whether the model has a lag, so that its records are not thinned.
        has_offset: Whether a constant displacement is always fitted.
        is_even: Whether the displacement may rise with both signs of the command.
    """

    title: str
    found_by: str
    data: str
    fit: Callable[["FitJob"], "FoundModel"]
    _: KW_ONLY
    takes: tuple[str, ...] = ()
    published: Mapping[str, Any] = field(default_factory=dict)
    own: type[StrictModel] | None = None
    compared: Mapping[str, Any] | None = None
    unit: CommandUnit = "A"
    whole: bool = False
    has_lag: bool = False
    has_offset: bool = False
    is_even: bool = False


def fit_named(name: str) -> Fit:
    """Return a fit; raise InputError if its name is unknown, or it cannot be loaded."""
    found: Fit = load(FITS, name)
    return found


def all_fits() -> dict[str, Fit]:
    """Return all fits by name; raise InputError if one cannot be loaded."""
    return {name: fit_named(name) for name in known(FITS)}
