"""Compiled hysteresis operators, and what else is worked out sample by sample: pure functions.

Rules of this folder: explicit signatures, no globals, no objects, state passed in and updated in
place, and every kernel stands in one file with all that it calls, because numba's on-disk cache
does not notice a callee that changed in another file. Units live one level above.

    jit.py       the decorator of all kernels
    hysteresis.py  play, stop, deadband, their sums, the integrated model and its inverse
    implicit.py  operators whose inverse is found root by root: Preisach, KP, Bouc-Wen, Duhem
    envelope.py  play operators between envelopes
    field.py     plays and drags of an effective field, its losses, and their inverse
    residual.py  plays, drags and rate of a modelled displacement, and what undoes them
    dynamics.py  field lag, structure, delay, creep and modes, and their inverses
    atomics.py   numbers in shared memory that say of other data that they are there
    limit.py     peak and slew limits of a command
    interlock.py what ends a run, looked at in every sample
    packed.py    messages of a recording's chunk, and their packed lists
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
