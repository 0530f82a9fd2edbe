"""Campaign file: its models, varied values and their order."""

import random
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import Field

from hilctl.base.strict import StrictModel
from hilctl.base.yaml import Loc
from hilctl.experiment.sections import Condition, Name

RunOrder = Literal["as_written", "random", "alternating"]


class ReferenceRun(StrictModel):
    """The same run again and again: its change is the drift of rig and actuator.

    Attributes:
        every: It comes first, after so many steps, and last.
        set: Keys of the base experiment that it has otherwise.
    """

    every: Annotated[int, Field(ge=1, le=10_000)]
    set: dict[str, Any] = Field(default_factory=dict)


class CoolDown(StrictModel):
    """How long the coil cools before a run, by its own thermal model in ``limits``.

    Attributes:
        to_rms_a: Running rms of the current that it cools to before every run; left out, only as
            far as the run needs to keep its budget.
    """

    to_rms_a: Annotated[float, Field(gt=0.0)] | None = None


class CampaignFile(StrictModel):
    """One campaign: a base experiment, and what varies.

    Attributes:
        name: Short name; that of its recordings, and of their folder.
        description: What it is for.
        experiment: The base experiment's file, relative to this file's folder.
        set: Keys of it that all steps have otherwise; dotted, as with ``--set``.
        vary: Dotted keys, each with a list of values, or with a range ``first:last:count`` of
            even steps, ``first:last:countlog`` of even ratios. The keys of a mapping are crossed;
            in a list of mappings, the keys of each go together and the mappings are crossed.
        order: ``as_written``, the last key fastest; ``random`` by ``seed``; or ``alternating`` up
            and down, against drift.
        seed: Of the random order.
        repeat: How often each step is run.
        reference_run: A run that comes again and again; None for none.
        condition: What the actuator goes through before every run.
        cool_down: How long the coil cools before a run.
        folder: Where recordings and table go, relative to where hilctl runs; left out, a folder of
            the campaign's name in the experiment's ``recording.folder``.
    """

    name: Name
    description: str = ""
    experiment: str
    set: dict[str, Any] = Field(default_factory=dict)
    vary: dict[str, Any] | tuple[dict[str, Any], ...]
    order: RunOrder = "as_written"
    seed: Annotated[int, Field(ge=0)] = 1
    repeat: Annotated[int, Field(ge=1, le=10_000)] = 1
    reference_run: ReferenceRun | None = None
    condition: Condition | None = None
    cool_down: CoolDown = Field(default_factory=CoolDown)
    folder: str | None = None


Point: TypeAlias = Mapping[str, Any]
"""A value for each varied key."""
Broken: TypeAlias = tuple[Loc, str, str, str]
"""Where a rule is broken, the rule, the value, and what to do."""

MOST_STEPS = 10_000

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_RANGE = re.compile(rf"({_NUMBER}):({_NUMBER}):(\d+)(log|lin)?\Z")
_DIGITS = 6  # of a value within a range: enough for any rig, and short enough to read


def values_of(given: Any) -> tuple[Any, ...]:
    """Return the values of a key: those of a list, or of a range ``first:last:count[log|lin]``.

    Raises:
        ValueError: It is neither; the text is the rule.
    """
    if isinstance(given, tuple):
        if not given:
            raise ValueError("must have at least one value")
        return given
    found = _RANGE.match(given) if isinstance(given, str) else None
    if found is None:
        raise ValueError("must be a list of values, or a range such as 1:9:9 or 1:250:12log")
    first, last, count = float(found[1]), float(found[2]), int(found[3])
    if not 2 <= count <= MOST_STEPS:
        raise ValueError(f"must have 2 to {MOST_STEPS} values")
    if found[4] != "log":
        return _rounded(np.linspace(first, last, count))
    if not (first > 0.0 and last > 0.0):
        raise ValueError("must have ends above 0 where it is log")
    return _rounded(np.geomspace(first, last, count))


def _rounded(values: Iterable[float]) -> tuple[float, ...]:
    return tuple(float(f"{value:.{_DIGITS}g}") for value in values)


def groups_of(
    vary: Mapping[str, Any] | Sequence[Mapping[str, Any]],
) -> tuple[list[list[Point]], list[Broken]]:
    """Return the groups that are crossed, each a list of points, and what is wrong with them.

    Args:
        vary: A mapping whose keys are crossed, or mappings whose keys go together.
    """
    single = isinstance(vary, Mapping)
    written: list[tuple[Loc, Mapping[str, Any]]] = (
        [((), {key: given}) for key, given in vary.items()]
        if isinstance(vary, Mapping)
        else [((number,), group) for number, group in enumerate(vary)]
    )
    groups: list[list[Point]] = []
    broken: list[Broken] = []
    seen: set[str] = set()
    for loc, group in written:
        columns: dict[str, tuple[Any, ...]] = {}
        for key, given in group.items():
            try:
                columns[key] = values_of(given)
            except ValueError as error:
                broken.append(((*loc, key), str(error), repr(given), ""))
            if key in seen:
                broken.append(((*loc, key), "is varied already", "", "give it once"))
            seen.add(key)
        lengths = {len(values) for values in columns.values()}
        if len(lengths) > 1:
            counted = ", ".join(f"{key} {len(values)}" for key, values in columns.items())
            rule = "must have as many values for each key, as they go together"
            broken.append((loc, rule, counted, "keys of mappings of their own are crossed"))
        elif columns:
            groups.append(
                [
                    dict(zip(columns, row, strict=True))
                    for row in zip(*columns.values(), strict=True)
                ]
            )
    if not written or (not single and not seen):
        broken.append(((), "must name at least one key", "", ""))
    return groups, broken


def points(
    groups: Sequence[Sequence[Point]], order: RunOrder, seed: int, repeat: int
) -> list[tuple[Point, int]]:
    """Return every point in the order in which it is run, and which repeat of it that is, from 1.

    Args:
        groups: What is crossed; the last goes fastest.
        order: See :class:`hilctl.studies.campaign.file.CampaignFile`.
        seed: Of the random order.
        repeat: How often each point is run.
    """
    alternating = order == "alternating"
    row: list[Point] = [{}]
    for group in groups:
        wider: list[Point] = []
        for number, point in enumerate(row):
            # Every other row backwards: then no step goes from one end of a range to the other.
            members = reversed(group) if alternating and number % 2 else group
            wider += [{**point, **member} for member in members]
        row = wider
    found: list[tuple[Point, int]] = []
    for number in range(repeat):
        again = reversed(row) if alternating and number % 2 else row
        found += [(point, number + 1) for point in again]
    if order == "random":
        random.Random(seed).shuffle(found)  # noqa: S311  an order, no secret
    return found
