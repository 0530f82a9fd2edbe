"""Commands that read recordings: report, replay, export.

They go without typer, which takes as long to load as 20 s at 50 kHz to read.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from hilctl import api
from hilctl.base.errors import InputError
from hilctl.cli.output import finish_orphans, print_json


def read_recording(name: str, words: Sequence[str]) -> int:
    """Run one of these commands.

    Args:
        name: Its name.
        words: Its arguments.

    Returns:
        The exit code.

    Raises:
        HilctlError: It could not be done.
    """
    command, _ = _COMMANDS[name]
    return command(**vars(parser_of(name).parse_intermixed_args(words)))


def parser_of(name: str) -> argparse.ArgumentParser:
    """Return what reads the words of a command."""
    command, add_arguments = _COMMANDS[name]
    parser = argparse.ArgumentParser(
        f"hilctl {name}", description=command.__doc__, allow_abbrev=False
    )
    add_arguments(parser)
    parser.add_argument(
        "--json", dest="as_json", action="store_true", help="Print one JSON object for programs."
    )
    return parser


def report(
    runs: Sequence[Path],
    *,
    html: Path | None = None,
    before: Path | None = None,
    model: Path | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
    overwrite: bool = False,
    as_json: bool = False,
) -> int:
    """Judge a recording: hysteresis, error, noise, lateness; or many, or a campaign's folder."""
    if len(runs) > 1 or runs[0].is_dir():
        if from_s is not None or to_s is not None or before is not None:
            raise InputError("--from, --to and --before are for the report of one recording")
        from hilctl.cli.series import report_series

        report_series(runs, html, model, overwrite=overwrite, as_json=as_json)
        return 0
    if model is not None:
        raise InputError("--model is for the report of several recordings")
    if before is not None and html is None:
        raise InputError("--before is drawn on the page: name one with --html")
    if html is None:
        summary = api.summarize(runs[0], from_s=from_s, to_s=to_s)
    else:
        summary = api.report_page(
            runs[0], html, before=before, from_s=from_s, to_s=to_s, overwrite=overwrite
        )
    if as_json:
        print_json(summary.to_mapping())
    else:
        from hilctl.cli.console import print_rich
        from hilctl.cli.report_view import render

        print_rich(render(summary))
    return 0


def replay(recording: Path, *, model: Path | None = None, as_json: bool = False) -> int:
    """Recompute the commands from the recorded reference and compare them bit for bit."""
    finish_orphans()
    result = api.replay(recording, model)
    if as_json:
        print_json(result.to_mapping())
    else:
        from hilctl.cli.console import print_replay

        print_replay(result, other=model)
    return 0 if model is not None or result.identical else 1


def export(
    recording: Path,
    output: Path,
    *,
    every: bool = False,
    from_s: float | None = None,
    to_s: float | None = None,
    overwrite: bool = False,
    as_json: bool = False,
) -> int:
    """Write a recording's samples as CSV, NumPy, Parquet or MATLAB file."""
    finish_orphans()
    if every:
        if overwrite or from_s is not None or to_s is not None:
            raise InputError("--all: writes whole recordings, and replaces none")
        return _export_all(recording, output, as_json=as_json)
    rows = api.export(recording, output, from_s=from_s, to_s=to_s, overwrite=overwrite)
    if as_json:
        print_json({"output": str(output), "rows": rows})
    else:
        print(f"{output}: {rows} samples")
    return 0


def _export_all(folder: Path, output: Path, *, as_json: bool) -> int:
    from hilctl.analysis.export_all import export_all
    from hilctl.cli.progress import shown_progress

    with shown_progress("export", quiet=as_json) as progress:
        done = export_all(folder, output, progress)
    if as_json:
        print_json({"output": str(output), **asdict(done)})
    else:
        print(f"{output}: {done.written} recordings written, {done.there} were there already")
        for path, why in done.left_out.items():
            print(f"hilctl: {path}: is left out: {why}", file=sys.stderr)
    return 1 if done.left_out else 0


def _report_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "runs", nargs="+", type=Path, metavar="RUN",
        help="Recordings (MCAP), or a campaign's folder.",
    )  # fmt: skip
    parser.add_argument("--html", type=Path, metavar="FILE", help="Page with figures to write.")
    parser.add_argument(
        "--before", type=Path, metavar="FILE",
        help="The same motion without a compensator, for the page.",
    )  # fmt: skip
    parser.add_argument(
        "--model", type=Path, metavar="FILE",
        help="Model to hold against measured loops; else the recorded ones.",
    )  # fmt: skip
    _stretch_arguments(parser)
    _overwrite_argument(parser)


def _replay_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, metavar="RUN", help="Recording (MCAP).")
    parser.add_argument(
        "--model", type=Path, metavar="FILE",
        help="Another model: say what it would have done.",
    )  # fmt: skip


def _export_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recording", type=Path, metavar="RUN", help="Recording (MCAP), or a folder of them."
    )
    parser.add_argument(
        "output", type=Path, metavar="OUTPUT",
        help=".csv, .npz, .parquet or .mat file to write, or a folder.",
    )  # fmt: skip
    parser.add_argument(
        "--all", dest="every", action="store_true",
        help="All recordings of a folder, as Hive-style Parquet.",
    )  # fmt: skip
    _stretch_arguments(parser)
    _overwrite_argument(parser)


def _stretch_arguments(parser: argparse.ArgumentParser) -> None:
    for name, meaning in (("from", "From this time of the run, in s."),
                          ("to", "Up to this time of the run, in s.")):  # fmt: skip
        parser.add_argument(f"--{name}", dest=f"{name}_s", type=float, metavar="S", help=meaning)


def _overwrite_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--overwrite", action="store_true", help="Replace the file if it exists.")


_COMMANDS: dict[str, tuple[Callable[..., int], Callable[[argparse.ArgumentParser], None]]] = {
    "report": (report, _report_arguments),
    "replay": (replay, _replay_arguments),
    "export": (export, _export_arguments),
}
