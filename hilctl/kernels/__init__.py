"""Compiled arithmetic per sample: pure functions of plain arrays.

Rules: exact types in annotations, no globals, no objects; state is an argument, updated in place. A
kernel and all kernels that it calls are in one file, because numba's on-disk cache does not detect
a changed callee in another file. Kernels of models use only the syntax that
:mod:`hilctl.models.kernel_translation` translates to C and MATLAB.
"""

import os
from contextlib import suppress
from pathlib import Path

from hilctl.base.private_dirs import private_folder, user_folders


def _set_cache_folder() -> None:
    """Cache kernels in memory if neither the package's nor the user's cache folder is writable."""
    user_cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111
    writable = any(os.access(each, os.W_OK) for each in (Path(__file__).parent, user_cache))
    if writable or "NUMBA_CACHE_DIR" in os.environ:
        return
    for folder in user_folders():
        with suppress(OSError):
            os.environ["NUMBA_CACHE_DIR"] = str(private_folder(private_folder(folder) / "kernels"))
            return


_set_cache_folder()  # here, because numba reads it when it is imported
