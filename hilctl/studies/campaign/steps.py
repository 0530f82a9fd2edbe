"""Steps of a campaign in their order, each as settings over the base experiment."""

import json
import math
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hilctl.base.errors import ConfigError, ConfigProblem, InputError
from hilctl.base.files import TextFiles
from hilctl.base.yaml import Document, Loc, dotted, load_document
from hilctl.experiment.devices import device_class, known_devices
from hilctl.experiment.load import LoadedExperiment, named_from, resolve
from hilctl.studies.campaign.file import MOST_STEPS, CampaignFile, Point, groups_of, points
from hilctl.studies.step_runner import document_with, setting

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

    def load(self, step: CampaignStep, files: TextFiles) -> LoadedExperiment:
        """Return the experiment of a step; raise InputError if it can't be read or is invalid."""
        document = load_document(self.experiment, files)
        return resolve(document, self.experiment.parent, self.settings_for(step, files), files)

    def settings_for(self, step: CampaignStep, files: TextFiles) -> list[str]:
        """Return all ``key=value`` texts of a step, outermost last."""
        # Each run of a simulated device gets its own, reproducible noise.
        settings = [*self.settings, *step.settings]
        device = document_with(self.experiment, settings, files).data.get("device")
        kind = device.get("kind") if isinstance(device, dict) else None
        if "device.seed" in self.keys or kind not in known_devices():
            return settings
        field = device_class(str(kind)).Options.model_fields.get("seed")
        first = device.get("seed", field.default) if field and isinstance(device, dict) else None
        if isinstance(first, int):
            own = json.dumps([step.settings, step.repeat, step.is_reference])
            settings.append(f"device.seed={first + zlib.crc32(own.encode()) % _SEEDS}")
        return settings


def load_campaign(path: Path, settings: Sequence[str] = ()) -> CampaignSteps:
    """Read a campaign file, with ``key=value`` texts over its base experiment.

    Raises:
        InputError: It can't be read.
        ConfigError: The file is invalid; all problems are listed.
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
        where = document.where(("condition",))
        problems.append(ConfigProblem(where, "condition", "must not be set, because it is varied"))
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
    common = [setting("name", config.name), *settings_of(config.set)]
    if config.condition is not None:
        common.append(setting("condition", config.condition.model_dump(exclude_unset=True)))
    reference = config.reference_run
    number = again = 0
    for place, (point, repeat) in enumerate(found):
        if reference is not None and place % reference.every == 0:
            number, again = number + 1, again + 1
            yield _reference(number, again, common, reference.set)
        number += 1
        yield CampaignStep(number, point, repeat, False, (*common, *settings_of(point)))
    if reference is not None:
        yield _reference(number + 1, again + 1, common, reference.set)


def _reference(
    number: int, again: int, common: list[str], given: Mapping[str, Any]
) -> CampaignStep:
    return CampaignStep(number, {}, again, True, (*common, *settings_of(given)))


def settings_of(given: Mapping[str, Any]) -> list[str]:
    """Return keys and values as ``key=value`` texts."""
    return [setting(key, value) for key, value in given.items()]


def key_of(text: str) -> str:
    """Return the key of a ``key=value`` text."""
    return text.partition("=")[0].strip()


def cell(value: Any) -> Any:
    """Return a value as a table cell: a number or a text."""
    if value is None or isinstance(value, str | int | float):
        return value
    return json.dumps(value, ensure_ascii=False)


def base_problem(campaign: CampaignSteps, error: InputError) -> ConfigError:
    """Return the error for a base experiment that can't be read."""
    where = campaign.document.where(("experiment",))
    return ConfigError([ConfigProblem(where, "experiment", str(error))])
