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
        int, typer.Option(min=0, max=65535, help="Port on this machine; 0 for any that is free.")
    ] = 0,
    as_json: AsJson = False,
) -> None:
    """Serve a page that shows runs as they go on, until Ctrl-C or the end of RUN."""
    from hilctl.desk.live import UntilEnded, serve_runs
    from hilctl.desk.server import LiveServer
    from hilctl.run.client import find_run
    from hilctl.run.run_folder import RunFolder

    first = find_run(name) if name is not None else None

    def chosen(runs: list[RunFolder]) -> RunFolder | None:
        if first is not None:
            return first
        return runs[0] if runs else None

    ended = UntilEnded()

    def over(server: LiveServer) -> bool:
        if first is None:
            return False
        # One that has ended before it could be looked at leaves nothing to wait for.
        return ended(server) or (server.feed(None) is None and not first.alive)

    serve_runs(
        chosen,
        over,
        lambda url: print_json({"url": url}) if as_json else print(f"live page: {url}", flush=True),
        port,
    )
