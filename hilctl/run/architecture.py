"""Computers that a run may be on."""

import platform
import sys

from hilctl.base.errors import InputError

_ORDERED = {"x86_64", "amd64"}
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


def require_real_time_machine(machine: str | None = None, system: str | None = None) -> None:
    """Refuse a system other than Linux, or a processor that may show writes out of order.

    Loop and recorder pass samples on in shared memory without barriers, which Python does not have.

    Args:
        machine: The processor's name; this one's where None.
        system: The system's name, as in ``sys.platform``; this one's where None.

    Raises:
        InputError: A run can't be on it.
    """
    require_linux(system)
    machine = platform.machine() if machine is None else machine
    if machine.lower() not in _ORDERED:
        raise InputError(
            f"a run needs an x86-64 processor so far, this one is {machine or 'not known'}: "
            f"{WORKS_ANYWHERE}"
        )
