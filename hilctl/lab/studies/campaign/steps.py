"""Campaign file, and its steps in their order, each as settings over the base experiment."""

import json
import math
import random
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import Field

from hilctl.base.axes import axis_documents
from hilctl.base.errors import ConfigError, ConfigProblem, InputError
from hilctl.base.files import TextFiles
from hilctl.base.strict import StrictModel
from hilctl.base.yaml import Document, Loc, dotted, load_document, setting, texts_of
from hilctl.experiment.devices import device_class, known_devices
from hilctl.experiment.file import Name
from hilctl.experiment.load import LoadedExperiment, document_with, named_from, resolve_axes
from hilctl.experiment.sections.conditioning import Condition

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
_DIGITS = 6  # digits of a value within a range


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


_SEEDS = 1_000_000


@dataclass(frozen=True, slots=True)
class CampaignStep:
    """One run of a campaign."""

    number: int  # its position, from 1
    point: Point  # a value for each varied key; empty for a reference run
    repeat: int  # number of the repeat or of the reference run, from 1
    is_reference: bool
    settings: tuple[str, ...]  # ``key=value`` texts over the base experiment

    @property
    def text(self) -> str:
        """Its number and its values."""
        values = ", ".join(f"{key}={cell(value)}" for key, value in self.point.items())
        return f"step {self.number} ({values or f'reference run {self.repeat}'})"


@dataclass(frozen=True, slots=True)
class CampaignSteps:
    """A campaign file with its steps, not checked yet."""

    config: CampaignFile
    document: Document  # the file's YAML with the location of each value
    experiment: Path  # file of the base experiment
    settings: tuple[str, ...]  # ``key=value`` texts over it from outside the campaign file
    keys: tuple[str, ...]  # the varied keys
    steps: tuple[CampaignStep, ...]  # the steps in order

    @contextmanager
    def base_read(self) -> Iterator[None]:
        """Raise ConfigError, located in the campaign file, if the base cannot be read meanwhile."""
        try:
            yield
        except ConfigError:
            raise
        except InputError as error:
            raise ConfigError([self.document.problem("experiment", str(error))]) from None

    def load(self, step: CampaignStep, files: TextFiles) -> tuple[LoadedExperiment, ...]:
        """Return the experiment of each axis of a step; raise InputError if it is not usable."""
        document, settings = load_document(self.experiment, files), self.settings_for(step, files)
        return resolve_axes(document, self.experiment.parent, settings, files)

    def settings_for(self, step: CampaignStep, files: TextFiles) -> list[str]:
        """Return all ``key=value`` texts of a step, outermost last."""
        # Each run of a simulated device gets its own, reproducible noise.
        settings = [*self.settings, *step.settings]
        document = document_with(self.experiment, settings, files)
        own = json.dumps([step.settings, step.repeat, step.is_reference])
        for axis, part in axis_documents(document).items():
            key = f"axes.{axis}.device.seed" if axis else "device.seed"
            kind, first = (part.value(("device", name)) for name in ("kind", "seed"))
            if {"device.seed", key} & {*self.keys} or kind not in known_devices():
                continue
            field = device_class(kind).Options.model_fields.get("seed")
            first = field.default if field and first is None else first
            if field and isinstance(first, int):
                settings.append(f"{key}={first + zlib.crc32(own.encode()) % _SEEDS}")
        return settings


def load_campaign(path: Path, settings: Sequence[str] = ()) -> CampaignSteps:
    """Read a campaign file, with ``key=value`` texts over its base experiment.

    Raise InputError if it cannot be read, ConfigError with all problems if it is invalid.
    """
    return campaign_of(load_document(path), path.parent, settings)


def campaign_of(document: Document, folder: Path, settings: Sequence[str]) -> CampaignSteps:
    """Return a document's campaign, relative to a folder; raise ConfigError with all problems."""
    config = document.validate(CampaignFile)
    groups, broken = groups_of(config.vary)
    keys = tuple(dict.fromkeys(key for group in groups for key in group[0]))
    count = config.repeat * math.prod(map(len, groups))
    if count > MOST_STEPS:
        broken.append(((), f"must make at most {MOST_STEPS} steps", f"{count}", ""))
    problems = [
        ConfigProblem(document.where(("vary", *loc)), dotted(("vary", *loc)), rule, value, hint)
        for loc, rule, value, hint in broken
    ]
    fixed = [*config.set, *(key_of(text) for text in settings)]
    problems += [
        ConfigProblem(
            document.where(locs_of(config, key)[0]), f"vary.{key}", f"is set to one value by {by}"
        )
        for key in keys
        if (by := next((each for each in fixed if f"{each}.".startswith(f"{key}.")), None))
    ]
    if config.condition is not None and "condition" in {key.split(".")[0] for key in keys}:
        problems.append(document.problem("condition", "must not be set, because it is varied"))
    if problems:
        raise ConfigError(problems)
    steps = tuple(_steps(config, points(groups, config.order, config.seed, config.repeat)))
    experiment = folder / config.experiment
    from_here = tuple(named_from(experiment.parent, text) for text in settings)
    return CampaignSteps(config, document, experiment, from_here, keys, steps)


def locs_of(config: CampaignFile, key: str) -> list[Loc]:
    """Return the locations of a varied key in the campaign file."""
    if isinstance(config.vary, Mapping):
        return [("vary", key)]
    return [("vary", number, key) for number, group in enumerate(config.vary) if key in group]


def _steps(config: CampaignFile, found: Sequence[tuple[Point, int]]) -> Iterator[CampaignStep]:
    common = [setting("name", config.name), *texts_of(config.set)]
    if config.condition is not None:
        common.append(setting("condition", config.condition.model_dump(exclude_unset=True)))
    reference = config.reference_run
    runs: list[tuple[Point, int, bool]] = [(point, repeat, False) for point, repeat in found]
    if reference is not None:
        places = [*range(0, len(found), reference.every), len(found)]
        for again, place in reversed(list(enumerate(places, 1))):
            runs.insert(place, ({}, again, True))
    for number, (point, repeat, is_reference) in enumerate(runs, 1):
        own = reference.set if reference and is_reference else point
        yield CampaignStep(number, point, repeat, is_reference, (*common, *texts_of(own)))


def key_of(text: str) -> str:
    """Return the key of a ``key=value`` text."""
    return text.partition("=")[0].strip()


def cell(value: Any) -> Any:
    """Return a value as a table cell: a number or a text."""
    if value is None or isinstance(value, str | int | float):
        return value
    return json.dumps(value, ensure_ascii=False)
