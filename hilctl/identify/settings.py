"""What can be chosen about a fit: each setting once, with its default, its limits and its kinds.

A new setting is a field of :class:`FitSettings`. The command line, the list that ``hilctl identify
--settings`` prints and the line that a model file has of its fit all follow from the fields.
"""

from collections.abc import Iterator, Mapping
from typing import Any, Literal, Self, TypeAlias, get_args, get_origin

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
_PLAYS = (*_SEARCHED, "staged")

_HISTORIES = {"field", "generalised_duhem", "ppi", "spi"}

_PPI: Choices = {"plays": 10}
PUBLISHED: Mapping[str, Choices] = {
    "ppi": _PPI,
    "spi": _PPI,
    "rdpi": {"plays": 4, "weights": "free", "weight_by": "hysteresis", "points": 400},
    # Nothing is published for staged models: these met the published figures on the simulated rig.
    "staged": {"plays": 20, "deadbands": 12, "offset": True, "starts": 4},
    "preisach": {"lines": 16},
    "butterfly": {"plays": 16},
    "field": {"plays": 32, "cells": 12},
}
"""Defaults of a kind that are not those of all; sections 3.4.2 (PPI), 5.3 (RDPI), 6.4."""


def _of(*kinds: str, default: Any, description: str, **limits: Any) -> Any:
    """Return a field that only these kinds of model have; all, where none is named."""
    return Field(
        default, description=description, json_schema_extra={"kinds": list(kinds)}, **limits
    )


class FitSettings(StrictModel):
    """Choices of a fit; what is not given is as published for the kind of model."""

    kind: FitKind = Field("integrated", description="Kind of model.")
    plays: int = _of(
        *_PLAYS,
        "asymmetric",
        "generalised",
        "butterfly",
        "field",
        default=12,
        ge=1,
        le=200,
        description="Play operators n; auto for as many as loops held out bear.",
    )
    deadbands: int = _of(
        "integrated",
        "staged",
        "asymmetric",
        default=8,
        ge=1,
        le=100,
        description="Deadband operators k on each side of 0, 2 k + 1 in all.",
    )
    lines: int = _of(
        "staged",
        "preisach",
        default=28,
        ge=2,
        le=100,
        description="Lines of a Preisach triangle, and cells of the longest; or auto.",
    )
    drags: int = _of("field", default=3, ge=0, le=12, description="Drags, whose small loops creep.")
    cells: int = _of(
        "field",
        "generalised_duhem",
        default=28,
        ge=3,
        le=60,
        description="Pieces of each table, along the effective field or the displacement.",
    )
    across: int = _of(
        "generalised_duhem",
        default=20,
        ge=2,
        le=60,
        description="Cells of a table of slopes across its band.",
    )
    knots: int = _of(
        "field", default=24, ge=2, le=60, description="Pieces of the curve after them."
    )
    size: Literal["given", "auto"] = _of(
        *_PLAYS,
        default="given",
        description="auto: the smallest number of operators that loops held out bear.",
    )
    weights: Literal["exponential", "free"] = _of(
        *_SEARCHED,
        default="exponential",
        description="Weights that fall as a e^(-b i) (3.26, 6.19-6.23), or one by one.",
    )
    layout: Literal["even", "midpoint"] = _of(
        *_PLAYS, default="even", description="Thresholds alpha i (3.25, 6.18), or alpha (i - 1/2)."
    )
    weight_by: Literal["equal", "hysteresis"] = _of(
        *_PLAYS,
        default="equal",
        description="Weight of a loop: 1 (6.24), or its peak hysteresis (5.14).",
    )
    offset: bool = _of(
        *_PLAYS,
        default=False,
        description="Find a constant displacement too; published models have none.",
    )
    creep: bool = _of(
        *_PLAIN,
        default=False,
        description="A zero and creep, c + d ln(1 + t / 0.1 s), of each record's own.",
    )
    creep_stage: bool = _of(
        "staged",
        "field",
        "generalised_duhem",
        default=True,
        description="Whether creep is looked for, where histories rest for 0.5 s and more.",
    )
    modes: bool = _of(
        "staged",
        "field",
        "generalised_duhem",
        default=True,
        description="Whether further modes of the structure are looked for in histories.",
    )
    hysteresis: Literal["integrated", "preisach"] = _of(
        "staged",
        default="integrated",
        description="Plays and deadbands, or a Preisach triangle in their place.",
    )
    lag: Literal["growth", "plain", "none"] = _of(
        "staged",
        default="growth",
        description="Field lag: one that grows with its distance, plain, or none.",
    )
    structure: bool = _of(
        "staged", default=True, description="Whether there is a second-order structure."
    )
    delay: bool = _of("staged", default=True, description="Whether there is a transport delay.")
    turning_um: float | None = _of(
        "butterfly",
        default=None,
        description="Displacement where the wings meet; else the lowest of all.",
    )
    magnets: bool = _of(
        "butterfly", default=True, description="Whether something biases the rods at no command."
    )
    starts: int = _of(
        *_PLAYS, default=6, ge=1, le=1000, description="Starting points of the search."
    )
    peak_goal_percent: float | None = _of(
        *_PLAYS,
        default=None,
        gt=0.0,
        description="Reweight after the fit until no error is larger, of the stroke.",
    )
    points: int = _of(default=300, ge=16, le=100_000, description="Points a loop.")

    @model_validator(mode="before")
    @classmethod
    def _published(cls, given: Any) -> Any:
        """Fill in the kind's own defaults; ``auto`` for a number of operators is a size."""
        if not isinstance(given, dict):
            return given
        sized = [name for name in ("plays", "lines") if given.get(name) == "auto"]
        if sized and "deadbands" in given:
            raise ValueError(f"{sized[0]}=auto finds the number of deadbands too: leave it out")
        kept = {name: value for name, value in given.items() if name not in sized}
        kind = kept.get("kind", "integrated")
        published = PUBLISHED.get(kind, {}) if isinstance(kind, str) else {}
        return {**published, **({"size": "auto"} if sized else {}), **kept}

    @field_validator("*")
    @classmethod
    def _belongs(cls, value: Any, info: ValidationInfo) -> Any:
        kinds, kind = kinds_of(cls.model_fields[str(info.field_name)]), info.data.get("kind")
        if kinds and kind is not None and kind not in kinds:
            raise ValueError(f"is a setting of {', '.join(kinds)}, not of {kind}: leave it out")
        return value

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.hysteresis == "preisach" and self.lag == "none":
            raise ValueError("hysteresis: a Preisach triangle has no rate: it needs a lag")
        return self

    def has(self, name: str) -> bool:
        """Whether a setting belongs to this kind of model."""
        kinds = kinds_of(type(self).model_fields[name])
        return not kinds or self.kind in kinds

    def looks_for(self, name: str) -> bool:
        """Whether a part that may be left out belongs to this kind, and is looked for."""
        return self.has(name) and bool(getattr(self, name))

    def changes(self) -> str:
        """Return what is not as published for the kind, as ``key=value`` with commas between."""
        published = type(self)(kind=self.kind).model_dump()
        return ", ".join(
            f"{name}={value}" for name, value in _differing(self.model_dump(), published)
        )


class TableSettings(StrictModel):
    """How text tables are read; recordings need none of it."""

    unit: CommandUnit | None = Field(None, description="Unit of the command.")
    command_column: str | int = Field("current_a", description="Name, or number from 1.")
    displacement_column: str | int = Field("displacement_um", description="The same, in um.")
    time_column: str | int | None = Field(None, description="The same, in s, or give rate_hz.")
    rate_hz: float | None = Field(None, gt=0.0, description="Samples a second without a time.")
    first_row: int = Field(1, ge=1, description="First data row used, from 1.")
    last_row: int | None = Field(None, ge=1, description="Last data row used; else all.")
    ignore: int = Field(0, ge=0, description="Rows at the start that are run but not judged.")
    lag_samples: int = Field(
        0, ge=0, le=10_000, description="Samples by which the displacement lags; or auto."
    )
    find_lag: bool = Field(False, description="Take the lag that leaves the least error.")

    @model_validator(mode="before")
    @classmethod
    def _lag(cls, given: Any) -> Any:
        if isinstance(given, dict) and given.get("lag_samples") == "auto":
            return {"find_lag": True, **{k: v for k, v in given.items() if k != "lag_samples"}}
        return given


class IdentifySettings(FitSettings):
    """Choices of a fit to files: those of the fit, and how the files are read."""

    leave_out: tuple[str, ...] = Field((), description="Labels of loops, or files, not to use.")
    auto: bool = Field(False, description="Take the kind that does best on data held out.")
    whole: bool = Field(False, description="Judge whole histories, not their steady cycles.")
    table: TableSettings = Field(TableSettings(), description="How text tables are read.")

    @model_validator(mode="before")
    @classmethod
    def _histories(cls, given: Any) -> Any:
        """Whole histories for a kind whose small loops remember the large ones before them.

        And for those that know no rate: their range must reach to where a run begins, at rest.
        """
        if isinstance(given, dict) and given.get("kind") in _HISTORIES:
            return {"whole": True, **given}
        return given

    def unit(self, recorded: CommandUnit | None) -> CommandUnit:
        """Return the command's unit, that of the recordings where there are any."""
        return recorded or self.table.unit or ("V" if self.kind in {"ppi", "spi"} else "A")


def kinds_of(field: FieldInfo) -> tuple[str, ...]:
    """Return the kinds of model that have a setting; none where all have it."""
    extra = field.json_schema_extra
    kinds = extra.get("kinds", []) if isinstance(extra, dict) else []
    return tuple(map(str, kinds)) if isinstance(kinds, list) else ()


def setting_rows() -> Iterator[tuple[str, str, str, str, str]]:
    """Give name, default, limits, kinds and meaning of all settings, in order."""
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
