"""Campaign file, and the grid of its varied values."""

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
    """A repeated run whose change is the drift of rig and actuator.

    Attributes:
        every: Number of steps between reference runs; one is first and one is last.
        set: Keys of the base experiment that it changes.
    """

    every: Annotated[int, Field(ge=1, le=10_000)]
    set: dict[str, Any] = Field(default_factory=dict)


class CoolDown(StrictModel):
    """Cooling of the coil before a run, by its thermal model in ``limits``.

    Attributes:
        to_rms_a: Running rms of the current to cool to before every run; by default, only as far
            as the run needs to keep its budget.
    """

    to_rms_a: Annotated[float, Field(gt=0.0)] | None = None


class CampaignFile(StrictModel):
    """A base experiment and the keys that vary.

    Attributes:
        name: Short name of the campaign, its recordings and their folder.
        description: Its purpose.
        experiment: File of the base experiment, relative to this file's folder.
        set: Keys that all steps change; dotted, as with ``--set``.
        vary: Dotted keys, each with a list of values, or with a range ``first:last:count`` of
            even steps, ``first:last:countlog`` of even ratios. The keys of a mapping are crossed;
            in a list of mappings, the keys of each go together and the mappings are crossed.
        order: ``as_written``, the last key fastest; ``random`` by ``seed``; or ``alternating`` up
            and down, against drift.
        seed: Seed of the random order.
        repeat: Number of runs per step.
        reference_run: A repeated run that measures drift; None for none.
        condition: Conditioning of the actuator before every run.
        cool_down: Cooling of the coil before a run.
        folder: Folder of recordings and table, relative to the working directory; by default, a
            folder of the campaign's name in the experiment's ``recording.folder``.
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


Point: TypeAlias = Mapping[str, Any]  # A value for each varied key
Broken: TypeAlias = tuple[Loc, str, str, str]  # A broken rule: location, rule, value and hint

MOST_STEPS = 10_000

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_RANGE = re.compile(rf"({_NUMBER}):({_NUMBER}):(\d+)(log|lin)?\Z")
_DIGITS = 6  # of a value within a range


def values_of(given: Any) -> tuple[Any, ...]:
    """Return the values of a list or a range; raise ValueError with the rule otherwise."""
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
        raise ValueError("must have ends above 0 with log")
    return _rounded(np.geomspace(first, last, count))


def _rounded(values: Iterable[float]) -> tuple[float, ...]:
    return tuple(float(f"{value:.{_DIGITS}g}") for value in values)


def groups_of(
    vary: Mapping[str, Any] | Sequence[Mapping[str, Any]],
) -> tuple[list[list[Point]], list[Broken]]:
    """Return the groups to cross, each a list of points, and the broken rules."""
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
                broken.append(((*loc, key), "is varied already", "", "vary it once"))
            seen.add(key)
        lengths = {len(values) for values in columns.values()}
        if len(lengths) > 1:
            counted = ", ".join(f"{key} {len(values)}" for key, values in columns.items())
            rule = "must have the same number of values for each key of a group"
            broken.append((loc, rule, counted, "keys of separate mappings are crossed"))
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
    """Return every point in order, the last group fastest, with its repeat from 1."""
    alternating = order == "alternating"
    row: list[Point] = [{}]
    for group in groups:
        wider: list[Point] = []
        for number, point in enumerate(row):
            # Reverse every other row, so that no step jumps from one end of a range to the other.
            members = reversed(group) if alternating and number % 2 else group
            wider += [{**point, **member} for member in members]
        row = wider
    found: list[tuple[Point, int]] = []
    for number in range(repeat):
        again = reversed(row) if alternating and number % 2 else row
        found += [(point, number + 1) for point in again]
    if order == "random":
        random.Random(seed).shuffle(found)  # noqa: S311  no secret
    return found
