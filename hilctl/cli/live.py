"""The live page of runs that are going on, until Ctrl-C."""

from typing import Annotated

import typer

from hilctl.cli.options import AsJson
from hilctl.cli.output import print_json


def live(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="RUN", help="Run to show first, or the beginning of its name; any if left out."
        ),
    ] = None,
    port: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=65535,
            help="Port on this machine; any that is free if left out, 8765 with --foxglove.",
        ),
    ] = None,
    foxglove: Annotated[
        bool,
        typer.Option(
            "--foxglove", help="Serve Foxglove, Lichtblick or PlotJuggler instead of a page."
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Serve a page that shows runs as they go on, until Ctrl-C or the end of RUN."""
    from hilctl.run.architecture import require_linux

    require_linux()
    from hilctl.desk.live import ShowsRuns, UntilEnded, serve_foxglove, serve_runs
    from hilctl.run.client import find_run
    from hilctl.run.run_folder import RunFolder

    first = find_run(name) if name is not None else None

    def chosen(runs: list[RunFolder]) -> RunFolder | None:
        if first is not None:
            return first
        return runs[0] if runs else None

    ended = UntilEnded()

    def over(server: ShowsRuns) -> bool:
        if first is None:
            return False
        # One that has ended before it could be looked at leaves nothing to wait for.
        return ended(server) or (server.feed(None) is None and not first.alive)

    def on_url(url: str) -> None:
        what = "Foxglove server" if foxglove else "live page"
        print_json({"url": url}) if as_json else print(f"{what}: {url}", flush=True)

    if foxglove:
        serve_foxglove(chosen, over, on_url, port)
    else:
        serve_runs(chosen, over, on_url, port or 0)
