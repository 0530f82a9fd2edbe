"""How long a block in binary frames takes, with the most overhead that COBS can add."""

from hilctl_drivers.board.frames import WATCHDOG_REPLY, WATCHDOG_REQUEST, exchange_sizes
from hilctl_drivers.board.profile import FrameProfile, FramesLink
from hilctl_drivers.wire.framing import binary_framing
from hilctl_drivers.wire.timing import WireTime

_USB_BITS_PER_S = {True: 19 * 64 * 8e3, False: 13 * 512 * 8 * 8e3}
"""Bulk payload of full-speed (1 ms) and high-speed (125 us) frames (USB 2.0, tables 5-9, 5-10)."""


def exchange_time(profile: FrameProfile, block: int = 1) -> WireTime:
    """Return what a block costs.

    Args:
        profile: The board; see :func:`hilctl_drivers.profile.with_link` for another line.
        block: Samples in an exchange; more than one only for boards that stream. Those settle while
            the next messages pass, so a sample period is no shorter than :func:`settle_s`.
    """
    link = profile.link
    stream = profile.exchange == "stream"
    size = next(iter(profile.outputs.values())).format.size
    request, reply = exchange_sizes(block, size, stream=stream)
    framing = binary_framing(link.framing, link.crc, link.payload_max)
    what = f"{block} {'sample' if block == 1 else 'samples'} in {link.framing} frames"
    byte_s, gaps, gaps_s, line = _line(link)
    return WireTime(
        f"{what} {line}",
        framing.wire_size(request) * byte_s,
        framing.wire_size(reply) * byte_s,
        gaps,
        gaps_s,
        profile.turnaround_s,
        block,
        0.0 if stream else settle_s(profile),
    )


def arm_s(profile: FrameProfile) -> float:
    """Return how long a WATCHDOG message and its reply take, s."""
    link = profile.link
    size = next(iter(profile.outputs.values())).format.size
    framing = binary_framing(link.framing, link.crc, link.payload_max)
    sent = framing.wire_size(WATCHDOG_REQUEST.size + size)
    received = framing.wire_size(WATCHDOG_REPLY.size)
    byte_s, _, gaps_s, _ = _line(link)
    return (sent + received) * byte_s + gaps_s + profile.turnaround_s


def settle_s(profile: FrameProfile) -> float:
    """Return how long output and input take to settle, s."""
    channels = (*profile.outputs.values(), *profile.inputs.values())
    return sum(channel.settle_s for channel in channels)


def _line(link: FramesLink) -> tuple[float, int, float, str]:
    """Return time of a byte, number and time of gaps, and the line in words."""
    if not link.usb:
        return link.char_s, 0, 0.0, f"at {link.format}"
    full_speed = link.usb_frame_s >= 1e-3
    byte_s = 8.0 / _USB_BITS_PER_S[full_speed]
    speed = "full" if full_speed else "high"
    return byte_s, 1, link.usb_frame_s, f"over {speed}-speed USB"
