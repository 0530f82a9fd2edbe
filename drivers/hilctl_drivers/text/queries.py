"""Questions of a text device that stand beside its exchange: what they cost, and which may be."""

from hilctl.base.errors import InputError
from hilctl_drivers.profile_parts import Range
from hilctl_drivers.text.profile import AsciiInput, AsciiProfile, Query
from hilctl_drivers.wire.line_settings import AsciiLink
from hilctl_drivers.wire_time import CHECKSUM_CHARS


def query_time_s(profile: AsciiProfile, line: AsciiLink, query: Query, address: int) -> float:
    """Return how long it takes to ask for a number and to get it, s.

    Args:
        profile: The device that is asked.
        line: Line that it stands on, which may be that of another device.
        query: The question.
        address: The device's address.
    """
    link = profile.link
    ask = query.ask.format(address=address)
    ends = len(link.terminator) + len(link.reply_terminator) + 2 * CHECKSUM_CHARS[link.checksum]
    characters = len(ask) + len(query.example) + ends
    return characters * line.char_s + link.min_gap_s + profile.turnaround_s


def measuring_input(profile: object, name: str | None, output: Range) -> AsciiInput | None:
    """Return the input that measures the output itself; None where none is wanted.

    Args:
        profile: The device's profile.
        name: Name of the input, or None.
        output: The output in use.

    Raises:
        InputError: There is no such input, or it measures something else.
    """
    if name is None:
        return None
    if not isinstance(profile, AsciiProfile):
        raise InputError("measure is for devices that speak lines of text")
    measuring = {key: each for key, each in profile.inputs.items() if each.measures == "output"}
    if name not in measuring:
        known = ", ".join(measuring) or "none"
        rule = f"measure must be an input of {profile.title} that measures its own output"
        raise InputError(f"{rule}, got {name!r} (it has {known})")
    if measuring[name].unit != output.unit:
        rule = f"measure must be in {output.unit}, as the output is"
        raise InputError(f"{rule}: {name} is in {measuring[name].unit}")
    return measuring[name]
