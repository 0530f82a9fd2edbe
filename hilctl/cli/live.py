"""The command ``hilctl live``: serve a live page of active runs."""

from typing import Annotated

import typer

from hilctl.cli.options import AsJson
from hilctl.cli.safe_streams import print_json
from hilctl.live.server_process import RunSelector, SingleRun, serve_foxglove, serve_runs
from hilctl.run.control.client import find_run
from hilctl.run.run_folder import RunFolder, require_linux


def live(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="RUN", help="Run to show first (or the beginning of its name); default: any."
        ),
    ] = None,
    port: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=65535,
            help="Port on this computer; default: any free port, 8765 with --foxglove.",
        ),
    ] = None,
    foxglove: Annotated[
        bool,
        typer.Option(
            "--foxglove",
            help="Serve data to Foxglove, Lichtblick or PlotJuggler instead of a page.",
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Serve a live page of active runs, until Ctrl-C or the end of RUN."""
    require_linux()
    first = find_run(name) if name is not None else None

    def chosen(runs: list[RunFolder]) -> RunFolder | None:
        if first is not None:
            return first
        return runs[0] if runs else None

    ended = SingleRun()

    def over(server: RunSelector) -> bool:
        if first is None:
            return False
        # A run that ended before the server could read it has no feed.
        return ended(server) or (server.feed(None) is None and not first.alive)

    def on_url(url: str) -> None:
        what = "Foxglove server" if foxglove else "live page"
        print_json({"url": url}) if as_json else print(f"{what}: {url}", flush=True)

    if foxglove:
        serve_foxglove(chosen, over, on_url, port)
    else:
        serve_runs(chosen, over, on_url, port or 0)
