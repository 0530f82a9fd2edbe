"""Campaigns in real time, or of simulated runs in parallel processes or on a Dask cluster.

Completed steps are kept, failed ones marked; a fault of the rig ends a campaign. A worker receives
the checked texts of a simulated run and returns the recording as bytes, so it does not need access
to the campaign's folder. Each such run starts with the coil heat that the preceding steps and
pauses would leave in real time.
"""

import math
import signal
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import methodcaller
from pathlib import Path

from hilctl.analysis.contour import contour
from hilctl.base.errors import ConfigError, HilctlError, InputError, RunError
from hilctl.base.files import TextFiles, write_file
from hilctl.base.formatting import shown_briefly
from hilctl.base.yaml import Document
from hilctl.experiment.load import resolve
from hilctl.experiment.preflight import check_axes
from hilctl.experiment.state_files import MachineTime
from hilctl.lab.identify.parallel import workers
from hilctl.lab.studies.campaign.plan import CampaignPlan, PlannedStep, planned
from hilctl.lab.studies.campaign.steps import CampaignStep, CampaignSteps
from hilctl.lab.studies.campaign.store import CampaignRow, entry_of, ordered, write_table
from hilctl.lab.studies.multi_run.collect import COMPLETED, series_of
from hilctl.lab.studies.multi_run.digest import SeriesDrift, digest_of, drift_of
from hilctl.lab.studies.multi_run.multi_run_page import write_series
from hilctl.lab.studies.study import (
    StepFaultError,
    StepStoppedError,
    Study,
    StudyHost,
    StudyRun,
    StudyStep,
    heat_of,
    require_room,
    run_study,
)
from hilctl.lab.studies.study_folder import completed_runs, last_started
from hilctl.recording.metadata_keys import AXIS_FACT
from hilctl.recording.reader import read
from hilctl.run.result import RunResult, recordings_of
from hilctl.run.unpaced import run_unpaced

_FIRST_PAGE_S = 60.0
_PAGE_SHARE = 30.0  # pause before the page is written again, over the time to write it


@shown_briefly
@dataclass(frozen=True, slots=True)
class CampaignResult:
    """Result of a campaign.

    Attributes:
        rows: Outcome of each step, by its number.
        tables: Files of the table.
        reason: Why it ended before its last step; otherwise empty.
        stop_signal: Number of the signal that stopped it, or 0.
        page: Its page; None if it could not be written.
    """

    plan: CampaignPlan
    rows: dict[int, CampaignRow]
    tables: tuple[Path, ...]
    reason: str = ""
    stop_signal: int = 0
    page: Path | None = None

    @property
    def ordered(self) -> list[tuple[CampaignStep, CampaignRow]]:
        """All steps in order, each with its rows, one per axis."""
        return ordered(self.plan, self.rows)

    @property
    def drift(self) -> SeriesDrift | None:
        """Drift over the reference runs, of the first axis."""
        numbers = [each.step.number for each in self.plan.steps if each.step.is_reference]
        references = [self.rows[number] for number in numbers if number in self.rows]
        return drift_of([row.figures for row in references if row.code == COMPLETED])

    @property
    def codes(self) -> list[str]:
        """Code of each step."""
        rows = (self.rows.get(each.step.number, CampaignRow()) for each in self.plan.steps)
        return [row.code for row in rows]

    def count(self, code: str) -> int:
        """Return the number of steps with a code."""
        return self.codes.count(code)


class Campaign:
    """A campaign as a study: its rows, table and page.

    The table is written after every step. Drawing the page takes seconds: it is written at the end,
    and between steps while that takes a small part of the time.

    Raise InputError without disk space; nothing has moved.
    """

    def __init__(
        self,
        plan: CampaignPlan,
        host: StudyHost,
        row_of: Callable[[StudyRun], CampaignRow] = lambda run: measured(run.paths),
    ) -> None:
        self.plan = plan
        self.rows: dict[int, CampaignRow] = {}
        self.tables: list[Path] = []
        self._page: Path | None = None
        self._host, self._row_of = host, row_of
        self._next_page_s = host.now().boot_s + _FIRST_PAGE_S
        require_room(plan.folder, plan.megabytes, plan.free_mb)

    def study(self) -> Study[CampaignResult]:
        """Run the remaining steps; raise InputError if the table cannot be written."""
        for each in self.plan.steps:
            if each.kept is not None:
                run = yield self._step(each, 0.0)
                self._add(each, replace(measured(run.paths), kept=True))
        self.tables = write_table(self.plan, self.rows)
        done_s = 0.0
        try:
            for each in self.plan.left:
                yield from self._ran(each, done_s)
                done_s += each.pause_s + each.seconds
        except StepStoppedError as error:
            return self.result(str(error), error.signal)
        except RunError as error:
            return self.result(str(error))
        except KeyboardInterrupt:  # while a run is evaluated
            return self.result("stopped by Ctrl-C", signal.SIGINT)
        return self.result()

    def _step(self, each: PlannedStep, done_s: float) -> StudyStep:
        config = self.plan.campaign.config
        return StudyStep(
            self.plan.campaign.experiment,
            each.settings,
            name=f"{config.name}-{each.step.number:04d}",
            text=each.step.text,
            repeats=0,  # a stall is marked, and the next call repeats the step
            cool_to_rms_a=config.cool_down.to_rms_a or math.inf,
            loaded=each.loaded,
            heat=each.heat,
            done_s=done_s,
        )

    def _ran(self, each: PlannedStep, done_s: float) -> Study[None]:
        """Run a step and add its row; raise RunError if no further step may run."""
        try:
            row = self._row_of((yield self._step(each, done_s)))
        except ConfigError as error:  # nothing has moved
            self._add(each, failed("refused", str(error)))
        except StepFaultError as error:
            self._add(each, failed("fault", error.result.reason, error.result.path))
            if not error.harmless:
                raise
        except StepStoppedError as error:
            if error.result is not None:
                self._add(each, failed("stopped", error.result.reason, error.result.path))
            raise
        except (InputError, RunError) as error:
            self._add(each, failed("fault", str(error)))
            raise RunError(f"{each.step.text}: {error}") from None
        else:
            self._add(each, row)

    def _add(self, each: PlannedStep, row: CampaignRow) -> None:
        """Add the row of a step, and rewrite the table unless the step was done earlier."""
        self.rows[each.step.number] = row
        if not row.kept:
            self.tables = write_table(self.plan, self.rows)
            if self._host.now().boot_s >= self._next_page_s:
                self._write_page()
        for one in (row, *row.others):
            self._host.on_step(each.step, one)

    def result(self, reason: str = "", stop_signal: int = 0) -> CampaignResult:
        """Return the result so far, and write its page."""
        self._write_page()
        tables = tuple(self.tables)
        return CampaignResult(self.plan, self.rows, tables, reason, stop_signal, self._page)

    def _write_page(self) -> None:
        start_s, name = self._host.now().boot_s, self.plan.campaign.config.name
        path = self.plan.folder / f"{name}.html"
        runs = [entry_of(*each) for each in ordered(self.plan, self.rows)]
        try:
            write_series(series_of(name, runs), path)
        except InputError as error:  # recordings and table hold everything that is on it
            self._host.on_note(f"no page: {error}")
            return
        self._page = path
        now_s = self._host.now().boot_s
        self._next_page_s = now_s + max(_FIRST_PAGE_S, _PAGE_SHARE * (now_s - start_s))


def measured(paths: Sequence[Path]) -> CampaignRow:
    """Return the row of the first axis of a completed run, with those of the others."""
    recordings, contour_um = {path: read(path) for path in paths}, None
    if len(paths) > 1 and all(each.compensated for each in recordings.values()):
        report, _ = contour({each.run[AXIS_FACT]: [each] for each in recordings.values()})
        contour_um = report.peak_um
    first, *others = (
        CampaignRow(
            COMPLETED,
            (digest := digest_of(each)).figures,
            path.name,
            COMPLETED,
            digest=digest,
            axis=each.run.get(AXIS_FACT, ""),
            contour_um=contour_um,
        )
        for path, each in recordings.items()
    )
    return replace(first, others=tuple(others))


def failed(code: str, reason: str, path: Path | None = None) -> CampaignRow:
    """Return the row of a run that was not completed, with its recording if there is one."""
    return CampaignRow(f"{code}: {reason}", recording=path.name if path else "", code=code)


def planned_in_real_time(campaign: CampaignSteps, folder: Path, now: MachineTime) -> CampaignPlan:
    """Return the plan of a campaign in real time; raise ConfigError if a step is not allowed."""
    completed = completed_runs(folder)
    plan = planned(campaign, folder, completed, 0.0)
    if not plan.left:
        return plan
    last = last_started(folder)
    heat_a2 = max(heat_of(each, last, now) for each in plan.left[0].loaded)
    return planned(campaign, folder, completed, heat_a2) if heat_a2 > 0.0 else plan


def run_series(plan: CampaignPlan, host: StudyHost) -> CampaignResult:
    """Run the remaining steps of a campaign one after the other in real time.

    Raise InputError without disk space, or if the table cannot be written; nothing has moved.
    """
    return run_study(
        Campaign(plan, host).study(), plan.folder, host, total_s=plan.seconds + plan.pauses_s
    )


@dataclass(frozen=True, slots=True)
class FastTask:
    """Input of one run."""

    experiments: Mapping[str, str]  # the experiment of each axis as YAML
    files: Mapping[str, str]  # texts of the files it uses, by absolute path
    folder: str  # folder that its file names are relative to
    heat_a2: float  # heat of the coil before it, in A^2


def run_task(task: FastTask) -> tuple[list[bytes], RunResult | HilctlError, CampaignRow | None]:
    """Run one step on a worker.

    Return the recording of each axis, its result, and its row if it was completed. An error
    replaces the result if it was refused.
    """
    place, files = Path(task.folder), TextFiles(task.files)
    loaded = [
        replace(resolve(Document("experiment", text), place, files=files), axis=axis)
        for axis, text in task.experiments.items()
    ]
    with tempfile.TemporaryDirectory(prefix="hilctl-campaign-") as folder:
        output = Path(folder) / "run.mcap"
        try:
            result = run_unpaced(check_axes(loaded, task.heat_a2), output)
        except HilctlError as error:
            return [], error, None
        row = measured(result.recordings) if result.code == COMPLETED else None
        return [path.read_bytes() for path in result.recordings], result, row


@dataclass(frozen=True, slots=True)
class WorkerRuns:
    """Results of steps on workers, in the order of the steps, and the rows of those taken."""

    results: Iterator[tuple[list[bytes], RunResult | HilctlError, CampaignRow | None]]
    rows: dict[Path, CampaignRow] = field(default_factory=dict)

    def take(
        self, path: Path, settings: object, output: Path, *_: object, **__: object
    ) -> RunResult:
        """Write the recordings of the next step; return its result, or raise its error."""
        contents, result, row = next(self.results)
        if isinstance(result, HilctlError):
            raise result
        paths = recordings_of([*result.axes] or [""], output)
        for target, content in zip(paths.values(), contents, strict=True):
            write_file(target, methodcaller("write", content), overwrite=False)
        result = result.moved(paths)
        if row is not None:
            others = tuple(replace(each, recording=paths[each.axis].name) for each in row.others)
            self.rows[result.path] = replace(row, recording=result.path.name, others=others)
        return result

    def row_of(self, run: StudyRun) -> CampaignRow:
        """Return the row of a run."""
        return self.rows.pop(run.path)


def planned_fast(campaign: CampaignSteps, folder: Path) -> CampaignPlan:
    """Return the plan of a campaign without real time; raise InputError for a real device."""
    plan = planned(campaign, folder, completed_runs(folder))
    for each in plan.steps:
        for info in (axis.device.info for axis in each.loaded):
            if not info.simulated:
                rule = "only simulated devices run without real time"
                raise InputError(f"--fast: {each.step.text}: {info.name}: {rule}")
    return plan


def run_fast(plan: CampaignPlan, host: StudyHost, scheduler: str = "none") -> CampaignResult:
    """Run the remaining steps as fast as possible; raise InputError if the disk has no space."""
    with workers(scheduler) as run:
        done = WorkerRuns(run(run_task, [_task(each) for each in plan.left]))
        host = replace(host, run=done.take, real_time=False)
        study = Campaign(plan, host, done.row_of).study()
        return run_study(study, plan.folder, host, total_s=plan.seconds)


def _task(each: PlannedStep) -> FastTask:
    texts, first = {axis.axis: axis.yaml_text for axis in each.loaded}, each.loaded[0]
    folder = str(first.folder.absolute())  # a link stays, as in the names of the texts
    return FastTask(texts, dict(first.files.texts), folder, each.heat_a2)
