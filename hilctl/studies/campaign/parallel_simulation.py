"""Campaign of simulated runs without real time, in parallel processes or on a Dask cluster.

A worker receives the checked texts and returns the recording as bytes, so it does not need access
to the campaign's folder. The coil starts each run with the heat that it would have if the steps and
their pauses followed each other.
"""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from hilctl.base.errors import HilctlError, InputError
from hilctl.base.files import TextFiles, write_file
from hilctl.base.yaml import Document
from hilctl.experiment.load import resolve
from hilctl.experiment.preflight import check
from hilctl.identify.parallel import workers
from hilctl.recording.reader import read
from hilctl.run.unpaced import run_unpaced
from hilctl.studies.campaign.campaign_runner import (
    Campaign,
    CampaignResult,
    is_harmless,
)
from hilctl.studies.campaign.plan import CampaignPlan, PlannedStep, planned
from hilctl.studies.campaign.steps import CampaignSteps
from hilctl.studies.campaign.store import completed_runs, new_recording
from hilctl.studies.campaign.table import CampaignRow
from hilctl.studies.multi_run.collect import COMPLETED
from hilctl.studies.multi_run.digest import RunDigest, RunFigures, digest_of
from hilctl.studies.step_runner import StudyHost


@dataclass(frozen=True, slots=True)
class FastTask:
    """Input of one run."""

    experiment: str  # the experiment as YAML
    files: Mapping[str, str]  # texts of the files it uses, by absolute path
    folder: str  # folder that its file names are relative to
    heat_a2: float  # heat of the coil before it, in A^2


@dataclass(frozen=True, slots=True)
class FastRun:
    """Outcome of one run."""

    recording: bytes  # its recording as bytes; empty if it was refused
    code: str  # ``completed``, ``fault`` or ``refused``
    reason: str
    harmless: bool  # whether the next step may run
    digest: RunDigest | None = None  # data of its recording; None if it was not completed


def run_task(task: FastTask) -> FastRun:
    """Run one step on a worker."""
    document = Document("experiment", task.experiment)
    loaded = resolve(document, Path(task.folder), files=TextFiles(task.files))
    with tempfile.TemporaryDirectory(prefix="hilctl-campaign-") as folder:
        output = Path(folder) / "run.mcap"
        try:
            result = run_unpaced(check(loaded, task.heat_a2), output)
        except HilctlError as error:
            return FastRun(b"", "refused", str(error), harmless=True)
        content, recording = output.read_bytes(), read(output)
        harmless = result.code == COMPLETED or is_harmless(result)
        digest = digest_of(recording) if result.code == COMPLETED else None
        return FastRun(content, result.code, result.reason, harmless, digest)


def planned_fast(campaign: CampaignSteps, folder: Path) -> CampaignPlan:
    """Return the plan of a campaign without real time; raise InputError for a real device."""
    plan = planned(campaign, folder, completed_runs(folder) if folder.is_dir() else {})
    for each in plan.steps:
        info = each.loaded.device.info
        if not info.simulated:
            rule = "only simulated devices run without real time"
            raise InputError(f"--fast: {each.step.text}: {info.name}: {rule}")
    return plan


def run_fast(plan: CampaignPlan, host: StudyHost, scheduler: str = "none") -> CampaignResult:
    """Run the remaining steps as fast as possible; raise InputError if the disk has no space."""
    plan.require_room()
    left = plan.left
    with workers(scheduler) as run:
        state = Campaign(plan, host)
        state.keep()
        runs = run(run_task, [_task(each) for each in left])
        for number, (each, fast) in enumerate(zip(left, runs, strict=True), 1):
            _take(state, each, fast)
            host.on_progress(number / len(left), f"{len(left) - number} of {len(left)} runs left")
            if not fast.harmless:
                return state.result(f"{each.step.text}: {fast.reason}")
    return state.result()


def _task(each: PlannedStep) -> FastTask:
    loaded = each.loaded
    folder = str(loaded.folder.resolve())
    return FastTask(loaded.yaml_text, dict(loaded.files.texts), folder, each.heat_a2)


def _take(state: Campaign, each: PlannedStep, run: FastRun) -> None:
    name = state.plan.campaign.config.name
    if not run.recording:
        state.add(each, CampaignRow(f"refused: {run.reason}", code="refused"))
        return
    path = new_recording(state.plan.folder, name, each.step.number)
    write_file(path, lambda stream: stream.write(run.recording), overwrite=False)
    result = COMPLETED if run.code == COMPLETED else f"{run.code}: {run.reason}"
    figures = run.digest.figures if run.digest else RunFigures()
    state.add(each, CampaignRow(result, figures, path.name, run.code, digest=run.digest))
