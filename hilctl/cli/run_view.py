"""Runs for people, in a terminal: progress, forecast, and how it ended."""

import shlex
import sys
import time
from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from hilctl.base.events import adapted_text
from hilctl.base.formatting import unit_text
from hilctl.cli.console import console

if TYPE_CHECKING:
    from hilctl.analysis.figures import RunReport
    from hilctl.experiment.check import Checked
    from hilctl.run.result import Progress as RunProgress
    from hilctl.run.result import RunResult

_REFRESH_S = 0.1
_LARGEST_REPORTED = 5_000_000


class LiveView:
    """A progress line on standard error: samples, error, command, late ticks.

    Args:
        quiet: Show nothing of it.
        addresses: Of pages that show the run; printed once there is something to look at.
    """

    def __init__(self, *, quiet: bool, addresses: Sequence[str] = ()) -> None:
        self._addresses = list(addresses)
        terminal = console(stderr=True)
        self._progress = Progress(
            TextColumn("[bold]run"),
            BarColumn(bar_width=24),
            TextColumn("{task.percentage:>3.0f} %"),
            TextColumn("{task.fields[live]}"),
            TimeRemainingColumn(),
            console=terminal,
            disable=quiet or not terminal.is_terminal,
            refresh_per_second=8,
        )
        self._task: TaskID | None = None
        self._shown = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._progress.stop()

    def update(self, progress: "RunProgress") -> None:
        """Show the newest samples, a few times a second."""
        while self._addresses:
            print(f"live page: {self._addresses.pop()}", file=sys.stderr)
        if self._progress.disable:
            return
        now = time.monotonic()
        if now - self._shown < _REFRESH_S and progress.samples < progress.total:
            return
        self._shown = now
        if self._task is None:
            self._progress.start()
            self._task = self._progress.add_task("run", total=progress.total, live="")
        done = min(progress.samples, progress.total)
        self._progress.update(self._task, completed=done, live=_live_text(progress))


def _live_text(progress: "RunProgress") -> str:
    newest = progress.batch.samples(slice(-1, None))
    command, displacement_um = newest.command, newest.displacement_um
    error_um = displacement_um - newest.reference_um
    shown = progress.compensated and np.isfinite(error_um[-1])
    error = f"error {error_um[-1]:+7.2f} µm  " if shown else ""
    return (
        f"{error}x {displacement_um[-1]:+8.2f} µm  command {command[-1]:+7.3f}  "
        f"late {progress.late_ticks}"
    )


def report_of(result: "RunResult", *, whole: bool) -> "RunReport | None":
    """Return the report of a run that has ended.

    Args:
        result: How it ended.
        whole: Whether it is wanted of a very long run too.
    """
    from hilctl.analysis.report import summarize  # a run should not wait for it
    from hilctl.recording.reader import read

    shown = whole or 0 < result.samples <= _LARGEST_REPORTED
    return summarize(read(result.path)) if shown else None


def run_mapping(result: "RunResult", report: "RunReport | None") -> dict[str, Any]:
    """Return a run's end and its report as plain values."""
    return {**(report.to_mapping() if report else {}), **result.to_mapping()}


def print_run(result: "RunResult", report: "RunReport | None") -> None:
    """Print how a run ended and, unless it is very long, its report."""
    from hilctl.cli.report_view import render
    from hilctl.loop.safe_output import describe

    terminal = console()
    colour = {"completed": "green", "stopped": "yellow"}.get(result.code, "red")
    terminal.print(Text(result.code, colour) + f": {result.reason}")
    if not result.safe:
        terminal.print(f"Not safe: {describe(result.output_state)}.", style="bold red")
    if result.guardian_active:
        terminal.print("The guardian keeps trying: see hilctl status, or end it with hilctl safe.")
    if result.deadline_misses:
        terminal.print(result.deadline_misses, style="bold yellow")
    if result.samples == 0:
        terminal.print("no sample was recorded")
    elif report is not None:
        terminal.print(render(report))
    elif result.adapted:
        terminal.print(f"adapted: {adapted_text(result.adapted)}")
    terminal.print(f"recorded: {result.path}", soft_wrap=True)
    path = shlex.quote(str(result.path))
    terminal.print(f"  hilctl report {path} --html run.html", soft_wrap=True)


def print_forecast(checked: "Checked") -> None:
    """Print what a run will do."""
    forecast, config = checked.forecast, checked.loaded.config
    unit, reference_unit = forecast.command_unit, checked.reference.unit
    limits = config.limits
    low, high = limits.command_range
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    rows = {
        "experiment": config.name,
        "device": checked.loaded.device.info.description,
        "samples": f"{forecast.samples} at {config.sample_rate_hz:g} Hz, {config.block} a tick",
        "highest rate": f"{forecast.highest_rate_hz:.6g} Hz"
        + (f" ({forecast.rate_note})" if forecast.rate_note else ""),
        "duration": f"{forecast.duration_s:g} s"
        + (f", after {forecast.before_s:g} s of condition and rest" if forecast.before_s else ""),
        "reference": f"{forecast.reference_min:.4g} to {forecast.reference_max:.4g} "
        f"{unit_text(reference_unit)}",
        "command": f"{forecast.command_min:.4g} to {forecast.command_max:.4g} {unit} "
        f"(limits {low:g} to {high:g})",
        "slew": f"{forecast.slew_per_s:.4g} {unit}/s (limit {limits.slew_per_s:g})",
        "recording": _recording(forecast.recording_mb),
    }
    if forecast.begins:
        rows["begins"] = forecast.begins
    if note := checked.loaded.device.info.safe_note:
        rows["safe value"] = note
    if forecast.heating_rms_a is not None:
        begins = f"begins at {forecast.begins_rms_a or 0.0:.3g} A rms"
        most = f"{forecast.heating_rms_a:.4g} A rms (limit {limits.rms_current_a:g})"
        rows["heating"] = f"{most}, {begins}"
    for name, text in rows.items():
        table.add_row(name, text)
    terminal = console()
    terminal.print(table)
    for warning in checked.warnings:
        terminal.print(f"warning: {warning}", style="yellow")
    terminal.print("may start", style="green")


def _recording(megabytes: float) -> str:
    return f"about {megabytes:.3g} MB" if megabytes < 1000.0 else f"about {megabytes / 1e3:.3g} GB"
