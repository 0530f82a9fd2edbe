"""A campaign's runs: what stands is kept, what fails is marked, a danger to the rig ends it."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

from hilctl.base.errors import ConfigError, DataError, InputError, RunError
from hilctl.experiment.coil_heat import CoolingCoil
from hilctl.experiment.history import heat_after, heat_before
from hilctl.recording.reader import read
from hilctl.recording.recording import Recording
from hilctl.run.orphans import recover_orphans
from hilctl.run.result import RunResult
from hilctl.run.start import OnPart, RunKey, StepStoppedError, paced
from hilctl.studies.campaign.plan import CampaignPlan, PlannedStep, planned
from hilctl.studies.campaign.steps import CampaignStep, CampaignSteps
from hilctl.studies.campaign.store import (
    await_runs,
    held_folder,
    last_begun,
    make_whole,
    new_recording,
    standing_runs,
)
from hilctl.studies.campaign.table import CampaignRow, entry_of, write_table
from hilctl.studies.multi_run.collect import COMPLETED, series_of
from hilctl.studies.multi_run.digest import SeriesDrift, digest_of, drift_of

HARMLESS = frozenset({"late", "dropped", "invalid_command"})
"""Codes of events that end a run, and say nothing of device or rig: the next step may do better."""

_WAIT_SHOWN_S = 1.0
_FIRST_PAGE_S = 60.0
_PAGE_SHARE = 30.0  # times what it takes to write the page, until it is written again


class CampaignRunner(Protocol):
    """Runs an experiment file with settings into a new recording."""

    def __call__(
        self,
        path: Path,
        settings: list[str],
        output: Path,
        on_part: OnPart,
        *,
        overwrite: bool,
        heat_a2: float,
    ) -> RunResult:
        """See :func:`hilctl.run.start.paced`."""
        ...


@dataclass(frozen=True, slots=True)
class CampaignHost:
    """What a campaign needs from outside: runs, time, and whoever watches.

    Attributes:
        run: How a step is run.
        now_s: Unix time in s.
        sleep_s: Waits that long.
        on_row: Called with each step that is done, and what became of it.
        on_progress: Called with what is done, from 0 to 1, and what is being done.
        on_note: Called with what was done for runs that were cut short.
    """

    run: CampaignRunner = paced
    now_s: Callable[[], float] = time.time
    sleep_s: Callable[[float], None] = time.sleep
    on_row: Callable[[CampaignStep, CampaignRow], None] = field(default=lambda step, row: None)
    on_progress: Callable[[float, str], None] = field(default=lambda done, text: None)
    on_note: Callable[[str], None] = field(default=lambda text: None)


@dataclass(frozen=True, slots=True)
class CampaignResult:
    """What came of a campaign.

    Attributes:
        plan: What was planned.
        rows: What became of the steps, by their number.
        tables: Files of the table.
        reason: Why it ended before its last step; empty where it did not.
        stop_signal: Number of the signal that stopped it, or 0.
        page: Its page; None where it could not be written.
    """

    plan: CampaignPlan
    rows: dict[int, CampaignRow]
    tables: tuple[Path, ...]
    reason: str = ""
    stop_signal: int = 0
    page: Path | None = None

    @property
    def ordered(self) -> list[tuple[CampaignStep, CampaignRow]]:
        """Every step in order, with what became of it."""
        steps = (each.step for each in self.plan.steps)
        return [(step, self.rows.get(step.number, CampaignRow())) for step in steps]

    @property
    def drift(self) -> SeriesDrift | None:
        """What its reference runs say of drift."""
        references = [row for step, row in self.ordered if step.is_reference]
        return drift_of([row.figures for row in references if row.code == COMPLETED])

    def count(self, code: str) -> int:
        """Return how many steps have come to a code."""
        return sum(row.code == code for _, row in self.ordered)


class Campaign:
    """The state of a campaign while it is run: rows, and table and page that follow them.

    The table is written after every step. To draw the page takes seconds: it is written at the end,
    and between steps as long as that stays a small part of the time.

    Args:
        plan: What is planned.
        host: Who watches.
    """

    def __init__(self, plan: CampaignPlan, host: CampaignHost) -> None:
        self.plan = plan
        self.rows: dict[int, CampaignRow] = {}
        self.tables: list[Path] = []
        self._page: Path | None = None
        self._host = host
        self._next_page_s = host.now_s() + _FIRST_PAGE_S
        config = plan.campaign.config
        self._facts = {
            "campaign": config.name,
            "description": config.description,
            "experiment": str(plan.campaign.experiment),
        }

    def keep(self) -> None:
        """Take the rows of what stands already; nothing is run for them."""
        for each in self.plan.steps:
            if each.kept is not None:
                row = measured(read(each.kept))
                self.add(each, replace(row, kept=True), write=False)
        self._write()

    def add(self, each: PlannedStep, row: CampaignRow, *, write: bool = True) -> None:
        """Take what became of a step, and write the table anew."""
        self.rows[each.step.number] = row
        if write:
            self._write()
            self._write_page(only_when_due=True)
        self._host.on_row(each.step, row)

    def result(self, reason: str = "", stop_signal: int = 0) -> CampaignResult:
        """Return what came of it so far, and write its page."""
        self._write_page()
        tables = tuple(self.tables)
        return CampaignResult(self.plan, self.rows, tables, reason, stop_signal, self._page)

    def _write_page(self, *, only_when_due: bool = False) -> None:
        from hilctl.studies.multi_run.multi_run_page import write_series

        begun_s = self._host.now_s()
        if only_when_due and begun_s < self._next_page_s:
            return
        name = self.plan.campaign.config.name
        path = self.plan.folder / f"{name}.html"
        steps = [each.step for each in self.plan.steps]
        rows = [(step, self.rows.get(step.number, CampaignRow())) for step in steps]
        digests = {row.recording: row.digest for _, row in rows if row.digest is not None}
        try:
            write_series(series_of(name, [entry_of(*each) for each in rows], digests), path)
        except InputError as error:  # recordings and table have all that is on it
            self._host.on_note(f"no page: {error}")
            return
        self._page = path
        now_s = self._host.now_s()
        self._next_page_s = now_s + max(_FIRST_PAGE_S, _PAGE_SHARE * (now_s - begun_s))

    def _write(self) -> None:
        self.tables = write_table(self.plan, self.rows, self._facts)


def measured(recording: Recording) -> CampaignRow:
    """Return the row of a step whose run was completed."""
    digest = digest_of(recording)
    name = recording.path.name
    return CampaignRow(COMPLETED, digest.figures, name, COMPLETED, digest=digest)


@contextmanager
def prepared(folder: Path, host: CampaignHost) -> Iterator[None]:
    """Hold a campaign's folder; what dead runs left there is made whole.

    Raises:
        InputError: Another campaign or a run writes to it.
    """
    with held_folder(folder, host.sleep_s):
        await_runs(folder, host.sleep_s)
        for orphan in recover_orphans():
            host.on_note(f"{orphan.name} was not recorded to its end: {orphan.text}")
        for text in make_whole(folder):
            host.on_note(text)
        yield


def planned_in_real_time(campaign: CampaignSteps, folder: Path, now_s: float) -> CampaignPlan:
    """Return the plan of a campaign that keeps real time; nothing moves.

    Raises:
        ConfigError: One or more steps must not be run.
        InputError: The base experiment can't be read.
    """
    standing = standing_runs(folder) if folder.is_dir() else {}
    last = last_begun(folder) if folder.is_dir() else None
    plan = planned(campaign, folder, standing, 0.0)
    if not plan.left:
        return plan
    heat_a2 = _heat_a2(plan.left[0], folder, last, now_s)
    return planned(campaign, folder, standing, heat_a2) if heat_a2 > 0.0 else plan


def _heat_a2(each: PlannedStep, folder: Path, last: Path | None, now_s: float) -> float:
    """Return the heat of the coil, by the device's last run, or by the last of this campaign.

    A simulated device has no past of its own; within a campaign it is one rig all the same.
    """
    config, info = each.loaded.config, each.loaded.device.info
    heat_a2 = heat_before(each.loaded, now_s)
    if config.limits.thermal_time_constant_s is None or not info.simulated or last is None:
        return heat_a2
    return max(heat_a2, heat_after(last, config, now_s))


def run_series(plan: CampaignPlan, host: CampaignHost) -> CampaignResult:
    """Run what is left of a campaign, one step after the other, in real time.

    Args:
        plan: Its plan.
        host: Who runs it and watches.

    Raises:
        InputError: There is no room, or the table can't be written; nothing has moved.
    """
    plan.require_room()
    series = Campaign(plan, host)
    series.keep()
    steps = _Steps(series, host)
    try:
        for each in plan.left:
            steps.do(each)
    except StepStoppedError as error:
        return series.result(str(error), error.signal)
    except RunError as error:
        return series.result(str(error))
    except KeyboardInterrupt:  # between two steps
        series.result()
        raise
    return series.result()


class _Steps:
    """Runs step by step; see :func:`run_series`."""

    def __init__(self, series: Campaign, host: CampaignHost) -> None:
        self._series, self._host, self._plan = series, host, series.plan
        self._last = last_begun(self._plan.folder)
        self._done_s = 0.0

    def do(self, each: PlannedStep) -> None:
        """Run a step, once the coil is cool enough.

        Raises:
            StepStoppedError: Somebody stopped it.
            RunError: Device, rig or disk: no further step is to be run.
        """
        heat_a2 = self._cool(each)
        config = self._plan.campaign.config
        output = new_recording(self._plan.folder, config.name, each.step.number)
        try:
            result = self._host.run(
                self._plan.campaign.experiment,
                list(each.settings),
                output,
                lambda part: self._progress(each, each.step.text, part),
                overwrite=False,
                heat_a2=heat_a2,
            )
        except ConfigError as error:  # refused for what only shows now; nothing has moved
            self._series.add(each, CampaignRow(f"refused: {error}", code="refused"))
            return
        except (InputError, RunError) as error:
            self._series.add(each, CampaignRow(f"fault: {error}", code="fault"))
            raise RunError(f"{each.step.text}: {error}") from None
        self._last = result.path
        self._done_s += each.pause_s + each.seconds
        self._take(each, result)

    def _take(self, each: PlannedStep, result: RunResult) -> None:
        """Take what became of a step.

        Raises:
            StepStoppedError: Somebody stopped it.
            RunError: No further step is to be run.
        """
        if result.stop_signal:
            row = CampaignRow(
                f"stopped: {result.reason}", recording=result.path.name, code="stopped"
            )
            self._series.add(each, row)
            raise StepStoppedError(f"{each.step.text}: {result.reason}", result.stop_signal)
        if result.code == COMPLETED:
            recording = read(result.path)
            if RunKey.of_facts(recording.run) != each.key:
                raise RunError(
                    f"{each.step.text}: the experiment, or a file that it names, has changed since "
                    "the campaign began: run it again"
                )
            self._series.add(each, measured(recording))
            return
        row = CampaignRow(f"fault: {result.reason}", recording=result.path.name, code="fault")
        self._series.add(each, row)
        if not is_harmless(result):
            raise RunError(f"{each.step.text}: {result.reason}")

    def _cool(self, each: PlannedStep) -> float:
        """Wait until the coil is cool enough; return its heat then, in A^2."""
        now_s = self._host.now_s()
        heat_a2 = _heat_a2(each, self._plan.folder, self._last, now_s)
        # From now on by its own model: a clock that was set back must not keep it hot for ever.
        coil = CoolingCoil(each.loaded.config, heat_a2, now_s)
        to_rms_a = self._plan.campaign.config.cool_down.to_rms_a or float("inf")
        pause_s = left_s = coil.pause_s(each.heat, now_s, to_rms_a)
        while left_s > 0.0:
            text = f"step {each.step.number}: the coil cools for {left_s:.0f} s"
            self._progress(each, text, 0.0)
            self._host.sleep_s(min(left_s, _WAIT_SHOWN_S))
            left_s -= _WAIT_SHOWN_S
        return coil.heat_a2(now_s + pause_s)

    def _progress(self, each: PlannedStep, text: str, part: float) -> None:
        whole_s = self._plan.seconds + self._plan.pauses_s
        done_s = self._done_s + part * each.seconds
        left_s = round(whole_s - done_s)
        left = f"{left_s // 3600}:{left_s // 60 % 60:02d}:{left_s % 60:02d} left"
        self._host.on_progress(done_s / max(whole_s, 1e-9), f"{text}; {left}")


def is_harmless(result: RunResult) -> bool:
    """Return whether a run that ended by a fault says nothing against running the next one."""
    if not result.safe:
        return False
    try:
        events = read(result.path).events
    except DataError:
        return False
    codes = {event.code for event in events if event.level == "error"} - {"run_ended"}
    return bool(codes) and codes <= HARMLESS
