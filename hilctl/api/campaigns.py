"""Run an experiment repeatedly: characterisation, campaigns, iterative learning."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

from hilctl.api.given import PathLike, Settings, path_or_none, runs_folder, texts_of
from hilctl.base.errors import InputError
from hilctl.base.files import check_no_input, check_writable
from hilctl.experiment.correction import write_correction
from hilctl.experiment.load import inputs_of
from hilctl.ilc.ilc_session import IlcSession
from hilctl.ilc.results import IlcResult, IlcRow
from hilctl.recording.run_summary import recordings_in
from hilctl.run.control.client import finish_dead_runs
from hilctl.run.start import paced, unpaced
from hilctl.studies.campaign.campaign_runner import (
    CampaignHost,
    CampaignResult,
    planned_in_real_time,
    prepared,
    run_series,
)
from hilctl.studies.campaign.parallel_simulation import planned_fast, run_fast
from hilctl.studies.campaign.plan import CampaignPlan
from hilctl.studies.campaign.steps import CampaignStep, CampaignSteps, load_campaign
from hilctl.studies.campaign.store import campaign_folder
from hilctl.studies.campaign.table import CampaignRow
from hilctl.studies.characterise.characterisation_runner import (
    CharacterisationHost,
    CharacterisationPlan,
    CharacterisationRunner,
)
from hilctl.studies.characterise.results import Characterisation, StepRow
from hilctl.studies.characterise.rig_page import write_characterisation


def _nothing(*_ignored: object) -> None:
    pass


def characterise(
    experiment: PathLike,
    output: PathLike,
    *,
    folder: PathLike | None = None,
    settings: Settings = (),
    highest_hz: float | None = None,
    fast: bool = False,
    overwrite: bool = False,
    dry_run: bool = False,
    on_progress: Callable[[float, str], None] = _nothing,
    on_plan: "Callable[[CharacterisationPlan], None]" = _nothing,
    on_step: "Callable[[StepRow], None]" = _nothing,
) -> "Characterisation | None":
    """Find a model of a wired actuator: measure within its limits, identify, judge.

    It goes on where it was stopped.

    Args:
        experiment: Experiment file that gives device and limits.
        output: Model file to write; a page of the same name, .html, is written beside it.
        folder: Where each run is kept; ``OUTPUT-runs`` where None.
        settings: Over the experiment.
        highest_hz: Highest frequency of loops; from the sample rate where None.
        fast: Do not wait for real time; simulated devices only.
        overwrite: Whether to begin anew where runs stand.
        dry_run: Only work out what it would do: nothing moves, and nothing is written.
        on_progress: Called with how much is done, from 0 to 1, and what is being done.
        on_plan: Called with what it will do, before anything moves.
        on_step: Called with each step that is done.

    Returns:
        What was found; None of a dry run.

    Raises:
        InputError: Something can't be used or written; nothing has moved.
        RunError: A step ended by a fault; those before it stand.
    """
    file, chosen = Path(output), runs_folder(output, folder)
    page = file.with_suffix(".html")
    if page == file:
        raise InputError(f"{file}: is the name of the page: give the model another one, .yaml")
    host = CharacterisationHost(
        run=unpaced if fast else paced, on_progress=on_progress, on_step=on_step
    )
    measured = CharacterisationRunner(
        Path(experiment), texts_of(settings), chosen, highest_hz, host
    )
    if not dry_run:
        inputs = inputs_of(Path(experiment), texts_of(settings))
        check_writable(file, overwrite=overwrite, inputs=inputs)
        again = overwrite or bool(recordings_in(chosen))
        check_writable(page, overwrite=again, inputs=inputs)
        for path in recordings_in(chosen):
            check_no_input(path, inputs)
        finish_dead_runs()
    on_plan(measured.plan)
    if dry_run:
        return None
    if overwrite:
        measured.discard()
    found = measured.characterise(file, overwrite=overwrite)

    write_characterisation(found, page)
    return found


def campaign(
    file: PathLike,
    folder: PathLike | None = None,
    *,
    settings: Settings = (),
    fast: bool = False,
    scheduler: str = "none",
    dry_run: bool = False,
    on_progress: Callable[[float, str], None] = _nothing,
    on_plan: "Callable[[CampaignPlan], None]" = _nothing,
    on_row: "Callable[[CampaignStep, CampaignRow], None]" = _nothing,
    on_note: Callable[[str], None] = _nothing,
) -> "CampaignResult | None":
    """Run an experiment again and again with other values of its keys; goes on where it was.

    Args:
        file: Campaign file (YAML).
        folder: Where recordings, table and page go; one named after the campaign where None.
        settings: Over the experiment of every step.
        fast: Do not wait for real time; simulated devices only.
        scheduler: With ``fast``, where steps run: ``none``, ``processes``, or a Dask address.
        dry_run: Only work out what it would do: nothing moves, and nothing is written.
        on_progress: Called with how much is done, from 0 to 1, and what is being done.
        on_plan: Called with what it will do, before anything moves.
        on_row: Called with each step that is done, and what became of it.
        on_note: Called with what was done for runs that were cut short.

    Returns:
        What came of it; None of a dry run.

    Raises:
        InputError: Something can't be used; nothing has moved.
        RunError: A danger to device or rig ended it; what stands is kept.
    """
    host = replace(CampaignHost(), on_progress=on_progress, on_row=on_row, on_note=on_note)
    steps = load_campaign(Path(file), texts_of(settings))
    return run_steps(
        steps, path_or_none(folder), host,
        fast=fast, scheduler=scheduler, dry_run=dry_run, on_plan=on_plan,
    )  # fmt: skip


def learn(
    experiment: PathLike,
    output: PathLike,
    *,
    cycles: int = 20,
    folder: PathLike | None = None,
    settings: Settings = (),
    fast: bool = False,
    overwrite: bool = False,
    on_rows: "Callable[[Sequence[IlcRow]], None]" = lambda rows: None,
) -> "IlcResult":
    """Learn a correction for a reference that repeats: run, correct, and run again.

    Args:
        experiment: Experiment file (YAML).
        output: Correction file to write.
        cycles: Most runs after the first.
        folder: Where each run is kept; ``OUTPUT-runs`` where None.
        settings: Over the experiment.
        fast: Do not wait for real time; simulated devices only.
        overwrite: Whether files of these names may be replaced.
        on_rows: Called with the figures of each run.

    Raises:
        InputError: Something can't be used or written; nothing has moved.
    """
    file, chosen = Path(output), runs_folder(output, folder)
    inputs = inputs_of(Path(experiment), texts_of(settings))
    check_writable(file, overwrite=overwrite, inputs=inputs)
    for path in chosen.glob("run-*.*"):
        check_no_input(path, inputs)
    if not overwrite and any(chosen.glob("run-*.mcap")):
        raise InputError(f"{chosen}: holds runs already: give another --folder, or --overwrite")
    session = IlcSession(Path(experiment), texts_of(settings), chosen, unpaced if fast else paced)
    learned = session.learn(cycles, on_rows)
    write_correction(file, learned.correction, overwrite=overwrite)
    return learned


def run_steps(
    steps: "CampaignSteps",
    folder: Path | None,
    host: "CampaignHost",
    *,
    fast: bool,
    scheduler: str,
    dry_run: bool,
    on_plan: "Callable[[CampaignPlan], None]",
) -> "CampaignResult | None":
    """Run the steps of a campaign, wherever they come from; see :func:`campaign`."""
    if scheduler != "none" and not fast:
        rule = "for fast runs only; those that keep real time follow each other"
        raise InputError(f"scheduler: {rule}")
    chosen = folder or campaign_folder(steps)
    with nullcontext() if dry_run else prepared(chosen, host):
        plan = _plan(steps, chosen, host, fast=fast)
        inputs = inputs_of(steps.experiment, steps.settings)
        for suffix in (".csv", ".parquet", ".html"):
            check_no_input(chosen / f"{steps.config.name}{suffix}", inputs)
        on_plan(plan)
        if dry_run:
            return None
        return run_fast(plan, host, scheduler) if fast else run_series(plan, host)


def _plan(
    steps: "CampaignSteps", folder: Path, host: "CampaignHost", *, fast: bool
) -> "CampaignPlan":

    host.on_progress(0.0, "check every step")
    if fast:
        return planned_fast(steps, folder)
    return planned_in_real_time(steps, folder, host.now_s())
