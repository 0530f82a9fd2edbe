"""Commands for the first minutes: examples to copy, and a demonstration."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hilctl.cli.options import AsJson
from hilctl.cli.output import finish_orphans, print_json

if TYPE_CHECKING:
    from hilctl.recording.data import Recording
    from hilctl.run.result import RunResult

_SECONDS = 3.0
_SHOWN = (
    ("without", "terfenol_sine_6a_uncompensated", ("waveform.frequency_hz=50",)),
    ("with", "demo", ()),
)


def examples(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="Example to copy; else list them.")
    ] = None,
    into: Annotated[Path, typer.Option(help="Folder for the copies.")] = Path(),
    as_json: AsJson = False,
) -> None:
    """List the examples, or copy one and the files it names to where they can be changed."""
    from hilctl.experiment.examples import copy_example, examples_folder, shipped_examples

    folder = examples_folder()
    if name is not None:
        copies = copy_example(name, into, folder)
        if as_json:
            print_json({"example": name, "files": [str(path) for path in copies]})
        else:
            print("\n".join(map(str, copies)))
        return
    found = shipped_examples(folder)
    if as_json:
        print_json({"examples": [example.to_mapping() for example in found]})
        return
    from rich.table import Table

    from hilctl.cli.console import print_rich

    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    table.add_column(no_wrap=True)
    for example in found:
        table.add_row(example.name, example.description)
    print_rich(table)
    print("\nhilctl examples NAME copies one, and the files that it names, into this folder")


def demo(
    folder: Annotated[
        Path, typer.Option(help="Folder for experiments, recordings and pages.")
    ] = Path("hilctl-demo"),
    as_json: AsJson = False,
) -> None:
    """Run the simulated rig without and with the inverse, and show what it does."""
    from hilctl.run.architecture import require_linux

    require_linux()
    from hilctl.analysis.report import summarize
    from hilctl.analysis.run_page import write_html
    from hilctl.experiment.examples import copy_example, examples_folder
    from hilctl.recording.reader import read

    finish_orphans()
    files = [copy_example(name, folder, examples_folder())[0] for _, name, _ in _SHOWN]
    found: dict[str, Any] = {}
    before: Recording | None = None
    for (which, _, settings), experiment in zip(_SHOWN, files, strict=True):
        result = _run(experiment, folder, settings, quiet=as_json)
        if result.stop_signal:
            raise typer.Exit(128 + result.stop_signal)
        contents = read(result.path)
        summary = summarize(contents)
        page = result.path.with_suffix(".html")
        write_html(contents, summary, page, before)
        before = contents
        found[which] = {
            "recording": str(result.path),
            "page": str(page),
            "code": result.code,
            "peak_hysteresis_percent": summary.peak_hysteresis_percent,
            "deadline_misses": result.deadline_misses,
        }
        if not as_json:
            _say(which, found[which], result.reason)
    if as_json:
        print_json(found)
    else:
        own = shlex.quote(str(files[-1]))
        print(f"\nNext: change {own}, then\n  hilctl check {own}")
        print(f"  hilctl run {own}\n  hilctl examples")
    if any(each["code"] == "fault" for each in found.values()):
        raise typer.Exit(3)


def _run(experiment: Path, folder: Path, settings: tuple[str, ...], *, quiet: bool) -> "RunResult":
    from hilctl.cli.run_view import LiveView
    from hilctl.run.start import start_run

    over = [f"waveform.duration_s={_SECONDS:g}", f"recording.folder={folder}"]
    with LiveView(quiet=quiet) as view:
        return start_run(
            experiment, [*over, *settings], None, overwrite=False, on_progress=view.update
        )


def _say(which: str, found: dict[str, Any], reason: str) -> None:
    hysteresis = found["peak_hysteresis_percent"]
    judged = "no figure" if hysteresis is None else f"{hysteresis:.2f} % peak hysteresis"
    print(f"{which + ' the inverse':20} {judged:28} {found['code']}: {reason}")
    if found["deadline_misses"]:
        print(f"{'':20} {found['deadline_misses']}")
    print(f"{'':20} {found['page']}")
