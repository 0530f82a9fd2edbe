"""Processors that a run may be on."""

import platform

from hilctl.base.errors import InputError

_ORDERED = {"x86_64", "amd64"}


def require_ordered_memory(machine: str | None = None) -> None:
    """Refuse a processor that may show another core's writes out of order.

    Loop and recorder pass samples on in shared memory without barriers, which Python does not have.

    Args:
        machine: Its name; this machine's where None.

    Raises:
        InputError: It is not known to keep the order.
    """
    machine = platform.machine() if machine is None else machine
    if machine.lower() not in _ORDERED:
        raise InputError(
            f"a run needs an x86-64 processor so far, this one is {machine or 'not known'}: "
            "report, replay, export, identify and compare work here"
        )
