"""The command that characterises an actuator."""

import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hilctl.base.errors import RunError
from hilctl.cli.options import AsJson, ExperimentFile, LabelTexts, Overwrite, Settings, with_labels
from hilctl.cli.output import print_json

if TYPE_CHECKING:
    from hilctl.characterise.results import Characterisation
    from hilctl.characterise.session import CampaignPlan

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
    from hilctl.api.running import runs_folder
    from hilctl.cli.characterise_view import plan_mapping, print_plan, print_step
    from hilctl.cli.progress import shown_progress

    chosen = runs_folder(output, folder)

    def on_plan(plan: "CampaignPlan") -> None:
        if not as_json:
            print_plan(plan, chosen)
        elif dry_run:
            print_json(plan_mapping(plan))

    with shown_progress("characterise", quiet=as_json) as on_progress:
        found = _characterised(
            experiment,
            output,
            folder=chosen,
            settings=with_labels(settings, labels),
            highest_hz=highest_hz,
            fast=fast,
            overwrite=overwrite,
            dry_run=dry_run,
            on_progress=on_progress,
            on_plan=on_plan,
            on_step=(lambda row: None) if as_json else print_step,
        )
    if found is not None:
        _finish(found, output, output.with_suffix(".html"), chosen, as_json=as_json)


def _characterised(experiment: Path, output: Path, **asked: Any) -> "Characterisation | None":
    from hilctl import api
    from hilctl.run.start import StepStoppedError

    try:
        return api.characterise(experiment, output, **asked)
    except (StepStoppedError, KeyboardInterrupt) as error:
        number = getattr(error, "signal", signal.SIGINT)
        print(f"hilctl: stopped: {error or 'Ctrl-C'}; {_GOES_ON}", file=sys.stderr)
        raise typer.Exit(128 + number) from None
    except RunError as error:
        raise RunError(f"{error}; {_GOES_ON}") from None


def _finish(
    found: "Characterisation", output: Path, page: Path, folder: Path, *, as_json: bool
) -> None:
    from hilctl.cli.characterise_view import print_characterisation

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
