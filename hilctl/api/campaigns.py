"""Calibration, and repeated runs: characterisation, coupling, campaigns, iterative learning."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from datetime import UTC, datetime
from pathlib import Path

from hilctl.api._types import PathLike, experiment_path, path_or_none, runs_folder
from hilctl.base.axes import axis_documents
from hilctl.base.errors import InputError
from hilctl.base.files import check_no_input, check_writable, is_folder, write_text
from hilctl.base.table import Column
from hilctl.base.yaml import Settings, texts_of
from hilctl.experiment.load import document_with, inputs_of
from hilctl.experiment.sections.correction import write_correction
from hilctl.experiment.sections.coupling import Coupling, write_coupling
from hilctl.lab.studies.calibrate import (
    CalibrationFit,
    Origin,
    existing_calibration,
    fit_sensor,
    measure_amplifier,
    sensor_points,
    write_calibration,
)
from hilctl.lab.studies.campaign.campaign_runner import (
    CampaignResult,
    planned_fast,
    planned_in_real_time,
    run_fast,
    run_series,
)
from hilctl.lab.studies.campaign.plan import CampaignPlan
from hilctl.lab.studies.campaign.steps import CampaignStep, CampaignSteps, load_campaign
from hilctl.lab.studies.campaign.store import CampaignRow, campaign_folder
from hilctl.lab.studies.characterise.characterisation_runner import (
    CharacterisationPlan,
    CharacterisationRunner,
)
from hilctl.lab.studies.characterise.results import Characterisation, StepRow
from hilctl.lab.studies.characterise.rig_page import characterisation_page
from hilctl.lab.studies.couple import CouplingStudy
from hilctl.lab.studies.learn import IlcResult, IlcRow, IlcSession
from hilctl.lab.studies.study import StudyHost, run_study
from hilctl.lab.studies.study_folder import prepared
from hilctl.recording.run_summary import recordings_in
from hilctl.run.control.client import finish_dead_runs
from hilctl.run.result import recordings_of


def _nothing(*_ignored: object) -> None:
    pass


def calibrate_sensor(
    table: PathLike,
    output: PathLike,
    *,
    by: str,
    reference: str,
    reading_column: Column | None = None,
    true_column: Column | None = None,
    overwrite: bool = False,
) -> CalibrationFit:
    """Fit the curve of a sensor to pairs of reading and true displacement, and write it.

    Args:
        table: Table of any kind that ``identify`` reads; lengths without a unit are in um.
        output: Calibration file to write; its calibration of an amplifier is kept.
        by: Operator.
        reference: Reference instrument.
        reading_column: Column of the readings without calibration: name, or number from 1; None if
            a name in the table has one of the words reading, sensor, indicated.
        true_column: Column of the true displacements; None if a name has one of the words true,
            reference, actual.
        overwrite: Replace the calibration of a sensor in the file.

    Raises:
        InputError: The table is invalid, points are outliers, or the file cannot be written.
    """
    file, origin = Path(output), Origin(datetime.now(UTC).date(), by, reference)
    before = existing_calibration(file, "sensor", overwrite=overwrite)
    points = sensor_points(Path(table), reading_column, true_column)
    found = fit_sensor(points, origin)
    write_calibration(file, found.fitted, before)
    return found


def calibrate_amplifier(
    experiment: PathLike,
    output: PathLike,
    *,
    by: str,
    reference: str = "device.measure",
    settings: Settings = (),
    fast: bool = False,
    overwrite: bool = False,
    on_progress: Callable[[float, str], None] = _nothing,
) -> CalibrationFit:
    """Step the command within a tenth of its limits, read it back, fit gain and offset.

    Args:
        experiment: Experiment file with device and limits.
        output: Calibration file to write; its calibration of a sensor is kept. The recording is
            a new file beside it, ``OUTPUT-run.mcap``.
        by: Operator.
        reference: Instrument that reads the command back.
        settings: Overrides of the experiment.
        fast: Simulate without waiting; simulated devices only.
        overwrite: Replace the calibration of an amplifier in the file.
        on_progress: Called with the fraction done (0 to 1) and the current step.

    Raises:
        InputError: An input is invalid, or a file cannot be written; nothing has moved.
        RunError: The run ended early.
    """
    path, texts, file = experiment_path(experiment), texts_of(settings), Path(output)
    origin = Origin(datetime.now(UTC).date(), by, reference)
    before = existing_calibration(file, "amplifier", overwrite=overwrite)
    finish_dead_runs()
    measured = measure_amplifier(path, texts, f"{file.stem}-run", origin)
    host = StudyHost.of(fast=fast, on_progress=on_progress)
    found = run_study(measured, file.parent, host, resume=False)
    write_calibration(file, found.fitted, before)
    return found


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
    on_plan: Callable[[CharacterisationPlan], None] = _nothing,
    on_step: Callable[[StepRow], None] = _nothing,
) -> Characterisation | None:
    """Measure a connected actuator within its limits, then identify and validate a model.

    A stopped characterisation resumes at the step where it stopped.

    Args:
        experiment: Experiment file with device and limits.
        output: Model file to write; its HTML page has the same name.
        folder: Folder for the recordings; default: ``OUTPUT-runs``.
        settings: Overrides of the experiment.
        highest_hz: Highest frequency of loops; default: from the sample rate.
        fast: Simulate without waiting; simulated devices only.
        overwrite: Discard earlier runs and start again.
        dry_run: Plan only; nothing moves, and nothing is written.
        on_progress: Called with the fraction done (0 to 1) and the current step.
        on_plan: Called with the plan before anything moves.
        on_step: Called with each completed step.

    Returns:
        The result; None for a dry run.

    Raises:
        InputError: An input is invalid, or a file cannot be written; nothing has moved.
        RunError: A step ended by a fault; earlier steps are kept.
    """
    file, chosen = Path(output), runs_folder(output, folder)
    page = file.with_suffix(".html")
    if page == file:
        raise InputError(f"{file}: is the name of the page: choose another output, such as .yaml")
    host = StudyHost.of(fast=fast, on_progress=on_progress, on_step=on_step)
    measured = CharacterisationRunner(
        experiment_path(experiment), texts_of(settings), chosen, highest_hz, host
    )
    if not dry_run:
        inputs = inputs_of(experiment_path(experiment), texts_of(settings))
        check_writable(file, overwrite=overwrite, inputs=inputs)
        again = overwrite or bool(recordings_in(chosen))
        check_writable(page, overwrite=again, inputs=inputs)
        for path in recordings_in(chosen):
            check_no_input(path, inputs)
        finish_dead_runs()
    on_plan(measured.plan)
    if dry_run:
        return None
    with prepared(chosen, host.sleep_s, host.on_note):
        if overwrite:
            measured.discard()
        found = measured.characterise(file, overwrite=overwrite)
        write_text(page, characterisation_page(found), overwrite=True)
    return found


def couple(
    experiment: PathLike,
    output: PathLike,
    *,
    folder: PathLike | None = None,
    settings: Settings = (),
    highest_hz: float | None = None,
    fast: bool = False,
    overwrite: bool = False,
    on_progress: Callable[[float, str], None] = _nothing,
) -> Coupling:
    """Identify the crosstalk between the axes of a stage, and verify its removal.

    Each axis moves in turn while the others hold, then again with the coupling in use. A stopped
    call resumes at the run where it stopped.

    Args:
        experiment: Experiment file with at least two axes, each with a compensator.
        output: Coupling file to write.
        folder: Folder for the recordings; default: ``OUTPUT-runs``.
        settings: Overrides of the experiment.
        highest_hz: Highest frequency of the motion; default: from the models and the sample rate.
        fast: Simulate without waiting; simulated devices only.
        overwrite: Discard earlier runs, and replace the file.
        on_progress: Called with the fraction done (0 to 1) and the current step.

    Raises:
        InputError: An input is invalid, or a file cannot be written; nothing has moved.
        RunError: A run ended by a fault, or a crosstalk is not a linear response.
    """
    file, chosen = Path(output), runs_folder(output, folder)
    inputs = inputs_of(experiment_path(experiment), texts_of(settings))
    check_writable(file, overwrite=overwrite, inputs=inputs)
    for path in recordings_in(chosen):
        check_no_input(path, inputs)
    finish_dead_runs()
    coupled = CouplingStudy(experiment_path(experiment), texts_of(settings), chosen, highest_hz)
    host = StudyHost.of(fast=fast, on_progress=on_progress)
    with prepared(chosen, host.sleep_s, host.on_note):
        found = run_study(
            coupled.study(), chosen, host, resume=not overwrite, total_s=coupled.seconds
        )
        write_coupling(file, found, overwrite=overwrite)
    return found


def campaign(
    file: PathLike | CampaignSteps,
    folder: PathLike | None = None,
    *,
    settings: Settings = (),
    fast: bool = False,
    scheduler: str = "none",
    dry_run: bool = False,
    on_progress: Callable[[float, str], None] = _nothing,
    on_plan: Callable[[CampaignPlan], None] = _nothing,
    on_row: Callable[[CampaignStep, CampaignRow], None] = _nothing,
    on_note: Callable[[str], None] = _nothing,
) -> CampaignResult | None:
    """Run an experiment with each combination of varied keys; a stopped campaign resumes.

    Args:
        file: Campaign file (YAML), or its steps.
        folder: Folder for recordings, table and page; default: named after the campaign.
        settings: Overrides of the experiment of every step.
        fast: Simulate without waiting; simulated devices only.
        scheduler: With ``fast``: ``none``, ``processes``, or a Dask scheduler address.
        dry_run: Plan only; nothing moves, and nothing is written.
        on_progress: Called with the fraction done (0 to 1) and the current step.
        on_plan: Called with the plan before anything moves.
        on_row: Called with each completed step and its result.
        on_note: Called with a note on each repaired recording.

    Returns:
        The result; None for a dry run.

    Raises:
        InputError: An input is invalid; nothing has moved.
        RunError: A hazard to device or rig ended the campaign; completed steps are kept.
    """
    steps = file
    if not isinstance(steps, CampaignSteps):
        steps = load_campaign(Path(steps), texts_of(settings))
    if scheduler != "none" and not fast:
        raise InputError("scheduler needs fast: runs in real time are sequential")
    host = StudyHost.of(fast=fast, on_progress=on_progress, on_step=on_row, on_note=on_note)
    chosen = path_or_none(folder) or campaign_folder(steps)
    with nullcontext() if dry_run else prepared(chosen, host.sleep_s, host.on_note):
        host.on_progress(0.0, "check every step")
        if fast:
            plan = planned_fast(steps, chosen)
        else:
            plan = planned_in_real_time(steps, chosen, host.now())
        inputs = inputs_of(steps.experiment, steps.settings)
        for suffix in (".csv", ".parquet", ".html"):
            check_no_input(chosen / f"{steps.config.name}{suffix}", inputs)
        on_plan(plan)
        if dry_run:
            return None
        return run_fast(plan, host, scheduler) if fast else run_series(plan, host)


def learn(
    experiment: PathLike,
    output: PathLike,
    *,
    cycles: int = 20,
    folder: PathLike | None = None,
    settings: Settings = (),
    fast: bool = False,
    overwrite: bool = False,
    on_rows: Callable[[Sequence[IlcRow]], None] = lambda rows: None,
) -> IlcResult:
    """Learn a correction for a periodic reference: run, correct, and run again.

    Args:
        experiment: Experiment file (YAML).
        output: Correction file to write; with several axes ``OUTPUT.AXIS.yaml`` for each one.
        cycles: Largest number of runs after the first.
        folder: Folder for the recordings; default: ``OUTPUT-runs``.
        settings: Overrides of the experiment.
        fast: Simulate without waiting; simulated devices only.
        overwrite: Replace existing files.
        on_rows: Called with the metrics of each run.

    Raises:
        InputError: An input is invalid, or a file cannot be written; nothing has moved.
    """
    chosen = runs_folder(output, folder)
    path, given = experiment_path(experiment), texts_of(settings)
    inputs = inputs_of(path, given)
    axes = axis_documents(document_with(path, given))
    files = recordings_of([*axes], Path(output))
    for file in files.values():
        check_writable(file, overwrite=overwrite, inputs=inputs)
    runs = [*chosen.glob("run-*.*")] if is_folder(chosen) else []
    for path in runs:
        check_no_input(path, inputs)
    if not overwrite and any(path.suffix == ".mcap" for path in runs):
        raise InputError(f"{chosen}: contains runs: choose another folder, or overwrite")
    session = IlcSession(path, given, chosen)
    host = StudyHost.of(fast=fast)
    with prepared(chosen, host.sleep_s, host.on_note):
        learned = run_study(session.study(cycles, on_rows), chosen, host, resume=False)
        for axis, correction in learned.corrections.items():
            write_correction(files[axis], correction, overwrite=overwrite)
    return learned
