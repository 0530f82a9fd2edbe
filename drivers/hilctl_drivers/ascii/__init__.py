"""Devices that speak lines of text: SCPI, DCON and their like.

profile.py  what a profile says of one
lines.py    lines and the numbers in them
timing.py   how long they take
session.py  one conversation
wire.py     sample by sample
"""

LINK_KINDS = {"ascii": f"{__name__}.ascii_profile:AsciiProfile"}
"""What a profile's ``link.kind`` says of it: where the class of such profiles stands."""
