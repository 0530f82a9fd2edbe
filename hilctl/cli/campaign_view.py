"""Campaigns for people: what one will do, each step, and what came of it."""

from typing import Any

from rich.table import Table
from rich.text import Text

from hilctl.campaign.plan import SeriesPlan
from hilctl.campaign.session import SeriesResult
from hilctl.campaign.steps import SeriesStep, cell
from hilctl.campaign.table import SeriesRow
from hilctl.cli.console import console
from hilctl.series.columns import COMPLETED


def plan_mapping(plan: SeriesPlan) -> dict[str, Any]:
    """Return a plan as plain values."""
    return {
        "campaign": plan.campaign.config.name,
        "folder": str(plan.folder),
        "steps": [
            {
                "step": each.step.number,
                "repeat": each.step.repeat,
                "reference_run": each.step.is_reference,
                "values": {key: cell(value) for key, value in each.step.point.items()},
                "seconds": each.seconds,
                "pause_s": each.pause_s,
                "heat_before_a": each.heat_a2**0.5,
                "kept": str(each.kept) if each.kept else None,
            }
            for each in plan.steps
        ],
        "left": len(plan.left),
        "rig_time_s": plan.seconds,
        "pauses_s": plan.pauses_s,
        "recordings_mb": plan.megabytes,
        "free_mb": plan.free_mb,
    }


def print_plan(plan: SeriesPlan, *, fast: bool, every_step: bool) -> None:
    """Print what a campaign will do.

    Args:
        plan: The plan.
        fast: Whether its runs need no real time.
        every_step: Whether each step is listed.
    """
    terminal = console()
    if every_step:
        terminal.print(_steps(plan))
    kept = len(plan.steps) - len(plan.left)
    stands = f", {kept} of them stand already" if kept else ""
    time = f"{_duration(plan.seconds)} of rig time"
    pauses = f" and {_duration(plan.pauses_s)} for the coil to cool" if plan.pauses_s else ""
    how = ", as fast as it goes" if fast else ""
    disk = f"{plan.megabytes:.0f} MB of {plan.free_mb:.0f} MB free in {plan.folder}"
    count = f"{plan.campaign.config.name}: {len(plan.steps)} steps{stands}"
    terminal.print(f"{count}; {time}{pauses}{how}; {disk}", soft_wrap=True)


def _steps(plan: SeriesPlan) -> Table:
    table = Table(title=Text(f"{plan.campaign.config.name}: steps"), title_justify="left")
    for name in ("step", *plan.campaign.keys, "s", "pause s", "coil A rms", ""):
        table.add_column(name, justify="right")
    for each in plan.steps:
        values = [_shown(each.step.point.get(key)) for key in plan.campaign.keys]
        what = "reference run" if each.step.is_reference else ""
        table.add_row(
            str(each.step.number),
            *map(Text, values),
            f"{each.seconds:.1f}" if each.kept is None else "",
            f"{each.pause_s:.0f}" if each.pause_s else "",
            f"{each.heat_a2**0.5:.2f}" if each.kept is None else "",
            "stands" if each.kept else what,
        )
    return table


def _shown(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:g}" if isinstance(value, float) else str(cell(value))


def _duration(seconds: float) -> str:
    whole = round(seconds)
    if whole < 100:
        return f"{seconds:.0f} s"
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def print_row(step: SeriesStep, row: SeriesRow) -> None:
    """Print a step that is done."""
    values = "  ".join(f"{key}={_shown(value)}" for key, value in step.point.items())
    figures = row.figures
    parts = [
        (figures.peak_to_peak_um, "{:.4g} µm"),
        (figures.peak_hysteresis_percent, "hysteresis {:.3g} %"),
        (figures.peak_error_percent, "error {:.3g} %"),
        (figures.natural_hz, "resonance {:.4g} Hz"),
    ]
    found = "  ".join(text.format(value) for value, text in parts if value is not None)
    text = found if row.code == COMPLETED else row.result
    kept = "stands  " if row.kept else ""
    print(f"{step.number:4d}  {values or 'reference run'}  {kept}{text}", flush=True)


def result_mapping(result: SeriesResult) -> dict[str, Any]:
    """Return what came of a campaign as plain values."""
    codes = [row.code for _, row in result.ordered]
    return {
        "campaign": result.plan.campaign.config.name,
        "folder": str(result.plan.folder),
        "tables": [str(path) for path in result.tables],
        "page": str(result.page) if result.page else None,
        "steps": len(codes),
        "results": {code: codes.count(code) for code in sorted(set(codes))},
        "drift": result.drift.to_mapping() if result.drift else None,
        "reason": result.reason,
    }


def print_result(result: SeriesResult) -> None:
    """Print what came of a campaign, its drift, and where its table is."""
    terminal = console()
    counts = result_mapping(result)["results"]
    done = ", ".join(f"{count} {code}" for code, count in counts.items())
    terminal.print(f"{result.plan.campaign.config.name}: {done}", soft_wrap=True)
    if result.drift is not None:
        terminal.print(str(result.drift), soft_wrap=True)
    for path in result.tables:
        terminal.print(f"table: {path}", soft_wrap=True)
    if result.page is not None:
        terminal.print(f"page: {result.page}", soft_wrap=True)
