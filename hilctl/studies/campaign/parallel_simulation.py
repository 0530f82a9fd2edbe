"""Campaign of simulated runs without real time, in parallel processes or on a Dask cluster.

A worker receives the checked texts and returns the recording as bytes, so it does not need access
to the campaign's folder. The coil starts each run with the heat that it would have if the steps and
their pauses followed each other.
"""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
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
    measured,
)
from hilctl.studies.campaign.plan import CampaignPlan, PlannedStep, planned
from hilctl.studies.campaign.steps import CampaignSteps
from hilctl.studies.campaign.store import completed_runs, new_recording
from hilctl.studies.campaign.table import CampaignRow
from hilctl.studies.multi_run.collect import COMPLETED
from hilctl.studies.step_runner import StudyHost, require_room


@dataclass(frozen=True, slots=True)
class FastTask:
    """Input of one run."""

    experiment: str  # the experiment as YAML
    files: Mapping[str, str]  # texts of the files it uses, by absolute path
    folder: str  # folder that its file names are relative to
    heat_a2: float  # heat of the coil before it, in A^2


def run_task(task: FastTask) -> tuple[bytes, CampaignRow, bool]:
    """Run one step on a worker.

    Return its recording, which is empty if it was refused, its row, and whether the next step may
    run.
    """
    document = Document("experiment", task.experiment)
    loaded = resolve(document, Path(task.folder), files=TextFiles(task.files))
    with tempfile.TemporaryDirectory(prefix="hilctl-campaign-") as folder:
        output = Path(folder) / "run.mcap"
        try:
            result = run_unpaced(check(loaded, task.heat_a2), output)
        except HilctlError as error:
            return b"", CampaignRow(f"refused: {error}", code="refused"), True
        content = output.read_bytes()
        if result.code == COMPLETED:
            return content, measured(read(output)), True
        row = CampaignRow(f"{result.code}: {result.reason}", code=result.code)
        return content, row, is_harmless(result)


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
    require_room(plan.folder, plan.megabytes, plan.free_mb)
    left = plan.left
    with workers(scheduler) as run:
        state = Campaign(plan, host)
        state.keep()
        runs = run(run_task, [_task(each) for each in left])
        for number, (each, (content, row, harmless)) in enumerate(zip(left, runs, strict=True), 1):
            state.add(each, _recorded(plan, each, content, row) if content else row)
            host.on_progress(number / len(left), f"{len(left) - number} of {len(left)} runs left")
            if not harmless:
                return state.result(f"{each.step.text}: {row.result}")
    return state.result()


def _task(each: PlannedStep) -> FastTask:
    loaded = each.loaded
    folder = str(loaded.folder.absolute())  # a link stays, as in the names of the texts
    return FastTask(loaded.yaml_text, dict(loaded.files.texts), folder, each.heat_a2)


def _recorded(
    plan: CampaignPlan, each: PlannedStep, content: bytes, row: CampaignRow
) -> CampaignRow:
    path = new_recording(plan.folder, plan.campaign.config.name, each.step.number)
    write_file(path, lambda stream: stream.write(content), overwrite=False)
    return replace(row, recording=path.name)
