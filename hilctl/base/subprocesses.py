"""Child Python processes that import nothing from the working folder.

Its files may belong to someone else: a planted ``hilctl.py`` would have the user's rights, and the
device.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_SAFE_PATH = "PYTHONSAFEPATH"  # as -P, for children whose command line another module makes


def python_command(*words: str) -> list[str]:
    """Return the command line of this Python with further words, such as ``-m`` and a module."""
    return [sys.executable, "-P", *words]


@contextmanager
def safe_import_path() -> Iterator[None]:
    """Keep Python processes that are started meanwhile from importing from the working folder."""
    before = os.environ.get(_SAFE_PATH)
    os.environ[_SAFE_PATH] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[_SAFE_PATH]
        else:
            os.environ[_SAFE_PATH] = before
