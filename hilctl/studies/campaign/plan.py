"""Every step of a campaign held against device, model and limits, before the first one moves."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from hilctl.base.errors import ConfigError, ConfigProblem, InputError
from hilctl.base.files import TextFiles
from hilctl.base.yaml import Loc
from hilctl.experiment.coil_heat import CoolingCoil, RunHeat
from hilctl.experiment.load import LoadedExperiment
from hilctl.experiment.preflight import check
from hilctl.run.start import RunKey
from hilctl.studies.campaign.steps import CampaignStep, CampaignSteps, base_problem, key_of

_SPARE = 1.2
_MOST_PROBLEMS = 20
_LONG_AFTER_S = 1e12
_NO_HEAT = RunHeat()


@dataclass(frozen=True, slots=True)
class PlannedStep:
    """A step that may be run, or stands already.

    Attributes:
        step: The step.
        loaded: Its experiment.
        settings: All ``key=value`` texts over the base experiment.
        key: What a recording of it says that it is of.
        kept: Its recording, where it stands already.
        heat: What it does to the heat of the coil.
        megabytes: About how large its recording will be.
        heat_a2: Heat of the coil before it, in A^2, where steps and pauses follow each other.
        pause_s: Time for which the coil must cool before it then.
    """

    step: CampaignStep
    loaded: LoadedExperiment
    settings: tuple[str, ...]
    key: RunKey
    kept: Path | None = None
    heat: RunHeat = _NO_HEAT
    megabytes: float = 0.0
    heat_a2: float = 0.0
    pause_s: float = 0.0

    @property
    def seconds(self) -> float:
        """Time that it takes."""
        return self.heat.seconds


@dataclass(frozen=True, slots=True)
class CampaignPlan:
    """What a campaign will do.

    Attributes:
        campaign: The campaign.
        folder: Where its recordings and its table go.
        steps: Its steps in order.
        free_mb: Room on the disk.
    """

    campaign: CampaignSteps
    folder: Path
    steps: tuple[PlannedStep, ...]
    free_mb: float

    @property
    def left(self) -> tuple[PlannedStep, ...]:
        """The steps that are still to be run."""
        return tuple(each for each in self.steps if each.kept is None)

    @property
    def seconds(self) -> float:
        """Rig time that is left, without pauses."""
        return sum(each.seconds for each in self.left)

    @property
    def pauses_s(self) -> float:
        """Time for which the coil must cool, as far as steps that are left ask for it."""
        return sum(each.pause_s for each in self.left)

    @property
    def megabytes(self) -> float:
        """About how large the recordings that are left will be."""
        return sum(each.megabytes for each in self.left)

    def require_room(self) -> None:
        """Refuse what the disk has no room for.

        Raises:
            InputError: It has not.
        """
        if self.free_mb < _SPARE * self.megabytes:
            room = f"{self.megabytes:.0f} MB, and there are {self.free_mb:.0f} MB"
            raise InputError(f"{self.folder}: no room for the recordings: they take {room}")


def planned(
    campaign: CampaignSteps,
    folder: Path,
    standing: Mapping[RunKey, Sequence[Path]],
    heat_a2: float | None = None,
    on_part: Callable[[float], None] = lambda part: None,
) -> CampaignPlan:
    """Check every step that is still to be run, and plan them.

    Args:
        campaign: The campaign.
        folder: Where recordings go.
        standing: Completed recordings that are there, in the order in which they were made.
        heat_a2: Heat of the coil before the first step, in A^2; None where its steps need not
            keep real time, and the kept ones count as well.
        on_part: Called with how much is checked, from 0 to 1.

    Raises:
        ConfigError: One or more steps must not be run; all reasons are listed.
        InputError: The base experiment can't be read.
    """
    files, problems = TextFiles(), _Problems(campaign)
    left = {key: list(paths) for key, paths in standing.items()}
    known: dict[tuple[str, ...], PlannedStep] = {}
    steps: list[PlannedStep] = []
    for number, step in enumerate(campaign.steps):
        on_part(number / len(campaign.steps))
        try:
            each = _loaded(campaign, step, files)
            kept = left.get(each.key)
            each = replace(each, kept=kept.pop(0) if kept else None)
            # What only differs by its noise is checked once; what stands is not checked again.
            if each.kept is None or (heat_a2 is None and _has_budget(each)):
                each = _checked(each, known, folder)
            steps.append(each)
        except ConfigError as error:
            problems.add(step, error.problems)
    problems.refuse()
    around = next(p for p in (folder, *folder.absolute().parents) if p.exists())
    free_mb = shutil.disk_usage(around).free / 1e6
    return CampaignPlan(campaign, folder, _cooling(campaign, steps, heat_a2), free_mb)


def _has_budget(each: PlannedStep) -> bool:
    return each.loaded.config.limits.thermal_time_constant_s is not None


def _loaded(campaign: CampaignSteps, step: CampaignStep, files: TextFiles) -> PlannedStep:
    try:
        settings = tuple(campaign.settings_for(step, files))
        loaded = campaign.load(step, files)
    except ConfigError:
        raise
    except InputError as error:
        raise base_problem(campaign, error) from None
    return PlannedStep(step, loaded, settings, RunKey.of(loaded))


def _checked(
    each: PlannedStep, known: dict[tuple[str, ...], PlannedStep], folder: Path
) -> PlannedStep:
    same = known.get(each.step.settings)
    if same is None:
        # At a far time: what the last run has left is waited for, and no reason to refuse a step.
        forecast = check(each.loaded, now_s=_LONG_AFTER_S).forecast
        same = replace(each, heat=forecast.heat, megabytes=forecast.recording_mb)
        known[each.step.settings] = same
    return replace(each, heat=same.heat, megabytes=same.megabytes)


def _cooling(
    campaign: CampaignSteps, steps: Sequence[PlannedStep], heat_a2: float | None
) -> tuple[PlannedStep, ...]:
    """Return the steps with their pauses, each begun as soon as the coil allows it."""
    to_rms_a = campaign.config.cool_down.to_rms_a or float("inf")
    found: list[PlannedStep] = []
    now_s, heat_now_a2 = 0.0, heat_a2 or 0.0
    for each in steps:
        if heat_a2 is not None and each.kept is not None:
            found.append(each)
            continue
        coil = CoolingCoil(each.loaded.config, heat_now_a2, now_s)
        pause_s = coil.pause_s(each.heat, now_s, to_rms_a)
        found.append(replace(each, pause_s=pause_s, heat_a2=coil.heat_a2(now_s + pause_s)))
        now_s += pause_s + each.seconds
        coil.ran(each.heat, now_s)
        heat_now_a2 = coil.heat_a2(now_s)
    return tuple(found)


class _Problems:
    """Broken rules of many steps: each once, with the place in the campaign's file.

    Args:
        campaign: The campaign.
    """

    def __init__(self, campaign: CampaignSteps) -> None:
        self._campaign = campaign
        self._found: dict[tuple[str, str, str], tuple[ConfigProblem, list[CampaignStep]]] = {}

    def add(self, step: CampaignStep, problems: Sequence[ConfigProblem]) -> None:
        """Take what is wrong with a step."""
        for problem in problems:
            moved = replace(problem, where=self._where(step, problem))
            known = self._found.setdefault((moved.where, moved.key, moved.rule), (moved, []))
            known[1].append(step)

    def refuse(self) -> None:
        """Raise ConfigError where there is any."""
        if self._found:
            raise ConfigError(
                replace(problem, hint="; ".join(filter(None, (problem.hint, self._whom(steps)))))
                for problem, steps in list(self._found.values())[:_MOST_PROBLEMS]
            )

    def _whom(self, steps: Sequence[CampaignStep]) -> str:
        if len(steps) == len(self._campaign.steps):
            return "in every step"
        more = f" and {len(steps) - 1} more" if len(steps) > 1 else ""
        return f"in {steps[0].text}{more}"

    def _where(self, step: CampaignStep, problem: ConfigProblem) -> str:
        """Return where a value stands: one that a step sets, in the campaign's file."""
        if not problem.where.startswith("--set "):
            return problem.where
        key, document = key_of(problem.where.removeprefix("--set ")), self._campaign.document
        vary = self._campaign.config.vary
        places: list[Loc]
        if isinstance(vary, Mapping):
            places = [("vary", key)]
        else:
            places = [("vary", n, key) for n, group in enumerate(vary) if key in group]
        places += [("set", key), ("reference_run", "set", key), (key,)]
        if not step.is_reference:
            places.remove(("reference_run", "set", key))
        return next((document.where(loc) for loc in places if document.holds(loc)), problem.where)
