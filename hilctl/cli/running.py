"""Commands about runs: start, check, safe; steering.py has those about runs that are going on."""

import logging
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from hilctl.base.errors import HilctlError, InputError
from hilctl.cli.compiling import compiling_shown
from hilctl.cli.options import AsJson, ExperimentFile, LabelTexts, Overwrite, Settings, with_labels
from hilctl.cli.output import finish_orphans, print_json

_log = logging.getLogger(__name__)


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
    live: Annotated[
        bool, typer.Option("--live", help="Serve a page that shows the run as it goes on.")
    ] = False,
    require_rt: Annotated[
        bool, typer.Option("--require-rt", help="Refuse without SCHED_FIFO and locked memory.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Run an experiment and record it; Ctrl-C ramps to the safe value first."""
    settings = with_labels(settings, labels)
    if require_rt:
        settings.append("realtime.require=true")
    if watch and (detach or as_json):
        raise InputError("--watch: not with --detach, which hilctl watch looks at, nor with --json")
    if detach and live:
        raise InputError("--detach and --live: start it by --detach, and look at it by hilctl live")
    if detach:
        _detach(experiment, output, settings, overwrite=overwrite, as_json=as_json)
        return
    from hilctl.run.architecture import require_linux

    require_linux()
    with compiling_shown():
        _run(experiment, output, settings, overwrite, watch=watch, live=live, as_json=as_json)


def _run(
    experiment: Path,
    output: Path | None,
    settings: list[str],
    overwrite: bool,
    *,
    watch: bool,
    live: bool,
    as_json: bool,
) -> None:
    from hilctl import api
    from hilctl.cli.run_view import LiveView, print_run, report_of, run_mapping

    finish_orphans()
    quiet = as_json or watch
    with (
        _served(wanted=live) as addresses,
        _watched(wanted=watch),
        LiveView(quiet=quiet, addresses=addresses) as view,
    ):
        result = api.run(
            experiment, output, settings=settings, overwrite=overwrite, on_progress=view.update
        )
        if result.stop_signal:  # impatience must not cost the result of a run that has ended
            signal.signal(result.stop_signal, signal.SIG_IGN)
    report, unread = None, ""
    try:
        report = report_of(result, whole=as_json)
    except HilctlError as error:  # of a run that has moved: no refusal, and no exit code of one
        unread = f"hilctl: the recording can't be reported: {error}"
        print(unread, file=sys.stderr)
    if as_json:
        print_json(run_mapping(result, report))
    else:
        print_run(result, report)
    if result.code == "fault" or unread or not result.safe:
        raise typer.Exit(3)
    if result.stop_signal:
        raise typer.Exit(128 + result.stop_signal)


@contextmanager
def _watched(*, wanted: bool) -> Iterator[None]:
    if not wanted:
        yield
        return
    from hilctl.cli.watch import watched_beside

    with watched_beside():
        yield


@contextmanager
def _served(*, wanted: bool) -> Iterator[list[str]]:
    """Serve the live page where it is wanted; yield its addresses that are to be printed."""
    if not wanted:
        yield []
        return
    from hilctl.desk.live import served_beside

    with served_beside() as url:
        yield [url]


def _detach(
    experiment: Path, output: Path | None, settings: list[str], *, overwrite: bool, as_json: bool
) -> None:
    from hilctl.machine.files import Machine
    from hilctl.machine.logind import log_out
    from hilctl.run.detached import start_detached
    from hilctl.run.run_folder import facts_of

    found = log_out(Machine())
    if found.level != "ok":
        _log.warning("a log-out %s: %s", found.text, found.remedy)
    flags = ["--overwrite"] if overwrite else []
    started = start_detached(experiment, settings, output, flags)
    facts = {"recording": str(started.recording), "log": str(started.log)}
    if as_json:
        print_json({**(facts_of(started.run) if started.run else {}), **facts})
    elif started.run is None:
        print(f"the run has ended already; recording: {started.recording}; log: {started.log}")
    else:
        print(f"{started.run.card.name} runs; recording: {started.run.card.recording}")
        print("  hilctl status    hilctl set gain=0.5 --over 2    hilctl stop")


def check(experiment: ExperimentFile, settings: Settings = None, as_json: AsJson = False) -> None:
    """Check an experiment and say what it would do; nothing moves."""
    from hilctl import api
    from hilctl.cli.run_view import print_forecast

    checked = api.check(experiment, settings or [])
    if as_json:
        found = {"warnings": list(checked.warnings), **checked.forecast.to_mapping()}
        print_json({"experiment": str(experiment), **found})
    else:
        print_forecast(checked)


def safe(experiment: ExperimentFile, settings: Settings = None, as_json: AsJson = False) -> None:
    """Put a device at its safe value by hand, where no run holds it."""
    from hilctl.loop.safe_output import describe
    from hilctl.run.architecture import require_linux

    require_linux()
    from hilctl.run.by_hand import put_safe

    put = put_safe(experiment, settings or [])
    where = f"{put.device}: {describe(put.output, put.error)} ({put.value:g} {put.unit})"
    if as_json:
        print_json(put.to_mapping())
    elif put.output == "confirmed":
        print(where)
    else:
        print(where, file=sys.stderr)
        if put.guardian_active:
            print("The guardian of the last run keeps trying: see hilctl status.", file=sys.stderr)
    if put.output != "confirmed":
        raise typer.Exit(3)
