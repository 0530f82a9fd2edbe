"""Devices with text (SCPI, GCS, DCON) or fixed frames: profile, session, and ``serial_dac``."""

LINK_KINDS = dict.fromkeys(
    ("ascii", "ascii_tcp", "bytes"), f"{__name__}.ascii_profile:AsciiProfile"
)
"""Class of profiles per ``link.kind``."""
