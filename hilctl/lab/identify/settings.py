"""Settings of a fit, each with its default and limits; a kind of model takes some of them.

A new setting is a field of :class:`FitSettings`, named by each :class:`Fit` that takes it. The
command line, the list of ``hilctl identify --settings`` and the provenance in a model file follow
from the fields.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, Literal, TypeAlias, get_args, get_origin

from pydantic import Field, ValidationInfo, field_validator, model_validator
from pydantic.fields import FieldInfo

from hilctl.base.errors import InputError
from hilctl.base.strict import StrictModel
from hilctl.base.table import known_unit
from hilctl.base.types import CommandUnit
from hilctl.lab.identify.registry import Fit, all_fits, fit_named
from hilctl.models.kinds import FITS, known

Choices: TypeAlias = Mapping[str, Any]
NO_CHOICES: Choices = {}
_COMMON = {"kind", "points", "highest_hz", "own"}
"""Settings of all kinds of model."""


def _setting(default: Any, description: str, **limits: Any) -> Any:
    return Field(default, description=description, **limits)


class FitSettings(StrictModel):
    """Settings of a fit; the defaults are those published for the kind of model."""

    REMOVED: ClassVar[Mapping[str, str]] = {
        "drags": "removed: --model field fits plays only; --model generalised_duhem has such loops",
        "hysteresis": "removed: --model field has a smaller error than a Preisach triangle",
        "lag": "removed: --model staged fits a growing lag, whose growth may be 0",
        "size": "removed: set plays, and deadbands if the kind has any",
        "delay": "removed: --model staged fits a delay, which may be 0",
    }

    kind: str = _setting("integrated", "Kind of model.")
    plays: int = _setting(12, "Play operators n.", ge=1, le=200)
    deadbands: int = _setting(
        8, "Deadband operators k on each side of 0, 2 k + 1 in all.", ge=1, le=100
    )
    lines: int = _setting(
        16, "Lines of a Preisach triangle, and cells of the longest line.", ge=2, le=100
    )
    cells: int = _setting(
        28, "Pieces of each table, along the effective field or the displacement.", ge=3, le=60
    )
    across: int = _setting(20, "Cells of a table of slopes across its band.", ge=2, le=60)
    activation: bool = _setting(False, "Plays creep with the logarithm of time.")
    accommodation: bool = _setting(False, "Plays forget with the travel of the field.")
    knots: int = _setting(24, "Pieces of the output curve.", ge=2, le=60)
    weights: Literal["exponential", "free"] = _setting(
        "exponential", "Weights a e^(-b i) (3.26, 6.19-6.23), or each weight by itself."
    )
    layout: Literal["even", "midpoint"] = _setting(
        "even", "Thresholds alpha i (3.25, 6.18), or alpha (i - 1/2)."
    )
    weight_by: Literal["equal", "hysteresis"] = _setting(
        "equal", "Weight of a loop: 1 (6.24), or its peak hysteresis (5.14)."
    )
    offset: bool = _setting(False, "Fit a constant displacement; published models have none.")
    creep: bool = _setting(False, "Fit an offset and creep, c + d ln(1 + t / 0.1 s), per record.")
    creep_stage: bool = _setting(True, "Fit creep if histories rest for 0.5 s or longer.")
    modes: bool = _setting(True, "Fit further modes of the structure to histories.")
    structure: bool = _setting(True, "Fit a second-order structure.")
    turning_um: float | None = _setting(
        None, "Displacement where the wings meet; the lowest one if not set."
    )
    magnets: bool = _setting(True, "Fit a bias field at zero command.")
    starts: int = _setting(6, "Starting points of the search.", ge=1, le=1000)
    points: int = _setting(300, "Points per loop.", ge=16, le=100_000)
    highest_hz: float | None = _setting(
        None, "Highest frequency of use: faster motions are fitted, not evaluated.", gt=0.0
    )
    own: Any = Field(None, description="Settings of the kind's own.", validate_default=True)

    @property
    def fit(self) -> Fit:
        """The fit of this kind of model."""
        return fit_named(self.kind)

    @model_validator(mode="before")
    @classmethod
    def _published(cls, given: Any) -> Any:
        """Fill in the defaults of the kind."""
        fit = _fit_in(given)
        return {**fit.published, **given} if fit else given

    @field_validator("kind")
    @classmethod
    def _registered(cls, kind: str) -> str:
        try:
            fit_named(kind)
        except InputError as error:
            raise ValueError(str(error)) from error
        return kind

    @field_validator("*")
    @classmethod
    def _belongs(cls, value: Any, info: ValidationInfo) -> Any:
        kind, name = info.data.get("kind"), str(info.field_name)
        if kind is not None and not _takes(fit_named(kind), name):
            kinds = ", ".join(other for other, fit in all_fits().items() if _takes(fit, name))
            raise ValueError(f"is a setting of {kinds}, not of {kind}: omit it")
        return value

    @field_validator("own")
    @classmethod
    def _of_its_own(cls, value: Any, info: ValidationInfo) -> Any:
        own = fit_named(info.data["kind"]).own if "kind" in info.data else None
        if own is not None:
            return own.model_validate({} if value is None else value)
        if value is not None:
            raise ValueError(f"has no settings for {info.data.get('kind')}: omit it")
        return None

    def has(self, name: str) -> bool:
        """Whether a setting belongs to this kind of model."""
        return _takes(self.fit, name)

    def looks_for(self, name: str) -> bool:
        """Whether an optional part belongs to this kind, and is to be fitted."""
        return self.has(name) and bool(getattr(self, name))

    def changes(self) -> str:
        """Return settings that differ from the published ones, as ``key=value, key=value``."""
        published = type(self)(kind=self.kind).model_dump()
        changed = _differing(self.model_dump(), published)
        return ", ".join(f"{name}={value}" for name, value in changed)


class TableSettings(StrictModel):
    """How text tables are read; not used for recordings."""

    unit: CommandUnit | None = _setting(None, "Unit of the command.")
    command_column: str | int | None = _setting(
        None, "Column name, or number from 1; default: current_a, or the only one in A or V."
    )
    displacement_column: str | int | None = _setting(
        None, "The same for the displacement; default: displacement_um, or the only one in um."
    )
    time_column: str | int | None = _setting(
        None, "The same for the time; default: t_s, or the only one in s, without rate_hz."
    )
    rate_hz: float | None = _setting(None, "Samples per second if there is no time column.", gt=0.0)
    command_scale: float | None = _setting(None, "Unit of the command per unit of its column.")
    displacement_scale: float | None = _setting(
        None, "um per unit of the displacement's column, as um per V of a sensor."
    )
    skip_rows: int = _setting(0, "Lines at the start of a text table to skip.", ge=0)
    first_row: int = _setting(1, "First data row used, from 1.", ge=1)
    last_row: int | None = _setting(None, "Last data row used; all if not set.", ge=1)
    ignore: int | None = _setting(
        None, "Rows at the start that are simulated but not evaluated.", ge=0
    )
    lag_samples: int = _setting(
        0, "Lag of the displacement in samples, < 0 if it leads; or auto.", ge=-10_000, le=10_000
    )
    find_lag: bool = _setting(False, "Select the lag with the least error.")

    @field_validator("unit", mode="before")
    @classmethod
    def _base_unit(cls, unit: Any) -> Any:
        base, factor = (isinstance(unit, str) and known_unit(unit)) or ("", 1.0)
        if base in get_args(CommandUnit) and unit != base:
            raise ValueError(f"must be A or V: for {unit} set {base}, and command_scale {factor:g}")
        return unit

    @model_validator(mode="before")
    @classmethod
    def _lag(cls, given: Any) -> Any:
        if isinstance(given, dict) and given.get("lag_samples") == "auto":
            return {"find_lag": True, **{k: v for k, v in given.items() if k != "lag_samples"}}
        return given


class IdentifySettings(FitSettings):
    """Settings of a fit to files: those of the fit, and how the files are read."""

    leave_out: tuple[str, ...] = Field((), description="Labels of loops or files to exclude.")
    auto: bool = Field(False, description="Select the kind with the least error on held-out data.")
    whole: bool = Field(False, description="Fit whole histories, not their steady cycles.")
    table: TableSettings = Field(TableSettings(), description="How text tables are read.")

    @model_validator(mode="before")
    @classmethod
    def _histories(cls, given: Any) -> Any:
        """Select whole histories for kinds that need the state of rest or large loops."""
        fit = _fit_in(given)
        return {"whole": True, **given} if fit and fit.whole else given

    def unit(self, recorded: CommandUnit | None) -> CommandUnit:
        """Return the unit of the command, from the recordings if there are any."""
        return recorded or self.table.unit or self.fit.unit


def _fit_in(given: Any) -> Fit | None:
    """Return the fit of unchecked settings; None if its name is unknown."""
    kind = given.get("kind", "integrated") if isinstance(given, dict) else None
    return fit_named(kind) if isinstance(kind, str) and kind in known(FITS) else None


def _takes(fit: Fit, name: str) -> bool:
    return name in fit.takes or name in _COMMON or name not in FitSettings.model_fields


def setting_rows() -> Iterator[tuple[str, str, str, str, str]]:
    """Yield name, default, limits, kinds and meaning of all settings."""
    fits = all_fits()
    for name, field in IdentifySettings.model_fields.items():
        if name == "table":
            yield from (_row(f"table.{k}", each) for k, each in TableSettings.model_fields.items())
        elif name == "own":
            for kind, fit in fits.items():
                inner = fit.own.model_fields if fit.own else {}
                yield from (_row(f"own.{k}", each, kinds=[kind]) for k, each in inner.items())
        else:
            others = {k: fit.published[name] for k, fit in fits.items() if name in fit.published}
            kinds = [kind for kind, fit in fits.items() if _takes(fit, name)]
            row = _row(name, field, others, kinds if len(kinds) < len(fits) else ())
            yield (*row[:2], ", ".join(fits), *row[3:]) if name == "kind" else row


def _row(
    name: str, field: FieldInfo, others: Choices = NO_CHOICES, kinds: Sequence[str] = ()
) -> tuple[str, str, str, str, str]:
    default = _text(field.default)
    default += "".join(f", {_text(value)} for {kind}" for kind, value in others.items())
    return name, default, _limits(field), ", ".join(kinds) or "all", str(field.description)


def _limits(field: FieldInfo) -> str:
    known = {
        sign: getattr(rule, name)
        for rule in field.metadata
        for sign, name in ((">= ", "ge"), ("> ", "gt"), ("<= ", "le"), ("< ", "lt"))
        if hasattr(rule, name)
    }
    if known.keys() == {">= ", "<= "}:
        return f"{known['>= ']} to {known['<= ']}"
    if get_origin(field.annotation) is Literal:
        return ", ".join(map(str, get_args(field.annotation)))
    return ", ".join(f"{sign}{value}" for sign, value in known.items())


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return "-" if value is None else str(value)


def _differing(given: Choices, published: Choices, at: str = "") -> Iterator[tuple[str, str]]:
    for name, value in given.items():
        if isinstance(value, dict):
            yield from _differing(value, published[name], f"{at}{name}.")
        elif value != published[name]:
            yield at + name, _text(value)
