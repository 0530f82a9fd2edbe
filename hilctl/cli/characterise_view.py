"""A campaign for people: what it will do, each step, and what came of it."""

from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from hilctl.characterise.page import HELD_OUT_HEADINGS, figure_rows, held_out_rows
from hilctl.characterise.results import Characterisation, StepRow
from hilctl.characterise.session import CampaignPlan
from hilctl.cli.console import console


def plan_mapping(plan: CampaignPlan) -> dict[str, Any]:
    """Return a plan as plain values."""
    limits = plan.limits
    return {
        "device": limits.loaded.device.info.name,
        "unit": limits.unit,
        "command_range": [limits.low, limits.high],
        "stroke_um": list(limits.stroke_um),
        "band_hz": [limits.lowest_hz, limits.highest_hz],
        "rig_time_s": plan.seconds,
        "pauses_s": plan.pauses_s,
        "recordings_mb": plan.megabytes,
        "free_mb": plan.free_mb,
        "steps": [
            {"name": step.name, "purpose": step.purpose, "seconds": step.seconds}
            for step in plan.steps
        ],
    }


def print_plan(plan: CampaignPlan, folder: Path) -> None:
    """Print what a campaign will do at most."""
    limits = plan.limits
    table = Table(title=Text(f"{limits.loaded.device.info.name}: steps"), title_justify="left")
    for name in ("step", "what for", "s"):
        table.add_column(name, justify="right" if name == "s" else "left")
    for step in plan.steps:
        table.add_row(step.name, step.purpose, f"{step.seconds:.1f}")
    terminal = console()
    terminal.print(table)
    low_um, high_um = limits.stroke_um
    within = f"{limits.low:g} to {limits.high:g} {limits.unit}, {low_um:g} to {high_um:g} µm"
    terminal.print(f"within {within}; loops at {limits.lowest_hz:g} to {limits.highest_hz:g} Hz")
    heat = "no thermal budget is given"
    if limits.loaded.config.limits.rms_current_a is not None:
        heat = f"the coil cools for {plan.pauses_s:.0f} s between"
    disk = f"{plan.megabytes:.0f} MB of {plan.free_mb:.0f} MB free in {folder}"
    terminal.print(f"at most {plan.seconds:.0f} s of rig time; {heat}; {disk}", soft_wrap=True)


def print_step(row: StepRow) -> None:
    """Print a step that is done."""
    how = "kept" if row.kept else f"{row.seconds:.1f} s"
    print(f"{row.name:16s} {how:>7s}  {row.text}", flush=True)


def print_characterisation(found: Characterisation, model: Path | None, page: Path) -> None:
    """Print the held-out error, what was measured, and where things are."""
    terminal = console()
    if found.held_out:
        title = Text("errors on references that no fit saw")
        terminal.print(_table(title, HELD_OUT_HEADINGS, held_out_rows(found)))
        terminal.print(f"verdict: {found.verdict}", soft_wrap=True)
        for note in found.verdict.notes if found.verdict else ():
            terminal.print(note, soft_wrap=True)
    figures = list(figure_rows(found))
    if figures:
        terminal.print(_table(Text("measured"), ("figure", "value"), figures))
    if model is not None:
        terminal.print(f"model: {model}", soft_wrap=True)
    terminal.print(f"page: {page}", soft_wrap=True)


def _table(title: Text, headings: tuple[str, ...], rows: list[Any]) -> Table:
    table = Table(title=title, title_justify="left")
    for i, name in enumerate(headings):
        table.add_column(name, justify="left" if i == 0 or len(headings) == 2 else "right")
    for row in rows:
        table.add_row(*map(Text, row))
    return table
