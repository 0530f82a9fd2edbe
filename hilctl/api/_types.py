"""Types of arguments that several functions accept, and their conversion."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

from hilctl.base.errors import InputError
from hilctl.base.files import already_there

PathLike: TypeAlias = str | os.PathLike[str]
Paths: TypeAlias = PathLike | Sequence[PathLike]


def paths_of(paths: Paths) -> list[Path]:
    """Return one or several paths as a list."""
    if isinstance(paths, str | os.PathLike):
        return [Path(paths)]
    return [Path(each) for each in paths]


def experiment_path(experiment: PathLike) -> Path:
    """Return the path of an experiment; raise InputError if it is not one, such as a mapping."""
    if isinstance(experiment, str | os.PathLike):
        return Path(experiment)
    raise InputError(
        f"experiment must be the path of a file, got {type(experiment).__name__}: write the file, "
        "and override its keys with settings"
    )


def path_or_none(path: PathLike | None) -> Path | None:
    """Return an optional path."""
    return None if path is None else Path(path)


def runs_folder(output: PathLike, folder: PathLike | None = None) -> Path:
    """Return the folder for the runs that lead to a file; default: ``OUTPUT-runs``."""
    file = Path(output)
    if not file.name:
        raise already_there(file, "")
    return path_or_none(folder) or file.with_name(f"{file.stem}-runs")
