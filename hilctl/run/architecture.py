"""Systems that a run may be on."""

import sys

from hilctl.base.errors import InputError

WORKS_ANYWHERE = "report, replay, export, identify, compare, check and learn --fast work here"


def require_real_time_machine() -> None:
    """Raise InputError on a system other than Linux."""
    if sys.platform != "linux":
        raise InputError(f"a run needs Linux, this is {sys.platform}: {WORKS_ANYWHERE}")
