"""Campaigns in real time, or of simulated runs in parallel processes or on a Dask cluster.

Completed steps are kept, failed ones marked; a fault of the rig ends a campaign. A worker receives
the checked texts of a simulated run and returns the recording as bytes, so it does not need access
to the campaign's folder. The coil starts each such run with the heat that it would have if the
steps and their pauses followed each other.
"""

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from hilctl.base.errors import ConfigError, DataError, HilctlError, InputError, RunError
from hilctl.base.files import TextFiles, write_file
from hilctl.base.formatting import shown_briefly
from hilctl.base.yaml import Document
from hilctl.experiment.coil_heat import CoolingCoil
from hilctl.experiment.device_state import heat_after, heat_before
from hilctl.experiment.load import resolve
from hilctl.experiment.preflight import check
from hilctl.experiment.state_files import MachineTime
from hilctl.lab.identify.parallel import workers
from hilctl.lab.studies.campaign.plan import CampaignPlan, PlannedStep, planned
from hilctl.lab.studies.campaign.steps import CampaignStep, CampaignSteps
from hilctl.lab.studies.campaign.store import (
    CampaignRow,
    await_runs,
    completed_runs,
    entry_of,
    last_started,
    locked_folder,
    new_recording,
    ordered,
    repair_recordings,
    write_table,
)
from hilctl.lab.studies.multi_run.collect import COMPLETED, series_of
from hilctl.lab.studies.multi_run.digest import SeriesDrift, digest_of, drift_of
from hilctl.lab.studies.multi_run.multi_run_page import write_series
from hilctl.lab.studies.step_runner import StepRunner, StudyHost, raise_if_stopped, require_room
from hilctl.recording.reader import read
from hilctl.recording.recording import Recording
from hilctl.run.recovery import recover_dead_runs
from hilctl.run.result import RunResult
from hilctl.run.start import RunKey, StepStoppedError
from hilctl.run.unpaced import run_unpaced

HARMLESS = frozenset({"late", "dropped", "invalid_command"})
"""Codes of faults that are not the device's or the rig's: the next step may succeed."""

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
        """All steps in order, each with its row."""
        return ordered(self.plan, self.rows)

    @property
    def drift(self) -> SeriesDrift | None:
        """Drift over the reference runs."""
        references = [row for step, row in self.ordered if step.is_reference]
        return drift_of([row.figures for row in references if row.code == COMPLETED])

    def count(self, code: str) -> int:
        """Return the number of steps with a code."""
        return sum(row.code == code for _, row in self.ordered)


class Campaign:
    """State of a running campaign, with the steps that are done already: rows, table and page.

    The table is written after every step. Drawing the page takes seconds: it is written at the end,
    and between steps while that takes a small part of the time.
    """

    def __init__(self, plan: CampaignPlan, host: StudyHost) -> None:
        self.plan = plan
        self.rows: dict[int, CampaignRow] = {}
        self.tables: list[Path] = []
        self._page: Path | None = None
        self._host = host
        self._next_page_s = host.now().boot_s + _FIRST_PAGE_S
        require_room(plan.folder, plan.megabytes, plan.free_mb)
        for each in plan.steps:
            if each.kept is not None:
                self.add(each, replace(measured(read(each.kept)), kept=True), write=False)
        self.tables = write_table(plan, self.rows)

    def add(self, each: PlannedStep, row: CampaignRow, *, write: bool = True) -> None:
        """Add the row of a step and rewrite the table."""
        self.rows[each.step.number] = row
        if write:
            self.tables = write_table(self.plan, self.rows)
            if self._host.now().boot_s >= self._next_page_s:
                self._write_page()
        self._host.on_step(each.step, row)

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


def measured(recording: Recording) -> CampaignRow:
    """Return the row of a completed run."""
    digest = digest_of(recording)
    return CampaignRow(COMPLETED, digest.figures, recording.path.name, COMPLETED, digest=digest)


@contextmanager
def prepared(folder: Path, host: StudyHost) -> Iterator[None]:
    """Lock a campaign's folder, unless another writes to it, and repair recordings."""
    with locked_folder(folder, host.sleep_s):
        await_runs(folder, host.sleep_s)
        for orphan in recover_dead_runs():
            host.on_note(f"{orphan.name}: recording was incomplete: {orphan.text}")
        for text in repair_recordings(folder):
            host.on_note(text)
        yield


def planned_in_real_time(campaign: CampaignSteps, folder: Path, now: MachineTime) -> CampaignPlan:
    """Return the plan of a campaign in real time; raise ConfigError if a step is not allowed."""
    completed, last = completed_runs(folder), last_started(folder)
    plan = planned(campaign, folder, completed, 0.0)
    if not plan.left:
        return plan
    heat_a2 = _heat_a2(plan.left[0], last, now)
    return planned(campaign, folder, completed, heat_a2) if heat_a2 > 0.0 else plan


def _heat_a2(each: PlannedStep, last: Path | None, now: MachineTime) -> float:
    """Return the heat that the last run of the device or the campaign left in the coil, in A^2."""
    # A simulated device has no history of its own; within a campaign it counts as one rig.
    config, info = each.loaded.config, each.loaded.device.info
    heat_a2, _ = heat_before(each.loaded, now)
    if config.limits.thermal_time_constant_s is None or not info.simulated or last is None:
        return heat_a2
    return max(heat_a2, heat_after(last, config, now.unix_s))


def run_series(plan: CampaignPlan, host: StudyHost) -> CampaignResult:
    """Run the remaining steps of a campaign one after the other in real time.

    Raise InputError without disk space, or if the table can't be written; nothing has moved.
    """
    state = Campaign(plan, host)
    steps = _Steps(state, host)
    try:
        for each in plan.left:
            steps.run(each)
    except StepStoppedError as error:
        return state.result(str(error), error.signal)
    except RunError as error:
        return state.result(str(error))
    except KeyboardInterrupt:  # between two steps
        state.result()
        raise
    return state.result()


class _Steps:
    """Steps of a campaign in real time."""

    def __init__(self, state: Campaign, host: StudyHost) -> None:
        self._state, self._host, self._plan = state, host, state.plan
        self._last = last_started(self._plan.folder)
        self._runner = StepRunner(host, self._plan.seconds + self._plan.pauses_s)

    def run(self, each: PlannedStep) -> None:
        """Run a step when the coil is cool enough; raise RunError if no further step may run."""
        heat_a2 = self._cool(each)
        campaign, text = self._plan.campaign, each.step.text
        output = new_recording(self._plan.folder, campaign.config.name, each.step.number)
        try:
            result = self._runner.run(
                campaign.experiment, list(each.settings), output, text, each.seconds,
                overwrite=False, heat_a2=heat_a2,
            )  # fmt: skip
        except ConfigError as error:  # nothing has moved
            self._add(each, "refused", str(error))
            return
        except (InputError, RunError) as error:
            self._add(each, "fault", str(error))
            raise RunError(f"{text}: {error}") from None
        self._last = result.path
        self._runner.done_s += each.pause_s + each.seconds
        self._take(each, result)

    def _take(self, each: PlannedStep, result: RunResult) -> None:
        """Add the row of a run; raise as :meth:`run` does."""
        text = each.step.text
        if result.code == COMPLETED and not result.stop_signal:
            recording = read(result.path)
            if RunKey.of_facts(recording.run) != each.key:
                raise RunError(
                    f"{text}: the experiment, or a file it uses, changed during the campaign. "
                    "Run the campaign again"
                )
            self._state.add(each, measured(recording))
            return
        self._add(each, "stopped" if result.stop_signal else "fault", result.reason, result.path)
        raise_if_stopped(text, result)
        if not is_harmless(result):
            raise RunError(f"{text}: {result.reason}")

    def _add(self, each: PlannedStep, code: str, reason: str, path: Path | None = None) -> None:
        name = path.name if path else ""
        self._state.add(each, CampaignRow(f"{code}: {reason}", recording=name, code=code))

    def _cool(self, each: PlannedStep) -> float:
        """Wait until the coil is cool enough; return its heat then, in A^2."""
        now = self._host.now()
        heat_a2, now_s = _heat_a2(each, self._last, now), now.boot_s
        # The coil's own model from here on.
        coil = CoolingCoil(each.loaded.rig, heat_a2, now_s)
        to_rms_a = self._plan.campaign.config.cool_down.to_rms_a or float("inf")
        pause_s = coil.pause_s(each.heat, now_s, to_rms_a)
        self._runner.cool(f"step {each.step.number}", pause_s)
        return coil.heat_a2(now_s + pause_s)


def is_harmless(result: RunResult) -> bool:
    """Return whether the next step may run after a run that ended by a fault."""
    if not result.safe:
        return False
    try:
        events = read(result.path).events
    except DataError:
        return False
    codes = {event.code for event in events if event.level == "error"} - {"run_ended"}
    return bool(codes) and codes <= HARMLESS


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
    plan = planned(campaign, folder, completed_runs(folder))
    for each in plan.steps:
        info = each.loaded.device.info
        if not info.simulated:
            rule = "only simulated devices run without real time"
            raise InputError(f"--fast: {each.step.text}: {info.name}: {rule}")
    return plan


def run_fast(plan: CampaignPlan, host: StudyHost, scheduler: str = "none") -> CampaignResult:
    """Run the remaining steps as fast as possible; raise InputError if the disk has no space."""
    left = plan.left
    with workers(scheduler) as run:
        state = Campaign(plan, host)
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
