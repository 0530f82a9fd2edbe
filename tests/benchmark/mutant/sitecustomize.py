"""Gives a changed module in the place of one that is imported, in this process and its children.

Python runs it at its start where ``PYTHONPATH`` names this folder. ``HILCTL_MUTANT`` says which
module, and which file to take instead.
"""

import os
import sys
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import CodeType

NAME, _, FILE = os.environ.get("HILCTL_MUTANT", "").partition("=")


class _Loader(SourceFileLoader):
    def get_code(self, fullname: str) -> CodeType:
        return compile(Path(FILE).read_bytes(), self.path, "exec", dont_inherit=True)


class _Finder(MetaPathFinder):
    def find_spec(self, fullname: str, path: object, target: object = None) -> ModuleSpec | None:
        if fullname != NAME:
            return None
        spec = PathFinder.find_spec(fullname, path)
        spec.loader = _Loader(fullname, spec.origin)
        return spec


if NAME:
    sys.meta_path.insert(0, _Finder())
