"""The command that learns on references that repeat."""

import shlex
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hilctl.cli.options import AsJson, ExperimentFile, LabelTexts, Overwrite, Settings, with_labels
from hilctl.cli.output import finish_orphans, print_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hilctl.learning.results import Learned, Row


def learn(
    experiment: ExperimentFile,
    output: Annotated[Path, typer.Option(help="Correction file to write.")],
    cycles: Annotated[int, typer.Option(min=1, max=200, help="Most runs after the first.")] = 20,
    folder: Annotated[
        Path | None, typer.Option(help="Where each run is kept; OUTPUT-runs where not given.")
    ] = None,
    settings: Settings = None,
    labels: LabelTexts = None,
    fast: Annotated[
        bool, typer.Option("--fast", help="Do not wait for real time; simulated devices only.")
    ] = False,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Learn a correction for a reference that repeats: run, correct, and run again."""
    from hilctl import api
    from hilctl.api.running import runs_folder

    finish_orphans()
    chosen = runs_folder(output, folder)
    learned = api.learn(
        experiment,
        output,
        cycles=cycles,
        folder=chosen,
        settings=with_labels(settings, labels),
        fast=fast,
        overwrite=overwrite,
        on_rows=(lambda rows: None) if as_json else _print_rows,
    )
    if as_json:
        print_json({**learned.to_mapping(), "output": str(output), "folder": str(chosen)})
    else:
        _print_end(learned, output, chosen)
    if learned.stop_signal:
        raise typer.Exit(128 + signal.Signals(learned.stop_signal))
    if learned.fault:
        raise typer.Exit(3)


def _print_rows(rows: "Sequence[Row]") -> None:
    for row in rows:
        name = f"  {row.label}" if len(rows) > 1 else ""
        reach = f"reach {row.reach_hz:.0f} Hz" if row.run else "start"
        error = f"peak error {row.error_percent:.4f} % (noise floor {row.floor_percent:.4f} %)"
        print(f"run {row.run:2d}  {error}  {reach}{name}", flush=True)


def _print_end(learned: "Learned", output: Path, folder: Path) -> None:
    from rich.table import Table
    from rich.text import Text

    from hilctl.cli.console import console
    from hilctl.learning.session import correction_setting

    checks = {row.label: row for row in learned.check}
    last = {row.label: row for row in learned.rows}
    table = Table(title=Text(f"learned: {learned.reason}"), title_justify="left")
    for name in ("waveform", "start %", "best %", "checked %", "floor %", "delay", "resonance"):
        table.add_column(name, justify="left" if name == "waveform" else "right")
    for cycle in learned.correction.cycles:
        row = last[cycle.label]
        check = checks.get(cycle.label)
        natural = f"{row.natural_hz:.0f} Hz" if row.natural_hz else "-"
        table.add_row(
            Text(cycle.label),
            f"{cycle.start_percent:.4f}",
            f"{cycle.error_percent:.4f}",
            f"{check.error_percent:.4f}" if check else "-",
            f"{row.floor_percent:.4f}",
            f"{row.delay_samples:.2f} samples",
            natural,
        )
    terminal = console()
    terminal.print(table)
    terminal.print(f"correction: {output}; runs: {folder}", soft_wrap=True)
    setting = shlex.quote(correction_setting(output))
    terminal.print(f"  --set {setting}", soft_wrap=True)
