"""Microcontroller boards with binary frames: profile, messages, session, and ``serial_dac``."""

LINK_KINDS = {"frames": f"{__name__}.board_profile:FrameProfile"}
"""Class of profiles per ``link.kind``."""
