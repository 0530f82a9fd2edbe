"""Commands on one run: run, check, safe."""

import logging
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.text import Text

from hilctl import api
from hilctl.analysis.run_metrics import RunReport
from hilctl.base.errors import HilctlError, InputError
from hilctl.base.events import adapted_text
from hilctl.base.formatting import quantity, unit_text
from hilctl.base.subprocesses import python_command
from hilctl.cli.console import compile_progress, console, listing, progress_bar
from hilctl.cli.options import AsJson, ExperimentFile, LabelTexts, Overwrite, Settings
from hilctl.cli.output import Verbosity, print_json, print_result
from hilctl.cli.reports import render_report
from hilctl.experiment.preflight import CheckedExperiment, CheckedRun
from hilctl.experiment.sections.labels import label_settings
from hilctl.loop.interlocks import for_longer_than
from hilctl.loop.safe_output import describe
from hilctl.machine.diagnosis import log_out
from hilctl.machine.procfs import Machine
from hilctl.run.control.client import finish_dead_runs
from hilctl.run.result import Progress as RunProgress
from hilctl.run.result import RunResult
from hilctl.run.run_folder import facts_of, require_linux
from hilctl.run.safety.manual_safe import SafeResult, put_safe
from hilctl.run.start import start_detached

_log = logging.getLogger(__name__)

_REFRESH_S = 0.1
_LARGEST_REPORTED = 5_000_000
_VIEW_END_S = 2.0


def run(
    experiment: ExperimentFile,
    output: Annotated[Path | None, typer.Option(help="Recording to write.")] = None,
    settings: Settings = None,
    labels: LabelTexts = None,
    overwrite: Overwrite = False,
    detach: Annotated[
        bool, typer.Option("--detach", help="Run in the background; see status, set and stop.")
    ] = False,
    watch: Annotated[
        bool, typer.Option("--watch", help="Show the run in the terminal, with keys to change it.")
    ] = False,
    live: Annotated[bool, typer.Option("--live", help="Serve a live page of the run.")] = False,
    require_rt: Annotated[
        bool,
        typer.Option("--require-rt", help="Refuse to run without SCHED_FIFO and locked memory."),
    ] = False,
    take_over: Annotated[
        bool,
        typer.Option("--take-over", help="Use the device even if another user's process holds it."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Run an experiment and record it (Ctrl-C ramps to the safe value first)."""
    settings = [*(settings or []), *label_settings(labels or [])]
    if require_rt:
        settings.append("realtime.require=true")
    if watch and (detach or as_json):
        raise InputError("--watch excludes --detach (use hilctl watch instead) and --json")
    if detach and live:
        raise InputError("--detach excludes --live: use hilctl live after the start")
    if detach:
        flags = ["--overwrite"] * overwrite + ["--take-over"] * take_over
        _detach(experiment, output, settings, flags, as_json=as_json)
        return
    require_linux()
    finish_dead_runs()
    with compile_progress():
        with _displays(live=live, watch=watch, quiet=as_json or watch) as on_progress:
            result = api.run(
                experiment, output, settings=settings, overwrite=overwrite, take_over=take_over,
                on_progress=on_progress,
            )  # fmt: skip
            if result.stop_signal:  # a second Ctrl-C must not suppress the result
                signal.signal(result.stop_signal, signal.SIG_IGN)
        reports, failure = _reports(result, every=as_json)
    values = run_mapping(result, reports)
    print_result(values, lambda: print_run(result, reports), as_json=as_json)
    if result.code == "fault" or not result.safe:
        raise typer.Exit(3)
    if failure or result.stop_signal:
        raise typer.Exit(failure or 128 + result.stop_signal)


@contextmanager
def _displays(*, live: bool, watch: bool, quiet: bool) -> Iterator[Callable[[RunProgress], None]]:
    """Show a run in its displays meanwhile; yield the function to call with its progress."""
    with ExitStack() as stack:
        addresses = []
        if live:
            from hilctl.live.server_process import served_beside  # websockets

            addresses.append(stack.enter_context(served_beside()))
        if watch:
            stack.enter_context(_watched())
        yield stack.enter_context(run_progress(quiet=quiet, addresses=addresses))


def _reports(result: RunResult, *, every: bool) -> tuple[list[RunReport], int]:
    """Return the reports of a finished run, and the exit code if one fails; otherwise 0."""
    try:
        return reports_of(result, every=every), 0
    except HilctlError as error:  # not exit code 2, because the actuator has moved
        print(f"hilctl: cannot report the recording: {error}", file=sys.stderr)
        return [], 3
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the result is still printed
        print("hilctl: report interrupted: see hilctl report", file=sys.stderr)
        return [], 128 + signal.SIGINT


@contextmanager
def _watched() -> Iterator[None]:
    """Show the run from a subprocess, so that a blocked terminal cannot delay the run."""
    with subprocess.Popen(python_command("-m", "hilctl.cli.live", str(os.getpid()))) as process:
        try:
            yield
        finally:
            process.terminate()  # restores the terminal first
            with suppress(subprocess.TimeoutExpired):
                process.wait(_VIEW_END_S)
            process.kill()


def _detach(
    experiment: Path, output: Path | None, settings: list[str], flags: list[str], *, as_json: bool
) -> None:
    effect, remedy = log_out(Machine())
    if remedy:
        _log.warning("a log-out %s: %s", effect, remedy)
    started = start_detached(experiment, settings, output, flags)
    facts = {"recording": str(started.recording), "log": str(started.log)}
    if as_json:
        print_json({**(facts_of(started.run) if started.run else {}), **facts})
    elif started.run is None:
        print(f"run already ended; recording: {started.recording}; log: {started.log}")
    else:
        files = ", ".join(map(str, started.run.card.recordings))
        print(f"{started.run.card.name} is running; recording: {files}")
        print("  hilctl status    hilctl set gain=0.5 --over 2    hilctl stop")


def check(experiment: ExperimentFile, settings: Settings = None, as_json: AsJson = False) -> None:
    """Check an experiment and show what it would do (nothing moves)."""
    checked = api.check_axes(experiment, settings or [])
    values: dict[str, Any] = {"experiment": str(experiment)}
    if len(checked.axes) == 1:
        values |= _forecast_mapping(checked.first)
    else:
        axes = zip(checked.names, checked.axes, strict=True)
        values["notes"] = list(checked.notes)
        values["axes"] = {name: _forecast_mapping(each) for name, each in axes}
    print_result(values, lambda: print_forecast(checked), as_json=as_json)


def _forecast_mapping(checked: CheckedExperiment) -> dict[str, Any]:
    return {
        "warnings": list(checked.warnings),
        "expected_error": asdict(checked.expected) if checked.expected else None,
        "trigger": _trigger(checked),
        **checked.forecast.to_mapping(),
    }


def safe(experiment: ExperimentFile, settings: Settings = None, as_json: AsJson = False) -> None:
    """Set the device of each axis to its safe value (refused while a run uses one)."""
    require_linux()
    axes = put_safe(experiment, settings or [])
    confirmed = all(put.output == "confirmed" for put in axes.values())
    print_result(_safe_mapping(axes), lambda: _print_safe(axes), as_json=as_json)
    if not confirmed:
        raise typer.Exit(3)


def _safe_mapping(axes: Mapping[str, SafeResult]) -> dict[str, Any]:
    """Return the results of setting the safe values as plain values."""
    results = {name: put.to_mapping() for name, put in axes.items()}
    if "" in results:
        return results[""]
    safe = all(each["output_safe"] for each in results.values())
    active = any(each["guardian_active"] for each in results.values())
    return {"output_safe": safe, "guardian_active": active, "axes": results}


def _print_safe(axes: Mapping[str, SafeResult]) -> None:
    for name, put in axes.items():
        text = f"{put.device}: {describe(put.output, put.error)} ({put.value:g} {put.unit})"
        stream = sys.stdout if put.output == "confirmed" else sys.stderr
        print(f"{name}: {text}" if name else text, file=stream)
    if any(put.guardian_active for put in axes.values()):
        text = "The guardian of the last run is still retrying: see hilctl status."
        print(text, file=sys.stderr)


@contextmanager
def run_progress(
    *, quiet: bool, addresses: Sequence[str] = ()
) -> Iterator[Callable[[RunProgress], None]]:
    """Yield a function that shows the newest samples on standard error, a few per second."""
    pages, shown_s = list(addresses), 0.0

    def update(progress: RunProgress) -> None:
        nonlocal shown_s
        while pages:
            print(f"live page: {pages.pop()}", file=sys.stderr)
        now_s = time.monotonic()
        if not quiet and (now_s - shown_s >= _REFRESH_S or progress.samples >= progress.total):
            shown_s = now_s
            show(min(progress.samples / max(progress.total, 1), 1.0), _live_text(progress))

    with progress_bar("run", quiet=quiet) as show:
        yield update


def _live_text(progress: RunProgress) -> str:
    newest = progress.batch.samples(slice(-1, None))
    command, displacement_um = newest.command, newest.displacement_um
    error_um = displacement_um - newest.reference_um
    shown = progress.compensated and np.isfinite(error_um[-1])
    error = f"error {error_um[-1]:+7.2f} µm  " if shown else ""
    position = f"x {displacement_um[-1]:+8.2f} µm  command {command[-1]:+7.3f}"
    return f"{error}{position}  late {progress.late_ticks}"


def reports_of(result: RunResult, *, every: bool) -> list[RunReport]:
    """Return the report of each axis of a finished run.

    A very long run has none unless ``every`` is set.
    """
    wanted = every or 0 < result.samples <= _LARGEST_REPORTED
    return [*map(api.summarize, result.recordings)] if wanted else []


def run_mapping(result: RunResult, reports: Sequence[RunReport]) -> dict[str, Any]:
    """Return the result and reports of a run as plain values; several axes are under ``axes``."""
    found = result.to_mapping()
    if not result.axes:
        return {**(reports[0].to_mapping() if reports else {}), **found}
    for own, report in zip(found["axes"].values(), reports, strict=False):
        own |= {**report.to_mapping(), **own}
    return found


def print_run(result: RunResult, reports: Sequence[RunReport]) -> None:
    """Print the result of a run with its report, or with a line per axis."""
    terminal = console()
    colour = {"completed": "green", "stopped": "yellow"}.get(result.code, "red")
    terminal.print(Text(result.code, colour) + f": {result.reason}")
    if Verbosity.quiet and result.code == "fault":  # the terminal discards all
        print(f"hilctl: fault: {result.reason}", file=sys.stderr)
    if not result.safe:
        terminal.print(f"Not safe: {describe(result.output_state)}.", style="bold red")
    if result.guardian_active:
        terminal.print("The guardian is still retrying: see hilctl status and hilctl stop --run.")
    if result.deadline_misses:
        terminal.print(result.deadline_misses, style="bold yellow")
    if result.samples == 0:
        terminal.print("no samples recorded")
    elif result.axes:
        terminal.print(listing("", _axis_rows(result, reports)))
    elif reports:
        terminal.print(render_report(reports[0]))
    elif result.adapted:
        terminal.print(f"adapted: {adapted_text(result.adapted)}")
    for recording in result.recordings:
        terminal.print(f"recorded: {recording}", soft_wrap=True)
    path = shlex.quote(str(result.path))
    terminal.print(f"  hilctl report {path} --html run.html", soft_wrap=True)


def _axis_rows(result: RunResult, reports: Sequence[RunReport]) -> Iterator[tuple[str, ...]]:
    """Yield a row for each axis: its samples, and the errors of its report."""
    for (name, axis), report in zip_longest(result.axes.items(), reports):
        missing = f", {axis.missing:,} missing" if axis.missing else ""
        errors = ""
        if report is not None and report.peak_error_percent is not None:
            peak, rms = report.peak_error_percent, report.rms_error_percent
            errors = f"error {quantity(peak, '%')} peak, {quantity(rms, '%')} rms"
        yield name, f"{axis.samples:,} samples{missing}", errors


def print_forecast(checked: CheckedRun) -> None:
    """Print what the axes of a run have in common, then the rest and the warnings of each."""
    terminal, rows = console(), [_forecast_rows(axis) for axis in checked.axes]
    common = dict(set.intersection(*(set(each.items()) for each in rows)))
    terminal.print(listing("", ((key, common[key]) for key in rows[0] if key in common)))
    for name, axis, own in zip(checked.names, checked.axes, rows, strict=True):
        if name:
            left = [(key, text) for key, text in own.items() if key not in common]
            terminal.print(listing(f"Axis {name}", left))
        for warning in axis.warnings:
            terminal.print(f"warning: {warning}", style="yellow")
    for note in checked.notes:
        terminal.print(f"note: {note}")
    terminal.print("ready to run", style="green")


def _forecast_rows(checked: CheckedExperiment) -> dict[str, str]:
    forecast, config = checked.forecast, checked.loaded.config
    unit, limits, info = forecast.command_unit, config.limits, checked.loaded.device.info
    low, high = limits.command_range
    note = f" ({forecast.rate_note})" if forecast.rate_note else ""
    before = f", after {forecast.before_s:g} s of conditioning and rest"
    reference = f"{forecast.reference_min:.4g} to {forecast.reference_max:.4g}"
    command = f"{forecast.command_min:.4g} to {forecast.command_max:.4g} {unit}"
    rows = {
        "experiment": config.name,
        "device": info.description,
        "samples": f"{forecast.samples} at {config.sample_rate_hz:g} Hz, {config.block} per tick",
        "highest rate": f"{forecast.highest_rate_hz:.6g} Hz{note}",
        "duration": f"{forecast.duration_s:g} s{before if forecast.before_s else ''}",
        "reference": f"{reference} {unit_text(checked.reference.unit)}",
        "command": f"{command} (limits {low:g} to {high:g})",
        "slew": f"{forecast.slew_per_s:.4g} {unit}/s (limit {limits.slew_per_s:g})",
        "recording": _recording(forecast.recording_mb) + " per axis" * bool(checked.loaded.axis),
    }
    if config.amplifier is not None and forecast.voltage_v is not None:
        rows["voltage"] = f"{forecast.voltage_v:.4g} V (limit {config.amplifier.voltage_max_v:g})"
    if (expected := checked.expected) is not None:
        median = expected.median_percent
        rows["model error"] = (
            f"{expected.percent:.2g} % of a motion's peak-to-peak at {expected.stroke}, exceeded "
            "at a tenth of places and frequencies"
            f"{'' if median is None else f'; median {median:.2g} %'}"
            f"{expected.worst and f'; worst {expected.worst}'}"
        )
    if forecast.begins:
        rows["initial state"] = forecast.begins
    return rows | _supervised_rows(checked)


def _supervised_rows(checked: CheckedExperiment) -> dict[str, str]:
    """Return what interlocks, trigger and device add to the forecast."""
    forecast, config, rows = checked.forecast, checked.loaded.config, {}
    info, interlocks = checked.loaded.device.info, checked.loaded.rig.interlocks
    if interlocks.tracking_error_um is not None:
        more = f"more{for_longer_than(interlocks.tracking_s)} ends the run"
        rows["tracking error"] = f"at most {interlocks.tracking_error_um:g} µm; {more}"
    if (apart := config.apart) is not None:
        more = f"more{for_longer_than(apart.for_s)} ends the run"
        rows["apart"] = f"{' and '.join(apart.axes)} at most {apart.um:g} µm; {more}"
    if (target := config.on_target) is not None:
        rows["on target"] = f"within {target.tolerance_um:g} µm for {target.settle_s:g} s"
    if aux := checked.loaded.rig.aux:
        rows["auxiliary"] = "; ".join(f"{each.channel.name}: {each}" for each in aux)
    if (trigger := _trigger(checked)) is not None:
        rows["trigger"] = _trigger_text(trigger, config.tick_s)
    if info.safe_note:
        rows["safe value"] = info.safe_note
    if forecast.heating_rms_a is not None:
        initial = f"initially {forecast.begins_rms_a or 0.0:.3g} A rms"
        limit_a = config.limits.rms_current_a
        maximum = f"{forecast.heating_rms_a:.4g} A rms (limit {limit_a:g})"
        rows["heating"] = f"{maximum}, {initial}"
    return rows


def _trigger(checked: CheckedExperiment) -> dict[str, Any] | None:
    """Return the keys of the triggers with channels, number of marks and cost; None without."""
    trigger, info = checked.loaded.config.trigger, checked.loaded.device.info
    if trigger is None:
        return None
    return {
        **trigger.model_dump(),
        "digital_output": info.digital_output,
        "digital_output_s": info.digital_output_s,
        "digital_input": info.digital_input,
        "marks": trigger.of(checked.reference.segments).marks.size,
    }


def _trigger_text(known: dict[str, Any], tick_s: float) -> str:
    parts = []
    if known["start"]:
        parts.append("starts with {digital_input} {start}, at most {timeout_s:g} s")
    if known["output"]:
        mark = "for one sample at each {output} ({marks})"
        when = "on target" if known["output"] == "on_target" else mark
        parts.append(f"{{digital_output}} is high {when}")
        if cost_s := known["digital_output_s"]:
            parts[-1] += f", in {1e3 * cost_s:.2g} of {1e3 * tick_s:.3g} ms"
    return "; ".join(parts).format(**known)


def _recording(megabytes: float) -> str:
    return f"about {megabytes:.3g} MB" if megabytes < 1000.0 else f"about {megabytes / 1e3:.3g} GB"
