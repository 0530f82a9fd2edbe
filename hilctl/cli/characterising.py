"""The command that characterises an actuator."""

import signal
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hilctl.base.errors import InputError, RunError
from hilctl.base.files import check_writable
from hilctl.cli.options import AsJson, ExperimentFile, LabelTexts, Overwrite, Settings, with_labels
from hilctl.cli.output import finish_orphans, print_json

if TYPE_CHECKING:
    from collections.abc import Callable

    from hilctl.characterise.results import Characterisation
    from hilctl.characterise.session import Campaign, CampaignHost

_GOES_ON = "the same command goes on from this step"


def characterise(
    experiment: ExperimentFile,
    output: Annotated[Path, typer.Option(help="Model file to write; its page stands beside it.")],
    folder: Annotated[
        Path | None, typer.Option(help="Where each run is kept; OUTPUT-runs where not given.")
    ] = None,
    settings: Settings = None,
    labels: LabelTexts = None,
    highest_hz: Annotated[
        float | None, typer.Option(help="Highest frequency of loops; else from the sample rate.")
    ] = None,
    fast: Annotated[
        bool, typer.Option("--fast", help="Do not wait for real time; simulated devices only.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what it would do; nothing moves.")
    ] = False,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Find a model of a wired actuator: measure within its limits, identify, judge."""
    from hilctl.characterise.session import Campaign
    from hilctl.cli.characterise_view import plan_mapping, print_plan
    from hilctl.cli.progress import shown_progress

    page = output.with_suffix(".html")
    if page == output:
        raise InputError(f"{output}: is the name of the page: give the model another one, .yaml")
    chosen = folder or output.with_name(f"{output.stem}-runs")
    with shown_progress("characterise", quiet=as_json) as on_progress:
        host = _host(on_progress, fast=fast, quiet=as_json)
        campaign = Campaign(experiment, with_labels(settings, labels), chosen, highest_hz, host)
        plan = campaign.plan
        if dry_run:
            print_json(plan_mapping(plan)) if as_json else print_plan(plan, chosen)
            return
        check_writable(output, overwrite=overwrite)
        check_writable(page, overwrite=overwrite or any(chosen.glob("*.mcap")))
        finish_orphans()
        if not as_json:
            print_plan(plan, chosen)
        if overwrite:
            campaign.discard()
        found = _characterised(campaign, output, overwrite=overwrite)
    _finish(found, output, page, chosen, as_json=as_json)


def _host(
    on_progress: "Callable[[float, str], None]", *, fast: bool, quiet: bool
) -> "CampaignHost":
    from hilctl.characterise.session import CampaignHost
    from hilctl.cli.characterise_view import print_step
    from hilctl.run.step import paced, unpaced

    host = CampaignHost(run=unpaced if fast else paced, on_progress=on_progress)
    return host if quiet else replace(host, on_step=print_step)


def _characterised(campaign: "Campaign", output: Path, *, overwrite: bool) -> "Characterisation":
    from hilctl.run.step import StepStoppedError

    try:
        return campaign.characterise(output, overwrite=overwrite)
    except (StepStoppedError, KeyboardInterrupt) as error:
        number = getattr(error, "signal", signal.SIGINT)
        print(f"hilctl: stopped: {error or 'Ctrl-C'}; {_GOES_ON}", file=sys.stderr)
        raise typer.Exit(128 + number) from None
    except RunError as error:
        raise RunError(f"{error}; {_GOES_ON}") from None


def _finish(
    found: "Characterisation", output: Path, page: Path, folder: Path, *, as_json: bool
) -> None:
    from hilctl.characterise.page import write_characterisation
    from hilctl.cli.characterise_view import print_characterisation

    write_characterisation(found, page)
    model = output if found.is_model else None
    if as_json:
        places = {"output": str(model) if model else None, "page": str(page)}
        print_json({**found.to_mapping(), **places, "folder": str(folder)})
    else:
        print_characterisation(found, model, page)
    if found.problem:
        print(f"hilctl: {found.problem}", file=sys.stderr)
        print(
            "hilctl: once that is done, --overwrite measures all anew; what was measured is on "
            "the page",
            file=sys.stderr,
        )
        raise typer.Exit(3)
    if not found.is_model:
        raise typer.Exit(1)
