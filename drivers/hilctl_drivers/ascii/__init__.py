"""Devices with a text protocol (SCPI, DCON): profile, lines, session, and ``serial_dac``."""

LINK_KINDS = {"ascii": f"{__name__}.ascii_profile:AsciiProfile"}
"""Class of profiles per ``link.kind``."""
