"""Plan of a campaign: every step is checked against device, model and limits in advance."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from hilctl.base.errors import ConfigError, ConfigProblem
from hilctl.base.files import TextFiles
from hilctl.experiment.coil_heat import CoolingCoil, RunHeat, of_hottest
from hilctl.experiment.load import LoadedExperiment
from hilctl.experiment.preflight import check_axes
from hilctl.experiment.rig import RunRig
from hilctl.lab.studies.campaign.steps import CampaignStep, CampaignSteps, key_of, locs_of
from hilctl.lab.studies.study import free_mb
from hilctl.run.start import RunKey

_MOST_PROBLEMS = 20
_NO_HEAT = RunHeat()


@dataclass(frozen=True, slots=True)
class PlannedStep:
    """A step to run, or done already."""

    step: CampaignStep
    loaded: tuple[LoadedExperiment, ...]  # of each axis
    settings: tuple[str, ...]  # all ``key=value`` texts over the base experiment
    keys: tuple[RunKey, ...]  # fingerprint of each axis' experiment in a recording
    kept: Path | None = None  # recording of its first axis, if it is done already
    heat: RunHeat = _NO_HEAT  # heat of its current in the hottest coil
    megabytes: float = 0.0  # approximate size of its recording
    heat_a2: float = 0.0  # heat of the coil before it, in A^2, if no step is interrupted
    pause_s: float = 0.0  # time for the coil to cool before it

    @property
    def seconds(self) -> float:
        """Duration of the run."""
        return self.heat.seconds

    @property
    def has_budget(self) -> bool:
        """Whether a coil has a thermal budget."""
        return self.slowest_coil.interlocks.thermal_time_constant_s is not None

    @property
    def slowest_coil(self) -> RunRig:
        """The axis whose coil cools slowest."""
        rigs = [each.rig for each in self.loaded]
        return max(rigs, key=lambda rig: rig.interlocks.thermal_time_constant_s or 0.0)


@dataclass(frozen=True, slots=True)
class CampaignPlan:
    """Plan of a campaign, with its steps in order and the free disk space."""

    campaign: CampaignSteps
    folder: Path
    steps: tuple[PlannedStep, ...]
    free_mb: float

    @property
    def left(self) -> tuple[PlannedStep, ...]:
        """The remaining steps."""
        return tuple(each for each in self.steps if each.kept is None)

    @property
    def seconds(self) -> float:
        """Rig time of the remaining steps, without pauses."""
        return sum(each.seconds for each in self.left)

    @property
    def pauses_s(self) -> float:
        """Time for the coil to cool before the remaining steps."""
        return sum(each.pause_s for each in self.left)

    @property
    def megabytes(self) -> float:
        """Approximate size of the remaining recordings."""
        return sum(each.megabytes for each in self.left)


def planned(
    campaign: CampaignSteps,
    folder: Path,
    completed: Mapping[tuple[RunKey, ...], Sequence[tuple[Path, ...]]],
    heat_a2: float | None = None,
) -> CampaignPlan:
    """Check and plan the remaining steps; raise ConfigError with all problems.

    ``heat_a2`` is the heat of the coil before the first step, in A^2; None for steps without real
    time, where kept steps heat the coil as well.
    """
    files = TextFiles()
    failed: list[tuple[CampaignStep, ConfigProblem]] = []
    left = {key: list(paths) for key, paths in completed.items()}
    known: dict[tuple[str, ...], PlannedStep] = {}
    steps: list[PlannedStep] = []
    for step in campaign.steps:
        try:
            each = _loaded(campaign, step, files)
            kept = left.get(each.keys)
            each = replace(each, kept=kept.pop(0)[0] if kept else None)
            # Steps that differ in noise only are checked once; kept steps are not checked again.
            if each.kept is None or (heat_a2 is None and each.has_budget):
                each = _checked(each, known)
            steps.append(each)
        except ConfigError as error:
            failed += [(step, problem) for problem in error.problems]
    _refuse(campaign, failed)
    return CampaignPlan(campaign, folder, _cooling(campaign, steps, heat_a2), free_mb(folder))


def _loaded(campaign: CampaignSteps, step: CampaignStep, files: TextFiles) -> PlannedStep:
    with campaign.base_read():
        settings = tuple(campaign.settings_for(step, files))
        loaded = campaign.load(step, files)
    return PlannedStep(step, loaded, settings, tuple(map(RunKey.of, loaded)))


def _checked(each: PlannedStep, known: dict[tuple[str, ...], PlannedStep]) -> PlannedStep:
    same = known.get(each.step.settings)
    if same is None:
        # Cooled down: heat of the last run causes a pause, not an error.
        forecasts = [axis.forecast for axis in check_axes(each.loaded, heat_a2=None).axes]
        heat = of_hottest([forecast.heat for forecast in forecasts])
        megabytes = sum(forecast.recording_mb for forecast in forecasts)
        same = replace(each, heat=heat, megabytes=megabytes)
        known[each.step.settings] = same
    return replace(each, heat=same.heat, megabytes=same.megabytes)


def _cooling(
    campaign: CampaignSteps, steps: Sequence[PlannedStep], heat_a2: float | None
) -> tuple[PlannedStep, ...]:
    """Return the steps with their pauses, each started as soon as the coil allows."""
    to_rms_a = campaign.config.cool_down.to_rms_a or float("inf")
    found: list[PlannedStep] = []
    now_s, heat_now_a2 = 0.0, heat_a2 or 0.0
    for each in steps:
        if heat_a2 is not None and each.kept is not None:
            found.append(each)
            continue
        coil = CoolingCoil(each.slowest_coil, heat_now_a2, now_s)
        pause_s = coil.pause_s(each.heat, now_s, to_rms_a)
        found.append(replace(each, pause_s=pause_s, heat_a2=coil.heat_a2(now_s + pause_s)))
        now_s += pause_s + each.seconds
        coil.ran(each.heat, now_s)
        heat_now_a2 = coil.heat_a2(now_s)
    return tuple(found)


def _refuse(campaign: CampaignSteps, failed: Sequence[tuple[CampaignStep, ConfigProblem]]) -> None:
    """Raise ConfigError if steps failed, with each problem once, located in the campaign file."""
    found: dict[tuple[str, str, str], tuple[ConfigProblem, list[CampaignStep]]] = {}
    for step, problem in failed:
        moved = replace(problem, where=_where(campaign, step, problem))
        found.setdefault((moved.where, moved.key, moved.rule), (moved, []))[1].append(step)
    problems = []
    for problem, steps in list(found.values())[:_MOST_PROBLEMS]:
        more = f" and {len(steps) - 1} more" if len(steps) > 1 else ""
        every = len(steps) == len(campaign.steps)
        whom = "in every step" if every else f"in {steps[0].text}{more}"
        problems.append(replace(problem, hint="; ".join(filter(None, (problem.hint, whom)))))
    if problems:
        raise ConfigError(problems)


def _where(campaign: CampaignSteps, step: CampaignStep, problem: ConfigProblem) -> str:
    """Return the location of a value; values of a step are in the campaign file."""
    if not problem.where.startswith("setting "):
        return problem.where
    key, document = key_of(problem.where.removeprefix("setting ")), campaign.document
    places = [*locs_of(campaign.config, key), ("set", key), (key,)]
    if step.is_reference:
        places.insert(-1, ("reference_run", "set", key))
    return next((document.where(loc) for loc in places if document.holds(loc)), problem.where)
