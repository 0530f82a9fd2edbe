"""Convert arguments that all functions accept."""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

PathLike: TypeAlias = str | os.PathLike[str]
Settings: TypeAlias = Mapping[str, object] | Sequence[str]
"""Over an experiment: values by key, ``{"waveform.frequency_hz": 50.0}``, or ``key=value`` texts as
``--set`` takes them."""
Paths: TypeAlias = PathLike | Sequence[PathLike]


def texts_of(settings: Settings) -> list[str]:
    """Return settings as ``key=value`` texts.

    Raises:
        TypeError: A value is none that YAML could hold.
    """
    if not isinstance(settings, Mapping):
        return [*settings]
    return [f"{key}={json.dumps(value, ensure_ascii=False)}" for key, value in settings.items()]


def paths_of(given: Paths) -> list[Path]:
    """Return one or several paths as a list."""
    if isinstance(given, str | os.PathLike):
        return [Path(given)]
    return [Path(each) for each in given]


def path_or_none(given: PathLike | None) -> Path | None:
    """Return a path that may be left out."""
    return None if given is None else Path(given)


def runs_folder(output: PathLike, folder: PathLike | None = None) -> Path:
    """Return where the runs that lead to a file are kept."""
    file = Path(output)
    return path_or_none(folder) or file.with_name(f"{file.stem}-runs")
