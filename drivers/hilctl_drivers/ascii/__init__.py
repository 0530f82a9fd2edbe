"""Devices with a text protocol (SCPI, GCS, DCON): profile, lines, session, and ``serial_dac``."""

LINK_KINDS = dict.fromkeys(("ascii", "ascii_tcp"), f"{__name__}.ascii_profile:AsciiProfile")
"""Class of profiles per ``link.kind``."""
