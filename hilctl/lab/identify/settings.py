"""Settings of a fit, each with its default, limits and kinds of model.

A new setting is a field of :class:`FitSettings`. The command line, the list of ``hilctl identify
--settings`` and the provenance in a model file follow from the fields.
"""

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, Literal, TypeAlias, get_args, get_origin

from pydantic import Field, ValidationInfo, field_validator, model_validator
from pydantic.fields import FieldInfo

from hilctl.base.strict import StrictModel
from hilctl.base.types import CommandUnit

FitKind: TypeAlias = Literal[
    "integrated", "staged", "rdpi", "asymmetric", "ppi", "spi", "generalised", "preisach", "kp",
    "bouc_wen", "duhem", "butterfly", "straight", "field",
    "generalised_duhem",
]  # fmt: skip
Choices: TypeAlias = Mapping[str, Any]

_PLAIN = ("ppi", "spi", "rdpi")
_SEARCHED = (*_PLAIN, "integrated")
_PLAYS = (*_SEARCHED, "staged", "asymmetric")
_TABLES = ("field", "generalised_duhem")

_HISTORIES = {"field", "generalised_duhem", "ppi", "spi"}

_PPI: Choices = {"plays": 10}
PUBLISHED: Mapping[str, Choices] = {
    "ppi": _PPI,
    "spi": _PPI,
    "rdpi": {"plays": 4, "weights": "free", "weight_by": "hysteresis", "points": 400},
    # Nothing is published for staged models: these met the published figures on the simulated rig.
    "staged": {"plays": 20, "deadbands": 12, "offset": True, "starts": 4},
    "asymmetric": {"offset": True},
    "butterfly": {"plays": 16},
    "field": {"plays": 32, "cells": 12},
}
"""Defaults of single kinds; sections 3.4.2 (PPI), 5.3 (RDPI), 6.4."""


def _of(kinds: tuple[str, ...], default: Any, description: str, **limits: Any) -> Any:
    """Return a field of these kinds of model; of all kinds if none is named."""
    extra: dict[str, Any] = {"kinds": list(kinds)}
    return Field(default, description=description, json_schema_extra=extra, **limits)


class FitSettings(StrictModel):
    """Settings of a fit; the defaults are those published for the kind of model."""

    REMOVED: ClassVar[Mapping[str, str]] = {
        "drags": "removed: --model field fits plays only; --model generalised_duhem has such loops",
        "hysteresis": "removed: --model field has a smaller error than a Preisach triangle",
        "lag": "removed: --model staged fits a growing lag, whose growth may be 0",
        "size": "removed: set plays, and deadbands if the kind has any",
        "delay": "removed: --model staged fits a delay, which may be 0",
    }

    kind: FitKind = Field("integrated", description="Kind of model.")
    plays: int = _of(
        (*_PLAYS, "generalised", "butterfly", "field"),
        12,
        "Play operators n.",
        ge=1,
        le=200,
    )
    deadbands: int = _of(
        ("integrated", "staged", "asymmetric"),
        8,
        "Deadband operators k on each side of 0, 2 k + 1 in all.",
        ge=1,
        le=100,
    )
    lines: int = _of(
        ("preisach",),
        16,
        "Lines of a Preisach triangle, and cells of the longest line.",
        ge=2,
        le=100,
    )
    cells: int = _of(
        _TABLES,
        28,
        "Pieces of each table, along the effective field or the displacement.",
        ge=3,
        le=60,
    )
    across: int = _of(
        ("generalised_duhem",), 20, "Cells of a table of slopes across its band.", ge=2, le=60
    )
    activation: bool = _of(("field",), False, "Plays creep with the logarithm of time.")
    knots: int = _of(("field",), 24, "Pieces of the output curve.", ge=2, le=60)
    weights: Literal["exponential", "free"] = _of(
        _SEARCHED, "exponential", "Weights a e^(-b i) (3.26, 6.19-6.23), or each weight by itself."
    )
    layout: Literal["even", "midpoint"] = _of(
        _PLAIN, "even", "Thresholds alpha i (3.25, 6.18), or alpha (i - 1/2)."
    )
    weight_by: Literal["equal", "hysteresis"] = _of(
        _PLAYS, "equal", "Weight of a loop: 1 (6.24), or its peak hysteresis (5.14)."
    )
    offset: bool = _of(_PLAYS, False, "Fit a constant displacement; published models have none.")
    creep: bool = _of(
        _PLAIN, False, "Fit an offset and creep, c + d ln(1 + t / 0.1 s), per record."
    )
    creep_stage: bool = _of(_TABLES, True, "Fit creep if histories rest for 0.5 s or longer.")
    modes: bool = _of(_TABLES, True, "Fit further modes of the structure to histories.")
    structure: bool = _of(_TABLES, True, "Fit a second-order structure.")
    turning_um: float | None = _of(
        ("butterfly",), None, "Displacement where the wings meet; the lowest one if not set."
    )
    magnets: bool = _of(("butterfly",), True, "Fit a bias field at zero command.")
    starts: int = _of(_PLAYS, 6, "Starting points of the search.", ge=1, le=1000)
    points: int = _of((), 300, "Points per loop.", ge=16, le=100_000)

    @model_validator(mode="before")
    @classmethod
    def _published(cls, given: Any) -> Any:
        """Fill in the defaults of the kind."""
        if not isinstance(given, dict):
            return given
        kind = given.get("kind", "integrated")
        published = PUBLISHED.get(kind, {}) if isinstance(kind, str) else {}
        return {**published, **given}

    @field_validator("*")
    @classmethod
    def _belongs(cls, value: Any, info: ValidationInfo) -> Any:
        kinds, kind = kinds_of(cls.model_fields[str(info.field_name)]), info.data.get("kind")
        if kinds and kind is not None and kind not in kinds:
            raise ValueError(f"is a setting of {', '.join(kinds)}, not of {kind}: omit it")
        return value

    def has(self, name: str) -> bool:
        """Whether a setting belongs to this kind of model."""
        kinds = kinds_of(type(self).model_fields[name])
        return not kinds or self.kind in kinds

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

    unit: CommandUnit | None = _of((), None, "Unit of the command.")
    command_column: str | int | None = _of(
        (), None, "Column name, or number from 1; default: current_a, or the only one in A or V."
    )
    displacement_column: str | int | None = _of(
        (), None, "The same for the displacement; default: displacement_um, or the only one in um."
    )
    time_column: str | int | None = _of(
        (), None, "The same for the time; default: t_s, or the only one in s, without rate_hz."
    )
    rate_hz: float | None = _of((), None, "Samples per second if there is no time column.", gt=0.0)
    command_scale: float | None = _of((), None, "Unit of the command per unit of its column.")
    displacement_scale: float | None = _of(
        (), None, "um per unit of the displacement's column, as um per V of a sensor."
    )
    skip_rows: int = _of((), 0, "Lines at the start of a text table to skip.", ge=0)
    first_row: int = _of((), 1, "First data row used, from 1.", ge=1)
    last_row: int | None = _of((), None, "Last data row used; all if not set.", ge=1)
    ignore: int = _of((), 0, "Rows at the start that are simulated but not evaluated.", ge=0)
    lag_samples: int = _of((), 0, "Lag of the displacement in samples; or auto.", ge=0, le=10_000)
    find_lag: bool = _of((), False, "Select the lag with the least error.")

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
        if isinstance(given, dict) and given.get("kind") in _HISTORIES:
            return {"whole": True, **given}
        return given

    def unit(self, recorded: CommandUnit | None) -> CommandUnit:
        """Return the unit of the command: that of the recordings if there are any."""
        return recorded or self.table.unit or ("V" if self.kind in {"ppi", "spi"} else "A")


def kinds_of(field: FieldInfo) -> tuple[str, ...]:
    """Return the kinds of model that have a setting; none if all have it."""
    extra = field.json_schema_extra
    kinds = extra.get("kinds", []) if isinstance(extra, dict) else []
    return tuple(map(str, kinds)) if isinstance(kinds, list) else ()


def setting_rows() -> Iterator[tuple[str, str, str, str, str]]:
    """Yield name, default, limits, kinds and meaning of all settings."""
    for name, field in IdentifySettings.model_fields.items():
        if name == "table":
            for key, inner in TableSettings.model_fields.items():
                yield f"table.{key}", *_facts(inner, inner.default)
            continue
        own = {kind: values[name] for kind, values in PUBLISHED.items() if name in values}
        others = "".join(f", {_text(value)} for {kind}" for kind, value in own.items())
        default, limits, kinds, meaning = _facts(field, field.default)
        yield name, default + others, limits, kinds, meaning


def _facts(field: FieldInfo, default: Any) -> tuple[str, str, str, str]:
    kinds = ", ".join(kinds_of(field)) or "all"
    return _text(default), _limits(field), kinds, str(field.description)


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
