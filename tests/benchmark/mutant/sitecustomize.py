"""Gives a changed source in the place of a file that is imported, in this process and its children.

Python runs it at its start where ``PYTHONPATH`` names this folder. ``HILCTL_MUTANT`` says which
file, and which to take instead.
"""

import os
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType

FILE, _, MUTANT = os.environ.get("HILCTL_MUTANT", "").partition("=")
_as_written = SourceFileLoader.get_code


def _get_code(loader: SourceFileLoader, fullname: str) -> CodeType | None:
    if loader.path != FILE:
        return _as_written(loader, fullname)
    return compile(Path(MUTANT).read_bytes(), FILE, "exec", dont_inherit=True)


if FILE:
    SourceFileLoader.get_code = _get_code  # type: ignore[method-assign]
