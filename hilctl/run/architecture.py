"""Systems that a run may be on."""

import sys

from hilctl.base.errors import InputError

WORKS_ANYWHERE = "report, replay, export, identify, compare, check and learn --fast work here"


def require_linux(system: str | None = None) -> None:
    """Refuse a system other than Linux.

    Args:
        system: The system's name, as in ``sys.platform``; this one's where None.

    Raises:
        InputError: It is another.
    """
    system = sys.platform if system is None else system
    if system != "linux":
        raise InputError(f"a run needs Linux, this is {system}: {WORKS_ANYWHERE}")
