"""Devices that speak lines of text: SCPI, DCON and similar protocols.

profile.py  profiles of such devices
lines.py    lines and the numbers in them
session.py  one conversation, and how long lines take
wire.py     sample by sample
"""

LINK_KINDS = {"ascii": f"{__name__}.ascii_profile:AsciiProfile"}
"""What a profile's ``link.kind`` says of it: where the class of such profiles stands."""
